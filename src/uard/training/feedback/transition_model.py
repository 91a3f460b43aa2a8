"""What a learner in a continuous world knows of its raters: a sample of rated steps, and a model for all others.

No step comes twice, so there are no running means. ``Reservoir`` is a uniform sample of all steps rated so far (it must
not forget what honest steps look like when the agent no longer takes them); ``TransitionModel`` regresses, for each
rater, the gap between rating and observed reward, and how far apart the raters are, on (s, a, s', observed reward).
Where rewards tell the truth gaps are small, whatever the rewards are: the model distorts them far less than one of the
ratings themselves, which version 0.1 had.

A rater's prediction is worth as many answers as its variance, over members, goes into that of one answer: that is the
rater's ``count``, and the rules that ask who said what need not know that a model has answered.

sigma_h of a step is composed at use from the predicted ratings and the reward that was observed, which tells hacks
apart far better than a predicted deviation. The lowest rating is that of the rater who is predicted to say least: what
the lowest of several noisy ratings is on average sinks with the noise, and an agent that can end its episode then
prefers to fall.

Noise also makes predictions err, so that raters seem to differ, and steps to be disputed, where nothing is. Only that
part of a difference counts that is more than the members' own deviation (``soft_threshold``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array, lax

from uard import _checks
from uard.agents.networks import Layer, descend, mlp, through
from uard.method.feedback import ByRater, Feedback
from uard.method.mitigations import Mitigation, PanelStatistics
from uard.ratings.aggregate import aggregate

QUERIES = ("random", "doubtful")  # which steps are rated
BINS, SPREAD = 64, 2048  # of observed rewards; steps over which statistics of the panel are taken


@dataclass(frozen=True)
class TransitionModel:
    """An ensemble regression on a sample of rated steps.

    Examples:
        >>> TransitionModel(members=3, capacity=1000).fits
        200
        >>> TransitionModel(batch=256, capacity=100)
        Traceback (most recent call last):
            ...
        uard._checks.InvalidValueError: capacity = 100: must be a whole number in [256, 1e+07]

    Attributes:
        members: Networks, in [2, 64].
        hidden: Width of their two hidden layers, in [1, 4096].
        learning_rate: Adam's step size, in (0, 1].
        fits: Minibatches per fit, in [1, 100000]; there is one fit per 2048 environment steps.
        batch: Rated steps per minibatch, in [1, 65536].
        prior_scale: Size of the fixed random functions, in units of the ratings' deviation, > 0. It says how much is
            unknown before anybody rates: where noise makes the members differ by as much, nothing counts as known.
        capacity: Rated steps kept, >= ``batch``.
        deviations: Deviations of the members, >= 0, by which differences are reduced before they count; see
            ``soft_threshold``.
        predicts: ``gaps`` between ratings and observed reward, or the ``ratings`` themselves, as version 0.1 did.
    """

    members: int = 5
    hidden: int = 64
    learning_rate: float = 1e-3
    fits: int = 200
    batch: int = 256
    prior_scale: float = 1.0
    capacity: int = 16_384
    deviations: float = 1.0
    predicts: str = field(default="gaps", metadata={"omitted_at": "ratings"})

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.whole("members", self.members, low=2, high=64)
        _checks.whole("hidden", self.hidden, low=1, high=4096)
        _checks.number("learning_rate", self.learning_rate, low=0, high=1, open_low=True)
        _checks.whole("fits", self.fits, low=1, high=100_000)
        _checks.whole("batch", self.batch, low=1, high=65_536)
        _checks.number("prior_scale", self.prior_scale, low=0, open_low=True)
        _checks.whole("capacity", self.capacity, low=self.batch, high=10_000_000)
        _checks.number("deviations", self.deviations, low=0)
        _checks.choose("predicts", self.predicts, ("gaps", "ratings"))


class Reservoir(NamedTuple):
    """A uniform sample of the rated steps, on the host; changed in place.

    Attributes:
        inputs: (M, features) of the steps.
        targets: (M, K + 1), each rater's rating (0 where one is missing), and their deviation.
        answered: (M, K + 1), whether it is there.
        seen: (1,), how many steps were rated so far.
    """

    inputs: np.ndarray
    targets: np.ndarray
    answered: np.ndarray
    seen: np.ndarray


def features(observation: Any, action: Any, next_observation: Any, reward: Any) -> Any:
    """Return what the model sees of steps: (..., 2 F + D + 1)."""
    xp = jnp if isinstance(observation, jax.Array) else np
    return xp.concatenate([observation, action, next_observation - observation, reward[..., None]], -1)


def width(features: int, actions: int) -> int:
    """Return how many features of a step there are."""
    return 2 * features + actions + 1


def empty(spec: TransitionModel, width: int, raters: int) -> Reservoir:
    """Return a reservoir of nothing."""
    inputs, targets = (np.zeros((spec.capacity, w), np.float32) for w in (width, raters + 1))
    return Reservoir(inputs, targets, np.zeros(targets.shape, bool), np.zeros(1, np.int64))


def keep(
    reservoir: Reservoir, inputs: np.ndarray, ratings: np.ndarray, random: np.random.Generator, ddof: int = 0
) -> None:
    """Put rated steps into the sample [Vitter 1985, algorithm R]; ratings (B, K), NaN where one is missing."""
    capacity = len(reservoir.inputs)
    targets = np.column_stack([ratings, aggregate(ratings, np.zeros(len(ratings)), ddof=ddof).sd])
    answered = ~np.isnan(targets)
    rows = inputs, np.where(answered, targets, 0.0), answered
    numbers = reservoir.seen[0] + np.arange(len(inputs))
    places = np.where(numbers < capacity, numbers, random.integers(0, numbers + 1))
    kept = places < capacity
    for table, new in zip(reservoir[:3], rows, strict=True):
        table[places[kept]] = new[kept]  # where two take one place, NumPy leaves the later
    reservoir.seen[0] += len(inputs)


def chosen(query: str, share: float, knows: Callable[[], np.ndarray], rows: int, random: np.random.Generator) -> Any:
    """Return which of some steps are to be rated, (rows,) of bool, a ``share`` of them on average.

    Args:
        query: ``random``, each by itself; or ``doubtful``: half of them at random, so that the usual is not forgotten,
            half where the model knows least (uncertainty sampling).
        share: In [0, 1].
        knows: Gives how many ratings the model's predictions are worth, (rows,); asked only if that matters.
        rows: How many steps.
        random: Source of chance.
    """
    if query == "random":
        return random.random(rows) < share
    number = random.binomial(rows, share)
    order = random.permutation(rows)
    blind, rest = order[: number - number // 2], order[number - number // 2 :]
    least = rest[np.argsort(knows()[rest], kind="stable")[: number // 2]]
    out = np.zeros(rows, bool)
    out[np.concatenate([blind, least])] = True
    return out


class Model(NamedTuple):
    """Layers, Adam's moments, and the units: location and scale of the inputs, location and scale of the targets.

    The last is the variance (K,) of one answer of each rater about its prediction; negative for who never answered.
    """

    layers: tuple[Layer, ...]
    prior: tuple[Layer, ...]
    optimiser: Any
    centre: Array
    width: Array
    location: Array
    scale: Array
    noise: Array


def init(spec: TransitionModel, key: Array, width: int, raters: int) -> Model:
    """Draw a fresh model."""
    own, fixed = jax.random.split(key)
    layers = mlp(own, (width, spec.hidden, spec.hidden, raters + 1), spec.members, last_gain=0.1)
    prior = mlp(fixed, (width, spec.hidden, raters + 1), spec.members)
    zeros, ones = jnp.zeros(width, jnp.float32), jnp.ones(width, jnp.float32)
    location = jnp.zeros(raters + 1, jnp.float32)
    optimiser, silent = optax.adam(spec.learning_rate).init(layers), jnp.full(raters, -1.0, jnp.float32)
    return Model(layers, prior, optimiser, zeros, ones, location, jnp.float32(1.0), silent)


def _predict(spec: TransitionModel, layers: Any, prior: Any, inputs: Array) -> Array:
    """Return (members, B, K + 1), in units of the ratings' deviation."""
    return through(layers, inputs) + spec.prior_scale * lax.stop_gradient(through(prior, inputs))


