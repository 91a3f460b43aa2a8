"""Asks a rater of a project for more: practice first, then what the project's rule chooses, with gold hidden among it.

What was read of a store is kept in memory and read on from there. The store alone says what was asked before, and takes
nothing that was decided before somebody else asked: two servers on one store do not ask one rater too many.
"""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np

from uard import _checks
from uard.collect.acquisition import Acquisition, Known
from uard.collect.items import Item, pair_item
from uard.collect.project import Project, Question
from uard.collect.store import AnswerStore, Request

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Integer

    from uard.ratings.table import Answer

GOLD = 1 / 15  # of a rater's questions
TRIES = 10  # while others ask at the same time
PAIRS = 50  # that a rater can be asked about: of fewer, new ones are made
_CHOICES = {"up": 1.0, "down": 0.0, "tie": 0.5}


def top_up(
    project: Project,
    store: AnswerStore,
    rater: str,
    count: int,
    without: Collection[str] = (),
    random: np.random.Generator | None = None,
) -> int:
    """Ask a rater for more, and return how many requests were made; 0 if there is nothing left to ask, or too busy.

    When nothing else is left, she is asked what others were asked who do not come to it (``AnswerStore.pass_on``).

    Examples:
        >>> import tempfile
        >>> from uard.collect.items import text_item
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     project = Project.create(folder)
        ...     with project.store() as store:
        ...         _ = store.add_items([text_item("2 + 2?", str(i)) for i in range(5)]), store.invite("ann")
        ...         top_up(project, store, "ann", 2), top_up(project, store, "ann", 9), len(store.lease("ann", 9))
        (2, 3, 5)

    Args:
        project: Its question says what is asked, and by which rule.
        store: The project's.
        rater: Who has too little to do; asked nothing while paused.
        count: How many more, >= 0. Practice that was not asked yet comes first, and all of it at once.
        without: Names of items that are not asked about, because their files are missing.
        random: Source of chance.

    Raises:
        InvalidValueError: for a count below 0, or a rule that does not exist.
        UnknownNameError: there is no such rater.
        StoreError: the store cannot be read or written now.
    """
    _checks.whole("count", count)
    random = np.random.default_rng() if random is None else random
    question = project.question
    acquisition = Acquisition(question.acquisition, question.overlap, question.repeats)
    seen = _seen(store)
    with seen.lock:
        for _ in range(TRIES):
            # Requests before answers: what is answered in between is then known twice, and not thought to be free.
            opened, place = store.open_requests()
            seen.refresh(store)
            if rater not in seen.column:
                raise _checks.UnknownNameError("rater", rater, seen.column)
            if rater in seen.paused:
                return 0
            requests, made = _Choice(seen, question, opened, rater, without, random).of(acquisition, count)
            if not requests:  # but what others were asked who have gone
                return store.pass_on(rater, count, seen.not_asked(question) | frozenset(without))
            if made:
                store.add_items(made)
            if store.ask(requests, place):
                return len(requests)
    return 0


