"""From ratings to ``Feedback``, and what is kept of a state-action that comes again."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from uard import InvalidValueError
from uard.method.feedback import Feedback
from uard.method.uncertainty import with_proxy
from uard.ratings.aggregate import aggregate, by_item, empty_rows, from_rows, merged, nothing, to_rows

NAN = math.nan
THREE = np.array([-1.0, 2.0, 1.0])  # the paper's three ratings of a trap that pays 4
SIGMA_H = math.sqrt(14 / 9)


def close(one: Feedback, other: Feedback, tolerance: float = 1e-12) -> None:
    """Check that all numbers of two feedbacks are the same, those of each rater included."""
    for got, want in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(got, want, rtol=tolerance, atol=tolerance)


def one_by_one(visits: Feedback) -> Feedback:
    """Merge visits (n,) to one state-action, one after the other."""
    rows = to_rows(visits)
    kept = empty_rows((), visits.by_rater.count.shape[-1])
    for row, rated in zip(rows, visits.count, strict=True):
        kept = merged(kept, row, rated)
    return from_rows(kept)


# --- one visit ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("ddof", "sd"), [(0, SIGMA_H), (1, math.sqrt(7 / 3))])
def test_three_ratings_by_hand(ddof, sd):
    feedback = aggregate(THREE, np.array(4.0), ddof=ddof)
    close(Feedback(*feedback[:6]), Feedback(1.0, 2 / 3, -1.0, sd, 4.0, 3.0))
    assert [x.tolist() for x in feedback.by_rater] == [[1, 1, 1], [-1, 2, 1], [0, 0, 0]]


@pytest.mark.parametrize(
    ("ratings", "count", "mean", "lowest", "sd", "raters"),
    [
        ([-1.0, NAN, 1.0], 1, 0.0, -1.0, 1.0, 2),
        ([NAN, 3.0, NAN], 1, 3.0, 3.0, 0.0, 1),
        ([NAN, NAN, NAN], 0, 0.0, 0.0, 0.0, 0),
        ([2.0, 2.0, 2.0], 1, 2.0, 2.0, 0.0, 3),
        ([0.0, NAN, 6.0], 1, 3.0, 0.0, 3.0, 2),
    ],
)
def test_missing_ratings_by_hand(ratings, count, mean, lowest, sd, raters):
    full = [[0.0, 10.0, 20.0], ratings]
    feedback = aggregate(np.array(full), np.array([7.0, 4.0]))
    close(Feedback(*feedback.map(lambda x: x[1])[:6]), Feedback(count, mean, lowest, sd, 4.0, raters))
    here = ~np.isnan(ratings)
    assert feedback.by_rater.count[1].tolist() == here.tolist()
    assert feedback.by_rater.mean[1].tolist() == np.where(here, ratings, 0.0).tolist()
    assert not feedback.by_rater.m2.any()


@pytest.mark.parametrize(
    ("ratings", "ddof", "sd"),
    [([-1.0, NAN, 1.0], 1, math.sqrt(2)), ([3.0, NAN, NAN], 1, 0.0), ([-1.0, NAN, 1.0], 2, 0.0), ([3.0], 1, 0.0)],
)
def test_a_visit_with_no_more_ratings_than_ddof_has_no_deviation(ratings, ddof, sd):
    assert aggregate(np.array(ratings), np.array(0.0), ddof=ddof).sd == pytest.approx(sd)


def test_one_of_three_who_rated_is_one_rater():
    """{-1, 4} deviate by 2.5; if the two who did not answer counted, it would be sqrt(3) / 4 of 5, 2.165."""
    feedback = aggregate(np.array([-1.0, NAN, NAN]), np.array(4.0))
    assert with_proxy(feedback.mean, feedback.sd, feedback.proxy, feedback.raters) == pytest.approx(2.5)
    assert feedback.raters == 1


def test_raters_are_counted_row_by_row():
    ratings = np.array([[1.0, 2.0, 3.0], [NAN, 2.0, NAN], [NAN, NAN, NAN]])
    assert aggregate(ratings, np.zeros(3)).raters.tolist() == [3, 1, 0]
    assert aggregate(np.ones((3, 1000)), np.zeros(3)).raters.tolist() == [1000, 1000, 1000]


def test_a_mask_says_what_nan_says_and_hides_anything():
    rng = np.random.default_rng(0)
    ratings, proxy, mask = rng.normal(size=(40, 4)), rng.normal(size=40), rng.random((40, 4)) < 0.5
    by_nan = aggregate(np.where(mask, ratings, NAN), proxy, ddof=1)
    assert (by_nan.raters == 0).any()
    for hidden in (NAN, math.inf, 1e300):
        by_mask = aggregate(np.where(mask, ratings, hidden), proxy, mask, ddof=1)
        jax.tree.map(np.testing.assert_array_equal, by_mask, by_nan)
    close(aggregate(ratings, proxy, np.ones_like(mask)), aggregate(ratings, proxy))


def test_against_numpy():
    rng = np.random.default_rng(1)
    ratings = np.where(rng.random((5, 8, 6)) < 0.7, rng.normal(size=(5, 8, 6)), NAN)
    ratings[..., 0] = rng.normal(size=(5, 8))  # somebody always answers
    feedback = aggregate(ratings, np.zeros((5, 8)))
    np.testing.assert_allclose(feedback.mean, np.nanmean(ratings, -1), rtol=1e-12)
    np.testing.assert_array_equal(feedback.lowest, np.nanmin(ratings, -1))
    np.testing.assert_allclose(feedback.sd, np.nanstd(ratings, -1), rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(feedback.raters, (~np.isnan(ratings)).sum(-1))


def test_whole_numbers_are_ratings_too():
    stars, mask = np.array([[1, 5, 3], [2, 2, 9]]), np.array([[True, True, True], [True, True, False]])
    for feedback in (aggregate(stars, np.zeros(2), mask), aggregate(*map(torch.tensor, (stars, [0.0, 0.0], mask)))):
        assert feedback.lowest.tolist() == [1.0, 2.0]
        assert feedback.sd.tolist() == pytest.approx([math.sqrt(8 / 3), 0.0])
    assert aggregate(stars, np.zeros(2)).lowest.dtype == np.float64


@pytest.mark.parametrize(
    ("ratings", "proxy", "mask", "message"),
    [
        ([1.0, 2.0], [1.0], None, r"^ratings\.shape = \(2,\): must be \(1, K\): one row per reward and one column per"),
        ([[1.0, 2.0]], [1.0, 2.0], None, r"^ratings\.shape = \(1, 2\): must be \(2, K\)"),
        ([[], []], [1.0, 2.0], None, r"^ratings\.shape = \(2, 0\): must be \(2, K\)"),
        (1.0, 1.0, None, r"^ratings\.shape = \(\): must be \(K\)"),
        ([[1.0, math.inf]], [1.0], None, r"^ratings\[0, 1\] = inf: must be finite"),
        ([[NAN, -math.inf]], [1.0], None, r"^ratings\[0, 1\] = -inf: must be finite"),
        ([[1.0, 2.0], [NAN, 0.0]], [1.0, 1.0], [[1, 1], [1, 1]], r"^ratings\[1, 0\] = nan: must be finite"),
        (
            [[1.0, 2.0], [3.0, 0.0]],
            [1.0, 1.0],
            [1, 0],
            r"^mask\.shape = \(2,\): must be \(2, 2\), the shape of ratings",
        ),
    ],
)
def test_bad_ratings_are_named(ratings, proxy, mask, message):
    mask = None if mask is None else np.array(mask, bool)
    with pytest.raises(InvalidValueError, match=message):
        aggregate(np.array(ratings), np.array(proxy), mask)


def test_under_jit_a_mask_says_what_is_missing():
    """NaN cannot be looked for while a program is traced; the mask can be data."""
    ratings, mask = jnp.array([[-1.0, NAN, NAN], [1.0, 2.0, NAN]]), jnp.array([[1, 0, 0], [1, 1, 0]], bool)
    traced = jax.jit(aggregate)(ratings, jnp.array([4.0, 0.0]), mask)
    close(traced, aggregate(np.asarray(ratings, float), np.array([4.0, 0.0])), 1e-6)


# --- visits to the same state-action --------------------------------------------------------------------------------

TWICE = aggregate(np.array([[-1.0, 2.0, 1.0], [3.0, NAN, 1.0]]), np.array([4.0, 2.0]))


def test_two_visits_by_hand():
    expected = Feedback(2.0, 4 / 3, 0.0, (SIGMA_H + 1.0) / 2, 3.0, 3.0)
    for known in (one_by_one(TWICE), by_item(TWICE, np.array([0, 0])).map(lambda x: x[0])):
        close(Feedback(*known[:6]), expected)
        assert known.by_rater.count.tolist() == [2, 1, 2]
        assert known.by_rater.mean.tolist() == pytest.approx([1.0, 2.0, 1.0])
        assert known.by_rater.m2.tolist() == pytest.approx([8.0, 0.0, 0.0])


def test_a_visit_that_is_not_rated_changes_nothing():
    rows = to_rows(TWICE)
    np.testing.assert_array_equal(merged(rows[0], rows[1], np.array(0.0)), rows[0])
    unrated = to_rows(aggregate(np.full((2, 3), NAN), np.array([1e9, -1e9])))
    np.testing.assert_array_equal(merged(rows, unrated, np.zeros(2)), rows)


def test_a_first_visit_is_what_is_known():
    rows = merged(empty_rows((2,), 3), to_rows(TWICE), TWICE.count)
    jax.tree.map(np.testing.assert_array_equal, from_rows(rows), TWICE)


def random_visits(visits: int, raters: int, seed: int, offset: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    ratings = offset + rng.normal(size=(visits, raters))
    return np.where(rng.random((visits, raters)) < 0.6, ratings, NAN), offset + rng.normal(size=visits)


@pytest.mark.parametrize("offset", [0.0, 1e8])
def test_each_raters_moments_are_those_of_the_whole_list(offset):
    """Welford's way loses nothing to a large offset; the difference of two sums of squares would lose all."""
    ratings, proxy = random_visits(200, 4, 2, offset)
    each = one_by_one(aggregate(ratings, proxy)).by_rater
    np.testing.assert_array_equal(each.count, (~np.isnan(ratings)).sum(0))
    np.testing.assert_allclose(each.mean - offset, np.nanmean(ratings - offset, 0), atol=1e-6 if offset else 1e-12)
    np.testing.assert_allclose(each.m2, each.count * np.nanvar(ratings - offset, 0), rtol=1e-6 if offset else 1e-12)


