"""Prompts and completions from files, and pairs of items."""

from __future__ import annotations

import csv
import itertools
import math
from collections import defaultdict
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from uard import _checks
from uard.collect.items import LONGEST_TEXT, Item, pair_item, text_item
from uard.collect.project import Project
from uard.ratings.log import bad_cell
from uard.ratings.readers.columns import Choice, Numbers, name_of
from uard.ratings.readers.formats import table
from uard.ratings.readers.spelling import among
from uard.ratings.table import LONGEST

PROMPTS = ("prompt", "prompts", "question", "instruction", "query", "input")
COMPLETIONS = (
    "completion", "completions", "response", "responses", "answer", "answers", "output", "outputs", "text",
)  # fmt: skip
REWARDS = ("reward", "rewards", "score", "scores")
STRATA = ("stratum", "model", "policy", "source")
SIDES = ("chosen", "rejected")
_TURN = "\n\nAssistant:"  # where an answer begins in data sets that keep conversations as text
_NAMED = 20  # rows that a message names
_LARGEST_CELL = 2**31 - 1  # characters of a CSV's cell; what is too long is refused by its row


def texts(path: str | Path, project: Project) -> list[Item]:
    r"""Put the completions of a file into a project: all of them, or none if a line is bad.

    A row holds a prompt and a completion, or several as a list, or ``chosen`` and ``rejected``; and, if known, what a
    reward model said (``reward``, ``score``) and who answered (``model``, ``stratum``). Prompts and completions are
    text, or lists of messages with ``role`` and ``content``, as TRL's and OpenAI's; a list called ``messages`` holds
    both. Without a column of prompts, what ``chosen`` and ``rejected`` begin with in common is the prompt. Markup is
    kept, and shown as it is.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "answers.jsonl"
        ...     _ = file.write_text('{"prompt": "2 + 2?", "completions": ["4", "<b>5</b>"]}\n')
        ...     found = texts(file, Project.create(Path(folder) / "project"))
        >>> [item.content["completion"] for item in found]
        ['4', '<b>5</b>']

    Args:
        path: A ``.jsonl``, ``.json``, ``.csv`` or ``.parquet`` file (``uard.ratings.readers.FORMATS``).
        project: Where to.

    Returns:
        The items, each once.

    Raises:
        InvalidValueError: the file cannot be read, has no such columns, or has bad lines: no text, an empty completion,
            a text of more than ``LONGEST_TEXT`` characters, a reward that is no number. The message names row, column
            and value of the first, and the rows of the others.
        StoreError: the project's database cannot be written.
    """
    items = read_texts(path)
    with closing(project.store()) as store:
        store.add_items(items)
    return items


def read_texts(path: str | Path) -> list[Item]:
    """Return the completions of a file, each once, without a project; see ``texts``.

    Raises:
        InvalidValueError: see ``texts``.
    """
    source = str(path)
    choice = _Columns(source)
    with _long_cells():
        try:
            columns, names = table(path, choice, Numbers(source))
        except _checks.InvalidValueError as error:
            if error.field != "log":
                raise
            raise _checks.InvalidValueError("texts", source, str(error).split(": must be ", 1)[-1]) from None
    layout = choice.of(names)
    bad = _Bad(source)
    found: dict[str, Item] = {}
    for row in range(len(columns[layout.answers[0]])):
        for item in _items({name: column[row] for name, column in columns.items()}, layout, bad, row):
            found.setdefault(item.id, item)
    bad.check()
    return list(found.values())