class _Seen:
    """What was read of a store so far. Changed in place."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.items: list[Item] = []
        self.names: list[str] = []
        self.row: dict[str, int] = {}
        self.column: dict[str, int] = {}
        self.paused: set[str] = set()
        self.ratings = np.zeros((0, 0))
        self.count = np.zeros((0, 0), int)
        self.put_before: defaultdict[str, defaultdict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
        self._stand: dict[tuple[int, int], dict[str, float]] = {}  # by item and rater: answers that stand, by name
        self._of: dict[str, tuple[int, int]] = {}
        self._after = [0, 0]  # items, answers
        self._asked: tuple[Question, _Askable] | None = None

    def refresh(self, store: AnswerStore) -> None:
        """Read on."""
        answers, after = store.answers(self._after[1])  # before items and raters, without which there are no answers
        items, self._after[0] = store.items(self._after[0])
        for item in items:
            name = item.id
            self.row[name] = len(self.items)
            self.items.append(item)
            self.names.append(name)
        raters = store.raters()
        for state in raters:
            self.column.setdefault(state.name, len(self.column))
        self.paused = {state.name for state in raters if state.paused}
        shape = len(self.items), len(self.column)
        if shape != self.ratings.shape:
            self.ratings, self.count = _grown(self.ratings, shape, np.nan), _grown(self.count, shape, 0)
        if items:
            self._asked = None
        for answer in answers:
            self._take(answer)
        self._after[1] = after

    def _take(self, answer: Answer) -> None:
        if answer.supersedes is not None and (place := self._of.pop(answer.supersedes, None)) is not None:
            del self._stand[place][answer.supersedes]
            self._tell(place)
        if answer.said is None or answer.attribute:
            return
        if answer.kind in ("practice", "gold"):
            self.put_before[answer.kind][answer.rater].add(answer.item)
        place = self.row[answer.item], self.column[answer.rater]
        self._of[answer.id] = place
        self._stand.setdefault(place, {})[answer.id] = self._value(answer)
        self._tell(place)

    def _value(self, answer: Answer) -> float:
        """Return an answer as a number; of a pair 1 where its first item was preferred."""
        if answer.choice is None:
            return np.nan if answer.value is None else answer.value
        if answer.choice in ("left", "right"):
            preferred = answer.left if answer.choice == "left" else answer.right
            return float(preferred == self.items[self.row[answer.item]].content.get("left"))
        return _CHOICES.get(answer.choice, np.nan)

    def _tell(self, place: tuple[int, int]) -> None:
        values = list(self._stand[place].values())
        self.count[place] = len(values)
        self.ratings[place] = values[-1] if values else np.nan

    def askable(self, question: Question) -> _Askable:
        """Return which items a question is about; kept until there are new ones."""
        if self._asked is None or self._asked[0] != question:
            self._asked = question, _askable(self, question)
        return self._asked[1]

    def not_asked(self, question: Question) -> frozenset[str]:
        """Return the items that a question is not about, or whose answer raters are told or known for."""
        return frozenset(self.row).difference(self.askable(question).names)


@dataclass(frozen=True, eq=False)
class _Askable:
    """The items that a question is about.

    Attributes:
        rows: Their numbers, (n,).
        names: Their names.
        reward: (n,) observed, NaN where there is none.
        strata: (n,) numbers of their strata.
        pairs: (n, 2) numbers of the items of each pair; None if the question is not about pairs.
        groups: Numbers of the items that may be put beside each other, in groups; none if it is not about pairs.
    """

    rows: Integer[np.ndarray, " n"]
    names: tuple[str, ...]
    reward: Float[np.ndarray, " n"]
    strata: Integer[np.ndarray, " n"]
    pairs: Integer[np.ndarray, "n 2"] | None
    groups: tuple[tuple[int, ...], ...]


def _askable(seen: _Seen, question: Question) -> _Askable:
    shown = {known.item for known in (*question.practice, *question.gold, *question.examples)}
    paired = question.kind == "pairs"
    rows = [i for i, x in enumerate(seen.items) if (x.kind == "pair") == paired and seen.names[i] not in shown]
    items = [seen.items[i] for i in rows]
    strata = {name: number for number, name in enumerate(dict.fromkeys(item.stratum for item in items))}
    pairs, groups = None, defaultdict[Any, list[int]](list)
    if paired:
        sides = [[seen.row.get(item.content[side], -1) for side in ("left", "right")] for item in items]
        pairs = np.array(sides, int).reshape(-1, 2)
        for i, item in enumerate(seen.items):
            if item.kind != "pair":  # completions are compared with others of the same prompt
                groups[item.content.get("prompt")].append(i)
    return _Askable(
        np.array(rows, int),
        tuple(seen.names[i] for i in rows),
        np.array([np.nan if item.reward is None else item.reward for item in items], float),
        np.array([strata[item.stratum] for item in items], int),
        pairs,
        tuple(tuple(group) for group in groups.values() if len(group) > 1),
    )


class _Choice:
    """What can be asked of one rater now."""

    def __init__(
        self,
        seen: _Seen,
        question: Question,
        opened: Sequence[Request],
        rater: str,
        without: Collection[str],
        random: np.random.Generator,
    ):
        self._seen, self._question, self._opened, self._rater = seen, question, opened, rater
        self._without, self._random = frozenset(without), random

    def of(self, acquisition: Acquisition, count: int) -> tuple[list[Request], list[Item]]:
        """Return what is asked, and items that must be made for it."""
        practice = self._not_yet("practice")
        count = max(count - len(practice), 0)
        gold = self._not_yet("gold")
        self._random.shuffle(gold)
        hidden = min(int((self._random.random(count) < GOLD).sum()), len(gold))
        asked = practice + gold[:hidden]
        if not count - hidden:
            return asked, []
        made: dict[str, Item] = {}
        chosen = list(acquisition.choose(self._known(made, acquisition.overlap), count - hidden, self._random))
        for request in asked[len(practice) :]:
            chosen.insert(int(self._random.integers(len(chosen) + 1)), request)
        return practice + chosen, [made[r.item] for r in chosen if r.item in made]

    def _not_yet(self, kind: str) -> list[Request]:
        """Return practice or gold that the rater was not given yet."""
        given = self._seen.put_before[kind][self._rater] | {
            r.item for r in self._opened if r.kind == kind and r.rater == self._rater
        }
        known = self._question.practice if kind == "practice" else self._question.gold
        names = [k.item for k in known if k.item in self._seen.row and k.item not in self._without]
        return [Request(name, self._rater, kind) for name in dict.fromkeys(names) if name not in given]

    def _known(self, made: dict[str, Item], overlap: int) -> Known:
        seen, askable = self._seen, self._seen.askable(self._question)
        asked, anybody = np.zeros(seen.ratings.shape, bool), np.zeros(len(seen.items), int)
        for r in self._opened:
            if (row := seen.row.get(r.item)) is None:
                continue
            if r.rater is None:
                anybody[row] += 1
            else:  # of those who were sent away, too: what they had is passed on, and not asked of one more
                asked[row, seen.column[r.rater]] = True
        rows = askable.rows
        if self._without:
            keep = np.array([name not in self._without for name in askable.names], bool)
        else:
            keep = np.ones(len(rows), bool)
        names, rows = tuple(n for n, k in zip(askable.names, keep.tolist(), strict=True) if k), rows[keep]
        ratings, count = seen.ratings[rows], seen.count[rows]
        # A request of hers for what she has answered since is none any more, but for a repeat.
        repeats = {(r.item, r.rater) for r in self._opened if r.kind == "repeat"}
        for i, k in np.argwhere(asked[rows] & (count > 0)).tolist():
            asked[rows[i], k] = (names[i], list(seen.column)[k]) in repeats
        paused = np.ones(len(seen.column), bool)
        paused[seen.column[self._rater]] = False
        known = Known(
            names,
            tuple(seen.column),
            askable.reward[keep],
            ratings,
            count,
            asked[rows],
            anybody[rows],
            paused,
            None if askable.pairs is None else askable.pairs[keep],
            None if askable.pairs is None else _worth(seen.ratings),
            askable.strata[keep],
        )
        return known if known.pairs is None else self._with_pairs(known, made, overlap)

    def _with_pairs(self, known: Known, made: dict[str, Item], overlap: int) -> Known:
        """Return what is known with new pairs beside those that there are, if they are too few for this rater."""
        mine = self._seen.column[self._rater]
        free = (known.heard < overlap) & (known.count[:, mine] == 0) & ~known.asked[:, mine]
        groups = self._seen.askable(self._question).groups
        new: list[tuple[int, int]] = []
        if groups:
            sizes = np.array([len(group) for group in groups], float)
            for g in self._random.choice(len(groups), 4 * max(PAIRS - int(free.sum()), 0), p=sizes / sizes.sum()):
                group = np.array(groups[int(g)])
                one, other = (int(x) for x in self._random.choice(group, 2, replace=False))
                item = pair_item(self._seen.names[one], self._seen.names[other], stratum=self._stratum(one, other))
                fresh = item.id not in self._seen.row and item.id not in made
                if fresh and self._without.isdisjoint((self._seen.names[one], self._seen.names[other])):
                    made[item.id] = item
                    new.append((one, other) if item.content["left"] == self._seen.names[one] else (other, one))
                if len(new) >= PAIRS - int(free.sum()):
                    break
        return _extended(known, tuple(made), np.array(new, int).reshape(-1, 2))

    def _stratum(self, one: int, other: int) -> str:
        strata = {self._seen.items[i].stratum for i in (one, other)}
        return strata.pop() if len(strata) == 1 else ""


def _extended(known: Known, names: tuple[str, ...], pairs: Integer[np.ndarray, "m 2"]) -> Known:
    """Return what is known with further pairs, of which nothing is."""
    if not names:
        return known
    assert known.pairs is not None
    shape = len(known.items) + len(names), len(known.raters)
    return Known(
        known.items + names,
        known.raters,
        np.concatenate([known.reward, np.full(len(names), np.nan)]),
        _grown(known.ratings, shape, np.nan),
        _grown(known.count, shape, 0),
        _grown(known.asked, shape, False),
        np.concatenate([known.anybody, np.zeros(len(names), int)]),
        known.paused,
        np.concatenate([known.pairs, pairs]),
        known.worth,
    )


def _grown(table: Any, shape: tuple[int, int], filling: Any) -> Any:
    """Return a table with more rows and columns."""
    out = np.full(shape, filling, table.dtype)
    out[: table.shape[0], : table.shape[1]] = table
    return out


def _worth(ratings: Float[np.ndarray, "n K"]) -> Float[np.ndarray, " n"]:
    """Return the mean rating of each item, NaN where there is none."""
    here: Bool[np.ndarray, "n K"] = ~np.isnan(ratings)
    number = here.sum(1)
    return np.where(number > 0, np.where(here, ratings, 0.0).sum(1) / np.maximum(number, 1), np.nan)


_LOCK = threading.Lock()
_SEEN: WeakKeyDictionary[AnswerStore, _Seen] = WeakKeyDictionary()


def _seen(store: AnswerStore) -> _Seen:
    with _LOCK:
        if store not in _SEEN:
            _SEEN[store] = _Seen()
        return _SEEN[store]
