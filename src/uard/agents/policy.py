"""The policy family: PPO, TRPO and CPO, with an ensemble of state values as critic (D8, D9, D11).

* PPO [Schulman et al. 2017]: the clipped surrogate, eq. 7, and a bonus for entropy.
* TRPO [Schulman et al. 2015]: a natural-gradient step of fixed mean KL, then a line search.
* CPO [Achiam et al. 2017]: TRPO with a budget of cost per episode.

Policy and critic are separate networks of one size. These agents have no action values and no maximum in their targets,
so a mitigation's ``backup`` means nothing to them; how its scores do stands at ``Experience``.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, final

import jax
import jax.numpy as jnp
import optax
from jax import Array, lax
from jax.flatten_util import ravel_pytree

from uard import _checks
from uard._support import fields
from uard.agents import heads, networks
from uard.agents.base import Agent, Family
from uard.agents.heads import ActionDistribution, divergence, entropy, log_probability
from uard.agents.networks import SINGLE, Ensemble, Layer, Network, Weights
from uard.agents.off_policy import UpdateInfo

Layers = tuple[Layer, ...]


class Experience(NamedTuple):
    """What one rollout of T steps in E copies of the world gave.

    Attributes:
        observation: (T, E, features), or (T, E) whole numbers that stand for one-hot rows.
        action: (T, E).
        next_observation: Alike, the observation after the step, before any reset.
        reward: (T, E), the reward to learn from.
        weight: (T, E), how much a step counts in the losses; 0 skips it.
        cost: (T, E), what CPO has to keep within its budget.
        terminated: (T, E), whether the step ended the episode; a cut-off at the horizon does not count.
        done: (T, E), whether it ended or was cut off.
        values: (N, T, E), the members' values of ``observation``.
        next_values: (N, T, E), those of ``next_observation``.
        horizon: Steps after which an episode is cut off.
        score_fn: Of the estimated values Q = V + A of the actions taken (T, E), the mitigation's scores (T, E). The
            advantage climbed is score_fn(Q) - V: GAE's own for a mitigation that does not score.
    """

    observation: Array
    action: Array
    next_observation: Array
    reward: Array
    weight: Array
    cost: Array
    terminated: Array
    done: Array
    values: Array
    next_values: Array
    horizon: Array
    score_fn: Callable[[Array], Array]


class Batch(NamedTuple):
    """A rollout made ready for learning: B = T E steps.

    Attributes:
        observation: (B, features), or (B,).
        action: (B,).
        advantage: (B,), of mean 0 and deviation 1 under ``weight``.
        target: (N, B), the members' lambda-returns.
        weight: (B,).
    """

    observation: Array
    action: Array
    advantage: Array
    target: Array
    weight: Array


class State(NamedTuple):
    """Policy, critic and Adam's moments of both (TRPO uses the critic's only); CPO's ``Costs``, else ()."""

    policy: Layers
    value: Weights
    policy_optimiser: Any
    value_optimiser: Any
    costs: Any


class Costs(NamedTuple):
    """CPO's cost critic, its Adam's moments; a running share of steps that end an episode, and its total weight."""

    weights: Weights
    optimiser: Any
    ends: Array
    trust: Array


