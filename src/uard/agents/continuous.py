"""The actor-critic family for continuous actions: SAC, CQL, EDAC and SUNRISE are one learner (D5, D6, D11).

* SAC [Haarnoja et al. 2018]: two critics, a squashed normal policy, a tuned temperature.
* EDAC [An et al. 2021]: more critics, whose gradients with respect to the action are pushed apart (``diversity``).
* CQL [Kumar et al. 2020]: the critics' values of actions that were not taken are pushed down (``conservative``).
* SUNRISE [Lee et al. 2021]: backups whose members disagree count less (``backup_temperature``), and the action is the
  best of several by mean + ``ucb`` deviations.
* Of many critics, the lowest of a random ``pair`` is as pessimistic as SAC's two [Chen et al. 2021, REDQ].

The mathematics that is the same for discrete actions is taken from ``actor_critic``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, final

import jax
import jax.numpy as jnp
import optax
from jax import Array, lax

from uard import _checks
from uard._support import fields
from uard.agents import networks
from uard.agents.actor_critic import LOG_TEMPERATURES, Trained, gradient_similarity, polyak, temperature_loss
from uard.agents.base import Agent, Family
from uard.agents.heads import HALF_LOG_TAU, Normal
from uard.agents.networks import Ensemble, Layer, Network, Weights
from uard.agents.off_policy import RewardFn, Transitions, UpdateInfo
from uard.agents.value import backup_weight

LOG_DEVIATIONS = (-5.0, 2.0)
CQL_ACTIONS = 4  # drawn from the policy, and as many uniformly
UCB_ACTIONS = 8


@final
@dataclass(frozen=True)
class ContinuousActorCritic(Agent):
    """A squashed normal policy that climbs its critics, and is paid for staying random.

    Examples:
        >>> agent = ContinuousActorCritic(network=Network(hidden=64), warmup=1000)
        >>> agent.family, agent.members
        ('continuous-replay', 2)
        >>> ContinuousActorCritic(batch=256, warmup=100)
        Traceback (most recent call last):
            ...
        uard._checks.InvalidValueError: warmup = 100: must be a whole number in [256, 1e+08]

    Attributes:
        network: Width and step size of the actor and of each critic; unit of values.
        ensemble: The critics, two or more, full or shared; fixed random priors only with ``pair``.
        gamma: Discount in [0, 0.9999].
        pair: Whether the target takes the lowest of a random pair of critics and the actor their mean; else both take
            the lowest of all.
        entropy: Target entropy, nats per motor, in [-100, 100].
        temperature: First price of entropy, in reward units, in (0, e^3]; tuned from there.
        diversity: EDAC's eta >= 0.
        conservative: CQL's alpha >= 0.
        ucb: SUNRISE's bonus for disagreement, in deviations, >= 0.
        backup_temperature: SUNRISE's T >= 0; 0 weighs all backups alike.
        tau: Share in (0, 1] of the critics that each update mixes into the target network.
        buffer: Transitions kept, >= ``batch``; rounded up to a multiple of 32.
        batch: Transitions per update, in [1, 65536]; there is one update per step.
        warmup: Steps of uniformly random actions before the first update, >= ``batch``.
        bootstrap: Chance that a critic learns from a transition, in [1/256, 1].
    """

    family: ClassVar[Family] = "continuous-replay"

    network: Network = field(default=Network(256, 3e-4, 1.0))
    ensemble: Ensemble = field(default=Ensemble("full", 2, 0.0))
    gamma: float = 0.99
    pair: bool = False
    entropy: float = -1.0
    temperature: float = 1.0
    diversity: float = 0.0
    conservative: float = 0.0
    ucb: float = 0.0
    backup_temperature: float = 0.0
    tau: float = 0.005
    buffer: int = 1_000_000
    batch: int = 256
    warmup: int = 5_000
    bootstrap: float = 1.0

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        fields.check(self)
        _checks.number("gamma", self.gamma, low=0, high=0.9999)
        _checks.number("entropy", self.entropy, low=-100, high=100)
        _checks.number("temperature", self.temperature, low=0, high=math.exp(LOG_TEMPERATURES[1]), open_low=True)
        for name in ("diversity", "conservative", "ucb", "backup_temperature"):
            _checks.number(name, getattr(self, name), low=0)
        _checks.number("tau", self.tau, low=0, high=1, open_low=True)
        _checks.whole("batch", self.batch, low=1, high=65_536)
        _checks.whole("buffer", self.buffer, low=self.batch, high=100_000_000)
        _checks.whole("warmup", self.warmup, low=self.batch, high=100_000_000)
        _checks.number("bootstrap", self.bootstrap, low=1 / 256, high=1)
        _checks.choose("ensemble.kind", self.ensemble.kind, ("full", "shared"))
        if self.ensemble.members < 2:
            raise _checks.InvalidValueError("ensemble.members", self.ensemble.members, "2 or more")

    @property
    def members(self) -> int:
        """Number of critics."""
        return self.ensemble.members

    def init(self, key: Array, features: int, actions: int) -> State:
        """Return fresh networks."""
        critics, actor = jax.random.split(key)
        width = self.network.hidden
        weights = networks.init(self.ensemble, self.network, critics, features + actions, 1)
        policy = networks.mlp(actor, (features, width, width, 2 * actions), last_gain=0.01)
        trained = Trained(weights.layers, policy, jnp.log(jnp.asarray(self.temperature, jnp.float32)))
        optimiser = optax.adam(self.network.learning_rate).init(trained)
        return State(trained, weights.prior, jax.tree.map(jnp.copy, weights.layers), optimiser)

    def values(self, state: State, observations: Array, actions: Array) -> Array:
        """Return all critics' values (N, B)."""
        return self._values(Weights(state.trained.critics, state.prior), observations, actions)

    def _values(self, weights: Weights, observations: Array, actions: Array) -> Array:
        inputs = jnp.concatenate([observations, actions], -1)
        return networks.values(self.ensemble, self.network, weights, inputs)[..., 0]

    def act(self, state: State, observations: Array, key: Array) -> Array:
        """Draw actions (B, D) within (-1, 1); with ``ucb``, the best of several by mean + ucb deviations."""
        if not self.ucb:
            return draw(action_distribution(self.network, state.trained.actor, observations), key)[0]
        keys = jax.random.split(key, UCB_ACTIONS)
        offered = jax.vmap(lambda k: draw(action_distribution(self.network, state.trained.actor, observations), k)[0])(
            keys
        )
        mu, sigma = networks.mean_and_deviation(
            jax.vmap(lambda a: self.values(state, observations, a), out_axes=1)(offered)
        )
        best = jnp.argmax(mu + self.ucb * sigma, 0)
        return jnp.take_along_axis(offered, best[None, :, None], 0)[0]

    def greedy(self, state: State, observations: Array) -> Array:
        """Return the policy's middle actions (B, D)."""
        return jnp.tanh(action_distribution(self.network, state.trained.actor, observations).mean)

    def update(
        self,
        state: State,
        batch: Transitions,
        reward_fn: RewardFn,
        score_fn: Callable[[Array, Array], Array],
        key: Array,
    ) -> tuple[State, UpdateInfo]:
        """Take one step of Adam on critics, actor and temperature together.

        Args:
            state: Before.
            batch: Transitions.
            reward_fn: Of sigma_m at the batch's state-actions (B,), the reward to learn from and its weight, (B,) each.
            score_fn: Of mean values and deviations (B,), the mitigation's scores (B,): what the actor climbs.
            key: For the drawn actions.
        """
        next_key, here_key, pair_key, cql_key = jax.random.split(key, 4)
        scale = self.network.value_scale
        temperature = jnp.exp(state.trained.log_temperature)
        action_next, log_next = draw(
            action_distribution(self.network, state.trained.actor, batch.next_observation), next_key
        )
        next_values = self._values(Weights(state.target, state.prior), batch.next_observation, action_next)
        trust = backup_weight(next_values, self.backup_temperature) if self.backup_temperature else 1.0
        if self.pair:
            next_values = next_values[jax.random.permutation(pair_key, self.members)[:2]]
        value = next_values.min(0) - temperature * log_next
        frozen = state.trained.critics

        def loss(trained: Trained) -> tuple[Array, Array]:
            weights = Weights(trained.critics, state.prior)

            def q_of(actions: Array) -> Array:
                return self._values(weights, batch.observation, actions)

            if self.diversity:
                # The batch's rows do not mix: the sum's gradient is each row's own.
                q, pull = jax.vjp(q_of, batch.action)
                rows = jnp.eye(self.members, dtype=q.dtype)[:, :, None] * jnp.ones_like(q)
                slope = jax.vmap(lambda r: pull(r)[0])(rows)
            else:
                q, slope = q_of(batch.action), None
            _, sigma = networks.mean_and_deviation(lax.stop_gradient(q))
            reward, share = reward_fn(sigma)
            target = lax.stop_gradient(reward + jnp.where(batch.terminated, 0.0, self.gamma * value))
            error = (q - target) / scale
            # Each critic learns from a mean over the batch; their sum, so that none learns slower than alone.
            critics = (batch.mask.T * share * trust * 0.5 * error**2).mean(1).sum()
            if slope is not None:
                critics += self.diversity * self.members * gradient_similarity(slope / scale)
            if self.conservative:
                critics += (
                    self.conservative * self._gap(weights, trained.actor, batch, q, cql_key).mean(1).sum() / scale
                )

            action, log_here = draw(action_distribution(self.network, trained.actor, batch.observation), here_key)
            member_values = self._values(Weights(lax.stop_gradient(frozen), state.prior), batch.observation, action)
            mu, doubt = networks.mean_and_deviation(member_values)
            climbed = score_fn(mu if self.pair else member_values.min(0), doubt)
            actor = (lax.stop_gradient(temperature) * log_here - climbed).mean() / scale
            aim = self.entropy * batch.action.shape[1]
            heat = temperature_loss(trained.log_temperature, -lax.stop_gradient(log_here), aim)
            return critics + actor + heat, jnp.max(jnp.abs(q))

        (lost, largest), gradient = jax.value_and_grad(loss, has_aux=True)(state.trained)
        moved, optimiser = networks.descend(self.network.learning_rate, gradient, state.optimiser, state.trained)
        moved = moved._replace(log_temperature=jnp.clip(moved.log_temperature, *LOG_TEMPERATURES))
        target = polyak(state.target, moved.critics, self.tau)
        return State(moved, state.prior, target, optimiser), UpdateInfo(lost, largest)

    def _gap(self, weights: Weights, actor: Any, batch: Transitions, q: Array, key: Array) -> Array:
        """CQL(H) with importance weights [Kumar et al. 2020, eq. 4 and appendix F]; (N, B)."""
        uniform_key, policy_key = jax.random.split(key)
        rows, motors = batch.action.shape
        uniform = jax.random.uniform(uniform_key, (CQL_ACTIONS, rows, motors), minval=-1.0, maxval=1.0)
        distribution = lax.stop_gradient(action_distribution(self.network, actor, batch.observation))
        drawn, logs = jax.vmap(lambda k: draw(distribution, k))(jax.random.split(policy_key, CQL_ACTIONS))
        offered = jnp.concatenate([uniform, lax.stop_gradient(drawn)])
        density = jnp.concatenate([jnp.full((CQL_ACTIONS, rows), -motors * math.log(2.0)), lax.stop_gradient(logs)])
        values = jax.vmap(lambda a: self._values(weights, batch.observation, a))(offered)
        soft = jax.nn.logsumexp(values - density[:, None], 0) - math.log(2.0 * CQL_ACTIONS)
        return soft - q


