"""Random Fourier features of states and actions: what makes a linear regression curve [Rahimi and Recht 2007]."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import gymnasium
import numpy as np

from uard import _checks

if TYPE_CHECKING:
    from jaxtyping import Float

BOUND = 10.0  # coordinates without finite bounds are cut off here


class RandomFeatures:
    """Features of state-actions, each member's own.

    Examples:
        >>> place, push = gymnasium.spaces.Box(-1.0, 1.0, (2,)), gymnasium.spaces.Discrete(2)
        >>> features = RandomFeatures(place, push, 3, 16, np.random.default_rng(0))
        >>> features(np.zeros((5, 2)), np.ones(5, int)).shape
        (3, 5, 16)
    """

    def __init__(
        self,
        observation_space: gymnasium.Space[Any],
        action_space: gymnasium.Space[Any],
        members: int,
        features: int,
        random: np.random.Generator,
    ):
        """Draw the features.

        Args:
            observation_space: Of one environment.
            action_space: Of one environment.
            members: N >= 1.
            features: Of each member, in [1, 4096].
            random: What they are drawn from.

        Raises:
            InvalidValueError: naming the argument, its value and what is allowed; a space of which a sample is no row
                of numbers (``Sequence``, ``Graph``).
        """
        for field, space in (("observation_space", observation_space), ("action_space", action_space)):
            if not space.is_np_flattenable:
                raise _checks.InvalidValueError(field, space, "one whose samples have a fixed number of numbers")
        _checks.whole("features", features, low=1, high=4096)
        self._spaces = observation_space, action_space
        width = sum(gymnasium.spaces.flatdim(space) for space in self._spaces)
        self._directions = random.normal(0.0, 1.0 / np.sqrt(width), (members, width, features))
        self._phases = random.uniform(0.0, 2.0 * np.pi, (members, 1, features))

    def __call__(self, observations: Any, actions: Any) -> Float[np.ndarray, "N B F"]:
        """Return the features of a batch of state-actions, of mean square 1.

        Raises:
            InvalidValueError: a state or an action is not finite, or none of its space's numbers.
        """
        flat = np.concatenate([_flat(s, x) for s, x in zip(self._spaces, (observations, actions), strict=True)], axis=1)
        _checks.finite("observations and actions", flat)
        projected = np.einsum("bw,nwf->nbf", flat, self._directions) * np.sqrt(flat.shape[1])
        return np.cos(projected + self._phases) * np.sqrt(2.0 / self._phases.shape[-1])


def _flat(space: gymnasium.Space[Any], batch: Any) -> Float[np.ndarray, "B width"]:
    """Return a batch as numbers of size about one."""
    if isinstance(space, gymnasium.spaces.Discrete):
        numbers = np.asarray(batch).reshape(-1) - int(space.start)
        if numbers.dtype.kind not in "iu" or numbers.min(initial=0) < 0 or numbers.max(initial=0) >= space.n:
            raise _checks.InvalidValueError("batch", batch, f"whole numbers of {space}")
        return np.eye(int(space.n))[numbers]
    if isinstance(space, gymnasium.spaces.Box):
        flat = np.asarray(batch, float).reshape(len(batch), -1)
        box = cast("Any", space)  # the precision of its bounds is not in its type
        low, high = (np.asarray(bound, float).ravel() for bound in (box.low, box.high))
        bounded = np.isfinite(low) & np.isfinite(high)
        low, high = np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)
        middle, half = (low + high) / 2, (high - low) / 2
        return np.clip((flat - middle) / np.where(half > 0, half, 1.0), -BOUND, BOUND)
    rows = gymnasium.vector.utils.iterate(gymnasium.vector.utils.batch_space(space, _length(batch)), batch)
    return np.array([gymnasium.spaces.flatten(space, row) for row in rows], float)


def _length(batch: Any) -> int:
    """Return B of a batch that may be a dictionary or a tuple of batches."""
    while isinstance(batch, dict | tuple):
        parts = cast("dict[Any, Any] | tuple[Any, ...]", batch)
        batch = next(iter(parts.values())) if isinstance(parts, dict) else parts[0]
    return len(batch)
