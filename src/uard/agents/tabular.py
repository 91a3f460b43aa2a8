"""Q-learning with N heads (D1, D3, D13), as pure functions on one table.

The table is (S, A, N). The mean over heads is mu, their deviation sigma_m. The agent knows a mitigation only through
its protocol and never sees the true reward.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple, final

import jax
import jax.numpy as jnp
from jax import Array

from uard import _checks
from uard.agents.base import Agent, Family
from uard.method import uncertainty
from uard.method.abstention import Abstention


@final
@dataclass(frozen=True)
class QLearning(Agent):
    """Tabular Q-learning; the defaults are the paper's (E1-E9) where it states them.

    Examples:
        >>> baseline = QLearning(heads=1, epsilon_decay=0.99)
        >>> baseline.family, baseline.learning_rate
        ('tabular', 0.1)
        >>> QLearning(learning_rate=0.0)
        Traceback (most recent call last):
            ...
        uard._checks.InvalidValueError: learning_rate = 0.0: must be a finite number in (0, 1]

    Attributes:
        heads: Number of Q-tables N, in [1, 64]; 1 is the paper's baseline.
        learning_rate: Step size in (0, 1].
        gamma: Discount in [0, 0.9999].
        epsilon: Exploration rate of the first episode, in [0, 1].
        epsilon_decay: Its factor per episode, in [0, 1].
        epsilon_min: Its floor, in [0, 1].
        bootstrap: Chance that a head learns from a step, in [1/256, 1] (resolution 1/256); 1 for a single head. The
            paper does not say; with 1 the heads differ by their initial values only.
        init_scale: Initial values are uniform in +-init_scale, in reward units, >= 0.
        abstention: When to defer (A42, A43), if ever.
    """

    family: ClassVar[Family] = "tabular"

    heads: int = 5
    learning_rate: float = 0.1
    gamma: float = 0.95
    epsilon: float = 1.0
    epsilon_decay: float = 0.995
    epsilon_min: float = 0.05
    bootstrap: float = 1.0
    init_scale: float = 0.1
    abstention: Abstention | None = None

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        if self.abstention is not None:
            _checks.instance("abstention", self.abstention, Abstention, "an Abstention, or none")
        _checks.whole("heads", self.heads, low=1, high=64)
        _checks.number("learning_rate", self.learning_rate, low=0, high=1, open_low=True)
        _checks.number("gamma", self.gamma, low=0, high=0.9999)
        for name in ("epsilon", "epsilon_decay", "epsilon_min"):
            _checks.number(name, getattr(self, name), low=0, high=1)
        _checks.number("bootstrap", self.bootstrap, low=1 / 256, high=1)
        _checks.number("init_scale", self.init_scale, low=0)
        if self.heads == 1 and self.bootstrap < 1:
            object.__setattr__(self, "bootstrap", 1.0)


class Draws(NamedTuple):
    """Random numbers of some steps, drawn ahead: per-step draws cost 15-25 times as much."""

    explore: Array
    action: Array
    mask: Array


def init(agent: QLearning, key: Array, states: int, actions: int) -> Array:
    """Return a fresh table (S, A, N). A larger S only appends rows."""
    bits = jax.random.bits(key, (states, actions, agent.heads), jnp.uint32)
    return agent.init_scale * (2.0 * uniform(bits) - 1.0)


def uniform(bits: Array) -> Array:
    """Turn 32 random bits into a float32 in [0, 1)."""
    return (bits >> 8).astype(jnp.float32) * jnp.float32(2.0**-24)


def words(agent: QLearning) -> int:
    """Return how many 32-bit words ``draw`` needs for one step."""
    return 1 + -(-agent.heads // 4)


def draw(agent: QLearning, bits: Array, actions: int) -> Draws:
    """Turn (words, C) random bits into the draws of C steps."""
    heads = jnp.arange(agent.heads)
    bytes_ = (bits[1:][heads // 4] >> (8 * (heads % 4).astype(jnp.uint32))[:, None]) & 255
    chosen = bytes_.astype(jnp.float32) < agent.bootstrap * 256.0
    action = (((bits[0] & 255) * actions) >> 8).astype(jnp.int32)  # the eight bits that ``uniform`` leaves
    return Draws(uniform(bits[0]), action, chosen.astype(jnp.float32).T)


def mean_and_deviation(q: Array) -> tuple[Array, Array]:
    """Return mu and sigma_m of values (..., N); a single head never disagrees."""
    if q.shape[-1] == 1:
        return q[..., 0], jnp.zeros(q.shape[:-1], q.dtype)
    return q.mean(-1), uncertainty.sigma_model(q)


def next_epsilon(agent: QLearning, epsilon: Array) -> Array:
    """Return the next episode's exploration rate."""
    return jnp.maximum(agent.epsilon_decay * epsilon, agent.epsilon_min)
