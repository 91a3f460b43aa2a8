"""JSONL: one JSON object a line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, cast

from uard import _checks
from uard.ratings.readers.columns import Wanted, no_binary


def read_jsonl(path: Path, wanted: Wanted) -> dict[str, Any]:
    """Return the wanted columns of a JSONL file; a list ``x`` becomes the columns ``x[0]``, ``x[1]`` ...

    Raises:
        InvalidValueError: a line is no JSON object (the message names the row), or a row or column is missing.
    """
    columns: dict[tuple[str, int | None], list[Any]] = {}
    others: set[str] = set()
    row = 0

    def put(name: str, part: int | None, cell: Any) -> None:
        column = columns.get((name, part))
        if column is None:
            if not wanted.has(name):
                others.add(name)
                return
            column = columns[name, part] = [None] * row
        column.extend([None] * (row - len(column)))
        column.append(cell)

    with path.open(encoding="utf-8-sig") as file:
        for line in file:
            if line.isspace():
                continue
            for name, value in _entry(line, row, path, wanted.reward).items():
                if isinstance(value, list):
                    for part, cell in enumerate(cast("list[Any]", value)):
                        put(name, part, cell)
                else:
                    put(name, None, value)
            row += 1
    if not row:
        raise _checks.InvalidValueError("log", str(path), "a JSONL file with at least one row")
    for column in columns.values():
        column.extend([None] * (row - len(column)))
    named = {name if part is None else f"{name}[{part}]": column for (name, part), column in columns.items()}
    wanted.check([*named, *others])
    return named


def _entry(line: str, row: int, path: Path, reward: str) -> dict[str, Any]:
    no_binary(line, path)
    try:
        entry: Any = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise _checks.InvalidValueError(f"{path}: row {row + 1}", line.strip(), f"JSON ({error})") from None
    if not isinstance(entry, dict):
        raise _checks.InvalidValueError(f"{path}: row {row + 1}", entry, "a JSON object")
    named = cast("dict[str, Any]", entry)
    if reward not in named:
        raise _checks.UnknownNameError(f"{path}: row {row + 1}, column", reward, named)
    return named
