"""CartPole and Acrobot in JAX, in float32; the specs are in ``uard.envs.classic.specs``."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from uard.envs.tables import HiddenTruth
from uard.envs.world import Step
from uard.ratings.panels import Panel, RatingLaw

GRAVITY = 9.8  # m/s^2

# CartPole, SI units
PUSH, TICK = 10.0, 0.02
POLE, HALF = 0.1, 0.5  # the pole's mass and half its length
TOTAL = 1.0 + POLE  # with the cart
EDGE, FALLEN = 2.4, math.radians(12)

# Acrobot, SI units; both links are 1 m long, weigh 1 kg and have their centre of mass in the middle
SWING = 0.2
CENTRE, INERTIA = 0.5, 1.0
FASTEST = np.array([4 * math.pi, 9 * math.pi], np.float32)


class Rules(NamedTuple):
    """What tells one problem from the other.

    Attributes:
        actions: Number of actions.
        features: Length of an observation.
        start: Every number of a first state is drawn from -start to start.
        step: From a state and an action to the state after it, the reward and whether the episode terminates.
        observe: From a state to the observation.
        goal: Whether to terminate is to reach a goal.
    """

    actions: int
    features: int
    start: float
    step: Callable[[Array, Array], tuple[Array, Array, Array]]
    observe: Callable[[Array], Array]
    goal: bool


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ClassicWorld:
    """The cart or the pendulum; a state is (4,).

    One class with static rules, not one class each: JAX 0.10 takes two registered dataclasses with the same fields for
    the same structure, and now and then gives one the program that was compiled for the other.

    Attributes:
        horizon: Steps per episode.
        noise: Standard deviation of extra noise on every rater, in reward units.
        panel: Who rates.
        rules: Which problem it is.
    """

    horizon: Array | np.integer
    noise: Array | np.floating
    panel: Panel = field(metadata={"static": True})
    rules: Rules = field(metadata={"static": True})

    @property
    def actions(self) -> int:
        """Number of actions."""
        return self.rules.actions

    @property
    def features(self) -> int:
        """Length of an observation."""
        return self.rules.features

    @property
    def raters(self) -> int:
        """Number of annotators."""
        return len(self.panel.raters)

    @property
    def slots(self) -> int:
        """One: states that are continuous do not come back."""
        return 1

    def reset(self, key: Array) -> Array:
        """Draw a first state."""
        return jax.random.uniform(key, (4,), jnp.float32, -self.rules.start, self.rules.start)

    def step(self, state: Array, action: Array, key: Array) -> Step:
        """Take one step, in which nothing is random."""
        return Step(*self.rules.step(state, action), jnp.float32(0.0))

    def observe(self, state: Array) -> Array:
        """Return the observation."""
        return self.rules.observe(state)

    def slot(self, state: Array, action: Array) -> Array:
        """Return 0."""
        return jnp.int32(0)

    def evaluate(self, state: Array, action: Array, after: Step) -> HiddenTruth:
        """Repeat the observed reward; there is no hack."""
        return HiddenTruth(after.reward, jnp.zeros((), bool), after.terminated & self.rules.goal)

    def rating_law(self, state: Array, action: Array, after: Step) -> RatingLaw:
        """Return how the panel answers."""
        return self.panel.law(after.reward, after.reward, jnp.zeros(after.reward.shape, bool), self.noise)


def _push(state: Array, action: Array) -> tuple[Array, Array, Array]:
    """Push the cart for one tick (Euler's method); a state is position, velocity, angle and angular velocity."""
    _, velocity, angle, spin = state
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    push = jnp.where(action == 1, jnp.float32(PUSH), jnp.float32(-PUSH))
    drive = (push + POLE * HALF * spin**2 * sin) / TOTAL
    turn = (GRAVITY * sin - cos * drive) / (HALF * (4 / 3 - POLE * cos**2 / TOTAL))
    speeding = drive - POLE * HALF * turn * cos / TOTAL
    after = state + TICK * jnp.stack([velocity, speeding, spin, turn])
    return after, jnp.float32(1.0), (jnp.abs(after[0]) > EDGE) | (jnp.abs(after[2]) > FALLEN)


def _itself(state: Array) -> Array:
    """The cart is seen as it is."""
    return state


def _turn(state: Array, action: Array) -> tuple[Array, Array, Array]:
    """Apply a torque for 0.2 s (one step of the fourth-order Runge-Kutta method).

    A state is the two angles in [-pi, pi] and their angular velocities.
    """
    torque = jnp.asarray(action, jnp.float32) - 1.0
    k1 = _swing(state, torque)
    k2 = _swing(state + SWING / 2 * k1, torque)
    k3 = _swing(state + SWING / 2 * k2, torque)
    k4 = _swing(state + SWING * k3, torque)
    after = state + SWING / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    # Whole turns are taken off in a way that leaves angles within half a turn untouched, to the last bit.
    angles = after[:2] - 2 * math.pi * jnp.round(after[:2] / (2 * math.pi))
    speeds = jnp.clip(after[2:], -FASTEST, FASTEST)
    terminated = -jnp.cos(angles[0]) - jnp.cos(angles[0] + angles[1]) > 1.0
    reward = jnp.where(terminated, jnp.float32(0.0), jnp.float32(-1.0))
    return jnp.concatenate([angles, speeds]), reward, terminated


def _directions(state: Array) -> Array:
    """Cosine and sine of each angle, then the velocities."""
    first, second, *speeds = state
    return jnp.stack([jnp.cos(first), jnp.sin(first), jnp.cos(second), jnp.sin(second), *speeds])


def _swing(state: Array, torque: Array) -> Array:
    """Return the state's derivative in time."""
    first, second, first_speed, second_speed = state
    cos, sin = jnp.cos(second), jnp.sin(second)
    d1 = CENTRE**2 + (1 + CENTRE**2 + 2 * CENTRE * cos) + 2 * INERTIA
    d2 = CENTRE**2 + CENTRE * cos + INERTIA
    # An angle's sine where the book writes the cosine of the angle less a right angle.
    phi2 = CENTRE * GRAVITY * jnp.sin(first + second)
    phi1 = -CENTRE * second_speed * (second_speed + 2 * first_speed) * sin
    phi1 = phi1 + (CENTRE + 1) * GRAVITY * jnp.sin(first) + phi2
    push = torque + d2 / d1 * phi1 - CENTRE * first_speed**2 * sin - phi2
    second_turn = push / (CENTRE**2 + INERTIA - d2**2 / d1)
    return jnp.stack([first_speed, second_speed, -(d2 * second_turn + phi1) / d1, second_turn])


CART_POLE = Rules(2, 4, 0.05, _push, _itself, goal=False)
ACROBOT = Rules(3, 6, 0.1, _turn, _directions, goal=True)