@dataclass(frozen=True)
class PolicyGradient(Agent):
    """What PPO, TRPO and CPO share.

    Examples:
        >>> agent, key = PPO(ensemble=Ensemble("full", members=3)), jax.random.key(0)
        >>> state = jax.eval_shape(lambda: agent.init(key, features=4, actions=2))  # shapes only
        >>> jax.eval_shape(agent.act, state, jnp.zeros((5, 4)), key).shape
        (5,)
        >>> jax.eval_shape(agent.values, state, jnp.zeros((5, 4)), key).shape
        (3, 5)

    Attributes:
        network: Size of the policy and of the critic, Adam's step size, unit of values.
        ensemble: The critic: how many estimates of V, and of which kind. sigma_m of a step is how much they differ on
            the state it leads to, discounted.
        gamma: Discount in [0, 0.9999].
        gae_lambda: Lambda of the generalised advantage estimate, in [0, 1].
        envs: Copies of the world that are stepped side by side, in [1, 4096].
        rollout: Steps of each copy between updates, in [1, 65536].
        epochs: Passes over a rollout per update (TRPO and CPO: of the critic only), in [1, 1000].
        minibatches: Parts of a pass, one step of Adam each, in [1, ``envs`` times ``rollout``].
        max_grad_norm: The gradients of the policy and of the critic are each scaled down to this, > 0.
        count_bonus: Added to the reward after the mitigation, over the root of the visits of the state-action; in
            reward units, >= 0 [Strehl and Littman 2008]. With it all of ten PPO runs arrive on the 10x10 grid; without
            it, five of ten on the true reward and two of ten with ``uard``.
    """

    family: ClassVar[Family] = "rollout"

    network: Network = field(default_factory=Network)
    ensemble: Ensemble = field(default_factory=Ensemble)
    gamma: float = 0.95
    gae_lambda: float = 0.95
    envs: int = 8
    rollout: int = 32
    epochs: int = 4
    minibatches: int = 4
    max_grad_norm: float = 0.5
    count_bonus: float = 0.5

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        fields.check(self)
        _checks.number("gamma", self.gamma, low=0, high=0.9999)
        _checks.number("gae_lambda", self.gae_lambda, low=0, high=1)
        _checks.whole("envs", self.envs, low=1, high=4096)
        _checks.whole("rollout", self.rollout, low=1, high=65_536)
        _checks.whole("epochs", self.epochs, low=1, high=1000)
        _checks.whole("minibatches", self.minibatches, low=1, high=self.envs * self.rollout)
        _checks.number("max_grad_norm", self.max_grad_norm, low=0, open_low=True)
        _checks.number("count_bonus", self.count_bonus, low=0)

    @property
    def members(self) -> int:
        """Number of members of the critic."""
        return self.ensemble.members

    @property
    def needs_cost(self) -> bool:
        """Whether the loop has to tell which steps were hacks: only of an oracle (see ``CPO``)."""
        return False

    def init(self, key: Array, features: int, actions: int, continuous: bool = False) -> State:
        """Return fresh networks; the policy is close to uniform, or to a standard normal."""
        costs, key = self._fresh_costs(key, features)
        own, critic = jax.random.split(key)
        policy = heads.init(own, self.network, features, actions, continuous)
        value = networks.init(self.ensemble, self.network, critic, features, 1)
        return State(policy, value, self._adam().init(policy), self._adam().init(value.layers), costs)

    def _fresh_costs(self, key: Array, features: int) -> tuple[Any, Array]:
        """Return what an agent keeps of costs, nothing for one that counts none, and a key for the rest."""
        return (), key

    def act(self, state: State, observations: Array, key: Array) -> Array:
        """Draw an action for each of (B, features) observations; continuous ones have no bounds."""
        return heads.draw(heads.action_distribution(self.network, state.policy, observations), key)

    def greedy(self, state: State, observation: Array) -> Array:
        """Return the likeliest action for one observation (features,)."""
        return heads.likeliest(heads.action_distribution(self.network, state.policy, observation[None]))[0]

    def values(self, state: State, observations: Array, key: Array) -> Array:
        """Return all members' values (N, B) of observations (B, features)."""
        return networks.values(self.ensemble, self.network, state.value, observations, key)[..., 0]

    @abstractmethod
    def update(self, state: State, experience: Experience, key: Array) -> tuple[State, UpdateInfo]:
        """Learn from one rollout."""

    def _adam(self) -> optax.GradientTransformation:
        adam = optax.adam(self.network.learning_rate)
        return optax.flatten(optax.chain(optax.clip_by_global_norm(self.max_grad_norm), adam))

    def _descend(self, gradient: Any, optimiser: Any, layers: Any) -> tuple[Any, Any]:
        # Optax raises a float to an integer, which JAX forbids where all promotions have to be written out.
        with jax.numpy_dtype_promotion("standard"):
            step, optimiser = self._adam().update(gradient, optimiser)
            return optax.apply_updates(layers, step), optimiser

    def _batch(self, e: Experience) -> Batch:
        def of_member(values: Array, next_values: Array) -> Array:
            return gae(e.reward, values, next_values, e.terminated, e.done, self.gamma, self.gae_lambda)

        # GAE is linear in the values: the mean of the members' estimates is the estimate from their mean.
        target = e.values + jax.vmap(of_member)(e.values, e.next_values)
        advantage = e.score_fn(target.mean(0)) - e.values.mean(0)
        return Batch(
            _flat(e.observation),
            _flat(e.action),
            _flat(standardised(advantage, e.weight)),
            target.reshape(target.shape[0], -1),
            _flat(e.weight),
        )

    def _critic_loss(
        self, ensemble: Ensemble, weights: Weights, batch: Batch, key: Array
    ) -> tuple[Array, tuple[Array, Array]]:
        """Return the critic's loss, twice, and its largest value."""
        dropout = ensemble.kind == "dropout" and ensemble.members > 1
        target = batch.target.mean(0, keepdims=True) if dropout else batch.target
        v = networks.values(ensemble, self.network, weights, batch.observation, key, passes=int(dropout))[..., 0]
        each = optax.losses.huber_loss((v - target) / self.network.value_scale)
        loss = (batch.weight * each).mean()
        return loss, (loss, jnp.max(jnp.abs(v)))

    def _shuffled(self, batch: Batch, key: Array) -> tuple[Array, Array]:
        """Return the minibatches of all epochs, (epochs minibatches, size) indices, and a key for each."""
        shuffle, each = jax.random.split(key)
        total = batch.action.shape[0]
        size = total // self.minibatches
        order = jnp.argsort(jax.random.bits(shuffle, (self.epochs, total)), axis=-1)
        parts = order[:, : size * self.minibatches].reshape(-1, size)
        return parts, jax.random.split(each, parts.shape[0])

    def _fitted(
        self, ensemble: Ensemble, weights: Weights, optimiser: Any, batch: Batch, key: Array
    ) -> tuple[Weights, Any, UpdateInfo]:
        """Fit a critic to the targets."""

        def one(c: tuple[Layers, Any], x: tuple[Array, Array]) -> tuple[tuple[Layers, Any], tuple[Array, Array]]:
            part = _take(batch, x[0])
            (layers, optimiser) = c
            gradient, info = jax.grad(
                lambda layers: self._critic_loss(ensemble, Weights(layers, weights.prior), part, x[1]), has_aux=True
            )(layers)
            return self._descend(gradient, optimiser, layers), info

        (layers, optimiser), (losses, largest) = lax.scan(one, (weights.layers, optimiser), self._shuffled(batch, key))
        return Weights(layers, weights.prior), optimiser, UpdateInfo(losses.sum(), largest.max())


