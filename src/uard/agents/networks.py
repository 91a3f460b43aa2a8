"""Networks of the deep agents, and ensembles of them, as pytrees and pure functions.

What must be the same for all agents that are compared (J35) is one object, ``Network``. An ensemble returns one value
per member, (N, B, outputs); its mean is mu, its deviation sigma_m (A16, A17).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from uard import _checks
from uard.method import uncertainty

Kind = Literal["full", "shared", "dropout"]
KINDS = ("full", "shared", "dropout")
Activation = Literal["relu", "tanh"]
ACTIVATIONS: dict[str, Callable[[Array], Array]] = {"relu": jax.nn.relu, "tanh": jnp.tanh}


@dataclass(frozen=True)
class Network:
    """What all deep agents have in common: size, step size, unit of values.

    Attributes:
        hidden: Width of each of the two hidden layers.
        learning_rate: Adam's step size, > 0.
        value_scale: Values are this many times the network's output, > 0: the size of a large return.
        activation: ``relu``, or ``tanh``, with which policy gradients learn far better in MuJoCo.
    """

    hidden: int = 64
    learning_rate: float = 1e-3
    value_scale: float = 10.0
    activation: Activation = "relu"

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.whole("hidden", self.hidden, low=1, high=4096)
        _checks.number("learning_rate", self.learning_rate, low=0, high=1, open_low=True)
        _checks.number("value_scale", self.value_scale, low=0, open_low=True)
        _checks.choose("activation", self.activation, ACTIVATIONS)


@dataclass(frozen=True)
class Ensemble:
    """How several estimates are had of one value (K4, K9).

    Attributes:
        kind: ``full``: independent networks; ``shared``: heads on one trunk; ``dropout``: one network, its hidden units
            dropped at random, several passes.
        members: Number of estimates N; 1 is a single network.
        prior_scale: Size of the fixed random function that is added to each member, in units of ``value_scale``, so
            that members disagree where there was no data [Osband et al. 2018]. Not for ``dropout``.
        dropout: Share of hidden units that a ``dropout`` pass leaves out, in [0, 0.9].
    """

    kind: Kind = "shared"
    members: int = 5
    prior_scale: float = 0.1
    dropout: float = 0.1

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.choose("kind", self.kind, KINDS)
        _checks.whole("members", self.members, low=1, high=64)
        _checks.number("prior_scale", self.prior_scale, low=0)
        _checks.number("dropout", self.dropout, low=0, high=0.9)


SINGLE = Ensemble("full", 1, 0.0)


class Layer(NamedTuple):
    """Weights (..., inputs, outputs) and bias (..., outputs)."""

    weight: Array
    bias: Array


class Weights(NamedTuple):
    """Trained layers, and the fixed layers of the random priors (None without)."""

    layers: tuple[Layer, ...]
    prior: tuple[Layer, ...] | None


PRIOR_WIDTH = 16  # a prior need not be learned, so it may be small


def layer(key: Array, inputs: int, outputs: int, members: int | None = None, gain: float = 2.0**0.5) -> Layer:
    """Draw a layer with orthogonal weights and no bias, as is usual in deep RL."""
    shape = (inputs, outputs) if members is None else (members, inputs, outputs)
    # One member after the other: LAPACK waits for a batch inside the pool of threads that has to work on it, so two
    # batches at once have waited for each other for ever on two cores.
    normal = jax.nn.initializers.orthogonal(gain)
    weight = (
        normal(key, shape, jnp.float32)
        if members is None
        else jax.lax.map(lambda k: normal(k, (inputs, outputs), jnp.float32), jax.random.split(key, members))
    )
    return Layer(weight, jnp.zeros((*shape[:-2], outputs), jnp.float32))


def mlp(key: Array, sizes: tuple[int, ...], members: int | None = None, last_gain: float = 1.0) -> tuple[Layer, ...]:
    """Draw a stack of layers; ``members`` independent ones if given."""
    keys = jax.random.split(key, len(sizes) - 1)
    gains = [2.0**0.5] * (len(sizes) - 2) + [last_gain]
    pairs = pairwise(sizes)
    return tuple(layer(k, a, b, members, g) for k, (a, b), g in zip(keys, pairs, gains, strict=True))


def through(layers: tuple[Layer, ...], x: Array, activation: Activation = "relu") -> Array:
    """Apply a stack, the activation between: (B, inputs) to (B, outputs), or (N, B, outputs) for N stacks.

    Whole numbers (B,) stand for one-hot rows, whose product with a weight is a row of it.
    """
    for i, (weight, bias) in enumerate(layers):
        x = times(x, weight) + bias[..., None, :]
        if i + 1 < len(layers):
            x = ACTIVATIONS[activation](x)
    return x


def times(x: Array, weight: Array) -> Array:
    """Return x weight of rows (..., B, inputs), or of the whole numbers (..., B) that stand for one-hot rows.

    The look-up spares the gradient's products with zeros, about half of what a small network on a grid costs.
    """
    if jnp.issubdtype(x.dtype, jnp.integer):
        return weight.at[..., x, :].get(mode="promise_in_bounds")
    return jnp.matmul(x, weight)


def init(ensemble: Ensemble, network: Network, key: Array, features: int, outputs: int) -> Weights:
    """Draw an ensemble's weights."""
    n, width = ensemble.members, network.hidden
    own, fixed = jax.random.split(key)
    prior = None
    if ensemble.kind == "dropout" or n == 1:
        return Weights(mlp(own, (features, width, width, outputs), last_gain=0.1), None)
    if ensemble.kind == "full":
        layers = mlp(own, (features, width, width, outputs), n, last_gain=0.1)
    else:
        layers = mlp(own, (features, width, width, n * outputs), last_gain=0.1)
    prior = mlp(fixed, (features, PRIOR_WIDTH, n * outputs), last_gain=1.0)
    return Weights(layers, prior)


