"""JSON: one object per line, or a list of objects; of rows, or as annotation tools export them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any, cast

from uard import _checks
from uard.ratings.log import bad_cell
from uard.ratings.readers.columns import Choice, Numbers, no_binary
from uard.ratings.readers.tools import rows_of


def read_jsonl(path: Path, choice: Choice, _: Numbers) -> tuple[dict[str, Any], list[str]]:
    """Return the chosen columns of a JSONL file, and the names of all; see ``read_json``."""
    return _table(_lines(path), path, choice)


def read_json(path: Path, choice: Choice, _: Numbers) -> tuple[dict[str, Any], list[str]]:
    """Return the chosen columns of a JSON file, and the names of all; a list ``x`` becomes ``x[0]``, ``x[1]`` ...

    Raises:
        InvalidValueError: it is no list of objects, or a column is missing.
    """
    text = path.read_text(encoding="utf-8-sig")
    no_binary(text, path)
    whole = _parsed(text, str(path))
    entries: Any = [whole] if isinstance(whole, dict) else whole
    if not isinstance(entries, list):
        raise _checks.InvalidValueError("log", str(path), "a list of JSON objects")
    return _table((_entry(x, row, path) for row, x in enumerate(cast("list[Any]", entries))), path, choice)


def _lines(path: Path) -> Iterator[dict[str, Any]]:
    row = 0
    with path.open(encoding="utf-8-sig") as file:
        for line in file:
            if line.isspace():
                continue
            no_binary(line, path)
            yield _entry(_parsed(line, f"{path}: row {row + 1}"), row, path)
            row += 1


def _parsed(text: str, where: str) -> Any:
    try:
        return json.loads(text, object_pairs_hook=_named_once)
    except (ValueError, RecursionError) as error:
        raise _checks.InvalidValueError(where, text.strip(), f"JSON ({error})") from None


def _named_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    entry = dict(pairs)
    if len(entry) < len(pairs):
        raise ValueError(f"a name is there twice among {', '.join(name for name, _ in pairs)}")
    return entry


def _entry(entry: Any, row: int, path: Path) -> dict[str, Any]:
    if not isinstance(entry, dict):
        raise _checks.InvalidValueError(f"{path}: row {row + 1}", entry, "a JSON object")
    return cast("dict[str, Any]", entry)


def _table(entries: Iterator[dict[str, Any]], path: Path, choice: Choice) -> tuple[dict[str, Any], list[str]]:
    """Return the chosen columns of rows, None where a row has nothing, and the names of all columns."""
    first = next(entries, None)
    if first is None:
        raise _checks.InvalidValueError("log", str(path), "a JSON file with at least one row")
    flatten = rows_of(first, path, choice.named)
    entries = chain([first], entries)
    rows = entries if flatten is None else (row for entry in entries for row in flatten(entry))
    columns, others, gaps = _columns(rows, choice)
    if flatten is not None and not columns:
        raise _checks.InvalidValueError("log", str(path), "an export with at least one answer that is a rating")
    for name in [n for n in columns if f"{n}[0]" in columns]:
        row = next((i for i, x in enumerate(columns[name]) if x is not None), None)
        if row is not None:
            raise bad_cell(str(path), row, name, columns[name][row], "a list, as in other rows")
        del columns[name]  # null beside lists: nobody has rated that row
    names = [*columns, *others]
    chosen = [n for part in choice.columns(names) for n in part]
    for name in choice.everywhere(names):
        if name in gaps:
            there = set(names) - {name}
            raise _checks.UnknownNameError(f"{path}: row {gaps[name] + 1}, column", name, there)
    return {n: columns[n] for n in chosen}, names


def _columns(
    rows: Iterable[dict[str, Any]], choice: Choice
) -> tuple[dict[str, list[Any]], dict[str, None], dict[str, int]]:
    """Return columns by name, the names of those that are not read, and in which row a column is first missing."""
    columns: dict[str, list[Any]] = {}
    others: dict[str, None] = {}
    gaps: dict[str, int] = {}
    same: dict[str, str] = {}  # names come again and again, and one text is enough
    count = 0

    def put(name: str, cells: list[Any]) -> None:
        column = columns.setdefault(name, [])
        if len(column) > count:  # a list, and beside it what is called as a part of it
            raise _checks.InvalidValueError(f"row {count + 1}, column", name, "there only once")
        if len(column) < count:
            gaps.setdefault(name, len(column))
            column.extend([None] * (count - len(column)))
        column += cells

    for entry in rows:
        for name, value in entry.items():
            if name in others:
                continue
            if name not in columns and not choice.candidate(name):
                others[name] = None
            elif isinstance(value, list) and choice.may_be_list(name):
                for part, cell in enumerate(cast("list[Any]", value)):
                    put(f"{name}[{part}]", [cell])
            elif isinstance(value, dict) and choice.may_be_list(name):
                for part, cell in cast("dict[str, Any]", value).items():
                    put(f"{name}.{part}", [cell])
            else:
                put(name, [same.setdefault(value, value) if isinstance(value, str) else value])
        count += 1
    for name in columns:
        put(name, [])
    return columns, others, gaps
