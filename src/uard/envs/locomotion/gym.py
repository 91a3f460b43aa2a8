"""Hopper and Walker2d with a reward that lies, for Gymnasium.

The same physics and the same reward as in the laboratory (``uard.envs.locomotion.physics``). Importing ``uard.envs`` registers
``uard/Hopper-v0``, ``uard/Hopper-Vibration-v0``, ``uard/Hopper-Posture-v0``, their twins in which the bonus is real
(``uard/Hopper-Posture-Legitimate-v0``), and the same of Walker2d. MuJoCo is needed only to make one.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from uard import _checks
from uard.envs.grids.gym import Evaluation
from uard.envs.locomotion import physics as mujoco
from uard.envs.simulator import rate
from uard.ratings.panels import Panel, as_panel


class LocomotionEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One robot that is to run forward; its observed reward lies where its region says.

    Observations (F,) float64 and actions (D,) float32 in [-1, 1] are Gymnasium's. After each step ``info`` holds
    ``evaluation`` (never to be learned from) and, with a panel, ``ratings``: its K ratings of
    this step in reward units, a (K,) array drawn from ``np_random``.

    Attributes:
        spec_of: What robot, and how its reward lies.
        panel: Who rates, or None.
        render_mode: ``rgb_array`` (an (H, W, 3) picture; needs a graphics library, see MUJOCO_GL) or None.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 125}  # noqa: RUF012

    def __init__(
        self,
        *,
        robot: str = "hopper",
        region: mujoco.Region | str | None = None,
        legitimate: bool = False,
        version: int = 4,
        horizon: int = 1000,
        panel: str | Panel | None = None,
        noise: float = 0.0,
        render_mode: str | None = None,
    ):
        """Build the environment.

        Args:
            robot: ``hopper`` or ``walker2d``.
            region: Where the reward lies: ``vibration``, ``posture``, a ``Region``, or nowhere.
            legitimate: The twin in which the region's bonus is real.
            version: Of Gymnasium's task, 4 or 5.
            horizon: Steps per episode, >= 1.
            panel: Who rates each step, a ``Panel`` or a name in ``uard.ratings.panels.PANELS``; nobody if left out.
            noise: Standard deviation of extra normal noise on every rater, in reward units, >= 0.
            render_mode: ``rgb_array`` or None.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        if isinstance(region, str):
            _checks.choose("region", region, REGIONS)
            region = REGIONS[region]()
        lies: Any = region
        self.spec_of = mujoco.Locomotion(robot, version, lies, legitimate=legitimate, horizon=horizon)
        _checks.number("noise", noise, low=0)
        if render_mode is not None:
            _checks.choose("render_mode", render_mode, self.metadata["render_modes"])
        self.panel = None if panel is None else as_panel(panel)
        self.noise, self.render_mode = noise, render_mode
        features, motors = self.spec_of.features, self.spec_of.actions
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (features,), np.float64)  # type: ignore[assignment]
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (motors,), np.float32)  # type: ignore[assignment]
        self._physics: mujoco.Physics | None = None
        self._running = False
        self._pictures: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode from Gymnasium's noise about the standing robot."""
        super().reset(seed=seed)
        if self._physics is None or seed is not None:
            self._physics = mujoco.Physics(self.spec_of, 1, int(self.np_random.integers(2**63)))
        else:
            self._physics.reset(0)
        self._running = True
        return self._physics.observe()[0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Take one step and return (observation, observed reward, terminated, truncated, info).

        Raises:
            InvalidValueError: an action of another shape, not finite, or out of bounds.
            PhysicsError: the physics blew up.
            ResetNeeded: before the first ``reset`` and after an episode's end.
        """
        if not self._running or self._physics is None:
            raise gymnasium.error.ResetNeeded("no episode is running: call reset() first")
        moved = self._physics.step(np.asarray(action)[None])
        terminated, truncated = bool(moved.terminated[0]), bool(moved.truncated[0])
        self._running = not (terminated or truncated)
        info: dict[str, Any] = {"evaluation": Evaluation(float(moved.true_reward[0]), bool(moved.hack[0]))}
        if self.panel is not None:
            info["ratings"] = rate(self.panel, moved, self.noise, self.np_random)[0]
        return moved.observation[0], float(moved.reward[0]), terminated, truncated, info

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """Return a picture of the robot, seen from the side and followed."""
        if self.render_mode is None or self._physics is None:
            return None
        if self._pictures is None:
            self._pictures = self._physics.camera()
        return self._pictures(0)

    def close(self) -> None:
        """Let go of the physics."""
        if self._physics is not None:
            self._physics.close()


REGIONS = {"vibration": mujoco.Vibration, "posture": mujoco.Posture}


def _registered() -> dict[str, dict[str, Any]]:
    ids: dict[str, dict[str, Any]] = {}
    for robot, name in (("hopper", "Hopper"), ("walker2d", "Walker2d")):
        ids[f"uard/{name}-v0"] = {"robot": robot}
        for region in REGIONS:
            lies = {"robot": robot, "region": region}
            ids[f"uard/{name}-{region.title()}-v0"] = lies
            ids[f"uard/{name}-{region.title()}-Legitimate-v0"] = lies | {"legitimate": True}
    return ids


REGISTERED = _registered()


def register() -> None:
    """Register the ids with Gymnasium; once is enough."""
    for name, settings in REGISTERED.items():
        if name not in gymnasium.registry:
            gymnasium.register(id=name, entry_point="uard.envs.locomotion.gym:LocomotionEnv", kwargs=dict(settings))
