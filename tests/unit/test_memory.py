"""What a stream keeps: a table of state-actions that come again, a uniform sample of steps that do not."""

import math

import jax
import numpy as np
import pytest

from uard.method.feedback import Feedback
from uard.ratings.aggregate import aggregate, by_item, empty_rows, from_rows, merged, nothing, to_rows
from uard.ratings.memory import FeedbackTable, RatingSample

NAN = math.nan


def visits_to(slots: np.ndarray, raters: int = 3, seed: int = 0, rated: float = 0.8) -> Feedback:
    """Visits (B,) of which some, and some raters, have no rating."""
    rng = np.random.default_rng(seed)
    ratings = np.where(rng.random((len(slots), raters)) < rated, rng.normal(size=(len(slots), raters)), NAN)
    return aggregate(ratings, rng.normal(size=len(slots)))


def equal(one: Feedback, other: Feedback) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


def one_by_one(slots: np.ndarray, visits: Feedback, size: int) -> Feedback:
    """What is known after merging the visits one after the other, without a table."""
    rows, new = empty_rows((size,), visits.by_rater.count.shape[1]), to_rows(visits)
    for slot, row, rated in zip(slots, new, visits.count, strict=True):
        rows[slot] = merged(rows[slot], row, rated)
    return from_rows(rows)


# --- the table ------------------------------------------------------------------------------------------------------


def test_the_same_state_action_twice_in_one_batch_by_hand():
    table = FeedbackTable()
    table.observe(np.array([1, 0, 1]), aggregate(np.array([[1.0, 3.0], [9.0, 9.0], [5.0, 7.0]]), np.arange(3.0)), 2)
    known = table[np.array([1])]
    assert (known.count, known.mean, known.lowest, known.sd, known.proxy) == (2, 4, 3, 1, 1)
    assert [x.tolist() for x in known.by_rater] == [[[2, 2]], [[3, 5]], [[8, 8]]]


@pytest.mark.parametrize("batch", [1, 7, 200])
def test_batches_are_as_good_as_one_after_the_other(batch):
    slots = np.random.default_rng(1).integers(0, 6, 200)
    slots[20:40] = 2  # the same one many times in a row
    visits, table = visits_to(slots), FeedbackTable()
    for i in range(0, 200, batch):
        now = slice(i, i + batch)
        table.observe(slots[now], visits.map(lambda x, now=now: x[now]), 6)
    equal(table.every(), one_by_one(slots, visits, 6))
    known = by_item(visits, slots)
    for got, want in zip(jax.tree.leaves(table.every()), jax.tree.leaves(known), strict=True):
        np.testing.assert_allclose(got, want, atol=1e-12)


def test_rows_grow_and_keep_what_they_held():
    table, first = FeedbackTable(), visits_to(np.arange(3))
    table.observe(np.arange(3), first, 3)
    table.observe(np.array([999]), visits_to(np.zeros(1), seed=1, rated=1.0), 1000)
    equal(table[np.arange(3)], first)
    every = table.every()
    assert every.count.shape == (1000,)
    equal(every.map(lambda x: x[3:999]), nothing((996,), 3))


def test_raters_grow_and_those_who_come_later_have_rated_nothing_before():
    table, two = FeedbackTable(), aggregate(np.array([[1.0, 3.0]]), np.array([2.0]))
    table.observe(np.array([0]), two, 1)
    table.observe(np.array([1]), aggregate(np.full((1, 1000), 5.0), np.array([2.0])), 2)
    table.observe(np.array([2]), aggregate(np.array([[4.0]]), np.array([2.0])), 3)
    known = table.every()
    assert known.raters.tolist() == [2, 1000, 1]
    assert known.by_rater.count.sum(1).tolist() == [2, 1000, 1]
    equal(Feedback(*known.map(lambda x: x[:1])[:6]), Feedback(*two[:6]))
    table.observe(np.array([0]), aggregate(np.array([[NAN, NAN, 8.0]]), np.array([2.0])), 3)
    again = table[np.array([0])]
    assert again.by_rater.count[0, :4].tolist() == [1, 1, 1, 0]
    assert again.by_rater.mean[0, :4].tolist() == [1, 3, 8, 0]
    assert (again.count, again.raters, again.mean) == (2, 3, 5)


