"""Results that are published with the package: studies too long to be trained for every report.

``uard reproduce STUDIES --extract FILE`` writes what the report needs of finished studies as one small JSON file:
metrics per seed, binned curves, what was derived from tables, and how it was made; of a study with thousands of cells
no more than the metrics that it names (``Study.brief``). The report reads the packaged ones; a row that is not in them,
or whose configuration has changed since (its key then differs), is shown as missing, never guessed. Here with a store
that is filled by hand:

    >>> cell, store = Cell(episodes=20), Store(":memory:")
    >>> study = Study("mine", "Without a mitigation", "", (Row((("mitigation", "raw"),), cell),), curves=("hacks",))
    >>> results = [Result(np.full((20, 6), x), steps=20, path=np.array([0]), extra={}) for x in (1.0, 2.0)]
    >>> store.put([(cell, seed, result) for seed, result in enumerate(results)])
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import metadata, resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import numpy as np

from uard import __version__, _checks
from uard.lab import statistics
from uard.lab.cell import Cell
from uard.lab.config import FORMAT
from uard.lab.execution.store import Store
from uard.lab.result import SHARES, Result, check_name
from uard.lab.statistics import Summary
from uard.lab.study import Row, Study
from uard.plugins import Plugin, PluginError, brought

MIGRATE = "`uard migrate FILE.json` brings published results over"
_PACKAGES = {None: ("jax", "numpy", "optax"), "simulator": ("mujoco",), "language": ("torch", "transformers", "trl")}
KEPT = ("calibration", "rating_error")  # of what a result holds beside its curves, as it is
BIN = 10  # episodes


@dataclass(frozen=True)
class ResultFiles:
    """Published results of one package (what an entry point of ``uard.results`` returns).

    Examples:
        >>> files = ResultFiles(resources.files("uard.lab.published"), studies=("games.json",))
        >>> (files.folder / "games.json").is_file()
        True

    Attributes:
        folder: Holds JSON files (``packaged_json``).
        studies: Names of those that ``uard reproduce --extract`` wrote; of a cell in several of them the last is taken.
    """

    folder: Traversable
    studies: tuple[str, ...]


def extract(studies: Sequence[Study], store: Store, seeds: Sequence[int], command: str) -> dict[str, Any]:
    """Gather what the report needs of some studies as plain data; a row counts when all its seeds are finished.

    Examples:
        >>> data = extract([study], store, seeds=[0, 1], command="uard reproduce mine --extract mine.json")
        >>> data["cells"][cell.key]["metrics"]["hacks"]
        [1.0, 2.0]

    Args:
        studies: With the curves and the derived numbers that each of them names.
        store: What it lacks is left out.
        seeds: All that a row must have.
        command: What made it, for the reader.
    """
    wanted: dict[Cell, dict[str, Study]] = {}
    for study in studies:
        for r in study.rows:
            wanted.setdefault(r.cell, {})[study.name] = study
    cells: dict[str, Any] = {}
    in_brief = {cell for cell, theirs in wanted.items() if all(s.brief for s in theirs.values())}
    for cell, theirs in wanted.items():
        if cell in in_brief:
            continue
        found = store.get(cell, seeds)
        if len(found) == len(seeds):
            cells[cell.key] = _of_cell(theirs.values(), cell, found)
    kinds = {cell.environment.kind for cell in wanted}
    packages = [p for kind, used in _PACKAGES.items() if kind is None or kind in kinds for p in used]
    return {
        "command": command,
        "version": __version__,
        "commit": _checkout(),
        "format": FORMAT,
        "packages": {p: metadata.version(p) for p in packages} | {"python": platform.python_version()},
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "cells": cells,
    } | ({"brief": _brief(wanted, in_brief, store, seeds)} if in_brief else {})


def _brief(
    wanted: Mapping[Cell, Mapping[str, Study]], in_brief: Iterable[Cell], store: Store, seeds: Sequence[int]
) -> dict[str, Any]:
    """Return some metrics of many cells in a tenth of the room, without their configurations."""
    names = list(dict.fromkeys(m for cell in in_brief for s in wanted[cell].values() for m in s.brief))
    cells = {}
    for cell in (c for c in wanted if c in in_brief):
        found = store.metrics(cell, seeds)
        if len(found) == len(seeds):
            cells[cell.key] = [_short([found[s][m] for s in sorted(found)], digits=4) for m in names]
    return {"seeds": sorted(seeds), "metrics": names, "cells": cells}


def _checkout() -> str | None:
    """Return the commit of the checkout that this code stands in, and whether it was changed; None if it is in none."""
    here = Path(__file__)

    def git(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(["git", "-C", str(here.parent), *words], capture_output=True, text=True, check=False)

    if shutil.which("git") is None or git("ls-files", "--error-unmatch", here.name).returncode:
        return None
    return git("describe", "--always", "--dirty", "--abbrev=12", "--exclude=*").stdout.strip()


def _of_cell(studies: Iterable[Study], cell: Cell, found: Mapping[int, Result]) -> dict[str, Any]:
    found = {seed: found[seed] for seed in sorted(found)}
    results = list(found.values())
    metrics = [r.metrics() for r in results]
    out: dict[str, Any] = {
        "config": cell.config(),
        "seeds": list(found),
        "metrics": {m: _short([x[m] for x in metrics]) for m in metrics[0]},
    }
    if columns := {c: None for study in studies for c in study.curves}:
        out["curves"] = {c: _short([_binned(r.curve(c)) for r in results]) for c in columns}
    derived: dict[str, Any] = {n: [r.extra[n] for r in results] for n in KEPT if n in results[0].extra}
    if "evaluation" in results[0].extra:  # columns of training.episode_log.LOG
        derived["deterministic"] = [r.extra["evaluation"].mean(0)[:2] for r in results]  # hacks, true return
    for study in studies:
        derived |= study.derive(cell, found) if study.derive else {}
    return out | ({"derived": _short(derived)} if derived else {})


def _short(x: Any, digits: int = 6) -> Any:
    """Return numbers, however nested, as JSON has them, with so many significant digits."""
    if isinstance(x, Mapping):
        return {name: _short(value, digits) for name, value in x.items()}
    if isinstance(x, list | tuple | np.ndarray):
        return [_short(value, digits) for value in x]
    return int(x) if isinstance(x, int | np.integer) else float(f"{float(x):.{digits}g}")


def _binned(curve: np.ndarray) -> np.ndarray:
    whole = len(curve) // BIN * BIN
    return curve[:whole].reshape(-1, BIN).mean(1)


class Published:
    """Published results of some studies.

    Methods that take a row want one that was published (``has``), and raise LookupError for another; unknown names are
    an InvalidValueError.

    Examples:
        >>> published = Published([study], [extract([study], store, seeds=[0, 1], command="made by hand")])
        >>> published.get("mine", "hacks", mitigation="raw").mean
        1.5
        >>> published.curves(study.rows[0], "hacks").shape
        (2, 2)

    Attributes:
        studies: By name.
        sources: What each file says of how it was made.
    """

    def __init__(self, studies: Sequence[Study], files: Sequence[dict[str, Any]]):
        """Read what ``extract`` gave.

        Raises:
            InvalidValueError: something of another format of keys, or that is no published results.
        """
        self.studies = {s.name: s for s in studies}
        self.sources: list[dict[str, Any]] = []
        self._cells: dict[str, Any] = {}
        self._commands: dict[str, str] = {}
        for f in files:
            _checks.instance("published", f, dict, "what `uard reproduce --extract` wrote")
            if _format_of(f) != FORMAT:
                raise _checks.InvalidValueError("format", _format_of(f), f"{FORMAT}: {MIGRATE}")
            found = cells_of(f)
            self._cells |= found
            self._commands |= dict.fromkeys(found, str(f.get("command", "unknown")))
            self.sources.append({k: v for k, v in f.items() if k not in ("cells", "brief")})

    @property
    def cells(self) -> tuple[str, ...]:
        """Return the keys of all published cells."""
        return tuple(self._cells)

    def has(self, row: Row, derived: str = "") -> bool:
        """Whether a row was published, and, if a name is given, this derived from it."""
        return row.cell.key in self._cells and (not derived or derived in self._cell(row).get("derived", {}))

    def rows(self, study: str, **labels: Any) -> list[Row]:
        """Return the published rows of a study with these labels."""
        return [r for r in self._study(study).where(**labels) if self.has(r)]

    def _study(self, name: str) -> Study:
        return self.studies[_checks.choose("study", name, self.studies)]

    def _cell(self, row: Row) -> dict[str, Any]:
        if not self.has(row):
            raise LookupError(f"{dict(row.labels)} was not published; run its study and extract it again")
        return self._cells[row.cell.key]

    def _numbers(self, row: Row, part: str, name: str) -> np.ndarray:
        found = self._cell(row).get(part, {})
        return np.array(found[check_name(part, name, found)], float)

    def seeds_of(self, row: Row) -> tuple[int, ...]:
        """Return the seeds of a row."""
        return tuple(self._cell(row)["seeds"])

    def seeds(self, study: str) -> int:
        """Return the smallest number of seeds of a published row."""
        return min((len(self.seeds_of(r)) for r in self.rows(study)), default=0)

    def command(self, study: str) -> str:
        """Return what made the published rows of a study."""
        return next((self._commands[r.cell.key] for r in self.rows(study)), "unknown")

    def of(self, row: Row, metric: str) -> Summary:
        """Return a metric's summary."""
        return statistics.summarise(self.per_seed(row, metric), metric, metric in SHARES)

    def compare(self, pairs: Sequence[tuple[Row, Row]], metric: str) -> statistics.Family:
        """Test a metric of each pair of rows on the seeds that both have, paired; corrected for the number of pairs."""
        found = []
        for rows in pairs:
            one, other = (dict(zip(self.seeds_of(r), self.per_seed(r, metric), strict=True)) for r in rows)
            shared = [seed for seed in one if seed in other]
            if len(shared) < 2:  # with seeds of their own they are compared as they are
                found.append((list(one.values()), list(other.values())))
            else:
                found.append(([one[s] for s in shared], [other[s] for s in shared]))
        return statistics.compare_all(found)

    def per_seed(self, row: Row, metric: str) -> np.ndarray:
        """Return a metric, one number per seed."""
        return self._numbers(row, "metrics", metric)

    def get(self, study: str, metric: str, **labels: Any) -> Summary:
        """Return the summary of the only row of a study with these labels.

        Raises:
            LookupError: it was not published.
        """
        row = self._study(study).one(**labels)
        if not self.has(row):
            raise LookupError(f"{labels} of {study} was not published; run uard reproduce {study} and extract it again")
        return self.of(row, metric)

    def curves(self, row: Row, column: str) -> np.ndarray:
        """Return a curve in bins of ``BIN`` episodes, (seeds, bins)."""
        return self._numbers(row, "curves", column)

    def derived(self, row: Row, name: str) -> np.ndarray:
        """Return something derived, one entry per seed."""
        return self._numbers(row, "derived", name)


