"""Do raters agree with each other by more than chance, and how many of them are independent?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from uard import _checks
from uard.ratings.pairs import ENOUGH, residuals, sample_of_raters, sample_of_rows, shared

if TYPE_CHECKING:
    from jaxtyping import Float

FEWEST_ITEMS = 10  # below, no interval
MOST_RESAMPLED = 500  # items; beyond, the bootstrap's normal limit is as good and cheap
RESAMPLES = 1_000


def krippendorff_alpha(ratings: object) -> float | None:
    """Krippendorff's alpha with the interval metric: do annotators agree by more than chance?

    1 is perfect agreement, 0 what chance would give, below 0 is systematic disagreement; by custom 0.8 is good and
    0.667 the least to draw tentative conclusions from (Krippendorff, Content Analysis, chapter 12). For the interval
    metric both disagreements are sums of squares, so this takes one pass:
    alpha = 1 - (n - 1) / n sum_u m_u S_u / (m_u - 1) / S, with m_u ratings of sum of squares S_u in row u, and n
    ratings of sum of squares S in all rows with at least two.

    Examples:
        >>> krippendorff_alpha([[1.0, 1.0], [2.0, 2.0]]), krippendorff_alpha([[1.0, 2.0], [2.0, 1.0]])
        (1.0, -0.5)

    Args:
        ratings: (n, K), a column per annotator, NaN where a rating is missing; an array or rows of numbers.

    Returns:
        A number <= 1; None where no row has two ratings, or all ratings are equal.

    Raises:
        InvalidValueError: for another shape, or a rating that is infinite or no number.
    """
    parts = _parts(ratings)
    return None if parts is None else float(_alpha(parts.sum(0)))


def alpha_interval(ratings: object, item: object = None, seed: int = 0) -> tuple[float, float] | None:
    """Interval that holds Krippendorff's alpha of further such items with a chance of 95 %.

    Items are drawn anew with replacement (percentile bootstrap, 1000 resamples); beyond 500 items its normal limit is
    taken (infinitesimal jackknife), which differs from it by less than its own error. Rows may be in any order.

    Examples:
        >>> low, high = alpha_interval([[x, x + (-0.1) ** x] for x in range(20)])
        >>> low < krippendorff_alpha([[x, x + (-0.1) ** x] for x in range(20)]) < high
        True

    Args:
        ratings: As in ``krippendorff_alpha``.
        item: What each row rates; rows of one item are drawn together. Every row is another thing if left out.
        seed: Of the draws.

    Returns:
        Both ends; None below ten items with two ratings of a row, and where alpha is not defined.

    Raises:
        InvalidValueError: as in ``krippendorff_alpha``.
    """
    parts = _parts(ratings, item)
    if parts is None or len(parts) < FEWEST_ITEMS:
        return None
    items = len(parts)
    if items <= MOST_RESAMPLED:
        parts = parts[np.lexsort(parts.round(9).T)]  # what differs by rounding alone depends on the order of raters
        drawn = np.random.default_rng(seed).multinomial(items, np.full(items, 1.0 / items), size=RESAMPLES)
        alphas = _alpha(drawn @ parts)
        low, high = np.quantile(alphas[np.isfinite(alphas)], [0.025, 0.975])
        return float(low), float(high)
    total = parts.sum(0)
    (n, within, once, squares), alpha = total, _alpha(total)
    spread = squares - once**2 / n
    slope = -(n - 1) / n * np.array([0.0, 1.0 / spread, 2.0 * once / n * within / spread**2, -within / spread**2])
    slope[0] = -within / n**2 / spread + (n - 1) / n * within / spread**2 * (once / n) ** 2
    influence = parts @ slope
    error = 1.96 * float(np.sqrt(((influence - influence.mean()) ** 2).sum()))
    return float(alpha) - error, float(alpha) + error


def _parts(ratings: object, item: Any = None) -> Float[np.ndarray, "items 4"] | None:
    """Return of every item: ratings n, sum of m_u S_u / (m_u - 1), sum and sum of squares; None without an alpha.

    Ratings are shifted and scaled to [-1, 1], which changes no alpha, so that no square overflows or vanishes.
    """
    x = _checks.as_numpy("ratings", ratings)
    if x.ndim != 2:
        raise _checks.InvalidValueError("ratings.shape", x.shape, "(n, K): a row per thing rated")
    here = ~np.isnan(x)
    several = here.sum(1) > 1
    x, here = x[several], here[several]
    _checks.finite("ratings", x[here])
    if not x.size or x[here].min() == x[here].max():
        return None
    x = np.where(here, x / np.abs(x[here]).max(), 0.0)
    x = np.where(here, x - x[here].mean(), 0.0)
    x = x / np.abs(x).max()
    m = here.sum(1)
    once = x.sum(1)
    within = (np.where(here, x - (once / m)[:, None], 0.0) ** 2).sum(1)
    parts = np.column_stack([m, m * within / (m - 1), once, (x * x).sum(1)])
    if item is None:
        return parts
    items = np.asarray(item)
    _checks.same_shape("item", items, "ratings[:, 0]", several)
    numbers = np.unique(items[several], return_inverse=True)[1]
    return np.column_stack([np.bincount(numbers, column) for column in parts.T])


def _alpha(parts: Float[np.ndarray, "*any 4"]) -> Float[np.ndarray, "*any"]:
    """Return alpha of sums over items; NaN where all ratings are equal."""
    n, within, once, squares = np.moveaxis(np.asarray(parts, float), -1, 0)
    spread = squares - once**2 / n
    some = spread > 1e-14 * squares
    return np.where(some, 1.0 - (n - 1) / n * within / np.where(some, spread, 1.0), np.nan)


@dataclass(frozen=True)
class Independence:
    """How many independent raters the raters of a row are worth.

    Examples:
        >>> Independence("true_reward", raters=3.0, correlation=0.5).effective
        1.5

    Attributes:
        against: What the errors are measured against, the name of a column.
        raters: K, the mean number of ratings of a row that has at least two.
        correlation: rho, the mean correlation of two raters' errors, in [-1, 1].
        effective: K / (1 + (K - 1) rho), rho below 0 counted as 0; in [1, K].
    """

    against: str
    raters: float
    correlation: float

    @property
    def effective(self) -> float:
        """Return the effective number of raters."""
        return self.raters / (1.0 + (self.raters - 1.0) * max(self.correlation, 0.0))


def independence(ratings: object, against: object, name: str = "true_reward") -> Independence | None:
    """How many independent raters are these worth (Kish's effective sample size; Kohli 2026, arXiv 2605.29800)?

    A rater's error is what is left of the ratings after the best straight line on ``against``: bias and scale are no
    errors here. Against the true reward, rho is what it says. Against the observed reward, a truth that raters see and
    the reward does not counts as a shared error, and an error that they share with the reward is not seen at all.
    Without either nothing can be known: what all raters share looks like the truth.

    Examples:
        >>> random = np.random.default_rng(0)
        >>> truth, mistake, own = random.normal(size=500), random.normal(size=500), random.normal(size=(500, 3))
        >>> round(independence(truth[:, None] + own, truth).effective, 1)
        2.9
        >>> round(independence((truth + mistake)[:, None] + own, truth).effective, 1)
        1.5

    Args:
        ratings: (n, K), a column per rater, NaN where one is missing.
        against: (n,) true rewards, or observed ones; NaN where unknown.
        name: What that is called.

    Returns:
        None unless two raters have rated 30 rows together, where ``against`` is known, and both make errors. Beyond
        2000 raters and 2 000 000 ratings a sample at even distances is taken.

    Raises:
        InvalidValueError: for other shapes.
    """
    x, truth = _checks.as_numpy("ratings", ratings), _checks.as_numpy("against", against)
    if x.ndim != 2:
        raise _checks.InvalidValueError("ratings.shape", x.shape, "(n, K): a row per thing rated")
    several = np.isfinite(x).sum(1)
    _checks.same_shape("against", truth, "ratings[:, 0]", several)
    several = several[several > 1]
    columns = sample_of_raters(x.shape[1])
    if not several.size or columns.size < 2:
        return None
    rows = sample_of_rows(len(x), columns.size)
    both = shared(residuals(x[np.ix_(rows, columns)], truth[rows, None]))
    told = (both.rows >= ENOUGH) & (both.sd > 0) & (both.sd.T > 0)
    told &= ~np.eye(len(told), dtype=bool)
    if not told.any():
        return None
    return Independence(name, float(several.mean()), float(both.correlation[told].mean()))
