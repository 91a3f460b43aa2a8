"""Parquet, by pyarrow."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from uard import _checks
from uard.ratings.readers.columns import Wanted


def read_parquet(path: Path, wanted: Wanted) -> dict[str, Any]:
    """Return the wanted columns of a Parquet file; a column of lists ``x`` becomes ``x[0]``, ``x[1]`` ...

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
        names: list[str] = list(file.schema_arrow.names)
        table = file.read([n for n in names if wanted.has(n)])
    except pa.ArrowException as error:
        raise _checks.InvalidValueError("log", str(path), f"a Parquet file ({error})") from None
    columns: dict[str, Any] = {}
    for name in table.column_names:
        columns |= _parts(name, table.column(name), pa, path, wanted)
    wanted.check([*columns, *(n for n in names if not wanted.has(n))])
    return columns


def _parts(name: str, column: Any, pa: Any, path: Path, wanted: Wanted) -> dict[str, Any]:
    """Return one column of the file as one or several by name."""
    kind, of = column.type, pa.types
    if name in wanted.labels:
        return {name: column.to_pylist()}
    if of.is_list(kind) or of.is_fixed_size_list(kind) or of.is_large_list(kind):
        rows: list[list[Any]] = [x or [] for x in column.to_pylist()]
        widest = max(map(len, rows), default=0)
        return {f"{name}[{i}]": [row[i] if i < len(row) else None for row in rows] for i in range(widest)}
    if of.is_integer(kind) or of.is_floating(kind) or of.is_decimal(kind) or of.is_null(kind):
        return {name: np.asarray(column.cast(pa.float64()).to_numpy(), dtype=float)}
    raise _checks.InvalidValueError(f"{path}: column {name!r}", str(kind), "a column of numbers")
