"""Networks and ensembles: shapes, independence, fixed priors, dropout, mu and sigma_m."""

from __future__ import annotations

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from uard._checks import InvalidValueError
from uard.agents import networks
from uard.agents.networks import SINGLE, Ensemble, Network, Weights

NETWORK = Network(hidden=8, value_scale=5.0)
FEATURES, ACTIONS, BATCH = 6, 3, 4
KEY = jax.random.key(0)
ENSEMBLES = [SINGLE, Ensemble("full", 3), Ensemble("shared", 3), Ensemble("dropout", 3)]


@cache
def drawer(ensemble: Ensemble) -> Any:
    return jax.jit(lambda key: networks.init(ensemble, NETWORK, key, FEATURES, ACTIONS))


def drawn(ensemble: Ensemble, seed: int = 0) -> Weights:
    return drawer(ensemble)(jax.random.key(seed))


def seen(seed: int = 1) -> jax.Array:
    return jax.random.normal(jax.random.key(seed), (BATCH, FEATURES))


def values(ensemble: Ensemble, weights: Weights, x: jax.Array, **more: Any) -> np.ndarray:
    return np.asarray(networks.values(ensemble, NETWORK, weights, x, KEY, **more))


def by_hand(layers: Any, x: np.ndarray, activation: Any = lambda x: np.maximum(x, 0)) -> np.ndarray:
    """One stack of layers in NumPy."""
    for i, (weight, bias) in enumerate(layers):
        x = x @ np.asarray(weight) + np.asarray(bias)
        x = activation(x) if i + 1 < len(layers) else x
    return x


@pytest.mark.parametrize("ensemble", ENSEMBLES, ids=lambda e: f"{e.kind}-{e.members}")
def test_every_member_has_a_value_of_every_action(ensemble: Ensemble):
    out = values(ensemble, drawn(ensemble), seen())
    assert out.shape == (ensemble.members, BATCH, ACTIONS)
    assert np.isfinite(out).all()
    assert out.dtype == np.float32
    np.testing.assert_array_equal(out, values(ensemble, drawn(ensemble), seen()))
    assert (out != values(ensemble, drawn(ensemble, 1), seen())).any()


def test_a_network_with_tanh_by_hand():
    weights = drawn(SINGLE)
    curved = Network(hidden=8, value_scale=5.0, activation="tanh")
    out = np.asarray(networks.values(SINGLE, curved, weights, seen()))
    np.testing.assert_allclose(out[0], 5.0 * by_hand(weights.layers, np.asarray(seen()), np.tanh), rtol=1e-5, atol=1e-5)
    with pytest.raises(InvalidValueError, match="activation"):
        Network(activation="rely")  # type: ignore[arg-type]


def test_a_single_network_by_hand():
    weights = drawn(SINGLE)
    assert weights.prior is None
    np.testing.assert_allclose(values(SINGLE, weights, seen())[0], 5.0 * by_hand(weights.layers, seen()), atol=1e-5)


def test_members_of_a_full_ensemble_share_nothing():
    ensemble = Ensemble("full", 3)
    weights = drawn(ensemble)
    before = values(ensemble, weights, seen())
    prior = by_hand(weights.prior, np.asarray(seen())).reshape(BATCH, 3, ACTIONS)
    for k in range(3):
        layers = jax.tree.map(lambda x, k=k: x[k], weights.layers)
        expected = 5.0 * (by_hand(layers, seen()) + 0.1 * prior[:, k])
        np.testing.assert_allclose(before[k], expected, atol=1e-5)
    for i in range(3):
        bent = jax.tree.map(lambda x: x.at[1].add(0.1), weights.layers[i])
        changed = weights._replace(layers=(*weights.layers[:i], bent, *weights.layers[i + 1 :]))
        moved = (values(ensemble, changed, seen()) != before).any((1, 2))
        np.testing.assert_array_equal(moved, [False, True, False])
    one = np.asarray(weights.layers[0].weight)
    assert abs(one[0] - one[1]).max() > 0.1


def test_heads_of_a_shared_ensemble_stand_on_one_trunk():
    ensemble = Ensemble("shared", 3, prior_scale=0.0)
    weights = drawn(Ensemble("shared", 3))
    assert [layer.weight.shape for layer in weights.layers] == [(6, 8), (8, 8), (8, 9)]
    out = values(ensemble, weights, seen())
    flat = 5.0 * by_hand(weights.layers, seen())
    for k in range(3):
        np.testing.assert_allclose(out[k], flat[:, 3 * k : 3 * k + 3], atol=1e-5)
    trunk = weights.layers[0]._replace(bias=weights.layers[0].bias + 0.5)
    moved = values(ensemble, weights._replace(layers=(trunk, *weights.layers[1:])), seen()) != out
    assert moved.any((1, 2)).all()


@pytest.mark.parametrize("kind", ["full", "shared"])
def test_priors_are_added_and_never_learned(kind: Any):
    ensemble = Ensemble(kind, 3, prior_scale=0.7)
    weights = drawn(Ensemble(kind, 3))
    with_prior = values(ensemble, weights, seen())
    without = values(Ensemble(kind, 3, prior_scale=0.0), weights, seen())
    twice = values(Ensemble(kind, 3, prior_scale=1.4), weights, seen())
    assert (abs(with_prior - without) > 1e-3).any((1, 2)).all(), "every member has one"
    np.testing.assert_allclose(twice - without, 2 * (with_prior - without), atol=1e-4)

    def total(w: Weights) -> jax.Array:
        return (networks.values(ensemble, NETWORK, w, seen()) ** 2).sum()

    gradient = jax.grad(total)(weights)
    assert not any(np.asarray(x).any() for x in jax.tree.leaves(gradient.prior))
    assert all(np.asarray(layer.weight).any() for layer in gradient.layers)


