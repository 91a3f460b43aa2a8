"""What a deep learner knows of its raters: a memory of distinct rated steps, and a model of ratings for all others.

``Memory`` has the tabular learner's rows of feedback, one per slot, with the state-action behind it.
``RatingModel`` regresses them: a small ensemble with fixed random priors predicts, of any state-action, the gap between
each rater's mean rating and the observed reward, that of the lowest rating, their deviation sigma_h and the observed
reward, and how much it knows of them. Both answer with the same ``Feedback``, so no mitigation can tell which of them
it is given: a rater's prediction counts as many answers as its variance, over members, goes into that of one answer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array, lax

from uard import _checks
from uard.agents.networks import Layer, descend, mlp, through
from uard.method.feedback import ByRater, Feedback
from uard.ratings.aggregate import empty_rows, from_rows, merged, to_rows

REST = 3  # outputs after those of the raters: lowest, sd, proxy


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
    row = _read_alone(known.rows, slot)
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


def _read_alone(rows: Array, slot: Array) -> Array:
    """Return a row, read once.

    In a loop of its own, once round, of which the compiler does not know that it is once: it would otherwise read the
    row again wherever it is used, also beside the write, and for that copy all rows at every step: 20 us of 8192.
    """
    return lax.fori_loop(0, jnp.minimum(slot + 1, 1), lambda _, row: rows[slot], jnp.zeros_like(rows[0]))


BLOCK = 256  # rated slots that are looked at together


def of_rated(known: Memory, one: Callable[[Array], Any]) -> Any:
    """Return a pytree of tables (M, ...), filled for the slots that were rated and 0 elsewhere.

    Most slots are empty for most of a training: the work is that of the rated ones.

    Args:
        known: The memory.
        one: From some slots (B,) to what is put there, leaves (B, ...).
    """
    order, slots = known.order, known.order.shape[0]
    size = min(BLOCK, slots)
    shapes = jax.eval_shape(one, order[:size])
    tables = jax.tree.map(lambda s: jnp.zeros((slots, *s.shape[1:]), s.dtype), shapes)

    def body(i: Array, tables: Any) -> Any:
        # The last block overlaps the one before: it ends where the order does.
        start = jnp.minimum(i * size, slots - size)
        here = start + jnp.arange(size) < known.rated
        chosen = lax.dynamic_slice_in_dim(order, start, size)
        places = jnp.where(here, chosen, slots)  # beyond the end: dropped
        return jax.tree.map(lambda table, new: table.at[places].set(new, mode="drop"), tables, one(chosen))

    return lax.fori_loop(0, -(-known.rated // size), body, tables)


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
        fits: Minibatches per chunk of environment steps, in [1, 10000]. A model of gaps that has learned little sees
            none and believes the reward: 16 are enough in a training of 50 000 steps, but not in one of 10 000, for
            which the study ``games`` takes 64.
        batch: Distinct rated steps per minibatch, in [1, 65536].
        prior_scale: Size of the fixed random functions that make members disagree where nobody rated, in units of the
            ratings' deviation, > 0.
        predicts: ``gaps`` between ratings and observed reward, of each rater; or the ``ratings`` of all together, as
            version 0.1 did.
    """

    members: int = 5
    hidden: int = 32
    learning_rate: float = 3e-3
    fits: int = 16
    batch: int = 128
    prior_scale: float = 1.0
    predicts: str = field(default="gaps", metadata={"omitted_at": "ratings"})

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
        _checks.choose("predicts", self.predicts, ("gaps", "ratings"))

    def outputs(self, raters: int) -> int:
        """Return how many numbers are predicted of a state-action."""
        return (raters if self.predicts == "gaps" else 1) + REST


class Model(NamedTuple):
    """Trained and fixed layers, Adam's moments, and the units (outputs,) of location and scale.

    The last is the variance (K,) of one answer of each rater about its prediction; negative for who never answered.
    """

    layers: tuple[Layer, ...]
    prior: tuple[Layer, ...]
    optimiser: Any
    location: Array
    scale: Array
    noise: Array


def init(spec: RatingModel, key: Array, features: int, actions: int, raters: int) -> Model:
    """Draw a fresh model."""
    own, fixed = jax.random.split(key)
    outputs = spec.outputs(raters)
    sizes = (features, spec.hidden, actions * outputs)
    layers = mlp(own, sizes, spec.members, last_gain=0.1)
    prior = mlp(fixed, sizes, spec.members)
    ones = jnp.ones(outputs, jnp.float32)
    silent = jnp.full(raters, -1.0, jnp.float32)
    return Model(layers, prior, optax.adam(spec.learning_rate).init(layers), 0.0 * ones, ones, silent)


