"""Where finished seeds live: one SQLite file, written in transactions, so nothing half-written is ever read."""

from __future__ import annotations

import json
import sqlite3
import time
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from uard import __version__
from uard.lab.cell import Cell
from uard.lab.result import CorruptResultError, Result, digest

_SCHEMA = """
begin immediate;
create table if not exists cells (key text primary key, config text not null);
create table if not exists results (
    key text not null references cells (key), seed integer not null, data blob not null, checksum text not null,
    metrics text not null, version text not null, created real not null, primary key (key, seed)
);
create table if not exists quarantine (key text, seed integer, data blob, reason text, created real);
commit;
"""
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


class Store:
    """Finished results by (cell, seed). Several processes may use one file.

    Attributes:
        path: The file; ``:memory:`` keeps nothing.
    """

    def __init__(self, path: str | Path):
        """Open the file, or make it.

        Raises:
            StoreError: the folder cannot be written, or the file is no sound result store.
        """
        self.path = str(path)
        try:
            if self.path != ":memory:":
                Path(self.path).parent.mkdir(parents=True, exist_ok=True)
            self._db = sqlite3.connect(self.path, timeout=60)
            try:
                self._prepare()
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
                "and start again, or name another with --store"
            ) from None

    def _prepare(self) -> None:
        if self._db.execute("pragma quick_check(1)").fetchone()[0] != "ok":
            raise sqlite3.DatabaseError("its pages are damaged")
        tables = {row[0] for row in self._db.execute("select name from sqlite_master where type = 'table'")}
        columns = {row[1] for row in self._db.execute("pragma table_info(results)")}
        if tables and columns != _COLUMNS:
            raise sqlite3.DatabaseError("its tables are another program's or another version's")
        self._db.execute("pragma journal_mode=wal")
        self._db.execute("pragma synchronous=normal")
        self._db.executescript(_SCHEMA)

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
        try:
            with self._db:
                for cell, seed, result in finished:
                    key, data, metrics = cell.key, result.pack()[0], json.dumps(result.metrics())
                    self._db.execute(
                        "insert or ignore into cells values (?, ?)", (key, json.dumps(cell.config(), sort_keys=True))
                    )
                    self._db.execute(
                        "insert or ignore into results values (?, ?, ?, ?, ?, ?, ?)",
                        (key, seed, data, digest(data + metrics.encode()), metrics, __version__, now),
                    )
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

        They are as sound as they were when ``have`` last looked.
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

    def _quarantine(self, key: str, seed: int, data: bytes, reason: str) -> None:
        with self._db:
            self._db.execute("insert into quarantine values (?, ?, ?, ?, ?)", (key, seed, data, reason, time.time()))
            self._db.execute("delete from results where key = ? and seed = ? and data = ?", (key, seed, data))

    def quarantined(self) -> list[tuple[str, int, str]]:
        """Return (key, seed, reason) of every result that was found corrupt."""
        return [tuple(row) for row in self._db.execute("select key, seed, reason from quarantine")]

    def cells(self) -> list[Stored]:
        """Return all cells, whatever program wrote them; they are as sound as they were when ``have`` last looked."""
        metrics: dict[str, dict[int, dict[str, float]]] = defaultdict(dict)
        for key, seed, text in self._db.execute("select key, seed, metrics from results order by seed"):
            metrics[key][seed] = json.loads(text)
        failed: dict[str, int] = {}
        if self._db.execute("select 1 from sqlite_master where name = 'failures'").fetchone():
            failed = dict(self._db.execute("select key, count(*) from failures group by key"))
        configs = dict(self._db.execute("select key, config from cells"))
        return [
            Stored(json.loads(config), metrics[key], failed.get(key, 0))
            for key, config in configs.items()
            if key in metrics or key in failed
        ]

    def count(self) -> tuple[int, int]:
        """Return the numbers of cells and of finished seeds."""
        row = self._db.execute("select count(distinct key), count(*) from results").fetchone()
        return int(row[0]), int(row[1])