def _normal(model: Model, inputs: Array) -> Array:
    return jnp.clip((inputs - model.centre) / model.width, -5.0, 5.0)


def soft_threshold(differences: Array, deviations: float) -> Array:
    """Return the mean over members (M, ...) less some of their deviations, 0 where it is not larger.

    Soft thresholding [Donoho 1995] at how far the members are apart.
    """
    mean = differences.mean(0)
    return jnp.sign(mean) * jnp.maximum(jnp.abs(mean) - deviations * differences.std(0, ddof=1), 0.0)


def read(spec: TransitionModel, model: Model, inputs: Array, raters: int) -> Feedback:
    """Predict the feedback of steps (B, width); ``proxy`` is the reward that was observed.

    ``count`` is how many ratings the prediction is worth, as in ``rating_model.read``.
    """
    x = _normal(model, inputs)
    out = _predict(spec, model.layers, model.prior, x)
    before = spec.prior_scale**2 * through(model.prior, x).var(0, ddof=1).mean(-1)
    after = out.var(0, ddof=1).mean(-1)
    count = jnp.maximum(before / jnp.maximum(after, 1e-6) - 1.0, 0.0)
    predicted = model.location + model.scale * out
    ratings = predicted[..., :-1]
    if spec.predicts == "gaps":
        ratings = ratings + inputs[:, -1:]
    means = ratings.mean(-1, keepdims=True)
    mean = means.mean((0, 2))
    lowest = mean + soft_threshold(ratings - means, spec.deviations).min(-1)
    typical = model.location[-1]
    sd = jnp.maximum(typical + soft_threshold(predicted[..., -1] - typical, spec.deviations), 0.0)
    heard = model.noise >= 0
    count = jnp.where(heard.any(), count, 0.0)  # before the first fit nothing is known, whatever the members say
    noise = jnp.where(heard, model.noise, 0.0)
    answers = jnp.where(heard, noise / jnp.maximum(ratings.var(0, ddof=1), 1e-6 * model.scale**2), 0.0)
    by_rater = ByRater(answers, ratings.mean(0), noise * jnp.maximum(answers - 1.0, 0.0))
    return Feedback(count, mean, lowest, sd, inputs[:, -1], jnp.full_like(mean, raters), by_rater)


