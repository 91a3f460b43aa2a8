"""Honest numbers: the seed is the unit, every mean has an interval, several tests are corrected.

Needs SciPy (the ``lab`` extra) for the tests only. Bootstrap intervals are seeded, so a report is reproducible.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from uard import _checks

RESAMPLES = 2_000


class Summary(NamedTuple):
    """One quantity over seeds.

    Attributes:
        mean: Mean over seeds.
        sd: Sample standard deviation over seeds (0 for one seed).
        ci95: 95 % percentile-bootstrap interval of the mean.
        iqm: Interquartile mean: the mean of the middle half of the seeds.
        iqm_ci95: Its 95 % percentile-bootstrap interval.
        per_seed: The values themselves.
    """

    mean: float
    sd: float
    ci95: tuple[float, float]
    iqm: float
    iqm_ci95: tuple[float, float]
    per_seed: tuple[float, ...]


class Test(NamedTuple):
    """A two-sample test of the difference a - b.

    Attributes:
        t: The statistic; infinite if both samples are constant and differ.
        df: Degrees of freedom.
        p: Two-sided p value.
        difference: mean(a) - mean(b).
        effect: Hedges' g: the difference in pooled standard deviations, corrected for small samples.
    """

    t: float
    df: float
    p: float
    difference: float
    effect: float


_AT_ONCE = 4_000_000  # numbers that are drawn at once: 32 MB


def _resampled(n: int) -> Iterator[np.ndarray]:
    """Yield which of n values each resample is made of: ``RESAMPLES`` rows in all, in blocks for a large n."""
    if RESAMPLES * n <= _AT_ONCE:
        yield _resampled_whole(n)
        return
    generator, rows = np.random.default_rng(20260101), max(1, _AT_ONCE // n)
    for first in range(0, RESAMPLES, rows):
        yield generator.integers(0, n, (min(rows, RESAMPLES - first), n))


@lru_cache(maxsize=16)
def _resampled_whole(n: int) -> np.ndarray:
    return np.random.default_rng(20260101).integers(0, n, (RESAMPLES, n))


def interquartile_mean(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Mean of the middle half (the outer quarters trimmed, with fractional weight at the edges).

    Examples:
        >>> interquartile_mean(np.array([[0.0, 1.0, 2.0, 90.0]])).tolist()
        [1.5]

    Args:
        values: Of any shape.
        axis: Along which the mean is taken, and which the result lacks.

    Raises:
        InvalidValueError: no numbers along the axis.
    """
    x = np.sort(np.moveaxis(np.asarray(values, float), axis, -1), axis=-1)
    n = x.shape[-1]
    if n == 0:
        raise _checks.InvalidValueError("values.shape", x.shape, "at least one number along the axis")
    edges = np.clip(np.arange(1, n + 1) - n / 4, 0, 1) - np.clip(np.arange(1, n + 1) - 3 * n / 4, 0, 1)
    return (x * edges).sum(-1) / edges.sum()


def summarise(values: Sequence[float] | np.ndarray, field: str = "values") -> Summary:
    """Summarise one number per seed.

    Examples:
        >>> summary = summarise([1.0, 2.0, 3.0, 10.0])
        >>> summary.mean, summary.iqm, round(summary.sd, 2)
        (4.0, 2.5, 4.08)

    Args:
        values: (n,), n >= 1.
        field: What an error calls them.

    Raises:
        InvalidValueError: no values, or one that is not finite.
    """
    x = _sample(field, values, least=1)
    drawn = [(sample.mean(1), interquartile_mean(sample)) for sample in (x[rows] for rows in _resampled(x.size))]
    means, middles = (np.concatenate(several) for several in zip(*drawn, strict=True))
    low, high = np.quantile(means, [0.025, 0.975])
    iqm_low, iqm_high = np.quantile(middles, [0.025, 0.975])
    return Summary(
        float(x.mean()),
        float(x.std(ddof=1)) if x.size > 1 else 0.0,
        (float(low), float(high)),
        float(interquartile_mean(x)),
        (float(iqm_low), float(iqm_high)),
        tuple(float(v) for v in x),
    )


