"""The compiled tabular trainer, on probe tasks whose values are known and on the paper's smallest grid."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import jax
import numpy as np
import pytest
import scipy.stats

from uard.agents import tabular
from uard.agents.tabular import QLearning
from uard.envs.grids.trapgrid import TrapGrid, paper_grid
from uard.envs.tables import HiddenTruth, Task
from uard.method.abstention import Abstention
from uard.method.mitigations import NAMED, named
from uard.ratings.panels import PANELS, RatingLaw
from uard.training.compiled import draws, runs
from uard.training.compiled import tabular as compiled
from uard.training.compiled.tabular import Program, Run, TrainedTables
from uard.training.episode_log import LOG
from uard.training.xla import COMPILER_OPTIONS

# One program length for all tests, so that what agrees in shapes and classes is compiled once.
PROGRAM = Program(episodes=300)
FIELDS = ("log", "steps", "q", "feedback")
VISITS, TRUE, OBSERVED, GOAL, LENGTH, ABSTAINED = range(len(LOG))


def train(*several: Run) -> list[dict[str, Any]]:
    return compiled.train(list(several), PROGRAM, FIELDS)


def on_grid(
    mitigation: str = "uard",
    grid: TrapGrid | None = None,
    agent: QLearning | None = None,
    seed: int = 0,
    panel: str = "main",
    noise: float = 0.0,
    rated: float = 1.0,
    **parameters: Any,
) -> Run:
    grid = grid or paper_grid(6)
    task, truth = grid.task(), grid.truth()
    agent = agent or QLearning(epsilon_decay=0.98)
    law = grid.rating_law(PANELS[panel], noise)
    return compiled.make_run(task, law, truth, agent, named(mitigation, **parameters), seed, rated)


def probe(next_state: list, reward: list, terminal: list, horizon: int, **agent: Any) -> Run:
    """A task with two actions, explored at random by the raw agent."""
    task = Task(np.int32(next_state), np.float32(reward), np.array(terminal, bool), np.int32(0), np.int32(horizon))
    shape = task.reward.shape
    truth = HiddenTruth(task.reward, np.zeros(shape, bool), task.terminal)
    law = RatingLaw(np.zeros((*shape, 3), np.float32), np.ones((*shape, 3), np.float32))
    settings = {"learning_rate": 0.5, "epsilon": 1.0, "epsilon_decay": 1.0, "init_scale": 1.0} | agent
    return compiled.make_run(task, law, truth, QLearning(**settings), named("raw"), seed=0)


def values(out: dict[str, Any]) -> np.ndarray:
    """Return the heads' values (S, A, N)."""
    return out["q"]


def same(one: dict[str, Any], other: dict[str, Any], fields: tuple[str, ...] = FIELDS) -> None:
    for name in fields:
        jax.tree.map(partial(np.testing.assert_array_equal, err_msg=name), one[name], other[name])


def test_one_step_learns_what_an_action_pays():
    (out,) = train(probe([[0, 0]], [[1.5, -2.0]], [[True, True]], horizon=9))
    np.testing.assert_allclose(values(out)[0], np.repeat([[1.5], [-2.0]], 5, axis=1), rtol=1e-6)
    assert out["steps"] == PROGRAM.episodes
    assert set(out["log"][:, OBSERVED]) == {1.5, -2.0}
    np.testing.assert_array_equal(out["log"][:, [LENGTH, GOAL, VISITS]], [[1, 1, 0]] * PROGRAM.episodes)


@pytest.mark.parametrize("gamma", [0.0, 0.5, 0.95])
def test_two_steps_are_discounted_once(gamma: float):
    chain = probe([[1, 0], [1, 1]], [[0.5, 0.3], [2.0, -7.0]], [[False, True], [True, True]], 9, gamma=gamma)
    (out,) = train(chain)
    expected = np.array([[0.5 + gamma * 2.0, 0.3], [2.0, -7.0]])
    np.testing.assert_allclose(values(out)[:2], np.repeat(expected[..., None], 5, axis=-1), rtol=1e-5)


