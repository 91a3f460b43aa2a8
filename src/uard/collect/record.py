"""Clips of an agent: short pieces of its episodes, as pictures and as arrays."""

from __future__ import annotations

import hashlib
import io
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import gymnasium
import numpy as np

from uard import _checks
from uard.adapters.steps import natural_key
from uard.collect import drawing, sheets
from uard.collect.items import Item, clip_item
from uard.collect.project import Project

if TYPE_CHECKING:
    from jaxtyping import Shaped, UInt8

Policy = Callable[[Any], Any]
"""From an observation to an action."""

RANDOM = "random"
LONGEST = sheets.MOST_FRAMES - 1  # steps of a clip
_IN_VAIN = 100  # clips in a row that bring nothing new, after which there is no use in going on
_WAITING = 4  # clips that may wait for being written while others are drawn
_LEAST_GAP = 8  # steps between two clips of one episode are drawn below this, or below the length of a clip if more


@dataclass(frozen=True, eq=False)
class Clip:
    """A piece of an episode.

    Attributes:
        frames: Before the first step and after each.
        observations: As many.
        actions: One less.
        rewards: As many as actions, as observed.
        key: State and action, if they are numbers and this is one step.
    """

    frames: UInt8[np.ndarray, "T H W 3"]
    observations: Shaped[np.ndarray, "T ..."]
    actions: Shaped[np.ndarray, "n ..."]
    rewards: Shaped[np.ndarray, " n"]
    key: list[int] | None

    @staticmethod
    def of(
        frames: Sequence[np.ndarray],
        observations: Sequence[np.ndarray],
        actions: Sequence[np.ndarray],
        rewards: Sequence[float],
        key: list[int] | None,
    ) -> Clip:
        """Return a piece of an episode from its steps.

        Raises:
            InvalidValueError: observations or actions have different shapes.
        """
        seen, done = _stacked("observation", observations), _stacked("action", actions)
        return Clip(np.stack(frames), seen, done, np.array(rewards), key)

    def mark(self) -> bytes:
        """Return what only clips of the same content share."""
        found = hashlib.blake2b(digest_size=16)
        for part in (self.frames, self.observations, self.actions, self.rewards):
            found.update(f"{part.dtype} {part.shape}".encode())
            found.update(np.ascontiguousarray(part).tobytes())
        return found.digest()


def record(
    env: gymnasium.Env[Any, Any],
    policy: Policy | str,
    project: Project,
    *,
    segments: int = 200,
    length: int = 50,
    seed: int = 0,
    fps: float | None = None,
    stratum: str = "",
    progress: Callable[[int, int], None] | None = None,
) -> list[Item]:
    """Let an agent act, and put pieces of its episodes into a project.

    A clip begins at a random step and ends after ``length`` steps, or where the episode ends; it has one frame before
    its first step and one after each. Kept are the frames (``uard.collect.sheets``) and, without objects, observations,
    actions and observed rewards. True rewards are not. What a project has already is not put there twice. Nothing is
    added to it before all is recorded.

    Of MuJoCo's worlds shadows, reflections and soft edges are left out (``uard.collect.drawing``).

    Examples:
        >>> import tempfile, uard.envs
        >>> env = gymnasium.make("uard/TrapGrid6-v0", render_mode="rgb_array")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     project = Project.create(folder)
        ...     clips = record(env, "random", project, segments=3, length=5, stratum="random")
        ...     len(clips), clips[0].content["frames"], clips[0].stratum, project.damaged(clips)
        (3, 6, 'random', {})

    Args:
        env: Made with ``render_mode="rgb_array"``. It is reset, and not closed.
        policy: From an observation to an action; ``random`` draws from the action space.
        project: Where to.
        segments: How many different clips; fewer where the same ones come again and again.
        length: Steps of a clip, in [1, 1023]. With one, in a world of numbered states and actions, an item's ``key`` is
            [state, action], so that ratings of it can be used in training.
        seed: Of the environment, of random actions, and of where clips begin.
        fps: Frames per second; the environment's own, but at most 30, if left out.
        stratum: Which part of the project they belong to, such as the policy that acts.
        progress: Is told after each clip how many there are, of how many.

    Returns:
        The clips.

    Raises:
        InvalidValueError: the environment draws no pictures, or they change their size; its observations or actions
            are no arrays and cannot be made such; a reward is no finite number; an argument is not what it must be.
        StoreError: the project's database cannot be written.
    """
    _checks.whole("segments", segments, low=1, high=1_000_000)
    _checks.whole("length", length, low=1, high=LONGEST)
    _checks.whole("seed", seed, low=0, high=2**63 - 1)
    _checks.instance("stratum", stratum, str, "text")
    drawing.check(env)
    rate = drawing.speed(env, fps)
    act = _policy(policy, env, seed)
    recorder = _Recorder(env, act, length, np.random.default_rng(seed))
    drawing.find_library(env)
    items: list[Item] = []
    with ThreadPoolExecutor(1) as pool:  # compressing a picture takes as long as drawing it, and holds no lock
        waiting: list[Any] = []
        for clip in _different(recorder.clips(seed), segments):
            waiting.append(pool.submit(keep_clip, clip, project, rate, stratum))
            if len(waiting) > _WAITING:
                items.append(waiting.pop(0).result())
            if progress is not None:
                progress(len(items) + len(waiting), segments)
        items += [future.result() for future in waiting]
    with closing(project.store()) as store:
        store.add_items(items)
    return items


