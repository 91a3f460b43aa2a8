"""What the server keeps in memory of a store: items and answers, read anew only as far as they are new."""

from __future__ import annotations

import threading
from collections import Counter, defaultdict

from uard.collect.items import Item
from uard.collect.project import Project
from uard.collect.question import MOST_ATTRIBUTES
from uard.collect.store import AnswerStore, part_name
from uard.ratings.table import Answer, Answers

REPORTS = 2  # raters whose browsers cannot show an item, then nobody is shown it


class Catalogue:
    """The items of a project by their names, and which of them cannot be shown.

    Examples:
        >>> import tempfile
        >>> from uard.collect import text_item
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     project = Project.create(folder)
        ...     with project.store() as store:
        ...         items, item = Catalogue(project, store), text_item("2 + 2?", "4")
        ...         _ = store.add_items([item])
        ...         items.find(item.id) == item, items.find("0" * 32), items.aside()
        (True, None, frozenset())
    """

    def __init__(self, project: Project, store: AnswerStore):
        """Read the items that are there, and look at their files."""
        self._project = project
        self._store = store
        self._lock = threading.Lock()
        self._items: dict[str, Item] = {}
        self._using: defaultdict[str, set[str]] = defaultdict(set)  # names of files and of a pair's items
        self._wrong: dict[str, str] = {}
        self._reports: defaultdict[str, set[str]] = defaultdict(set)  # by item, raters who could not see it
        question = project.question
        self._pairs = question.kind == "pairs"
        self._known = {known.item for known in (*question.practice, *question.gold, *question.examples)}
        self._earnest: set[str] = set()
        self._unfit: set[str] = set()
        self._after = 0
        self.refresh()

    def refresh(self) -> None:
        """Read the items that were added since."""
        with self._lock:
            new, self._after = self._store.items(self._after)
            for item in new:
                for name in (*item.media, *_sides(item)):
                    self._using[name].add(item.id)
                self._items[item.id] = item
                if (item.kind == "pair") != self._pairs:
                    self._unfit.add(item.id)
                elif item.id not in self._known:
                    self._earnest.add(item.id)
            self._set_aside(self._project.damaged(new))
            self._set_aside({i.id: self._wrong[name] for i in new for name in _sides(i) if name in self._wrong})

    def find(self, name: str) -> Item | None:
        """Return an item; None if there is none of this name."""
        if name not in self._items:
            self.refresh()
        return self._items.get(name)

    def all(self) -> dict[str, Item]:
        """Return all items by their names."""
        self.refresh()
        with self._lock:
            return dict(self._items)

    def earnest(self) -> set[str]:
        """Return the names of what the question is asked about in earnest: no practice, gold or examples."""
        with self._lock:
            return self._earnest - self._wrong.keys()

    def wrong(self) -> dict[str, str]:
        """Return which items are set aside for everybody, and why."""
        with self._lock:
            return dict(self._wrong)

    def reported(self) -> dict[str, str]:
        """Return which items are set aside for some raters only, and for whom."""
        with self._lock:
            return {name: ", ".join(sorted(who)) for name, who in self._reports.items() if name not in self._wrong}

    def aside(self, rater: str | None = None) -> frozenset[str]:
        """Return the names of items that a rater is not shown.

        Their files are missing or were changed, the question is not asked about such items, or her browser could not
        show them.
        """
        with self._lock:
            own = {name for name, who in self._reports.items() if rater in who}
            pairs = {pair for name in own for pair in self._using.get(name, ())}
            return frozenset(self._unfit.union(self._wrong, own, pairs))

    def report(self, name: str, rater: str) -> None:
        """Set aside for a rater what her browser cannot show, and for everybody if it is not hers alone."""
        with self._lock:
            who = self._reports[name]
            who.add(rater)
            if len(who) >= REPORTS:
                self._set_aside({name: f"the browsers of {', '.join(sorted(who))} cannot show it"})

    def missing(self, file: str) -> None:
        """Set aside what needs a file that is not there any more."""
        with self._lock:
            self._set_aside({item: f"{self._project.media(file)} is missing" for item in self._using.get(file, ())})

    def _set_aside(self, found: dict[str, str]) -> None:
        for name, why in found.items():
            self._wrong[name] = why
            for pair in self._using.get(name, ()):
                self._wrong[pair] = why


def _sides(item: Item) -> tuple[str, ...]:
    return (item.content["left"], item.content["right"]) if item.kind == "pair" else ()


class Book:
    """All answers, and who has rated what.

    Examples:
        >>> import tempfile
        >>> from uard.collect import text_item
        >>> with tempfile.TemporaryDirectory() as folder, Project.create(folder).store() as store:
        ...     book, item = Book(store), text_item("2 + 2?", "4")
        ...     _ = store.add_items([item]), store.invite("ann"), store.put([Answer("a1", item.id, "ann", 1.0)])
        ...     book.refresh()
        ...     book.rated("ann"), book.full(1), [a.value for a in book.given("a1")]
        ({'...'}, {'...'}, [1.0])
    """

    def __init__(self, store: AnswerStore):
        """Begin with what the store holds."""
        self._store = store
        self._lock = threading.Lock()
        self._rows: list[Answer] = []
        self._after = 0
        self._by_id: dict[str, Answer] = {}
        self._taken_back: dict[str, str] = {}
        self._times: defaultdict[str, Counter[str]] = defaultdict(Counter)  # by rater, of items
        self._raters: Counter[str] = Counter()  # of items
        self._answered: Counter[str] = Counter()  # by rater
        self.refresh()

    def refresh(self) -> None:
        """Read the answers that were given since."""
        with self._lock:
            new, self._after = self._store.answers(self._after)
            for answer in new:
                self._rows.append(answer)
                self._by_id[answer.id] = answer
                if answer.supersedes is not None:
                    self._taken_back[answer.supersedes] = answer.id
                    self._count(self._by_id[answer.supersedes], -1)
                self._count(answer, 1)

    def _count(self, answer: Answer, change: int) -> None:
        if answer.said is None or answer.attribute or answer.kind == "practice":
            return
        self._answered[answer.rater] += change
        times = self._times[answer.rater]
        before = times[answer.item]
        times[answer.item] += change
        self._raters[answer.item] += (times[answer.item] > 0) - (before > 0)

    def all(self) -> Answers:
        """Return all of them in the order in which they were stored."""
        self.refresh()
        with self._lock:
            return Answers(tuple(self._rows))

    def given(self, name: str) -> tuple[Answer, ...]:
        """Return the answers that were given in one go, one for each thing asked; none if the name is not known."""
        if name not in self._by_id:
            self.refresh()
        names = (name, *(part_name(name, k) for k in range(1, MOST_ATTRIBUTES + 1)))
        return tuple(self._by_id[n] for n in names if n in self._by_id)

    def stands(self, name: str) -> bool:
        """Whether an answer is there and was neither corrected nor taken back."""
        return name in self._by_id and name not in self._taken_back

    def answered(self, rater: str) -> int:
        """Return how many answers of a rater stand, without practice."""
        return self._answered[rater]

    def rated(self, rater: str) -> set[str]:
        """Return the items of which a rater has said something that stands."""
        with self._lock:
            return {item for item, times in self._times[rater].items() if times > 0}

    def full(self, overlap: int) -> set[str]:
        """Return the items that have been rated by as many as should."""
        with self._lock:
            return {item for item, raters in self._raters.items() if raters >= overlap}
