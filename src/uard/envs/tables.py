"""A small MDP (Markov decision process) as tables, and its one-step dynamics.

``Task`` is what an agent meets. ``HiddenTruth`` is for evaluation only and travels apart from it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

Array = Any
MIN_STATES = 100  # tables are padded to this many states, so that grids up to 10x10 share one program


class Task(NamedTuple):
    """A deterministic episodic task with S states and A actions.

    Attributes:
        next_state: (S, A) integers.
        reward: (S, A) observed (proxy) reward.
        terminal: (S, A), whether the step ends the episode.
        start: Starting state; several, (n,), take turns.
        horizon: Steps after which an episode is cut off.
        doubt: (S, A) deviation between the members of the model that made the observed reward; None for a reward that
            was written by hand.
    """

    next_state: Array
    reward: Array
    terminal: Array
    start: Array
    horizon: Array
    doubt: Array | None = None


class HiddenTruth(NamedTuple):
    """What only the evaluation sees: true reward, hack flag and arrival at the goal; (S, A), or of one step.

    No agent, model of ratings or mitigation takes it as an argument.
    """

    reward: Array
    hack: Array
    goal: Array


def at(table: Array, index: Array) -> Array:
    """Return ``table[index]`` for an index that is known to be in range (in JAX).

    Examples:
        >>> at(np.array([3.0, 5.0], np.float32), 1).item()
        5.0
    """
    from jax import lax

    return lax.dynamic_index_in_dim(table, index, 0, keepdims=False, allow_negative_indices=False)


def step(task: Task, state: Array, time: Array, action: Array) -> tuple[Array, Array, Array, Array]:
    """Return (next state, observed reward, terminated, truncated) of step number ``time`` (0-based; in JAX).

    Examples:
        >>> from uard.envs.grids.trapgrid import TrapGrid
        >>> task = TrapGrid(size=3, traps=[(1, 0)]).task()
        >>> [x.item() for x in step(task, state=0, time=0, action=1)]  # down, into the trap
        [3, 4.0, False, False]
    """
    place = state * task.reward.shape[1] + action
    terminated = at(task.terminal.reshape(-1), place)
    truncated = (time + 1 >= task.horizon) & ~terminated
    return at(task.next_state.reshape(-1), place), at(task.reward.reshape(-1), place), terminated, truncated


def pad(tables: Any, states: int) -> Any:
    """Append unreachable states so that tables of several sizes fit one compiled program.

    Examples:
        >>> from uard.envs.grids.trapgrid import TrapGrid
        >>> task = pad(TrapGrid(size=3).task(), states=100)
        >>> task.reward.shape, task.start.item()
        ((100, 4), 0)

    Args:
        tables: A ``Task``, a ``HiddenTruth`` or a ``RatingLaw``; what has fewer than two axes stays as it is.
        states: How many states they are to have, at least as many as they have.
    """

    def grow(table: Any) -> Any:
        if table is None or isinstance(table, tuple) or np.ndim(table) < 2:
            return table
        table = np.asarray(table)
        extra = np.zeros((states - table.shape[0], *table.shape[1:]), table.dtype)
        return np.concatenate([table, extra])

    return type(tables)(*(grow(t) for t in tables))
