"""What a policy's network says, as a distribution over actions: discrete (categorical) or continuous (normal).

A policy over A discrete actions is its layers, and what it says are logits (B, A). One over D continuous actions is a
``GaussianPolicy``, and what it says is a ``Normal``. Everything that policy gradients need of either is here, so that
PPO, TRPO and CPO do not know which of them they move.
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


Said = Array | Normal


def init(key: Array, network: Network, features: int, actions: int, continuous: bool) -> Any:
    """Return a policy that is close to uniform, or to a standard normal."""
    layers = networks.mlp(key, (features, network.hidden, network.hidden, actions), last_gain=0.01)
    return GaussianPolicy(layers, jnp.zeros(actions, jnp.float32)) if continuous else layers


def say(network: Network, policy: Any, observations: Array) -> Said:
    """Return what a policy says of (B, features) observations."""
    if isinstance(policy, GaussianPolicy):
        return Normal(networks.through(policy.layers, observations, network.activation), policy.log_deviation)
    return networks.through(policy, observations, network.activation)


def draw(said: Said, key: Array) -> Array:
    """Draw actions: (B,) integers, or (B, D) without bounds."""
    if isinstance(said, Normal):
        noise = jax.random.normal(key, said.mean.shape, said.mean.dtype)
        return said.mean + jnp.exp(said.log_deviation) * noise
    return jax.random.categorical(key, said).astype(jnp.int32)


def likeliest(said: Said) -> Array:
    """Return the likeliest actions: (B,) integers, or (B, D)."""
    return said.mean if isinstance(said, Normal) else jnp.argmax(said, -1).astype(jnp.int32)


def log_probability(said: Said, action: Array) -> Array:
    """Return the log-probability (discrete) or log-density (continuous) of actions, (B,)."""
    if isinstance(said, Normal):
        z = (action - said.mean) * jnp.exp(-said.log_deviation)
        return -(0.5 * z * z + said.log_deviation + HALF_LOG_TAU).sum(-1)
    return networks.batched_index(jax.nn.log_softmax(said), action)


def entropy(said: Said) -> Array:
    """Return the entropy in nats: (B,), or () where it does not depend on the state."""
    if isinstance(said, Normal):
        return (said.log_deviation + 0.5 + HALF_LOG_TAU).sum(-1)
    logs = jax.nn.log_softmax(said)
    return -(jnp.exp(logs) * logs).sum(-1)


def divergence(old: Said, new: Said) -> Array:
    """Return the mean KL(old || new), in nats."""
    if isinstance(old, Normal):
        assert isinstance(new, Normal)
        apart = (old.mean - new.mean) ** 2 + jnp.exp(2.0 * old.log_deviation)
        each = new.log_deviation - old.log_deviation + 0.5 * apart * jnp.exp(-2.0 * new.log_deviation) - 0.5
        return each.sum(-1).mean()
    assert not isinstance(new, Normal)
    before, after = jax.nn.log_softmax(old), jax.nn.log_softmax(new)
    return (jnp.exp(before) * (before - after)).sum(-1).mean()


def curvature(said: Said, direction: Said) -> Said:
    """Return M u / B: the second derivative of the mean KL at what is said, times a direction in the same space.

    For logits M is diag(p) - p p' of each row; for normals it is 1 / deviation^2 of the means, and 2 of the log
    deviations.
    """
    if isinstance(said, Normal):
        assert isinstance(direction, Normal)
        rows = said.mean.shape[0]
        of_mean = jnp.exp(-2.0 * said.log_deviation) * direction.mean / rows
        shared = said.log_deviation.ndim == 1  # then the mean over rows is over equal terms
        return Normal(of_mean, 2.0 * direction.log_deviation / (1 if shared else rows))
    assert not isinstance(direction, Normal)
    p = jax.nn.softmax(said)
    return p * (direction - (p * direction).sum(-1, keepdims=True)) / p.shape[0]
