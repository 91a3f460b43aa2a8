"""CSV and TSV."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np

from uard import _checks
from uard.ratings.readers.columns import Choice, Numbers, no_binary

_CHUNK = 50_000  # rows of text that are held at a time


def read_csv(path: Path, choice: Choice, numbers: Numbers) -> tuple[dict[str, Any], list[str]]:
    """Return the chosen columns of a CSV file, and the names of all; its text is held in chunks, never whole.

    Raises:
        InvalidValueError: there is no header, a column is missing, or a row has another number of cells.
    """
    with path.open(encoding="utf-8-sig", newline="") as file:
        first = file.readline()
        if not first.strip():
            raise _checks.InvalidValueError("log", str(path), "a CSV file whose first line names its columns")
        no_binary(first, path)
        separator = max(",;\t", key=first.count)
        chunks = _chunks(csv.reader(chain([first], file), delimiter=separator), path)
        names = [name.strip() for name in next(chunks)[0]]
        as_numbers, as_texts = choice.columns(names)
        parts: dict[str, list[Any]] = {n: [] for n in (*as_numbers, *as_texts)}
        same: dict[str, str] = {}  # names come again and again, and one text is enough
        start = 0
        for rows in chunks:
            if set(map(len, rows)) != {len(names)}:
                i = next(i for i, row in enumerate(rows) if len(row) != len(names))
                allowed = f"{len(names)} cells, as the header has"
                raise _checks.InvalidValueError(f"{path}: row {start + i + 1}", separator.join(rows[i]), allowed)
            for name in as_numbers:
                place = names.index(name)
                parts[name].append(numbers.of_text([row[place] for row in rows], name, start))
            for name in as_texts:
                place = names.index(name)
                parts[name] += [same.setdefault(row[place], row[place]) for row in rows]
            start += len(rows)
    return parts | {n: np.concatenate([np.zeros(0), *parts[n]]) for n in as_numbers}, names


def _chunks(reader: Iterator[list[str]], path: Path) -> Iterator[list[list[str]]]:
    """Yield the header, then rows in chunks; empty lines are no rows."""
    full = (row for row in reader if row)
    size = 1
    while True:
        try:
            rows = list(islice(full, size))
        except csv.Error as error:
            raise _checks.InvalidValueError("log", str(path), f"a CSV file ({error})") from None
        if not rows:
            return
        yield rows
        size = _CHUNK
