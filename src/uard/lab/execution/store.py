"""Where finished seeds live: one SQLite file, written in transactions, so nothing half-written is ever read.

It also says who is training what, so that several processes share the work, and what failed, and why.
"""

from __future__ import annotations

import json
import os
import sqlite3
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from uard import __version__
from uard.lab.cell import Cell
from uard.lab.config import FORMAT, check_names
from uard.lab.execution.claims import Owner
from uard.lab.result import CorruptResultError, Result, digest

# The file's ``user_version`` is the format of its keys; what is of an older one goes through ``uard migrate``.
TABLES = {
    "cells": "(key text primary key, config text not null)",
    "results": """(
        key text not null references cells (key), seed integer not null, data blob not null, checksum text not null,
        metrics text not null, version text not null, created real not null, primary key (key, seed)
    )""",
    "quarantine": "(key text, seed integer, data blob, reason text, created real)",
    "runs": """(
        token text primary key, host text not null, place text not null, pid integer not null, born integer not null,
        began real not null, beat real not null, total integer not null, done integer not null default 0,
        failed integer not null default 0, remaining real, ended real
    )""",
    "claims": """(
        key text not null, seed integer not null, token text not null references runs (token), since real not null,
        primary key (key, seed)
    )""",
    "attempts": "(key text not null, seed integer not null, token text not null, began real not null)",
    "failures": """(
        key text not null, seed integer not null, error text not null, traceback text not null, version text not null,
        token text not null, created real not null, primary key (key, seed)
    )""",
}
# Whoever asks what is finished need not walk past the bytes.
_INDEX = "create index if not exists results_finished on results (key, seed, created);"
UNNUMBERED = 2  # format of stores whose file bears no number
_COLUMNS = {"key", "seed", "data", "checksum", "metrics", "version", "created"}  # of results


class StoreError(RuntimeError):
    """The result store cannot be used; the message names the file and says what to do."""


@dataclass(frozen=True)
class Stored:
    """What a store says of one cell, without its curves.

    Attributes:
        config: ``Cell.config``, as it was when the cell was trained.
        metrics: By seed.
        failed: Seeds that could not be trained when that was last tried.
    """

    config: dict[str, Any]
    metrics: dict[int, dict[str, float]]
    failed: int


@dataclass(frozen=True)
class WorkerRun:
    """One process's work on a store, as it last said itself.

    Attributes:
        owner: The process.
        began: When it began, in seconds since 1970.
        beat: Its last heartbeat.
        total: Seeds that were missing when it began.
        done: Those of them that are finished or failed, whoever trained them.
        failed: Those that failed.
        remaining: Seconds that it thought it would still need; None if it could not know.
        ended: When it stopped in good order; None if it runs, or died.
        claimed: Seeds that it trains, or trained when it died.
    """

    owner: Owner
    began: float
    beat: float
    total: int
    done: int
    failed: int
    remaining: float | None
    ended: float | None
    claimed: int

    @property
    def alive(self) -> bool:
        """Whether it is still at work."""
        return self.ended is None and self.owner.alive(self.beat)


@dataclass(frozen=True)
class FailedSeed:
    """Why a seed could not be trained when that was last tried.

    Examples:
        >>> cell, store = Cell(), Store(":memory:")
        >>> store.fail([(cell, 3)], "ValueError: no", Owner.here())  # as ``runner.run`` does
        >>> [(seed, failed.error) for (key, seed), failed in store.failures().items() if key == cell.key]
        [(3, 'ValueError: no')]

    Attributes:
        error: One line.
        traceback: All of it.
        version: Of the program.
        token: Of the run that tried.
        created: When, in seconds since 1970.
    """

    error: str
    traceback: str
    version: str
    token: str
    created: float


