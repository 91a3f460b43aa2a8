"""The replay loop and the value family, on probe tasks whose values are known."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from uard.agents.networks import SINGLE, Ensemble, Network
from uard.agents.off_policy import Transitions, UpdateInfo
from uard.agents.value import DeepQ
from uard.envs.tables import HiddenTruth, Task
from uard.envs.world import TableWorld, table_world
from uard.method.mitigations import named
from uard.ratings.panels import RatingLaw
from uard.training.compiled import off_policy, runs
from uard.training.compiled.common import QUANTITIES, Program, Run, Watch, make_run
from uard.training.episode_log import LOG

# One program for all probes: as many steps, agents that differ in numbers alone, few states and rows.
PROGRAM = Program(episodes=2500, steps=2500, walk=8)
FIELDS = ("log", "steps", "episodes", "values", "feedback", "walk", "fault", "fault_step", "good_step")
NETWORK = Network(hidden=16, learning_rate=3e-3, value_scale=2.0)
ROOM = 2
HACK, TRUE, OBSERVED, GOAL, LENGTH, _ = range(len(LOG))


def random_walker(**changes: Any) -> DeepQ:
    settings: dict[str, Any] = {"network": NETWORK, "ensemble": Ensemble("full", 2, 0.1), "buffer": 1000, "batch": 32}
    settings |= {"epsilon": 1.0, "epsilon_decay": 1.0, "warmup": 64, "target_every": 50}
    return DeepQ(**(settings | changes))


def world(next_state: list, reward: list, terminal: list, horizon: int) -> TableWorld:
    task = Task(np.int32(next_state), np.float32(reward), np.array(terminal, bool), np.int32(0), np.int32(horizon))
    shape = task.reward.shape
    truth = HiddenTruth(task.reward, np.zeros(shape, bool), task.terminal)
    centre = np.arange(3.0 * task.reward.size).reshape(*shape, 3)
    return table_world(task, truth, RatingLaw(np.float32(centre), np.ones((*shape, 3), np.float32)), 3)


def probe(next_state: list, reward: list, terminal: list, horizon: int, seed: int = 0, **agent: Any) -> Run:
    return make_run(world(next_state, reward, terminal, horizon), random_walker(**agent), named("raw"), seed)


def train(*several: Run) -> list[dict[str, Any]]:
    return runs.train(list(several), off_policy.train_one, PROGRAM, FIELDS, ROOM)


def mean(out: dict[str, Any]) -> np.ndarray:
    return out["values"][0]


def same(one: dict[str, Any], other: dict[str, Any]) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


def bandit(**agent: Any) -> Run:
    return probe([[0, 0]], [[1.5, -2.0]], [[True, True]], 9, **agent)


def chain(**agent: Any) -> Run:
    """Two steps; the second action of the first state ends the episode."""
    return probe([[1, 0], [1, 1]], [[0.5, 0.3], [2.0, -3.0]], [[False, True], [True, True]], 9, **agent)


@cache
def trained(name: str) -> dict[str, Any]:
    return train({"bandit": bandit, "chain": chain}[name]())[0]


def test_one_step_learns_what_an_action_pays():
    out = trained("bandit")
    np.testing.assert_allclose(mean(out)[0], [1.5, -2.0], atol=0.05)
    assert out["steps"] // 128 * 128 == out["steps"], "whole chunks"
    assert out["episodes"] == 2500
    assert set(out["log"][:, OBSERVED]) == {1.5, -2.0}
    np.testing.assert_array_equal(out["log"][:, [LENGTH, GOAL, HACK]], [[1, 1, 0]] * 2500)
    places, rewards = out["walk"]
    np.testing.assert_array_equal(places, [0] + [-1] * 7)
    np.testing.assert_array_equal(rewards, [1.5] + [0] * 7)


@pytest.mark.parametrize("gamma", [0.5, 0.95])
def test_two_steps_are_discounted_once(gamma: float):
    out = trained("chain") if gamma == 0.95 else train(chain(gamma=gamma))[0]
    np.testing.assert_allclose(mean(out)[:2], [[0.5 + gamma * 2.0, 0.3], [2.0, -3.0]], atol=0.1)
    np.testing.assert_array_equal(out["walk"][0][:3], [0, 2, -1])


@pytest.mark.parametrize("horizon", [1, 7])
def test_a_cut_off_episode_bootstraps_and_a_finished_one_does_not(horizon: int):
    """An endless loop that pays r is worth r / (1 - gamma), however early it is cut off."""
    cut, ended = train(*(probe([[0, 0]], [[2.0, 2.0]], [[over, over]], horizon, gamma=0.6) for over in (False, True)))
    np.testing.assert_allclose(mean(cut)[0], 5.0, atol=0.1)
    np.testing.assert_allclose(mean(ended)[0], 2.0, atol=0.05)
    assert set(cut["log"][: cut["episodes"], LENGTH]) == {horizon}
    assert not cut["log"][:, GOAL].any()


def test_the_same_run_twice_gives_the_same():
    (again,), (other,) = train(chain()), train(chain(seed=1))
    same(trained("chain"), again)
    assert (mean(other) != mean(again)).any()


def test_runs_in_one_batch_are_the_runs_alone():
    together = train(bandit(), chain())
    for out, name in zip(together, ("bandit", "chain"), strict=True):
        same(out, trained(name))


def test_side_by_side_gives_the_same():
    pair = [chain(), chain(seed=1, gamma=0.5)]
    stacked = jax.tree.map(lambda *x: np.stack([np.asarray(v, runs.narrow(v)) for v in x]), *pair)
    together = jax.jit(jax.vmap(lambda one: off_policy.train_one(one, PROGRAM)))(stacked)
    for i, alone in enumerate(train(*pair)):
        np.testing.assert_array_equal(together.steps[i], alone["steps"])
        np.testing.assert_allclose(together.log[i], alone["log"], rtol=1e-4, atol=1e-4)
        for one, other in zip(together.values, alone["values"], strict=True):
            np.testing.assert_allclose(one[i], other, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e38])
def test_a_reward_beyond_measure_is_noticed_and_harms_no_other_run(bad: float):
    """The second action of the last state pays it, and goes on."""
    broken = probe([[1, 0], [0, 0]], [[0.5, 0.3], [0.0, bad]], [[False, True], [True, False]], 9)
    out, healthy = train(broken, chain())
    same(healthy, trained("chain"))
    assert healthy["fault"] == 0 == healthy["fault_step"]
    assert out["fault"] > 0
    assert QUANTITIES[out["fault"]] in ("reward", "loss", "values", "parameters")
    assert 0 <= out["good_step"] < out["fault_step"] == out["steps"] <= 1024
    assert out["fault_step"] - out["good_step"] == 128


def test_the_cause_is_named_before_its_effects():
    endless = probe([[0, 0]], [[1.0, np.nan]], [[False, False]], 10_000)
    assert QUANTITIES[train(endless)[0]["fault"]] == "reward"
    episodic = probe([[0, 0]], [[1.0, np.nan]], [[True, True]], 9)
    assert QUANTITIES[train(episodic)[0]["fault"]] == "loss", "an episode's sums are over before one looks"


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("nothing", {}),
        ("loss", {"loss": np.inf, "largest": np.nan, "agent": np.nan}),
        ("values", {"largest": 3e8, "agent": np.nan}),
        ("values", {"largest": np.nan}),
        ("parameters", {"agent": np.nan}),
        ("rating model", {"model": np.inf, "loss": np.nan}),
        ("reward", {"reward": np.nan, "model": np.nan, "loss": np.nan, "largest": np.nan, "agent": np.nan}),
    ],
)
def test_what_diverged_is_named(name: str, changes: dict[str, float]):
    fine = {"agent": 1.0, "loss": 1.0, "largest": 1e8, "model": 0.0, "reward": 1.0}
    seen = {k: jnp.float32(v) for k, v in (fine | changes).items()}
    before = Watch.start(jnp.float32(7.0))
    watch = before.after(jnp.int32(128), **seen, unit=jnp.float32(2.0))
    assert QUANTITIES[int(watch.fault)] == name
    well = name == "nothing"
    assert (int(watch.fault_step), int(watch.good_step)) == ((0, 128) if well else (128, 0))
    assert float(watch.good) == (1.0 if well else 7.0)


def one_way(agent: Any, seed: int = 0) -> Run:
    """Three states in a circle and one action: whatever the agent draws, it goes the same way."""
    steps = world([[1], [2], [0]], [[1.0], [2.0], [3.0]], [[False], [False], [True]], 9)
    return make_run(steps, agent, named("mean-of-annotations"), seed, rated=0.7)


def test_no_agent_shifts_the_ratings():
    """Ratings have a stream of their own: agents that draw otherwise get the same ones."""
    program = Program(episodes=100, steps=256, walk=4)
    learner = random_walker(ensemble=SINGLE)
    several = {"learner": one_way(learner), "witness": one_way(Witness()), "other seed": one_way(learner, 1)}
    known = {}
    for name, run in several.items():
        (out,) = runs.train([run], off_policy.train_one, program, ("feedback", "values"), ROOM)
        known[name] = out["feedback"]
    jax.tree.map(np.testing.assert_array_equal, known["learner"], known["witness"])
    assert (np.stack(known["learner"][:5]) != np.stack(known["other seed"][:5])).any()
    learned = known["learner"]
    assert 0.5 * 256 < learned.count.sum() < 0.9 * 256
    np.testing.assert_array_equal(learned.by_rater.count, np.repeat(learned.count[..., None], 3, -1))


class Seen(NamedTuple):
    """What a ``Witness`` was given."""

    updates: jax.Array
    first: Transitions
    ever: jax.Array


@dataclass(frozen=True)
class Witness:
    """An agent that learns nothing, goes through the actions in turn, and keeps the first batch that it is given."""

    network: Network = field(default_factory=Network)
    buffer: int = 321
    batch: int = 32
    warmup: int = 0
    bootstrap: float = 0.5
    members: int = 4

    def init(self, key: Any, features: int, actions: int) -> Seen:
        some, none = jnp.zeros(self.batch, jnp.int32), jnp.zeros(self.batch, bool)
        first = Transitions(some, some, some, none, jnp.zeros((self.batch, self.members)))
        return Seen(jnp.int32(0), first, jnp.zeros((features, actions)))

    def values(self, state: Seen, observations: Any, key: Any) -> Any:
        return jnp.zeros((2, observations.shape[0], state.ever.shape[1]))

    def read(self, state: Seen, observations: Any, key: Any) -> Any:
        return self.values(state, observations, key)[0], self.values(state, observations, key)[1]

    def act(self, state: Seen, observation: Any, score_fn: Any, episode: Any, key: Any) -> Any:
        return (state.updates % state.ever.shape[1]).astype(jnp.int32)

    def greedy(self, state: Seen, observation: Any, score_fn: Any, key: Any) -> Any:
        return jnp.int32(0)

    def update(self, state: Seen, batch: Transitions, *rest: Any) -> tuple[Seen, UpdateInfo]:
        first = jax.tree.map(lambda new, old: jnp.where(state.updates == 0, new, old), batch, state.first)
        ever = state.ever.at[batch.observation, batch.action].add(1.0)
        return Seen(state.updates + 1, first, ever), UpdateInfo(jnp.float32(0.0), jnp.float32(0.0))


def compiled(agent: Any) -> Any:
    steps = world([[1, 1], [2, 2], [0, 0]], [[1, 1]] * 3, [[False] * 2, [False] * 2, [True] * 2], 9)
    run = make_run(steps, agent, named("raw"), 0)
    run = jax.tree.map(lambda x: np.asarray(x, runs.narrow(x)), run)
    program = Program(episodes=100, steps=256, walk=4)
    return jax.jit(lambda one: off_policy.train_one(one, program)).lower(run).compile(), run


def test_a_step_is_in_the_buffer_before_it_is_drawn():
    program, run = compiled(Witness())
    seen: Seen = program(run).good
    assert int(seen.updates) == 256
    first = seen.first
    np.testing.assert_array_equal(first.observation, [0] * 32, err_msg="only the first step was there")
    np.testing.assert_array_equal(first.next_observation, [1] * 32)
    assert not np.asarray(first.action).any()
    assert not np.asarray(first.terminated).any()
    assert set(np.asarray(first.mask).ravel()) <= {0.0, 1.0}
    ever = np.asarray(seen.ever)
    assert (ever > 0).all()
    assert ever.max() < 1.5 * ever.min(), "drawn evenly"


def test_the_buffer_is_never_copied_within_a_chunk():
    """In the compiled program, copies of the buffer stand outside the loop over steps, in which one writes to it."""
    agent = DeepQ(network=NETWORK, ensemble=Ensemble("shared", 2), buffer=321, batch=32, warmup=0)
    text = compiled(agent)[0].as_text()
    inside: dict[str, tuple[str, bool]] = {}  # by computation: who calls it, and whether as the body of a loop
    copies, writes, place = set(), set(), ""
    for line in text.splitlines():
        if head := re.match(r"(?:ENTRY )?%?([\w.\-]+) \(.*-> .*\{$", line):
            place = head[1]
        for how, called in re.findall(r"(body|condition|calls|to_apply|computation)=%?([\w.\-]+)", line):
            inside[called] = place, how == "body"
        for called in re.findall(r"branch_computations=\{([^}]*)\}", line):
            inside |= {name.strip().lstrip("%"): (place, False) for name in called.split(",")}
        whole = re.search(r" = \w+\[321(?:,\d+)*\]\S* (copy|dynamic-update-slice|scatter|fusion)\(", line)
        if whole and whole[1] == "copy":
            copies.add(place)
        elif whole and ("dynamic-update-slice" in line or "scatter" in line):
            writes.add(place)

    def loops(name: str) -> int:
        caller, body = inside.get(name, ("", False))
        return body + loops(caller) if caller else 0

    assert max(map(loops, writes)) >= 2, "chunks, steps"
    assert all(loops(name) <= 1 for name in copies)