@partial(jax.jit, static_argnames="spec")
def worth(spec: TransitionModel, model: Model, inputs: Array) -> Array:
    """Return ``read``'s count alone, (B,)."""
    return read(spec, model, inputs, 1).count


def nothing(rows: int) -> Feedback:
    """Return the feedback of steps that nobody was asked about."""
    none = jnp.zeros(rows, jnp.float32)
    return Feedback(none, none, none, none, none, none, ByRater(*(jnp.zeros((rows, 1), jnp.float32),) * 3))


def panel_statistics(
    mitigation: Mitigation, spec: TransitionModel, model: Any, sample: Array, seen: Array, raters: int
) -> Any:
    """Return the mitigation's statistics over the sampled rated steps; ``model`` () was never asked.

    Args:
        mitigation: Whose.
        spec: Of the model.
        model: Predicts the feedback of the steps.
        sample: (M, width) inputs of the steps.
        seen: How many steps were rated so far.
        raters: K.
    """
    if model == ():
        return mitigation.fit(nothing(1), jnp.zeros(1, bool))
    if spec.predicts == "ratings":
        feedback, known = read(spec, model, sample, raters), jnp.arange(sample.shape[0]) < seen
    else:
        places, known = distinct(sample[:, -1], seen)
        feedback = read(spec, model, sample[places], raters)
    return mitigation.fit(feedback, known & (feedback.count > 0))


def distinct(reward: Array, seen: Array) -> tuple[Array, Array]:
    """Choose steps whose observed rewards are spread evenly, and say which of the chosen ones count.

    In tables statistics are taken over distinct state-actions. Here no step comes twice, but an agent that sits in a
    trap fills the sample with it, and what raters say of the lie would be taken for their bias.

    Examples:
        >>> reward = jnp.array([0.0, 5.0, 5.0, 5.0, 5.0, 5.0])
        >>> places, known = distinct(reward, jnp.asarray(6))
        >>> reward[places[known]].tolist().count(0.0) / int(known.sum()) >= 1 / 6
        True

    Args:
        reward: (M,) of the sampled steps.
        seen: How many of them there are.
    """
    here = jnp.arange(reward.shape[0]) < seen
    low, high = jnp.nanquantile(jnp.where(here, reward, jnp.nan), jnp.array([0.01, 0.99]))
    place = jnp.clip(BINS * (reward - low) / jnp.maximum(high - low, 1e-6), 0, BINS - 1)
    place = jnp.where(here, place, 0).astype(jnp.int32)
    one = here.astype(jnp.float32)
    weight = one / jnp.maximum(jnp.bincount(place, one, length=BINS), 1.0)[place]
    total = jnp.cumsum(weight)
    chosen = jnp.searchsorted(total, total[-1] * (jnp.arange(SPREAD, dtype=jnp.float32) + 0.5) / SPREAD)
    return chosen, (seen > 0) & (jnp.diff(chosen, prepend=-jnp.ones_like(chosen[:1])) > 0)


