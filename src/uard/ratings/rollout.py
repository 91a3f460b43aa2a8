"""A log from random steps in a Gymnasium environment."""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from uard import _checks
from uard.ratings.log import LABELS, RatingLog, bad_cell


def rollout(env: Any, steps: int = 1000, seed: int = 0) -> RatingLog:
    """Take random actions in a Gymnasium environment and log its rewards and their ratings.

    Read from ``info``: ``ratings``, K numbers; ``sigma_m``; and ``evaluation.true_reward`` as the environments of this
    package give it. Where states and actions are whole numbers a row's item is its state-action.

    Examples:
        >>> import gymnasium, uard.envs
        >>> log = rollout(gymnasium.make("uard/TrapGrid6-v0", panel="main"), steps=20)
        >>> log.ratings.shape, log.source
        ((20, 3), 'uard/TrapGrid6-v0, 20 random steps, seed 0')

    Args:
        env: A ``gymnasium.Env``; it is not closed.
        steps: Number of steps, in 1..10 000 000.
        seed: Seed of the environment and of the actions, >= 0.

    Raises:
        InvalidValueError: the number of ratings or what ``info`` holds changes from one step to another, or a reward is
            no number.
    """
    _checks.whole("steps", steps, low=1, high=10_000_000)
    _checks.whole("seed", seed, low=0)
    columns = _drop_absent(_random_steps(env, steps, seed))
    widths = [np.shape(v) for v in columns.get("ratings", ())]
    for row, width in enumerate(widths):
        if len(width) != 1 or width != widths[0]:
            raise bad_cell("rollout", row, "ratings", columns["ratings"][row], "a row of K ratings, as in the first")
    name = "rollout" if env.spec is None else env.spec.id
    source = f"{name}, {steps} random steps, seed {seed}"
    arrays: dict[str, Any] = {"ratings": np.zeros((steps, 0))}
    arrays |= {name: np.asarray(column) for name, column in columns.items()}
    return RatingLog(**arrays, source=source)


def _random_steps(env: Any, steps: int, seed: int) -> dict[str, list[Any]]:
    """Return the columns of a log; None where ``info`` holds nothing."""
    env.action_space.seed(seed)
    columns: dict[str, list[Any]] = {n: [] for n in ("reward", "ratings", "sigma_m", "true_reward", *LABELS)}
    state, _ = env.reset(seed=seed)
    episode = step = 0
    for _ in range(steps):
        action = env.action_space.sample()
        next_state, reward, terminated, truncated, info = env.step(action)
        found = {"ratings": _with_nan(info.get("ratings")), "sigma_m": info.get("sigma_m")}
        found["true_reward"] = info["evaluation"].true_reward if "evaluation" in info else None
        whole = isinstance(state, int | np.integer) and isinstance(action, int | np.integer)
        found["item"] = f"state {state}, action {action}" if whole else None
        for name, value in (found | {"reward": _one_number(step, reward), "episode": episode, "step": step}).items():
            columns[name].append(value)
        state, step = next_state, step + 1
        if terminated or truncated:
            state, _ = env.reset()
            episode, step = episode + 1, 0
    return columns


def _with_nan(ratings: Any) -> Any:
    """Return a list of ratings with NaN for None, where one is missing; what is no list as it is."""
    listed = isinstance(ratings, list | tuple)
    return [np.nan if x is None else x for x in cast("list[Any]", ratings)] if listed else ratings


def _one_number(row: int, reward: Any) -> float:
    try:
        return float(_checks.as_numpy("reward", reward))
    except (TypeError, ValueError):
        raise bad_cell("rollout", row, "reward", reward, "one number") from None


def _drop_absent(columns: dict[str, list[Any]]) -> dict[str, list[Any]]:
    """Leave out the columns that are None everywhere; one that is so in some rows only is an error."""
    for name, column in columns.items():
        absent = [v is None for v in column]
        if any(absent) and not all(absent):
            row = absent.index(not absent[0])
            raise bad_cell("rollout", row, name, column[row], "in info at every step, or at none")
    return {name: column for name, column in columns.items() if column[0] is not None}