def intervals(values: np.ndarray) -> np.ndarray:
    """Return ``summarise``'s 95 % interval of the mean for many samples of one size at once.

    Examples:
        >>> intervals(np.array([[1.0, 1.0], [0.0, 2.0]])).tolist()
        [[1.0, 1.0], [0.0, 2.0]]

    Args:
        values: (m, n), finite, n >= 1: m samples of n seeds.

    Returns:
        (m, 2) lower and upper ends.
    """
    n = values.shape[1]
    counts = [_counts(drawn, n) for drawn in _resampled(n)] if RESAMPLES * n <= _AT_ONCE else None
    found = []
    for block in np.array_split(values, -(-len(values) // 1000)):  # whose means are 16 MB
        means = [block @ count / n for count in counts or (_counts(drawn, n) for drawn in _resampled(n))]
        found.append(np.quantile(np.concatenate(means, 1), [0.025, 0.975], axis=1).T)
    return np.concatenate(found)


def _counts(drawn: np.ndarray, n: int) -> np.ndarray:
    """Return how often each of n values is in each resample, (n, resamples)."""
    counts = np.empty((len(drawn), n))
    for count, row in zip(counts, drawn, strict=True):
        count[:] = np.bincount(row, minlength=n)
    return counts.T


def _sample(field: str, values: object, least: int = 2) -> np.ndarray:
    x = np.atleast_1d(_checks.as_numpy(field, values))
    if x.ndim > 1:
        raise _checks.InvalidValueError(f"{field}.shape", x.shape, "(n,): one number per seed")
    _checks.finite(field, x)
    if x.size < least:
        raise _checks.InvalidValueError(f"{field}.size", x.size, f">= {least} (one number per seed)")
    return x


def welch(a: object, b: object) -> Test:
    """Welch's t test: two samples whose variances may differ.

    Examples:
        >>> test = welch([1.0, 2.0, 3.0], [2.0, 5.0, 8.0])
        >>> test.difference, round(test.t, 3), round(test.df, 2), round(test.p, 3)
        (-3.0, -1.643, 2.44, 0.219)

    Args:
        a: (n,) finite numbers, one per seed, n >= 2.
        b: Alike; as many or not.

    Raises:
        InvalidValueError: too few numbers, or one that is not finite.
    """
    return _t_test(a, b, equal_variances=False)


def student(a: object, b: object) -> Test:
    """Student's two-sample t test with df = n_a + n_b - 2: the paper's (I1).

    Examples:
        >>> test = student([1.0, 2.0, 3.0], [2.0, 3.0, 4.0])
        >>> test.df, round(test.t, 3), round(test.p, 3)
        (4.0, -1.225, 0.288)

    Args:
        a: (n,) finite numbers, one per seed, n >= 2.
        b: Alike; as many or not.

    Raises:
        InvalidValueError: too few numbers, or one that is not finite.
    """
    return _t_test(a, b, equal_variances=True)


def _t_test(a: object, b: object, equal_variances: bool) -> Test:
    x, y = _sample("a", a), _sample("b", b)
    mean_x, variance_x = _mean_and_variance(x)
    mean_y, variance_y = _mean_and_variance(y)
    difference, df = mean_x - mean_y, float(x.size + y.size - 2)
    if variance_x == variance_y == 0:
        t = 0.0 if difference == 0 else math.copysign(math.inf, difference)
        return Test(t, df, 1.0 if t == 0 else 0.0, difference, t)
    from scipy.special import stdtr

    if equal_variances:
        variance_x = variance_y = ((x.size - 1) * variance_x + (y.size - 1) * variance_y) / df
    variance = variance_x / x.size + variance_y / y.size
    if not equal_variances:
        share = variance_x / x.size / variance
        df = 1 / (share**2 / (x.size - 1) + (1 - share) ** 2 / (y.size - 1))
    t = difference / math.sqrt(variance)
    return Test(t, df, float(2 * stdtr(df, -abs(t))), difference, hedges_g(x, y))


def _mean_and_variance(x: np.ndarray) -> tuple[float, float]:
    """Exact for a constant sample, whose rounded mean may differ from its values."""
    return (float(x[0]), 0.0) if np.ptp(x) == 0 else (float(x.mean()), float(x.var(ddof=1)))


def hedges_g(a: object, b: object) -> float:
    """Standardised difference with the small-sample correction 1 - 3 / (4 df - 1); infinite without spread.

    Examples:
        >>> round(hedges_g([1.0, 2.0, 3.0], [2.0, 3.0, 4.0]), 3)
        -0.8

    Args:
        a: (n,) finite numbers, one per seed, n >= 2.
        b: Alike; as many or not.

    Raises:
        InvalidValueError: too few numbers, or one that is not finite.
    """
    x, y = _sample("a", a), _sample("b", b)
    mean_x, variance_x = _mean_and_variance(x)
    mean_y, variance_y = _mean_and_variance(y)
    difference, df = mean_x - mean_y, x.size + y.size - 2
    pooled = math.sqrt(((x.size - 1) * variance_x + (y.size - 1) * variance_y) / df)
    if pooled == 0:
        return 0.0 if difference == 0 else math.copysign(math.inf, difference)
    return difference / pooled * (1 - 3 / (4 * df - 1))


def probability_of_improvement(a: object, b: object) -> float:
    """Chance that a seed of ``a`` beats a seed of ``b``, ties counted half.

    Examples:
        >>> probability_of_improvement([1.0, 2.0], [0.0, 1.0])
        0.875

    Args:
        a: (n,) finite numbers, one per seed, n >= 1.
        b: Alike; as many or not.

    Raises:
        InvalidValueError: no numbers, or one that is not finite.
    """
    x, y = _sample("a", a, 1), _sample("b", b, 1)
    return float((np.greater.outer(x, y) + 0.5 * np.equal.outer(x, y)).mean())


def bonferroni(p_values: Sequence[float]) -> list[float]:
    """Each p times their number, at most 1.

    Examples:
        >>> bonferroni([0.01, 0.04, 0.5])
        [0.03, 0.12, 1.0]

    Raises:
        InvalidValueError: a p outside [0, 1].
    """
    _check_p(p_values)
    return [min(1.0, p * len(p_values)) for p in p_values]


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's step-down adjustment: never weaker than Bonferroni's.

    Examples:
        >>> holm([0.01, 0.04, 0.5])
        [0.03, 0.08, 0.5]

    Raises:
        InvalidValueError: a p outside [0, 1].
    """
    _check_p(p_values)
    order = np.argsort(p_values)
    adjusted, running = [0.0] * len(p_values), 0.0
    for rank, i in enumerate(order):
        running = max(running, min(1.0, p_values[i] * (len(p_values) - rank)))
        adjusted[i] = running
    return adjusted


def _check_p(p_values: Sequence[float]) -> None:
    for i, p in enumerate(p_values):
        _checks.number(f"p_values[{i}]", p, low=0, high=1)