class State(NamedTuple):
    """Trained weights, the critics' fixed priors, the target's layers, Adam's moments."""

    trained: Trained
    prior: tuple[Layer, ...] | None
    target: Any
    optimiser: Any


def action_distribution(network: Network, layers: tuple[Layer, ...], observations: Array) -> Normal:
    """Return the normal, before squashing, of (B, F) observations."""
    mean, log_deviation = jnp.split(networks.through(layers, observations, network.activation), 2, -1)
    return Normal(mean, jnp.clip(log_deviation, *LOG_DEVIATIONS))


def draw(distribution: Normal, key: Array) -> tuple[Array, Array]:
    """Draw squashed actions (B, D) within (-1, 1), and their log-densities (B,) [Haarnoja et al. 2018, appendix C]."""
    noise = jax.random.normal(key, distribution.mean.shape, distribution.mean.dtype)
    x = distribution.mean + jnp.exp(distribution.log_deviation) * noise
    log_normal = -(0.5 * noise**2 + distribution.log_deviation + HALF_LOG_TAU).sum(-1)
    # log(1 - tanh(x)^2), without the cancellation
    squash = (2.0 * (math.log(2.0) - x - jax.nn.softplus(-2.0 * x))).sum(-1)
    return jnp.tanh(x), log_normal - squash