@pytest.mark.parametrize("horizon", [1, 7])
def test_a_cut_off_episode_bootstraps_and_a_finished_one_does_not(horizon: int):
    """An endless loop that pays r is worth r / (1 - gamma), however early it is cut off."""
    loop, end = (probe([[0, 0]], [[2.0, 2.0]], [[over, over]], horizon, gamma=0.75) for over in (False, True))
    cut, ended = train(loop, end)
    np.testing.assert_allclose(values(cut)[0], 2.0 / (1 - 0.75), rtol=1e-4)
    np.testing.assert_allclose(values(ended)[0], 2.0, rtol=1e-6)
    assert set(cut["log"][:, LENGTH]) == {horizon}
    assert not cut["log"][:, GOAL].any()
    assert set(ended["log"][:, LENGTH]) == {1}


def test_states_that_are_never_reached_keep_their_initial_values():
    agent = {"init_scale": 0.7}
    (out,) = train(probe([[0, 0]], [[1.0, 1.0]], [[True, True]], 9, **agent))
    key = jax.random.wrap_key_data(np.uint32([0, 0]), impl="threefry2x32")
    begun = np.asarray(tabular.init(QLearning(init_scale=0.7), key, compiled.MIN_STATES, 2))
    np.testing.assert_array_equal(values(out)[1:], begun[1:])
    np.testing.assert_array_equal(tabular.init(QLearning(init_scale=0.7), key, 7, 2), begun[:7])
    assert 0.6 < abs(begun).max() <= 0.7


def test_the_log_adds_up():
    (out,) = train(on_grid())
    log, grid = out["log"], paper_grid(6)
    assert log.shape == (PROGRAM.episodes, len(LOG))
    assert out["steps"] == log[:, LENGTH].sum()
    plain = log[:, LENGTH] - log[:, VISITS] - log[:, GOAL]
    for column, trap in ((OBSERVED, grid.trap_reward), (TRUE, grid.true_trap_reward)):
        expected = 10.0 * log[:, GOAL] + trap * log[:, VISITS] - 0.1 * plain
        np.testing.assert_allclose(log[:, column], expected, atol=1e-3)
    assert set(log[:, GOAL]) == {0.0, 1.0}
    assert log[:, LENGTH].max() == grid.horizon
    assert not log[:, ABSTAINED].any()
    assert out["feedback"].count.sum() == out["steps"], "every step was rated"
    np.testing.assert_array_equal(out["feedback"].raters, 3 * (out["feedback"].count > 0))
    for rater in range(3):
        np.testing.assert_array_equal(out["feedback"].by_rater.count[..., rater], out["feedback"].count)


def test_raw_learning_hacks_and_the_filter_does_not():
    trained = {name: train(*(on_grid(name, seed=s) for s in range(4))) for name in ("raw", "uard")}
    late = {name: np.stack([o["log"][-50:] for o in out]).mean((0, 1)) for name, out in trained.items()}
    assert late["raw"][VISITS] > 10
    assert late["raw"][GOAL] < 0.1
    assert late["uard"][VISITS] < 0.5
    assert late["uard"][GOAL] > 0.95
    assert late["uard"][TRUE] > 8 > 0 > late["raw"][TRUE]


def test_every_snapshot_is_filled():
    """Short episodes pass several snapshots between two looks at the table."""
    program = Program(PROGRAM.episodes, snapshots=60)
    (out,) = compiled.train([on_grid()], program, ("log", "q", "feedback", "q_snapshots", "feedback_snapshots"))
    feedback, later = out["feedback"], out["feedback_snapshots"]
    pairs = zip(jax.tree.leaves(later), jax.tree.leaves(feedback), strict=True)
    assert out["log"][-50:, LENGTH].mean() < 5 * 256 / 60
    for kept, final in ((out["q_snapshots"], out["q"]), *pairs):
        assert kept.shape == (60, *final.shape)
        assert kept.reshape(60, -1).any(axis=1).all()
        np.testing.assert_array_equal(kept[-1], final)
    assert (np.diff(later.count.sum((1, 2))) >= 0).all()


def test_the_same_run_twice_gives_the_same():
    first, again, other = train(on_grid(seed=5)), train(on_grid(seed=5)), train(on_grid(seed=6))
    same(first[0], again[0])
    assert (first[0]["q"] != other[0]["q"]).any()


