"""Parquet, by pyarrow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from uard import _checks
from uard.ratings.log import LABELS
from uard.ratings.readers.columns import Wanted


def read_parquet(path: Path, wanted: Wanted) -> dict[str, Any]:
    """Return the wanted columns of a Parquet file; a column of lists ``x`` becomes ``x[0]``, ``x[1]`` ..."""
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ModuleNotFoundError:
        allowed = "a CSV or JSONL file, or first: pip install 'uard[doctor]' (pyarrow reads Parquet)"
        raise _checks.InvalidValueError("log", str(path), allowed) from None
    try:
        file = parquet.ParquetFile(path)
        names = list(file.schema_arrow.names)
        table = file.read([n for n in names if wanted.has(n)])
    except pa.ArrowException as error:
        raise _checks.InvalidValueError("log", str(path), f"a Parquet file ({error})") from None
    columns: dict[str, Any] = {}
    for name in table.column_names:
        column = table.column(name)
        kind = column.type
        if name in LABELS:
            columns[name] = column.to_pylist()
        elif pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind) or pa.types.is_large_list(kind):
            rows = [x or [] for x in column.to_pylist()]
            for i in range(max(map(len, rows), default=0)):
                columns[f"{name}[{i}]"] = [row[i] if i < len(row) else None for row in rows]
        elif any(t(kind) for t in (pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal, pa.types.is_null)):
            columns[name] = np.asarray(column.cast(pa.float64()).to_numpy(), dtype=float)
        else:
            raise _checks.InvalidValueError(f"{path}: column {name!r}", str(kind), "a column of numbers")
    wanted.check([*columns, *(n for n in names if not wanted.has(n))])
    return columns