def sac(**changes: Any) -> ContinuousActorCritic:
    """Return SAC.

    Examples:
        >>> sac(gamma=0.95).gamma, sac().members
        (0.95, 2)

    Args:
        **changes: Fields of ``ContinuousActorCritic``.
    """
    return ContinuousActorCritic(**changes)


def ensemble_sac(members: int = 5, kind: Any = "shared", **changes: Any) -> ContinuousActorCritic:
    """Return SAC with as many critics as the paper's ensembles have, no more pessimistic than with two.

    Examples:
        >>> agent = ensemble_sac(members=3)
        >>> agent.ensemble.kind, agent.members, agent.pair
        ('shared', 3, True)

    Args:
        members: Critics, in [2, 64].
        kind: ``shared`` or ``full``, see ``Ensemble``.
        **changes: Other fields of ``ContinuousActorCritic``.
    """
    return ContinuousActorCritic(ensemble=Ensemble(kind, members), pair=True, **changes)


def cql(alpha: float = 1.0, **changes: Any) -> ContinuousActorCritic:
    """Return CQL in its SAC form.

    Examples:
        >>> cql(alpha=5.0).conservative
        5.0

    Args:
        alpha: CQL's alpha >= 0.
        **changes: Other fields of ``ContinuousActorCritic``.
    """
    return ContinuousActorCritic(conservative=alpha, **changes)


def edac(members: int = 5, diversity: float = 1.0, **changes: Any) -> ContinuousActorCritic:
    """Return EDAC.

    Examples:
        >>> agent = edac(members=10)
        >>> agent.ensemble.kind, agent.members, agent.diversity
        ('full', 10, 1.0)

    Args:
        members: Critics, in [2, 64].
        diversity: EDAC's eta >= 0.
        **changes: Other fields of ``ContinuousActorCritic``.
    """
    return ContinuousActorCritic(ensemble=Ensemble("full", members, 0.0), diversity=diversity, **changes)


def sunrise(members: int = 5, **changes: Any) -> ContinuousActorCritic:
    """Return SUNRISE; its critics share a trunk and the policy is one.

    Examples:
        >>> agent = sunrise(members=3)
        >>> agent.members, agent.ucb, agent.backup_temperature
        (3, 1.0, 10.0)

    Args:
        members: Critics, in [2, 64].
        **changes: Other fields of ``ContinuousActorCritic``.
    """
    return ContinuousActorCritic(
        ensemble=Ensemble("shared", members), pair=True, ucb=1.0, backup_temperature=10.0, **changes
    )
