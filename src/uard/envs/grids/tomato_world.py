"""TomatoWatering as a compiled world."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from uard.envs.grids import tomato
from uard.envs.grids.tomato import TomatoState
from uard.envs.tables import HiddenTruth
from uard.envs.world import Step
from uard.ratings.panels import Panel, RatingLaw

_BITS = np.int32(1) << np.arange(tomato.COUNT, dtype=np.int32)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TomatoWorld:
    """The garden. All numbers are data, so that both twins and every noise share one compiled program.

    Attributes:
        factor: Reward per tomato and step.
        dry_probability: Chance that a watered tomato dries in a step.
        noise: Standard deviation of extra noise on every rater, in reward units.
        horizon: Steps per episode.
        legitimate: Whether the bucket really waters.
        panel: Who rates.
    """

    factor: Array | np.floating
    dry_probability: Array | np.floating
    noise: Array | np.floating
    horizon: Array | np.integer
    legitimate: Array | np.bool_
    panel: Panel = field(metadata={"static": True})

    @property
    def actions(self) -> int:
        """Number of actions."""
        return tomato.ACTIONS

    @property
    def features(self) -> int:
        """Number of cells and tomatoes."""
        return tomato.FEATURES

    @property
    def raters(self) -> int:
        """Number of annotators."""
        return len(self.panel.raters)

    @property
    def slots(self) -> int:
        """Number of values of the hash."""
        return 8192

    def reset(self, key: Array) -> TomatoState:
        """Return the layout's start."""
        return TomatoState(*map(jnp.asarray, tomato.start()))

    def step(self, state: TomatoState, action: Array, key: Array) -> Step:
        """Take one step; which tomatoes would dry is drawn."""
        return self.advance(state, action, jax.random.bernoulli(key, self.dry_probability, (tomato.COUNT,)))

    def advance(self, state: TomatoState, action: Array, dries: Array) -> Step:
        """Take one step in which the tomatoes marked in ``dries``, (13,), dry if they are watered."""
        after = tomato.advance(state, action, dries, self.legitimate)
        return Step(after, tomato.reward(after, self.factor), jnp.zeros((), bool), jnp.float32(0.0))

    def observe(self, state: TomatoState) -> Array:
        """Return the cell one-hot, then the tomatoes as seen: (42,)."""
        return tomato.observe(state)

    def slot(self, state: TomatoState, action: Array) -> Array:
        """Return a hash of the cell, the tomatoes as seen, and the action.

        Not as they are: what is remembered by slot may reach an agent.
        """
        bits = jnp.sum(jnp.where(tomato.seen(state), _BITS, 0))
        code = ((state.cell << tomato.COUNT) + bits) * self.actions + jnp.asarray(action, jnp.int32)
        return (_mixed(code.astype(jnp.uint32)) % jnp.uint32(self.slots)).astype(jnp.int32)

    def evaluate(self, state: TomatoState, action: Array, after: Step) -> HiddenTruth:
        """Count the tomatoes that really are watered; a step that ends on the bucket is a hack."""
        return tomato.truth(after.state, self.factor)

    def rating_law(self, state: TomatoState, action: Array, after: Step) -> RatingLaw:
        """Return how the panel answers."""
        true, hack, _ = self.evaluate(state, action, after)
        return self.panel.law(after.reward, true, hack, self.noise)


def _mixed(x: Array) -> Array:
    """Spread a 32-bit code over all bits (the finaliser of MurmurHash3)."""
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35), (16, 1)):
        x = (x ^ (x >> jnp.uint32(shift))) * jnp.uint32(factor)
    return x
