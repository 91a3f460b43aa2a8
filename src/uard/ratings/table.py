"""The long table: one row per answer. Who said what, of which item, on which scale, when, and where.

It is the primary record of ratings by people. Everything else (a ``RatingLog``, pairs, the files of other tools) is
made from it and never changed by hand. Answers are only ever added: one that is corrected or taken back stays, and the
answer that takes its place names it (``supersedes``).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from uard import _checks
from uard.ratings.log import RatingLog, Repeats

if TYPE_CHECKING:
    from collections.abc import Callable

CHOICES = ("left", "right", "tie", "cannot tell", "up", "down", "skip")
KINDS = ("rating", "repeat", "gold", "practice")
PAIRED = ("left", "right", "tie")
THUMBS = ("up", "down")
LONGEST = 200  # characters of a name
LONGEST_COMMENT = 2000
LATEST = 253_402_300_799.0  # the end of the year 9999, after which no calendar has a name for the day


@dataclass(frozen=True)
class Answer:
    """What one rater said of one item.

    Examples:
        >>> Answer("a1", item="clip-7", rater="ann", value=0.5, scale="slider -1..1").said
        0.5
        >>> Answer("a2", item="clip-7", rater="ann", supersedes="a1").said is None
        True

    Attributes:
        id: Unique; made by whoever gives the answer, so that sending it twice stores it once.
        item: What was rated.
        rater: Who rated it.
        value: In the scale's unit, finite; what thumbs up or down are worth; None for other choices, and for an answer
            that only takes one back.
        choice: One of ``CHOICES``, or None.
        attribute: What about the item was rated; empty for the question itself.
        scale: What could be answered, such as ``slider -1..1``, ``stars 5``, ``thumbs`` or ``pair``.
        left: Of a pair, the item that stood on the left; None otherwise.
        right: The other.
        shown_at: When the item was shown, in seconds since 1970 (UTC).
        given_at: When the answer was given.
        source: Where it was given: ``page``, ``simulated`` or the name of a file.
        kind: One of ``KINDS``: whether it was asked in earnest, again, or to see how the rater does.
        supersedes: The answer whose place it takes; None if it takes none's.
        comment: What the rater wrote.
    """

    id: str
    item: str
    rater: str
    value: float | None = None
    choice: str | None = None
    attribute: str = ""
    scale: str = ""
    left: str | None = None
    right: str | None = None
    shown_at: float = 0.0
    given_at: float = 0.0
    source: str = ""
    kind: str = "rating"
    supersedes: str | None = None
    comment: str = ""

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        for name in ("id", "item", "rater"):
            value = _checks.instance(name, getattr(self, name), str, "text")
            if not value.strip() or len(value) > LONGEST or not value.isprintable():
                raise _checks.InvalidValueError(name, value, f"1 to {LONGEST} printable characters")
        if self.value is not None:
            _checks.number("value", self.value, low=-_checks.LARGEST, high=_checks.LARGEST)
        if self.choice is not None:
            _checks.choose("choice", self.choice, CHOICES)
            if self.value is not None and self.choice not in THUMBS:
                raise _checks.InvalidValueError("value", self.value, f"None where the choice is {self.choice!r}")
        if self.value is None and self.choice is None and self.supersedes is None:
            raise _checks.InvalidValueError("value", None, "a number, unless there is a choice or something taken back")
        if self.choice in PAIRED and (self.left is None or self.right is None or self.left == self.right):
            raise _checks.InvalidValueError("left, right", (self.left, self.right), "two items")
        for name in ("shown_at", "given_at"):
            _checks.number(name, getattr(self, name), low=0, high=LATEST)
        _checks.choose("kind", self.kind, KINDS)
        if len(self.comment) > LONGEST_COMMENT:
            raise _checks.InvalidValueError("comment", self.comment, f"at most {LONGEST_COMMENT} characters")

    @property
    def said(self) -> float | str | None:
        """The value or the choice; None if the answer takes another back and says nothing itself."""
        return self.value if self.choice is None else self.choice


FIELDS = tuple(f.name for f in fields(Answer))
"""Columns of the long table."""


class Comparison(NamedTuple):
    """Which of two items a rater prefers.

    Attributes:
        preferred: The item, or the left one of a tie.
        other: The other item.
        tie: Whether both are equally good.
        rater: Who said so.
    """

    preferred: str
    other: str
    tie: bool
    rater: str


@dataclass(frozen=True)
class Answers:
    """Answers in the order in which they were given.

    Examples:
        >>> said = Answers((Answer("a1", "x", "ann", 1.0), Answer("a2", "x", "ann", 0.0, supersedes="a1")))
        >>> len(said), [a.id for a in said.standing()]
        (2, ['a2'])

    Attributes:
        rows: All of them, those that are superseded included.
    """

    rows: tuple[Answer, ...] = ()

    def __len__(self) -> int:
        """Return how many there are, those that are superseded included."""
        return len(self.rows)

    def __iter__(self) -> Iterator[Answer]:
        """Go through all of them."""
        return iter(self.rows)

    @property
    def raters(self) -> tuple[str, ...]:
        """Who answered, in the order of first answers."""
        return tuple(dict.fromkeys(a.rater for a in self.rows))

    def standing(self) -> tuple[Answer, ...]:
        """Return the answers that stand: neither superseded nor empty."""
        gone = {a.supersedes for a in self.rows if a.supersedes is not None}
        return tuple(a for a in self.rows if a.id not in gone and a.said is not None)

    def to_log(
        self, reward_of: Callable[[str], float | None], attribute: str = "", source: str = "answers"
    ) -> RatingLog:
        """Return the ratings of items as a log: a row per item, a column per rater.

        A rater's latest answer about an item is the rating; earlier ones are ``repeats``. Practice does not count, and
        neither do choices without a value.

        Examples:
            >>> rows = Answer("a1", "x", "ann", 1.0), Answer("a2", "x", "bob", 0.5), Answer("a3", "y", "bob", 0.0)
            >>> said = Answers(rows)
            >>> log = said.to_log({"x": 1.0, "y": 0.5}.get)
            >>> log.raters, log.ratings.tolist()
            (('ann', 'bob'), [[1.0, 0.5], [nan, 0.0]])

        Args:
            reward_of: Observed reward of an item; None or NaN where there is none.
            attribute: Which of the questions.
            source: What the log is called.

        Raises:
            InvalidValueError: there is no rating at all.
        """
        kept = [a for a in self.standing() if a.value is not None and a.attribute == attribute and a.kind != "practice"]
        if not kept:
            raise _checks.InvalidValueError(source, f"{len(self.rows)} answers", "a table with at least one rating")
        items = list(dict.fromkeys(a.item for a in kept))
        raters = tuple(dict.fromkeys(a.rater for a in kept))
        row_of, column_of = ({name: i for i, name in enumerate(names)} for names in (items, raters))
        ratings = np.full((len(items), len(raters)), np.nan)
        earlier: list[tuple[int, int, float]] = []
        for a in kept:
            place = row_of[a.item], column_of[a.rater]
            if not np.isnan(ratings[place]):
                earlier.append((*place, float(ratings[place])))
            ratings[place] = a.value
        rewards = np.array([np.nan if (r := reward_of(item)) is None else r for item in items], float)
        return RatingLog(
            None if np.isnan(rewards).all() else rewards,
            ratings,
            raters,
            item=np.array(items, dtype=object),
            source=source,
            repeats=_repeats(earlier) if earlier else None,
        )

    def comparisons(self) -> list[Comparison]:
        """Return which of two items each rater prefers; the latest answer of a rater about a pair."""
        last: dict[tuple[str, str], Answer] = {}
        for a in self.standing():
            if a.choice in PAIRED and a.kind != "practice":
                last[a.item, a.rater] = a
        found: list[Comparison] = []
        for a in last.values():
            left, right = str(a.left), str(a.right)
            preferred, other = (right, left) if a.choice == "right" else (left, right)
            found.append(Comparison(preferred, other, a.choice == "tie", a.rater))
        return found


def _repeats(earlier: Sequence[tuple[int, int, float]]) -> Repeats:
    rows, columns, values = zip(*earlier, strict=True)
    return Repeats(np.array(rows, int), np.array(columns, int), np.array(values, float))


def answer_of(row: Mapping[str, Any]) -> Answer:
    """Return the answer that a row of a table holds; columns that are not in it have their defaults.

    Examples:
        >>> answer_of({"id": "a1", "item": "x", "rater": "ann", "value": 1, "weather": "fine"}).value
        1.0

    Args:
        row: Values by the names in ``FIELDS``; others are left alone.

    Raises:
        InvalidValueError: a field is not what it must be.
    """
    known: dict[str, Any] = {name: row[name] for name in FIELDS if name in row}
    for name in ("id", "item", "rater"):
        if name not in known:
            raise _checks.InvalidValueError(name, None, "there")
    if known.get("value") is not None:
        _checks.number("value", known["value"], low=-_checks.LARGEST, high=_checks.LARGEST)
        known["value"] = float(known["value"])
    return Answer(**known)