def _predict(spec: RatingModel, layers: Any, prior: Any, observations: Array, actions: int) -> Array:
    """Return (members, B, actions, outputs), in units of the observed reward's deviation."""
    out = through(layers, observations) + spec.prior_scale * lax.stop_gradient(through(prior, observations))
    return out.reshape(*out.shape[:2], actions, -1)


def read(spec: RatingModel, model: Model, observations: Array, actions: int, raters: int) -> Feedback:
    """Predict the feedback of all actions at observations (B, features): arrays (B, A).

    ``count`` is how many ratings the prediction is worth: the variance of the members' priors over the variance of
    their predictions, less one. It is near 0 where nothing like it was ever rated.
    """
    out = _predict(spec, model.layers, model.prior, observations, actions)
    before = spec.prior_scale**2 * through(model.prior, observations).var(0, ddof=1).mean(-1)
    after = out.var(0, ddof=1).mean(-1)
    count = jnp.maximum(before[:, None] / jnp.maximum(after, 1e-6) - 1.0, 0.0)
    predicted = model.location + model.scale * out.mean(0)
    lowest, sd, proxy = jnp.moveaxis(predicted[..., -REST:], -1, 0)
    everybody = jnp.full_like(proxy, raters)
    if spec.predicts == "ratings":
        return Feedback(count, predicted[..., 0], lowest, jnp.maximum(sd, 0.0), proxy, everybody)
    heard = model.noise >= 0
    count = jnp.where(heard.any(), count, 0.0)  # before the first fit nothing is known, whatever the members say
    noise = jnp.where(heard, model.noise, 0.0)
    variance = (model.scale * out)[..., :raters].var(0, ddof=1)
    answers = jnp.where(heard, noise / jnp.maximum(variance, 1e-6 * model.scale[0] ** 2), 0.0)
    ratings = proxy[..., None] + predicted[..., :raters]
    mean = jnp.where(heard, ratings, 0.0).sum(-1) / jnp.maximum(heard.astype(jnp.float32).sum(), 1.0)
    by_rater = ByRater(answers, ratings, noise * jnp.maximum(answers - 1.0, 0.0))
    return Feedback(count, mean, proxy + lowest, jnp.maximum(sd, 0.0), proxy, everybody, by_rater)


def observing(predicted: Feedback, reward: Array) -> Feedback:
    """Return predictions of steps whose reward was observed: the gaps are then added to that, not to a prediction."""
    if predicted.by_rater is None:
        return predicted
    shift = reward - predicted.proxy
    each = predicted.by_rater
    return predicted._replace(
        mean=predicted.mean + shift,
        lowest=predicted.lowest + shift,
        proxy=reward,
        by_rater=each._replace(mean=each.mean + shift[..., None]),
    )


def _targets(spec: RatingModel, feedback: Feedback) -> tuple[Array, Array]:
    """Return what is to be predicted of every slot, (M, outputs), and which of it is known."""
    rated = (feedback.count > 0)[:, None]
    if spec.predicts == "ratings":
        targets = jnp.stack([feedback.mean, feedback.lowest, feedback.sd, feedback.proxy], axis=-1)
        return targets, jnp.broadcast_to(rated, targets.shape)
    assert feedback.by_rater is not None
    proxy = feedback.proxy[:, None]
    rest = jnp.stack([feedback.lowest - feedback.proxy, feedback.sd, feedback.proxy], axis=-1)
    targets = jnp.concatenate([feedback.by_rater.mean - proxy, rest], axis=-1)
    here = jnp.concatenate([feedback.by_rater.count > 0, jnp.broadcast_to(rated, rest.shape)], axis=-1)
    return targets, here & rated


class _Lessons(NamedTuple):
    """What is learned of the slots: targets (M, outputs) in units of ``scale`` about ``location``, and which count."""

    target: Array
    here: Array
    location: Array
    scale: Array


def _lessons(spec: RatingModel, known: Memory) -> _Lessons:
    targets, here = _targets(spec, from_rows(known.rows))
    total = jnp.maximum(here.sum(0), 1).astype(jnp.float32)
    location = jnp.where(here, targets, 0.0).sum(0) / total
    deviation = jnp.sqrt((jnp.where(here, targets - location, 0.0) ** 2).sum(0) / total)
    # One unit for all: the observed reward's deviation, as the mitigations' own.
    unit = jnp.where(deviation[-1] > 0, deviation[-1], 1.0)
    scale = jnp.full_like(deviation, 1.0) * unit
    return _Lessons((targets - location) / scale, here, location, scale)


