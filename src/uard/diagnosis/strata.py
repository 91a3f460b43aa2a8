"""Agreement within parts of a log."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uard import _checks
from uard.diagnosis.finding import Stratum
from uard.ratings.agreement import alpha_interval, krippendorff_alpha

if TYPE_CHECKING:
    from jaxtyping import Float, Shaped

MOST = 50  # parts that anybody would read


def strata_of(
    by: Shaped[np.ndarray, " n"] | None, ratings: Float[np.ndarray, "n K"], item: Shaped[np.ndarray, " n"] | None = None
) -> tuple[Stratum, ...]:
    """Return how far raters agree within each part of a log, by the name of the part; nothing if it has no parts.

    Examples:
        >>> [(s.name, s.agreement) for s in strata_of(np.array(["a", "a"]), np.array([[1.0, 1.0], [2.0, 2.0]]))]
        [('a', 1.0)]

    Args:
        by: Name of the part that each row belongs to.
        ratings: NaN where one is missing.
        item: What each row rates; every row is another thing if left out.

    Raises:
        InvalidValueError: there are more than 50 parts.
    """
    if by is None:
        return ()
    names, part = np.unique(by, return_inverse=True)
    if names.size > MOST:
        raise _checks.InvalidValueError("by", f"a column of {names.size} different values", f"one of at most {MOST}")
    several = np.isfinite(ratings).sum(1) > 1
    strata: list[Stratum] = []
    for number, name in enumerate(names):
        rows = np.flatnonzero((part == number) & several)
        here = ratings[rows]
        low, high = alpha_interval(here, None if item is None else item[rows]) or (None, None)
        within = between = 0.0
        if rows.size:
            mean, count = np.nanmean(here, 1), np.isfinite(here).sum(1)
            within = float(np.sqrt((np.nansum((here - mean[:, None]) ** 2, 1) / (count - 1)).mean()))
            between = float(mean.std())
        strata.append(Stratum(str(name), int(rows.size), krippendorff_alpha(here), low, high, within, between))
    return tuple(strata)
