"""Which rater a finding about missing ratings names."""

from __future__ import annotations

import numpy as np

from uard import doctor
from uard.ratings.readers import from_columns


def _evidence(holes: dict[int, int]) -> str:
    """Return what is said where rater k has not rated its own ``holes[k]`` of 40 rows."""
    truth = np.random.default_rng(0).normal(size=40)
    ratings = {f"rating_{k}": truth.copy() for k in range(3)}
    start = 0
    for k, count in holes.items():
        ratings[f"rating_{k}"][start : start + count] = np.nan
        start += count
    found = {f.code: f for f in doctor(from_columns({"reward": truth, **ratings})).findings}
    return found["missing-ratings"].evidence


def test_no_rater_is_named_where_all_miss_alike() -> None:
    assert "no rater stands out" in _evidence({0: 10, 1: 11, 2: 10})


def test_the_rater_who_misses_most_is_named() -> None:
    assert "most of rating_1 (50 %)" in _evidence({0: 2, 1: 20, 2: 2})