def test_a_visit_without_ratings_makes_room_and_changes_nothing():
    table = FeedbackTable()
    table.observe(np.array([0, 4]), aggregate(np.full((2, 2), NAN), np.array([1e9, -1e9])), 5)
    equal(table.every(), nothing((5,), 2))


def test_a_table_of_nothing():
    assert FeedbackTable().every().count.shape == (0,)
    table = FeedbackTable()
    table.observe(np.zeros(0, int), aggregate(np.zeros((0, 2)), np.zeros(0)), 0)
    assert table.every().count.shape == (0,)


def test_what_was_looked_up_does_not_change_later():
    table = FeedbackTable()
    table.observe(np.array([0]), aggregate(np.array([[1.0]]), np.array([1.0])), 1)
    before = table[np.array([0])]
    table.observe(np.array([0]), aggregate(np.array([[9.0]]), np.array([1.0])), 1)
    assert (before.mean, before.count) == (1, 1)


# --- the sample -----------------------------------------------------------------------------------------------------


def kept(sample: RatingSample) -> list[float]:
    """The observed rewards of the steps that were kept."""
    return sample.feedback().proxy.tolist()


def test_all_are_kept_in_order_while_there_is_room():
    sample = RatingSample(100, seed=0)
    for i in range(0, 90, 30):
        sample.put(aggregate(np.ones((30, 2)), np.arange(i, i + 30.0)))
    assert kept(sample) == list(range(90))


@pytest.mark.parametrize(
    ("capacity", "batches"),
    [(5, [20]), (5, [3, 17]), (5, [2, 1, 4, 13]), (5, [1] * 20), (1, [1, 1]), (2, [3, 1])],
    ids=str,
)
def test_every_step_is_as_likely_to_be_kept(capacity, batches):
    ends, seeds = np.cumsum(batches), 1000
    steps, counts = sum(batches), np.zeros(sum(batches))
    for seed in range(seeds):
        sample = RatingSample(capacity, seed)
        for start, end in zip(ends - batches, ends, strict=True):
            sample.put(aggregate(np.ones((end - start, 1)), np.arange(start, end, dtype=float)))
        places = np.array(kept(sample), int)
        assert len(set(places)) == capacity
        counts[places] += 1
    share = capacity / steps
    assert np.abs(counts - seeds * share).max() < 4.5 * math.sqrt(seeds * share * (1 - share))


def test_ratings_stay_with_their_step():
    sample, rng = RatingSample(7, seed=1), np.random.default_rng(0)
    for i in range(40):
        proxy = np.arange(5 * i, 5 * i + 5.0)
        sample.put(aggregate(proxy[:, None] + [0.0, 100.0, rng.normal()], proxy))
    feedback = sample.feedback()
    assert feedback.proxy.shape == (7,)
    np.testing.assert_array_equal(feedback.by_rater.mean[:, 0], feedback.proxy)
    np.testing.assert_array_equal(feedback.by_rater.mean[:, 1], feedback.proxy + 100)


def test_a_wider_panel_changes_no_other_row():
    sample = RatingSample(3, seed=0)
    sample.put(aggregate(np.array([[1.0], [2.0]]), np.array([0.0, 1.0])))
    before = sample.feedback()
    sample.put(aggregate(np.full((1, 1000), 7.0), np.array([2.0])))
    after = sample.feedback()
    assert after.raters.tolist() == [1, 1, 1000]
    equal(Feedback(*after.map(lambda x: x[:2])[:6]), Feedback(*before[:6]))


def test_a_narrow_row_in_the_place_of_a_wide_one_has_no_rating_of_the_others():
    sample = RatingSample(2, seed=0)
    sample.put(aggregate(np.full((2, 4), 7.0), np.zeros(2)))
    sample.put(aggregate(np.full((200, 1), 1.0), np.arange(1.0, 201.0)))
    feedback = sample.feedback()
    assert feedback.proxy.min() > 0, "both places were taken"
    assert feedback.raters.tolist() == [1, 1]
    assert feedback.mean.tolist() == [1, 1]


def test_a_sample_of_nothing():
    assert RatingSample(4, seed=0).feedback().count.shape == (0,)