def test_dropout_passes_differ_by_what_they_drop():
    ensemble = Ensemble("dropout", 5, dropout=0.5)
    weights = drawn(Ensemble("dropout", 3))
    out = values(ensemble, weights, seen())
    assert all((out[i] != out[j]).any() for i in range(5) for j in range(i))
    again = np.asarray(networks.values(ensemble, NETWORK, weights, seen(), jax.random.key(1)))
    assert (again != out).any()
    assert values(ensemble, weights, seen(), passes=1).shape == (1, BATCH, ACTIONS)
    plain = values(Ensemble("dropout", 5, dropout=0.0), weights, seen())
    np.testing.assert_allclose(plain, np.broadcast_to(5.0 * by_hand(weights.layers, seen()), plain.shape), atol=1e-5)


def test_dropout_keeps_the_expectation_of_a_linear_part():
    """With one hidden layer the output is linear in what is dropped."""
    ensemble = Ensemble("dropout", 5, dropout=0.3)
    layers = networks.mlp(KEY, (FEATURES, 64, 2))
    out = networks._dropped(ensemble, Network(), layers, seen(), KEY, 4000)
    plain = by_hand(layers, seen())
    error = np.asarray(out).std(0) / np.sqrt(4000)
    assert (abs(np.asarray(out).mean(0) - plain) < 5 * error).all()


def test_layers_are_orthogonal():
    single, several = networks.layer(KEY, 8, 5, gain=1.5), networks.layer(KEY, 8, 5, members=3, gain=1.5)
    assert single.weight.shape == (8, 5)
    assert several.weight.shape == (3, 8, 5)
    assert several.bias.shape == (3, 5)
    for w in (single.weight, *several.weight):
        np.testing.assert_allclose(w.T @ w, 1.5**2 * np.eye(5), atol=1e-5)
    assert abs(several.weight[0] - several.weight[1]).max() > 0.1


def test_mean_and_deviation_are_the_samples():
    all_values = np.random.default_rng(0).normal(size=(5, 4, 3)).astype(np.float32)
    mu, sigma = networks.mean_and_deviation(jnp.asarray(all_values))
    np.testing.assert_allclose(mu, all_values.mean(0), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(sigma, all_values.std(0, ddof=1), rtol=1e-5)
    mu, sigma = networks.mean_and_deviation(jnp.asarray(all_values[:1]))
    np.testing.assert_array_equal(mu, all_values[0])
    assert not np.asarray(sigma).any(), "a single member never disagrees"


def test_size_counts_numbers():
    assert networks.size(drawn(SINGLE)) == 6 * 8 + 8 + 8 * 8 + 8 + 8 * 3 + 3


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: Network(hidden=0), "hidden"),
        (lambda: Network(learning_rate=0.0), "learning_rate"),
        (lambda: Network(value_scale=0.0), "value_scale"),
        (lambda: Ensemble("fulll"), "kind"),  # type: ignore[arg-type]
        (lambda: Ensemble(members=0), "members"),
        (lambda: Ensemble(prior_scale=-1.0), "prior_scale"),
        (lambda: Ensemble(dropout=0.95), "dropout"),
    ],
)
def test_what_is_refused(make: Any, field: str):
    with pytest.raises(InvalidValueError, match=f"^{field} = "):
        make()


@pytest.mark.parametrize("ensemble", ENSEMBLES, ids=lambda e: f"{e.kind}-{e.members}")
def test_a_number_stands_for_its_one_hot_row(ensemble: Ensemble):
    """Values and gradients of places (B,) are those of one-hot rows; a place drawn twice counts twice."""
    weights, places = drawn(ensemble), jnp.array([3, 0, 3, 5])
    rows = jnp.asarray(np.eye(FEATURES, dtype=np.float32)[places])
    np.testing.assert_array_equal(values(ensemble, weights, places), values(ensemble, weights, rows))

    def slope(x: jax.Array) -> Any:
        def cost(layers: Any) -> jax.Array:
            return (networks.values(ensemble, NETWORK, Weights(layers, weights.prior), x, KEY) ** 2).sum()

        return jax.grad(cost)(weights.layers)

    of_places, of_rows = (jax.tree.leaves(slope(x)) for x in (places, rows))
    for one, other in zip(of_places, of_rows, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)
    first = np.asarray(of_places[0])
    assert np.any(first[..., 3, :] != 0)
    np.testing.assert_array_equal(first[..., [1, 2, 4], :], 0)


def test_the_chosen_are_those_at_their_places():
    all_values = jax.random.normal(KEY, (2, BATCH, ACTIONS)).at[0, 0, 0].set(jnp.nan)
    choice = jnp.array([1, 2, 0, 1])
    slots = jnp.broadcast_to(choice[None, :, None], (2, BATCH, 1))

    def gathered(v: jax.Array) -> jax.Array:
        return jnp.take_along_axis(v, slots, -1)[..., 0]

    np.testing.assert_array_equal(networks.batched_index(all_values, choice), gathered(all_values))
    ways = (lambda v: networks.batched_index(v, choice), gathered)
    one, other = (jax.grad(lambda v, f=f: (f(v) ** 3).sum())(all_values) for f in ways)
    np.testing.assert_array_equal(one, other)
