"""The store in one SQLite file (write-ahead log, every commit on the disk before it is acknowledged)."""

from __future__ import annotations

import os
import secrets
import sqlite3
import threading
import time
from collections.abc import Callable, Collection, Generator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, final

from uard import _checks
from uard.collect import recorded, schema
from uard.collect.items import Item, item_of
from uard.collect.store import (
    LEASE_SECONDS,
    AnswerStore,
    ConflictError,
    Lease,
    LinkUsedError,
    RaterState,
    Request,
    StoreError,
    hashed,
)
from uard.ratings.table import FIELDS, LONGEST, Answer, Answers

_COPY = ": it, or its folder, is write-protected. Copy the project's whole folder to where it can be written"


@final
class SQLiteStore(AnswerStore):
    """An ``AnswerStore`` in a file.

    Examples:
        >>> import tempfile
        >>> from uard.collect.items import text_item
        >>> with tempfile.TemporaryDirectory() as folder, SQLiteStore(Path(folder) / "answers.sqlite") as store:
        ...     item = text_item("2 + 2?", "4")
        ...     _ = store.add_items([item]), store.invite("ann"), store.ask([Request(item.id)])
        ...     (lease,) = store.lease("ann")
        ...     _ = store.put([Answer("a1", item.id, "ann", value=1.0)], lease.id)
        ...     store.answers()[0].rows[0].value, store.lease("ann")
        (1.0, ())

    Attributes:
        path: The file.
        read_only: Whether nothing can be written to it, as in an archive; all is read all the same.
    """

    def __init__(self, path: str | Path, *, clock: Callable[[], float] = time.time):
        """Open a store, and make it if there is none.

        Args:
            path: A file; its folder must be there.
            clock: Seconds since 1970.

        Raises:
            StoreError: it cannot be opened, is no such store, or is of another version.
        """
        self.path = Path(path)
        self.read_only = schema.is_read_only(self.path)
        self._clock = clock
        self._local = threading.local()
        self._opened: list[sqlite3.Connection] = []
        self._lock = threading.Lock()
        with suppress(OSError):  # new ones: for nobody else's eyes; SQLite says what is wrong if it cannot be made
            os.close(os.open(self.path, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o600))
        with self._reading() if self.read_only else self._changing() as db:
            self._identity = schema.prepare(db, self.path)

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and other processes open the file themselves."""
        return partial(SQLiteStore, clock=self._clock), (self.path,)

    def __enter__(self) -> SQLiteStore:
        """Return the store."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close it."""
        self.close()

    @property
    def identity(self) -> str:
        """See ``AnswerStore``."""
        return self._identity

    def close(self) -> None:
        """Close all connections; a later call opens a new one."""
        with self._lock:
            opened, self._opened = self._opened, []
        for connection in opened:
            connection.close()
        self._local = threading.local()

    def _connection(self) -> sqlite3.Connection:
        found: sqlite3.Connection | None = getattr(self._local, "connection", None)
        if found is None:
            found = schema.connect(self.path, self.read_only)
            with self._lock:
                self._opened.append(found)
            schema.settle(found, self.read_only)
            self._local.connection = found
        return found

    def _remedy(self, error: sqlite3.Error) -> str:
        return _COPY if self.read_only and isinstance(error, sqlite3.OperationalError) else ""

    @contextmanager
    def _reading(self) -> Generator[sqlite3.Connection]:
        try:
            yield self._connection()
        except sqlite3.Error as error:
            raise StoreError(f"{self.path}: {error}{self._remedy(error)}") from error

    @contextmanager
    def _changing(self) -> Generator[sqlite3.Connection]:
        """Change all or nothing; other writers wait."""
        if self.read_only:
            raise StoreError(f"{self.path} cannot be changed{_COPY}")
        with self._reading() as db:
            db.execute("BEGIN IMMEDIATE")
            try:
                yield db
                db.execute("COMMIT")
            except BaseException:
                if db.in_transaction:  # SQLite itself may have rolled back, on a full disk
                    db.execute("ROLLBACK")
                raise

    def add_items(self, items: Sequence[Item]) -> int:
        """See ``AnswerStore``."""
        with self._changing() as db:
            rows = [(item.id, item.as_json) for item in items]
            return sum(db.execute("INSERT OR IGNORE INTO items (id, content) VALUES (?, ?)", r).rowcount for r in rows)

    def items(self, after: int = 0) -> tuple[tuple[Item, ...], int]:
        """See ``AnswerStore``."""
        with self._reading() as db:
            rows = db.execute("SELECT seq, content FROM items WHERE seq > ? ORDER BY seq", (after,)).fetchall()
        return tuple(self._item_of(row["content"], row["seq"]) for row in rows), rows[-1]["seq"] if rows else after

    def _item_of(self, content: str, place: int) -> Item:
        try:
            return item_of(content)
        except (ValueError, TypeError, AttributeError, RecursionError) as error:
            raise StoreError(f"{self.path} is damaged: what stands there as item {place} is none ({error})") from None

    def invite(self, rater: str, *, end_sessions: bool = False) -> str:
        """See ``AnswerStore``."""
        _checks.instance("rater", rater, str, "a name")
        if not rater.strip() or rater != rater.strip() or len(rater) > LONGEST or not rater.isprintable():
            raise _checks.InvalidValueError(
                "rater", rater, f"a name of 1 to {LONGEST} printable characters, no spaces around"
            )
        secret = secrets.token_urlsafe(16)
        with self._changing() as db:
            db.execute(
                "INSERT INTO raters (name, link) VALUES (?, ?) ON CONFLICT (name) DO UPDATE SET link = excluded.link",
                (rater, hashed(secret)),
            )
            if end_sessions:
                db.execute("DELETE FROM sessions WHERE rater = ?", (rater,))
        return secret

    def enter(self, secret: str) -> tuple[str, str]:
        """See ``AnswerStore``."""
        session = secrets.token_urlsafe(16)
        with self._changing() as db:
            row = db.execute("SELECT name FROM raters WHERE link = ?", (hashed(secret),)).fetchone()
            if row is None:
                raise LinkUsedError("this link was used before, or was never given out; ask for a new one")
            db.execute("UPDATE raters SET link = NULL WHERE name = ?", (row["name"],))
            db.execute("INSERT INTO sessions (hash, rater) VALUES (?, ?)", (hashed(session), row["name"]))
        return str(row["name"]), session

    def raters(self) -> tuple[RaterState, ...]:
        """See ``AnswerStore``."""
        with self._reading() as db:
            rows = db.execute("SELECT name, paused, link FROM raters ORDER BY seq").fetchall()
            held: dict[str, set[str]] = {row["name"]: set() for row in rows}
            for row in db.execute("SELECT hash, rater FROM sessions"):
                held.setdefault(row["rater"], set()).add(row["hash"])
        return tuple(
            RaterState(
                row["name"],
                paused=bool(row["paused"]),
                entered=bool(held[row["name"]]),
                invited=row["link"] is not None,
                sessions=frozenset(held[row["name"]]),
            )
            for row in rows
        )

    def pause(self, rater: str, paused: bool) -> None:
        """See ``AnswerStore``."""
        with self._changing() as db:
            if not db.execute("UPDATE raters SET paused = ? WHERE name = ?", (int(paused), rater)).rowcount:
                known = [row["name"] for row in db.execute("SELECT name FROM raters")]
                raise _checks.UnknownNameError("rater", rater, known)

    def ask(self, requests: Sequence[Request], after: int | None = None) -> int:
        """See ``AnswerStore``."""
        with self._changing() as db:
            if after is not None and recorded.last_request(db) != after:
                return 0
            for r in requests:
                recorded.expect(db, "items", "id", r.item, "item")
                if r.rater is not None:
                    recorded.expect(db, "raters", "name", r.rater, "rater")
                until = None if r.rater is None else self._clock() + LEASE_SECONDS  # so long it is hers alone
                db.execute(
                    "INSERT INTO requests (item, rater, kind, priority, held_until) VALUES (?, ?, ?, ?, ?)",
                    (r.item, r.rater, r.kind, float(r.priority), until),
                )
        return len(requests)

    def open_requests(self) -> tuple[tuple[Request, ...], int]:
        """See ``AnswerStore``."""
        with self._reading() as db:
            place = recorded.last_request(db)  # first: what comes between the two is then not thought to be read
            rows = db.execute(
                "SELECT item, rater, kind, priority FROM requests WHERE answer IS NULL AND seq <= ? ORDER BY seq",
                (place,),
            ).fetchall()
        return tuple(Request(row["item"], row["rater"], row["kind"], row["priority"]) for row in rows), place

    def lease(self, rater: str, count: int = 1, without: Collection[str] = ()) -> tuple[Lease, ...]:
        """See ``AnswerStore``."""
        with self._changing() as db:
            now = self._clock()
            held = db.execute(
                "SELECT seq, item, kind FROM requests WHERE held_by = ? AND answer IS NULL", (rater,)
            ).fetchall()
            known = {row["seq"] for row in held}
            found = [row for row in held if row["item"] not in without]
            found.sort(key=lambda row: (row["kind"] != "practice", row["seq"]))
            while len(found) < count:
                row = self._next(db, rater, now, without)
                if row is None:
                    break
                self._hold(db, row, rater, now)
                found.append(row)
            found = found[:count]
            until = now + LEASE_SECONDS
            for row in found:
                if row["seq"] in known:
                    db.execute("UPDATE requests SET held_until = ? WHERE seq = ?", (until, row["seq"]))
            return tuple(self._lease_of(db, row["seq"], rater) for row in found)

    def pass_on(self, rater: str, count: int, without: Collection[str] = ()) -> int:
        """See ``AnswerStore``."""
        with self._changing() as db:
            now = self._clock()
            rows = db.execute(schema.LEFT_BEHIND, {"rater": rater, "now": now, "term": LEASE_SECONDS}).fetchall()
            first = {row["item"]: row["seq"] for row in reversed(rows) if row["item"] not in without}
            taken = [row["seq"] for row in rows if row["seq"] == first.get(row["item"])][:count]
            for seq in taken:  # the lease that there was stays known: an answer to it is heard whenever it comes
                db.execute(
                    'UPDATE requests SET rater = ?, lease = NULL, held_by = NULL, held_until = ?, "left" = NULL '
                    "WHERE seq = ?",
                    (rater, now + LEASE_SECONDS, seq),
                )
        return len(taken)

    def leased(self, name: str) -> Lease | None:
        """See ``AnswerStore``."""
        with self._reading() as db:
            row = db.execute(
                'SELECT l.rater, l."left", r.kind, r.item, r.lease, r.held_until, items.seq, items.content '
                "FROM leases AS l JOIN requests AS r ON r.seq = l.request JOIN items ON items.id = r.item "
                "WHERE l.id = ?",
                (name,),
            ).fetchone()
        if row is None:
            return None
        until = row["held_until"] if row["lease"] == name else 0.0
        return Lease(name, self._item_of(row["content"], row["seq"]), row["rater"], row["kind"], until, row["left"])

    def _lease_of(self, db: sqlite3.Connection, seq: int, rater: str) -> Lease:
        row = db.execute(
            'SELECT lease, kind, held_until, r."left" AS side, content, items.seq AS place '
            "FROM requests AS r JOIN items ON items.id = r.item WHERE r.seq = ?",
            (seq,),
        ).fetchone()
        item = self._item_of(row["content"], row["place"])
        return Lease(row["lease"], item, rater, row["kind"], row["held_until"], row["side"])

    @staticmethod
    def _next(db: sqlite3.Connection, rater: str, now: float, without: Collection[str]) -> sqlite3.Row | None:
        """Return the open request that comes first: those to this rater before those to anybody."""
        for who in (rater, None):
            given = {"who": who, "rater": rater, "now": now, "term": LEASE_SECONDS}
            rows = db.execute(schema.NEXT, given)
            for row in rows:
                if row["item"] not in without:
                    return row
        return None

    def _hold(self, db: sqlite3.Connection, row: sqlite3.Row, rater: str, now: float) -> None:
        stored = db.execute("SELECT seq, content FROM items WHERE id = ?", (row["item"],)).fetchone()
        content, name = self._item_of(stored["content"], stored["seq"]).content, secrets.token_hex(16)
        left = secrets.choice([content["left"], content["right"]]) if content["kind"] == "pair" else None
        db.execute(
            'UPDATE requests SET lease = ?, held_by = ?, held_until = ?, "left" = ? WHERE seq = ?',
            (name, rater, now + LEASE_SECONDS, left, row["seq"]),
        )
        db.execute(
            'INSERT INTO leases (id, request, rater, "left") VALUES (?, ?, ?, ?)', (name, row["seq"], rater, left)
        )

    def put(self, answers: Sequence[Answer], lease: str | None = None) -> tuple[Answer, ...]:
        """See ``AnswerStore``."""
        if not answers:
            raise _checks.InvalidValueError("answers", answers, "at least one")
        with self._changing() as db:
            known = [recorded.stored(db, a.id) for a in answers]
            if known[0] is not None:
                for a, there in zip(answers, known, strict=True):
                    if there is None or recorded.differs(there, a):
                        raise ConflictError(f"another answer is stored as {a.id!r}")
                return tuple(a for a in known if a is not None)
            rows = list(answers) if lease is None else recorded.about_lease(db, answers, lease)
            for a in rows:
                self._add(db, a)
            if lease is not None:
                said = rows[0].id
                db.execute("UPDATE leases SET answer = ? WHERE id = ?", (said, lease))
                db.execute(
                    "UPDATE requests SET answer = ? WHERE lease = ? AND (answer IS NULL OR answer = ?)",
                    (said, lease, rows[0].supersedes),
                )
        return tuple(rows)

    @staticmethod
    def _add(db: sqlite3.Connection, answer: Answer) -> None:
        if recorded.stored(db, answer.id) is not None:
            raise ConflictError(f"another answer is stored as {answer.id!r}")
        recorded.expect(db, "items", "id", answer.item, "item")
        recorded.expect(db, "raters", "name", answer.rater, "rater")
        if answer.supersedes is not None:
            before = recorded.stored(db, answer.supersedes)
            if before is None or (before.rater, before.item) != (answer.rater, answer.item):
                raise ConflictError(f"{answer.rater} has given no answer {answer.supersedes!r} about this item")
            if db.execute("SELECT 1 FROM answers WHERE supersedes = ?", (before.id,)).fetchone():
                raise ConflictError(f"the answer {answer.supersedes!r} was taken back before")
        marks = ", ".join("?" * len(FIELDS))
        names = ", ".join(f'"{name}"' for name in FIELDS)
        db.execute(f"INSERT INTO answers ({names}) VALUES ({marks})", tuple(getattr(answer, name) for name in FIELDS))
        if answer.said is None and answer.source != "owner":
            again = db.execute(
                "UPDATE requests SET answer = NULL, held_by = ? WHERE answer = ?", (answer.rater, answer.supersedes)
            )
            leased = db.execute("UPDATE leases SET answer = NULL WHERE answer = ?", (answer.supersedes,))
            if leased.rowcount and not again.rowcount:  # her question was passed on while her page still showed it
                db.execute(
                    "INSERT INTO requests (item, rater, kind, priority, held_until) VALUES (?, ?, 'rating', 0.0, ?)",
                    (answer.item, answer.rater, answer.given_at + LEASE_SECONDS),
                )

    def answers(self, after: int = 0) -> tuple[Answers, int]:
        """See ``AnswerStore``."""
        with self._reading() as db:
            rows = db.execute("SELECT * FROM answers WHERE seq > ? ORDER BY seq", (after,)).fetchall()
        return Answers(tuple(recorded.answer_of(row) for row in rows)), rows[-1]["seq"] if rows else after
