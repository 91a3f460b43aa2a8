"""What the store says: metrics of cells and of studies' rows, read once each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from uard import _checks
from uard.lab import statistics
from uard.lab.cell import Cell
from uard.lab.execution.store import Store
from uard.lab.result import METRICS, SHARES, Result, check_name
from uard.lab.study import Row, Study, metrics_of, results_of


class StudyResults:
    """Finished studies over some seeds.

    Seeds that are not in the store are a MissingSeedsError; unknown names of studies, metrics and columns, and labels
    that name no row or several, are an InvalidValueError.

    Examples:
        >>> cell, store = Cell(episodes=20), Store(":memory:")
        >>> study = Study("mine", "Without a mitigation", "", (Row((("mitigation", "raw"),), cell),))
        >>> finished = [Result(np.full((20, 6), x), steps=20, path=np.array([0]), extra={}) for x in (1.0, 2.0)]
        >>> store.put([(cell, seed, result) for seed, result in enumerate(finished)])  # as ``runner.run`` does
        >>> results = StudyResults(store, seeds=[0, 1], studies=[study])
        >>> results.get("mine", "hacks", mitigation="raw").mean, results.curves("mine", "hacks").shape
        (1.5, (2, 20))

    Attributes:
        seeds: The seeds, in order.
        studies: By name.
    """

    def __init__(self, store: Store, seeds: Sequence[int], studies: Sequence[Study]):
        """Read from ``store`` as asked."""
        self.store, self.seeds = store, tuple(seeds)
        self.studies = {s.name: s for s in studies}
        self._metrics: dict[Cell, list[dict[str, float]]] = {}
        self._summaries: dict[tuple[Cell, str], statistics.Summary] = {}

    def results(self, cell: Cell) -> list[Result]:
        """Return all seeds of a cell (not kept in memory)."""
        return results_of(cell, self.store, self.seeds)

    def values(self, cell: Cell, metric: str) -> np.ndarray:
        """Return one metric, one number per seed."""
        if cell not in self._metrics:
            self._metrics[cell] = metrics_of(cell, self.store, self.seeds)
        check_name("metric", metric, METRICS)
        return np.array([m[metric] for m in self._metrics[cell]])

    def of(self, cell: Cell, metric: str) -> statistics.Summary:
        """Return one metric's summary."""
        key = cell, metric
        if key not in self._summaries:
            self._summaries[key] = statistics.summarise(self.values(cell, metric), metric, metric in SHARES)
        return self._summaries[key]

    def compare(self, pairs: Sequence[tuple[Cell, Cell]], metric: str) -> statistics.Family:
        """Test a metric of each pair of cells, paired by seed; corrected for the number of pairs."""
        return statistics.compare_all((self.values(a, metric), self.values(b, metric)) for a, b in pairs)

    def moments(self, cell: Cell, metric: str) -> tuple[float, float]:
        """Return mean and sd of one metric as its summary does, but at once: no interval is resampled."""
        values = self.values(cell, metric)
        return float(values.mean()), float(values.std(ddof=1)) if values.size > 1 else 0.0

    def row(self, study: str, **labels: Any) -> Row:
        """Return the only row of a study with these labels."""
        return self.studies[_checks.choose("study", study, self.studies)].one(**labels)

    def get(self, study: str, metric: str, **labels: Any) -> statistics.Summary:
        """Return the summary of one row of a study."""
        return self.of(self.row(study, **labels).cell, metric)

    def per_seed(self, study: str, metric: str, **labels: Any) -> np.ndarray:
        """Return the values of one row of a study, one per seed."""
        return self.values(self.row(study, **labels).cell, metric)

    def curves(self, study: str, column: str, **labels: Any) -> np.ndarray:
        """Return a per-episode column, (seeds, episodes).

        Raises:
            InvalidValueError: seeds have different numbers of episodes.
        """
        curves = [r.curve(column) for r in self.results(self.row(study, **labels).cell)]
        if len(lengths := {len(curve) for curve in curves}) > 1:
            raise _checks.InvalidValueError("episodes", sorted(lengths), "as many of one seed as of another")
        return np.stack(curves)

    def window(self, study: str, column: str, first: int, last: int, **labels: Any) -> statistics.Summary:
        """Return a column's mean over episodes first..last (1-based, inclusive), summarised over seeds.

        Raises:
            InvalidValueError: there are no such episodes.
        """
        curves = self.curves(study, column, **labels)
        _checks.whole("last", last, low=1, high=curves.shape[1])
        _checks.whole("first", first, low=1, high=last)
        return statistics.summarise(curves[:, first - 1 : last].mean(1), column, column == "success")
