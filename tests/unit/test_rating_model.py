"""What a deep learner knows of its raters: the memory of rated steps, and the model of all others."""

from __future__ import annotations

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from uard._checks import InvalidValueError
from uard.envs.grids.trapgrid import paper_grid
from uard.envs.world import TableWorld
from uard.method.feedback import ByRater, Feedback
from uard.ratings.aggregate import aggregate, from_rows, to_rows
from uard.ratings.panels import PANELS
from uard.training.feedback import rating_model
from uard.training.feedback.rating_model import Memory, Model, RatingModel

SLOTS = 7


def remembered(steps: int, share: float) -> tuple[Memory, list[dict[str, Any]]]:
    """Remember random steps, some of them rated; return the memory and the rated steps."""
    rng = np.random.default_rng(0)
    known = rating_model.memory(SLOTS, {"place": jnp.zeros(2, jnp.int32)}, raters=3)
    remember = jax.jit(rating_model.remember)
    kept = []
    for _ in range(steps):
        slot = int(rng.integers(SLOTS - 1))  # the last one is never met
        ratings = np.float32(rng.normal(size=3))
        rated = float(rng.random() < share)
        state = {"place": jnp.asarray([slot // 2, 5], jnp.int32)}
        known = remember(
            known,
            jnp.int32(slot),
            state,
            jnp.int32(slot % 2),
            aggregate(jnp.asarray(ratings), jnp.float32(ratings[0] + 1)),
            jnp.float32(rated),
        )
        if rated:
            kept.append({"slot": slot, "ratings": ratings, "proxy": ratings[0] + 1})
    return known, kept


def test_memory_keeps_the_means_of_every_slot():
    known, kept = remembered(60, 0.6)
    for slot in range(SLOTS):
        mine = [k for k in kept if k["slot"] == slot]
        feedback = jax.tree.map(np.asarray, from_rows(known.rows[slot]))
        assert feedback.count == len(mine)
        assert feedback.raters == (3 if mine else 0)
        if mine:
            ratings = np.stack([k["ratings"] for k in mine])
            proxy = np.mean([k["proxy"] for k in mine])
            expected = [ratings.mean(), ratings.min(1).mean(), ratings.std(1).mean(), proxy]
            np.testing.assert_allclose(feedback[1:5], expected, rtol=1e-4, atol=1e-5)
            np.testing.assert_array_equal(feedback.by_rater.count, 3 * [len(mine)])
            np.testing.assert_allclose(feedback.by_rater.mean, ratings.mean(0), rtol=1e-4, atol=1e-5)
            np.testing.assert_allclose(feedback.by_rater.m2, len(mine) * ratings.var(0), rtol=1e-4, atol=1e-5)
            assert known.actions[slot] == slot % 2
            np.testing.assert_array_equal(known.states["place"][slot], [slot // 2, 5])
    assert not np.asarray(known.rows[SLOTS - 1]).any()


def test_order_lists_the_rated_slots_once():
    known, kept = remembered(60, 0.6)
    first = list(dict.fromkeys(k["slot"] for k in kept))
    assert int(known.rated) == len(first) == SLOTS - 1
    np.testing.assert_array_equal(known.order[: len(first)], first)


def test_what_is_not_rated_is_not_remembered():
    known, _ = remembered(20, 0.0)
    empty = rating_model.memory(SLOTS, {"place": jnp.zeros(2, jnp.int32)}, raters=3)
    jax.tree.map(np.testing.assert_array_equal, known, empty)


SPEC = RatingModel()
WORLD = paper_grid(10).world(PANELS["main"])  # 100 states, no padding
RATERS, STATES, ACTIONS = WORLD.raters, WORLD.features, WORLD.actions
HALF = np.arange(STATES * ACTIONS) // ACTIONS % 2 == 0  # every second state


def rated_world(slots: np.ndarray) -> Memory:
    """A memory in which the panel has rated some slots five times, without noise."""
    centre = np.asarray(WORLD.law.centre, float).reshape(-1, RATERS)
    proxy = np.asarray(WORLD.task.reward).reshape(-1)
    visit = aggregate(centre, proxy.astype(float))
    five = ByRater(5 * visit.by_rater.count, centre, 0 * centre)
    rows = to_rows(visit._replace(count=5 * visit.count, by_rater=five)) * slots[:, None]
    which = np.flatnonzero(slots)
    order = np.zeros(len(slots), np.int32)
    order[: len(which)] = np.random.default_rng(0).permutation(which)
    every = np.arange(len(slots), dtype=np.int32)
    table = rows.astype(np.float32), every // ACTIONS, every % ACTIONS, order, np.int32(len(which))
    return jax.tree.map(jnp.asarray, Memory(*table))


@cache
def fitted() -> Any:
    def fit(world: TableWorld, known: Memory, chunks: Any) -> tuple[Model, Feedback]:
        def once(i: Any, model: Model) -> Model:
            return rating_model.fit(
                SPEC, model, known, world.observe, ACTIONS, jax.random.fold_in(jax.random.key(1), i)
            )

        model = rating_model.init(SPEC, jax.random.key(0), STATES, ACTIONS, RATERS)
        model = jax.lax.fori_loop(0, chunks, once, model)
        model = rating_model.with_noise(SPEC, model, known, world.observe, ACTIONS)
        return model, rating_model.read(SPEC, model, jnp.eye(STATES), ACTIONS, RATERS)

    return jax.jit(fit)


@cache
def read_after(chunks: int, what: str = "all") -> tuple[Model, Feedback]:
    slots = {"all": np.ones(len(HALF), bool), "half": HALF, "none": np.zeros(len(HALF), bool)}[what]
    return jax.tree.map(np.asarray, fitted()(WORLD, rated_world(slots), chunks))


def error(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean((np.asarray(a) - np.asarray(b)) ** 2)))


def test_predictions_approach_what_the_panel_says():
    centre = np.asarray(WORLD.law.centre)
    truth = centre.mean(-1), centre.min(-1), centre.std(-1), WORLD.task.reward
    _, early = read_after(5)
    _, late = read_after(200)
    for name, expected in zip(("mean", "lowest", "sd", "proxy"), truth, strict=True):
        before, after = error(getattr(early, name), expected), error(getattr(late, name), expected)
        unit = float(np.std(WORLD.task.reward))
        assert after < 0.15 * unit, name
        assert after < 0.5 * before, name
    hack = np.asarray(WORLD.truth.hack)
    assert late.sd[hack].min() > 0.5 > 0.2 > np.quantile(late.sd[~hack], 0.95)
    assert (late.sd >= 0).all()
    np.testing.assert_array_equal(late.raters, np.full((STATES, ACTIONS), RATERS))
    each = late.by_rater
    assert error(each.mean, centre) < 0.15 * float(np.std(WORLD.task.reward))
    assert (each.count > 0).all()


def test_count_is_high_where_there_were_ratings():
    _, feedback = read_after(200, "half")
    count = feedback.count.reshape(-1)
    yes, no = count[HALF], count[~HALF]
    assert (yes[:, None] > no[None, :]).mean() > 0.99
    assert np.median(no) < 0.5 < 5 < np.median(yes)
    assert (count >= 0).all()


def test_gaps_are_added_to_the_reward_that_was_observed():
    _, feedback = read_after(200)
    reward = np.full((STATES, ACTIONS), 7.0)
    seen = rating_model.observing(feedback, reward)
    np.testing.assert_array_equal(seen.proxy, reward)
    gaps = feedback.by_rater.mean - feedback.proxy[..., None]
    np.testing.assert_allclose(seen.by_rater.mean, 7.0 + gaps, atol=1e-5)
    np.testing.assert_allclose(seen.mean - seen.lowest, feedback.mean - feedback.lowest, atol=1e-5)


def test_a_rater_who_never_answered_is_not_heard():
    known = rated_world(np.ones(len(HALF), bool))
    rows = np.array(known.rows)
    rows[:, 5:][:, [0, RATERS, 2 * RATERS]] = 0.0  # of the first: count, mean, squares
    model, feedback = jax.tree.map(np.asarray, fitted()(WORLD, known._replace(rows=jnp.asarray(rows)), 5))
    assert model.noise[0] == -1.0 < 0.0 <= model.noise[1:].min()
    assert not feedback.by_rater.count[..., 0].any()
    assert (feedback.by_rater.count[..., 1:] > 0).all()


def test_before_the_first_rating_nothing_is_fitted():
    fresh, quiet = read_after(0, "none"), read_after(5, "none")
    jax.tree.map(np.testing.assert_array_equal, quiet[0].layers, fresh[0].layers)
    jax.tree.map(np.testing.assert_array_equal, quiet[0].optimiser, fresh[0].optimiser)
    jax.tree.map(np.testing.assert_array_equal, quiet[1], fresh[1])
    assert np.median(fresh[1].count) < 0.3


def test_priors_are_never_fitted():
    fresh, late = read_after(0, "none")[0], read_after(200)[0]
    jax.tree.map(np.testing.assert_array_equal, fresh.prior, late.prior)


@pytest.mark.parametrize("chunks", [0, 5, 200])
@pytest.mark.parametrize("what", ["none", "half", "all"])
def test_nothing_is_ever_nan(what: str, chunks: int):
    for leaf in jax.tree.leaves(read_after(chunks, what)):
        assert np.isfinite(leaf).all()


def test_a_constant_reward_has_a_unit():
    """One rated step: no deviation to measure in."""
    one = np.arange(len(HALF)) == 17
    model, feedback = jax.tree.map(np.asarray, fitted()(WORLD, rated_world(one), 200))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((model, feedback)))
    np.testing.assert_array_equal(model.scale, 1.0)
    assert abs(feedback.mean.reshape(-1)[17] - np.asarray(WORLD.law.centre).reshape(-1, RATERS)[17].mean()) < 0.1


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("members", 1),
        ("hidden", 0),
        ("learning_rate", 0.0),
        ("fits", 0),
        ("batch", 0),
        ("prior_scale", 0.0),
    ],
)
def test_what_is_refused(field: str, value: Any):
    with pytest.raises(InvalidValueError, match=f"^{field} = "):
        RatingModel(**{field: value})


def test_tables_at_once_are_fitted_as_step_by_step():
    known, key = rated_world(HALF), jax.random.key(3)
    model = rating_model.init(SPEC, jax.random.key(0), STATES, ACTIONS, RATERS)
    one = jax.jit(lambda: rating_model.fit(SPEC, model, known, WORLD.observe, ACTIONS, key))()
    at_once = jax.jit(lambda: rating_model.fit_table(SPEC, model, known, ACTIONS, key))()
    before = jax.tree.leaves(model.layers)
    for old, a, b in zip(before, *map(jax.tree.leaves, (one.layers, at_once.layers)), strict=True):
        assert np.abs(np.asarray(a) - old).max() > 1e-3
        np.testing.assert_allclose(a, b, atol=2e-5)
    np.testing.assert_allclose(one.location, at_once.location, rtol=1e-6)


@pytest.mark.parametrize("rated", [0, 1, 255, 256, 257, 400])
def test_only_rated_slots_are_looked_at(rated: int):
    slots = np.zeros(400, bool)
    slots[np.random.default_rng(rated).permutation(400)[:rated]] = True
    known = rated_world(slots)
    table = jax.jit(lambda: rating_model.of_rated(known, lambda places: (places + 1, 2 * places[:, None])))()
    number = np.arange(400)
    np.testing.assert_array_equal(table[0], slots * (number + 1))
    np.testing.assert_array_equal(table[1][:, 0], 2 * slots * number)


def test_rows_are_not_copied_at_every_step():
    known = rating_model.memory(8192, jnp.int32(0), RATERS)
    visit = aggregate(jnp.ones(RATERS), jnp.float32(1.0))

    def steps(known: Memory) -> Memory:
        def one(known: Memory, slot: Any) -> tuple[Memory, None]:
            return rating_model.remember(known, slot, slot, slot % 4, visit, jnp.float32(1.0)), None

        return jax.lax.scan(one, known, jnp.arange(100))[0]

    text = str(jax.jit(steps).lower(known).compile().as_text())
    body = text[: text.index("ENTRY")]  # copied once before the loop is no matter
    width = known.rows.shape[1]
    assert f"f32[8192,{width}]" in body
    assert f"f32[8192,{width}]{{1,0}} copy(" not in body
