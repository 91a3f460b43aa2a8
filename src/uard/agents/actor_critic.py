"""The discrete actor-critic family: SAC and EDAC are one learner with different numbers (D5, D11).

* SAC [Haarnoja et al. 2018] for discrete actions [Christodoulou 2019]: two critics; expectations over the actions are
  sums, so nothing is sampled but the behaviour; the temperature keeps the policy's entropy near a target.
* EDAC [An et al. 2021]: more critics, whose gradients with respect to the action are pushed apart (``diversity``).

The actor climbs the mitigation's scores of the critics' lowest value, so a mitigation that acts on scores is followed
by the policy itself. The target takes the values under that policy: the ``greedy`` and the ``consistent`` backup are
the same here. What does not depend on the actions being discrete is a function of its own, for the continuous agents.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array, lax

from uard import _checks
from uard._support import fields
from uard.agents import networks
from uard.agents.networks import Ensemble, Layer, Network, Weights
from uard.agents.off_policy import Backup, OffPolicy, RewardFn, ScoreFn, Transitions, UpdateInfo

LOG_TEMPERATURES = (-10.0, 3.0)  # beyond them Adam would only wind up


@dataclass(frozen=True)
class SoftActorCritic(OffPolicy):
    """A policy that climbs the lowest of several critics, and is paid for staying random.

    Examples:
        >>> agent = SoftActorCritic(entropy=0.5, batch=32)
        >>> agent.family, agent.members
        ('replay', 2)
        >>> SoftActorCritic(tau=0.0)
        Traceback (most recent call last):
            ...
        uard._checks.InvalidValueError: tau = 0.0: must be a finite number in (0, 1]

    Attributes:
        network: Size and step size, the same for all deep agents; of the actor and of each critic.
        ensemble: The critics. Fixed random priors do not go with the lowest of them: where nothing was seen it falls by
            about their size, and the policy keeps away from what it does not know.
        gamma: Discount in [0, 0.9999].
        entropy: Target entropy of the first update, as a share of log A, in [0, 1]; every update multiplies it by
            ``entropy_decay``, down to ``entropy_min``. A fixed share of 0.98 [Christodoulou 2019] never settles on a
            path; a small one from the start may never find it.
        entropy_decay: See ``entropy``; in [0, 1].
        entropy_min: See ``entropy``; in [0, 1].
        temperature: First price of entropy, in units of ``value_scale``, in (0, e^3]; tuned from there.
        diversity: EDAC's eta >= 0, the weight of the similarity between the critics' gradients.
        tau: Share in (0, 1] of the critics that each update mixes into the target network.
        buffer: Transitions kept, >= ``batch``.
        batch: Transitions per update, in [1, 4096]; there is one update per step.
        warmup: Steps before the first update, >= 0.
        bootstrap: Chance that a critic learns from a transition, in [1/256, 1].
    """

    network: Network = field(default_factory=Network)
    ensemble: Ensemble = field(default=Ensemble("full", 2, 0.0))
    gamma: float = 0.95
    entropy: float = 0.9
    entropy_decay: float = 0.9999
    entropy_min: float = 0.05
    temperature: float = 0.01
    diversity: float = 0.0
    tau: float = 0.01
    buffer: int = 10_000
    batch: int = 64
    warmup: int = 500
    bootstrap: float = 1.0

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        fields.check(self)
        _checks.number("gamma", self.gamma, low=0, high=0.9999)
        for name in ("entropy", "entropy_decay", "entropy_min"):
            _checks.number(name, getattr(self, name), low=0, high=1)
        _checks.number("temperature", self.temperature, low=0, high=math.exp(LOG_TEMPERATURES[1]), open_low=True)
        _checks.number("diversity", self.diversity, low=0)
        _checks.number("tau", self.tau, low=0, high=1, open_low=True)
        _checks.whole("batch", self.batch, low=1, high=4096)
        _checks.whole("buffer", self.buffer, low=self.batch, high=10_000_000)
        _checks.whole("warmup", self.warmup, low=0, high=10_000_000)
        _checks.number("bootstrap", self.bootstrap, low=1 / 256, high=1)

    @property
    def members(self) -> int:
        """Number of critics."""
        return self.ensemble.members

    def init(self, key: Array, features: int, actions: int) -> State:
        """Return fresh networks; the policy begins almost uniform."""
        weights, actor = _drawn(self.ensemble, self.network, key, features, actions)
        log_temperature = jnp.log(jnp.asarray(self.temperature, jnp.float32))
        trained = Trained(weights.layers, actor, log_temperature)
        optimiser = optax.adam(self.network.learning_rate).init(trained)
        return State(trained, weights.prior, jax.tree.map(jnp.copy, weights.layers), optimiser, jnp.int32(0))

    def policy(self, state: State, observations: Array) -> Array:
        """Return the log chances of the actions, (B, A)."""
        return log_policy(self.network, state.trained.actor, observations)

    def values(self, state: State, observations: Array, key: Array | None = None) -> Array:
        """Return all critics' values (N, B, A)."""
        weights = Weights(state.trained.critics, state.prior)
        return networks.values(self.ensemble, self.network, weights, observations, key)

    def read(self, state: State, observations: Array, key: Array) -> tuple[Array, Array]:
        """Return mu and sigma_m of the critics, (B, A) each."""
        return networks.mean_and_deviation(self.values(state, observations, key))

    def act(self, state: State, observation: Array, score_fn: ScoreFn, episode: Array, key: Array) -> Array:
        """Return a draw from the policy, which has learned what the mitigation prefers."""
        return jax.random.categorical(key, self.policy(state, observation[None])[0]).astype(jnp.int32)

    def greedy(self, state: State, observation: Array, score_fn: ScoreFn, key: Array) -> Array:
        """Return the policy's likeliest action."""
        return jnp.argmax(self.policy(state, observation[None])[0]).astype(jnp.int32)

    def target_entropy(self, updates: Array, actions: int) -> Array:
        """Return the entropy (nats) that the policy is to have after so many updates."""
        share = jnp.maximum(self.entropy * self.entropy_decay ** updates.astype(jnp.float32), self.entropy_min)
        return share * math.log(actions)

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
        """Take one step of Adam on critics, actor and temperature together."""
        drop, drop_next, drop_read = jax.random.split(key, 3)
        ensemble, network, scale = self.ensemble, self.network, self.network.value_scale
        dropout = ensemble.kind == "dropout" and ensemble.members > 1
        temperature = jnp.exp(state.trained.log_temperature)
        next_values = networks.values(
            ensemble, network, Weights(state.target, state.prior), batch.next_observation, drop_next
        )
        log_next = self.policy(state, batch.next_observation)
        value = soft_value(lowest(next_values), log_next, scale * temperature)
        aim = self.target_entropy(state.updates, next_values.shape[-1])

        # Critics, actor and temperature share no parameter and Adam works on each number alone, so one gradient of
        # the sum is what three optimisers would take. All three see the networks before the step.
        def loss(trained: Trained) -> tuple[Array, Array]:
            weights = Weights(trained.critics, state.prior)
            q = networks.values(ensemble, network, weights, batch.observation, drop, 1 if dropout else 0)
            member_values, mask = q, batch.mask.T
            if dropout:
                member_values = networks.values(ensemble, network, weights, batch.observation, drop_read)
                mask = jnp.ones((1, mask.shape[1]), mask.dtype)
            member_values = lax.stop_gradient(member_values)
            _, sigma = networks.mean_and_deviation(member_values)
            reward, share = reward_fn(networks.batched_index(sigma, batch.action))
            target = reward + jnp.where(batch.terminated, 0.0, self.gamma * value)
            taken = networks.batched_index(q, batch.action)
            error = (taken - lax.stop_gradient(target)) / scale
            critics = (mask * share * optax.losses.huber_loss(error)).mean()
            if q.shape[0] > 1:  # with diversity 0 this costs little, and diversity remains a number
                critics += self.diversity * gradient_similarity(simplex_gradient(q / scale))

            log_here = log_policy(network, trained.actor, batch.observation)
            scores = score_fn_here(lowest(member_values), sigma, batch.observation)
            actor = -soft_value(lax.stop_gradient(scores) / scale, log_here, temperature).mean()
            heat = temperature_loss(trained.log_temperature, lax.stop_gradient(entropy(log_here)), aim)
            return critics + actor + heat, jnp.max(jnp.abs(taken))

        (lost, largest), gradient = jax.value_and_grad(loss, has_aux=True)(state.trained)
        moved, optimiser = networks.descend(network.learning_rate, gradient, state.optimiser, state.trained)
        critics, actor, log_temperature = moved
        trained = Trained(critics, actor, jnp.clip(log_temperature, *LOG_TEMPERATURES))
        target = polyak(state.target, critics, self.tau)
        return State(trained, state.prior, target, optimiser, state.updates + 1), UpdateInfo(lost, largest)


