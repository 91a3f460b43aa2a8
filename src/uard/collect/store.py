"""Where items, raters, requests and answers are kept: a few methods, so that another database can follow.

Answers are only ever added. What ``put`` has returned is kept, whatever happens to the process afterwards; what is put
twice under one name is there once. ``uard.collect.sqlite.SQLiteStore`` is the one that comes with the package.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

from uard import _checks
from uard.collect.items import Item
from uard.ratings.table import KINDS, Answer, Answers

LEASE_SECONDS = 900.0
"""How long an item is kept for a rater who was shown it. An answer that comes later counts all the same."""


class StoreError(RuntimeError):
    """The database cannot be read or written now: a full disk, a file without permission, one of another version."""


class ConflictError(ValueError):
    """Something else is there under this name already, or what a change refers to is not there."""


class LinkUsedError(ValueError):
    """A rater's link that was used before, or never given out."""


@dataclass(frozen=True)
class Request:
    """That somebody should rate an item.

    Examples:
        >>> Request("0" * 32, rater="ann", priority=2.0).kind
        'rating'

    Attributes:
        item: Its name.
        rater: Who; anybody who has not rated it yet if left out. A repeat names who rated it before. A rating that she
            does not come to for a while may be passed on to somebody else (``AnswerStore.pass_on``).
        kind: One of ``uard.ratings.table.KINDS``.
        priority: Higher ones are shown first, practice before all others.
    """

    item: str
    rater: str | None = None
    kind: str = "rating"
    priority: float = 0.0

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.choose("kind", self.kind, KINDS)
        _checks.number("priority", self.priority)
        if self.kind in ("repeat", "practice") and self.rater is None:
            raise _checks.InvalidValueError("rater", None, f"a rater's name where the kind is {self.kind!r}")


@dataclass(frozen=True)
class Lease:
    """An item that is kept for one rater for a while.

    Attributes:
        id: Its name; the answer says which lease it answers.
        item: What to rate.
        rater: Who it is kept for.
        kind: Of the request.
        until: When somebody else may be shown it, in seconds since 1970.
        left: Of a pair, the item that stands on the left; drawn once for each lease.
    """

    id: str
    item: Item
    rater: str
    kind: str
    until: float
    left: str | None = None


@dataclass(frozen=True)
class RaterState:
    """A rater as the store knows her.

    Attributes:
        name: As she was invited.
        paused: Whether she is shown nothing now.
        entered: Whether she has used a link.
        invited: Whether she has a link that was not used yet.
        sessions: Hashes of the secrets by which her browsers are known.
    """

    name: str
    paused: bool
    entered: bool
    invited: bool
    sessions: frozenset[str]


def hashed(secret: str) -> str:
    """Return what is stored in place of a secret of 128 random bits.

    Examples:
        >>> len(hashed("some secret"))
        64
    """
    return hashlib.sha256(secret.encode()).hexdigest()


def part_name(name: str, number: int) -> str:
    """Return the name of an answer's part: the question itself is 0, its attributes are counted from 1.

    Examples:
        >>> part_name("a1", 0), part_name("a1", 2)
        ('a1', 'a1.2')
    """
    return f"{name}.{number}" if number else name


def taken_back(before: Sequence[Answer], name: str, *, source: str, now: float) -> list[Answer]:
    """Return the answers that take back all that was said in one go.

    Examples:
        >>> [a.supersedes for a in taken_back([Answer("a1", "x", "ann", 1.0)], "b1", source="owner", now=0.0)]
        ['a1']

    Args:
        before: What was said.
        name: Of the first new answer.
        source: Where it is taken back.
        now: Seconds since 1970.
    """
    times = {"shown_at": now, "given_at": now}
    empty = {"value": None, "choice": None, "comment": "", "source": source} | times
    return [replace(a, id=part_name(name, k), supersedes=a.id, **empty) for k, a in enumerate(before)]


