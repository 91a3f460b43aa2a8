"""What raters are asked: the fields of ``project.toml``, and how that is read and written."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, cast

from uard import _checks
from uard.collect.acquisition import Acquisition
from uard.ratings.export import COLUMNS, is_taken

QUESTIONS = ("slider", "stars", "thumbs", "pairs")
SETTINGS = "project.toml"
MOST_ATTRIBUTES = 8
LONGEST_ATTRIBUTE = 100  # characters


@dataclass(frozen=True)
class Known:
    """An item of which the owner knows what should be said.

    Attributes:
        item: Its name.
        value: What should be said, in the question's unit; 1 and 0 for thumbs up and down, and for left and right.
        tolerance: How far off an answer may be, >= 0.
        why: What a rater is told after practice, or beside an example.
    """

    item: str
    value: float
    tolerance: float = 0.0
    why: str = ""

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.instance("item", self.item, str, "the name of an item")
        _checks.number("value", self.value)
        _checks.number("tolerance", self.tolerance, low=0)
        _checks.instance("why", self.why, str, "text")


@dataclass(frozen=True)
class Question:
    """What raters are asked, and how; the fields are those of ``project.toml``.

    Examples:
        >>> Question(kind="stars", low=0.0, high=10.0, stars=3).levels
        (0.0, 5.0, 10.0)

    Attributes:
        question: The sentence above the item.
        kind: ``slider``, ``stars``, ``thumbs`` or ``pairs``.
        low: Lowest value, in the reward's unit; what thumbs down are worth.
        high: Highest value; what thumbs up are worth.
        stars: How many, in [2, 10]; evenly spaced from ``low`` to ``high``.
        unit: What the values are, in words.
        attributes: More things to rate on the same scale, such as ``("safe", "fast")``.
        comment: Whether raters may write a comment.
        instructions: Plain text that is shown first, and on demand.
        overlap: Raters per item.
        repeats: Share of questions that a rater has answered before, in [0, 1).
        acquisition: Who is asked what: a rule's name, or names with weights (``uard.collect.acquisition``). The default
            does better than chance on grids and clips where all raters rate an item; with three of them little of that
            is left (``uard acquisition``).
        break_after: Answers after which a break is proposed; 0 for never.
        show_reward: Whether raters see what the environment paid.
        practice: Items that are shown first, with feedback.
        gold: Items that are hidden among the others.
        examples: Items that are shown with the instructions.
    """

    question: str = "How much reward does this deserve?"
    kind: str = "slider"
    low: float = -1.0
    high: float = 1.0
    stars: int = 5
    unit: str = "reward per step"
    attributes: tuple[str, ...] = ()
    comment: bool = False
    instructions: str = "Judge what you see, not what you expect. There is no hurry, and u takes an answer back."
    overlap: int = 3
    repeats: float = 0.05
    acquisition: str | Mapping[str, float] = field(default_factory=lambda: {"random": 0.5, "highest-reward": 0.5})
    break_after: int = 50
    show_reward: bool = False
    practice: tuple[Known, ...] = ()
    gold: tuple[Known, ...] = ()
    examples: tuple[Known, ...] = field(default=())

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.choose("kind", self.kind, QUESTIONS)
        for name in ("low", "high"):
            _checks.number(name, getattr(self, name), low=-_checks.LARGEST, high=_checks.LARGEST)
        if not self.low < self.high:
            raise _checks.InvalidValueError("high", self.high, f"more than low = {self.low:g}")
        _checks.whole("stars", self.stars, low=2, high=10)
        for name in ("question", "unit", "instructions"):
            _checks.instance(name, getattr(self, name), str, "text")
        self._check_attributes()
        if self.kind in ("pairs", "thumbs") and self.attributes:
            raise _checks.InvalidValueError("attributes", self.attributes, "left out for pairs and thumbs")
        _checks.truth("comment", self.comment)
        _checks.truth("show_reward", self.show_reward)
        _checks.whole("overlap", self.overlap, low=1, high=1000)
        _checks.number("repeats", self.repeats, low=0, high=0.9)
        _checks.whole("break_after", self.break_after)
        try:
            Acquisition(self.acquisition, self.overlap, self.repeats)
        except _checks.InvalidValueError as error:
            raise renamed(error, "acquisition") from None
        for table in ("practice", "gold", "examples"):
            self._check_known(table, getattr(self, table))
        told = {known.item for known in (*self.practice, *self.examples)}  # of which raters hear what should be said
        for known in self.gold:
            if known.item in told:
                raise _checks.InvalidValueError("gold: item", known.item, "none of practice and examples")

    def _check_attributes(self) -> None:
        allowed = f"at most {MOST_ATTRIBUTES} different names of 1 to {LONGEST_ATTRIBUTE} printable characters"
        plain: list[str] = []
        for name in cast("tuple[Any, ...]", self.attributes):
            if not isinstance(name, str) or not name.strip() or not name.isprintable() or len(name) > LONGEST_ATTRIBUTE:
                raise _checks.InvalidValueError("attributes", self.attributes, allowed)
            if is_taken(name) or name.lstrip()[0] in "=+-@":
                clash = (
                    f"other names than the columns of the export ({', '.join(COLUMNS)}), none that would be read as "
                    "one of them, and not beginning with = + - @"
                )
                raise _checks.InvalidValueError("attributes", name, clash)
            plain.append(name)
        if len(plain) > MOST_ATTRIBUTES or len(set(plain)) < len(plain):
            raise _checks.InvalidValueError("attributes", self.attributes, allowed)

    def _check_known(self, table: str, entries: tuple[Known, ...]) -> None:
        """Check that what should be said can be said, and of each item once."""
        levels = {"thumbs": (0.0, 1.0), "pairs": (0.0, 0.5, 1.0)}.get(self.kind)
        low, high = self.low, self.high
        told = f"in [{low:g}, {high:g}], which can be answered"
        if levels is not None:
            told = {"thumbs": "1 or 0, for up or down", "pairs": "1, 0 or 0.5, for left, right or a tie"}[self.kind]
        items = [entry.item for entry in entries]
        for entry in entries:
            if not (low <= entry.value <= high if levels is None else entry.value in levels):
                raise _checks.InvalidValueError(f"{table}: value of item {entry.item}", entry.value, told)
            if items.count(entry.item) > 1:
                raise _checks.InvalidValueError(f"{table}: item", entry.item, "there only once")

    @property
    def levels(self) -> tuple[float, ...]:
        """What each star is worth."""
        return tuple(self.low + (self.high - self.low) * i / (self.stars - 1) for i in range(self.stars))

    @property
    def scale(self) -> str:
        """What could be answered, as it stands in the long table."""
        between = f"{self.low:g}..{self.high:g}"
        return {"stars": f"stars {self.stars} {between}", "thumbs": "thumbs", "pairs": "pair"}.get(
            self.kind, f"slider {between}"
        )

    @property
    def identity(self) -> str:
        """A name made of all that decides what can be answered; an answer that was given under another is none here."""
        stars = self.stars if self.kind == "stars" else None
        decides = (self.kind, float(self.low), float(self.high), stars, self.attributes, self.comment)
        return hashlib.sha256(repr(decides).encode()).hexdigest()[:12]

    def known(self, item: str, kind: str) -> Known | None:
        """Return what should be said of an item of practice or gold."""
        return next((k for k in (self.practice if kind == "practice" else self.gold) if k.item == item), None)


LISTS = {"practice": "practice", "gold": "gold", "example": "examples"}  # tables of the file, and fields


def question_of(data: Mapping[str, Any], source: str = SETTINGS) -> Question:
    """Return the question that a file's data describe.

    Examples:
        >>> question_of({"kind": "thumbs", "gold": [{"item": "0" * 32, "value": 1}]}).gold[0].value
        1

    Args:
        data: What stands in the file.
        source: What it is called in errors.

    Raises:
        InvalidValueError: naming the file, the field, the value and what is allowed.
    """
    given: dict[str, Any] = dict(data)
    if "examples" in given:
        raise _checks.UnknownNameError(f"{source}: table", "examples", LISTS)
    for table, name in LISTS.items():
        entries: Any = given.pop(table, [])
        allowed = f"[[{table}]] tables with {', '.join(f.name for f in fields(Known))}"
        try:
            given[name] = tuple(Known(**entry) for entry in entries)
        except TypeError:
            raise _checks.InvalidValueError(f"{source}: {table}", entries, allowed) from None
    if "attributes" in given:
        names: Any = given["attributes"]
        if not isinstance(names, list):
            raise _checks.InvalidValueError(f"{source}: attributes", names, "a list of names")
        given["attributes"] = tuple(cast("list[str]", names))
    for name in given:
        if name not in {f.name for f in fields(Question)}:
            raise _checks.UnknownNameError(
                f"{source}: field", name, {f.name for f in fields(Question)} - {"examples"} | {"example"}
            )
    try:
        return Question(**given)
    except _checks.InvalidValueError as error:
        raise renamed(error, f"{source}: {error.field}") from None


def renamed(error: _checks.InvalidValueError, field: str) -> _checks.InvalidValueError:
    """Return an error about the same value under another name.

    Examples:
        >>> str(renamed(_checks.InvalidValueError("low", 2, "a number below 1"), "project.toml: low"))
        'project.toml: low = 2: must be a number below 1'
    """
    found = _checks.InvalidValueError(field, None, "")
    found.args = (field + str(error).removeprefix(error.field),)
    return found


def as_toml(question: Question) -> str:
    """Return a question as the text of a ``project.toml`` with a comment beside each field.

    Examples:
        >>> import tomllib
        >>> question_of(tomllib.loads(as_toml(Question(kind="thumbs")))) == Question(kind="thumbs")
        True
    """
    lines = ["# What raters are asked. Changes take effect when `uard collect serve` starts."]
    for name, comment in _COMMENTS.items():
        lines.append(f"{name} = {_toml(getattr(question, name))}{f'  # {comment}' if comment else ''}")
    for table, name in LISTS.items():
        for entry in getattr(question, name):
            lines += ["", f"[[{table}]]", *(f"{f.name} = {_toml(getattr(entry, f.name))}" for f in fields(Known))]
    return "\n".join(lines) + "\n"


_COMMENTS = {
    "question": "",
    "kind": "slider, stars, thumbs or pairs",
    "low": "lowest value, in the reward's unit",
    "high": "highest value",
    "stars": "how many, if the kind is stars",
    "unit": "what the values are, in words",
    "attributes": 'more things to rate on the same scale, such as ["safe", "fast"]',
    "comment": "whether raters may write a comment",
    "instructions": "plain text, shown first",
    "overlap": "raters per item",
    "repeats": "share of questions that are asked again",
    "acquisition": 'which items first: "random", "disputed", "least-known", "highest-reward", "near-ties", or weights',
    "break_after": "answers, then a break is proposed; 0 for never",
    "show_reward": "whether raters see what the environment paid",
}


def _toml(value: Any) -> str:
    """Return a value as TOML; text with the escapes of JSON, which TOML's basic strings share."""
    if isinstance(value, Mapping):
        entries = cast("Mapping[str, Any]", value).items()
        return "{ " + ", ".join(f"{json.dumps(str(k))} = {_toml(v)}" for k, v in entries) + " }"
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_toml(x) for x in cast("Iterable[Any]", value)) + "]"
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value, ensure_ascii=False)
