"""Results that are published with the package: studies too long to be trained for every report.

``uard reproduce STUDIES --extract FILE`` writes what the report needs of finished studies as one small JSON file:
metrics per seed, binned curves, what was derived from tables, and how it was made. The report reads the packaged ones;
a row that is not in them, or whose configuration has changed since (its key then differs), is shown as missing, never
guessed.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
from collections.abc import Sequence
from functools import cache
from importlib import metadata, resources
from pathlib import Path
from typing import Any

import numpy as np

from uard import __version__
from uard.envs.base import Tables
from uard.lab import statistics
from uard.lab.cell import RESULTS, Cell
from uard.lab.execution import examine
from uard.lab.execution.store import Store
from uard.lab.result import TABLES, Result
from uard.lab.statistics import Summary
from uard.lab.study import Row, Study
from uard.method import calibration
from uard.replication import distortion

BIN = 10  # episodes
CURVES = ("observed_return", "trap_visits", "goal")
FILES = (
    "grid-deep.json",
    "games.json",
    "mujoco-one.json",
    "mujoco-eight.json",
    "mujoco.json",  # of as many seeds as their names say, the last of three
)


def extract(studies: Sequence[Study], store: Store, seeds: Sequence[int], command: str) -> dict[str, Any]:
    """Gather what the report needs of some studies as plain data; a row counts when all its seeds are finished."""
    wanted: dict[Cell, set[str]] = {}
    for study in studies:
        for r in study.rows:
            wanted.setdefault(r.cell, set()).add(study.name)
    cells: dict[str, Any] = {}
    for cell, names in wanted.items():
        found = store.get(cell, seeds)
        if len(found) == len(seeds):
            cells[cell.key] = _of_cell(names, cell, found)
    packages = ["jax", "numpy", "optax"] + (["mujoco"] if any(cell.steps for cell in wanted) else [])
    return {
        "command": command,
        "version": __version__,
        "commit": checkout(),
        "results": RESULTS,
        "packages": {p: metadata.version(p) for p in packages} | {"python": platform.python_version()},
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "cells": cells,
    }


def checkout() -> str | None:
    """Return the commit of the checkout that this code stands in, and whether it was changed; None if it is in none."""
    here = Path(__file__)

    def git(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(["git", "-C", str(here.parent), *words], capture_output=True, text=True, check=False)

    if shutil.which("git") is None or git("ls-files", "--error-unmatch", here.name).returncode:
        return None
    return git("describe", "--always", "--dirty", "--abbrev=12", "--exclude=*").stdout.strip()


def _of_cell(studies: set[str], cell: Cell, found: dict[int, Result]) -> dict[str, Any]:
    results = [found[s] for s in sorted(found)]
    metrics = [r.metrics() for r in results]
    out: dict[str, Any] = {
        "config": cell.config(),
        "seeds": sorted(found),
        "metrics": {m: [_short(x[m]) for x in metrics] for m in metrics[0]},
    }
    if "deep-baselines" in studies:
        out["curves"] = {c: [[_short(x) for x in _binned(r.curve(c))] for r in results] for c in CURVES}
    derived: dict[str, list[Any]] = {}
    for name in ("calibration", "rating_error"):
        if name in results[0].extra:
            derived[name] = [[_short(x) for x in r.extra[name]] for r in results]
    if "deep-ensembles" in studies:
        derived["sigma_m"] = [[_short(x) for x in sigma_quality(cell, r)] for r in results]
    if "evaluation" in results[0].extra:  # columns of training.lanes.LOG
        means = [r.extra["evaluation"].mean(0) for r in results]
        derived["deterministic"] = [[_short(m[0]), _short(m[1])] for m in means]  # hacks, true return
    if "deep-distortion" in studies:
        traces = [distortion.walk(cell, r, s) for s, r in sorted(found.items())]
        derived["activations"] = [distortion.activations(t) for t in traces]
        derived["largest"] = [_short(t.adjusted[t.counts].max()) for t in traces]
        derived["mean_inside"] = [_short(t.adjusted[t.counts].mean()) for t in traces]
        derived["trace"] = [[_short(x) for x in column] for column in traces[0][:4]]
    if "mujoco-standard-distortion" in studies:
        for name in ("perturbed", "warning"):
            derived[name] = [[_short(x) for x in r.extra[name].ravel()] for r in results]
        derived["reaction"] = [[_short(x) for x in examine.reaction(r.extra["trace"])] for r in results]
        derived["trace"] = [[_short(x) for x in column] for column in results[0].extra["trace"].T]
    return out | ({"derived": derived} if derived else {})


def _short(x: Any) -> float:
    return float(f"{float(x):.6g}")


def _binned(curve: np.ndarray) -> np.ndarray:
    whole = len(curve) // BIN * BIN
    return curve[:whole].reshape(-1, BIN).mean(1)


SIGMA_QUALITY = ("auroc_unseen", "spearman_error")


def sigma_quality(cell: Cell, result: Result) -> tuple[float, float]:
    """How good is sigma_m? AUROC of it for state-actions never tried, and its rank correlation with |mu - Q*|.

    Q* is exact for the observed reward. Needs an agent all of whose steps were rated, so that tried means rated.
    """
    from uard.method import bellman

    assert isinstance(cell.environment, Tables)
    held = {name: result.extra["tables"][..., i].astype(float) for i, name in enumerate(TABLES)}
    tried = held["rated"] > 0
    task = cell.environment.task()
    exact = bellman.solve(task.reward, 1.0, task.next_state, task.terminal, cell.agent.gamma)  # type: ignore[attr-defined]
    both = bool(tried.any() and not tried.all())
    unseen = calibration.auroc(held["sigma_m"].ravel(), ~tried.ravel()) if both else 0.5
    return unseen, calibration.spearman(held["sigma_m"].ravel(), np.abs(held["mu"] - exact).ravel())


class Published:
    """Published results of some studies.

    Attributes:
        studies: By name.
        sources: What each file says of how it was made.
    """

    def __init__(self, studies: Sequence[Study], files: Sequence[dict[str, Any]]):
        """Read what ``extract`` gave."""
        self.studies = {s.name: s for s in studies}
        self.sources = [{k: v for k, v in f.items() if k != "cells"} for f in files]
        self._cells: dict[str, Any] = {}
        for f in files:
            if f["results"] == RESULTS:
                self._cells |= f["cells"]

    @property
    def cells(self) -> tuple[str, ...]:
        """Return the keys of all published cells."""
        return tuple(self._cells)

    def has(self, row: Row) -> bool:
        """Whether a row was published."""
        return row.cell.key in self._cells

    def rows(self, study: str, **labels: Any) -> list[Row]:
        """Return the published rows of a study with these labels."""
        return [r for r in self.studies[study].where(**labels) if self.has(r)]

    def seeds_of(self, row: Row) -> tuple[int, ...]:
        """Return the seeds of a row."""
        return tuple(self._cells[row.cell.key]["seeds"])

    def seeds(self, study: str) -> int:
        """Return the smallest number of seeds of a published row."""
        return min((len(self.seeds_of(r)) for r in self.rows(study)), default=0)

    def of(self, row: Row, metric: str) -> Summary:
        """Return a metric's summary."""
        return statistics.summarise(self.per_seed(row, metric), metric)

    def per_seed(self, row: Row, metric: str) -> np.ndarray:
        """Return a metric, one number per seed."""
        return np.array(self._cells[row.cell.key]["metrics"][metric], float)

    def get(self, study: str, metric: str, **labels: Any) -> Summary:
        """Return the summary of the only row of a study with these labels.

        Raises:
            LookupError: it was not published.
        """
        row = self.studies[study].one(**labels)
        if not self.has(row):
            raise LookupError(f"{labels} of {study} was not published; run uard reproduce {study} and extract it again")
        return self.of(row, metric)

    def curves(self, row: Row, column: str) -> np.ndarray:
        """Return a curve in bins of ``BIN`` episodes, (seeds, bins)."""
        return np.array(self._cells[row.cell.key]["curves"][column], float)

    def derived(self, row: Row, name: str) -> np.ndarray:
        """Return something derived, one entry per seed."""
        return np.array(self._cells[row.cell.key]["derived"][name], float)


def packaged_json(name: str) -> Any:
    """Return a packaged file's numbers, or None if there is none."""
    file = resources.files("uard.replication") / "results" / name
    return json.loads(file.read_text()) if file.is_file() else None


@cache
def packaged() -> Published:
    """Return what is published with this version."""
    from uard.lab.studies import every

    return Published(every(), [data for name in FILES if (data := packaged_json(name))])
