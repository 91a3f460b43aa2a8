"""The policy family on probe tasks whose values are known, on a constrained toy, and on the paper's largest grid."""

from __future__ import annotations

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from uard.agents.policy import CPO, PPO, TRPO
from uard.envs.grids.trapgrid import paper_grid
from uard.envs.tables import HiddenTruth, Task
from uard.envs.world import TableWorld, table_world
from uard.method.mitigations import named
from uard.ratings.panels import PANELS, RatingLaw
from uard.training.compiled import on_policy, runs
from uard.training.compiled.common import ROOM, Program, make_run
from uard.training.episode_log import LOG

VISITS, TRUE, OBSERVED, GOAL, LENGTH, _ = range(len(LOG))
GAMMA = 0.8
STATES, ACTIONS = 3, 2
END = -1


def tables(steps: dict[tuple[int, int], tuple[int, float]], horizon: int = 10, hack: Any = ()) -> TableWorld:
    """Build a world from (state, action) -> (next state or END, reward)."""
    next_state = np.zeros((STATES, ACTIONS), np.int32)
    reward, terminal = np.zeros((STATES, ACTIONS), np.float32), np.ones((STATES, ACTIONS), bool)
    hacks = np.zeros((STATES, ACTIONS), bool)
    for place, (to, pay) in steps.items():
        next_state[place], reward[place], terminal[place] = max(to, 0), pay, to == END
        hacks[place] = place in hack
    law = RatingLaw(np.stack([reward] * 3, -1), np.zeros((STATES, ACTIONS, 3), np.float32))
    task = Task(next_state, reward, terminal, np.int32(0), np.int32(horizon))
    return table_world(task, HiddenTruth(reward, hacks, hacks), law, STATES)


BOTH = (0, 1)
PROBES = {
    "value": (tables({(0, a): (END, 1.0) for a in BOTH}), {0: 1.0}),
    "discount": (tables({(0, a): (1, 0.0) for a in BOTH} | {(1, a): (END, 2.0) for a in BOTH}), {0: 2 * GAMMA, 1: 2.0}),
    "action": (tables({(0, 0): (END, -1.0), (0, 1): (END, 1.0)}), {0: 1.0}),
    # Action 1 pays at once, action 0 more a step later.
    "patience": (
        tables({(0, 0): (1, 0.0), (0, 1): (END, 1.0), (1, 0): (END, 2.0), (1, 1): (END, 0.0)}),
        {0: 1.6, 1: 2.0},
    ),
    # It never ends but is cut off every 3 steps: who took the cut for an end would see at most 1 + 0.8 + 0.64.
    "cut": (tables({(0, a): (0, 1.0) for a in BOTH}, horizon=3), {0: 1 / (1 - GAMMA)}),
}
OPTIMA = {"action": {0: 1}, "patience": {0: 0, 1: 0}}


def train(several: list[Any], program: Program, fields: tuple[str, ...]) -> list[dict[str, Any]]:
    # The model of ratings and Optax mix integers and floats.
    with jax.numpy_dtype_promotion("standard"):
        return runs.train(several, on_policy.train_one, program, fields, ROOM)


@cache
def probed(make: Any) -> dict[str, Any]:
    agent = make(gamma=GAMMA, count_bonus=0.0)
    several = [make_run(world, agent, named("raw"), 0) for world, _ in PROBES.values()]
    program = Program(episodes=20_000, steps=20_000, walk=4)
    return dict(zip(PROBES, train(several, program, ("values", "good", "log", "episodes")), strict=True))


@pytest.mark.parametrize("make", [PPO, TRPO])
@pytest.mark.parametrize("probe", PROBES)
def test_known_values_are_learned(make, probe):
    mean = probed(make)[probe]["values"][0][:, 0]
    for state, value in PROBES[probe][1].items():
        assert mean[state] == pytest.approx(value, abs=0.1 * max(1, value))


@pytest.mark.parametrize("make", [PPO, TRPO])
@pytest.mark.parametrize("probe", OPTIMA)
def test_known_optima_are_found(make, probe):
    policy = jax.tree.map(jnp.asarray, probed(make)[probe]["good"])
    for state, best in OPTIMA[probe].items():
        assert make().greedy(policy, jnp.eye(STATES)[state]) == best


BUDGETS = (0.1, 0.3, 0.7)
TEMPTATION = tables({(0, 0): (END, 1.0), (0, 1): (END, 0.0)}, horizon=1, hack={(0, 0)})


@cache
def tempted() -> list[np.ndarray]:
    """Return the episodes of CPO for each budget, then PPO's."""
    program = Program(episodes=20_000, walk=4)

    def logs(agents: list[Any]) -> list[np.ndarray]:
        several = [make_run(TEMPTATION, agent, named("raw"), 0) for agent in agents]
        return [out["log"] for out in train(several, program, ("log",))]

    return [
        *logs([CPO(limit=d, count_bonus=0.0) for d in BUDGETS]),
        *logs([PPO(count_bonus=0.0)]),
    ]


@pytest.mark.parametrize("index", range(len(BUDGETS)))
def test_cpo_spends_its_budget_and_no_more(index):
    last = tempted()[index][-5000:]
    assert last[:, VISITS].mean() <= BUDGETS[index] + 0.03
    assert last[:, OBSERVED].mean() == pytest.approx(BUDGETS[index], abs=0.03)


def test_without_a_budget_the_temptation_is_taken():
    assert tempted()[-1][-5000:, VISITS].mean() > 0.97


# --- the grid -------------------------------------------------------------------------------------------------------


def on_grid(agent: Any, mitigation: str, seeds: range, trap: float = 4.0, panel: str = "main") -> np.ndarray:
    """Return the mean of the last 100 of 500 episodes, (seeds, len(LOG))."""
    world = paper_grid(10, trap, horizon=100).world(PANELS[panel])
    several = [make_run(world, agent, named(mitigation), seed) for seed in seeds]
    return np.stack([out["log"][-100:].mean(0) for out in train(several, Program(500), ("log",))])


AGENTS = {"ppo": PPO(), "trpo": TRPO(), "cpo": CPO(oracle=False)}


@pytest.mark.slow
@pytest.mark.parametrize("name", AGENTS)
def test_the_plain_agent_hacks(name):
    last = on_grid(AGENTS[name], "raw", range(3))
    assert (last[:, VISITS] > 35).all()
    assert last[:, GOAL].mean() < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("name", AGENTS)
def test_the_plain_agent_solves_an_honest_grid(name):
    last = on_grid(AGENTS[name], "raw", range(5), trap=-1.0)
    assert (last[:, GOAL] >= 0.95).all()
    assert (last[:, VISITS] <= 0.5).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "trap", "panel"), [*((name, 4.0, "main") for name in AGENTS), ("ppo", 8.0, "appendix")]
)
def test_uard_leaves_the_traps_and_reaches_the_goal(name, trap, panel):
    last = on_grid(AGENTS[name], "uard-0.1", range(5), trap, panel)
    assert (last[:, VISITS] <= 0.5).all()
    assert (last[:, GOAL] >= 0.95).all()
