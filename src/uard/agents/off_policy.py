"""What an agent that learns from a replay buffer is to a training loop."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

from jax import Array

from uard.agents.networks import Network

Backup = Literal["greedy", "consistent"]  # which value the target takes: the best, or that of the best score


class Batch(NamedTuple):
    """Transitions drawn from the buffer.

    Attributes:
        observation: (B, features), or (B,) whole numbers that stand for one-hot rows.
        action: (B,).
        following: Alike, the observation after the step.
        terminated: (B,), whether the step ended the episode; a cut-off at the horizon does not count.
        mask: (B, N), which members learn from a transition (0 or 1).
    """

    observation: Array
    action: Array
    following: Array
    terminated: Array
    mask: Array


class Watched(NamedTuple):
    """What is watched for divergence after an update: the loss, and the largest absolute value it saw."""

    loss: Array
    largest: Array


# Of the ensemble's disagreement about the batch's state-actions (B,), the reward to learn from and its weight (B,).
Judge = Callable[[Array], tuple[Any, Any]]
# Of mean values (B, A), their deviations (B, A) and the observations (B, features), the mitigation's scores (B, A).
Prefer = Callable[[Array, Array, Array], Array]


@runtime_checkable
class OffPolicy(Protocol):
    """A learner from a replay buffer; its methods are pure.

    Attributes:
        network: Gives the unit of values.
        buffer: Transitions kept.
        batch: Transitions per update.
        warmup: Steps before the first update.
        bootstrap: Chance that a member learns from a transition.
    """

    network: Network
    buffer: int
    batch: int
    warmup: int
    bootstrap: float

    @property
    def members(self) -> int:
        """Number of members of the ensemble."""
        ...

    def init(self, key: Array, features: int, actions: int) -> Any:
        """Return a fresh state: any pytree."""
        ...

    def values(self, state: Any, observations: Array, key: Array) -> Array:
        """Return all members' values, (N, B, A), of observations (B, features)."""
        ...

    def act(self, state: Any, observation: Array, prefer: Prefer, episode: Array, key: Array) -> Array:
        """Return an exploring action for one observation (features,) in the given episode (0-based)."""
        ...

    def greedy(self, state: Any, observation: Array, prefer: Prefer, key: Array) -> Array:
        """Return the action without exploration."""
        ...

    def update(
        self,
        state: Any,
        batch: Batch,
        judge: Judge,
        prefer: Prefer,
        prefer_here: Prefer,
        backup: Backup,
        key: Array,
    ) -> tuple[Any, Watched]:
        """Learn from one batch; ``prefer`` scores the observations after its steps, ``prefer_here`` those before."""
        ...
