"""What all our Gymnasium environments share: steps that a panel rates, and what they were really worth."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, final

import gymnasium

from uard import _checks
from uard.envs.base import Environment
from uard.ratings.panels import Panel, as_panel

Observation = TypeVar("Observation")
Action = TypeVar("Action")
Stepped = tuple[Observation, float, bool, bool, dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Evaluation:
    """What a step was really worth: for evaluation only, nothing that learns may read it.

    Examples:
        >>> from uard.envs.gym import make
        >>> env = make("BoatRace")
        >>> state, info = env.reset(seed=0)
        >>> state, reward, terminated, truncated, info = env.step(3)
        >>> reward, info["evaluation"]
        (2.0, Evaluation(true_reward=0.5, hack=False))

    Attributes:
        true_reward: The reward that the designer meant, in the unit of the observed one.
        hack: Whether the step is contested: it pays for something else than what was meant (in a legitimate twin, too).
    """

    true_reward: float
    hack: bool


class RatedEnv(gymnasium.Env[Observation, Action], ABC):
    """An environment of the laboratory as Gymnasium sees it.

    The reward is the observed one, which may lie. After each step ``info`` holds

    * ``evaluation``: an ``Evaluation``, never to be learned from;
    * ``ratings``: with a panel, its K ratings of this step in reward units, a (K,) array drawn from ``np_random``, NaN
      where a rater did not answer.

    Examples:
        >>> from uard.envs.gym import make
        >>> env = make("TrapGrid6", panel="main")
        >>> env.step(1)
        Traceback (most recent call last):
            ...
        gymnasium.error.ResetNeeded: no episode is running: call reset() first
        >>> state, info = env.reset(seed=0)
        >>> env.step(4)
        Traceback (most recent call last):
            ...
        uard._checks.InvalidValueError: action = 4: must be a whole number in [0, 3]
        >>> sorted(env.step(1)[-1])
        ['evaluation', 'ratings']

    Attributes:
        problem: The environment's configuration, frozen.
        panel: Who rates, or None.
        noise: Standard deviation of extra normal noise on every rater, in reward units.
        render_mode: How ``render`` draws, or None.
    """

    problem: Environment

    def __init__(
        self,
        problem: Environment,
        panel: str | Panel | None,
        noise: float,
        render_mode: str | None,
        modes: Sequence[str],
        frames: int,
    ):
        """Check what all have.

        Args:
            problem: The environment's configuration.
            panel: Who rates each step, a ``Panel`` or a name in ``uard.ratings.panels.PANELS``; nobody if None.
            noise: Standard deviation of extra normal noise on every rater, in reward units, >= 0.
            render_mode: One of ``modes``, or None.
            modes: Those that there are.
            frames: Per second, for a film in real time.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
            UnknownNameError: for an unknown panel or render mode, with the nearest name.
        """
        _checks.number("noise", noise, low=0)
        if render_mode is not None:
            _checks.choose("render_mode", render_mode, modes)
        self.metadata = {"render_modes": [*modes], "render_fps": frames}
        self.problem, self.noise, self.render_mode = problem, float(noise), render_mode
        self.panel = None if panel is None else as_panel(panel)
        self._running = self._started = False

    @final
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode and return the first observation and an empty info.

        Args:
            seed: Of everything random.
            options: None are known.
        """
        super().reset(seed=seed)
        observation = self._begin(seed)
        self._running = self._started = True
        return observation, {}

    @final
    def step(self, action: Action) -> Stepped[Observation]:
        """Take one step and return (observation, observed reward, terminated, truncated, info).

        Raises:
            InvalidValueError: an action that is not in the action space.
            ResetNeeded: before the first ``reset`` and after an episode's end.
        """
        if not self._running:
            raise gymnasium.error.ResetNeeded("no episode is running: call reset() first")
        stepped = self._take(action)
        self._running = not (stepped[2] or stepped[3])
        return stepped

    @final
    def render(self) -> Any:
        """Return a picture, (H, W, 3) of uint8, or a text, according to ``render_mode``; None without one.

        Raises:
            ResetNeeded: before the first ``reset``.
        """
        if self.render_mode is None:
            modes = " or ".join(map(repr, self.metadata["render_modes"]))
            gymnasium.logger.warn(f"render() needs a render_mode: make the environment with {modes}")
            return None
        if not self._started:
            raise gymnasium.error.ResetNeeded("nothing to draw: call reset() first")
        return self._draw()

    @abstractmethod
    def _begin(self, seed: int | None) -> Observation:
        """Start an episode; ``seed`` as in ``reset``."""

    @abstractmethod
    def _take(self, action: Action) -> Stepped[Observation]:
        """Take one step."""

    @abstractmethod
    def _draw(self) -> Any:
        """Draw the present state in ``render_mode``."""
