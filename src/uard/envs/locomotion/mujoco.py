"""Models that come with Gymnasium, on MuJoCo: several copies stepped together, saved to the bit, and filmed."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from uard import _checks
from uard.envs.simulator import Simulator, StepResult

Array = np.ndarray
INSTALL = "pip install 'uard[mujoco]'"
OLDEST, TOO_NEW = (3, 0), (5, 0)


class PhysicsError(FloatingPointError):
    """The physics of a copy left the finite numbers."""


@dataclass(frozen=True)
class MujocoModel:
    """A model, and how its task runs it.

    Attributes:
        file: Name of the model among those that come with Gymnasium.
        substeps: Physics steps per action.
        noise: The first positions and velocities are uniform within so much of the model's own.
        control: What a motor is given for an action of 1.
    """

    file: str
    substeps: int
    noise: float
    control: float = 1.0


def _mujoco() -> Any:
    """Import MuJoCo, or say what to do."""
    try:
        import mujoco
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"this environment needs MuJoCo: {INSTALL}", name="mujoco") from error
    if not OLDEST <= tuple(int(x) for x in mujoco.__version__.split(".")[:2]) < TOO_NEW:
        allowed = f"{'.'.join(map(str, OLDEST))} or later, before {'.'.join(map(str, TOO_NEW))}"
        raise ImportError(f"MuJoCo {mujoco.__version__} was not tried; needs {allowed}: {INSTALL}")
    return mujoco


@cache
def _load(file: str) -> Any:
    import gymnasium.envs

    mujoco = _mujoco()
    folder = Path(gymnasium.envs.__path__[0]) / "mujoco" / "assets"
    loaded = mujoco.MjModel.from_xml_path(str(folder / file))
    # MuJoCo would put a robot whose physics blew up back to its start without a word to the learner.
    loaded.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return loaded


class MujocoSimulator(Simulator):
    """Copies of a model; subclasses say what an agent sees of it (``observe``) and what a step is worth (``_judge``).

    Examples:
        >>> from uard.envs.locomotion.inverted_pendulum import InvertedPendulum
        >>> simulator = InvertedPendulum().simulator(copies=1, seed=0)
        >>> saved = simulator.save()
        >>> once = simulator.step(np.ones((1, 1))).observation
        >>> simulator.load(saved)
        >>> again = simulator.step(np.ones((1, 1))).observation
        >>> np.abs(again - once).max().item(), round(simulator.seconds, 3)
        (0.0, 0.04)
        >>> simulator.close()

    Attributes:
        model: What is simulated.
        horizon: Steps per episode.
    """

    def __init__(self, model: MujocoModel, horizon: int, copies: int, seed: int, threads: int = 1):
        """Build and reset all copies.

        Args:
            model: What is simulated.
            horizon: Steps per episode.
            copies: E, in [1, 65536].
            seed: Of the first states, a whole number >= 0.
            threads: Threads that share the copies, in [1, 256]; results do not depend on it.

        Raises:
            InvalidValueError: for copies or threads out of their range.
            ImportError: MuJoCo is not there (a ``ModuleNotFoundError``), or is of a version that was not tried; with
                what to install.
        """
        mujoco = _mujoco()
        _checks.whole("copies", copies, low=1, high=65_536)
        _checks.whole("threads", threads, low=1, high=256)
        self.model, self.horizon, self.copies = model, horizon, copies
        self._mujoco, self._model = mujoco, _load(model.file)
        self._data = [mujoco.MjData(self._model) for _ in range(copies)]
        self._whole = mujoco.mjtState.mjSTATE_INTEGRATION
        self._random = np.random.Generator(np.random.PCG64(seed))
        self._time = np.zeros(copies, np.int64)
        # Views of MuJoCo's memory, made once: to ask a copy for them takes longer than to read them.
        self._controls = [d.ctrl for d in self._data]
        self._leaves = [getattr(d, name) for name in ("qpos", "qvel", "qacc") for d in self._data]
        self._state = np.zeros((3, copies, self._model.nv))
        self._position, self._velocity, self._acceleration = self._state
        cuts = np.linspace(0, copies, min(threads, copies) + 1).astype(int)
        self._parts = [self._data[a:b] for a, b in pairwise(cuts)]
        self._pool = ThreadPoolExecutor(len(self._parts) - 1) if len(self._parts) > 1 else None
        for i in range(copies):
            self.reset(i)

    @property
    def seconds(self) -> float:
        """Simulated time of one step, s."""
        return self.model.substeps * self._model.opt.timestep

    @abstractmethod
    def _judge(self, before: Array, actions: Array, last: Array) -> StepResult:
        """Return what the step to the present state led to.

        Args:
            before: (E, nq) positions before the step.
            actions: (E, D) as they were taken.
            last: (E,) whether the step is the last before the horizon.
        """

    def reset(self, i: int) -> None:
        """Begin an episode in copy ``i``, with Gymnasium's noise."""
        data, m = self._data[i], self._model
        self._mujoco.mj_resetData(m, data)
        noise = self.model.noise
        data.qpos[:] = m.qpos0 + self._random.uniform(-noise, noise, m.nq)
        data.qvel[:] = self._random.uniform(-noise, noise, m.nv)
        self._mujoco.mj_forward(m, data)
        self._position[i], self._velocity[i] = data.qpos, data.qvel
        self._time[i] = 0

    def step(self, actions: Array) -> StepResult:
        """Take one step in every copy, actions (E, D) in [-1, 1]; copies whose episode ended begin a new one.

        Raises:
            InvalidValueError: actions of another shape, not finite, or out of bounds.
            PhysicsError: a copy's state left the finite numbers; names copy and step.
        """
        actions = self._checked(actions)
        before = self._position.copy()
        self._advance(actions * self.model.control)
        finite = np.isfinite(self._state[:2]).all((0, 2))
        if not finite.all():
            i = int(np.argmin(finite))
            raise PhysicsError(
                f"the physics of copy {i} left the finite numbers at step {self._time[i]} of its episode; "
                f"actions {actions[i].tolist()}"
            )
        result = self._judge(before, actions, self._time + 1 >= self.horizon)
        self._time += 1
        for i in np.nonzero(result.terminated | result.truncated)[0]:
            self.reset(int(i))
        return result

    def _checked(self, actions: Array) -> Array:
        actions, shape = np.asarray(actions, float), (self.copies, self._model.nu)
        if actions.shape != shape:
            raise _checks.InvalidValueError("actions.shape", actions.shape, str(shape))
        if not (np.abs(actions) <= 1.0).all():
            worst = actions.ravel()[np.argmax(np.where(np.isnan(actions), np.inf, np.abs(actions)))]
            raise _checks.InvalidValueError("actions", float(worst), "within [-1, 1]")
        return actions

    def _advance(self, controls: Array) -> None:
        for place, control in zip(self._controls, controls, strict=True):
            place[:] = control
        others = [self._pool.submit(self._integrate, part) for part in self._parts[1:]] if self._pool else []
        self._integrate(self._parts[0])
        for other in others:
            other.result()
        np.concatenate(self._leaves, out=self._state.reshape(-1))

    def _integrate(self, part: list[Any]) -> None:
        # Nothing else in this loop: MuJoCo lets go of Python's lock while it steps, and threads that touch arrays
        # between steps wait for each other most of the time.
        step, m, substeps = self._mujoco.mj_step, self._model, self.model.substeps
        for data in part:
            step(m, data, substeps)

    def save(self) -> dict[str, Array]:
        """Return the whole state: physics, times, random numbers."""
        n = self._mujoco.mj_stateSize(self._model, self._whole)
        physics = np.zeros((self.copies, n))
        for row, data in zip(physics, self._data, strict=True):
            self._mujoco.mj_getState(self._model, data, row, self._whole)
        inner = self._random.bit_generator.state["state"]
        words = [(inner[k] >> (64 * j)) & (2**64 - 1) for k in ("state", "inc") for j in range(2)]
        return {"physics": physics, "time": self._time.copy(), "random": np.array(words, np.uint64)}

    def load(self, saved: dict[str, Array]) -> None:
        """Go on from what ``save`` gave; the future is then the same to the bit.

        Raises:
            InvalidValueError: it was saved from another model or another number of copies.
        """
        n = self._mujoco.mj_stateSize(self._model, self._whole)
        if saved["physics"].shape != (self.copies, n):
            allowed = f"({self.copies}, {n}), that of {self.copies} copies of {self.model.file}"
            raise _checks.InvalidValueError("physics.shape", saved["physics"].shape, allowed)
        for i, (row, data) in enumerate(zip(saved["physics"], self._data, strict=True)):
            self._mujoco.mj_setState(self._model, data, row, self._whole)
            self._position[i], self._velocity[i] = data.qpos, data.qvel
        self._time = np.array(saved["time"])
        words = [int(w) for w in saved["random"]]
        state = {"state": words[0] | words[1] << 64, "inc": words[2] | words[3] << 64}
        self._random.bit_generator.state = {"bit_generator": "PCG64", "state": state, "has_uint32": 0, "uinteger": 0}

    def camera(self, height: int = 240, width: int = 320) -> Callable[[int], Array]:
        """Return what takes a picture (height, width, 3) of a copy, from the side, following it.

        Needs a graphics library; without a screen set the environment variable MUJOCO_GL to egl or osmesa.
        """
        renderer = self._mujoco.Renderer(self._model, height, width)
        follow = self._mujoco.MjvCamera()
        follow.type, follow.trackbodyid = self._mujoco.mjtCamera.mjCAMERA_TRACKING, 1
        follow.distance, follow.elevation, follow.azimuth = 2.8, -10.0, 90.0

        def picture(i: int) -> Array:
            renderer.update_scene(self._data[i], follow)
            return renderer.render()

        return picture

    def close(self) -> None:
        """Let the threads go."""
        if self._pool:
            self._pool.shutdown()
