"""Answers as files of other tools: long tables, TRL's preference rows, Label Studio's JSON; and the whole record."""

from __future__ import annotations

import csv
import importlib
import io
import json
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from functools import lru_cache
from typing import Any

from uard import _checks
from uard._support.text import printable
from uard.ratings.readers.columns import Wanted
from uard.ratings.readers.layout import layout_of
from uard.ratings.readers.spelling import normal
from uard.ratings.table import FIELDS, LATEST, LONGEST, Answer, Answers, answer_of

Contents = Mapping[str, Mapping[str, Any]]
"""Name of an item -> its content (``uard.collect.items``)."""
Row = dict[str, Any]


def write(answers: Answers, items: Contents, form: str) -> bytes:
    """Return answers as the bytes of a file.

    Forms:

    * ``csv``, ``jsonl``, ``parquet``: a row per answer that stands, practice left out: item, rater, rating or choice,
      what the environment paid, further attributes as columns. ``uard doctor`` and ``uard preferences`` read them.
    * ``trl``: a row per comparison of texts that is no tie, as TRL's ``DPOTrainer`` and ``RewardTrainer`` take them
      (JSONL): prompt, chosen and rejected.
    * ``label-studio``: a task per item with one annotation per rater, as Label Studio exports and imports it.
    * ``record``: every answer that was ever given, superseded ones, practice and what was taken back included (JSONL);
      ``read_record`` reads it.

    Examples:
        >>> said = Answers((Answer("a1", "x", "ann", 0.5, scale="slider -1..1"),))
        >>> print(write(said, {"x": {"kind": "text", "reward": 1.0}}, "csv").decode())
        item,rater,rating,reward,kind,shown_at,given_at,id
        x,ann,0.5,1.0,rating,1970-01-01T00:00:00+00:00,1970-01-01T00:00:00+00:00,a1
        <BLANKLINE>

    Args:
        answers: All of them.
        items: What was rated; an item that is not there is known by its name only.
        form: One of ``FORMS``.

    Raises:
        UnknownNameError: there is no such form.
        InvalidValueError: Parquet is wanted and pyarrow is not installed, or there are no comparisons of texts for
            ``trl``.
    """
    return _WRITERS[_checks.choose("form", form, FORMS)](answers, items)


def read_record(data: bytes) -> Answers:
    """Return the answers that ``write(..., "record")`` wrote.

    Examples:
        >>> said = Answers((Answer("a1", "x", "ann", 0.1),))
        >>> read_record(write(said, {}, "record")) == said
        True

    Raises:
        InvalidValueError: a line is none of them.
    """
    rows: list[Answer] = []
    lines = data.decode().split("\n")  # a comment may hold what else ends a line of text
    for number, line in enumerate(lines[:-1] if lines[-1] == "" else lines):
        try:
            rows.append(answer_of(json.loads(line)))
        except json.JSONDecodeError:
            raise _checks.InvalidValueError(f"line {number + 1}", line, "an answer as JSON") from None
    return Answers(tuple(rows))


def rows_of(answers: Answers, items: Contents) -> list[Row]:
    """Return a row per answer that stands, practice left out; columns that are empty everywhere are left out, too.

    Examples:
        >>> said = Answers((Answer("a1", "x", "ann", choice="left", left="u", right="v"),))
        >>> rows_of(said, {})[0]["choice"]
        'left'

    Args:
        answers: All of them.
        items: See ``write``.
    """
    rows: dict[tuple[str, str, str], Row] = {}  # attributes are given in one go, at one time
    attributes: list[str] = []
    given_with = _submissions(answers)
    for a in answers.standing():
        if a.kind == "practice":
            continue
        place = a.item, a.rater, given_with[a.id]
        row = rows.setdefault(place, _row(a, items.get(a.item, {})) | {"id": given_with[a.id]})
        if a.attribute:
            column = f"rated {a.attribute}" if is_taken(a.attribute) else a.attribute  # in a store of before
            row[column] = a.value
            attributes.append(column)
        else:
            row |= {"rating": a.value, "choice": a.choice, "comment": a.comment or None, "id": a.id}
    names = [*_COLUMNS, *(n for n in dict.fromkeys(attributes)), *_AFTER]
    used = [n for n in names if any(row.get(n) is not None for row in rows.values())]
    return [{n: row.get(n) for n in used} for row in rows.values()]


def _submissions(answers: Answers) -> dict[str, str]:
    """Return for each answer the name of what was first given in one go with it.

    An answer that takes another's place belongs to what that was given with, even if only one of several parts was
    corrected.
    """
    found: dict[str, str] = {}
    for a in answers:
        begun = found.get(a.supersedes, a.supersedes) if a.supersedes is not None else None
        if begun is None:
            begun = (a.id.rpartition(".")[0] or a.id) if a.attribute else a.id
        found[a.id] = begun
    return found


_COLUMNS = ("item", "rater", "rating", "left", "right", "choice", "reward", "stratum")
_AFTER = ("comment", "kind", "shown_at", "given_at", "id")
COLUMNS = (*_COLUMNS, *_AFTER)
"""Names of the columns of ``rows_of``, which no attribute may have."""


@lru_cache(maxsize=256)
def is_taken(name: str) -> bool:
    """Whether an attribute cannot be called so: it is a column's name, or would be read in the place of one.

    Examples:
        >>> is_taken("Reward"), is_taken("worker id"), is_taken("safe")
        (True, True, False)
    """
    if normal(name) in {normal(column) for column in COLUMNS}:
        return True
    wanted = Wanted("export")
    rated = tuple(column for column in COLUMNS if column not in ("left", "right", "choice"))
    for columns in (rated, tuple(column for column in rated if column != "reward")):
        try:
            if layout_of((*columns, name), wanted) != layout_of(columns, wanted):
                return True
        except _checks.InvalidValueError:  # it could not be told which of two columns is meant
            return True
    return False


