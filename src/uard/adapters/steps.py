"""What all environments' adapters share: where ratings and sigma_m of a batch of steps come from."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

import gymnasium
import numpy as np

from uard import _checks
from uard.ratings.stream import Filtered, RewardStream

if TYPE_CHECKING:
    from jaxtyping import Float

RatingsFn = Callable[[Any, Any, Any, np.ndarray], Any]
"""(observations, actions, next observations, observed rewards), all (B, ...) -> ratings (B, K), NaN where missing."""
SigmaFn = Callable[[Any, Any], Any]
"""(observations, actions), both (B, ...) -> sigma_m (B,). If it has ``update(observations, actions, rewards)``, that
is called with every step afterwards."""
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

    Observations and actions may be arrays (B, ...) or dictionaries and tuples of such; of a space that has no arrays
    (``Sequence``, ``Graph``, ``OneOf``) they are arrays (B,) of objects.

    Examples:
        >>> steps = Steps(ratings=lambda observations, actions, next_observations, rewards: rewards[:, None])
        >>> now, act, then = np.zeros((2, 4)), np.array([0, 1]), np.ones((2, 4))
        >>> steps.filter(now, act, then, np.array([0.0, 1.0]), None).rated.tolist()
        [True, True]

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

    @property
    def reads_steps(self) -> bool:
        """Whether observations and actions are looked at."""
        return self.ratings is not None or self.sigma_m is not None or self.key is not None

    def keys(self, observations: Any, actions: Any, count: int) -> list[Hashable] | None:
        """Return the keys of a batch of ``count`` steps, or None where all steps differ."""
        if self.key is None:
            return None
        if self.key is _numbers and type(observations) is np.ndarray and type(actions) is np.ndarray:
            numbers = observations.tolist(), actions.tolist()
            if all(type(x) is int for part in numbers for x in part):
                return list(zip(*numbers, strict=True))
        return [_ask("key", self.key, _row(observations, i), _row(actions, i)) for i in range(count)]

    def ratings_of(
        self,
        observations: Any,
        actions: Any,
        next_observations: Any,
        rewards: Float[np.ndarray, " B"],
        info: Float[np.ndarray, "B K"] | None,
    ) -> Float[np.ndarray, "B K"] | None:
        """Return the ratings of a batch, from the callable or as found in ``info``; NaN where one is missing.

        Raises:
            InvalidValueError: what the callable gave is no (B, K) array of numbers.
        """
        if self.ratings is None:
            return info
        said = _ask("ratings", self.ratings, observations, actions, next_observations, rewards)
        ratings = _checks.as_numpy("ratings(...)", said)
        if ratings.ndim != 2 or len(ratings) != len(rewards):
            allowed = f"({len(rewards)}, K), one row per step"
            raise _checks.InvalidValueError("ratings(...).shape", ratings.shape, allowed)
        return ratings

    def sigma_of(self, observations: Any, actions: Any) -> Any:
        """Return the ensemble's disagreement on a batch, None where there is no ensemble.

        Raises:
            InvalidValueError: the callable gave no numbers.
        """
        if self.sigma_m is None:
            return None
        return _checks.as_numpy("sigma_m(...)", _ask("sigma_m", self.sigma_m, observations, actions))

    def filter(
        self,
        observations: Any,
        actions: Any,
        next_observations: Any,
        rewards: Float[np.ndarray, " B"],
        info: Float[np.ndarray, "B K"] | None,
    ) -> Filtered:
        """Filter a batch of steps.

        Args:
            observations: What the actions were taken on.
            actions: (B, ...).
            next_observations: What they led to, before any reset.
            rewards: Observed rewards.
            info: The ratings that came with the steps, NaN where one is missing, or None.

        Raises:
            InvalidValueError: for rewards, ratings or a sigma_m that no training should be fed.
        """
        ratings = self.ratings_of(observations, actions, next_observations, rewards, info)
        sigma_m = self.sigma_of(observations, actions)
        out = self.stream(rewards, ratings, sigma_m, self.keys(observations, actions, len(rewards)))
        update = getattr(self.sigma_m, "update", None)
        if update is not None:
            update(observations, actions, rewards)
        return out


def natural_key(observation_space: gymnasium.Space[Any], action_space: gymnasium.Space[Any]) -> KeyFn | None:
    """Return the key of a world of numbered states and actions; None for all others.

    Examples:
        >>> key = natural_key(gymnasium.spaces.Discrete(9), gymnasium.spaces.Discrete(4))
        >>> key(np.int64(7), np.int64(2))
        (7, 2)
    """
    discrete = gymnasium.spaces.Discrete
    return _numbers if isinstance(observation_space, discrete) and isinstance(action_space, discrete) else None


def _numbers(observation: Any, action: Any) -> Hashable:
    return int(observation), int(action)


def rows_of(entries: Mapping[int, Any], count: int) -> Float[np.ndarray, "B K"] | None:
    """Return the ratings of some of ``count`` steps as an array; NaN for steps and raters that are missing.

    Examples:
        >>> rows_of({1: [0.5, None]}, count=2).tolist()
        [[nan, nan], [0.5, nan]]

    Args:
        entries: The ratings of a step, by its number.
        count: B.

    Returns:
        None if there are none at all.

    Raises:
        InvalidValueError: naming the environment whose ratings are no list, tuple or array of numbers.
    """
    whole = _stacked([*entries.values()]) if len(entries) == count and [*entries] == [*range(count)] else None
    if whole is not None:
        return whole
    rows = {i: _ratings_row(f"ratings of environment {i}", entry) for i, entry in entries.items() if entry is not None}
    if not rows:
        return None
    out = np.full((count, max(map(len, rows.values()))), np.nan)
    for i, row in rows.items():
        out[i, : len(row)] = row
    return out


def with_row(batch: Any, i: Any, row: Any) -> Any:
    """Return a copy of a batch with one row replaced by a batch of one.

    Examples:
        >>> with_row(np.array([1, 2]), 1, np.array([9])).tolist()
        [1, 9]
    """
    if isinstance(batch, dict):
        return {name: with_row(part, i, row[name]) for name, part in cast("dict[str, Any]", batch).items()}
    if isinstance(batch, tuple):
        return tuple(with_row(part, i, x) for part, x in zip(cast("Any", batch), row, strict=True))
    out = batch.copy()
    out[i] = row[0]
    return out


def _stacked(entries: list[Any]) -> Float[np.ndarray, "B K"] | None:
    """Return the usual ratings, as many numbers from every step, in one go; None for those to be looked at.

    Whatever is special is left to those who look at each step's entry, and say what is wrong with it.
    """
    kinds = set(map(type, entries))
    if kinds == {np.ndarray}:
        if any(x.dtype.char != "d" or x.ndim != 1 or len(x) != len(entries[0]) for x in entries):
            return None
    elif not (kinds == {list} and set(map(type, entries[0])) == {float} and len({*map(len, entries)}) == 1):
        return None
    try:
        stacked = np.array(entries)
    except ValueError:  # lists in lists
        return None
    usual = stacked.dtype.char == "d" and stacked.ndim == 2 and stacked.size > 0
    return stacked if usual and (_checks.is_small(stacked) or not np.isinf(stacked).any()) else None


def _ratings_row(field: str, entry: Any) -> Float[np.ndarray, " K"]:
    allowed = "a row of K finite numbers (None or NaN is a missing one)"
    given: Any = entry
    try:
        if isinstance(entry, list | tuple) or getattr(getattr(given, "dtype", None), "kind", "") == "O":
            given = [np.nan if x is None else x for x in given]
        row = _checks.as_numpy(field, given)
    except (TypeError, _checks.InvalidValueError):  # an array of objects may have no dimensions
        raise _checks.InvalidValueError(field, cast("object", entry), allowed) from None
    if row.ndim != 1 or not len(row) or np.isinf(row).any():
        raise _checks.InvalidValueError(field, cast("object", entry), allowed)
    return row


def refuse_filtered(info: Mapping[str, Any], field: str) -> None:
    """Refuse the ``info`` of a step that has been filtered already.

    Examples:
        >>> refuse_filtered({"ratings": [1.0], "weight": 70.0}, "info")

    Raises:
        InvalidValueError: all that this package puts into ``info`` is there.
    """
    if "raw_reward" in info and all(name in info for name in INFO):
        allowed = "not there yet: something inside filters already, and rewards would be filtered twice"
        raise _checks.InvalidValueError(field, info["raw_reward"], allowed)


def _ask(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call what a user gave; a StopIteration of theirs must not end somebody's loop in silence."""
    try:
        return function(*arguments)
    except StopIteration as error:
        raise RuntimeError(f"{name}(...) raised StopIteration") from error