@final
@dataclass(frozen=True)
class PPO(PolicyGradient):
    """Proximal policy optimisation; it has the fields of ``PolicyGradient``, too.

    Examples:
        >>> agent = PPO(clip=0.1, envs=4)
        >>> agent.family, agent.rollout
        ('rollout', 32)
        >>> PPO(envs=1, rollout=8, minibatches=16)
        Traceback (most recent call last):
            ...
        uard._checks.InvalidValueError: minibatches = 16: must be a whole number in [1, 8]

    Attributes:
        clip: How far a probability may move from the old one before its step stops counting, as a share of it, in
            (0, 0.99].
        entropy: Bonus for the policy's entropy (nats), >= 0, in units of the standardised advantage.
    """

    clip: float = 0.2
    entropy: float = 0.01

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        super().__post_init__()
        _checks.number("clip", self.clip, low=0, high=0.99, open_low=True)
        _checks.number("entropy", self.entropy, low=0)

    def update(self, state: State, experience: Experience, key: Array) -> tuple[State, UpdateInfo]:
        """Take ``epochs`` times ``minibatches`` steps of Adam on policy and critic."""
        batch = self._batch(experience)
        old = log_probability(heads.action_distribution(self.network, state.policy, batch.observation), batch.action)

        def one(s: State, x: tuple[Array, Array]) -> tuple[State, tuple[Array, Array]]:
            part, before = _take(batch, x[0]), old[x[0]]

            def loss(policy: Layers, layers: Layers) -> tuple[Array, tuple[Array, Array]]:
                distribution = heads.action_distribution(self.network, policy, part.observation)
                gain = clipped_surrogate(log_probability(distribution, part.action) - before, part.advantage, self.clip)
                gain = (part.weight * (gain + self.entropy * entropy(distribution))).mean()
                fit, info = self._critic_loss(self.ensemble, Weights(layers, s.value.prior), part, x[1])
                return fit - gain, (fit - gain, info[1])

            (to_policy, to_value), info = jax.grad(loss, (0, 1), has_aux=True)(s.policy, s.value.layers)
            policy, policy_optimiser = self._descend(to_policy, s.policy_optimiser, s.policy)
            layers, value_optimiser = self._descend(to_value, s.value_optimiser, s.value.layers)
            return State(policy, Weights(layers, s.value.prior), policy_optimiser, value_optimiser, ()), info

        state, (losses, largest) = lax.scan(one, state, self._shuffled(batch, key))
        return state, UpdateInfo(losses.sum(), largest.max())