def pairs(items: Iterable[Item], project: Project, count: int | None = None, seed: int = 0) -> list[Item]:
    """Put pairs of items into a project: of completions of one prompt, and of any two clips; no pair twice.

    They are drawn at random, such that each item is in about as many as the others.

    Examples:
        >>> import tempfile
        >>> answers = [text_item("2 + 2?", a) for a in ("3", "4", "5")] + [text_item("3 + 3?", "6")]
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     project = Project.create(folder)
        ...     with closing(project.store()) as store:
        ...         _ = store.add_items(answers)
        ...     len(pairs(answers, project)), len(pairs(answers, project, count=2))
        (3, 2)

    Args:
        items: Clips and texts that are in the project; pairs among them are left alone.
        project: Where to.
        count: How many, >= 1; all that there are if that is fewer, or if left out.
        seed: Of what is drawn, >= 0.

    Raises:
        InvalidValueError: no two items can be compared.
        StoreError: the project's database cannot be written.
    """
    if count is not None:
        _checks.whole("count", count, low=1)
    _checks.whole("seed", seed, low=0)
    items = list(items)
    groups = comparable(items)
    if not groups:
        allowed = "at least two clips, or two completions of one prompt"
        raise _checks.InvalidValueError("items", f"{len({i.id for i in items if i.kind != 'pair'})} items", allowed)
    found = [_pair(*two) for two in _drawn(groups, count, np.random.default_rng(seed))]
    with closing(project.store()) as store:
        store.add_items(found)
    return found


def comparable(items: Iterable[Item]) -> list[list[Item]]:
    """Return the clips and texts that can stand beside each other, in groups of at least two.

    Examples:
        >>> len(comparable([text_item("2 + 2?", "4"), text_item("2 + 2?", "5"), text_item("3 + 3?", "6")]))
        1
    """
    groups: defaultdict[tuple[str, ...], dict[str, Item]] = defaultdict(dict)
    for item in items:
        if item.kind != "pair":
            groups[(item.kind, str(item.content.get("prompt", "")))][item.id] = item
    return [list(group.values()) for group in groups.values() if len(group) > 1]


def _drawn(groups: list[list[Item]], count: int | None, random: np.random.Generator) -> list[tuple[Item, Item]]:
    """Return pairs: rounds in which each item meets another of its group, until there are enough."""
    there = sum(math.comb(len(group), 2) for group in groups)
    if count is None or count >= there:
        return [two for group in groups for two in itertools.combinations(group, 2)]
    found: dict[frozenset[str], tuple[Item, Item]] = {}
    while True:
        for g in cast("list[int]", random.permutation(len(groups)).tolist()):
            order = cast("list[int]", random.permutation(len(groups[g])).tolist())
            for i, j in zip(order[::2], order[1::2], strict=False):
                one, other = groups[g][i], groups[g][j]
                found.setdefault(frozenset((one.id, other.id)), (one, other))
                if len(found) == count:
                    return list(found.values())


def _pair(one: Item, other: Item) -> Item:
    strata = sorted({one.stratum, other.stratum} - {""})
    return pair_item(one.id, other.id, stratum=" | ".join(strata))


class _Layout(NamedTuple):
    """Which columns hold what; ``sides`` says that the answers are chosen and rejected."""

    prompt: str | None
    answers: tuple[str, ...]
    rewards: tuple[str | None, ...]
    stratum: str | None
    sides: bool = False


@dataclass(frozen=True)
class _Columns(Choice):
    """The columns of prompts and completions; ``source`` is what messages call their file."""

    source: str

    def candidate(self, name: str) -> bool:
        return True

    def columns(self, names: Sequence[str]) -> tuple[Sequence[str], Sequence[str]]:
        found = self.of(names)
        wanted = (found.prompt, *found.answers, *found.rewards, found.stratum)
        return (), tuple(dict.fromkeys(name for name in wanted if name is not None))

    def of(self, names: Sequence[str]) -> _Layout:
        """Return the layout; the first of several columns that could be meant.

        Raises:
            InvalidValueError: there are no completions or no prompts.
        """
        prompt, stratum, reward = (_first(names, known) for known in (PROMPTS, STRATA, REWARDS))
        sides = tuple(_first(names, (side,)) for side in SIDES)
        if all(sides):
            rewards = tuple(_first(names, [f"{a}{b}" for r in REWARDS for a, b in ((r, s), (s, r))]) for s in SIDES)
            return _Layout(prompt, tuple(str(side) for side in sides), rewards, stratum, True)
        answer = _first(names, COMPLETIONS)
        if answer is None and (messages := _first(names, ("messages", "conversation"))):
            return _Layout(None, (messages,), (reward,), stratum)
        for what, column, like in (("completions", answer, "completion"), ("prompts", prompt, "prompt")):
            if column is None:
                allowed = f"one called {like}, or chosen and rejected, or messages. Columns: {', '.join(names)}"
                raise _checks.InvalidValueError(f"{self.source}: column of {what}", "none", allowed)
        return _Layout(prompt, (str(answer),), (reward,), stratum)