class Store:
    """Finished results by (cell, seed). Several processes may use one file.

    Examples:
        >>> import numpy as np
        >>> cell, store = Cell(), Store(":memory:")
        >>> store.put([(cell, 0, Result(np.ones((500, 6)), steps=500, path=np.zeros(1), extra={}))])
        >>> store.missing(cell, range(3)), store.metrics(cell, [0])[0]["hacks"]
        ([1, 2], 1.0)

    Attributes:
        path: The file; ``:memory:`` keeps nothing.
    """

    def __init__(self, path: str | Path, readonly: bool = False):
        """Open the file, or make it.

        Args:
            path: The file.
            readonly: Only read: the file must be there, and is not changed.

        Raises:
            StoreError: the folder cannot be written, or the file is no sound result store, or is not there.
        """
        self.path = str(path)
        if not self.path or os.path.isdir(self.path):
            raise StoreError(f"store = {self.path!r}: must be a file that can be written, not a folder")
        if readonly and not os.path.isfile(self.path):  # Path's raises for a long name
            raise StoreError(f"store = {self.path!r}: must be a result store, but there is no such file")
        try:
            if readonly:
                self._db = sqlite3.connect(f"file:{quote(self.path)}?mode=ro", timeout=60, uri=True)
            else:
                if self.path != ":memory:":
                    Path(self.path).parent.mkdir(parents=True, exist_ok=True)
                self._db = sqlite3.connect(self.path, timeout=60)
            try:
                self._prepare(readonly)
            except BaseException:
                self._db.close()
                raise
        except OSError as error:
            raise StoreError(f"store = {self.path!r}: must be in a folder that can be written ({error})") from None
        except sqlite3.OperationalError as error:
            raise StoreError(f"store = {self.path!r}: must be a file that can be written ({error})") from None
        except sqlite3.DatabaseError as error:
            raise StoreError(
                f"store = {self.path!r}: must be a result store, but {error}. Nothing was changed. Move the file aside "
                "and start again, or take another store"
            ) from None

    def _prepare(self, readonly: bool) -> None:
        tables = check_store(self._db, self.path)
        if readonly and not tables:
            raise sqlite3.DatabaseError("it is empty")
        if readonly:
            return
        self._db.execute("pragma journal_mode=wal")
        self._db.execute("pragma synchronous=normal")
        create_tables(self._db)

    def close(self) -> None:
        """Close the file."""
        self._db.close()

    def have(self, cell: Cell) -> set[int]:
        """Return the seeds that are finished; a corrupt one is quarantined as by ``get``."""
        return {seed for seed, _ in self._sound(cell)}

    def missing(self, cell: Cell, seeds: Iterable[int]) -> list[int]:
        """Return those of the seeds that are not finished."""
        done = self.have(cell)
        return [s for s in seeds if s not in done]

    def put(self, finished: Sequence[tuple[Cell, int, Result]]) -> None:
        """Write some results, all or none.

        Raises:
            StoreError: the file cannot be written (a full disk, say); what was there stays.
        """
        now = time.time()
        with self._writing():
            for cell, seed, result in finished:
                key, data, metrics = cell.key, result.pack()[0], json.dumps(result.metrics())
                self._describe(cell)
                self._db.execute(
                    "insert or ignore into results values (?, ?, ?, ?, ?, ?, ?)",
                    (key, seed, data, digest(data + metrics.encode()), metrics, __version__, now),
                )
                for table in ("claims", "failures"):
                    self._db.execute(f"delete from {table} where key = ? and seed = ?", (key, seed))

    def _describe(self, cell: Cell) -> None:
        config = cell.config()
        if self.path != ":memory:":
            check_names(config)
        text = json.dumps(config, sort_keys=True)
        self._db.execute("insert or ignore into cells values (?, ?)", (cell.key, text))

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Do all or nothing; nobody else writes meanwhile."""
        try:
            with self._db:
                self._db.execute("begin immediate")
                yield
        except sqlite3.Error as error:
            raise StoreError(
                f"store = {self.path!r}: cannot be written ({error}); what was finished before is safe"
            ) from None

    def get(self, cell: Cell, seeds: Iterable[int]) -> dict[int, Result]:
        """Return the finished ones of the seeds.

        A corrupt one is moved to the table ``quarantine`` and left out, so that it is trained again.
        """
        wanted = set(seeds)
        found: dict[int, Result] = {}
        for seed, data in self._sound(cell):
            if seed not in wanted:
                continue
            try:
                found[seed] = Result.unpack(data, digest(data))
            except (CorruptResultError, ValueError, KeyError, OSError) as error:
                self._quarantine(cell.key, seed, data, str(error))
        return found

    def metrics(self, cell: Cell, seeds: Iterable[int]) -> dict[int, dict[str, float]]:
        """Return the metrics of the finished ones of the seeds, without reading their curves.

        They are as sound as they were when ``have`` last checked them.
        """
        wanted = set(seeds)
        rows = self._db.execute("select seed, metrics from results where key = ?", (cell.key,))
        return {seed: json.loads(text) for seed, text in rows if seed in wanted}

    def _sound(self, cell: Cell) -> list[tuple[int, bytes]]:
        """Return seed and bytes of every result whose checksum matches, and quarantine the others."""
        query = "select seed, data, metrics, checksum from results where key = ?"
        sound = []
        for seed, data, metrics, checksum in self._db.execute(query, (cell.key,)).fetchall():
            if digest(data + metrics.encode()) == checksum:
                sound.append((seed, data))
            else:
                self._quarantine(cell.key, seed, data, "checksum does not match")
        return sound

    def stored(self, key: str) -> tuple[dict[int, tuple[bytes, dict[str, float]]], list[int]]:
        """Return bytes and metrics of a cell's seeds, and which seeds are corrupt; nothing is changed."""
        query = "select seed, data, metrics, checksum from results where key = ?"
        sound, corrupt = {}, []
        for seed, data, metrics, checksum in self._db.execute(query, (key,)):
            if digest(data + metrics.encode()) == checksum:
                sound[seed] = data, json.loads(metrics)
            else:
                corrupt.append(seed)
        return sound, corrupt

    def configs(self) -> dict[str, str]:
        """Return the configuration, as JSON, of every cell that has a finished seed, by key."""
        query = "select key, config from cells where exists (select 1 from results where results.key = cells.key)"
        return dict(self._db.execute(query).fetchall())

    def versions(self) -> tuple[str, ...]:
        """Return the versions of the program that trained what is here."""
        return tuple(row[0] for row in self._db.execute("select distinct version from results order by version"))

    def _quarantine(self, key: str, seed: int, data: bytes, reason: str) -> None:
        with self._db:
            self._db.execute("insert into quarantine values (?, ?, ?, ?, ?)", (key, seed, data, reason, time.time()))
            self._db.execute("delete from results where key = ? and seed = ? and data = ?", (key, seed, data))

    def quarantined(self) -> list[tuple[str, int, str]]:
        """Return (key, seed, reason) of every result that was found corrupt."""
        return [tuple(row) for row in self._db.execute("select key, seed, reason from quarantine")]

    def cells(self) -> list[Stored]:
        """Return all cells, whatever program wrote them; they are as sound as ``have`` last found them."""
        metrics: dict[str, dict[int, dict[str, float]]] = defaultdict(dict)
        for key, seed, text in self._db.execute("select key, seed, metrics from results order by seed"):
            metrics[key][seed] = json.loads(text)
        failed = Counter(key for key, _ in self.failures())
        configs = dict(self._db.execute("select key, config from cells"))
        return [
            Stored(json.loads(config), metrics[key], failed[key])
            for key, config in configs.items()
            if key in metrics or key in failed
        ]

    def count(self) -> tuple[int, int]:
        """Return the numbers of cells and of finished seeds."""
        row = self._db.execute("select count(distinct key), count(*) from results").fetchone()
        return int(row[0]), int(row[1])

    def begin(self, owner: Owner, total: int) -> None:
        """Write down that a process goes to work on ``total`` missing seeds; claims of processes that have died end."""
        now = time.time()
        with self._writing():
            for run in self.runs():
                if run.ended is None and not run.alive:
                    self._db.execute("delete from claims where token = ?", (run.owner.token,))
                    self._db.execute("update runs set ended = beat where token = ?", (run.owner.token,))
            self._db.execute(
                "insert into runs (token, host, place, pid, born, began, beat, total) values (?, ?, ?, ?, ?, ?, ?, ?)",
                (*astuple(owner), now, now, total),
            )

    def report(self, owner: Owner, done: int, failed: int, remaining: float | None) -> None:
        """Write down how far a process is, for ``uard status``."""
        with self._writing():
            self._db.execute(
                "update runs set beat = ?, done = ?, failed = ?, remaining = ?, ended = null where token = ?",
                (time.time(), done, failed, remaining, owner.token),
            )

    def end(self, owner: Owner) -> None:
        """Give back what a process has claimed and not finished: it stops."""
        with self._writing():
            self._db.execute("delete from claims where token = ?", (owner.token,))
            self._db.execute("update runs set ended = ? where token = ?", (time.time(), owner.token))

    def claim(self, jobs: Sequence[tuple[Cell, int]], owner: Owner) -> list[tuple[Cell, int]]:
        """Take what is neither finished nor claimed by a living process; return it.

        What a dead process had claimed is taken over. Every seed taken is one more row of the table ``attempts``.
        """
        taken, now = [], time.time()
        with self._writing():
            held = self.claimed()
            for cell, seed in jobs:
                place = cell.key, seed
                finished = self._db.execute("select 1 from results where key = ? and seed = ?", place).fetchone()
                if finished or place in held:
                    continue
                self._db.execute("insert or replace into claims values (?, ?, ?, ?)", (*place, owner.token, now))
                self._db.execute("insert into attempts values (?, ?, ?, ?)", (*place, owner.token, now))
                taken.append((cell, seed))
        return taken

    def fail(self, jobs: Iterable[tuple[Cell, int]], traceback: str, owner: Owner) -> None:
        """Write down that seeds could not be trained, and why; their claims end."""
        error, now = traceback.strip().rpartition("\n")[2], time.time()
        with self._writing():
            for cell, seed in jobs:
                self._describe(cell)
                self._db.execute(
                    "insert or replace into failures values (?, ?, ?, ?, ?, ?, ?)",
                    (cell.key, seed, error, traceback, __version__, owner.token, now),
                )
                self._db.execute(
                    "delete from claims where key = ? and seed = ? and token = ?", (cell.key, seed, owner.token)
                )

    def runs(self) -> list[WorkerRun]:
        """Return who works here, or died and was not replaced, or was last to end, in the order of their beginning."""
        query = """
            select token, host, place, pid, born, began, beat, total, done, failed, remaining, ended,
                (select count(*) from claims where claims.token = runs.token)
            from runs where ended is null or ended = (select max(ended) from runs) order by began
        """
        return [WorkerRun(Owner(*row[:5]), *row[5:]) for row in self._db.execute(query)]

    def claimed(self) -> dict[tuple[str, int], WorkerRun]:
        """Return who is training each (key, seed); claims of processes that have died are left out."""
        living = {run.owner.token: run for run in self.runs() if run.alive}
        rows = self._db.execute("select key, seed, token from claims").fetchall()
        return {(key, seed): living[token] for key, seed, token in rows if token in living}

    def attempts(self) -> dict[tuple[str, int], list[str]]:
        """Return the tokens of those who began to train each (key, seed), in order."""
        found: dict[tuple[str, int], list[str]] = {}
        for key, seed, token in self._db.execute("select key, seed, token from attempts order by rowid"):
            found.setdefault((key, seed), []).append(token)
        return found

    def failures(self) -> dict[tuple[str, int], FailedSeed]:
        """Return what failed when it was last tried, by (key, seed)."""
        query = "select key, seed, error, traceback, version, token, created from failures"
        return {(row[0], row[1]): FailedSeed(*row[2:]) for row in self._db.execute(query)}

    def finished(self) -> dict[str, dict[int, float]]:
        """Return when each seed was finished, in seconds since 1970, by key; their bytes are not read."""
        found: dict[str, dict[int, float]] = {}
        for key, seed, created in self._db.execute("select key, seed, created from results"):
            found.setdefault(key, {})[seed] = created
        return found