@dataclass(frozen=True)
class TrustRegion(PolicyGradient):
    """What TRPO and CPO share: a step of the policy within a trust region; the critic is fitted by Adam after it.

    Attributes:
        delta: Largest mean KL divergence of the new policy from the old one (nats), in (0, 100] (E11).
        damping: Added to the diagonal of the Fisher matrix, > 0.
        conjugate_steps: Iterations of the conjugate gradient, in [1, 1000].
        backtracks: Steps that the line search tries, in [1, 1000].
        shrink: Each is this times the one before, in (0, 0.99].
    """

    delta: float = 0.01
    damping: float = 0.1
    conjugate_steps: int = 10
    backtracks: int = 10
    shrink: float = 0.8

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        super().__post_init__()
        _checks.number("delta", self.delta, low=0, high=100, open_low=True)
        _checks.number("damping", self.damping, low=0, open_low=True)
        _checks.whole("conjugate_steps", self.conjugate_steps, low=1, high=1000)
        _checks.whole("backtracks", self.backtracks, low=1, high=1000)
        _checks.number("shrink", self.shrink, low=0, high=0.99, open_low=True)


@final
@dataclass(frozen=True)
class TRPO(TrustRegion):
    """Trust-region policy optimisation; its fields are those of ``PolicyGradient`` and ``TrustRegion``.

    Examples:
        >>> TRPO(delta=0.02).damping
        0.1
        >>> TRPO(delta=0.0)
        Traceback (most recent call last):
            ...
        uard._checks.InvalidValueError: delta = 0.0: must be a finite number in (0, 100]
    """

    def update(self, state: State, experience: Experience, key: Array) -> tuple[State, UpdateInfo]:
        """Take one step of the policy, then fit the critic."""
        batch = self._batch(experience)
        policy = self.improved(state.policy, batch)
        value, optimiser, info = self._fitted(self.ensemble, state.value, state.value_optimiser, batch, key)
        return State(policy, value, state.policy_optimiser, optimiser, ()), info

    def improved(self, policy: Layers, batch: Batch) -> Layers:
        """Return the policy after one step of at most ``delta``; the same if no step of the line search improves it."""
        theta, shape = ravel_pytree(policy)
        distribution_of = _distribution_of(self.network, shape, batch)
        old = distribution_of(theta)

        def gain(theta: Array) -> Array:
            return surrogate(distribution_of(theta), old, batch.action, batch.weight * batch.advantage)

        gradient = jax.grad(gain)(theta)
        product = fisher_product(distribution_of, theta, self.damping)
        direction = conjugate_gradient(product, gradient, self.conjugate_steps)
        step = jnp.sqrt(2.0 * self.delta / jnp.maximum(direction @ product(direction), TINY)) * direction
        before = gain(theta)

        def accept(new: Array) -> Array:
            return (divergence(old, distribution_of(new)) <= self.delta) & (gain(new) > before)

        return shape(line_search(theta, step, accept, self.backtracks, self.shrink))