def _minibatches(spec: RatingModel, known: Memory, key: Array) -> Array:
    """Draw the slots of all minibatches, (fits, batch), evenly from the distinct rated ones."""

    def draw(k: Array) -> Array:
        return known.order[jax.random.randint(k, (spec.batch,), 0, jnp.maximum(known.rated, 1))]

    return jax.vmap(draw)(jax.random.split(key, spec.fits))


def _descended(spec: RatingModel, model: Model, known: Memory, lessons: _Lessons, loss: Any, batches: Any) -> Model:
    """Return the model after a step down ``loss`` (of layers and a minibatch) for each minibatch."""

    def one(carry: tuple[Any, Any], batch: Any) -> tuple[tuple[Any, Any], None]:
        layers, optimiser = carry
        return descend(spec.learning_rate, jax.grad(loss)(layers, batch), optimiser, layers), None

    before = model.layers, model.optimiser
    after, _ = lax.scan(one, before, batches)
    some = known.rated > 0
    layers, optimiser = jax.tree.map(lambda new, old: jnp.where(some, new, old), after, before)
    return Model(layers, model.prior, optimiser, lessons.location, lessons.scale, model.noise)


def fit(spec: RatingModel, model: Model, known: Memory, observe: Any, actions: int, key: Array) -> Model:
    """Train for ``fits`` minibatches of distinct rated steps; unchanged before the first rating."""
    lessons = _lessons(spec, known)
    target, here, _, _ = lessons

    def loss(layers: Any, drawn: Array) -> Array:
        observations = jax.vmap(observe)(jax.tree.map(lambda x: x[drawn], known.states))
        out = _predict(spec, layers, model.prior, observations, actions)
        each = optax.losses.huber_loss(_of_action(out, known.actions[drawn]), target[drawn])
        return jnp.where(here[drawn], each, 0.0).sum() / spec.batch

    return _descended(spec, model, known, lessons, loss, _minibatches(spec, known, key))


def fit_table(spec: RatingModel, model: Model, known: Memory, actions: int, key: Array) -> Model:
    """Do what ``fit`` does where slots are the state-actions of tables, observed by their number.

    Equal but for rounding. All states go through the network at once, and a slot counts as often as it was drawn: the
    first layer is then no look-up, whose gradient has to be gathered row by row, and the priors are asked once.
    """
    lessons = _lessons(spec, known)
    states, width = known.rows.shape[0] // actions, actions * lessons.target.shape[-1]
    drawn = _minibatches(spec, known, key)
    times = jnp.zeros((spec.fits, states * actions), jnp.float32)
    times = times.at[jnp.arange(spec.fits)[:, None], drawn].add(1.0 / spec.batch)
    here = lessons.here.astype(jnp.float32)
    goal = lessons.target.reshape(states, width) - spec.prior_scale * through(model.prior, jnp.arange(states))

    def loss(layers: tuple[Layer, ...], times: Array) -> Array:
        (weight, bias), *rest = layers
        out = through(tuple(rest), jax.nn.relu(weight + bias[:, None]))
        counts = (times[:, None] * here).reshape(states, width)
        return (counts * optax.losses.huber_loss(out, goal)).sum()

    return _descended(spec, model, known, lessons, loss, times)


def _of_action(values: Array, chosen: Array) -> Array:
    """Return (..., B, A, outputs) of the actions (B,) that were taken: (..., B, outputs)."""
    taken = jnp.arange(values.shape[-2]) == chosen[:, None]
    return jnp.where(taken[..., None], values, 0.0).sum(-2)


def with_noise(spec: RatingModel, model: Model, known: Memory, observe: Any, actions: int) -> Model:
    """Measure how far each rater's answers lie from their predictions, over the distinct rated state-actions."""
    if spec.predicts == "ratings":
        return model

    def gaps(slots: Array) -> Array:
        observations = jax.vmap(observe)(jax.tree.map(lambda x: x[slots], known.states))
        return _of_action(
            _predict(spec, model.layers, model.prior, observations, actions).mean(0), known.actions[slots]
        )

    feedback = from_rows(known.rows)
    assert feedback.by_rater is not None
    count, _, m2 = feedback.by_rater
    targets, here = _targets(spec, feedback)
    raters = count.shape[-1]
    predicted = (model.location + model.scale * of_rated(known, gaps))[:, :raters]
    each = m2 / jnp.maximum(count, 1.0) + (predicted - targets[:, :raters]) ** 2
    answered = here[:, :raters].astype(jnp.float32).sum(0)
    mean = jnp.where(here[:, :raters], each, 0.0).sum(0) / jnp.maximum(answered, 1.0)
    return model._replace(noise=jnp.where(answered > 0, mean, -1.0))
