"""The compiled dynamics, the Gymnasium environment and rules written by hand agree step by step."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from uard.envs.grids.trapgrid import TrapGrid
from uard.envs.gym import Evaluation, GridEnv
from uard.envs.tables import HiddenTruth, Task, pad, step

from .by_hand import Traps

SIZES = range(2, 9)
STATES = max(SIZES) ** 2
LENGTH = 120
HEADINGS = ("state", "reward", "terminated", "truncated", "true reward", "hack", "goal")


@jax.jit
def compiled(task: Task, truth: HiddenTruth, actions: jax.Array) -> tuple[jax.Array, ...]:
    """Follow the actions, starting anew after each episode's end."""

    def one(carry: tuple[jax.Array, jax.Array], action: jax.Array) -> tuple[Any, Any]:
        state, time = carry
        next_state, reward, terminated, truncated = step(task, state, time, action)
        done = terminated | truncated
        hidden = truth.reward[state, action], truth.hack[state, action], truth.goal[state, action]
        carry = jnp.where(done, task.start, next_state), jnp.where(done, 0, time + 1)
        return carry, (next_state, reward, terminated, truncated, *hidden)

    return jax.lax.scan(one, (jnp.asarray(task.start, jnp.int32), jnp.int32(0)), actions)[1]


def by_hand(grid: TrapGrid, actions: np.ndarray) -> list[tuple]:
    """Follow the actions under rules written by hand, and see that the Gymnasium environment does the same."""
    rules, env = Traps(grid), GridEnv(grid)
    random = np.random.default_rng()  # nothing is drawn
    env.reset()
    state, time, rows = grid.start, 0, []
    for action in actions.tolist():
        state, reward, terminated, true_reward, hack = rules.step(state, action, random)
        time += 1
        truncated = not terminated and time == grid.horizon
        seen = rules.observe(state)
        assert env.step(action) == (seen, reward, terminated, truncated, {"evaluation": Evaluation(true_reward, hack)})
        hidden = np.float32(true_reward), hack, state == grid.goal
        rows.append((seen, np.float32(reward), terminated, truncated, *hidden))
        if terminated or truncated:
            state, time = grid.start, 0
            env.reset()
    return rows


rewards = st.floats(-20, 20, width=32)


@st.composite
def grids(draw: st.DrawFn) -> TrapGrid:
    size = draw(st.sampled_from(SIZES))
    cells = draw(st.permutations([(r, c) for r in range(size) for c in range(size)]))
    start, goal, *rest = cells
    return TrapGrid(
        size=size,
        start=start,
        goal=goal,
        traps=tuple(rest[: draw(st.integers(0, min(6, len(rest))))]),
        trap_reward=draw(rewards),
        true_trap_reward=draw(rewards),
        goal_reward=draw(rewards),
        step_reward=draw(rewards),
        horizon=draw(st.integers(1, 50)),
        legitimate=draw(st.booleans()),
    )


@settings(max_examples=60)
@given(grids(), st.lists(st.integers(0, 3), min_size=LENGTH, max_size=LENGTH).map(np.int32))
@example(TrapGrid(size=2), np.tile(np.int32([1, 3]), LENGTH // 2))
@example(TrapGrid(size=2, horizon=2), np.tile(np.int32([1, 3]), LENGTH // 2))
@example(TrapGrid(size=2, traps=((0, 1),), horizon=1), np.full(LENGTH, 3, np.int32))
def test_all_three_tell_the_same_story(grid: TrapGrid, actions: np.ndarray):
    columns = compiled(pad(grid.task(), STATES), pad(grid.truth(), STATES), actions)
    expected = zip(*by_hand(grid, actions), strict=True)
    for name, got, want in zip(HEADINGS, columns, expected, strict=True):
        np.testing.assert_array_equal(got, want, err_msg=name)

    assert compiled._cache_size() == 1, "every grid up to STATES shares one program"


def test_padding_appends_what_nobody_reaches():
    task = TrapGrid(size=3).task()
    padded = pad(task, 20)
    assert padded.next_state.shape == (20, 4)
    np.testing.assert_array_equal(padded.next_state[:9], task.next_state)
    assert padded.next_state[:9].max() < 9
    assert (padded.start, padded.horizon) == (task.start, task.horizon)
    assert [np.asarray(t).dtype for t in padded] == [np.asarray(t).dtype for t in task]
