"""A step is judged by its own ratings: other rows, wider panels and the order of raters make no difference to it."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uard.method.feedback import Feedback
from uard.method.mitigations import NAMED, Evidence, Mitigation, named
from uard.ratings.aggregate import aggregate, by_item
from uard.ratings.memory import FeedbackTable
from uard.ratings.stream import RewardStream

from . import strategies as some

OLD = named("uard-0.1")  # whose sigma_h is the deviation of the ratings


NAN = math.nan
WIDE = 1000


class Rated(NamedTuple):
    """Steps as they come: what was observed (B,), who rated how (B, K; NaN where nobody did), of which key (B,)."""

    reward: np.ndarray
    ratings: np.ndarray
    key: np.ndarray


@st.composite
def rated(draw: st.DrawFn) -> Rated:
    """A few steps in units of an eighth, some ratings missing, some keys met several times."""
    rows, raters = draw(st.integers(1, 8)), draw(st.integers(1, 5))
    eighth = st.integers(-80, 80).map(lambda i: i / 8)
    reward = draw(st.lists(eighth, min_size=rows, max_size=rows))
    cells = draw(st.lists(eighth | st.just(NAN), min_size=rows * raters, max_size=rows * raters))
    key = draw(st.lists(st.integers(0, 3), min_size=rows, max_size=rows))
    return Rated(np.array(reward), np.array(cells).reshape(rows, raters), np.array(key))


def same(one: Feedback, other: Feedback) -> None:
    """Check that all is the same but for rounding, in sums over a padded row."""
    for got, want in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-12, atol=1e-12)


def of_panel(feedback: Feedback) -> Feedback:
    return feedback._replace(by_rater=None)


def table_of(steps: Rated) -> FeedbackTable:
    table = FeedbackTable()
    table.observe(steps.key, aggregate(steps.ratings, steps.reward), 4)
    return table


def wider(ratings: np.ndarray, raters: int = WIDE) -> np.ndarray:
    """Append raters who never answer."""
    return np.pad(ratings, ((0, 0), (0, raters - ratings.shape[1])), constant_values=NAN)


# --- rows do not influence each other -------------------------------------------------------------------------------


@given(rated())
def test_feedback_of_a_row_is_that_of_the_row_alone(steps):
    together = aggregate(steps.ratings, steps.reward)
    for i in range(len(steps.reward)):
        alone = aggregate(steps.ratings[i : i + 1], steps.reward[i : i + 1])
        same(together.map(lambda x, i=i: x[i : i + 1]), alone)


@given(rated())
def test_a_row_of_a_thousand_raters_changes_no_other_row(steps):
    before = aggregate(steps.ratings, steps.reward)
    crowd = np.full((1, WIDE), 2.0)
    after = aggregate(np.concatenate([wider(steps.ratings), crowd]), np.append(steps.reward, 9.0))
    same(of_panel(after.map(lambda x: x[:-1])), of_panel(before))
    assert after.raters[-1] == WIDE
    table, width = table_of(steps), steps.ratings.shape[1]
    known = table[np.arange(4)]
    table.observe(np.array([4]), aggregate(crowd, np.array([9.0])), 5)
    later = table[np.arange(4)]
    jax.tree.map(np.testing.assert_array_equal, of_panel(later), of_panel(known))
    for new, old in zip(later.by_rater, known.by_rater, strict=True):
        np.testing.assert_array_equal(new[:, :width], old)
        assert not new[:, width:].any()


@given(rated(), st.sampled_from(sorted(NAMED)) | some.mitigations(), rated(), st.floats(0.0, 10.0), st.randoms())
def test_what_is_learned_of_a_row_depends_on_it_and_on_the_statistics_only(steps, mitigation, others, sigma_m, chance):
    mitigation: Mitigation = named(mitigation) if isinstance(mitigation, str) else mitigation
    every = by_item(aggregate(others.ratings, others.reward), others.key)
    statistics = mitigation.fit(every, every.count > 0)
    feedback, doubt = aggregate(steps.ratings, steps.reward), np.full(len(steps.reward), sigma_m)

    def explained(rows: list[int]) -> list[np.ndarray]:
        evidence = Evidence(steps.reward[rows], doubt[rows], feedback.map(lambda x: x[rows]))
        return [x + np.zeros(len(rows)) for x in jax.tree.leaves(mitigation.explain(evidence, statistics))]

    order = list(range(len(steps.reward)))
    together = explained(order)
    shuffled = chance.sample(order, len(order))
    for all_rows, moved in zip(together, explained(shuffled), strict=True):
        np.testing.assert_array_equal(all_rows[shuffled], moved)
    for i in order:
        np.testing.assert_array_equal([x[i] for x in together], [x[0] for x in explained([i])])


@given(rated(), rated(), st.booleans())
def test_sigma_h_of_a_streams_row_is_its_own(steps, others, keyed):
    """Whatever was filtered before it, wide panels included; its weight depends on them by the statistics only."""
    fresh, used = RewardStream(OLD), RewardStream(OLD)
    keys = [f"other {k}" for k in others.key] if keyed else None
    used(others.reward, wider(others.ratings), keys=keys)
    used([9.0], np.full((1, WIDE), 2.0), keys=["crowd"] if keyed else None)
    mine = steps.key.tolist() if keyed else None
    one, other = (stream(steps.reward, steps.ratings, keys=mine) for stream in (fresh, used))
    np.testing.assert_allclose(one.sigma_h, other.sigma_h, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(one.rated, other.rated)


@given(rated(), st.randoms())
def test_other_keys_in_between_change_nothing_of_a_key(steps, chance):
    own = {k: iter(np.flatnonzero(steps.key == k)) for k in range(4)}
    order = [
        next(own[k]) for k in chance.sample(steps.key.tolist(), len(steps.key))
    ]  # a key's own visits stay in order
    known, moved = table_of(steps), table_of(Rated(*(x[order] for x in steps)))
    jax.tree.map(np.testing.assert_array_equal, known[np.arange(4)], moved[np.arange(4)])
    for k in range(4):
        mine = table_of(Rated(*(x[steps.key == k] for x in steps)))
        jax.tree.map(np.testing.assert_array_equal, known[np.array([k])], mine[np.array([k])])


# --- raters ---------------------------------------------------------------------------------------------------------


@given(rated(), st.randoms())
def test_the_order_of_raters_is_irrelevant_to_what_they_say_together(steps, chance):
    order = chance.sample(range(steps.ratings.shape[1]), steps.ratings.shape[1])
    moved = steps._replace(ratings=steps.ratings[:, order])
    for one, other in (
        (aggregate(steps.ratings, steps.reward), aggregate(moved.ratings, moved.reward)),
        (table_of(steps)[np.arange(4)], table_of(moved)[np.arange(4)]),
    ):
        same(of_panel(one), of_panel(other))
        for mine, theirs in zip(one.by_rater, other.by_rater, strict=True):
            np.testing.assert_array_equal(mine[:, order], theirs)


@given(rated(), st.data())
def test_a_rater_who_never_answers_changes_nothing(steps, data):
    place = data.draw(st.integers(0, steps.ratings.shape[1]))
    more = steps._replace(ratings=np.insert(steps.ratings, place, NAN, axis=1))
    for with_it, without in (
        (aggregate(more.ratings, more.reward), aggregate(steps.ratings, steps.reward)),
        (table_of(more)[np.arange(4)], table_of(steps)[np.arange(4)]),
    ):
        same(of_panel(with_it), of_panel(without))
        for mine, theirs in zip(with_it.by_rater, without.by_rater, strict=True):
            assert not mine[:, place].any()
            np.testing.assert_array_equal(np.delete(mine, place, axis=1), theirs)
    for keys in (None, steps.key.tolist()):
        one, other = (RewardStream(OLD)(s.reward, s.ratings, keys=keys) for s in (more, steps))
        for got, want in zip(one, other, strict=True):
            np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-9)


@given(rated(), st.sets(st.integers(1, 7)))
def test_in_chunks_or_one_by_one_the_same_is_known(steps, cuts):
    rows = len(steps.reward)
    edges = sorted({0, rows, *(c for c in cuts if c < rows)})
    chunked, streamed = FeedbackTable(), RewardStream(named("mean-of-annotations"))
    slots = streamed.observe(steps.reward, steps.ratings, steps.key.tolist()).slots
    again = RewardStream(named("mean-of-annotations"))
    for a, b in pairwise(edges):
        part = Rated(*(x[a:b] for x in steps))
        chunked.observe(part.key, aggregate(part.ratings, part.reward), 4)
        again.observe(part.reward, part.ratings, part.key.tolist())
    single = FeedbackTable()
    for i in range(rows):
        single.observe(steps.key[i : i + 1], aggregate(steps.ratings[i : i + 1], steps.reward[i : i + 1]), 4)
    jax.tree.map(np.testing.assert_array_equal, streamed.known(slots), again.known(slots))
    same(chunked.every(), single.every())
    visits = aggregate(steps.ratings, steps.reward)
    counted = steps.key.max() + 1
    same(chunked.every().map(lambda x: x[:counted]), by_item(visits, steps.key))


# --- the fault behind it: rows were judged by the largest number of raters ever seen --------------------------------


@pytest.mark.parametrize("raters", [0, 3, 9, 30, WIDE])
@pytest.mark.parametrize("keyed", [True, False])
def test_three_who_say_0_of_a_4_disagree_by_the_root_of_3_whoever_rated_before(raters, keyed):
    stream = RewardStream(OLD)
    if raters:
        stream([1.0], np.ones((1, raters)), keys=["first"] if keyed else None)
    out = stream([4.0], np.zeros((1, 3)), keys=["second"] if keyed else None)
    assert out.sigma_h == pytest.approx([math.sqrt(3)], abs=1e-12)  # {0, 0, 0, 4}


@pytest.mark.parametrize("raters", [0, 3, 30, WIDE])
def test_one_row_of_a_thousand_raters_makes_no_lie_more_believable(raters):
    """After 200 honest steps; the weight was 0.00047, and 18 times as much after one row of 1000 raters."""
    stream = RewardStream(OLD)
    for _ in range(200):
        stream([-0.1], np.full((1, 3), -0.1))
    if raters:
        stream([-0.1], np.full((1, raters), -0.1))
    out = stream([4.0], [[-1.0, 0.0, -1.0]])
    sigma_h = math.sqrt(4.25)  # of {-1, 0, -1, 4}
    # The honest steps have no disagreement and one reward: location 0, unit 1, deviation at its floor of 0.01.
    lam = 0.2 * (1 + 50 * (sigma_h / 0.01 - 1))
    weight = 1 / (1 + lam * 0.5 * sigma_h)
    assert weight == pytest.approx(0.00047261, abs=1e-8)
    assert out.sigma_h == pytest.approx([sigma_h], rel=1e-12)
    assert out.weight == pytest.approx([weight], rel=1e-9)
    assert out.reward == pytest.approx([-1 + 5 * weight], rel=1e-9)


@pytest.mark.parametrize("panel", [[-1.0], [-1.0, NAN, NAN], [NAN] * 49 + [-1.0]], ids=len)
def test_one_of_several_who_rated_is_one_rater(panel):
    assert RewardStream(OLD)([4.0], [panel]).sigma_h == pytest.approx([2.5], abs=1e-12)


def test_a_row_that_fifty_did_not_rate_leaves_the_next_alone():
    stream = RewardStream(OLD)
    stream([1.0], np.full((1, 50), NAN))
    stream([1.0, 1.0], [[1.0] + [NAN] * 49] * 2)
    assert stream([4.0], [[0.0] * 3]).sigma_h == pytest.approx([math.sqrt(3)], abs=1e-12)