def check_store(db: sqlite3.Connection, path: str, version: int = FORMAT) -> set[str]:
    """Return the tables of a sound store of a format, none of a new file.

    Raises:
        sqlite3.DatabaseError: it is damaged, or no store.
        StoreError: its keys are of another format; with what to do.
    """
    if db.execute("pragma quick_check(1)").fetchone()[0] != "ok":
        raise sqlite3.DatabaseError("its pages are damaged")
    tables = {row[0] for row in db.execute("select name from sqlite_master where type = 'table'")}
    if tables and {row[1] for row in db.execute("pragma table_info(results)")} != _COLUMNS:
        raise sqlite3.DatabaseError("its tables are another program's")
    found = db.execute("pragma user_version").fetchone()[0] or UNNUMBERED
    if tables and found != version:
        todo = f"`uard migrate {path}` brings it over; nothing is lost" if found < version else "a newer uard is needed"
        raise StoreError(f"store = {path!r}: must be of format {version}, but it is of format {found}: {todo}")
    return tables


def create_tables(db: sqlite3.Connection) -> None:
    """Make what is not there yet, all or nothing."""
    made = (f"create table if not exists {name} {columns};" for name, columns in TABLES.items())
    db.executescript(f"begin immediate; {''.join(made)} {_INDEX} pragma user_version = {FORMAT}; commit;")


def record_heartbeat(path: str, owner: Owner) -> None:
    """Write into a store that a process is alive, from whichever thread.

    Raises:
        StoreError: that is not possible.
    """
    try:
        with closing(sqlite3.connect(path, timeout=10)) as db, db:
            db.execute("update runs set beat = ?, ended = null where token = ?", (time.time(), owner.token))
    except sqlite3.Error as error:
        raise StoreError(f"store = {path!r}: cannot be written ({error})") from None
