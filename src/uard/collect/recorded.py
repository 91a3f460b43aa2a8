"""Answers as they stand in the tables of a SQLite store: read, compared, and set in each other's place."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from uard.collect.store import ConflictError, part_name, taken_back
from uard.ratings.table import FIELDS, LATEST, Answer


def last_request(db: sqlite3.Connection) -> int:
    """Return the number of the last request of all."""
    return int(db.execute("SELECT coalesce(max(seq), 0) FROM requests").fetchone()[0])


def about_lease(db: sqlite3.Connection, answers: Sequence[Answer], lease: str) -> list[Answer]:
    """Return answers as they are stored for a lease: of its kind, and in place of what was said of it before.

    Two tabs, or a page whose answer came late, may both answer one lease. What comes last stands, whichever it is, and
    it is no hidden repeat.

    Raises:
        ConflictError: the lease was not given to their rater for their item.
    """
    row = db.execute(
        "SELECT l.rater, l.answer, r.item, r.kind FROM leases AS l JOIN requests AS r ON r.seq = l.request "
        "WHERE l.id = ?",
        (lease,),
    ).fetchone()
    first = answers[0]
    if row is None or (row["rater"], row["item"]) != (first.rater, first.item):
        raise ConflictError(f"{first.rater} was not shown this item under this lease")
    parts = db.execute(
        "SELECT * FROM answers AS a WHERE item = :item AND rater = :rater "
        "AND (id = :said OR substr(id, 1, length(:said) + 1) = :said || '.') "
        "AND (value IS NOT NULL OR choice IS NOT NULL) "
        "AND NOT EXISTS (SELECT 1 FROM answers AS b WHERE b.supersedes = a.id) ORDER BY seq",
        {"item": first.item, "rater": first.rater, "said": row["answer"]},
    ).fetchall()
    before = {part["attribute"]: answer_of(part) for part in parts}
    rows = [replace(a, kind=row["kind"]) for a in answers]
    rows = [replace(a, supersedes=a.supersedes or _name(before.pop(a.attribute, None))) for a in rows]
    silent = taken_back(list(before.values()), first.id, source=first.source, now=first.given_at)
    return rows + [replace(a, id=part_name(first.id, len(rows) + k)) for k, a in enumerate(silent)]


def _name(answer: Answer | None) -> str | None:
    return None if answer is None else answer.id


def stored(db: sqlite3.Connection, name: str) -> Answer | None:
    """Return the answer of a name; None if there is none."""
    row = db.execute("SELECT * FROM answers WHERE id = ?", (name,)).fetchone()
    return None if row is None else answer_of(row)


def answer_of(row: sqlite3.Row) -> Answer:
    """Return the answer that a row holds; no day that a clock once told comes after the last that has a name."""
    held: dict[str, Any] = {name: row[name] for name in FIELDS}
    return Answer(**held | {name: min(held[name], LATEST) for name in ("shown_at", "given_at")})


def differs(there: Answer, sent: Answer) -> bool:
    """Whether two answers of one name are not the same: of another content, or in place of another.

    Times differ when it is sent again; what the store itself has decided (the kind, what it takes the place of) is not
    known to who sends it.
    """
    left_to_us = {"shown_at", "given_at", "kind"} | ({"supersedes"} if sent.supersedes is None else set[str]())
    return any(getattr(there, name) != getattr(sent, name) for name in FIELDS if name not in left_to_us)


def expect(db: sqlite3.Connection, table: str, column: str, value: str, what: str) -> None:
    """Check that something is there.

    Raises:
        ConflictError: it is not.
    """
    if db.execute(f"SELECT 1 FROM {table} WHERE {column} = ?", (value,)).fetchone() is None:
        raise ConflictError(f"there is no {what} {value!r} in this store")
