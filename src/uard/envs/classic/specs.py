"""CartPole-v1 and Acrobot-v1: problems without a lie, against which one sees what a mitigation costs.

Dynamics, rewards, starts and horizons are those of Gymnasium 1.4; a test holds each step to its. The observed reward is
the true one and no step is contested, so every panel but for its noise tells the truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from uard import _checks
from uard.envs.base import CompiledEnvironment
from uard.ratings.panels import Panel

if TYPE_CHECKING:
    from uard.envs.classic.world import ClassicWorld


@dataclass(frozen=True)
class CartPole(CompiledEnvironment):
    """Keep a pole upright on a cart by pushing it left (0) or right (1); +1 per step, the last one included.

    Source: Barto, Sutton and Anderson (1983), as ``CartPole-v1``. An observation is the cart's position (m) and
    velocity (m/s), the pole's angle from upright (rad) and angular velocity (rad/s). The episode terminates beyond
    2.4 m or 12 degrees. There is no goal.

    Examples:
        >>> import jax
        >>> from uard.ratings.panels import MAIN
        >>> world = CartPole().world(MAIN)
        >>> after = jax.jit(world.step)(np.zeros(4, np.float32), 1, jax.random.key(0))
        >>> [round(float(x), 2) for x in after.state], float(after.reward)  # pushed to the right
        ([0.0, 0.2, 0.0, -0.29], 1.0)

    Attributes:
        horizon: Steps per episode, >= 1.
    """

    horizon: int = 500

    def __post_init__(self) -> None:
        """Check everything.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.whole("horizon", self.horizon, low=1, high=100_000)

    def world(self, panel: Panel, noise: float = 0.0) -> ClassicWorld:
        """Return the compiled world, each step rated by a panel (needs JAX)."""
        from uard.envs.classic.world import CART_POLE, ClassicWorld

        _checks.number("noise", noise, low=0)
        return ClassicWorld(np.int32(self.horizon), np.float32(noise), panel, CART_POLE)


@dataclass(frozen=True)
class Acrobot(CompiledEnvironment):
    """Swing a two-link pendulum up with torques -1, 0 or +1 N m (0, 1, 2) at its middle joint; -1 per step.

    Source: Sutton (1996) with the equations of Sutton and Barto's book, as ``Acrobot-v1``. An observation is the cosine
    and sine of the first link's angle (from hanging down) and of the second's (from the first), then their angular
    velocities (rad/s). The episode terminates, with reward 0, when the free end is more than one link's length above
    the fixed joint: the goal.

    Examples:
        >>> from uard.ratings.panels import MAIN
        >>> world = Acrobot(horizon=200).world(MAIN)
        >>> world.actions, world.features, world.horizon.item()
        (3, 6, 200)
        >>> Acrobot(horizon=0)
        Traceback (most recent call last):
            ...
        uard._checks.InvalidValueError: horizon = 0: must be a whole number in [1, 100000]

    Attributes:
        horizon: Steps per episode, >= 1.
    """

    horizon: int = 500

    def __post_init__(self) -> None:
        """Check everything.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.whole("horizon", self.horizon, low=1, high=100_000)

    def world(self, panel: Panel, noise: float = 0.0) -> ClassicWorld:
        """Return the compiled world, each step rated by a panel (needs JAX)."""
        from uard.envs.classic.world import ACROBOT, ClassicWorld

        _checks.number("noise", noise, low=0)
        return ClassicWorld(np.int32(self.horizon), np.float32(noise), panel, ACROBOT)
