"""Agreement within parts of a log."""

from __future__ import annotations

import numpy as np

from uard import _checks
from uard.diagnosis.case import Case
from uard.diagnosis.finding import Stratum
from uard.ratings.agreement import alpha_interval, krippendorff_alpha

MOST = 50  # parts that anybody would read


def strata_of(case: Case) -> tuple[Stratum, ...]:
    """Return how far raters agree within each part of a log, by the name of the part; nothing if it has no parts.

    Raises:
        InvalidValueError: there are more than 50 parts.
    """
    if case.log.by is None:
        return ()
    names, part = np.unique(case.log.by[case.rows], return_inverse=True)
    if names.size > MOST:
        raise _checks.InvalidValueError("by", f"a column of {names.size} different values", f"one of at most {MOST}")
    item = None if case.log.item is None else case.log.item[case.rows]
    several = np.isfinite(case.ratings).sum(1) > 1
    strata: list[Stratum] = []
    for number, name in enumerate(names):
        rows = np.flatnonzero((part == number) & several)
        ratings = case.ratings[rows]
        low, high = alpha_interval(ratings, None if item is None else item[rows]) or (None, None)
        within = between = 0.0
        if rows.size:
            mean, count = np.nanmean(ratings, 1), np.isfinite(ratings).sum(1)
            within = float(np.sqrt((np.nansum((ratings - mean[:, None]) ** 2, 1) / (count - 1)).mean()))
            between = float(mean.std())
        strata.append(Stratum(str(name), int(rows.size), krippendorff_alpha(ratings), low, high, within, between))
    return tuple(strata)