def _row(answer: Answer, content: Mapping[str, Any]) -> Row:
    return {
        "item": answer.item,
        "rater": answer.rater,
        "left": answer.left,
        "right": answer.right,
        "reward": content.get("reward"),
        "stratum": printable(str(content.get("stratum") or ""))[:LONGEST] or None,  # which was any text once
        "kind": answer.kind,
        "shown_at": _time(answer.shown_at),
        "given_at": _time(answer.given_at),
    }


def _time(seconds: float) -> str:
    return datetime.fromtimestamp(min(seconds, LATEST), UTC).isoformat()


def _csv(answers: Answers, items: Contents) -> bytes:
    rows = rows_of(answers, items)
    out = io.StringIO(newline="")
    names = list(rows[0]) if rows else list(_COLUMNS)
    writer = csv.DictWriter(out, names, lineterminator="\n")
    writer.writerow({name: _harmless(name) for name in names})
    writer.writerows([{name: _harmless(value) for name, value in row.items()} for row in rows])
    return out.getvalue().encode(errors=_HALF)


def _harmless(value: Any) -> Any:
    """Return a cell that no spreadsheet runs as a formula: what raters write comes from outside."""
    return f"'{value}" if isinstance(value, str) and value[:1] in ("=", "+", "-", "@", "\t", "\r") else value


def _jsonl(answers: Answers, items: Contents) -> bytes:
    return _lines(rows_of(answers, items))


def _lines(rows: Sequence[Row]) -> bytes:
    return "".join(json.dumps(row, ensure_ascii=False, allow_nan=False) + "\n" for row in rows).encode(errors=_HALF)


_HALF = "backslashreplace"  # half of a surrogate pair has no UTF-8; in JSON its escape is read as what it was


def _encodable(value: Any) -> Any:
    """Return a cell that has UTF-8."""
    return value.encode(errors=_HALF).decode() if isinstance(value, str) else value


def _parquet(answers: Answers, items: Contents) -> bytes:
    try:  # pyarrow has no types
        pa: Any = importlib.import_module("pyarrow")
        parquet: Any = importlib.import_module("pyarrow.parquet")
    except ModuleNotFoundError:
        allowed = "csv or jsonl, or first: pip install 'uard[doctor]' (pyarrow writes Parquet)"
        raise _checks.InvalidValueError("form", "parquet", allowed) from None
    out = io.BytesIO()
    rows = [{_encodable(name): _encodable(value) for name, value in row.items()} for row in rows_of(answers, items)]
    parquet.write_table(pa.Table.from_pylist(rows), out)
    return out.getvalue()


def _trl(answers: Answers, items: Contents) -> bytes:
    rows: list[Row] = []
    for c in answers.comparisons():
        if c.tie:
            continue
        chosen, rejected = items.get(c.preferred, {}), items.get(c.other, {})
        if "completion" not in chosen or "completion" not in rejected:
            allowed = "a form for clips (csv, jsonl, parquet): TRL's rows hold texts"
            raise _checks.InvalidValueError("form", "trl", allowed)
        row: Row = {"chosen": chosen["completion"], "rejected": rejected["completion"]}
        if chosen.get("prompt") is not None and chosen.get("prompt") == rejected.get("prompt"):
            row = {"prompt": chosen["prompt"]} | row
        rows.append(row | {"rater": c.rater})
    if not rows:
        allowed = "a form for ratings (csv, jsonl, parquet): there are no comparisons of which one side was preferred"
        raise _checks.InvalidValueError("form", "trl", allowed)
    return _lines(rows)


def _label_studio(answers: Answers, items: Contents) -> bytes:
    tasks: dict[str, Row] = {}
    given_with = _submissions(answers)
    for a in answers.standing():
        if a.kind == "practice":
            continue
        data = {"item": a.item} | {k: v for k, v in items.get(a.item, {}).items() if v is not None}
        task = tasks.setdefault(a.item, {"id": len(tasks) + 1, "data": data, "annotations": []})
        marks = task["annotations"]
        group = given_with[a.id]
        mark = next((m for m in marks if m["unique_id"] == group), Row())
        if not mark:
            mark |= {"id": a.id, "unique_id": group, "completed_by": a.rater, "was_cancelled": a.choice == "skip"}
            mark |= {"created_at": _time(a.given_at), "lead_time": a.given_at - a.shown_at, "result": []}
            marks.append(mark)
        mark["result"] += _results(a)
    return json.dumps(list(tasks.values()), ensure_ascii=False, indent=1, allow_nan=False).encode(errors=_HALF)


def _results(answer: Answer) -> list[Row]:
    name = answer.attribute or "rating"
    if answer.choice == "skip":
        return []
    if answer.choice is not None:
        choices: Row = {"choices": [answer.choice]}
        return [{"from_name": "choice", "to_name": "item", "type": "choices", "value": choices}]
    number: Row = {"number": answer.value}
    return [{"from_name": name, "to_name": "item", "type": "number", "value": number}]


def _record(answers: Answers, _: Contents) -> bytes:
    return _lines([{name: getattr(a, name) for name in FIELDS} for a in answers])


_WRITERS: dict[str, Callable[[Answers, Contents], bytes]] = {
    "csv": _csv,
    "jsonl": _jsonl,
    "parquet": _parquet,
    "trl": _trl,
    "label-studio": _label_studio,
    "record": _record,
}
FORMS = tuple(_WRITERS)
"""What ``write`` can write."""
