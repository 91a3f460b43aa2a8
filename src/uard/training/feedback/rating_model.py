"""What a deep learner knows of its raters: a memory of distinct rated steps, and a model of ratings for all others.

``Memory`` has the tabular learner's rows of feedback, one per slot, with the state-action behind it.
``RatingModel`` regresses them: a small ensemble with fixed random priors predicts the mean rating, the lowest, their
deviation sigma_h and the observed reward of any state-action, and how much it knows of it. Both answer with the same
``Feedback``, so no mitigation can tell which of them it is given.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array, lax

from uard import _checks
from uard.agents.networks import Layer, descend, mlp, through
from uard.method.mitigations import Feedback
from uard.ratings.aggregate import empty_rows, from_rows, merged, to_rows

OUTPUTS = 4  # mean, lowest, sd, proxy


class Memory(NamedTuple):
    """What is known of ratings, by slot.

    Attributes:
        rows: (M, width) of feedback, see ``uard.ratings.aggregate``.
        states: The state last rated there, leaves (M, ...).
        actions: (M,), its action.
        order: (M,), slots in the order in which they were first rated.
        rated: How many slots were rated.
    """

    rows: Array
    states: Any
    actions: Array
    order: Array
    rated: Array


def memory(slots: int, state: Any, raters: int) -> Memory:
    """Return an empty memory for states like ``state``."""
    states = jax.tree.map(lambda x: jnp.zeros((slots, *jnp.shape(x)), jnp.asarray(x).dtype), state)
    rows = empty_rows((slots,), raters, jnp, jnp.float32)
    return Memory(rows, states, jnp.zeros(slots, jnp.int32), jnp.zeros(slots, jnp.int32), jnp.int32(0))


def remember(known: Memory, slot: Array, state: Any, action: Array, visit: Feedback, rated: Array) -> Memory:
    """Return the memory after one more visit; unchanged if ``rated`` is 0."""
    row = known.rows[slot]
    first = (row[0] == 0) & (rated > 0)
    put = rated > 0
    states = jax.tree.map(lambda table, new: table.at[slot].set(jnp.where(put, new, table[slot])), known.states, state)
    place = jnp.minimum(known.rated, known.order.shape[0] - 1)
    return Memory(
        known.rows.at[slot].set(merged(row, to_rows(visit), rated)),
        states,
        known.actions.at[slot].set(jnp.where(put, action, known.actions[slot])),
        known.order.at[place].set(jnp.where(first, slot, known.order[place])),
        known.rated + first.astype(jnp.int32),
    )


@dataclass(frozen=True)
class RatingModel:
    """An ensemble regression on the rated steps.

    Examples:
        >>> RatingModel(members=3, hidden=16).fits
        16
        >>> RatingModel(members=1)
        Traceback (most recent call last):
            ...
        uard._checks.InvalidValueError: members = 1: must be a whole number in [2, 64]

    Attributes:
        members: Networks, in [2, 64].
        hidden: Width of their one hidden layer, in [1, 4096].
        learning_rate: Adam's step size, in (0, 1].
        fits: Minibatches per chunk of environment steps, in [1, 10000].
        batch: Distinct rated steps per minibatch, in [1, 65536].
        prior_scale: Size of the fixed random functions that make members disagree where nobody rated, in units of the
            ratings' deviation, > 0.
    """

    members: int = 5
    hidden: int = 32
    learning_rate: float = 3e-3
    fits: int = 16
    batch: int = 128
    prior_scale: float = 1.0

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.whole("members", self.members, low=2, high=64)
        _checks.whole("hidden", self.hidden, low=1, high=4096)
        _checks.number("learning_rate", self.learning_rate, low=0, high=1, open_low=True)
        _checks.whole("fits", self.fits, low=1, high=10_000)
        _checks.whole("batch", self.batch, low=1, high=65_536)
        _checks.number("prior_scale", self.prior_scale, low=0, open_low=True)


class Model(NamedTuple):
    """Trained and fixed layers, Adam's moments, and the units (OUTPUTS,) of location and scale."""

    layers: tuple[Layer, ...]
    prior: tuple[Layer, ...]
    optimiser: Any
    location: Array
    scale: Array