def _first(names: Sequence[str], known: Sequence[str]) -> str | None:
    return next((name for wanted in known for name in among(names, (wanted,))), None)


class _Bad:
    """Bad cells; all are found before any is told."""

    def __init__(self, source: str):
        self.source = source
        self.cells: list[tuple[int, str, object, str]] = []

    def add(self, row: int, column: str, value: object, allowed: str) -> None:
        self.cells.append((row, column, value, allowed))

    def check(self) -> None:
        """Refuse the file if there are any.

        Raises:
            InvalidValueError: so it is.
        """
        if not self.cells:
            return
        row, column, value, allowed = self.cells[0]
        if more := list(dict.fromkeys(r + 1 for r, *_ in self.cells if r != row)):
            shown = ", ".join(map(str, more[:_NAMED])) + (", ..." if len(more) > _NAMED else "")
            allowed += f". Rows that are bad, too ({len(more)}): {shown}"
        raise bad_cell(self.source, row, column, value, f"{allowed}. Nothing was added")


def _items(row: Mapping[str, Any], layout: _Layout, bad: _Bad, number: int) -> list[Item]:
    """Return the completions of a row; none of a bad one."""
    before = len(bad.cells)
    stratum = "" if layout.stratum is None else (name_of(row[layout.stratum]) or "")
    if len(stratum) > LONGEST or not stratum.isprintable():
        bad.add(number, str(layout.stratum), f"{stratum[:30]}...", f"at most {LONGEST} printable characters")
    prompt, answers = _conversation(row, layout, bad, number)
    found: list[Item] = []
    for column, completions in answers.items():
        reward = layout.rewards[layout.answers.index(column)]
        rewards = _rewards(row, reward, len(completions), bad, number)
        for completion, value in zip(completions, rewards, strict=True):
            if _checked(completion, column, bad, number, empty=False) and len(bad.cells) == before:
                found.append(text_item(prompt, completion, reward=value, stratum=stratum))
    return found if len(bad.cells) == before else []


def _conversation(row: Mapping[str, Any], layout: _Layout, bad: _Bad, number: int) -> tuple[str, dict[str, list[str]]]:
    """Return the prompt, and the completions in each column."""
    column = layout.answers[0]
    try:
        if layout.prompt is not None:
            column = layout.prompt
            prompt = _text(row[column])
            _checked(prompt, column, bad, number, empty=True)
            answers: dict[str, list[str]] = {}
            for column in layout.answers:
                answers[column] = [_completion(x, prompt) for x in _several(row[column], layout.sides)]
            return prompt, answers
        if layout.sides:
            prompt, *sides = _common(*(row[name] for name in layout.answers))
            answers = {name: [said] for name, said in zip(layout.answers, sides, strict=True)}
        else:
            messages = _messages(row[column])
            prompt, answers = _said(messages[:-1]), {column: [_content(messages[-1])]}
    except ValueError as error:
        bad.add(number, column, row[column], str(error))
        return "", {}
    _checked(prompt, column, bad, number, empty=True)
    return prompt, answers


def _checked(text: str, column: str, bad: _Bad, number: int, *, empty: bool) -> bool:
    if len(text) > LONGEST_TEXT:
        bad.add(number, column, f"{text[:30]}...", f"at most {LONGEST_TEXT} characters, and it has {len(text)}")
    elif not empty and not text.strip():
        bad.add(number, column, text, "text that is not empty")
    elif any("\ud800" <= c <= "\udfff" for c in text):
        bad.add(number, column, text, "text without halves of surrogate pairs, which no page can show")
    else:
        return True
    return False


