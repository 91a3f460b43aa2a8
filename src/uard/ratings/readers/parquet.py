"""Parquet, by pyarrow."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any, cast

import numpy as np

from uard import _checks
from uard.ratings.readers.columns import Choice, Numbers


def read_parquet(path: Path, choice: Choice, _: Numbers) -> tuple[dict[str, Any], list[str]]:
    """Return the chosen columns of a Parquet file, and the names of all; a column of lists ``x`` becomes ``x[0]`` ...

    Raises:
        InvalidValueError: there is no pyarrow, or the file is none that it can read; a column is missing, or one that
            is wanted is not of numbers.
    """
    try:  # pyarrow has no types
        pa: Any = importlib.import_module("pyarrow")
        parquet: Any = importlib.import_module("pyarrow.parquet")
    except ModuleNotFoundError:
        allowed = "a CSV or JSONL file, or first: pip install 'uard[doctor]' (pyarrow reads Parquet)"
        raise _checks.InvalidValueError("log", str(path), allowed) from None
    try:
        file = parquet.ParquetFile(path)
        there: list[str] = list(file.schema_arrow.names)
        table = file.read([n for n in dict.fromkeys(there) if choice.candidate(n)])
    except pa.ArrowException as error:
        raise _checks.InvalidValueError("log", str(path), f"a Parquet file ({error})") from None
    names: list[str] = []
    found: dict[str, Any] = {}
    for place, name in enumerate(table.column_names):
        parts = _parts(name, table.column(place), pa, choice)
        names += parts
        found |= parts
    names += [n for n in there if not choice.candidate(n)]
    as_numbers, as_texts = choice.columns(names)
    columns = {n: _numbers(found[n], n, pa, path) for n in as_numbers}
    return columns | {n: _cells(found[n]) for n in as_texts}, names


def _parts(name: str, column: Any, pa: Any, choice: Choice) -> dict[str, Any]:
    """Return one column of the file as one or several by name."""
    kind, of = column.type, pa.types
    listed = of.is_list(kind) or of.is_fixed_size_list(kind) or of.is_large_list(kind)
    if not (listed and choice.may_be_list(name)):
        return {name: column}
    rows: list[list[Any]] = [x or [] for x in column.to_pylist()]
    widest = max(map(len, rows), default=0)
    return {f"{name}[{i}]": [row[i] if i < len(row) else None for row in rows] for i in range(widest)}


def _cells(column: Any) -> list[Any]:
    return cast("list[Any]", column if isinstance(column, list) else column.to_pylist())


def _numbers(column: Any, name: str, pa: Any, path: Path) -> Any:
    if isinstance(column, list):  # a part of a column of lists
        return cast("list[Any]", column)
    kind, of = column.type, pa.types
    if not (of.is_integer(kind) or of.is_floating(kind) or of.is_decimal(kind) or of.is_null(kind)):
        raise _checks.InvalidValueError(f"{path}: column {name!r}", str(kind), "a column of numbers")
    try:
        return np.asarray(column.cast(pa.float64()).to_numpy(), dtype=float)
    except pa.ArrowInvalid as error:
        allowed = f"numbers that a float of 64 bits holds exactly, between -2^53 and 2^53 ({error})"
        raise _checks.InvalidValueError(f"{path}: column {name!r}", str(kind), allowed) from None
