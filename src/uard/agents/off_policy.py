"""What an agent that learns from a replay buffer is to a training loop."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, Literal, NamedTuple

from jax import Array

from uard.agents.base import Agent, Family
from uard.agents.networks import Network

Backup = Literal["greedy", "consistent"]  # which value the target takes: the best, or that of the best score


class Transitions(NamedTuple):
    """Transitions drawn from the buffer.

    Attributes:
        observation: (B, features), or (B,) whole numbers that stand for one-hot rows.
        action: (B,).
        next_observation: Alike, the observation after the step.
        terminated: (B,), whether the step ended the episode; a cut-off at the horizon does not count.
        mask: (B, N), which members learn from a transition (0 or 1).
    """

    observation: Array
    action: Array
    next_observation: Array
    terminated: Array
    mask: Array


class UpdateInfo(NamedTuple):
    """What is looked at for divergence after an update: the loss, and the largest absolute value it saw."""

    loss: Array
    largest: Array


# Of the ensemble's disagreement about the batch's state-actions (B,), the reward to learn from and its weight (B,).
RewardFn = Callable[[Array], tuple[Any, Any]]
# Of mean values (B, A), their deviations (B, A) and the observations (B, features), the mitigation's scores (B, A).
ScoreFn = Callable[[Array, Array, Array], Array]


class OffPolicy(Agent):
    """A learner from a replay buffer, with discrete actions; its methods are pure.

    Examples:
        >>> import jax
        >>> from uard.agents.networks import Ensemble
        >>> from uard.agents.value import DeepQ
        >>> agent, key = DeepQ(ensemble=Ensemble("full", members=3)), jax.random.key(0)
        >>> state = jax.eval_shape(lambda: agent.init(key, features=4, actions=2))  # shapes only
        >>> jax.eval_shape(agent.values, state, jax.numpy.zeros((5, 4)), key).shape
        (3, 5, 2)

    Attributes:
        network: Gives the unit of values.
        buffer: Transitions kept, >= ``batch``.
        batch: Transitions per update, >= 1.
        warmup: Steps before the first update, >= 0.
        bootstrap: Chance that a member learns from a transition, in [0, 1].
    """

    family: ClassVar[Family] = "replay"
    network: Network
    buffer: int
    batch: int
    warmup: int
    bootstrap: float

    @property
    @abstractmethod
    def members(self) -> int:
        """Number of members of the ensemble."""

    @abstractmethod
    def init(self, key: Array, features: int, actions: int) -> Any:
        """Return a fresh state: any pytree."""

    @abstractmethod
    def values(self, state: Any, observations: Array, key: Array) -> Array:
        """Return all members' values, (N, B, A), of observations (B, features)."""

    @abstractmethod
    def act(self, state: Any, observation: Array, score_fn: ScoreFn, episode: Array, key: Array) -> Array:
        """Return an exploring action, () int32, for one observation (features,) in the given episode (0-based)."""

    @abstractmethod
    def greedy(self, state: Any, observation: Array, score_fn: ScoreFn, key: Array) -> Array:
        """Return the action without exploration, () int32."""

    @abstractmethod
    def update(
        self,
        state: Any,
        batch: Transitions,
        reward_fn: RewardFn,
        score_fn: ScoreFn,
        score_fn_here: ScoreFn,
        backup: Backup,
        key: Array,
    ) -> tuple[Any, UpdateInfo]:
        """Learn from a batch; ``score_fn`` scores the observations after its steps, ``score_fn_here`` those before."""
