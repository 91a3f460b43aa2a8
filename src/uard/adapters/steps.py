"""What all environments' adapters share: where ratings and sigma_m of a batch of steps come from."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np

from uard import _checks
from uard.ratings.stream import Filtered, RewardStream

RatingsFn = Callable[[Any, Any, Any, np.ndarray], Any]
"""(observations, actions, next observations, observed rewards), all (B, ...) -> ratings (B, K), NaN where missing."""
SigmaFn = Callable[[Any, Any], Any]
"""(observations, actions), both (B, ...) -> sigma_m (B,). If it has ``update(observations, actions, rewards)``, it is
told of every step afterwards."""
KeyFn = Callable[[Any, Any], Hashable]
"""(observation, action) of one step -> what tells it from other state-actions."""

INFO = {
    "raw_reward": "raw",
    "weight": "weight",
    "sigma_m": "sigma_m",
    "sigma_h": "sigma_h",
    "lambda_t": "lam",
    "abstained": "abstained",
}
"""What is put into ``info``, and where a ``Filtered`` has it."""


@dataclass
class Steps:
    """Filters batches of steps.

    Attributes:
        stream: What is known so far.
        ratings: Gives ratings; where None, those that the environment put into ``info`` are taken.
        sigma_m: Gives the ensemble's disagreement; 0 where None.
        key: Tells state-actions apart; where None, all steps differ.
    """

    stream: RewardStream = field(default_factory=RewardStream)
    ratings: RatingsFn | None = None
    sigma_m: SigmaFn | None = None
    key: KeyFn | None = None

    def keys(self, observations: Any, actions: Any, count: int) -> list[Hashable] | None:
        """Return the keys of a batch, or None where all steps differ."""
        return None if self.key is None else [self.key(_row(observations, i), actions[i]) for i in range(count)]

    def ratings_of(
        self, observations: Any, actions: Any, next_observations: Any, rewards: np.ndarray, info: Any
    ) -> Any:
        """Return the ratings of a batch, from the callable or as found in ``info``."""
        if self.ratings is None:
            return info
        ratings = _checks.as_numpy("ratings(...)", self.ratings(observations, actions, next_observations, rewards))
        if ratings.ndim != 2 or len(ratings) != len(rewards):
            allowed = f"({len(rewards)}, K), one row per step"
            raise _checks.InvalidValueError("ratings(...).shape", ratings.shape, allowed)
        return ratings

    def filter(
        self, observations: Any, actions: Any, next_observations: Any, rewards: np.ndarray, info: Any
    ) -> Filtered:
        """Filter a batch of steps; ``info`` holds the ratings (B, K) that came with it, or is None."""
        ratings = self.ratings_of(observations, actions, next_observations, rewards, info)
        sigma_m = None if self.sigma_m is None else self.sigma_m(observations, actions)
        out = self.stream(rewards, ratings, sigma_m, self.keys(observations, actions, len(rewards)))
        update = getattr(self.sigma_m, "update", None)
        if update is not None:
            update(observations, actions, rewards)
        return out


def natural_key(observation_space: gymnasium.Space[Any], action_space: gymnasium.Space[Any]) -> KeyFn | None:
    """Return the key of a world of numbered states and actions; None for all others."""
    discrete = gymnasium.spaces.Discrete
    return _numbers if isinstance(observation_space, discrete) and isinstance(action_space, discrete) else None


def _numbers(observation: Any, action: Any) -> Hashable:
    return int(observation), int(action)


def rows_of(entries: Mapping[int, Any], count: int) -> np.ndarray | None:
    """Return the ratings of some of ``count`` steps as (count, K); NaN for steps and raters that are missing.

    Raises:
        InvalidValueError: naming the environment whose ratings are no row of numbers.
    """
    rows = {}
    for i, entry in entries.items():
        try:
            row = np.array([np.nan if x is None else x for x in entry], float)
        except (TypeError, ValueError):
            raise _checks.InvalidValueError(f"ratings of environment {i}", entry, "a row of K numbers") from None
        if row.ndim != 1 or not len(row) or np.isinf(row).any():
            raise _checks.InvalidValueError(f"ratings of environment {i}", entry, "a row of K finite numbers")
        rows[i] = row
    if not rows:
        return None
    out = np.full((count, max(map(len, rows.values()))), np.nan)
    for i, row in rows.items():
        out[i, : len(row)] = row
    return out


def subset(batch: Any, chosen: np.ndarray) -> Any:
    """Return some rows of a batch of observations."""
    if isinstance(batch, dict):
        return {name: subset(part, chosen) for name, part in batch.items()}
    return tuple(subset(part, chosen) for part in batch) if isinstance(batch, tuple) else np.asarray(batch)[chosen]


def _row(batch: Any, i: int) -> Any:
    if isinstance(batch, dict):
        return {name: _row(part, i) for name, part in batch.items()}
    return tuple(_row(part, i) for part in batch) if isinstance(batch, tuple) else batch[i]