_A_TEXT = "text, or a list of messages with role and content"


def _several(value: Any, one: bool) -> list[Any]:
    """Return the completions in a cell."""
    if isinstance(value, list) and not one and not (value and isinstance(value[0], Mapping)):
        if not value:
            raise ValueError("a list with at least one completion")
        return cast("list[Any]", value)
    return [value]


def _text(value: Any) -> str:
    """Return a cell as text.

    Raises:
        ValueError: with what it must be.
    """
    return value if isinstance(value, str) else _said(_messages(value))


def _completion(value: Any, prompt: str) -> str:
    """Return a completion as text, without the prompt if it repeats that."""
    if isinstance(value, str):
        return value
    messages = _messages(value)
    return _content(messages[-1]) if len(messages) > 1 and _said(messages[:-1]) == prompt else _said(messages)


def _common(chosen: Any, rejected: Any) -> tuple[str, str, str]:
    """Return what two conversations begin with in common, and how each goes on."""
    if isinstance(chosen, str) and isinstance(rejected, str):
        end = chosen.rfind(_TURN) + len(_TURN)
        if end < len(_TURN) or chosen[:end] != rejected[:end]:
            raise ValueError("beside a column of prompts, or a conversation that rejected begins with, too")
        return chosen[:end].strip(), chosen[end:].strip(), rejected[end:].strip()
    one, other = _messages(chosen), _messages(rejected)
    same = sum(1 for _ in itertools.takewhile(lambda two: two[0] == two[1], zip(one[:-1], other[:-1], strict=False)))
    return _said(one[:same]), _said(one[same:]), _said(other[same:])


def _messages(value: Any) -> list[Mapping[str, Any]]:
    messages = cast("list[Any]", value) if isinstance(value, list) else []
    if not messages or not all(isinstance(m, Mapping) and "content" in m for m in messages):
        raise ValueError(_A_TEXT)
    return cast("list[Mapping[str, Any]]", messages)


def _said(messages: Sequence[Mapping[str, Any]]) -> str:
    """Return messages as text; who speaks is said where there are several."""
    if len(messages) == 1:
        return _content(messages[0])
    return "\n\n".join(f"{m.get('role') or 'message'}: {_content(m)}" for m in messages)


def _content(message: Mapping[str, Any]) -> str:
    content: Any = message["content"]
    if isinstance(content, list):  # OpenAI's parts
        parts = cast("list[Any]", content)
        texts = [cast("Mapping[str, Any]", part).get("text") if isinstance(part, Mapping) else None for part in parts]
        content = None if any(not isinstance(text, str) for text in texts) else "".join(cast("list[str]", texts))
    if not isinstance(content, str):
        raise ValueError("messages whose content is text; pictures and calls of tools cannot be shown")
    return content


def _rewards(row: Mapping[str, Any], column: str | None, count: int, bad: _Bad, number: int) -> list[float | None]:
    if column is None:
        return [None] * count
    given: Any = row[column]
    values = cast("list[Any]", given) if isinstance(given, list) else [given] * count
    if len(values) != count:
        bad.add(number, column, row[column], f"a number, or as many as there are completions ({count})")
        return [None] * count
    found: list[float | None] = []
    for value in values:
        reader = Numbers(bad.source)
        (read,) = reader.of([value], column, text=True)
        if reader.bad or abs(read) > _checks.LARGEST:
            bad.add(number, column, value, "a number, or nothing where it is not known")
        found.append(None if np.isnan(read) or abs(read) > _checks.LARGEST else float(read))
    return found


@contextmanager
def _long_cells() -> Generator[None]:
    """Let cells of a CSV be long while the block runs."""
    before = csv.field_size_limit(_LARGEST_CELL)
    try:
        yield
    finally:
        csv.field_size_limit(before)
