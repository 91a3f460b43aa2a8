"""Honest numbers: the seed is the unit, every mean has an interval, several tests are corrected.

Needs SciPy (the ``lab`` extra) for the tests only. Bootstrap intervals are seeded, so a report is reproducible.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

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


@cache
def _resampled(n: int) -> np.ndarray:
    return np.random.default_rng(20260101).integers(0, n, (RESAMPLES, n))


def interquartile_mean(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Mean of the middle half (the outer quarters trimmed, with fractional weight at the edges)."""
    x = np.sort(np.moveaxis(np.asarray(values, float), axis, -1), axis=-1)
    n = x.shape[-1]
    edges = np.clip(np.arange(1, n + 1) - n / 4, 0, 1) - np.clip(np.arange(1, n + 1) - 3 * n / 4, 0, 1)
    return (x * edges).sum(-1) / edges.sum()


def summarise(values: Sequence[float] | np.ndarray, field: str = "values") -> Summary:
    """Summarise one number per seed.

    Raises:
        InvalidValueError: no values, or one that is not finite.
    """
    x = _sample(field, values, least=1)
    drawn = x[_resampled(x.size)]
    low, high = np.quantile(drawn.mean(1), [0.025, 0.975])
    iqm_low, iqm_high = np.quantile(interquartile_mean(drawn), [0.025, 0.975])
    return Summary(
        float(x.mean()),
        float(x.std(ddof=1)) if x.size > 1 else 0.0,
        (float(low), float(high)),
        float(interquartile_mean(x)),
        (float(iqm_low), float(iqm_high)),
        tuple(float(v) for v in x),
    )


def _sample(field: str, values: object, least: int = 2) -> np.ndarray:
    x = _checks.as_numpy(field, values).ravel()
    _checks.finite(field, x)
    if x.size < least:
        raise _checks.InvalidValueError(f"{field}.size", x.size, f">= {least} (one number per seed)")
    return x


def welch(a: object, b: object) -> Test:
    """Welch's t test: two samples whose variances may differ."""
    return _t_test(a, b, equal_variances=False)


def student(a: object, b: object) -> Test:
    """Student's two-sample t test with df = n_a + n_b - 2: the paper's (I1)."""
    return _t_test(a, b, equal_variances=True)


def _t_test(a: object, b: object, equal_variances: bool) -> Test:
    x, y = _sample("a", a), _sample("b", b)
    difference = float(x.mean() - y.mean())
    if x.std() == 0 and y.std() == 0:
        same = difference == 0
        t = 0.0 if same else math.copysign(math.inf, difference)
        return Test(t, float(x.size + y.size - 2), 1.0 if same else 0.0, difference, t)
    from scipy import stats

    result: Any = stats.ttest_ind(x, y, equal_var=equal_variances)
    return Test(float(result.statistic), float(result.df), float(result.pvalue), difference, hedges_g(x, y))


def hedges_g(a: object, b: object) -> float:
    """Standardised difference with the small-sample correction 1 - 3 / (4 df - 1); infinite without spread."""
    x, y = _sample("a", a), _sample("b", b)
    df = x.size + y.size - 2
    pooled = math.sqrt(((x.size - 1) * x.var(ddof=1) + (y.size - 1) * y.var(ddof=1)) / df)
    difference = float(x.mean() - y.mean())
    if pooled == 0:
        return 0.0 if difference == 0 else math.copysign(math.inf, difference)
    return difference / pooled * (1 - 3 / (4 * df - 1))


def probability_of_improvement(a: object, b: object) -> float:
    """Chance that a seed of ``a`` beats a seed of ``b``, ties counted half."""
    x, y = _sample("a", a, 1), _sample("b", b, 1)
    return float((np.greater.outer(x, y) + 0.5 * np.equal.outer(x, y)).mean())


def bonferroni(p_values: Sequence[float]) -> list[float]:
    """Each p times their number, at most 1."""
    return [min(1.0, p * len(p_values)) for p in p_values]


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's step-down adjustment: never weaker than Bonferroni's."""
    order = np.argsort(p_values)
    adjusted, running = [0.0] * len(p_values), 0.0
    for rank, i in enumerate(order):
        running = max(running, min(1.0, p_values[i] * (len(p_values) - rank)))
        adjusted[i] = running
    return adjusted
