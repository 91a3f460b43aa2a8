"""Do raters agree with each other by more than chance?"""

import krippendorff
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uard import InvalidValueError
from uard.ratings import agreement
from uard.ratings.agreement import Independence, alpha_interval, independence, krippendorff_alpha
from uard.ratings.pairs import residuals, shared


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


@pytest.mark.parametrize("size", [5e-324, 1e-310, 1e-200, 1e200, 1.7e308])
def test_krippendorff_alpha_does_not_depend_on_the_unit(size):
    ratings = np.array([[0.0, 1.0], [1.0, 1.0], [0.0, 0.0]])
    assert krippendorff_alpha(size * ratings) == pytest.approx(krippendorff_alpha(ratings))


def noisy(random, items, sd=0.5):
    return random.normal(size=(items, 1)) + random.normal(0.0, sd, (items, 3))


def test_the_interval_of_alpha_holds_it_as_often_as_it_says():
    # Alpha of the population is 1 / (1 + 0.25) = 0.8. Of 200 logs 91 to 97 % are what 95 % may come
    # to, and the percentile bootstrap of 60 items covers a little less.
    covered = 0
    for seed in range(200):
        low, high = alpha_interval(noisy(np.random.default_rng(seed), 60))
        covered += low < 0.8 < high
    assert 0.88 <= covered / 200 <= 0.98


def test_the_normal_limit_is_that_of_the_bootstrap(monkeypatch):
    ratings = noisy(np.random.default_rng(0), 500)
    ratings[::7, 2] = np.nan
    drawn = alpha_interval(ratings)
    monkeypatch.setattr(agreement, "MOST_RESAMPLED", 10)
    assert alpha_interval(ratings) == pytest.approx(drawn, abs=0.005)


def test_items_are_drawn_together():
    random = np.random.default_rng(0)
    once = noisy(random, 30)
    rows, item = np.repeat(once, 10, axis=0), np.repeat(np.arange(30), 10)
    alone, together = alpha_interval(rows), alpha_interval(rows, item)
    assert together == pytest.approx(alpha_interval(once), abs=0.05)
    assert together[1] - together[0] > 2.0 * (alone[1] - alone[0])  # ten copies are no more information: sqrt(10)


def test_the_interval_needs_ten_items_and_no_order():
    ratings = noisy(np.random.default_rng(0), 40)
    assert alpha_interval(ratings[:9]) is None
    assert alpha_interval(np.ones((40, 2))) is None
    assert alpha_interval(ratings) == pytest.approx(alpha_interval(ratings[::-1, ::-1]))
    assert alpha_interval(ratings, seed=1) != alpha_interval(ratings)


def test_statistics_of_pairs_are_those_of_numpy():
    random = np.random.default_rng(0)
    ratings = random.normal(size=(50, 3)) * [1.0, 1e90, 1e-90] + [5.0, 0.0, 1e-90]
    ratings[random.random((50, 3)) < 0.3] = np.nan
    both = shared(ratings)
    for i in range(3):
        for j in range(3):
            here = np.isfinite(ratings[:, i]) & np.isfinite(ratings[:, j])
            x, y = ratings[here, i], ratings[here, j]
            assert both.rows[i, j] == here.sum()
            assert both.mean[i, j] == pytest.approx(x.mean())
            assert both.sd[i, j] == pytest.approx(x.std())
            assert both.correlation[i, j] == pytest.approx(np.corrcoef(x / np.abs(x).max(), y / np.abs(y).max())[0, 1])
    assert shared(np.full((9, 2), 0.1)).correlation.tolist() == [[0.0, 0.0], [0.0, 0.0]]  # of a constant there is none


def test_bias_and_scale_are_no_errors():
    truth = np.arange(40.0)
    assert np.abs(residuals(3.0 + 2.0 * truth[:, None], truth[:, None])).max() == 0.0
    assert np.isnan(residuals(np.ones((1, 1)), np.ones((1, 1)))).all()  # a line takes two rows


def test_independence_by_hand():
    assert Independence("true_reward", raters=9.0, correlation=0.4375).effective == 2.0  # 9 / (1 + 8 * 7/16)
    assert Independence("true_reward", raters=3.0, correlation=-0.4).effective == 3.0
    random = np.random.default_rng(0)
    truth, ratings = np.zeros(100), random.normal(size=(100, 2))
    found = independence(np.column_stack([ratings, ratings[:, 0]]), truth)
    assert found.correlation == pytest.approx((1.0 + 2.0 * np.corrcoef(ratings.T)[0, 1]) / 3.0)
    assert independence(ratings[:29], truth[:29]) is None
    assert independence(np.tile(truth[:, None], 2), truth) is None  # nobody errs
    assert independence(ratings, np.full(100, np.nan)) is None
    with pytest.raises(InvalidValueError, match="against"):
        independence(ratings, truth[:5])
    with pytest.raises(InvalidValueError, match="item"):
        alpha_interval(ratings, np.arange(5))
