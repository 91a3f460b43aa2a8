"""What a stream knows as data: one file of arrays and JSON, from which nothing is ever executed or imported."""

from __future__ import annotations

import dataclasses
import json
import zipfile
import zlib
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from uard import _checks
from uard._support import fields, files
from uard.method.mitigations import NAMED, Mitigation

VERSION = 1
BROKEN = (
    *(OSError, EOFError, zipfile.BadZipFile, zlib.error, RuntimeError, AttributeError, LookupError, OverflowError),
    *(MemoryError, TypeError, ValueError),
)
"""What reading a file of another kind, a truncated or a changed one may raise."""


class State(NamedTuple):
    """What is in a file.

    Attributes:
        plain: Numbers, text, lists and dictionaries of such.
        arrays: Arrays of numbers by name.
    """

    plain: dict[str, Any]
    arrays: dict[str, np.ndarray]


def write(path: str | Path, state: State) -> None:
    """Write a file; what was there stays whole until the new one is complete.

    Raises:
        OSError: it cannot be written.
    """
    text = json.dumps({"version": VERSION, **state.plain})
    with files.replacing(path) as file:
        np.savez(file, allow_pickle=False, plain=np.frombuffer(text.encode(), np.uint8), **cast("Any", state.arrays))


def read(path: str | Path) -> State:
    """Read a file that ``write`` wrote.

    Raises:
        OSError, ValueError and others of ``BROKEN``: it is no such file.
    """
    with open(path, "rb") as file, np.load(file, allow_pickle=False) as found:
        arrays = {name: found[name] for name in found.files}
    plain = json.loads(arrays.pop("plain").tobytes())
    if plain["version"] != VERSION:
        raise _checks.InvalidValueError("version", plain["version"], str(VERSION))
    return State(plain, arrays)


def plain_key(key: Hashable) -> Any:
    """Return a key as JSON has it.

    Examples:
        >>> plain_key((3, b"a")), key_of(plain_key((3, b"a")))
        ([3, {'bytes': '61'}], (3, b'a'))

    Raises:
        InvalidValueError: it is of a kind that cannot be told from its text.
    """
    if isinstance(key, np.generic):
        return plain_key(cast("Any", key).item())
    if key is None or isinstance(key, bool | int | str | float):
        return key
    if isinstance(key, bytes):
        return {"bytes": key.hex()}
    if isinstance(key, tuple):
        return [plain_key(part) for part in cast("tuple[Hashable, ...]", key)]
    allowed = "a number, text, bytes, a truth value, None or a tuple of such, to be saved"
    raise _checks.InvalidValueError("key", key, allowed)


def key_of(plain: Any) -> Hashable:
    """Return the key that ``plain_key`` has made JSON of."""
    if isinstance(plain, list):
        return tuple(key_of(part) for part in cast("list[Any]", plain))
    return bytes.fromhex(cast("dict[str, str]", plain)["bytes"]) if isinstance(plain, dict) else plain


def described(value: Any) -> dict[str, Any]:
    """Return the name of a dataclass's class and, if it is one of uard's own mitigations or no mitigation, its fields.

    Examples:
        >>> from uard.method.mitigations import named
        >>> described(named("lcb"))
        {'kind': 'RatedReward', 'fields': {'statistic': 'bound', 'k': 1.0, 'unrated_weight': 1.0}}
    """
    kind = type(value).__name__
    known = not isinstance(value, Mitigation) or _own_mitigations().get(kind) is type(value)
    return {"kind": kind, "fields": _flat(value) if known else None}


def mitigation_of(plain: Mapping[str, Any]) -> Mitigation | None:
    """Return the mitigation that was ``described``; None if it is not one of uard's own.

    Raises:
        InvalidValueError: a field is unknown or has a value that is not allowed.
    """
    kind = _own_mitigations().get(plain["kind"])
    if kind is None or plain["fields"] is None:
        return None
    return fields.changed(kind(), plain["fields"], "mitigation")


def _own_mitigations() -> dict[str, type[Mitigation]]:
    every = (make() for make in NAMED.values())
    return {type(one).__name__: type(one) for one in every}


def _flat(value: Any, prefix: str = "") -> dict[str, Any]:
    """Return fields by dotted names."""
    flat: dict[str, Any] = {}
    for field in dataclasses.fields(value):
        part = getattr(value, field.name)
        inner = dataclasses.is_dataclass(part)
        flat |= _flat(part, f"{prefix}{field.name}.") if inner else {f"{prefix}{field.name}": plain_key(part)}
    return flat
