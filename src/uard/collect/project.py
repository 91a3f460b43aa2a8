"""A project is a folder: its question (``project.toml``), its answers (``answers.sqlite``), its clips (``media``)."""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, cast

from uard import _checks
from uard._support import files
from uard.collect.acquisition import Acquisition
from uard.collect.items import Item
from uard.collect.sqlite import SQLiteStore
from uard.ratings.export import COLUMNS

QUESTIONS = ("slider", "stars", "thumbs", "pairs")
SETTINGS, ANSWERS, MEDIA, LOCK = "project.toml", "answers.sqlite", "media", "serving.lock"
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
        _checks.number("low", self.low)
        _checks.number("high", self.high)
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

    def _check_attributes(self) -> None:
        allowed = f"at most {MOST_ATTRIBUTES} different names of 1 to {LONGEST_ATTRIBUTE} printable characters"
        plain: list[str] = []
        for name in cast("tuple[Any, ...]", self.attributes):
            if not isinstance(name, str) or not name.strip() or not name.isprintable() or len(name) > LONGEST_ATTRIBUTE:
                raise _checks.InvalidValueError("attributes", self.attributes, allowed)
            if name in COLUMNS or name[0] in "=+-@":
                clash = f"other names than the columns of the export ({', '.join(COLUMNS)}), not beginning with = + - @"
                raise _checks.InvalidValueError("attributes", name, clash)
            plain.append(name)
        if len(plain) > MOST_ATTRIBUTES or len(set(plain)) < len(plain):
            raise _checks.InvalidValueError("attributes", self.attributes, allowed)

    def _check_known(self, table: str, entries: tuple[Known, ...]) -> None:
        """Check that what should be said can be said, and of each item once."""
        low, high = (0.0, 1.0) if self.kind in ("thumbs", "pairs") else (self.low, self.high)
        items = [entry.item for entry in entries]
        for entry in entries:
            if not low <= entry.value <= high:
                where = f"{table}: value of item {entry.item}"
                raise _checks.InvalidValueError(where, entry.value, f"in [{low:g}, {high:g}], which can be answered")
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


_LISTS = {"practice": "practice", "gold": "gold", "example": "examples"}  # tables of the file, and fields


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
        raise _checks.UnknownNameError(f"{source}: table", "examples", _LISTS)
    for table, name in _LISTS.items():
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


@dataclass(frozen=True)
class Project:
    """A folder in which people rate.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     project = Project.create(Path(folder) / "walk", Question(kind="stars"))
        ...     project.question.kind, Project.open(project.folder).question == project.question
        ('stars', True)

    Attributes:
        folder: Where it is.
        question: What raters are asked.
    """

    folder: Path
    question: Question

    @staticmethod
    def create(folder: str | Path, question: Question | None = None) -> Project:
        """Make a project's folder; an existing project is opened and keeps its question.

        Raises:
            InvalidValueError: the folder cannot be made, or its ``project.toml`` is not what it must be.
        """
        path = Path(folder)
        if not (path / SETTINGS).exists():
            files.prepare_folder(str(path / MEDIA), "project")
            files.write(path / SETTINGS, as_toml(question or Question()), "project")
        return Project.open(path)

    @staticmethod
    def open(folder: str | Path) -> Project:
        """Open a project.

        Raises:
            InvalidValueError: there is none, or its ``project.toml`` is not what it must be.
        """
        path = Path(folder)
        file = path / SETTINGS
        try:
            data = tomllib.loads(file.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise _checks.InvalidValueError(
                "project", str(folder), "a folder that `uard collect record` or `uard collect texts` has made"
            ) from None
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise _checks.InvalidValueError(str(file), str(error), "a TOML file that can be read") from None
        try:
            (path / MEDIA).mkdir(exist_ok=True)
        except OSError as error:
            raise _checks.InvalidValueError(str(path / MEDIA), error.strerror, "a folder, which holds clips") from None
        return Project(path, question_of(data, str(file)))

    def store(self) -> SQLiteStore:
        """Open its store; made if there is none yet.

        Raises:
            StoreError: it cannot be opened, or is of another version.
        """
        return SQLiteStore(self.folder / ANSWERS)

    def served_at(self) -> str | None:
        """Return the address of the server that shows the project now; None if it tells none."""
        try:
            return str(json.loads((self.folder / LOCK).read_bytes())["address"])
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def keep(self, data: bytes, ending: str) -> str:
        """Keep a file of a clip, and return its name, which is made of its content.

        Args:
            data: The file's bytes.
            ending: ``webp`` or ``npz``.
        """
        name = f"{hashlib.sha256(data).hexdigest()}.{ending}"
        path = self.folder / MEDIA / name
        if not path.exists():
            with files.replacing(path) as file:
                file.write(data)
        return name

    def media(self, name: str) -> Path:
        """Return the path of a file of a clip; it may be missing."""
        return self.folder / MEDIA / name

    def outside(self, target: str | None, field: str) -> None:
        """Refuse to write over what the project is made of.

        Args:
            target: Where a file is going to be written; None and ``-`` are nowhere.
            field: What that is called in the error.

        Raises:
            InvalidValueError: it is one of the project's own files.
        """
        if target is None or target == "-":
            return
        own, path = self.folder.resolve(), Path(target).resolve()
        names = (SETTINGS, LOCK, *(ANSWERS + ending for ending in ("", "-wal", "-shm", "-journal")))
        if path in {own / name for name in names} or path == own / MEDIA or own / MEDIA in path.parents:
            raise _checks.InvalidValueError(field, target, f"another file than those of the project {self.folder}")
        files.prepare(target, field, *(own / name for name in names))

    def unknown(self, items: Iterable[Item]) -> dict[str, str]:
        """Return the items that practice, gold or examples name and that are not there, each with the table's name."""
        there = {item.id for item in items}
        tables = {table: getattr(self.question, name) for table, name in _LISTS.items()}
        return {k.item: table for table, entries in tables.items() for k in entries if k.item not in there}

    def damaged(self, items: Iterable[Item]) -> dict[str, str]:
        """Return which items cannot be shown, and why: a file is missing, or was changed since it was recorded."""
        verdicts: dict[str, str | None] = {}
        found: dict[str, str] = {}
        for item in items:
            for name in item.media:
                if name not in verdicts:
                    verdicts[name] = self._wrong(name)
                if (why := verdicts[name]) is not None:
                    found[item.id] = why
        return found

    def _wrong(self, name: str) -> str | None:
        path = self.media(name)
        try:
            changed = hashlib.sha256(path.read_bytes()).hexdigest() != name.split(".")[0]
        except FileNotFoundError:
            return f"{path} is missing"
        except OSError as error:
            return f"{path} cannot be read ({error.strerror})"
        return f"{path} was changed after it was recorded" if changed else None


def as_toml(question: Question) -> str:
    """Return a question as the text of a ``project.toml`` with a comment beside each field.

    Examples:
        >>> question_of(tomllib.loads(as_toml(Question(kind="thumbs")))) == Question(kind="thumbs")
        True
    """
    lines = ["# What raters are asked. Changes take effect when `uard collect serve` starts."]
    for name, comment in _COMMENTS.items():
        lines.append(f"{name} = {_toml(getattr(question, name))}{f'  # {comment}' if comment else ''}")
    for table, name in _LISTS.items():
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
