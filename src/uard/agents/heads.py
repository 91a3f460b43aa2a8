"""A policy's distribution over actions: discrete (categorical) or continuous (normal).

A policy over A discrete actions is its layers, and its distribution is logits (B, A). One over D continuous actions is
a ``GaussianPolicy``, and its distribution is a ``Normal``. Everything that policy gradients need of either is here, so
that PPO, TRPO and CPO do not know which of them they move.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from uard.agents import networks
from uard.agents.networks import Layer, Network

HALF_LOG_TAU = 0.5 * math.log(2.0 * math.pi)


class GaussianPolicy(NamedTuple):
    """Layers of the mean, and log deviations (D,) that do not depend on the state."""

    layers: tuple[Layer, ...]
    log_deviation: Array


class Normal(NamedTuple):
    """Independent normals: mean (B, D), log deviation (D,) or (B, D)."""

    mean: Array
    log_deviation: Array


ActionDistribution = Array | Normal


def init(key: Array, network: Network, features: int, actions: int, continuous: bool) -> Any:
    """Return a policy that is close to uniform, or to a standard normal."""
    layers = networks.mlp(key, (features, network.hidden, network.hidden, actions), last_gain=0.01)
    return GaussianPolicy(layers, jnp.zeros(actions, jnp.float32)) if continuous else layers


def action_distribution(network: Network, policy: Any, observations: Array) -> ActionDistribution:
    """Return a policy's distribution over actions at (B, features) observations."""
    if isinstance(policy, GaussianPolicy):
        return Normal(networks.through(policy.layers, observations, network.activation), policy.log_deviation)
    return networks.through(policy, observations, network.activation)


def draw(distribution: ActionDistribution, key: Array) -> Array:
    """Draw actions: (B,) integers, or (B, D) without bounds."""
    if isinstance(distribution, Normal):
        noise = jax.random.normal(key, distribution.mean.shape, distribution.mean.dtype)
        return distribution.mean + jnp.exp(distribution.log_deviation) * noise
    return jax.random.categorical(key, distribution).astype(jnp.int32)


def likeliest(distribution: ActionDistribution) -> Array:
    """Return the likeliest actions: (B,) integers, or (B, D)."""
    return distribution.mean if isinstance(distribution, Normal) else jnp.argmax(distribution, -1).astype(jnp.int32)


def log_probability(distribution: ActionDistribution, action: Array) -> Array:
    """Return the log-probability (discrete) or log-density (continuous) of actions, (B,)."""
    if isinstance(distribution, Normal):
        z = (action - distribution.mean) * jnp.exp(-distribution.log_deviation)
        return -(0.5 * z * z + distribution.log_deviation + HALF_LOG_TAU).sum(-1)
    return networks.batched_index(jax.nn.log_softmax(distribution), action)


def entropy(distribution: ActionDistribution) -> Array:
    """Return the entropy in nats: (B,), or () where it does not depend on the state."""
    if isinstance(distribution, Normal):
        return (distribution.log_deviation + 0.5 + HALF_LOG_TAU).sum(-1)
    logs = jax.nn.log_softmax(distribution)
    return -(jnp.exp(logs) * logs).sum(-1)


def divergence(old: ActionDistribution, new: ActionDistribution) -> Array:
    """Return the mean KL(old || new), in nats."""
    if isinstance(old, Normal):
        assert isinstance(new, Normal)
        apart = (old.mean - new.mean) ** 2 + jnp.exp(2.0 * old.log_deviation)
        each = new.log_deviation - old.log_deviation + 0.5 * apart * jnp.exp(-2.0 * new.log_deviation) - 0.5
        return each.sum(-1).mean()
    assert not isinstance(new, Normal)
    before, after = jax.nn.log_softmax(old), jax.nn.log_softmax(new)
    return (jnp.exp(before) * (before - after)).sum(-1).mean()


def curvature(distribution: ActionDistribution, direction: ActionDistribution) -> ActionDistribution:
    """Return M u / B: the second derivative of the mean KL at a distribution, times a direction in the same space.

    For logits M is diag(p) - p p' of each row; for normals it is 1 / deviation^2 of the means, and 2 of the log
    deviations.
    """
    if isinstance(distribution, Normal):
        assert isinstance(direction, Normal)
        rows = distribution.mean.shape[0]
        of_mean = jnp.exp(-2.0 * distribution.log_deviation) * direction.mean / rows
        shared = distribution.log_deviation.ndim == 1  # then the mean over rows is over equal terms
        return Normal(of_mean, 2.0 * direction.log_deviation / (1 if shared else rows))
    assert not isinstance(direction, Normal)
    p = jax.nn.softmax(distribution)
    return p * (direction - (p * direction).sum(-1, keepdims=True)) / p.shape[0]