def batch_of(space: gymnasium.Space[Any], one: Any) -> Any:
    """Return a single observation or action as a batch of one; arrays are copied.

    Examples:
        >>> batch_of(gymnasium.spaces.Tuple([gymnasium.spaces.Discrete(2)] * 2), (1, 0))
        (array([1]), array([0]))
    """
    spaces = gymnasium.spaces
    if isinstance(space, spaces.Dict):
        return {name: batch_of(part, one[name]) for name, part in cast("Any", space).spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(batch_of(part, x) for part, x in zip(cast("Any", space).spaces, one, strict=True))
    if isinstance(space, ARRAYS):
        return np.array(one)[None]
    return _objects([one])


def arrays_of(space: gymnasium.Space[Any], batch: Any) -> Any:
    """Return a batch as Gymnasium's vector environments have it, copied and with arrays only.

    Examples:
        >>> letters = gymnasium.spaces.Sequence(gymnasium.spaces.Discrete(2))
        >>> arrays_of(letters, ((0, 1), (1,))).tolist()  # one sequence from each environment
        [(0, 1), (1,)]
    """
    spaces = gymnasium.spaces
    if isinstance(space, spaces.Dict):
        return {name: arrays_of(part, batch[name]) for name, part in cast("Any", space).spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(arrays_of(part, x) for part, x in zip(cast("Any", space).spaces, batch, strict=True))
    return np.array(batch) if isinstance(space, ARRAYS) else _objects(batch)


_S = gymnasium.spaces
ARRAYS = (_S.Box, _S.Discrete, _S.MultiDiscrete, _S.MultiBinary, _S.Text)
"""Spaces of which a batch is an array."""


def _objects(items: Any) -> np.ndarray:
    out = np.empty(len(items), object)
    for i, item in enumerate(items):
        out[i] = item
    return out


def map_batch(batch: Any, function: Callable[[Any], Any]) -> Any:
    """Return a batch of observations with a function applied to each of its arrays.

    Examples:
        >>> map_batch({"place": np.array([1, 2]), "speed": np.array([3, 4])}, lambda x: x[1:].tolist())
        {'place': [2], 'speed': [4]}

    Args:
        batch: An array, or a dictionary or tuple of batches.
        function: Given each array.
    """
    if isinstance(batch, dict):
        parts = cast("dict[str, Any]", batch)
        return {name: map_batch(part, function) for name, part in parts.items()}
    if isinstance(batch, tuple):
        return tuple(map_batch(part, function) for part in cast("tuple[Any, ...]", batch))
    return function(batch)


def _row(batch: Any, i: int) -> Any:
    return map_batch(batch, lambda x: x[i])


def subset(batch: Any, chosen: np.ndarray) -> Any:
    """Return some rows of a batch of observations.

    Examples:
        >>> subset({"place": np.array([1, 2])}, np.array([1]))["place"].tolist()
        [2]

    Args:
        batch: As for ``map_batch``.
        chosen: Numbers of the rows, or one number in an array of no dimensions.
    """
    return map_batch(batch, lambda x: np.asarray(x)[chosen])