class Trained(NamedTuple):
    """What Adam moves: the critics' layers, the actor's, the log of the temperature in units of ``value_scale``."""

    critics: tuple[Layer, ...]
    actor: tuple[Layer, ...]
    log_temperature: Array


class State(NamedTuple):
    """Trained weights, the critics' fixed priors, the target's layers, Adam's moments, updates so far."""

    trained: Trained
    prior: tuple[Layer, ...] | None
    target: Any
    optimiser: Any
    updates: Array


def edac(members: int = 5, diversity: float = 0.01, **changes: Any) -> SoftActorCritic:
    """Return EDAC: independent critics with diversified gradients.

    Examples:
        >>> agent = edac(members=3, batch=32)
        >>> agent.members, agent.diversity
        (3, 0.01)

    Args:
        members: Critics, in [1, 64]; with one there is nothing to diversify.
        diversity: EDAC's eta >= 0.
        **changes: Other fields of ``SoftActorCritic``.
    """
    return SoftActorCritic(ensemble=Ensemble("full", members, 0.0), diversity=diversity, **changes)


def _drawn(
    ensemble: Ensemble, network: Network, key: Array, features: int, actions: int
) -> tuple[Weights, tuple[Layer, ...]]:
    """Draw critics and actor."""
    n, width = ensemble.members, network.hidden
    if ensemble.kind != "full":
        critics, actor = jax.random.split(key)
        weights = networks.init(ensemble, network, critics, features, actions)
        return weights, networks.mlp(actor, (features, width, width, actions), last_gain=0.1)
    # An actor is as large as a critic: drawn as one more of them, the program compiles in three seconds less.
    layers, prior = networks.init(replace(ensemble, members=n + 1), network, key, features, actions)
    assert prior is not None
    if n == 1:
        return Weights(_member(layers, 0), None), _member(layers, 1)
    shown = prior[-1].weight[:, : n * actions], prior[-1].bias[: n * actions]
    return Weights(jax.tree.map(lambda x: x[:n], layers), (*prior[:-1], Layer(*shown))), _member(layers, n)


