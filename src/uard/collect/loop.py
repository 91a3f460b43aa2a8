"""Ratings for a training run from people who rate while it trains.

``StoreRatings`` is what an adapter takes as ``ratings=``: it looks into the project's store now and then, and gives the
run what raters have said since. The run never waits. ``ClipRecorder`` (``uard.collect.recorder``) puts clips of the
run itself before the raters.
"""

from __future__ import annotations

import time
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


class StoreRatings:
    """What raters have said of a run's steps so far (an adapter's ``ratings=``). Changed in place.

    Where states and actions are numbered, a rating of a step is handed on when its state-action comes again, once:
    the adapter remembers it under the same key. Elsewhere a ``ClipModel`` of each rater says what she would say of a
    step, and nothing where too little is known. An answer that is taken back after it was handed on stays handed on.

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
            InvalidValueError: there is no such project, or a space is none that the model can work with.
            StoreError: its store cannot be opened.
        """
        _checks.number("poll", poll, low=0)
        self._project = project if isinstance(project, Project) else Project.open(project)
        self._store = self._project.store()
        self._key = key or natural_key(observation_space, action_space)
        self._steps = Steps(key=self._key)
        self._model = model or (None if self._key is not None else ClipModel(observation_space, action_space))
        self._poll, self._clock, self._due = poll, clock, -np.inf
        self._items: dict[str, Item] = {}
        self._places = [0, 0]  # of the last item and the last answer that were read
        self._columns: dict[str, int] = {}
        self._waiting: dict[Hashable, dict[int, deque[float]]] = defaultdict(lambda: defaultdict(deque))
        self._clips: dict[str, RatedClip] = {}
        self._fitted = 0
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
            for column, values in self._waiting.pop(key, {}).items():
                out[i, column] = values.popleft()
                if values:
                    self._waiting[key][column] = values
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
        new = [a for a in answers.standing() if a.value is not None and not a.attribute and a.kind != "practice"]
        for answer in new:
            self._take(answer, self._items.get(answer.item))
        self.heard += len(new)
        if self._model is not None and self.heard > MORE * self._fitted:
            self._fitted = self.heard
            self._model.fit(list(self._clips.values()))
        return len(new)

    def _take(self, answer: Answer, item: Item | None) -> None:
        assert answer.value is not None
        column = self._columns[answer.rater]
        if item is None or item.kind != "clip":
            return
        if self._key is not None:
            key = item.content.get("key")
            if key is not None:
                self._waiting[_hashable(key)][column].append(answer.value)
        elif item.content.get("data") and item.reward is not None:
            known = self._clips.get(item.id) or self._read(item)
            ratings = np.full(len(self._columns), np.nan)
            ratings[: len(known.ratings)] = known.ratings
            ratings[column] = answer.value
            self._clips[item.id] = known._replace(ratings=ratings)

    def _read(self, item: Item) -> RatedClip:
        path = self._project.media(str(item.content["data"]))
        try:
            with np.load(path, allow_pickle=False) as arrays:
                observations, actions = arrays["observations"], arrays["actions"]
        except (OSError, ValueError, KeyError) as error:
            raise _checks.InvalidValueError(str(path), str(error), "the file that was recorded with the clip") from None
        return RatedClip(observations[: len(actions)], actions, float(item.reward or 0.0), np.zeros(0))


def _hashable(key: Any) -> Hashable:
    """Return a key that stood in JSON as the adapters' keys are: lists were tuples."""
    return tuple(_hashable(x) for x in cast("list[Any]", key)) if isinstance(key, list) else key
