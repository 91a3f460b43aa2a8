"""Brings what older versions have written over to the present format of configurations and keys: ``uard migrate``.

The old file is kept beside the new one.
"""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from uard import _checks
from uard._support import files
from uard.lab.config import FORMAT
from uard.lab.execution import format_2
from uard.lab.execution.claims import LEASE, Owner
from uard.lab.execution.format_2 import UnmappedError
from uard.lab.execution.rows import check_failure, check_run, checksum_of, finished_seed
from uard.lab.execution.store import TABLES, StoreError, check_store, create_tables, text_of
from uard.lab.result import CorruptResultError, digest


@dataclass(frozen=True)
class Migration:
    """What became of an old store or file.

    Examples:
        >>> done = Migration(Path("s.sqlite"), Path("s.sqlite.format-2"), 2, Counter(results=20))
        >>> lines(done)
        ['s.sqlite: 2 cells, 20 seeds have new keys', 'the old file is kept as s.sqlite.format-2']

    Attributes:
        path: What was migrated; the new one stands there now.
        backup: The old one.
        cells: That have new keys.
        rows: By table, how many rows were brought over; of a file of published results, only ``results``: its seeds.
        left: What stands in the backup only: why, and how many rows that are.
        checkpoints: Unfinished long runs, which begin again: their checkpoints are an older program's.
    """

    path: Path
    backup: Path
    cells: int
    rows: Counter[str]
    left: Counter[str] = field(default_factory=Counter)
    checkpoints: int = 0


def lines(migration: Migration) -> list[str]:
    """Return the report's lines."""
    m = migration
    others = ", ".join(f"{count} {table}" for table, count in m.rows.items() if table != "results")
    text = [f"{m.path}: {m.cells} cells, {m.rows['results']} seeds have new keys{f'; {others}' if others else ''}"]
    text += [f"only in {m.backup}: {count} rows, for {why}" for why, count in m.left.items()]
    if m.checkpoints:
        text.append(f"{m.checkpoints} long runs begin again: their checkpoints are an older version's")
    return [*text, f"the old file is kept as {m.backup}"]


def migrate(path: str | Path) -> Migration:
    """Bring a result store, or a JSON file of published results, over to the present format.

    The new one takes its place; the old one is kept beside it, under its name with ``.format-2`` behind.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     file = Path(folder, "published.json")
        ...     _ = file.write_text('{"results": 2, "cells": {}}')  # as an older version wrote it
        ...     done = migrate(file)
        >>> done.cells, done.backup.name
        (0, 'published.json.format-2')

    Raises:
        InvalidValueError: there is no such file, or nothing in it to migrate.
        StoreError: the store is damaged, cannot be written, is in use, or is of another format than the last.
    """
    path = Path(path).resolve()  # the file itself, not a link to it
    if not os.path.isfile(path):  # Path's raises for a long name
        raise _checks.InvalidValueError("path", str(path), "a result store, or a JSON file of published results")
    backup = path.with_name(f"{path.name}.format-{format_2.NUMBER}")
    return _migrate_published(path, backup) if path.suffix == ".json" else _migrate_store(path, backup)


class _Keys:
    """New keys and configurations by old keys, and why there is none."""

    def __init__(self, configs: dict[str, Any]):
        self.new: dict[str, tuple[str, dict[str, Any]]] = {}
        self.why: dict[str, str] = {}
        for key, old in configs.items():
            try:
                config = format_2.new_config(old)
                self.new[key] = format_2.new_key(config, old), config
            except UnmappedError as error:
                self.why[key] = str(error)

    def reason(self, key: str) -> str:
        """Return why an old key has no new one."""
        return self.why.get(key, "no configuration is stored with their keys")


def _migrate_published(path: Path, backup: Path) -> Migration:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise _checks.InvalidValueError("path", str(path), f"JSON ({error})") from None
    if not isinstance(data, dict) or not isinstance(data.get("cells"), dict) or data.get("results") != format_2.NUMBER:
        allowed = f"published results of format {format_2.NUMBER} (what `uard reproduce --extract` wrote)"
        raise _checks.InvalidValueError("path", str(path), allowed)
    whole = {k: c for k, c in data["cells"].items() if _is_cell(c)}
    keys, rows, left, cells = _Keys({k: c["config"] for k, c in whole.items()}), Counter[str](), Counter[str](), {}
    left["they are no cell with config, seeds and metrics"] += len(data["cells"]) - len(whole)
    for key, cell in whole.items():
        if key not in keys.new:
            left[keys.reason(key)] += len(cell["seeds"])
            continue
        new, config = keys.new[key]
        if new in cells:
            left["another cell of the same configuration was there"] += len(cell["seeds"])
            continue
        cells[new] = {**cell, "config": config, "metrics": _renamed(cell["metrics"], format_2.METRICS)}
        if "curves" in cell:
            cells[new]["curves"] = _renamed(cell["curves"], format_2.COLUMNS)
        rows["results"] += len(cell["seeds"])
    _check_free(path, backup)
    head = {"format" if k == "results" else k: FORMAT if k == "results" else v for k, v in data.items()}
    try:
        text = json.dumps(head | {"cells": cells}, allow_nan=False) + "\n"
    except ValueError:
        raise _checks.InvalidValueError("path", str(path), "published results without NaN and infinity") from None
    shutil.copy2(path, backup)
    files.write(path, text, "path")
    return Migration(path, backup, len(cells), rows, +left)


def _is_cell(cell: Any) -> bool:
    parts = {"config": dict, "seeds": list, "metrics": dict}
    return isinstance(cell, dict) and all(isinstance(cell.get(name), kind) for name, kind in parts.items())


def _check_free(path: Path, backup: Path) -> None:
    if os.path.lexists(backup):
        raise _checks.InvalidValueError("path", str(path), f"one whose backup is not there yet; move {backup} away")