@final
@dataclass(frozen=True)
class CPO(TrustRegion):
    """Constrained policy optimisation: TRPO that keeps the cost of an episode within a budget.

    WARNING: with ``oracle`` (the default) the cost of a step is the HIDDEN TRUTH, whether the step was a hack. This is
    the one place in the package where a learner sees what only the evaluation may see; what it then achieves is a
    bound on what anybody could who knew every hack, not a result. Without it the cost is 0 everywhere, as the paper's
    evidently was: its CPO hacks as much as its other baselines; and CPO then is TRPO.

    The budget is kept per step: cost per step <= ``limit`` times episodes per step. The paper's discounted cost
    advantages stand in for undiscounted ones.

    It has the fields of ``PolicyGradient`` and ``TrustRegion``, too.

    Examples:
        >>> CPO(limit=1.0).needs_cost, CPO(oracle=False).needs_cost
        (True, False)
        >>> CPO(limit=-1.0)
        Traceback (most recent call last):
            ...
        uard._checks.InvalidValueError: limit = -1.0: must be a finite number >= 0

    Attributes:
        limit: Largest mean cost of an episode, >= 0.
        oracle: Whether hacks cost 1 each; see the warning.
    """

    limit: float = 0.5
    oracle: bool = True

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        super().__post_init__()
        _checks.number("limit", self.limit, low=0)

    @property
    def needs_cost(self) -> bool:
        """Whether the loop has to tell which steps were hacks."""
        return self.oracle

    def _fresh_costs(self, key: Array, features: int) -> tuple[Any, Array]:
        """Return a cost critic that expects no costs."""
        own, other = jax.random.split(key)
        weights = networks.init(SINGLE, self.network, other, features, 1)
        last = jax.tree.map(jnp.zeros_like, weights.layers[-1])
        weights = Weights((*weights.layers[:-1], last), None)
        return Costs(weights, self._adam().init(weights.layers), jnp.float32(0.0), jnp.float32(0.0)), own

    def update(self, state: State, experience: Experience, key: Array) -> tuple[State, UpdateInfo]:
        """Take one step of the policy, then fit both critics."""
        e, costs = experience, state.costs
        value_key, cost_key = jax.random.split(key)
        batch = self._batch(e)

        def critic(observations: Array) -> Array:
            return networks.values(SINGLE, self.network, costs.weights, observations)[0, ..., 0]

        values, next_values = jax.vmap(critic)(e.observation), jax.vmap(critic)(e.next_observation)
        advantage = gae(e.cost, values, next_values, e.terminated, e.done, self.gamma, self.gae_lambda)
        costly = batch._replace(
            advantage=_flat(advantage - advantage.mean()),
            target=_flat(values + advantage)[None],
            weight=jnp.ones_like(batch.weight),
        )
        # Episodes per step, over about the last 10 rollouts; episodes are never longer than the horizon.
        ends = ENDS_MEMORY * costs.ends + (1.0 - ENDS_MEMORY) * e.done.astype(jnp.float32).mean()
        trust = ENDS_MEMORY * costs.trust + (1.0 - ENDS_MEMORY)
        rate = jnp.maximum(ends / trust, 1.0 / e.horizon.astype(jnp.float32))
        excess = e.cost.mean() - self.limit * rate

        policy = self.constrained(state.policy, batch, costly.advantage, excess)
        value, optimiser, info = self._fitted(self.ensemble, state.value, state.value_optimiser, batch, value_key)
        weights, moments, of_costs = self._fitted(SINGLE, costs.weights, costs.optimiser, costly, cost_key)
        after = State(policy, value, state.policy_optimiser, optimiser, Costs(weights, moments, ends, trust))
        return after, UpdateInfo(info.loss + of_costs.loss, jnp.maximum(info.largest, of_costs.largest))

    def constrained(self, policy: Layers, batch: Batch, cost_advantage: Array, excess: Array) -> Layers:
        """Return the policy after one step within the trust region and, to first order, within the budget.

        Args:
            policy: The old policy.
            batch: What it did.
            cost_advantage: (B,), in units of cost.
            excess: By how much the old policy's cost per step is above the budget.
        """
        theta, shape = ravel_pytree(policy)
        distribution_of = _distribution_of(self.network, shape, batch)
        old = distribution_of(theta)

        def gain(theta: Array) -> Array:
            return surrogate(distribution_of(theta), old, batch.action, batch.weight * batch.advantage)

        def price(theta: Array) -> Array:
            return surrogate(distribution_of(theta), old, batch.action, cost_advantage)

        g, b = jax.grad(gain)(theta), jax.grad(price)(theta)
        product = fisher_product(distribution_of, theta, self.damping)
        solve = jax.vmap(lambda v: conjugate_gradient(product, v, self.conjugate_steps))
        to_gain, to_price = solve(jnp.stack([g, b]))
        q, r, s = g @ to_gain, g @ to_price, b @ to_price
        along, against, feasible = constrained_step(q, r, s, excess, self.delta)
        step = along * to_gain - against * to_price
        gain_before, price_before = gain(theta), price(theta)

        def accept(new: Array) -> Array:
            near = divergence(old, distribution_of(new)) <= self.delta
            cheap = price(new) - price_before <= jnp.maximum(-excess, 0.0)
            # Who is beyond the budget has to come back first, whatever the gain.
            better = (gain(new) > gain_before) | (excess > 0) | ~feasible
            return near & cheap & better

        return shape(line_search(theta, step, accept, self.backtracks, self.shrink))


