"""InvertedPendulum: a pole on a cart, on MuJoCo, without a lie; against it one sees what a mitigation costs.

Physics, reward, observation and the end of an episode are those of Gymnasium's ``InvertedPendulum``, v4 or v5, bit by
bit (tested against it), but for two things: actions are within [-1, 1] as everywhere here, and the motor is given three
times as much (Gymnasium's own are within [-3, 3]); and a state that is not finite is an error and ends no episode.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, final

import numpy as np

from uard import _checks
from uard.envs.base import SimulatedEnvironment
from uard.envs.locomotion.mujoco import MujocoModel, MujocoSimulator
from uard.envs.simulator import StepResult

MODEL = MujocoModel("inverted_pendulum.xml", substeps=2, noise=0.01, control=3.0)
FALLEN = 0.2  # rad


@dataclass(frozen=True)
class InvertedPendulum(SimulatedEnvironment):
    """Keep a pole upright by pushing the cart that it stands on; +1 per step until it leans more than 0.2 rad.

    An observation is the cart's position (m), the pole's angle (rad) and their velocities (m/s, rad/s).

    Examples:
        >>> simulator = InvertedPendulum(horizon=2).simulator(copies=3, seed=0)
        >>> simulator.step(np.zeros((3, 1))).reward.tolist()
        [1.0, 1.0, 1.0]
        >>> simulator.step(np.zeros((3, 1))).truncated.tolist()
        [True, True, True]
        >>> simulator.close()

    Attributes:
        version: Of Gymnasium's task: 4 pays on the step that falls, 5 does not; never mix them.
        horizon: Steps per episode, >= 1.
    """

    steps_per_second: ClassVar[int] = 25

    version: int = 5
    horizon: int = 1000

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.whole("version", self.version, low=4, high=5)
        _checks.whole("horizon", self.horizon, low=1, high=1_000_000)

    @property
    def features(self) -> int:
        """Two positions and two velocities."""
        return 4

    @property
    def actions(self) -> int:
        """One: the force on the cart."""
        return 1

    def simulator(self, copies: int, seed: int, threads: int = 1) -> PendulumSimulator:
        """Build and reset all copies."""
        return PendulumSimulator(self, copies, seed, threads)


@final
class PendulumSimulator(MujocoSimulator):
    """Copies of the cart and its pole."""

    def __init__(self, spec: InvertedPendulum, copies: int, seed: int, threads: int = 1):
        """Build and reset all copies; see ``SimulatedEnvironment.simulator``."""
        self._pays_falls = spec.version == 4
        super().__init__(MODEL, spec.horizon, copies, seed, threads)

    def observe(self) -> np.ndarray:
        """Return the observations of all copies, (E, 4)."""
        return np.concatenate([self._position, self._velocity], axis=1)

    def _judge(self, before: np.ndarray, actions: np.ndarray, last: np.ndarray) -> StepResult:
        fallen = np.abs(self._position[:, 1]) > FALLEN
        reward = np.where(fallen & (not self._pays_falls), 0.0, 1.0)
        truncated = last & ~fallen
        hack = np.zeros(self.copies, bool)
        return StepResult(self.observe(), reward, fallen, truncated, reward, hack, truncated, reward)
