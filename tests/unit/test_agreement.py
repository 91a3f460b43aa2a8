"""Do raters agree with each other by more than chance?"""

import krippendorff
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uard import InvalidValueError
from uard.ratings.agreement import krippendorff_alpha


@pytest.mark.parametrize(
    ("ratings", "alpha"),
    [
        ([[1, 1], [2, 2], [3, 3]], 1.0),
        ([[0, 1], [1, 0]], -0.5),  # n = 4, S = 1, S_u = 1/2 each: 1 - 3/4 (2 (2 * 1/2)) / 1
        ([[0, 1], [0, 1], [np.nan, 7]], -0.5),  # a row with one rating tells nothing of agreement
        ([[1, 1], [1, 1]], None),
        ([[1, np.nan], [np.nan, 2]], None),
        (np.zeros((5, 0)), None),
    ],
)
def test_krippendorff_alpha_by_hand(ratings, alpha):
    got = krippendorff_alpha(ratings)
    assert got is None if alpha is None else got == pytest.approx(alpha)


@given(st.integers(0, 10_000), st.integers(2, 5), st.integers(2, 12))
@settings(max_examples=50, deadline=None)
def test_krippendorff_alpha_is_that_of_the_package(seed, raters, rows):
    random = np.random.default_rng(seed)
    ratings = random.integers(0, 4, (rows, raters)).astype(float)
    ratings[random.random(ratings.shape) < 0.2] = np.nan
    ours = krippendorff_alpha(ratings)
    if ours is not None:
        assert ours == pytest.approx(krippendorff.alpha(ratings.T, level_of_measurement="interval"))


def test_krippendorff_alpha_refuses_nonsense():
    with pytest.raises(InvalidValueError, match=r"ratings.shape = \(3,\)"):
        krippendorff_alpha([1.0, 2.0, 3.0])
    with pytest.raises(InvalidValueError, match="ratings"):
        krippendorff_alpha([[1.0, np.inf], [1.0, 2.0]])