def test_merged_one_by_one_is_the_mean_over_all_rated_visits():
    ratings, proxy = random_visits(60, 3, 3)
    visits = aggregate(ratings, proxy)
    rated = visits.count > 0
    assert not rated.all()
    known = one_by_one(visits)
    assert known.count == rated.sum()
    assert known.raters == 3
    for name in ("mean", "lowest", "sd", "proxy"):
        assert getattr(known, name) == pytest.approx(getattr(visits, name)[rated].mean(), abs=1e-12)
    close(by_item(visits, np.zeros(60, int)).map(lambda x: x[0]), known, 1e-9)


def test_raters_who_come_one_by_one_are_known_as_if_they_had_come_together():
    alone = np.where(np.eye(3, dtype=bool), THREE, NAN)
    known, together = one_by_one(aggregate(alone, np.full(3, 4.0))), aggregate(THREE, np.array(4.0))
    jax.tree.map(np.testing.assert_array_equal, known.by_rater, together.by_rater)
    assert (known.raters, known.count) == (3, 3)
    assert known.mean == pytest.approx(together.mean)
    assert known.proxy == together.proxy
    assert known.sd == 0, "nobody was there to disagree with"


def test_by_item_is_merging_item_by_item():
    ratings, proxy = random_visits(80, 3, 4)
    item = np.random.default_rng(5).choice([0, 1, 2, 5], 80)
    visits = aggregate(ratings, proxy)
    known = by_item(visits, item)
    assert known.count.shape == (6,)
    for i in range(6):
        close(known.map(lambda x, i=i: x[i]), one_by_one(visits.map(lambda x, i=i: x[item == i])), 1e-9)
    close(known.map(lambda x: x[3:5]), nothing((2,), 3))


