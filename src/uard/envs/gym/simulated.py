"""Environments that run on the host, as Gymnasium environments with continuous actions."""

from __future__ import annotations

from typing import Any, final

import gymnasium
import numpy as np

from uard.envs.base import SimulatedEnvironment
from uard.envs.gym.rated import Evaluation, RatedEnv, Stepped
from uard.envs.simulator import Simulator, rate
from uard.ratings.panels import Panel


@final
class SimulatedEnv(RatedEnv[np.ndarray, np.ndarray]):
    """One copy of an environment that runs on the host; the same physics and reward as in the laboratory.

    Observations are (F,) float64, actions (D,) float32 in [-1, 1]. ``render_mode`` is ``rgb_array`` (an (H, W, 3)
    picture; needs a graphics library, see MUJOCO_GL) or None. ``info`` is that of ``RatedEnv``.

    Examples:
        >>> from uard.envs.locomotion.inverted_pendulum import InvertedPendulum
        >>> env = SimulatedEnv(InvertedPendulum(), panel="main")
        >>> observation, info = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(np.array([0.5]))
        >>> observation.shape, reward, info["ratings"].shape
        ((4,), 1.0, (3,))
        >>> env.close()
    """

    def __init__(
        self,
        problem: SimulatedEnvironment,
        *,
        panel: str | Panel | None = None,
        noise: float = 0.0,
        render_mode: str | None = None,
    ):
        """Build the environment; arguments and errors as for ``RatedEnv``."""
        super().__init__(problem, panel, noise, render_mode, ["rgb_array"], problem.steps_per_second)
        box = gymnasium.spaces.Box
        self.observation_space = box(-np.inf, np.inf, (problem.features,), np.float64)  # type: ignore[assignment]
        self.action_space = box(-1.0, 1.0, (problem.actions,), np.float32)  # type: ignore[assignment]
        self._problem = problem
        self._simulator: Simulator | None = None
        self._camera: Any = None

    def _begin(self, seed: int | None) -> np.ndarray:
        if self._simulator is None or seed is not None:
            self.close()
            self._simulator = self._problem.simulator(1, int(self.np_random.integers(2**63)))
        else:
            self._simulator.reset(0)
        return self._simulator.observe()[0]

    def _take(self, action: np.ndarray) -> Stepped[np.ndarray]:
        assert self._simulator is not None
        result = self._simulator.step(np.asarray(action)[None])
        info: dict[str, Any] = {"evaluation": Evaluation(float(result.true_reward[0]), bool(result.hack[0]))}
        if self.panel is not None:
            info["ratings"] = rate(self.panel, result, self.noise, self.np_random)[0]
        ends = bool(result.terminated[0]), bool(result.truncated[0])
        return result.observation[0], float(result.reward[0]), *ends, info

    def _draw(self) -> np.ndarray:
        assert self._simulator is not None
        if self._camera is None:
            self._camera = self._simulator.camera()
        return self._camera(0)

    def close(self) -> None:
        """Let go of the simulator."""
        if self._simulator is not None:
            self._simulator.close()
        self._simulator = self._camera = None
        self._running = False
