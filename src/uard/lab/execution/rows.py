"""The rows of a store: whatever is read is decoded here, and is what was written or an error.

SQLite puts any value into any column, and anybody can change a file. So every row is checked: its checksum, which
covers the cell's key, the seed, the bytes and the metrics, and the kind and range of every field.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

from uard import _checks
from uard.lab.config import key_of
from uard.lab.execution.claims import Owner
from uard.lab.result import METRICS, CorruptResultError, digest
from uard.lab.trainers import TRAINERS

FINISHED = "rowid, key, seed, data, checksum, metrics, version, created"  # columns of the table ``results``
_LATEST = 253_402_300_799  # seconds since 1970 at the end of the year 9999, the last that a date can be made of


@dataclass(frozen=True)
class FinishedSeed:
    """A row of the table ``results`` that is what was written.

    Attributes:
        rowid: Its number in the table.
        key: Of the cell.
        seed: Whole number >= 0.
        data: What ``Result.pack`` gave.
        metrics: ``METRICS`` by name, all finite.
        created: When it was written, in seconds since 1970.
    """

    rowid: int
    key: str
    seed: int
    data: bytes
    metrics: dict[str, float]
    created: float


@dataclass(frozen=True)
class DamagedSeed:
    """A row of the table ``results`` or ``cells`` that is not what was written, and counts as not there.

    Attributes:
        key: As it is read now; so is the seed.
        seed: None if it is the cell's configuration that is damaged, and so none of its seeds can be shown.
        reason: What is wrong.
    """

    key: str
    seed: int | str | None
    reason: str

    @staticmethod
    def of(key: Any, seed: Any, reason: str) -> DamagedSeed:
        """Return it with what stands there, of whatever kind, as text that can be shown."""
        key = key if isinstance(key, str) else _checks.short(key)
        return DamagedSeed(key, seed if isinstance(seed, int | None) else _checks.short(seed), reason)


def checksum_of(key: str, seed: int, data: bytes, metrics: str) -> str:
    """Return the checksum of a row: SHA-256 as 64 hexadecimal digits.

    Examples:
        >>> checksum_of("a", 1, b"", "{}") == checksum_of("a", 2, b"", "{}")
        False

    Args:
        key: Of the cell.
        seed: Its seed.
        data: Packed result.
        metrics: As JSON.
    """
    return digest(f"{key} {seed} {metrics}\n".encode() + data)


def finished_seed(
    rowid: int, key: Any, seed: Any, data: Any, checksum: Any, metrics: Any, version: Any, created: Any
) -> FinishedSeed:
    """Decode a row of the table ``results``.

    Raises:
        CorruptResultError: its checksum is another's, or its metrics are no finite numbers.
        InvalidValueError: a field is of another kind, or out of range.
    """
    for name, value, kind, allowed in (
        ("key", key, str, "text"),
        ("data", data, bytes, "bytes"),
        ("metrics", metrics, str, "text"),
        ("version", version, str, "text"),
    ):
        _checks.instance(name, value, kind, allowed)
    _checks.whole("seed", seed)
    _checks.number("created", created, low=0, high=_LATEST)
    # Rows that were written before the checksum covered key and seed have the second one.
    if checksum != checksum_of(key, seed, data, metrics) and checksum != digest(data + metrics.encode()):
        raise CorruptResultError("checksum does not match")
    return FinishedSeed(rowid, key, seed, data, _metrics(metrics), created)


def _metrics(text: str) -> dict[str, float]:
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict) or not found.keys() >= set(METRICS):
        raise CorruptResultError(f"metrics = {_checks.short(text)}: must be JSON with a number for each metric")
    for name, value in found.items():
        if type(value) not in (float, int) or not math.isfinite(value):
            raise CorruptResultError(f"metrics hold {name} = {_checks.short(value)}: must be a finite number")
    if not found["episode_length"]:
        raise CorruptResultError("metrics hold episode_length = 0: must be the length of an episode")
    return found


def config_of(key: Any, text: Any) -> dict[str, Any] | None:
    """Decode a configuration; None if the key is not that configuration's.

    Examples:
        >>> from uard.lab.cell import Cell
        >>> text = json.dumps(Cell().config())
        >>> config_of(Cell().key, text) == Cell().config(), config_of(Cell(episodes=3).key, text)
        (True, None)
    """
    try:
        config = json.loads(text)
        known = (key_of(config, t.name, v) for t in TRAINERS for v in range(t.version, 0, -1))
        return config if isinstance(config, dict) and any(key == one for one in known) else None
    except (TypeError, ValueError, RecursionError):
        return None


def check_run(
    token: Any,
    host: Any,
    place: Any,
    pid: Any,
    born: Any,
    began: Any,
    beat: Any,
    total: Any,
    done: Any,
    failed: Any,
    remaining: Any,
    ended: Any,
) -> Owner:
    """Check a row of the table ``runs`` and return whose it is.

    Raises:
        InvalidValueError: a field is of another kind, or out of range.
    """
    for name, value in (("token", token), ("host", host), ("place", place)):
        _checks.instance(name, value, str, "text")
    for name, value in (("pid", pid), ("born", born), ("total", total), ("done", done), ("failed", failed)):
        _checks.whole(name, value)
    for name, value in (("began", began), ("beat", beat), ("ended", 0 if ended is None else ended)):
        _checks.number(name, value, low=0, high=_LATEST)
    if remaining is not None:
        _checks.number("remaining", remaining, low=0)
    return Owner(token, host, place, pid, born)


def check_failure(key: Any, seed: Any, error: Any, traceback: Any, version: Any, token: Any, created: Any) -> None:
    """Check a row of the table ``failures``.

    Raises:
        InvalidValueError: a field is of another kind, or out of range.
    """
    for name, value in (("key", key), ("error", error), ("traceback", traceback), ("version", version)):
        _checks.instance(name, value, str, "text")
    _checks.instance("token", token, str, "text")
    _checks.whole("seed", seed)
    _checks.number("created", created, low=0, high=_LATEST)