def read_file(path: str) -> Any:
    """Return what ``uard reproduce --extract`` wrote.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     _ = Path(folder, "mine.json").write_text('{"cells": {}}')
        ...     read_file(f"{folder}/mine.json")
        {'cells': {}}

    Raises:
        InvalidValueError: it cannot be read.
    """
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        allowed = f"a file that `uard reproduce --extract` wrote ({error})"
        raise _checks.InvalidValueError("published", path, allowed) from None


def cells_of(data: Any) -> dict[str, Any]:
    """Return the cells of what ``extract`` gave by key, those in brief written out.

    Examples:
        >>> brief = {"seeds": [0, 1], "metrics": ["hacks"], "cells": {"a": [[1.0, 2.0]]}}
        >>> cells_of({"cells": {}, "brief": brief})
        {'a': {'seeds': [0, 1], 'metrics': {'hacks': [1.0, 2.0]}}}

    Raises:
        InvalidValueError: see ``check_cells``; of what is in brief, metrics and cells do not fit together.
    """
    check_cells(data)
    if "brief" not in data:
        return data["cells"]
    brief = _checks.instance("brief", data["brief"], dict, "an object")
    for name, kind, allowed in (("seeds", list, "a list"), ("metrics", list, "a list"), ("cells", dict, "an object")):
        _checks.instance(f"brief.{name}", brief.get(name), kind, allowed)
    written_out = {}
    for key, values in brief["cells"].items():
        if not isinstance(values, list) or len(values) != len(brief["metrics"]):
            allowed = f"a list for each of {len(brief['metrics'])} metrics"
            raise _checks.InvalidValueError(f"brief.cells[{key}]", values, allowed)
        written_out[key] = {"seeds": brief["seeds"], "metrics": dict(zip(brief["metrics"], values, strict=True))}
    check_cells({"cells": written_out})
    return data["cells"] | written_out