def test_by_item_of_nothing():
    empty = by_item(aggregate(np.zeros((0, 2)), np.zeros(0)), np.zeros(0, int))
    assert empty.count.shape == (0,)
    assert empty.by_rater.mean.shape == (0, 2)


def test_rows_are_there_and_back():
    feedback = by_item(aggregate(*random_visits(30, 2, 6)), np.arange(30) // 4)
    rows = to_rows(feedback)
    assert rows.shape == (8, 5 + 3 * 2)
    jax.tree.map(np.testing.assert_array_equal, from_rows(rows), feedback)
    np.testing.assert_array_equal(to_rows(from_rows(rows)), rows)


def test_nothing_is_what_empty_rows_hold():
    feedback = nothing((2, 4), 3)
    jax.tree.map(np.testing.assert_array_equal, feedback, from_rows(empty_rows((2, 4), 3)))
    assert feedback.by_rater.count.shape == (2, 4, 3)
    assert nothing((2,), 3, jnp, jnp.float32).mean.dtype == jnp.float32
    assert isinstance(nothing((2,), 1, torch).by_rater.m2, torch.Tensor)


# --- every array library --------------------------------------------------------------------------------------------

RATINGS, PROXY = np.random.default_rng(7).normal(size=(6, 3)), np.random.default_rng(8).normal(size=6)
MASK = np.array([[1, 1, 1], [1, 0, 1], [0, 1, 0], [0, 0, 0], [1, 1, 0], [0, 0, 1]], bool)


def merged_twice(ratings, proxy, mask):
    rows, rated = to_rows(aggregate(ratings, proxy, mask)), aggregate(ratings, proxy, mask).count
    return from_rows(merged(merged(rows, to_rows(aggregate(proxy[..., None] + ratings, proxy)), rated), rows, rated))


CASES = {
    "complete": lambda r, p, m: aggregate(r, p),
    "complete-ddof": lambda r, p, m: aggregate(r, p, ddof=1),
    "one rater": lambda r, p, m: aggregate(r[:, :1], p),
    "masked": aggregate,
    "masked-ddof": lambda r, p, m: aggregate(r, p, m, ddof=1),
    "merged": merged_twice,
}


@pytest.mark.parametrize("case", CASES)
def test_every_array_library_gives_the_same(backend, case):
    backend.agrees(CASES[case], RATINGS, PROXY, MASK)


def test_nan_is_a_missing_rating_in_every_array_library(backend):
    if not backend.jit:
        backend.agrees(aggregate, np.where(MASK, RATINGS, NAN), PROXY)


@pytest.mark.parametrize("mask", [np.array([[2, 0]]), np.array([[0.5, np.nan]])])
def test_a_mask_that_is_not_of_truth_values_is_refused(mask):
    with pytest.raises(InvalidValueError, match=r"mask\.dtype = .*truth values"):
        aggregate(np.array([[5.0, 1.0]]), np.array([0.0]), mask)


@pytest.mark.parametrize("name", ["ratings", "proxy", "mask"])
def test_what_is_no_array_is_refused_by_name(name):
    given = {"ratings": np.zeros((1, 2)), "proxy": np.zeros(1), "mask": np.ones((1, 2), bool)}
    with pytest.raises(InvalidValueError, match=rf"^{name} = .*an array"):
        aggregate(**(given | {name: [[1.0]]}))


@pytest.mark.parametrize(
    ("ratings", "message"),
    [
        (np.array([["1", "2"]]), r"^ratings\.dtype = dtype\('<U1'\): must be real numbers in a plain array"),
        (np.array([[1j, 2.0]]), r"^ratings\.dtype = dtype\('complex128'\)"),
        (torch.tensor([[1j, 2.0]]), r"^ratings\.dtype = torch\.complex64"),
        (np.array([[1.0, None]]), r"^ratings\.dtype = dtype\('O'\)"),
        (np.ma.array([[1.0, 2.0]], mask=[[False, True]]), r"^ratings\.dtype = 'a masked array'"),
        (
            np.array([[1e308, -1e308]]),
            r"^ratings\[0, 0\] = 1e\+308: must be in \[-1e\+100, 1e\+100\], or its",
        ),
        (torch.tensor([[1.0, 1e20]]), r"^ratings\[0, 1\] = 1.*e\+20: must be in \[-1e\+15, 1e\+15\]"),
    ],
    ids=str,
)
def test_ratings_that_are_no_numbers_or_too_large_ones_are_named(ratings, message):
    xp = torch if isinstance(ratings, torch.Tensor) else np
    with pytest.raises(InvalidValueError, match=message):
        aggregate(ratings, xp.zeros(1))


@pytest.mark.parametrize("proxy", [math.nan, math.inf, 1e200, "4"])
def test_a_proxy_that_is_no_number_is_named(proxy):
    with pytest.raises(InvalidValueError, match=r"^proxy(\.dtype|\[0\]) = "):
        aggregate(np.zeros((1, 2)), np.array([proxy]))


@pytest.mark.parametrize("ddof", [-1, math.nan, 0.5, True, None])
def test_ddof_is_a_whole_number(ddof):
    with pytest.raises(InvalidValueError, match=r"^ddof = .*: must be a whole number >= 0"):
        aggregate(np.zeros((1, 2)), np.zeros(1), ddof=ddof)


def test_half_precision_is_counted_in_single():
    """300 squared is no float16."""
    for ratings in (np.float16([[-300, 300]]), torch.tensor([[-300.0, 300.0]], dtype=torch.float16)):
        assert aggregate(ratings, ratings[:, 0]).sd.tolist() == [300.0]


def test_ratings_with_a_gradient_keep_it():
    ratings = torch.tensor([[-1.0, 2.0, 1.0]], requires_grad=True)
    aggregate(ratings, torch.zeros(1)).mean.sum().backward()
    assert ratings.grad.tolist() == [pytest.approx([1 / 3] * 3)]


def test_thumbs_are_ratings_too():
    feedback = aggregate(np.array([[True, False]]), np.array([1], np.int8))
    assert (feedback.mean, feedback.lowest, feedback.proxy) == (0.5, 0.0, 1.0)


@pytest.mark.parametrize("raters", [2, 3, 7, 40])
def test_a_row_is_the_same_whether_another_lacks_a_rating_or_stands_otherwise_in_memory(raters):
    draw = np.random.default_rng(raters)
    ratings, proxy = draw.normal(size=(50, raters)), draw.normal(size=50)
    some = ratings.copy()
    some[::4, 0] = np.nan
    for given in (some, np.asfortranarray(ratings), ratings[:, ::-1][:, ::-1]):
        whole = aggregate(given, proxy)
        for i in range(1, 50, 4):
            alone = aggregate(ratings[[i]], proxy[[i]])
            assert (whole.mean[i], whole.sd[i], whole.lowest[i]) == (alone.mean[0], alone.sd[0], alone.lowest[0])