def _member(layers: tuple[Layer, ...], i: int) -> tuple[Layer, ...]:
    return jax.tree.map(lambda x: x[i], layers)


def log_policy(network: Network, layers: tuple[Layer, ...], observations: Array) -> Array:
    """Return an actor's log chances of discrete actions, (B, A)."""
    return jax.nn.log_softmax(networks.through(layers, observations, network.activation))


def entropy(log_chances: Array) -> Array:
    """Entropy of a policy over discrete actions, in nats: (..., A) to (...), in [0, log A]."""
    return -(jnp.exp(log_chances) * log_chances).sum(-1)


def soft_value(values: Array, log_chances: Array, temperature: Array | float) -> Array:
    """Expected value plus the price of the entropy, E_pi[Q - T log pi]: (..., A) to (...) [Christodoulou 2019, eq. 4].

    Examples:
        >>> values, evenly = jnp.array([1.0, 3.0]), jnp.log(jnp.array([0.5, 0.5]))
        >>> [round(soft_value(values, evenly, temperature).item(), 3) for temperature in (0.0, 1.0)]  # 2, 2 + log 2
        [2.0, 2.693]

    Args:
        values: (..., A) of the actions.
        log_chances: (..., A), log pi.
        temperature: T >= 0 in the unit of the values.
    """
    return (jnp.exp(log_chances) * (values - temperature * log_chances)).sum(-1)


def lowest(values: Array) -> Array:
    """The lowest of the critics' values, (N, ...) to (...): the pessimism of clipped double Q, SAC-N and EDAC."""
    return values.min(0)


def temperature_loss(log_temperature: Array, entropies: Array, target: Array | float) -> Array:
    """Loss whose descent raises the temperature where the policy's entropy is below the target, and else lowers it.

    Linear in log T, so that the speed does not depend on T [Haarnoja et al. 2018b, section 5].

    Args:
        log_temperature: log T.
        entropies: Entropies (or for continuous actions -log pi of a drawn one), any shape.
        target: Wanted entropy, nats.
    """
    return log_temperature * (entropies - target).mean()


def polyak(target: Any, online: Any, tau: Array | float) -> Any:
    """Mix a share ``tau`` of the online weights into the target's; two pytrees of one structure."""
    return jax.tree.map(lambda old, new: old + tau * (new - old), target, online)


def simplex_gradient(values: Array) -> Array:
    """Gradient of sum_i a_i Q_i with respect to a on the simplex: the values (..., A) less their mean over the actions.

    This is what EDAC's gradient with respect to a continuous action is for discrete ones: it says which way the critic
    would shift the policy.
    """
    return values - values.mean(-1, keepdims=True)


def gradient_similarity(gradients: Array, floor: float = 1e-3) -> Array:
    """EDAC's penalty: 1/(N-1) times the batch's mean of sum over k != j of cos(grad_k, grad_j), in [-N/(N-1), N].

    Examples:
        >>> alike, opposed = jnp.array([[[1.0]], [[2.0]]]), jnp.array([[[1.0]], [[-2.0]]])  # of two critics
        >>> [round(gradient_similarity(gradients).item(), 3) for gradients in (alike, opposed)]
        [2.0, -2.0]

    Args:
        gradients: (N, B, dims), of N >= 2 critics with respect to the action.
        floor: Gradients much shorter than this have no direction: their cosines fade to 0. Without it the penalty's own
            gradient, which goes with 1 / length, has no bound.
    """
    members = gradients.shape[0]
    unit = gradients * lax.rsqrt((gradients * gradients).sum(-1, keepdims=True) + floor**2)
    # The sum over pairs is the sum's square less the squares, N terms instead of N^2.
    total = unit.sum(0)
    pairs = (total * total).sum(-1) - (unit * unit).sum((0, -1))
    return pairs.mean() / (members - 1)