def check_cells(data: Any) -> None:
    """Check that data are what ``extract`` gives: finite metrics and curves, as many as there are seeds.

    Examples:
        >>> check_cells({"cells": {"a": {"seeds": [0], "metrics": {"hacks": [1.0, 2.0]}}}})
        Traceback (most recent call last):
            ...
        uard._checks.InvalidValueError: cells[a].metrics.hacks.shape = (2,): must be one entry for each of 1 seeds

    Raises:
        InvalidValueError: naming the field.
    """
    cells = _checks.instance("cells", data.get("cells") if isinstance(data, dict) else data, dict, "cells by key")
    for key, cell in cells.items():
        kinds = (("seeds", list, "a list"), ("metrics", dict, "an object"))
        for name, kind, allowed in kinds:
            part = _checks.instance(f"cells[{key}]", cell, dict, "an object").get(name)
            _checks.instance(f"cells[{key}].{name}", part, kind, allowed)
        for part in ("metrics", "curves"):
            curves = _checks.instance(f"cells[{key}].{part}", cell.get(part, {}), dict, "an object")
            for name, values in curves.items():
                field = f"cells[{key}].{part}.{name}"
                shape = _checks.as_numpy(field, values).shape
                _checks.finite(field, values)
                if shape[:1] != (len(cell["seeds"]),) or len(shape) != (1 if part == "metrics" else 2):
                    raise _checks.InvalidValueError(
                        f"{field}.shape", shape, f"one entry for each of {len(cell['seeds'])} seeds"
                    )