def _renamed(values: dict[str, Any], names: dict[str, str]) -> dict[str, Any]:
    return {names.get(name, name): value for name, value in values.items()}


def _migrate_store(path: Path, backup: Path) -> Migration:
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f"{path.name}.", suffix=".migrating")
    except OSError as error:
        raise StoreError(f"store = {str(path)!r}: could not be migrated ({error}); nothing was changed") from None
    os.close(handle)
    fresh = Path(name)
    fresh.chmod(path.stat().st_mode & 0o777)
    try:
        with _alone(path) as source, closing(sqlite3.connect(fresh)) as target:
            _check_free(path, backup)
            create_tables(target)
            cells, rows, left = _copied(source, target)
            target.close()
            _keep(path, backup)
            os.replace(fresh, path)  # while nobody else can write
    except (OSError, sqlite3.Error) as error:
        raise StoreError(f"store = {str(path)!r}: could not be migrated ({error}); nothing was changed") from None
    finally:
        fresh.unlink(missing_ok=True)
    checkpoints = len(list(Path(f"{path}-checkpoints").glob("*.checkpoint")))
    return Migration(path, backup, cells, rows, left, checkpoints)


@contextmanager
def _alone(path: Path) -> Iterator[sqlite3.Connection]:
    """Open an old store so that nobody else reads or writes it, all of it in one file.

    Raises:
        StoreError: it is at work, or of another format.
        sqlite3.Error: it is in use, or damaged.
    """
    with closing(sqlite3.connect(path, timeout=5)) as db:
        db.text_factory = text_of
        if db.execute("pragma user_version").fetchone()[0] == FORMAT:
            check_store(db, str(path))  # one that is damaged is not well
            raise StoreError(f"store = {str(path)!r}: is of format {FORMAT} already; there is nothing to migrate")
        tables = check_store(db, str(path), format_2.NUMBER)
        if "runs" in tables:
            living = """select token, host, place, pid, born, beat from runs
                where ended is null and typeof(beat) in ('real', 'integer')"""
            for *owner, beat in db.execute(living):
                # A heartbeat from the future is of another clock, and says nothing; the lock below still does.
                if Owner(*owner).alive(beat) and beat < time.time() + LEASE:
                    raise StoreError(
                        f"store = {str(path)!r}: {Owner(*owner)} is at work on it; wait for it, or stop it"
                    )
        db.execute("pragma locking_mode = exclusive")
        db.execute("pragma journal_mode = delete")  # fails while another process has it open
        db.execute("begin exclusive")
        yield db
        db.rollback()


def _keep(path: Path, backup: Path) -> None:
    """Make the backup without taking the store away, not even for a moment."""
    try:
        os.link(path, backup)
    except OSError:  # a file system without links
        shutil.copy2(path, backup)


def _copied(source: sqlite3.Connection, target: sqlite3.Connection) -> tuple[int, Counter[str], Counter[str]]:
    """Copy all rows with new keys; return how many cells and rows there are, and why which were left out."""
    there = {row[0] for row in source.execute("select name from sqlite_master where type = 'table'")}
    keys = _Keys({key: _parsed(text) for key, text in source.execute("select key, config from cells")})
    rows, left = Counter[str](), Counter[str]()
    with target:
        for new, config in keys.new.values():
            text = json.dumps(config, sort_keys=True)
            rows["cells"] += target.execute("insert or ignore into cells values (?, ?)", (new, text)).rowcount
        for table in (t for t in TABLES if t in there and t != "cells"):
            names = [row[1] for row in target.execute(f"pragma table_info({table})")]
            for values in source.execute(f"select {', '.join(names)} from {table}"):
                row = dict(zip(names, values, strict=True))
                if "key" in row and row["key"] not in keys.new:
                    left[keys.reason(row["key"])] += 1
                    continue
                if "key" in row:
                    row["key"] = keys.new[row["key"]][0]
                try:
                    place, row = _checked(table, row)
                except _checks.InvalidValueError as error:
                    left[f"they are damaged ({table}: {error})"] += 1
                    continue
                marks = ", ".join("?" * len(row))
                put = f"insert or ignore into {place} ({', '.join(row)}) values ({marks})"
                added = target.execute(put, tuple(row.values())).rowcount
                rows[place] += added
                left["another row of the same cell and seed was there"] += 1 - added
    return rows.pop("cells", 0), rows, +left


def _parsed(text: Any) -> Any:
    try:
        return json.loads(text)
    except (TypeError, ValueError, RecursionError):
        return text  # which is no configuration, and is told so


def _checked(table: str, row: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return a row with new names of metrics, and its table: a result that is not sound goes into quarantine.

    Raises:
        InvalidValueError: a row of another table that is damaged.
    """
    if check := {"runs": check_run, "failures": check_failure}.get(table):
        check(*row.values())
    if table != "results":
        return table, row
    try:
        return table, _renamed_result(row)
    except (CorruptResultError, _checks.InvalidValueError) as error:
        kept = {k: row[k] for k in ("key", "seed", "data", "created")}
        return "quarantine", kept | {"reason": str(error)}


def _renamed_result(row: dict[str, Any]) -> dict[str, Any]:
    data, text = row["data"], row["metrics"]
    if not (isinstance(data, bytes) and isinstance(text, str) and digest(data + text.encode()) == row["checksum"]):
        raise CorruptResultError("checksum does not match")
    old = _parsed(text)
    metrics = json.dumps(_renamed(old, format_2.METRICS) if isinstance(old, dict) else old)
    new = row | {"metrics": metrics, "checksum": checksum_of(row["key"], row["seed"], data, metrics)}
    finished_seed(0, *new.values())
    return new