class AnswerStore(ABC):
    """The interface. All methods may be called from any thread, and by several processes on one store.

    All raise ``StoreError`` if the database cannot do it now; then nothing of the call has happened.

    Examples:
        >>> import tempfile
        >>> from uard.collect.project import Project
        >>> with tempfile.TemporaryDirectory() as folder, Project.create(folder).store() as store:
        ...     isinstance(store, AnswerStore), store.raters()
        (True, ())
    """

    @property
    @abstractmethod
    def identity(self) -> str:
        """A random name that the store was given when it was made; a copy of it keeps the name."""

    @abstractmethod
    def add_items(self, items: Sequence[Item]) -> int:
        """Add items, and return how many of them were new."""

    @abstractmethod
    def items(self, after: int = 0) -> tuple[tuple[Item, ...], int]:
        """Return the items that were added after a place, in that order, and the place of the last."""

    @abstractmethod
    def invite(self, rater: str, *, end_sessions: bool = False) -> str:
        """Return a new link secret for a rater, who may be new; links given to her before are void.

        Args:
            rater: Her name.
            end_sessions: Whether browsers that are known as hers are forgotten.

        Raises:
            InvalidValueError: the name is empty, too long, or has characters that cannot be printed.
        """

    @abstractmethod
    def enter(self, secret: str) -> tuple[str, str]:
        """Use a link up, and return the rater's name and the secret of her new session.

        Raises:
            LinkUsedError: it was used before, or is not known.
        """

    @abstractmethod
    def raters(self) -> tuple[RaterState, ...]:
        """Return all raters in the order in which they were invited."""

    @abstractmethod
    def pause(self, rater: str, paused: bool) -> None:
        """Show a rater nothing more, or go on; answers that she still gives are kept.

        Raises:
            UnknownNameError: there is no such rater.
        """

    @abstractmethod
    def ask(self, requests: Sequence[Request], after: int | None = None) -> int:
        """Add requests, and return how many; the latest come last among those of equal priority.

        Args:
            requests: What should be rated, and by whom.
            after: The place up to which ``open_requests`` was read. If somebody has asked since, nothing is added and
                0 is returned: what should be asked may have changed. Not looked at if left out.

        Raises:
            ConflictError: one names an item or a rater that is not there.
        """

    @abstractmethod
    def open_requests(self) -> tuple[tuple[Request, ...], int]:
        """Return the requests that are not answered, in the order in which they were made, and a place.

        The place is that of the last request of all, whether it is open or not.
        """

    @abstractmethod
    def lease(self, rater: str, count: int = 1, without: Collection[str] = ()) -> tuple[Lease, ...]:
        """Return what a rater should be shown next, and keep it for her; first what she holds already.

        Args:
            rater: Her name.
            count: How many at most.
            without: Names of items that are not shown, because their files are missing.
        """

    @abstractmethod
    def pass_on(self, rater: str, count: int, without: Collection[str] = ()) -> int:
        """Give a rater questions of others who do not come to them, and return how many.

        Those are open requests of kind ``rating`` to a name whose lease has ended, or that she was not shown within the
        time of a lease, or who is paused; of items that this rater has neither rated nor is asked about. Who had one
        is not asked about it any more. What she says of it all the same is kept.

        Args:
            rater: Her name.
            count: How many at most.
            without: Names of items that are left alone.
        """

    @abstractmethod
    def leased(self, name: str) -> Lease | None:
        """Return a lease that was ever given, also one that has ended or was answered; None if there was none."""

    @abstractmethod
    def put(self, answers: Sequence[Answer], lease: str | None = None) -> tuple[Answer, ...]:
        """Add the answers that were given in one go: all of them or none.

        An answer that says nothing takes back the one that it supersedes. Its request is open again for the same
        rater, unless the owner took it back (``source`` is ``owner``).

        Answers to a lease get its kind. If something that was said of the same lease stands, they take its place: of
        several at once the one that is stored last stands alone.

        Args:
            answers: At least one. If the first is there already, the whole call was heard before: nothing happens.
            lease: What they answer, if anything; it may have expired.

        Returns:
            The answers as they are stored, and those that take back what was said of the lease before.

        Raises:
            ConflictError: something else is stored under one of their names; the lease was not given to their rater for
                their item; they supersede what is not there, is
                superseded already, or is of another rater or item; or they are of an unknown item or rater.
        """

    @abstractmethod
    def answers(self, after: int = 0) -> tuple[Answers, int]:
        """Return the answers that were stored after a place, in that order, and the place of the last."""