ENDS_MEMORY = 0.9
TINY = 1e-20


def gae(
    reward: Array,
    values: Array,
    next_values: Array,
    terminated: Array,
    done: Array,
    gamma: Array | float,
    lam: Array | float,
) -> Array:
    """Generalised advantage estimate [Schulman et al. 2016, eq. 16] of (T, ...) steps; (T, ...).

    Examples:
        >>> zeros, ends = jnp.zeros(3), jnp.array([False, False, True])
        >>> gae(jnp.ones(3), zeros, zeros, ends, ends, gamma=0.5, lam=1.0).tolist()
        [1.75, 1.5, 1.0]

    Args:
        reward: (T, ...).
        values: (T, ...), V of the states.
        next_values: (T, ...), V of the states that the steps led to, also where an episode was cut off.
        terminated: (T, ...), where nothing follows.
        done: (T, ...), where the next row belongs to another episode.
        gamma: Discount, in [0, 1].
        lam: Lambda, in [0, 1].
    """
    delta = reward + jnp.where(terminated, 0.0, gamma * next_values) - values

    def back(later: Array, x: tuple[Array, Array]) -> tuple[Array, Array]:
        error, over = x
        advantage = error + jnp.where(over, 0.0, gamma * lam * later)
        return advantage, advantage

    return lax.scan(back, jnp.zeros_like(delta[0]), (delta, done), reverse=True)[1]


def standardised(advantage: Array, weight: Array) -> Array:
    """Return advantages of mean 0 and deviation 1, each counted by its weight."""
    total = jnp.maximum(weight.sum(), TINY)
    centred = advantage - (weight * advantage).sum() / total
    return centred / (jnp.sqrt((weight * centred**2).sum() / total) + 1e-8)


def clipped_surrogate(log_ratio: Array, advantage: Array, clip: Array | float) -> Array:
    """PPO's min(ratio A, clip(ratio, 1 - clip, 1 + clip) A) [Schulman et al. 2017, eq. 7], elementwise.

    Examples:
        >>> doubled = jnp.log(jnp.array([2.0, 2.0]))
        >>> gain = clipped_surrogate(doubled, advantage=jnp.array([1.0, -1.0]), clip=0.2)
        >>> [round(x, 3) for x in gain.tolist()]  # a gain stops to count, a loss does not
        [1.2, -2.0]

    Args:
        log_ratio: Log of an action's new probability over its old one, any shape.
        advantage: A, of the same shape.
        clip: In (0, 1).
    """
    ratio = jnp.exp(log_ratio)
    return jnp.minimum(ratio * advantage, jnp.clip(ratio, 1.0 - clip, 1.0 + clip) * advantage)


def surrogate(new: ActionDistribution, old: ActionDistribution, action: Array, advantage: Array) -> Array:
    """Return the mean of ratio times advantage (B,), for what two policies' distributions give the actions."""
    ratio = jnp.exp(log_probability(new, action) - lax.stop_gradient(log_probability(old, action)))
    return (ratio * advantage).mean()


def fisher_product(
    distribution_of: Callable[[Array], Any], theta: Array, damping: Array | float
) -> Callable[[Array], Array]:
    """Return v -> (F + damping) v, F the Fisher matrix of the mean KL at ``theta``.

    ``distribution_of`` maps parameters (P,) to the policy's distribution. F is J' M J / B, see ``heads.curvature``.
    """
    distribution, push = jax.linearize(distribution_of, theta)
    pull = jax.linear_transpose(push, theta)

    def product(v: Array) -> Array:
        return pull(heads.curvature(distribution, push(v)))[0] + damping * v

    return product


