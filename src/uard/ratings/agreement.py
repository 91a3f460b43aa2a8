"""Do raters agree with each other by more than chance?"""

from __future__ import annotations

import numpy as np

from uard import _checks


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
    x = _checks.as_numpy("ratings", ratings)
    if x.ndim != 2:
        raise _checks.InvalidValueError("ratings.shape", x.shape, "(n, K): a row per thing rated")
    here = ~np.isnan(x)
    x, here = x[here.sum(1) > 1], here[here.sum(1) > 1]
    _checks.finite("ratings", x[here])
    n = int(here.sum())
    if n == 0 or np.ptp(x[here]) == 0:
        return None
    each = here.sum(1)
    within = np.where(here, x, 0.0).sum(1) / each
    squares = (np.where(here, x - within[:, None], 0.0) ** 2).sum(1)
    total = ((x[here] - x[here].mean()) ** 2).sum()
    return float(1.0 - (n - 1) / n * (each * squares / (each - 1)).sum() / total)
