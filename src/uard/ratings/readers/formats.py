"""Which ending a file has, and what reads it."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from uard import _checks
from uard.ratings.readers.columns import Choice, Numbers
from uard.ratings.readers.csv_file import read_csv
from uard.ratings.readers.json_file import read_json, read_jsonl
from uard.ratings.readers.parquet import read_parquet

FORMATS: dict[str, Callable[[Path, Choice, Numbers], tuple[dict[str, Any], list[str]]]] = {
    ".csv": read_csv,
    ".tsv": read_csv,
    ".jsonl": read_jsonl,
    ".ndjson": read_jsonl,
    ".json": read_json,
    ".parquet": read_parquet,
    ".pq": read_parquet,
}


def table(path: str | Path, choice: Choice, numbers: Numbers) -> tuple[dict[str, Any], list[str]]:
    """Read the chosen columns of a file; ``path`` with any of the endings ``FORMATS``.

    Returns:
        The columns by name, and the names of all columns.

    Raises:
        InvalidValueError: see ``uard.ratings.readers.read``.
    """
    path = Path(path)
    reader = FORMATS.get(path.suffix.lower())
    if reader is None or "\0" in str(path):
        raise _checks.InvalidValueError("log", str(path), f"a file that ends in {', '.join(FORMATS)}")
    try:
        return reader(path, choice, numbers)
    except OSError as error:
        why = os.strerror(error.errno) if error.errno else error
        raise _checks.InvalidValueError("log", str(path), f"a file that can be read ({why})") from None
    except UnicodeDecodeError as error:
        raise _checks.InvalidValueError(
            "log", str(path), f"UTF-8 text (byte {error.start}: {error.object[error.start : error.start + 1]!r})"
        ) from None