def packaged_json(name: str) -> Any:
    """Return a packaged file's numbers, ours or a package's, or None if there is none.

    Examples:
        >>> packaged_json("best-of-n.json")["problem"]["models"]
        5
        >>> packaged_json("no-such-file.json") is None
        True
    """
    for place in _places():
        if (file := place.folder / name).is_file():
            return json.loads(file.read_text(encoding="utf-8"))
    return None


@cache
def packaged() -> Published:
    """Return what is published with this version and the installed packages."""
    from uard.lab.studies import every

    places = [_OWN, *brought("results", _checked)[0].values()]
    return Published(every(), [_read(place, name) for place in places for name in place.studies])


def broken() -> list[PluginError]:
    """Return an error for each package's published results that cannot be used.

    Examples:
        >>> [str(error) for error in broken()]
        []
    """
    return brought("results", _checked)[1]


_OWN = ResultFiles(resources.files("uard.lab.published"), ("games.json", "panels.json"))


def _places() -> list[ResultFiles]:
    return [_OWN, *brought("results", _called)[0].values()]


def _read(place: ResultFiles, name: str) -> Any:
    return json.loads((place.folder / name).read_text(encoding="utf-8"))


def _format_of(data: dict[str, Any]) -> Any:
    """Return the format of a file's keys."""
    return data.get("format") or data.get("results")  # as it was called before format 3


def _checked(plugin: Plugin) -> ResultFiles:
    """Return a package's files; those of studies must have keys of the present format."""
    made = _called(plugin)
    for name in made.studies:
        try:
            cells_of(_read(made, name))
        except ValueError as error:  # of JSON, too
            raise PluginError(plugin, f"{name} is no published results: {error}") from None
        if (found := _format_of(_read(made, name))) != FORMAT:
            raise PluginError(plugin, f"{name} is of format {found}, not {FORMAT}: {MIGRATE}")
    return made


def _called(plugin: Plugin) -> ResultFiles:
    made = plugin.call()
    if not isinstance(made, ResultFiles):
        raise PluginError(plugin, f"{_checks.short(made)} is no ResultFiles")
    if lost := [name for name in made.studies if not (made.folder / name).is_file()]:
        raise PluginError(plugin, f"there is no file {', '.join(lost)} in {made.folder}")
    return made
