"""Honest numbers: the seed is the unit, every mean has an interval, several tests are corrected.

Which interval a quantity has is decided here and nowhere else (``interval``): Wilson's for a share, Student's t below
ten seeds, the bootstrap from ten up, none for one seed. Families of comparisons are corrected with Holm's procedure
(``Family``). Needs SciPy (the ``lab`` extra) for the quantiles and tails of Student's t. What is drawn is seeded, so a
report is reproducible.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from uard import _checks

RESAMPLES = 2_000
LEVEL = 0.05  # of tests; intervals are 95 %
POWER = 0.8  # with which a minimal detectable difference is detected
FROM_BOOTSTRAP = 10  # seeds: a percentile interval of fewer is too short, see ``interval``
_EXACT = 14  # differences whose 2^14 signs are all tried
_FLIPS = 20_000  # signs that are drawn for more
Interval = tuple[float, float]


class Summary(NamedTuple):
    """One quantity over seeds.

    Attributes:
        mean: Mean over seeds.
        sd: Sample standard deviation over seeds (0 for one seed).
        ci95: 95 % interval of the mean as ``interval`` has it; None for one seed.
        iqm: Interquartile mean: the mean of the middle half of the seeds.
        iqm_ci95: Its 95 % percentile-bootstrap interval; None below ten seeds.
        per_seed: The values themselves.
    """

    mean: float
    sd: float
    ci95: Interval | None
    iqm: float
    iqm_ci95: Interval | None
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


def wilson(share: float, n: float) -> Interval:
    """Return Wilson's 95 % score interval of a share; it never leaves [0, 1] and is no point at 0 or 1.

    Wilson, E. B. (1927), "Probable inference, the law of succession, and statistical inference".

    Examples:
        >>> [round(x, 4) for x in wilson(0.9, 10)]  # nine of ten
        [0.5958, 0.9821]

    Args:
        share: Of the n, in [0, 1].
        n: How many independent trials there were, >= 1.

    Raises:
        InvalidValueError: a share outside [0, 1], or no trials.
    """
    _checks.number("share", share, low=0, high=1)
    _checks.number("n", n, low=1)
    z2 = 1.959963984540054**2
    middle, half = share + z2 / (2 * n), math.sqrt(z2 * (share * (1 - share) / n + z2 / (4 * n * n)))
    low, high = (middle - half) / (1 + z2 / n), (middle + half) / (1 + z2 / n)
    return min(max(low, 0.0), share), max(min(high, 1.0), share)  # rounding


def interval(values: Sequence[float] | np.ndarray, share: bool = False, field: str = "values") -> Interval | None:
    """Return the 95 % interval of the mean of one number per seed; None for one seed, of which nothing is known.

    A share has Wilson's with the seeds as trials: a seed's episodes come from one policy and are no independent
    trials, so this may be too wide but is not too narrow. Other means have Student's t interval below ten seeds and a
    percentile bootstrap from ten up: that of three seeds would reach from the lowest to the highest, which covers a
    normal mean 75 times in 100.

    Examples:
        >>> [round(x, 3) for x in interval([1.0, 2.0, 3.0])]  # 2 -+ 4.303 / sqrt(3)
        [-0.484, 4.484]
        >>> [round(x, 3) for x in interval([1.0, 1.0, 1.0], share=True)], interval([1.0])
        ([0.439, 1.0], None)

    Args:
        values: (n,), finite, n >= 1.
        share: Whether each value is a share of its seed's episodes (or 0 or 1), in [0, 1].
        field: What an error calls them.

    Raises:
        InvalidValueError: no values, one that is not finite, or a share outside [0, 1].
    """
    x = _sample(field, values, least=1)
    if share and not ((x >= 0) & (x <= 1)).all():
        raise _checks.InvalidValueError(field, values, "shares in [0, 1]")
    if x.size == 1:
        return None
    low, high = intervals(x[None], share)[0]
    return float(low), float(high)


def intervals(values: np.ndarray, share: bool = False) -> np.ndarray:
    """Return ``interval`` of many samples of one size at once.

    Examples:
        >>> intervals(np.array([[1.0, 1.0], [0.0, 2.0]])).round(2).tolist()
        [[1.0, 1.0], [-11.71, 13.71]]

    Args:
        values: (m, n), finite, n >= 2: m samples of n seeds.
        share: As in ``interval``.

    Returns:
        (m, 2) lower and upper ends.
    """
    m, n = values.shape
    if share:
        return np.array([wilson(float(np.clip(x, 0, 1)), n) for x in values.mean(1)]).reshape(m, 2)
    if n < FROM_BOOTSTRAP:
        constant = np.ptp(values, axis=1) == 0  # whose rounded mean may differ from its values
        mean = np.where(constant, values[:, 0], values.mean(1))
        half = np.where(constant, 0.0, t_quantile(1 - LEVEL / 2, n - 1) * values.std(1, ddof=1) / math.sqrt(n))
        return np.stack([mean - half, mean + half], 1)
    counts = [_counts(drawn, n) for drawn in _resampled(n)] if RESAMPLES * n <= _AT_ONCE else None
    found = []
    for block in np.array_split(values, -(-len(values) // 1000)):  # whose means are 16 MB
        means = [block @ count / n for count in counts or (_counts(drawn, n) for drawn in _resampled(n))]
        found.append(np.quantile(np.concatenate(means, 1), [0.025, 0.975], axis=1).T)
    return np.concatenate(found)


@lru_cache(maxsize=256)
def t_quantile(p: float, df: float) -> float:
    """Return the quantile of Student's t distribution.

    Examples:
        >>> round(t_quantile(0.975, 2), 3)
        4.303
    """
    from scipy.special import stdtrit

    return float(stdtrit(df, p))


def summarise(values: Sequence[float] | np.ndarray, field: str = "values", share: bool = False) -> Summary:
    """Summarise one number per seed.

    Examples:
        >>> summary = summarise([1.0, 2.0, 3.0, 10.0])
        >>> summary.mean, summary.iqm, round(summary.sd, 2)
        (4.0, 2.5, 4.08)

    Args:
        values: (n,), n >= 1.
        field: What an error calls them.
        share: Whether they are shares, as in ``interval``.

    Raises:
        InvalidValueError: no values, one that is not finite, or a share outside [0, 1].
    """
    x = _sample(field, values, least=1)
    iqm_ci95 = None
    if x.size >= FROM_BOOTSTRAP:
        middles = np.concatenate([interquartile_mean(x[rows]) for rows in _resampled(x.size)])
        low, high = np.quantile(middles, [0.025, 0.975])
        iqm_ci95 = float(low), float(high)
    return Summary(
        float(x.mean()),
        float(x.std(ddof=1)) if x.size > 1 else 0.0,
        interval(x, share, field),
        float(interquartile_mean(x)),
        iqm_ci95,
        tuple(float(v) for v in x),
    )


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


def paired(a: object, b: object) -> Test:
    """Student's t test of the differences a - b of the same seeds (or tasks).

    ``effect`` is their mean in their standard deviations, corrected for small samples as ``hedges_g`` is; of two
    differences it is NaN, and if these are equal they are no evidence.

    Examples:
        >>> test = paired([1.0, 2.0, 3.0], [0.0, 0.0, 0.0])
        >>> round(test.t, 3), test.df, round(test.p, 3)
        (3.464, 2.0, 0.074)

    Args:
        a: (n,) finite numbers, one per seed, n >= 2.
        b: The same seeds' in the same order.

    Raises:
        InvalidValueError: too few numbers, one that is not finite, or not as many of one as of the other.
    """
    mean, sd, n = _differences(a, b)
    df = float(n - 1)
    if sd == 0:
        t = 0.0 if mean == 0 else math.copysign(math.inf, mean)
        return Test(t, df, 1.0 if t == 0 or n == 2 else 0.0, mean, math.nan if n == 2 else t)
    from scipy.special import stdtr

    t = mean / (sd / math.sqrt(n))
    effect = math.nan if n == 2 else mean / sd * (1 - 3 / (4 * df - 1))
    return Test(t, df, float(2 * stdtr(df, -abs(t))), mean, effect)


def _differences(a: object, b: object) -> tuple[float, float, int]:
    """Return mean, sd and number of the differences; an sd that is only rounding is 0."""
    x, y = _sample("a", a), _sample("b", b)
    if x.size != y.size:
        raise _checks.InvalidValueError("b.size", y.size, f"{x.size}, one number for each of a's")
    mean, variance = _mean_and_variance(x - y)
    sd = math.sqrt(variance)
    return mean, 0.0 if sd <= 1e-14 * max(np.abs(x).max(), np.abs(y).max()) else sd, x.size


def paired_sign_flip_p(differences: object) -> float:
    """Two-sided p value of paired differences by flipping their signs; no distribution is assumed, only symmetry.

    All 2^n signs are tried up to 14 differences; for more 20 000 are drawn (seeded), and p is (1 + as extreme) /
    (1 + drawn), which keeps the level [Phipson and Smyth 2010].

    Examples:
        >>> paired_sign_flip_p([1.0, 2.0, 3.0])  # of eight signs two are as extreme
        0.25

    Args:
        differences: (n,) finite numbers, one per seed or task that both share, n >= 1.

    Raises:
        InvalidValueError: no numbers, or one that is not finite.
    """
    x = _sample("differences", differences, least=1)
    found = abs(x.sum()) * (1 - 1e-12)  # sums in another order are equal but for rounding
    if x.size <= _EXACT:
        signs = 1.0 - 2.0 * (np.arange(2**x.size)[:, None] >> np.arange(x.size) & 1)
        return float((np.abs(signs @ x) >= found).mean())
    generator, extreme, rows = np.random.default_rng(20260101), 1, max(1, _AT_ONCE // x.size)
    for first in range(0, _FLIPS, rows):
        signs = generator.choice((-1.0, 1.0), (min(rows, _FLIPS - first), x.size))
        extreme += int((np.abs(signs @ x) >= found).sum())
    return extreme / (1 + _FLIPS)


def detectable_difference(a: object, b: object, shared: bool = False, comparisons: int = 1) -> float:
    """Return the difference of means that a test of these seeds and spreads detects with 80 % power.

    (t(1 - level / 2) + t(power)) standard errors of the difference [Bloom 1995, "Minimum detectable effects",
    Evaluation Review 19(5)], with the degrees of freedom of the test; level is 0.05 over the number of comparisons.

    Examples:
        >>> round(detectable_difference([1.0, 2.0, 3.0], [2.0, 3.0, 4.0]), 3)  # (2.776 + 0.941) sqrt(2 / 3)
        3.035

    Args:
        a: (n,) finite numbers, one per seed, n >= 2.
        b: Alike.
        shared: Whether both have the same seeds in the same order: then of the paired test, else of Welch's.
        comparisons: In the family, >= 1.

    Raises:
        InvalidValueError: too few numbers, or one that is not finite.
    """
    _checks.whole("comparisons", comparisons, low=1)
    if shared:
        _, sd, n = _differences(a, b)
        df, error = float(n - 1), sd / math.sqrt(n)
    else:
        x, y = _sample("a", a), _sample("b", b)
        each = [_mean_and_variance(z)[1] / z.size for z in (x, y)]
        df, error = welch(x, y).df, math.sqrt(sum(each))
    return (t_quantile(1 - LEVEL / comparisons / 2, df) + t_quantile(POWER, df)) * error


@dataclass(frozen=True)
class Family:
    """Comparisons that a table makes together, corrected with Holm's procedure.

    Attributes:
        tests: One for each pair that was given; None for a pair with one seed, which is not compared.
        adjusted: Their p values after correction; 1 where there is no test.
        detectable: The difference each would have detected with 80 % power at the level of the family.
    """

    tests: tuple[Test | None, ...]
    adjusted: tuple[float, ...]
    detectable: tuple[float, ...]

    @property
    def compared(self) -> int:
        """How many comparisons there are."""
        return sum(t is not None for t in self.tests)

    @property
    def found(self) -> tuple[int, ...]:
        """Which pairs differ after correction."""
        return tuple(i for i, p in enumerate(self.adjusted) if p < LEVEL)

    def above(self, i: int) -> bool:
        """Whether the first of pair i is larger, after correction."""
        return self.adjusted[i] < LEVEL and (test := self.tests[i]) is not None and test.difference > 0

    def below(self, i: int) -> bool:
        """Whether the first of pair i is smaller, after correction."""
        return self.adjusted[i] < LEVEL and not self.above(i)

    def caption(self) -> str:
        """Say how many comparisons there are, how many would differ by chance, and how many do.

        Examples:
            >>> compare_all([([1.0, 2.0, 3.1], [2.0, 3.0, 4.0])]).caption()
            '1 comparison: 0.1 would differ by chance at 5 % uncorrected, 1 do uncorrected, 1 after Holm correction.'
        """
        if not self.compared:
            return "Nothing is compared: there is one run of each."
        uncorrected = sum(t is not None and t.p < LEVEL for t in self.tests)
        what = "comparison" if self.compared == 1 else "comparisons"
        text = (
            f"{self.compared} {what}: {LEVEL * self.compared:.1f} would differ by chance at "
            f"5 % uncorrected, {uncorrected} do uncorrected, {len(self.found)} after Holm correction."
        )
        larger = sum(t is not None and t.p < LEVEL and t.difference > 0 for t in self.tests)
        if uncorrected > len(self.found):  # which correction hides: a reader must see in whose favour
            text = f"{text} Of the {uncorrected}, the first of the two is larger in {larger}."
        spread = [d for d in self.detectable if d > 0]
        if self.found or not spread:
            return text
        return (
            f"{text} A true difference of {float(np.median(spread)):.3g} (median of the pairs; {min(spread):.3g} to "
            f"{max(spread):.3g}) would have been found with 80 % power."
        )


def compare_all(pairs: Iterable[tuple[object, object]], shared: bool = True) -> Family:
    """Test each pair of samples, and correct for their number.

    Examples:
        >>> one, other = [1.0, 2.0, 3.1], [0.0, 1.0, 2.0]
        >>> family = compare_all([(one, other), (other, [2.0, 0.0, 1.0]), (one[:1], other[:1])])
        >>> family.compared, family.found, [round(p, 4) for p in family.adjusted]
        (2, (0,), [0.0021, 1.0, 1.0])

    Args:
        pairs: Two samples each, one number per seed; with one seed a pair is not compared.
        shared: Whether both of a pair have the same seeds in the same order wherever they have as many: the test is
            paired then, and Welch's for all others.

    Raises:
        InvalidValueError: a number that is not finite, or no numbers.
    """
    known = [(_sample("a", a, 1), _sample("b", b, 1)) for a, b in pairs]
    tested = [i for i, (a, b) in enumerate(known) if min(a.size, b.size) > 1]
    tests: list[Test | None] = [None] * len(known)
    adjusted, detectable = [1.0] * len(known), [0.0] * len(known)
    for i in tested:
        a, b = known[i]
        together = shared and a.size == b.size
        tests[i] = (paired if together else welch)(a, b)
        detectable[i] = detectable_difference(a, b, together, len(tested))
    for i, p in zip(tested, holm([t.p for t in tests if t is not None]), strict=True):
        adjusted[i] = p
    return Family(tuple(tests), tuple(adjusted), tuple(detectable))


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
