"""From a column per rater to a log."""

from __future__ import annotations

from typing import Any

import numpy as np

from uard import _checks
from uard.ratings.log import RatingLog
from uard.ratings.readers.columns import Numbers
from uard.ratings.readers.layout import Layout


def wide_log(columns: dict[str, Any], layout: Layout, numbers: Numbers) -> RatingLog:
    """Return a log of columns of cells.

    Args:
        columns: Those that the layout names.
        layout: Of the wide form.
        numbers: Reads the cells.

    Raises:
        InvalidValueError: a cell is no number (the message names row and column), columns of unequal length, or no row.
    """
    rows = len(columns[layout.numbers[0]])
    if not rows:
        raise _checks.InvalidValueError("log", numbers.source, "a log with at least one row")
    found = {name: numbers.of(columns[name], name) for name in layout.numbers}
    numbers.check()
    ratings = np.empty((rows, len(layout.ratings)))
    for k, name in enumerate(layout.ratings):
        ratings[:, k] = numbers.rated(found[name])
    columns_of = {"item": layout.item} if layout.item else {}
    columns_of |= {name: name for name in layout.names} | ({"by": layout.by} if layout.by else {})
    names: dict[str, Any] = {n: np.array([str(x) for x in columns[c]], dtype=object) for n, c in columns_of.items()}
    return RatingLog(
        reward=None if layout.reward is None else found[layout.reward],
        ratings=ratings,
        raters=layout.ratings,
        **{name: found[name] for name in layout.others},
        **names,
        source=numbers.source,
    )