def expecting(statistics: Any, feedback: Feedback) -> Any:
    """Return statistics in which each step's own predicted lowest rating stands for that of all steps.

    Anchors of few ratings are drawn towards the latter. A prediction is a regression's: it has been drawn already, and
    once more would make all steps, good and bad, look alike.
    """
    return statistics._replace(lowest=feedback.lowest) if isinstance(statistics, PanelStatistics) else statistics


def fit(spec: TransitionModel, model: Model, reservoir: Reservoir, key: Array) -> Model:
    """Train for ``fits`` minibatches of what the reservoir holds; unchanged before the first rating."""
    return _fit(spec, model, *reservoir[:3], reservoir.seen[0], key)


@partial(jax.jit, static_argnames="spec")
def _fit(
    spec: TransitionModel, model: Model, inputs: Array, targets: Array, answered: Array, seen: Array, key: Array
) -> Model:
    """Train on the first ``seen`` rows."""
    filled = jnp.minimum(seen, inputs.shape[0])
    mask = (jnp.arange(inputs.shape[0]) < filled)[:, None]
    here = mask & answered

    def moments(x: Array, here: Array) -> tuple[Array, Array]:
        total = jnp.maximum(here.sum(0), 1).astype(jnp.float32)
        centre = jnp.where(here, x, 0.0).sum(0) / total
        return centre, jnp.sqrt(jnp.where(here, (x - centre) ** 2, 0.0).sum(0) / total)

    centre, width = moments(inputs, mask)
    location, deviation = moments(targets, here)
    width = jnp.where(width > 1e-6, width, 1.0)
    typical = deviation[:-1].mean()
    scale = jnp.where(typical > 1e-6, typical, 1.0)
    if spec.predicts == "gaps":
        targets = targets.at[:, :-1].add(-inputs[:, -1:])
        location = moments(targets, here)[0]
    model = model._replace(centre=centre, width=width, location=location, scale=scale)

    def one(carry: tuple[Any, Any], k: Array) -> tuple[tuple[Any, Any], None]:
        layers, optimiser = carry
        drawn = jax.random.randint(k, (spec.members, spec.batch), 0, jnp.maximum(filled, 1))
        x = _normal(model, inputs[drawn])
        target = (targets[drawn] - location) / scale

        def loss(layers: Any) -> Array:
            out = _predict(spec, layers, model.prior, x)
            each = jnp.where(answered[drawn], optax.losses.huber_loss(out, target), 0.0)
            return each.mean((1, 2)).sum()

        return descend(spec.learning_rate, jax.grad(loss)(layers), optimiser, layers), None

    carry, _ = lax.scan(one, (model.layers, model.optimiser), jax.random.split(key, spec.fits))
    layers, optimiser = jax.tree.map(
        lambda new, old: jnp.where(filled > 0, new, old), carry, (model.layers, model.optimiser)
    )
    return model._replace(
        layers=layers, optimiser=optimiser, noise=_noise(spec, model, layers, inputs, targets, here, filled)
    )


BLOCK = 1024  # rows that are looked at together: of a sample that is still small, few


def _noise(
    spec: TransitionModel, model: Model, layers: Any, inputs: Array, targets: Array, here: Array, filled: Array
) -> Array:
    """Return how far each rater's answers lie from their predictions, a variance (K,); -1 where there are none."""
    rows, raters = inputs.shape[0], here.shape[1] - 1
    size = min(BLOCK, rows)

    def body(i: Array, sums: Array) -> Array:
        start = jnp.minimum(i * size, rows - size)  # the last block overlaps the one before
        new = (start + jnp.arange(size) >= i * size)[:, None]
        block, target, known = (lax.dynamic_slice_in_dim(x, start, size) for x in (inputs, targets, here))
        out = _predict(spec, layers, model.prior, _normal(model, block)).mean(0)
        apart = model.location + model.scale * out - target
        return sums + jnp.where(known & new, apart**2, 0.0)[:, :-1].sum(0)

    square = lax.fori_loop(0, -(-filled // size), body, jnp.zeros(raters, jnp.float32))
    answers = here[:, :-1].astype(jnp.float32).sum(0)
    return jnp.where(answers > 0, square / jnp.maximum(answers, 1.0), -1.0)