def conjugate_gradient(product: Callable[[Array], Array], b: Array, steps: int) -> Array:
    """Solve A x = b for a symmetric positive A, given as v -> A v; stops moving when the residual is rounding.

    Examples:
        >>> matrix = jnp.array([[2.0, 1.0], [1.0, 3.0]])
        >>> x = conjugate_gradient(lambda v: matrix @ v, jnp.array([4.0, 7.0]), steps=2)
        >>> [round(each, 3) for each in x.tolist()]
        [1.0, 2.0]

    Args:
        product: v -> A v, of vectors (P,).
        b: (P,).
        steps: Most iterations; P are enough but for rounding.
    """
    small = 1e-10 * (b @ b)

    def one(_: int, c: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        x, residual, direction, size = c
        going = size > small
        image = product(direction)
        length = jnp.where(going, size / jnp.where(going, direction @ image, 1.0), 0.0)
        x, residual = x + length * direction, residual - length * image
        after = residual @ residual
        direction = residual + jnp.where(going, after / jnp.where(going, size, 1.0), 0.0) * direction
        return x, residual, direction, after

    return lax.fori_loop(0, steps, one, (jnp.zeros_like(b), b, b, b @ b))[0]


def constrained_step(q: Array, r: Array, s: Array, excess: Array, delta: Array | float) -> tuple[Array, Array, Array]:
    """Solve CPO's problem by its dual [Achiam et al. 2017, theorem 2].

    Maximise g'x subject to b'x + excess <= 0 and x'Hx <= 2 delta, where q = g'H^-1 g, r = g'H^-1 b, s = b'H^-1 b.

    Examples:
        >>> q, r, s = jnp.float32(2.0), jnp.float32(1.0), jnp.float32(1.0)
        >>> for excess in (-10.0, 0.0, 2.0):  # the budget is far, used up, out of reach
        ...     along, against, feasible = constrained_step(q, r, s, jnp.float32(excess), delta=1.0)
        ...     print(round(along.item(), 3), round(against.item(), 3), feasible.item())
        1.0 0.0 True
        1.414 1.414 True
        0.0 1.414 False

    Args:
        q: See above, >= 0; () as all that follow.
        r: See above.
        s: See above, >= 0; 0 where nothing that is done changes the cost.
        excess: By how much the old policy's cost is above the budget.
        delta: Half the squared radius of the trust region, > 0.

    Returns:
        (along, against, feasible): x = along H^-1 g - against H^-1 b. If no x meets both conditions (``feasible`` is
        false), it is the one in the trust region that lowers the cost most.
    """
    radius = 2.0 * delta
    q = jnp.maximum(q, TINY)
    no_cost = s <= TINY
    s = jnp.where(no_cost, 1.0, s)
    room = radius - excess**2 / s  # of the trust region on the budget's plane; negative where it misses the plane
    feasible = no_cost | (excess <= 0) | (room > 0)

    # The dual is a concave and smooth function of lam = 1 / along, in two pieces: the budget binds where
    # lam excess + r > 0. So a stationary point that lies in its own piece is the maximum; one of the two does.
    # The floor is for g parallel to b: rounding would otherwise be multiplied by 1 / 0.
    binding = jnp.sqrt(jnp.maximum(q - r**2 / s, 1e-6 * q) / jnp.where(room > 0, room, 1.0))
    binds = ~no_cost & (room > 0) & (binding * excess + r > 0)
    lam = jnp.where(binds, binding, jnp.sqrt(q / radius))
    against = jnp.where(binds, (r / lam + excess) / s, 0.0)
    return (
        jnp.where(feasible, 1.0 / lam, 0.0),
        jnp.where(feasible, against, jnp.sqrt(radius / s)),
        feasible,
    )


def line_search(
    theta: Array, step: Array, accept: Callable[[Array], Array], tries: int, shrink: Array | float
) -> Array:
    """Return theta + shrink^i step for the first i < tries that is accepted, or theta."""

    def searching(c: tuple[Array, Array, Array]) -> Array:
        i, _, found = c
        return (i < tries) & ~found

    def one(c: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        i, factor, _ = c
        factor = jnp.where(i == 0, 1.0, factor * shrink)
        return i + 1, factor, accept(theta + factor * step)

    _, factor, found = lax.while_loop(searching, one, (jnp.int32(0), jnp.float32(1.0), jnp.asarray(False)))
    return jnp.where(found, theta + factor * step, theta)


def _distribution_of(network: Network, shape: Callable[[Array], Any], batch: Batch) -> Callable[[Array], Any]:
    return lambda theta: heads.action_distribution(network, shape(theta), batch.observation)


def _flat(x: Array) -> Array:
    return x.reshape(-1, *x.shape[2:])


def _take(batch: Batch, part: Array) -> Batch:
    target = batch.target[:, part]
    return Batch(batch.observation[part], batch.action[part], batch.advantage[part], target, batch.weight[part])