def mixed() -> list[Run]:
    """Runs that differ in all that is a number, as one program takes them."""
    return [
        on_grid(seed=1),
        on_grid(grid=paper_grid(8), seed=2, slack=0.2, noise=0.5),
        on_grid(agent=QLearning(gamma=0.9, epsilon=0.5, epsilon_decay=0.9), seed=3, panel="appendix", rated=0.2),
    ]


def test_runs_in_one_batch_are_the_runs_alone():
    for together, run in zip(train(*mixed()), mixed(), strict=True):
        same(together, train(run)[0])


def test_side_by_side_gives_the_same_log():
    stacked = jax.tree.map(
        lambda *leaves: np.stack([np.float32(x) if isinstance(x, float) else x for x in leaves]), *mixed()
    )
    side_by_side = jax.jit(jax.vmap(lambda one: compiled.train_one(one, PROGRAM)), compiler_options=COMPILER_OPTIONS)
    together: TrainedTables = side_by_side(stacked)
    for i, alone in enumerate(train(*mixed())):
        np.testing.assert_array_equal(together.steps[i], alone["steps"])
        np.testing.assert_allclose(together.log[i], alone["log"], rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(together.q[i], alone["q"], rtol=1e-4, atol=1e-4)


@cache
def trained_alone(name: str) -> dict[str, Any]:
    return train(on_grid(name))[0]


@pytest.mark.parametrize("name", NAMED)
def test_every_named_mitigation_trains(name: str):
    out = trained_alone(name)
    for field in FIELDS:
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(out[field])), field
    assert (out["log"][:, LENGTH] >= 1).all()
    assert abs(out["q"]).max() <= max(4.0 / (1 - 0.95), 10.0) + 1e-3
    assert (out["feedback"].count.sum() > 0) == named(name).reads_feedback


@pytest.mark.parametrize("name", ["uard", "uard-paper", "lcb", "screening"])
def test_learning_never_sees_the_truth(name: str):
    honest = on_grid(name)
    noise = np.random.default_rng(0).normal(size=honest.truth.reward.shape).astype(np.float32)
    lie = HiddenTruth(5.0 * noise, ~np.asarray(honest.truth.hack), ~np.asarray(honest.truth.goal))
    other = train(honest._replace(truth=lie))[0]
    same(other, trained_alone(name), ("q", "feedback", "steps"))
    blind, seeing = other["log"], trained_alone(name)["log"]
    np.testing.assert_array_equal(blind[:, [OBSERVED, LENGTH]], seeing[:, [OBSERVED, LENGTH]])
    for column in (TRUE, VISITS, GOAL):
        assert (blind[:, column] != seeing[:, column]).any(), LOG[column]


def test_numbers_do_not_recompile():
    train(on_grid())
    before = runs.one_by_one._cache_size()
    grid = TrapGrid(size=5, traps=((1, 1), (2, 3)), trap_reward=6.5, goal=(0, 4), horizon=33)
    for run in (
        on_grid(lies=0.1, slack=0.2, contest=1.5, caution=1.0, risk=0.5, unrated_weight=0.5),
        on_grid(agent=QLearning(epsilon=0.3, epsilon_decay=0.9, epsilon_min=0.01, learning_rate=0.2, gamma=0.9)),
        on_grid(agent=QLearning(bootstrap=0.5, init_scale=0.3)),
        on_grid(noise=1.2, panel="appendix", rated=0.01, seed=77),
        on_grid(grid=grid),
        on_grid(grid=paper_grid(10, 8.0, legitimate=True)),
    ):
        train(run)
    assert runs.one_by_one._cache_size() == before


def test_whole_numbers_are_numbers_too():
    train(on_grid())
    before = runs.one_by_one._cache_size()
    same(train(on_grid(contest=1, caution=2))[0], train(on_grid(contest=1.0, caution=2.0))[0])
    train(on_grid(agent=QLearning(epsilon=1, bootstrap=1, gamma=0)))
    assert runs.one_by_one._cache_size() == before
    assert runs.signature(on_grid(risk=1)) == runs.signature(on_grid(risk=0.5)), "they fit into one batch"