def _policy(policy: Policy | str, env: gymnasium.Env[Any, Any], seed: int) -> Policy:
    if callable(policy):
        return policy
    _checks.choose("policy", policy, (RANDOM,))
    env.action_space.seed(seed)
    return lambda observation: env.action_space.sample()


def _different(clips: Iterator[Clip], count: int) -> Iterator[Clip]:
    """Yield clips of different content; fewer than asked for, if there seem to be no more."""
    seen: set[bytes] = set()
    vain = 0
    for clip in clips:
        mark = clip.mark()
        vain = vain + 1 if mark in seen else 0
        if not vain:
            seen.add(mark)
            yield clip
        if len(seen) == count or vain == _IN_VAIN:
            return


def keep_clip(clip: Clip, project: Project, fps: float, stratum: str) -> Item:
    """Keep a clip's files in a project, and return its item, which is not in the store yet."""
    sheet = sheets.sheet_of(clip.frames)
    file = io.BytesIO()
    np.savez_compressed(file, observations=clip.observations, actions=clip.actions, rewards=clip.rewards)
    return clip_item(
        project.keep(sheet.data, "webp"),
        sheet.frames,
        sheet.columns,
        sheet.size,
        data=project.keep(file.getvalue(), "npz"),
        fps=fps,
        reward=math.fsum(clip.rewards.tolist()) / len(clip.rewards),
        stratum=stratum,
        key=clip.key,
    )


class _Recorder:
    """Plays episodes, and cuts clips out of them.

    The first clip of an episode begins in the first half of what the episode before it lasted, so that there is one in
    short episodes, too, and another one follows it after a pause.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], act: Policy, length: int, random: np.random.Generator):
        self._env, self._act, self._length, self._random = env, act, length, random
        self._numbered = length == 1 and natural_key(env.observation_space, env.action_space) is not None
        self._reach = 2 * max(length, _LEAST_GAP)
        self._shape: tuple[int, ...] | None = None  # of the environment's pictures
        self._observation: Any = None
        self._steps = 0  # of this episode
        self._over = True

    def clips(self, seed: int) -> Iterator[Clip]:
        """Yield clips without end."""
        self._observation, _ = self._env.reset(seed=seed)
        drawing.simplify(self._env)
        self._frame()  # what cannot be drawn, or not as arrays, is known now
        as_array(self._env, "observation_space", self._observation)
        self._over = False
        self._pass(self._reach)  # only to know how long it lasts
        lasted = min(self._steps, self._reach)
        self._begin()
        while True:
            self._pass(int(self._random.integers(max(1, lasted // 2))))
            if not self._over:
                yield self._clip()
            if self._over:
                lasted = min(self._steps, self._reach)
                self._begin()
            else:
                lasted = self._reach

    def _begin(self) -> None:
        self._observation, _ = self._env.reset()
        self._steps, self._over = 0, False

    def _pass(self, steps: int) -> None:
        for _ in range(steps):
            if self._over:
                return
            self._step()

    def _step(self) -> tuple[Any, float]:
        """Act, and return the action and the observed reward."""
        action = self._act(self._observation)
        self._observation, reward, terminated, truncated, _ = self._env.step(action)
        self._steps += 1
        self._over = bool(terminated or truncated)
        _checks.number(f"reward of step {self._steps}", reward, low=-_checks.LARGEST, high=_checks.LARGEST)
        return action, float(reward)

    def _frame(self) -> np.ndarray:
        found = drawing.picture(self._env, self._shape)
        self._shape = found.shape
        return np.array(sheets.fitted(found))  # copied: an environment may draw into it again

    def _clip(self) -> Clip:
        frames, observations = [self._frame()], [as_array(self._env, "observation_space", self._observation)]
        actions: list[np.ndarray] = []
        rewards: list[float] = []
        while not self._over and len(actions) < self._length:
            action, reward = self._step()
            actions.append(as_array(self._env, "action_space", action))
            rewards.append(reward)
            frames.append(self._frame())
            observations.append(as_array(self._env, "observation_space", self._observation))
        key = [int(observations[0]), int(actions[0])] if self._numbered else None
        return Clip.of(frames, observations, actions, rewards, key)


def as_array(env: gymnasium.Env[Any, Any], field: str, value: Any) -> np.ndarray:
    """Return an observation or an action as an array; dictionaries and tuples are made flat.

    Args:
        env: Whose it is.
        field: ``observation_space`` or ``action_space``.
        value: The observation or the action.

    Raises:
        InvalidValueError: it is no array of numbers and cannot be made one.
    """
    space: Any = getattr(env, field)
    spaces = gymnasium.spaces
    if isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        found = np.array(value)  # copied: an environment may write into it later
    elif space.is_np_flattenable:
        found = np.array(cast("Any", gymnasium.spaces.flatten(space, value)))
    else:
        raise _checks.InvalidValueError(field, space, "a space of arrays, or of such as can be flattened to one")
    if found.dtype.kind not in "biuf":
        raise _checks.InvalidValueError(field, cast("object", value), f"of numbers, as {space} says")
    if not np.isfinite(found).all():
        raise _checks.InvalidValueError(field, cast("object", value), "of finite numbers")
    return found


def _stacked(field: str, arrays: Sequence[np.ndarray]) -> np.ndarray:
    shapes = {array.shape for array in arrays}
    if len(shapes) > 1:
        raise _checks.InvalidValueError(f"{field}.shape", sorted(shapes), "the same in all steps")
    return np.stack(arrays)
