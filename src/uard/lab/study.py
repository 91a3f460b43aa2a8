"""A study as data: named rows, each a cell; the seeds are added when it is run.

``uard.lab.execution.runner.run`` trains what a study asks for and puts it into a store. Here by hand:

    >>> import numpy as np
    >>> raw = Cell()
    >>> result = Result(np.ones((500, 6)), steps=500, path=np.array([0]), extra={})
    >>> store = Store(":memory:")
    >>> store.put([(raw, 0, result), (raw, 1, result)])
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

from uard import _checks
from uard.lab.cell import Cell
from uard.lab.execution.store import MissingSeedsError, Store
from uard.lab.result import COLUMNS, METRICS, Result, check_name


@dataclass(frozen=True)
class Row:
    """One line of a study: what tells it from the others, and the cell behind it.

    Examples:
        >>> line = Row((("agent", "q-learning"), ("rated", 1.0)), Cell())
        >>> line["agent"]
        'q-learning'
    """

    labels: tuple[tuple[str, Any], ...]
    cell: Cell

    def __getitem__(self, name: str) -> Any:
        """Return a label.

        Raises:
            KeyError: there is none of that name.
        """
        return dict(self.labels)[name]


def row(cell: Cell, **labels: Any) -> Row:
    """Build a row.

    Examples:
        >>> row(Cell(), agent="q-learning", rated=1.0).labels
        (('agent', 'q-learning'), ('rated', 1.0))
    """
    return Row(tuple(labels.items()), cell)


@final
class LazyRows(Sequence[Row]):
    """Rows that are built when the first of them is read: thousands take seconds, and most commands need none.

    Examples:
        >>> rows = LazyRows(lambda: (row(Cell(), agent="q-learning"),), count=1)
        >>> len(rows), rows[0]["agent"]
        (1, 'q-learning')
    """

    def __init__(self, build: Callable[[], tuple[Row, ...]], count: int):
        """Remember how.

        Args:
            build: Builds them; called once at most.
            count: How many it builds.
        """
        self._build, self._count = build, count

    @cached_property
    def _rows(self) -> tuple[Row, ...]:
        rows = self._build()
        if len(rows) != self._count:
            raise _checks.InvalidValueError("count", self._count, f"{len(rows)}: so many are built")
        return rows

    def __len__(self) -> int:
        """Return how many there are, without building them."""
        return self._count

    def __getitem__(self, index: Any) -> Any:
        """Return a row, or several."""
        return self._rows[index]

    def __iter__(self) -> Iterator[Row]:
        """Yield all."""
        return iter(self._rows)


@dataclass(frozen=True)
class Study:
    """An experiment: a question, what of the paper it answers, and its rows.

    Examples:
        >>> from uard.method.mitigations import named
        >>> rows = tuple(row(Cell(mitigation=named(name)), mitigation=name) for name in ("raw", "uard"))
        >>> study = Study("mine", "With and without", "", rows)
        >>> len(study.jobs(seeds=range(10))), study.one(mitigation="raw").cell == Cell()
        (20, True)

    Attributes:
        name: As on the command line.
        title: One line.
        answers: Inventory numbers (F2, H5, G3 ...).
        rows: Its cells with their labels; a tuple, or ``LazyRows`` of a large study.
        curves: Columns of the episode log that are published, binned, beside the metrics.
        derive: What else is published of a cell: numbers by name, of the cell and its results by seed. For what needs
            the whole result, which is too large to be published.
        brief: Metrics that are published, and nothing else, of a study with thousands of cells; all if left out.
        development: Whether constants may be tuned on it; what is reported comes from other studies then.
    """

    name: str
    title: str
    answers: str
    rows: Sequence[Row]
    curves: tuple[str, ...] = ()
    derive: Callable[[Cell, Mapping[int, Result]], dict[str, Any]] | None = None
    brief: tuple[str, ...] = ()
    development: bool = False

    def __post_init__(self) -> None:
        """Check what is published.

        Raises:
            UnknownNameError: a curve that is no column of the episode log, or no metric in ``brief``.
            InvalidValueError: curves or derived numbers of a study that is published in brief.
        """
        for name, known in (("curves", COLUMNS), ("brief", METRICS)):
            for i, value in enumerate(getattr(self, name)):
                check_name(f"{name}[{i}]", value, known)
        if self.brief and (self.curves or self.derive):
            raise _checks.InvalidValueError(
                "brief", self.brief, "left out where curves or what is derived is published"
            )

    def jobs(self, seeds: Iterable[int]) -> list[tuple[Cell, int]]:
        """Return every (cell, seed), the seeds of a cell side by side so that it finishes as a whole."""
        seeds = list(seeds)
        return [(r.cell, seed) for r in self.rows for seed in seeds]

    def where(self, **labels: Any) -> Iterator[Row]:
        """Yield the rows that have all these labels."""
        for r in self.rows:
            have = dict(r.labels)
            if all(name in have and have[name] == value for name, value in labels.items()):
                yield r

    def one(self, **labels: Any) -> Row:
        """Return the only row with these labels.

        Raises:
            InvalidValueError: there is none, or several.
        """
        found = list(self.where(**labels))
        if len(found) != 1:
            known = {name: None for r in self.rows for name, _ in r.labels}
            allowed = f"those of exactly one row of the study {self.name!r}, not of {len(found)}; labels are"
            raise _checks.InvalidValueError("labels", labels, f"{allowed} {', '.join(known)}")
        return found[0]


def results_of(cell: Cell, store: Store, seeds: Iterable[int]) -> list[Result]:
    """Return the results of all seeds, in their order.

    Examples:
        >>> [result.log.shape for result in results_of(raw, store, seeds=[0, 1])]
        [(500, 6), (500, 6)]

    Raises:
        MissingSeedsError: some are not in the store.
    """
    seeds = list(seeds)
    return _all(store.get(cell, seeds), seeds, cell, store)


def metrics_of(cell: Cell, store: Store, seeds: Iterable[int]) -> list[dict[str, float]]:
    """Return the metrics of all seeds, in their order, without reading the curves.

    Examples:
        >>> [metrics["true_return"] for metrics in metrics_of(raw, store, seeds=[0, 1])]
        [1.0, 1.0]

    Raises:
        MissingSeedsError: some are not in the store.
    """
    seeds = list(seeds)
    return _all(store.metrics(cell, seeds), seeds, cell, store)


def _all(found: dict[int, Any], seeds: list[int], cell: Cell, store: Store) -> list[Any]:
    lost = [s for s in seeds if s not in found]
    if lost:
        raise MissingSeedsError(f"seeds {lost} of this cell are not in the store {store.path!r}; run it again: {cell}")
    return [found[s] for s in seeds]