def init(spec: RatingModel, key: Array, features: int, actions: int) -> Model:
    """Draw a fresh model."""
    own, fixed = jax.random.split(key)
    sizes = (features, spec.hidden, actions * OUTPUTS)
    layers = mlp(own, sizes, spec.members, last_gain=0.1)
    prior = mlp(fixed, sizes, spec.members)
    ones = jnp.ones(OUTPUTS, jnp.float32)
    return Model(layers, prior, optax.adam(spec.learning_rate).init(layers), 0.0 * ones, ones)


def _predict(spec: RatingModel, layers: Any, prior: Any, observations: Array, actions: int) -> Array:
    """Return (members, B, actions, OUTPUTS), in units of the ratings' deviation."""
    out = through(layers, observations) + spec.prior_scale * lax.stop_gradient(through(prior, observations))
    return out.reshape(*out.shape[:2], actions, OUTPUTS)


def read(spec: RatingModel, model: Model, observations: Array, actions: int, raters: int) -> Feedback:
    """Predict the feedback of all actions at observations (B, features): arrays (B, A).

    ``count`` is how many ratings the prediction is worth: the variance of the members' priors over the variance of
    their predictions, less one. It is near 0 where nothing like it was ever rated.
    """
    out = _predict(spec, model.layers, model.prior, observations, actions)
    before = spec.prior_scale**2 * through(model.prior, observations).var(0, ddof=1).mean(-1)
    after = out.var(0, ddof=1).mean(-1)
    count = jnp.maximum(before[:, None] / jnp.maximum(after, 1e-6) - 1.0, 0.0)
    mean, lowest, sd, proxy = jnp.moveaxis(model.location + model.scale * out.mean(0), -1, 0)
    return Feedback(count, mean, lowest, jnp.maximum(sd, 0.0), proxy, jnp.full_like(mean, raters))


def fit(spec: RatingModel, model: Model, known: Memory, observe: Any, actions: int, key: Array) -> Model:
    """Train for ``fits`` minibatches of distinct rated steps; unchanged before the first rating."""
    feedback = from_rows(known.rows)
    rated = (feedback.count > 0)[:, None]
    total = jnp.maximum(rated.sum(), 1).astype(jnp.float32)
    targets = jnp.stack([feedback.mean, feedback.lowest, feedback.sd, feedback.proxy], axis=-1)
    location = jnp.where(rated, targets, 0.0).sum(0) / total
    deviation = jnp.sqrt((jnp.where(rated, targets - location, 0.0) ** 2).sum(0) / total)
    # One unit for all: the observed reward's deviation, as the mitigations' own.
    unit = jnp.where(deviation[-1] > 0, deviation[-1], 1.0)
    scale = jnp.full_like(deviation, 1.0) * unit
    some = known.rated > 0

    def one(carry: tuple[Any, Any], k: Array) -> tuple[tuple[Any, Any], None]:
        layers, optimiser = carry
        drawn = known.order[jax.random.randint(k, (spec.batch,), 0, jnp.maximum(known.rated, 1))]
        states = jax.tree.map(lambda x: x[drawn], known.states)
        observations = jax.vmap(observe)(states)
        target = (targets[drawn] - location) / scale
        here = jnp.arange(actions) == known.actions[drawn][:, None]

        def loss(layers: Any) -> Array:
            out = _predict(spec, layers, model.prior, observations, actions)
            each = optax.losses.huber_loss(out, target[None, :, None])
            return jnp.where(here[:, :, None], each, 0.0).sum() / spec.batch

        gradient = jax.grad(loss)(layers)
        after = descend(spec.learning_rate, gradient, optimiser, layers)
        return jax.tree.map(lambda new, old: jnp.where(some, new, old), after, carry), None

    (layers, optimiser), _ = lax.scan(one, (model.layers, model.optimiser), jax.random.split(key, spec.fits))
    return Model(layers, model.prior, optimiser, location, scale)
