"""The tables of the store in one SQLite file, and the look at a file before it is used."""

from __future__ import annotations

import os
import secrets
import sqlite3
from pathlib import Path

from uard.collect.store import StoreError
from uard.ratings.table import FIELDS

VERSION = 1
PATIENCE = 10.0  # seconds to wait for another process that writes
APPLICATION = 0x75617264  # "uard", so that `file` and we know whose database it is

SCHEMA = f"""
CREATE TABLE project (identity TEXT NOT NULL);
CREATE TABLE items (seq INTEGER PRIMARY KEY, id TEXT NOT NULL UNIQUE, content TEXT NOT NULL);
CREATE TABLE raters (seq INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, paused INTEGER NOT NULL DEFAULT 0, link TEXT);
CREATE TABLE sessions (hash TEXT PRIMARY KEY, rater TEXT NOT NULL REFERENCES raters(name));
CREATE TABLE answers (seq INTEGER PRIMARY KEY, {", ".join(f'"{name}"' for name in FIELDS)}, UNIQUE (id));
CREATE UNIQUE INDEX superseded ON answers (supersedes) WHERE supersedes IS NOT NULL;
CREATE INDEX answered_by ON answers (item, rater);
CREATE TABLE requests (
    seq INTEGER PRIMARY KEY, item TEXT NOT NULL REFERENCES items(id), rater TEXT REFERENCES raters(name),
    kind TEXT NOT NULL, priority REAL NOT NULL, "left" TEXT,
    lease TEXT UNIQUE, held_by TEXT, held_until REAL, answer TEXT
);
CREATE INDEX open_requests ON requests (rater, priority DESC, seq) WHERE answer IS NULL;
CREATE INDEX held_requests ON requests (held_by) WHERE answer IS NULL;
CREATE INDEX answered_requests ON requests (answer) WHERE answer IS NOT NULL;
CREATE TABLE leases (
    id TEXT PRIMARY KEY, request INTEGER NOT NULL REFERENCES requests(seq), rater TEXT NOT NULL REFERENCES raters(name),
    "left" TEXT, answer TEXT
);
CREATE INDEX answered_leases ON leases (answer) WHERE answer IS NOT NULL;
"""
"""``requests`` holds the lease that counts now; ``leases`` all that were ever given, so that a late answer is known."""

NEXT = """
SELECT seq, item, kind FROM requests AS r
WHERE answer IS NULL AND rater IS :who AND held_by IS NOT :rater
  AND (held_by IS NULL OR held_until < :now OR held_until > :now + :term)
  AND (kind = 'repeat' OR NOT EXISTS (
        SELECT 1 FROM answers AS a WHERE a.item = r.item AND a.rater = :rater
        AND (a.value IS NOT NULL OR a.choice IS NOT NULL)
        AND NOT EXISTS (SELECT 1 FROM answers AS b WHERE b.supersedes = a.id)))
  AND NOT EXISTS (SELECT 1 FROM requests AS h WHERE h.item = r.item AND h.held_by = :rater AND h.answer IS NULL
        AND h.seq <> r.seq)
ORDER BY priority DESC, seq
"""
"""What a rater may be shown next, of the requests to one name or to nobody in particular (rater IS ?).

Open, held by nobody else, not rated by her yet unless that is the point, and not in her hands already by another
request. A lease that ends further ahead than any lease can was given by a clock that has jumped back since.
"""

LEFT_BEHIND = """
SELECT seq, item FROM requests AS r
WHERE answer IS NULL AND kind = 'rating' AND rater <> :rater
  AND (coalesce(held_until, 0) < :now OR held_until > :now + :term
       OR EXISTS (SELECT 1 FROM raters WHERE name = r.rater AND paused))
  AND NOT EXISTS (
        SELECT 1 FROM answers AS a WHERE a.item = r.item AND a.rater IN (:rater, r.rater)
        AND (a.value IS NOT NULL OR a.choice IS NOT NULL)
        AND NOT EXISTS (SELECT 1 FROM answers AS b WHERE b.supersedes = a.id))
  AND NOT EXISTS (SELECT 1 FROM requests AS h WHERE h.item = r.item AND h.answer IS NULL
        AND (h.rater = :rater OR h.held_by = :rater))
ORDER BY priority DESC, seq
"""
"""Requests to others that a rater may take over: nobody comes to them, and she knows nothing of their items yet.

What the other one has answered by another way is not asked of anybody: its place is taken.
"""


def is_read_only(path: Path) -> bool:
    """Whether a file is there and cannot be changed; SQLite needs to write beside it, too."""
    return path.is_file() and not (os.access(path, os.W_OK) and os.access(path.parent, os.W_OK))


def connect(path: Path, read_only: bool) -> sqlite3.Connection:
    """Open a file. What is read-only and was closed in order is taken as it is, for SQLite would write beside it."""
    where = str(path)
    if read_only:
        log = path.with_name(f"{path.name}-wal")  # what a server that was killed has not moved to its place yet
        pending = log.is_file() and log.stat().st_size > 0
        where = f"{path.resolve().as_uri()}?{'mode=ro' if pending else 'mode=ro&immutable=1'}"
    found = sqlite3.connect(where, timeout=PATIENCE, isolation_level=None, check_same_thread=False, uri=read_only)
    found.row_factory = sqlite3.Row
    return found


def settle(db: sqlite3.Connection, read_only: bool) -> None:
    """Set how a connection writes, which looks at the file for the first time."""
    if not read_only:
        db.execute("PRAGMA journal_mode = WAL")
        db.execute("PRAGMA synchronous = FULL")  # what is acknowledged survives the loss of power, too
        db.execute("PRAGMA foreign_keys = ON")


def prepare(db: sqlite3.Connection, path: Path) -> str:
    """Make the tables if there are none, and return the identity of the store.

    Args:
        db: A connection within a transaction.
        path: Its file, for errors.

    Raises:
        StoreError: the file is something else, or of another version.
    """
    version, application = (
        int(db.execute(f"PRAGMA {name}").fetchone()[0]) for name in ("user_version", "application_id")
    )
    if db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] == 0:
        for statement in SCHEMA.split(";"):
            db.execute(statement)
        db.execute("INSERT INTO project (identity) VALUES (?)", (secrets.token_hex(8),))
        db.execute(f"PRAGMA user_version = {VERSION}")
        db.execute(f"PRAGMA application_id = {APPLICATION}")
    elif application != APPLICATION:
        raise StoreError(f"{path} is a database of something else than answers to uard")
    elif version != VERSION:
        age = "an older" if version < VERSION else "a newer"
        raise StoreError(
            f"{path} is of version {version}, made by {age} uard; this one reads {VERSION}; it was not changed"
        )
    found = db.execute("SELECT identity FROM project").fetchone()
    if found is None:
        raise StoreError(f"{path} is damaged: it does not say which project it is of")
    return str(found["identity"])
