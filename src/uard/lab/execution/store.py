"""Where finished seeds live: one SQLite file, written in transactions, so nothing half-written is ever read.

It also says who is training what, so that several processes share the work, and what failed, and why.
"""

from __future__ import annotations

import json
import os
import sqlite3
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any, TypeVar

from uard import InvalidValueError, __version__, _checks
from uard.lab.cell import Cell
from uard.lab.config import FORMAT, check_names
from uard.lab.execution import rows
from uard.lab.execution.claims import Owner
from uard.lab.execution.reading import can_be_written, open_for_reading
from uard.lab.execution.rows import DamagedSeed, FinishedSeed
from uard.lab.result import CorruptResultError, Result

T = TypeVar("T")

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


class MissingSeedsError(StoreError, LookupError):
    """Seeds that are not in a store, or are damaged there; the message says which."""


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

    Whatever is read is checked (``uard.lab.execution.rows``). A damaged seed counts as not there: ``have``, ``missing``
    and ``get`` move it to the table ``quarantine``, so that it is trained again; others name it in ``damaged``.

    Attributes:
        path: The file; ``:memory:`` keeps nothing.
        readonly: Whether it is only read.
    """

    def __init__(self, path: str | Path, readonly: bool = False):
        """Open the file, or make it.

        Args:
            path: The file.
            readonly: Only read: the file must be there, and is not changed. So is a file that is in a read-only place.

        Raises:
            StoreError: the folder cannot be written, or the file is no sound result store, or is not there.
        """
        self.path = str(path)
        if not self.path or os.path.isdir(self.path):
            raise StoreError(f"store = {self.path!r}: must be a file that can be written, not a folder")
        if readonly and not os.path.isfile(self.path):  # Path's raises for a long name
            raise StoreError(f"store = {self.path!r}: must be a result store, but there is no such file")
        self.readonly = readonly or (os.path.isfile(self.path) and not can_be_written(self.path))
        self._damaged_rows: dict[int, DamagedSeed] = {}  # by rowid
        self._damaged_cells: dict[str, DamagedSeed] = {}
        self._leaving = ExitStack()
        able = "read" if self.readonly else "written"
        try:
            with ExitStack() as leaving:
                self._db = self._open(leaving)
                self._leaving = leaving.pop_all()
        except OSError as error:
            raise StoreError(f"store = {self.path!r}: must be in a folder that can be {able} ({error})") from None
        except sqlite3.OperationalError as error:
            raise StoreError(f"store = {self.path!r}: must be a file that can be {able} ({error})") from None
        except sqlite3.DatabaseError as error:
            raise StoreError(
                f"store = {self.path!r}: must be a result store, but {error}. Nothing was changed. Move the file aside "
                "and start again, or take another store"
            ) from None

    def _open(self, leaving: ExitStack) -> sqlite3.Connection:
        if self.readonly:
            db = open_for_reading(self.path, leaving)
        else:
            if self.path != ":memory:":
                Path(self.path).parent.mkdir(parents=True, exist_ok=True)
            db = leaving.enter_context(closing(sqlite3.connect(self.path, timeout=60)))
        db.text_factory = text_of
        tables = check_store(db, self.path)
        if not self.readonly:
            db.execute("pragma journal_mode=wal")
            db.execute("pragma synchronous=normal")
            create_tables(db)
        elif not tables:
            raise sqlite3.DatabaseError("it is empty")
        return db

    def close(self) -> None:
        """Close the file."""
        self._leaving.close()

    @property
    def damaged(self) -> tuple[DamagedSeed, ...]:
        """What was damaged of all that has been read so far, was left out, and is not in quarantine."""
        return (*self._damaged_rows.values(), *self._damaged_cells.values())

    def have(self, cell: Cell) -> set[int]:
        """Return the seeds that are finished; a damaged one is quarantined as by ``get``."""
        found = {row.seed for row in self._sound(cell.key)}
        self._quarantine()
        return found

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
                    (key, seed, data, rows.checksum_of(key, seed, data, metrics), metrics, __version__, now),
                )
                for table in ("claims", "failures"):
                    self._db.execute(f"delete from {table} where key = ? and seed = ?", (key, seed))

    def _describe(self, cell: Cell) -> None:
        plain = cell.config()
        if self.path != ":memory:":
            check_names(plain)
        config = json.dumps(plain, sort_keys=True)
        put = "insert into cells values (?, ?) on conflict (key) do update set config = ? where config is not ?"
        self._db.execute(put, (cell.key, config, config, config))

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

    def _read(self, query: str, *values: Any) -> Iterator[tuple[Any, ...]]:
        """Yield what a query finds."""
        try:
            yield from self._db.execute(query, values)
        except sqlite3.Error as error:
            raise StoreError(f"store = {self.path!r}: cannot be read ({error})") from None

    def _sound(self, key: str | None = None) -> Iterator[FinishedSeed]:
        """Yield the finished seeds of a cell, or of all, that are what was written; the others are then ``damaged``."""
        query, values = f"select {rows.FINISHED} from results", ()
        if key is not None:
            query, values = f"{query} where key = ?", (key,)
        for row in self._read(query, *values):
            try:
                found = rows.finished_seed(*row)
            except (CorruptResultError, InvalidValueError) as error:
                self._damaged_rows[row[0]] = DamagedSeed.of(row[1], row[2], str(error))
            else:
                yield found

    def get(self, cell: Cell, seeds: Iterable[int]) -> dict[int, Result]:
        """Return the finished ones of the seeds.

        A damaged one is moved to the table ``quarantine`` and left out, so that it is trained again; where nothing can
        be written it is only left out.
        """
        wanted = set(seeds)
        found: dict[int, Result] = {}
        for row in self._sound(cell.key):
            if row.seed not in wanted:
                continue
            try:
                found[row.seed] = Result.unpack(row.data)
            except CorruptResultError as error:
                self._damaged_rows[row.rowid] = DamagedSeed.of(row.key, row.seed, str(error))
        self._quarantine()
        return found

    def metrics(self, cell: Cell, seeds: Iterable[int]) -> dict[int, dict[str, float]]:
        """Return the metrics of the finished ones of the seeds, without unpacking their curves."""
        wanted = set(seeds)
        return {row.seed: row.metrics for row in self._sound(cell.key) if row.seed in wanted}

    def stored(self, key: str) -> tuple[dict[int, tuple[bytes, dict[str, float]]], list[DamagedSeed]]:
        """Return bytes and metrics of a cell's seeds, and which of them are damaged; nothing is changed."""
        sound: dict[int, tuple[bytes, dict[str, float]]] = {}
        for row in self._sound(key):
            try:
                Result.unpack(row.data)
            except CorruptResultError as error:
                self._damaged_rows[row.rowid] = DamagedSeed.of(row.key, row.seed, str(error))
            else:
                sound[row.seed] = row.data, row.metrics
        return sound, [damaged for damaged in self.damaged if damaged.key == key]

    def configs(self) -> dict[str, dict[str, Any]]:
        """Return the configuration of every cell that has a finished seed, by key; a damaged one is left out."""
        query = "select key, config from cells where exists (select 1 from results where results.key = cells.key)"
        return self._configs(query)

    def _configs(self, query: str) -> dict[str, dict[str, Any]]:
        found = {}
        for key, text in self._read(query):
            if (config := rows.config_of(key, text)) is None:
                self._damaged_cells[key] = DamagedSeed.of(key, None, "its configuration is not what its key is of")
            else:
                found[key] = config
        return found

    def versions(self) -> tuple[str, ...]:
        """Return the versions of the program that trained what is here."""
        query = "select distinct version from results order by version"
        return tuple(version for (version,) in self._read(query) if isinstance(version, str))

    def _quarantine(self) -> None:
        """Move what was found damaged to the table of that name, where anything can be written."""
        if self.readonly or not self._damaged_rows:
            return
        with self._writing():
            for rowid in self._damaged_rows:
                for row in self._read(f"select {rows.FINISHED} from results where rowid = ?", rowid):
                    try:  # again, for another process may have put a sound one there
                        Result.unpack(rows.finished_seed(*row).data)
                    except (CorruptResultError, InvalidValueError) as error:
                        put = "insert into quarantine select key, seed, data, ?, ? from results where rowid = ?"
                        self._db.execute(put, (str(error), time.time(), rowid))
                        self._db.execute("delete from results where rowid = ?", (rowid,))
        self._damaged_rows.clear()

    def quarantined(self) -> list[tuple[str, int, str]]:
        """Return (key, seed, reason) of every result that was found corrupt."""
        return [tuple(row) for row in self._read("select key, seed, reason from quarantine")]

    def cells(self) -> list[Stored]:
        """Return all cells, whatever program wrote them, with their sound seeds in order."""
        metrics: dict[str, dict[int, dict[str, float]]] = defaultdict(dict)
        for row in self._sound():
            metrics[row.key][row.seed] = row.metrics
        failed = Counter(key for key, _ in self.failures())
        return [
            Stored(config, dict(sorted(metrics[key].items())), failed[key])
            for key, config in self._configs("select key, config from cells").items()
            if key in metrics or key in failed
        ]

    def count(self) -> tuple[int, int]:
        """Return the numbers of cells and of finished seeds."""
        ((cells, seeds),) = self._read("select count(distinct key), count(*) from results")
        return int(cells), int(seeds)

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
        return [WorkerRun(self._checked("runs", rows.check_run, row[:12]), *row[5:]) for row in self._read(query)]

    def _checked(self, table: str, check: Callable[..., T], row: Sequence[Any]) -> T:
        try:
            return check(*row)
        except InvalidValueError as error:
            where = f"store = {self.path!r}, table {table}, row {_checks.short(tuple(row[:2]))}"
            raise StoreError(f"{where}: {error}; delete that row, or take another store") from None

    def claimed(self) -> dict[tuple[str, int], WorkerRun]:
        """Return who is training each (key, seed); claims of processes that have died are left out."""
        living = {run.owner.token: run for run in self.runs() if run.alive}
        claims = self._read("select key, seed, token from claims")
        return {(key, seed): living[token] for key, seed, token in claims if token in living}

    def attempts(self) -> dict[tuple[str, int], list[str]]:
        """Return the tokens of those who began to train each (key, seed), in order."""
        found: dict[tuple[str, int], list[str]] = {}
        for key, seed, token in self._read("select key, seed, token from attempts order by rowid"):
            found.setdefault((key, seed), []).append(token)
        return found

    def failures(self) -> dict[tuple[str, int], FailedSeed]:
        """Return what failed when it was last tried, by (key, seed)."""
        query = "select key, seed, error, traceback, version, token, created from failures"
        found = {}
        for row in self._read(query):
            self._checked("failures", rows.check_failure, row)
            found[row[0], row[1]] = FailedSeed(*row[2:])
        return found

    def finished(self) -> dict[str, dict[int, float]]:
        """Return when each sound seed was finished, in seconds since 1970, by key."""
        found: dict[str, dict[int, float]] = {}
        for row in self._sound():
            found.setdefault(row.key, {})[row.seed] = row.created
        return found

    def places(self) -> set[tuple[str, int]]:
        """Return (key, seed) of all finished seeds, at once: their bytes are not read, and not checked."""
        return {(key, seed) for key, seed in self._read("select key, seed from results")}


def text_of(raw: bytes) -> str:
    """Decode any text: what is no UTF-8 must not end the reading of all other rows."""
    return raw.decode(errors="backslashreplace")


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