def values(
    ensemble: Ensemble,
    network: Network,
    weights: Weights,
    observations: Array,
    key: Array | None = None,
    passes: int = 0,
) -> Array:
    """Return every member's values, (N, B, outputs), of observations (B, features).

    Args:
        ensemble: Kind and number of members.
        network: Gives the unit of values.
        weights: From ``init``.
        observations: (B, features).
        key: For ``dropout`` only.
        passes: Number of dropout passes; ``members`` if 0 (training takes one).
    """
    n, scale = ensemble.members, network.value_scale
    if ensemble.kind == "dropout" and n > 1:
        assert key is not None
        return scale * _dropped(ensemble, network, weights.layers, observations, key, passes or n)
    out = through(weights.layers, observations, network.activation)
    if n == 1:
        return scale * out[None]
    if ensemble.kind == "shared":
        out = _by_member(out, n)
    assert weights.prior is not None
    doubt = _by_member(through(weights.prior, observations), n)
    return scale * (out + ensemble.prior_scale * jax.lax.stop_gradient(doubt))


def _by_member(out: Array, members: int) -> Array:
    return jnp.moveaxis(out.reshape(out.shape[0], members, -1), 1, 0)


def _dropped(
    ensemble: Ensemble, network: Network, layers: tuple[Layer, ...], x: Array, key: Array, passes: int
) -> Array:
    x = jnp.broadcast_to(x, (passes, *x.shape))
    keys = jax.random.split(key, len(layers))
    for i, (weight, bias) in enumerate(layers):
        x = times(x, weight) + bias
        if i + 1 < len(layers):
            kept = jax.random.uniform(keys[i], x.shape) >= ensemble.dropout
            x = jnp.where(kept, ACTIVATIONS[network.activation](x) / (1.0 - ensemble.dropout), 0.0)
    return x


def batched_index(values: Array, choice: Array) -> Array:
    """Return the values (..., A) of the actions chosen, (...): what ``take_along_axis`` returns.

    Summed over a mask, whose gradient is another; that of a gather is a scatter, element by element on a CPU.
    """
    here = jnp.arange(values.shape[-1]) == choice[..., None]
    return jnp.where(here, values, 0.0).sum(-1)


def mean_and_deviation(all_values: Array) -> tuple[Array, Array]:
    """Return mu and sigma_m of (N, ...) values; a single member never disagrees."""
    if all_values.shape[0] == 1:
        return all_values[0], jnp.zeros_like(all_values[0])
    return all_values.mean(0), uncertainty.sigma_model(all_values, axis=0)


def descend(learning_rate: Array | float, gradient: Any, moments: Any, weights: Any) -> tuple[Any, Any]:
    """Take one step of Adam: return the weights and the moments after it."""
    # Optax raises a float to an integer, which JAX forbids where all promotions have to be written out.
    with jax.numpy_dtype_promotion("standard"):
        step, moments = optax.adam(learning_rate).update(gradient, moments)
        return optax.apply_updates(weights, step), moments


def size(tree: Any) -> int:
    """Return the number of numbers in a pytree."""
    return sum(int(np.prod(x.shape)) for x in jax.tree.leaves(tree))