@pytest.mark.parametrize("name", ["uard", "mean-of-annotations"])
def test_a_single_rater(name: str):
    out = train(on_grid(name, panel="single"))[0]
    assert np.isfinite(out["q"]).all()
    feedback = out["feedback"]
    assert feedback.count.sum() == out["steps"]
    assert not feedback.sd.any(), "alone it never disagrees with itself"
    np.testing.assert_array_equal(feedback.raters, feedback.count > 0)
    np.testing.assert_allclose(feedback.by_rater.mean[..., 0], feedback.mean, rtol=1e-5, atol=1e-6)
    assert out["log"][-50:, VISITS].mean() < 1
    assert out["log"][-50:, GOAL].mean() > 0.9


def test_a_single_head():
    out = train(on_grid(agent=QLearning(heads=1, epsilon_decay=0.98)))[0]
    assert out["q"].shape == (compiled.MIN_STATES, 4, 1)
    assert np.isfinite(out["q"]).all()
    assert out["log"][-50:, VISITS].mean() < 0.5


def test_random_bits_become_finite_normals():
    """Against the exact inverse; the highest bits must not round to a probability of 1 and so to infinity."""
    bits = np.arange(2**16, dtype=np.uint32) << 16 | 1 << 15
    ends = np.uint32([0, 2**32 - 1])
    exact = scipy.stats.norm.ppf((bits + 0.5) / 2**32)
    np.testing.assert_allclose(draws.normal(bits), exact, atol=2e-3)
    low, high = np.asarray(draws.normal(ends))
    assert -6 < low < -5
    assert 5 < high < 6


@pytest.mark.parametrize(("seed", "number", "count", "steps"), [(0, 0, 1, 1), (7, 3, 5, 512), (2**32 - 1, 2, 4, 9)])
def test_random_bits_are_threefry(seed: int, number: int, count: int, steps: int):
    key = jax.random.wrap_key_data(np.uint32([seed, number]), impl="threefry2x32")
    found = draws.words(np.uint32(seed), np.uint32(number), count, steps)
    np.testing.assert_array_equal(found.T, jax.random.bits(key, (steps, count), np.uint32))


def test_a_share_of_the_steps_is_rated():
    for share in (0.0, 0.1, 1.0):
        out = train(on_grid(rated=share))[0]
        steps = int(out["steps"])
        assert abs(out["feedback"].count.sum() - share * steps) <= 4 * np.sqrt(steps * share * (1 - share))


def abstaining(response: str, limit: float, init_scale: float = 0.1, **settings: Any) -> Run:
    rule = Abstention("threshold", limit, response)  # type: ignore[arg-type]
    return on_grid(agent=QLearning(epsilon_decay=0.98, init_scale=init_scale, abstention=rule), **settings)


@pytest.mark.parametrize("response", ["safe", "ask", "skip"])
def test_who_never_abstains_learns_as_if_there_were_no_rule(response: str):
    same(train(abstaining(response, 1e9))[0], trained_alone("uard"))


def test_who_skips_everything_learns_nothing():
    out = train(abstaining("skip", 1e-9))[0]
    key = jax.random.wrap_key_data(np.uint32([0, 0]), impl="threefry2x32")
    np.testing.assert_array_equal(out["q"], tabular.init(QLearning(), key, compiled.MIN_STATES, 4))
    np.testing.assert_array_equal(out["log"][:, ABSTAINED], out["log"][:, LENGTH])


def test_who_asks_is_rated_beyond_the_budget():
    limits = (1e9, 1e-9, 0.1)
    never, always, sometimes = (train(abstaining("ask", x, rated=0.0, init_scale=1.0))[0] for x in limits)
    assert not any(x.any() for x in jax.tree.leaves(never["feedback"]))
    for out in (always, sometimes):
        assert out["feedback"].count.sum() == out["log"][:, ABSTAINED].sum()
    assert always["feedback"].count.sum() == always["steps"]
    assert 0 < sometimes["feedback"].count.sum() < 0.9 * sometimes["steps"]


def test_who_plays_safe_acts_otherwise():
    out = train(abstaining("safe", 1e-9))[0]
    assert (out["log"][:, ABSTAINED] > 0).all()
    assert (out["log"][:, LENGTH] != trained_alone("uard")["log"][:, LENGTH]).any()
    assert np.isfinite(out["q"]).all()


def test_no_draw_of_a_rater_is_infinite():
    extremes = np.array([0, 2**32 - 1, 2**31, 2**32 - 256], np.uint32)
    assert np.isfinite(np.asarray(draws.normal(extremes))).all()
