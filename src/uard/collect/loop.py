"""Ratings for a training run from people who rate while it trains.

``StoreRatings`` is what an adapter takes as ``ratings=``: it looks into the project's store now and then, and gives the
run what raters have said since. The run never waits. ``ClipRecorder`` (``uard.collect.recorder``) puts clips of the
run itself before the raters.
"""

from __future__ import annotations

import time
import warnings
from collections import defaultdict, deque
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import gymnasium
import numpy as np

from uard import _checks
from uard.adapters.steps import KeyFn, Steps, natural_key
from uard.collect.clip_model import ClipModel, RatedClip
from uard.collect.items import Item
from uard.collect.project import Project
from uard.ratings.table import Answer

if TYPE_CHECKING:
    from jaxtyping import Float

MORE = 1.1  # times as many ratings: the model of clips is fitted again


class UnusableClipWarning(UserWarning):
    """Raters have rated clips that say nothing to this training."""


class StoreRatings:
    """What raters have said of a run's steps so far (an adapter's ``ratings=``). Changed in place.

    Where states and actions are numbered, or there is a ``key``, a rating of a clip of one step is handed on when its
    state-action comes again, once: the adapter remembers it under the same key. An answer that is corrected or taken
    back before that is not handed on; afterwards it stays. Elsewhere a ``ClipModel`` of each rater says what she would
    say of a step, and nothing where too little is known.

    Examples:
        >>> import tempfile
        >>> from uard.collect import Project, Request, clip_item
        >>> numbered = gymnasium.spaces.Discrete(9), gymnasium.spaces.Discrete(4)
        >>> folder = tempfile.TemporaryDirectory()
        >>> project = Project.create(folder.name)
        >>> step = clip_item("0" * 64 + ".webp", 2, 2, (8, 8), reward=4.0, key=[1, 3])
        >>> with project.store() as store:
        ...     _ = store.add_items([step]), store.invite("ann")
        ...     _ = store.put([Answer("a1", step.id, "ann", -1.0)])
        >>> ratings = StoreRatings(project, *numbered)
        >>> ratings(np.array([0, 1]), np.array([0, 3]), np.array([1, 1]), np.array([0.0, 4.0])).tolist()
        [[nan], [-1.0]]
        >>> ratings.close(), folder.cleanup()
        (None, None)

    Attributes:
        heard: Ratings that have arrived so far.
    """

    def __init__(
        self,
        project: Project | str | Path,
        observation_space: gymnasium.Space[Any],
        action_space: gymnasium.Space[Any],
        *,
        key: KeyFn | None = None,
        model: ClipModel | None = None,
        poll: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Open a project's answers.

        Args:
            project: With the run's clips; its folder if it is text.
            observation_space: Of one environment.
            action_space: Of one environment.
            key: As the adapter has it; found for numbered states and actions if left out.
            model: For steps without a key; one with the usual settings if left out.
            poll: Seconds between two looks into the store, >= 0.
            clock: Seconds that never go back.

        Raises:
            InvalidValueError: there is no such project, its raters give no numbers, or a space is none that the model
                can work with.
            StoreError: its store cannot be opened.
        """
        _checks.number("poll", poll, low=0)
        self._project = project if isinstance(project, Project) else Project.open(project)
        if self._project.question.kind == "pairs":
            allowed = "one whose raters give numbers (kind slider, stars or thumbs): of pairs nothing is known by step"
            raise _checks.InvalidValueError("project", str(self._project.folder), allowed)
        self._store = self._project.store()
        self._natural = natural_key(observation_space, action_space)
        self._key = key or self._natural
        self._steps = Steps(key=self._key)
        self._model = model or (None if self._key is not None else ClipModel(observation_space, action_space))
        self._poll, self._clock, self._due = poll, clock, -np.inf
        self._items: dict[str, Item] = {}
        self._places = [0, 0]  # of the last item and the last answer that were read
        self._columns: dict[str, int] = {}
        self._waiting: dict[Hashable, dict[int, deque[Answer]]] = defaultdict(lambda: defaultdict(deque))
        self._gone: set[str] = set()  # names of answers in whose place others are
        self._said: dict[str, Answer] = {}  # that stand, for the model
        self._clips: dict[str, RatedClip | None] = {}
        self._keys: dict[str, Hashable | None] = {}
        self._fitted, self._changed = 0, False
        self.heard = 0

    def close(self) -> None:
        """Close the store."""
        self._store.close()

    @property
    def raters(self) -> tuple[str, ...]:
        """Whose ratings the columns are."""
        return tuple(self._columns)

    def __call__(
        self, observations: Any, actions: Any, next_observations: Any, rewards: Float[np.ndarray, " B"]
    ) -> Float[np.ndarray, "B K"]:
        """Return ratings of a batch of steps, NaN where there is none."""
        now = self._clock()
        if now >= self._due:
            self._due = now + self._poll
            self.refresh()
        if self._key is None:
            assert self._model is not None
            gaps = self._model(observations, actions)
            return gaps + rewards[:, None] if gaps.shape[1] else np.full((len(rewards), 1), np.nan)
        out = np.full((len(rewards), max(len(self._columns), 1)), np.nan)
        keys = self._steps.keys(observations, actions, len(rewards)) if self._waiting else None
        for i, key in enumerate(keys or ()):
            for column, answers in self._waiting.pop(key, {}).items():
                while answers:
                    answer = answers.popleft()
                    if answer.id not in self._gone and answer.value is not None:
                        out[i, column] = answer.value
                        break
                if answers:
                    self._waiting[key][column] = answers
        return out

    def refresh(self) -> int:
        """Look into the store now, and return how many ratings were new.

        Raises:
            StoreError: it cannot be read.
        """
        items, self._places[0] = self._store.items(self._places[0])
        self._items |= {item.id: item for item in items}
        for rater in self._store.raters():
            self._columns.setdefault(rater.name, len(self._columns))
        answers, self._places[1] = self._store.answers(self._places[1])
        self._gone |= {a.supersedes for a in answers if a.supersedes is not None}
        for name in self._gone & self._said.keys():
            del self._said[name]
            self._changed = True
        new = [a for a in answers.standing() if a.value is not None and not a.attribute and a.kind != "practice"]
        for answer in new:
            self._take(answer, self._items.get(answer.item))
        self.heard += len(new)
        if self._model is not None and (self._changed or self.heard > MORE * self._fitted):
            self._fitted, self._changed = self.heard, False
            self._model.fit(self._rated())
        return len(new)

    def _take(self, answer: Answer, item: Item | None) -> None:
        if item is None or item.kind != "clip":
            return
        if self._key is None:
            self._said[answer.id] = answer
            return
        if item.id not in self._keys:
            self._keys[item.id] = self._key_of(item)
        key = self._keys[item.id]
        if key is not None:
            self._waiting[key][self._columns[answer.rater]].append(answer)

    def _key_of(self, item: Item) -> Hashable | None:
        """Return the key of a clip's only step; None, with a warning, if there is none."""
        if self._key is self._natural and item.content.get("key") is not None:
            return _hashable(item.content["key"])
        clip = self._read(item)
        if clip is None:
            return None
        if len(clip.actions) != 1:
            _warn("clips of several steps were rated, and a rating belongs to one: record them with length 1")
            return None
        found = self._steps.keys(clip.observations, clip.actions, 1)
        return None if found is None else found[0]

    def _rated(self) -> list[RatedClip]:
        """Return the clips that can be read, with the latest rating of each rater."""
        ratings: dict[str, Float[np.ndarray, " K"]] = {}
        for answer in self._said.values():
            row = ratings.setdefault(answer.item, np.full(len(self._columns), np.nan))
            row[self._columns[answer.rater]] = answer.value
        for name in ratings.keys() - self._clips.keys():
            self._clips[name] = self._read(self._items[name])
        clips = [(self._clips[name], row) for name, row in ratings.items()]
        return [clip._replace(ratings=row) for clip, row in clips if clip is not None]

    def _read(self, item: Item) -> RatedClip | None:
        """Return what was recorded with a clip; None, with a warning, if that is missing or no finite numbers."""
        if not item.content.get("data") or item.reward is None:
            _warn("clips without observations, actions or rewards were rated")
            return None
        path = self._project.media(str(item.content["data"]))
        try:
            with np.load(path, allow_pickle=False) as arrays:
                observations, actions = arrays["observations"], arrays["actions"]
        except (OSError, ValueError, KeyError) as error:
            _warn(f"{path} cannot be read ({error})")
            return None
        if not (np.isfinite(observations).all() and np.isfinite(actions).all()):
            _warn(f"{path} holds an observation or an action that is no finite number")
            return None
        return RatedClip(observations[: len(actions)], actions, float(item.reward), np.zeros(0))


def _warn(why: str) -> None:
    """Say why ratings go unheard; a training is not ended for that."""
    warnings.warn(f"some ratings are not used: {why}", UnusableClipWarning, stacklevel=4)


def _hashable(key: Any) -> Hashable:
    """Return a key that stood in JSON as the adapters' keys are: lists were tuples."""
    return tuple(_hashable(x) for x in cast("list[Any]", key)) if isinstance(key, list) else key
