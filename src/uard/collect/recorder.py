"""Clips of a training run, while it trains, for people to rate."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from uard import _checks
from uard.adapters.steps import natural_key
from uard.collect import drawing, sheets
from uard.collect.items import Item
from uard.collect.loop import UnusableClipWarning
from uard.collect.project import Project
from uard.collect.record import LONGEST, Clip, as_array, keep_clip
from uard.collect.store import Request, StoreError

EACH = 16  # clips that are put into the store in one go
SOON = 0.5  # seconds after which fewer are, between two episodes: a rare step must not wait for others
AFTER = -1.0  # the priority of what was asked before: new questions first


class ClipRecorder(gymnasium.Wrapper[Any, Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    """Puts pieces of what an agent does into a project; rewards, observations and actions pass unchanged.

    It goes innermost, around the environment that draws, so that no reset comes between a step and its picture. Who is
    asked about which clip is decided where the page is served (``Question.acquisition``).

    Examples:
        >>> import tempfile, uard.envs
        >>> folder = tempfile.TemporaryDirectory()
        >>> project = Project.create(folder.name)
        >>> env = gymnasium.make("uard/TrapGrid6-v0", render_mode="rgb_array")
        >>> env = ClipRecorder(env, project, share=1.0)
        >>> _ = env.reset(seed=0)
        >>> for action in (1, 1, 3):
        ...     _ = env.step(action)
        >>> env.close()
        >>> [item.content["key"] for item in project.store().items()[0]]
        [[0, 1], [6, 1], [12, 3]]
        >>> folder.cleanup()

    Attributes:
        recorded: Clips that are new to this run so far.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        project: Project | str | Path,
        *,
        share: float = 0.05,
        length: int = 1,
        most: int = 100_000,
        again: int = 0,
        stratum: str = "training",
        seed: int = 0,
    ):
        """Wrap an environment.

        Args:
            env: Made with ``render_mode="rgb_array"``.
            project: Where the clips go; its folder if it is text.
            share: Of the steps that are recorded, in (0, 1].
            length: Steps of a clip, in [1, 1023]; a clip that an episode's end cuts short is shorter. With one, in a
                world of numbered states and actions, each state-action is recorded once.
            most: Clips after which none is recorded any more.
            again: How often a numbered state-action that is drawn once more is put before all raters again, so that
                what the agent does often is known best; as hidden repeats, >= 0.
            stratum: What the clips are called by.
            seed: Of which steps are recorded, >= 0.

        Raises:
            InvalidValueError: the environment draws no pictures, there is no such project, or an argument is not what
                it must be.
            StoreError: the project's store cannot be opened.
        """
        _checks.number("share", share, low=0, high=1, open_low=True)
        _checks.whole("length", length, low=1, high=LONGEST)
        _checks.whole("most", most, low=1)
        _checks.whole("again", again)
        _checks.whole("seed", seed)
        drawing.check(env)
        gymnasium.utils.RecordConstructorArgs.__init__(
            self, project=project, share=share, length=length, most=most, again=again, stratum=stratum, seed=seed
        )
        super().__init__(env)
        self._project = project if isinstance(project, Project) else Project.open(project)
        self._store = self._project.store()
        self._length, self._most, self._again, self._stratum = length, most, again, stratum
        self._chance = share / length  # that a clip begins at a step
        self._random = np.random.default_rng(seed)
        self._numbered = length == 1 and natural_key(env.observation_space, env.action_space) is not None
        self._rate = drawing.speed(env, None)
        self._seen: dict[tuple[int, int], _Seen] = {}
        self._waiting: list[Item] = []
        self._once_more: list[str] = []
        self._clip: _Clip | None = None
        self._observation: Any = None
        self._shape: tuple[int, ...] | None = None  # of the environment's pictures
        self._flushed = 0.0
        self.recorded = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; a clip that was not finished ends where the episode was left."""
        self._safely(self._finish)
        if time.monotonic() - self._flushed > SOON:
            self._safely(self._flush)
        self._observation, info = super().reset(seed=seed, options=options)
        if self._shape is None:  # what cannot be drawn at all is known now
            drawing.find_library(self.env)
            drawing.simplify(self.env)
            self._frame()
            as_array(self.env, "observation_space", self._observation)
        return self._observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Act, and record the step if it is one of those."""
        if self._clip is None and self.recorded < self._most and self._random.random() < self._chance:
            self._safely(lambda: self._begin(action))
        observation, reward, terminated, truncated, info = super().step(action)
        if (clip := self._clip) is not None:
            over = bool(terminated or truncated)
            self._safely(lambda: self._add(clip, action, float(reward), observation, over))
        self._observation = observation
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        """Put what waits into the store, and close both."""
        self._finish()
        self._flush()
        self._store.close()
        super().close()

    def _safely(self, record: Callable[[], None]) -> None:
        """Record; what cannot be recorded is left out, and said once: a training is not ended for that."""
        try:
            record()
        except (_checks.InvalidValueError, StoreError, OSError) as error:
            self._clip = None
            warnings.warn(f"a clip was not recorded: {error}", UnusableClipWarning, stacklevel=3)

    def _add(self, clip: _Clip, action: Any, reward: float, observation: Any, over: bool) -> None:
        _checks.number("reward", reward)
        clip.actions.append(as_array(self.env, "action_space", action))
        clip.rewards.append(reward)
        clip.frames.append(self._frame())
        clip.observations.append(as_array(self.env, "observation_space", observation))
        if len(clip.actions) == self._length or over:
            self._finish()

    def _begin(self, action: Any) -> None:
        key = None
        if self._numbered:
            key = (int(self._observation), int(action))
            if (seen := self._seen.get(key)) is not None:
                self._repeat(seen)
                return
        self._clip = _Clip(self._frame(), as_array(self.env, "observation_space", self._observation), key)

    def _repeat(self, seen: _Seen) -> None:
        if seen.times < self._again:
            seen.times += 1
            self._once_more.append(seen.item)
            if len(self._once_more) >= EACH:
                self._flush()

    def _frame(self) -> np.ndarray:
        found = drawing.picture(self.env, self._shape)
        self._shape = found.shape
        return np.array(sheets.fitted(found))  # copied: an environment may draw into it again

    def _finish(self) -> None:
        clip, self._clip = self._clip, None
        if clip is None or not clip.actions:
            return
        made = Clip.of(clip.frames, clip.observations, clip.actions, clip.rewards, clip.key)
        item = keep_clip(made, self._project, self._rate, self._stratum)
        self._waiting.append(item)
        if clip.key is not None:
            self._seen[clip.key[0], clip.key[1]] = _Seen(item.id)
        self.recorded += 1
        if len(self._waiting) >= EACH or self.recorded <= EACH:  # the first at once: somebody waits at the page
            self._flush()

    def _flush(self) -> None:
        self._flushed = time.monotonic()
        if self._waiting:
            self._store.add_items(self._waiting)
            self._waiting = []
        if self._once_more:
            names = [r.name for r in self._store.raters() if not r.paused]
            self._store.ask([Request(item, name, "repeat", AFTER) for item in self._once_more for name in names])
            self._once_more = []


@dataclass
class _Seen:
    """A numbered state-action that was recorded.

    Attributes:
        item: Its name.
        times: How often it was put before the raters again.
    """

    item: str
    times: int = 0


class _Clip:
    """A clip that is being recorded."""

    def __init__(self, frame: np.ndarray, observation: np.ndarray, key: tuple[int, int] | None):
        self.frames, self.observations = [frame], [observation]
        self.actions: list[np.ndarray] = []
        self.rewards: list[float] = []
        self.key = None if key is None else list(key)
