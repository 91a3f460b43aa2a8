"""CSV."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from uard import _checks
from uard.ratings.log import bad_cell
from uard.ratings.readers.columns import A_NUMBER, Wanted, no_binary

_MISSING = frozenset(("", "nan", "na", "n/a", "null", "none"))
_CHUNK = 50_000  # rows of text that are held at a time


def read_csv(path: Path, wanted: Wanted) -> dict[str, Any]:
    """Return the wanted columns of a CSV file, in chunks so that its text is never held whole.

    Raises:
        InvalidValueError: there is no header, a column is missing, a row has another number of cells, or a cell is no
            number; the message names row and column.
    """
    with path.open(encoding="utf-8-sig", newline="") as file:
        first = file.readline()
        if not first.strip():
            raise _checks.InvalidValueError("log", str(path), "a CSV file whose first line names its columns")
        no_binary(first, path)
        separator = max(",;\t", key=first.count)
        names = [name.strip() for name in next(csv.reader([first], delimiter=separator))]
        wanted.check(names)
        places = [(names.index(n), n) for n in dict.fromkeys(names) if wanted.has(n)]
        parts: dict[str, list[Any]] = {n: [] for _, n in places}
        start = 0
        for rows in _chunks(csv.reader(file, delimiter=separator), path):
            if set(map(len, rows)) != {len(names)}:
                i = next(i for i, row in enumerate(rows) if len(row) != len(names))
                allowed = f"{len(names)} cells, as the header has"
                raise _checks.InvalidValueError(f"{path}: row {start + i + 1}", separator.join(rows[i]), allowed)
            for place, name in places:
                cells = [row[place] for row in rows]
                parts[name].append(cells if name in wanted.labels else _parsed(cells, start, name, str(path)))
            start += len(rows)
    return {
        n: [x for p in part for x in p] if n in wanted.labels else np.concatenate([np.zeros(0), *part])
        for n, part in parts.items()
    }


def _chunks(reader: Iterator[list[str]], path: Path) -> Iterator[list[list[str]]]:
    """Yield rows in chunks; empty lines are no rows."""
    full = (row for row in reader if row)
    while True:
        try:
            rows = list(islice(full, _CHUNK))
        except csv.Error as error:
            raise _checks.InvalidValueError("log", str(path), f"a CSV file ({error})") from None
        if not rows:
            return
        yield rows


def _parsed(cells: list[str], start: int, column: str, source: str) -> np.ndarray:
    try:
        return np.array([float(cell or "nan") for cell in cells])
    except ValueError:
        return np.array([_from_text(cell, start + i, column, source) for i, cell in enumerate(cells)])


def _from_text(cell: str, row: int, column: str, source: str) -> float:
    try:
        return float(cell)
    except ValueError:
        if cell.strip().lower() in _MISSING:
            return np.nan
        raise bad_cell(source, row, column, cell, A_NUMBER) from None
