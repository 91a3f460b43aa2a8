"""The value family: DQN, Ensemble-DQN, CQL and SUNRISE are one learner with different numbers (D4, D7, D10, D12).

* DQN [Mnih et al. 2015]: one member.
* Ensemble-DQN: bootstrapped members [Osband et al. 2016], acting on their mean.
* CQL [Kumar et al. 2020, eq. 4, the CQL(H) term]: ``conservative`` times the gap between the soft maximum of the values
  and the value of the action in the buffer.
* SUNRISE [Lee et al. 2021]: acts on mu + ``ucb`` sigma, and weighs each backup by sigmoid(-``temperature`` sigma') +
  0.5, sigma' the deviation of the members' targets at the next state-action.
* UARD is not here: it is a mitigation, and works with each of them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

from uard import _checks
from uard._support import fields
from uard.agents import networks
from uard.agents.networks import SINGLE, Ensemble, Network, Weights
from uard.agents.off_policy import Backup, OffPolicy, RewardFn, ScoreFn, Transitions, UpdateInfo


@dataclass(frozen=True)
class DeepQ(OffPolicy):
    """Deep Q-learning with an ensemble; the defaults are DQN's and the paper's (E2-E9) where it states them.

    Examples:
        >>> sunrise = DeepQ(ensemble=Ensemble("full", members=5), ucb=1.0, temperature=10.0)
        >>> sunrise.members, DeepQ(conservative=1.0).members  # the latter is CQL
        (5, 1)
        >>> DeepQ(batch=64, buffer=10)
        Traceback (most recent call last):
            ...
        uard._checks.InvalidValueError: buffer = 10: must be a whole number in [64, 1e+07]

    Attributes:
        network: Size and step size, the same for all deep agents.
        ensemble: How many members, and of which kind.
        gamma: Discount in [0, 0.9999].
        epsilon: Exploration rate of the first episode, in [0, 1]; every episode multiplies it by ``epsilon_decay``,
            down to ``epsilon_min``.
        epsilon_decay: See ``epsilon``; in [0, 1].
        epsilon_min: See ``epsilon``; in [0, 1].
        buffer: Transitions kept, >= ``batch``.
        batch: Transitions per update, in [1, 4096]; there is one update per step.
        warmup: Steps before the first update, >= 0.
        target_every: Updates between copies into the target network, >= 1.
        bootstrap: Chance that a member learns from a transition, in [1/256, 1]; 1 for a single member.
        conservative: CQL's alpha >= 0.
        ucb: SUNRISE's exploration bonus >= 0, in deviations.
        temperature: SUNRISE's temperature of backup weights >= 0; 0 weighs all alike.
    """

    network: Network = field(default_factory=Network)
    ensemble: Ensemble = SINGLE
    gamma: float = 0.95
    epsilon: float = 1.0
    epsilon_decay: float = 0.995
    epsilon_min: float = 0.05
    buffer: int = 10_000
    batch: int = 64
    warmup: int = 500
    target_every: int = 250
    bootstrap: float = 0.5
    conservative: float = 0.0
    ucb: float = 0.0
    temperature: float = 0.0

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        fields.check(self)
        _checks.number("gamma", self.gamma, low=0, high=0.9999)
        for name in ("epsilon", "epsilon_decay", "epsilon_min"):
            _checks.number(name, getattr(self, name), low=0, high=1)
        _checks.whole("batch", self.batch, low=1, high=4096)
        _checks.whole("buffer", self.buffer, low=self.batch, high=10_000_000)
        _checks.whole("warmup", self.warmup, low=0, high=10_000_000)
        _checks.whole("target_every", self.target_every, low=1, high=1_000_000)
        _checks.number("bootstrap", self.bootstrap, low=1 / 256, high=1)
        for name in ("conservative", "ucb", "temperature"):
            _checks.number(name, getattr(self, name), low=0)
        if self.ensemble.members == 1 and self.bootstrap < 1:
            object.__setattr__(self, "bootstrap", 1.0)

    @property
    def members(self) -> int:
        """Number of members."""
        return self.ensemble.members

    def init(self, key: Array, features: int, actions: int) -> State:
        """Return fresh networks."""
        weights = networks.init(self.ensemble, self.network, key, features, actions)
        optimiser = optax.adam(self.network.learning_rate).init(weights.layers)
        return State(weights, jax.tree.map(jnp.copy, weights.layers), optimiser, jnp.int32(0))

    def values(self, state: State, observations: Array, key: Array | None = None) -> Array:
        """Return all members' values (N, B, A)."""
        return networks.values(self.ensemble, self.network, state.weights, observations, key)

    def read(self, state: State, observations: Array, key: Array) -> tuple[Array, Array]:
        """Return mu and sigma_m, (B, A) each."""
        return networks.mean_and_deviation(self.values(state, observations, key))

    def act(self, state: State, observation: Array, score_fn: ScoreFn, episode: Array, key: Array) -> Array:
        """Return an epsilon-greedy action on the mitigation's scores (plus SUNRISE's bonus)."""
        explore, choice, dropout = jax.random.split(key, 3)
        mu, sigma = self.read(state, observation[None], dropout)
        scores = score_fn(mu, sigma, observation[None]) + self.ucb * sigma
        rate = jnp.maximum(self.epsilon * self.epsilon_decay ** episode.astype(jnp.float32), self.epsilon_min)
        chance = jax.random.randint(choice, (), 0, mu.shape[-1])
        return jnp.where(jax.random.uniform(explore) < rate, chance, jnp.argmax(scores[0])).astype(jnp.int32)

    def greedy(self, state: State, observation: Array, score_fn: ScoreFn, key: Array) -> Array:
        """Return the action with the best score."""
        mu, sigma = self.read(state, observation[None], key)
        return jnp.argmax(score_fn(mu, sigma, observation[None])[0]).astype(jnp.int32)

    def update(
        self,
        state: State,
        batch: Transitions,
        reward_fn: RewardFn,
        score_fn: ScoreFn,
        score_fn_here: ScoreFn,
        backup: Backup,
        key: Array,
    ) -> tuple[State, UpdateInfo]:
        """Take one step of Adam on the temporal difference (and CQL's gap)."""
        drop, drop_next, drop_read = jax.random.split(key, 3)
        frozen = Weights(state.target, state.weights.prior)
        next_values = networks.values(self.ensemble, self.network, frozen, batch.next_observation, drop_next)
        if backup == "consistent":
            mu, sigma = networks.mean_and_deviation(next_values)
            value = networks.batched_index(
                next_values, jnp.argmax(score_fn(mu, sigma, batch.next_observation), axis=-1)
            )
        else:
            value = next_values.max(-1)
        weight = jnp.where(batch.terminated, 1.0, backup_weight(value, self.temperature))

        def loss(layers: Any) -> tuple[Array, Array]:
            weights = Weights(layers, state.weights.prior)
            passes = 1 if self.ensemble.kind == "dropout" else 0
            q = networks.values(self.ensemble, self.network, weights, batch.observation, drop, passes)
            taken = networks.batched_index(q, batch.action)
            if self.ensemble.kind == "dropout" and self.members > 1:
                member_values = networks.values(self.ensemble, self.network, weights, batch.observation, drop_read)
                member_values = networks.batched_index(member_values, batch.action)
                targets, mask = value.mean(0, keepdims=True), jnp.ones_like(taken)
            else:
                member_values, targets, mask = taken, value, batch.mask.T
            _, sigma = networks.mean_and_deviation(jax.lax.stop_gradient(member_values))
            reward, share = reward_fn(sigma)
            target = reward + jnp.where(batch.terminated, 0.0, self.gamma * targets)
            error = (taken - jax.lax.stop_gradient(target)) / self.network.value_scale
            gap = conservative_gap(q, batch.action) / self.network.value_scale**2
            each = weight * optax.losses.huber_loss(error) + self.conservative * gap
            return (mask * share * each).mean(), jnp.max(jnp.abs(taken))

        (lost, largest), gradient = jax.value_and_grad(loss, has_aux=True)(state.weights.layers)
        rate = self.network.learning_rate
        layers, optimiser = networks.descend(rate, gradient, state.optimiser, state.weights.layers)
        count = state.updates + 1
        fresh = count % self.target_every == 0
        target = jax.tree.map(lambda new, old: jnp.where(fresh, new, old), layers, state.target)
        return State(Weights(layers, state.weights.prior), target, optimiser, count), UpdateInfo(lost, largest)


class State(NamedTuple):
    """Weights, the target's layers, Adam's moments, updates so far."""

    weights: Weights
    target: Any
    optimiser: Any
    updates: Array


def conservative_gap(values: Array, action: Array) -> Array:
    """CQL's gap: log sum exp of the values over the actions, less the value of the action taken; (N, B), > 0.

    Examples:
        >>> values = jnp.log(jnp.array([[[1.0, 3.0]]]))  # of one member, one observation, two actions
        >>> round(conservative_gap(values, jnp.array([1])).item(), 3)  # log 4 - log 3
        0.288

    Args:
        values: (N, B, A).
        action: (B,).
    """
    return jax.nn.logsumexp(values, axis=-1) - networks.batched_index(values, action)


def backup_weight(next_values: Array, temperature: Array | float) -> Array:
    """SUNRISE's weight of a backup, sigmoid(-T sigma') + 0.5 in (0.5, 1]; (B,), from targets (N, B)."""
    _, sigma = networks.mean_and_deviation(next_values)
    return jax.nn.sigmoid(-temperature * sigma) + 0.5
