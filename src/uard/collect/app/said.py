"""What a page has sent as an answer, checked against the question: values, choices, comments, times and names."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any, cast

from starlette.exceptions import HTTPException

from uard.collect.items import Item
from uard.collect.project import Question
from uard.ratings.table import LONGEST_COMMENT

LONGEST_SECONDS = 86_400.0
SOURCES = ("page", "simulated")
_CLIENT_ID = re.compile(r"[0-9A-Za-z-]{8,64}")
_CHOICES = {"pairs": ("left", "right", "tie", "cannot tell", "skip"), "thumbs": ("up", "down", "skip")}

Said = tuple[str, float | None, str | None]
"""Attribute, value and choice of one thing that was answered."""


def said(question: Question, body: Mapping[str, Any], item: Item) -> list[Said]:
    """Return what was answered, a row for each thing that was asked.

    Examples:
        >>> from uard.collect.items import text_item
        >>> said(Question(), {"values": {"": 0.5}}, text_item("2 + 2?", "4"))
        [('', 0.5, None)]

    Args:
        question: What was asked.
        body: What was sent.
        item: Of what.

    Raises:
        HTTPException: it is no answer to this question.
    """
    values, choice = body.get("values"), body.get("choice")
    if (item.kind == "pair") != (question.kind == "pairs"):
        raise HTTPException(400, f"This question is not asked about a {item.kind}.")
    allowed = _CHOICES.get(question.kind, ("skip",))
    if choice is not None:
        if choice not in allowed or values is not None:
            raise HTTPException(400, f"choice = {choice!r}: must be one of {', '.join(allowed)}, without values.")
        thumbs = {"up": question.high, "down": question.low} if question.kind == "thumbs" else {}
        return [("", thumbs.get(str(choice)), str(choice))]
    names = ("", *question.attributes)
    if question.kind in _CHOICES or not isinstance(values, dict) or set(cast("Any", values)) != set(names):
        wanted = "a choice" if question.kind in _CHOICES else f"values for {', '.join(map(repr, names))}"
        raise HTTPException(400, f"The answer must hold {wanted}, or the choice to skip.")
    return [(name, _value(question, name, cast("Any", values)[name]), None) for name in names]


def _value(question: Question, name: str, value: object) -> float:
    if isinstance(value, int | float) and not isinstance(value, bool):
        if question.kind == "stars":
            nearest = min(question.levels, key=lambda level: abs(level - value))
            if abs(nearest - value) <= 1e-9 * (question.high - question.low):
                return nearest
        elif question.low <= value <= question.high:
            return float(value)
    allowed = f"in [{question.low:g}, {question.high:g}]"
    if question.kind == "stars":
        allowed = f"one of {', '.join(f'{level:g}' for level in question.levels)}"
    raise HTTPException(400, f"values[{name!r}] = {value!r}: must be {allowed}.")


def comment_of(question: Question, body: Mapping[str, Any]) -> str:
    """Return the comment; empty if there is none.

    Raises:
        HTTPException: it is none, or the project asks for none.
    """
    comment = body.get("comment") or ""
    if not isinstance(comment, str) or len(comment) > LONGEST_COMMENT:
        raise HTTPException(400, f"A comment may have {LONGEST_COMMENT} characters.")
    if comment.strip() and not question.comment:
        raise HTTPException(400, "This project asks for no comments.")
    return comment.strip()


def source_of(body: Mapping[str, Any]) -> str:
    """Return where an answer was given.

    Raises:
        HTTPException: elsewhere.
    """
    source = body.get("source", SOURCES[0])
    if source not in SOURCES:
        raise HTTPException(400, f"source = {source!r}: must be one of {', '.join(SOURCES)}.")
    return str(source)


def client_id(value: object) -> str:
    """Return the name that a page has given to what it sends.

    Raises:
        HTTPException: it is none.
    """
    if not isinstance(value, str) or not _CLIENT_ID.fullmatch(value):
        raise HTTPException(400, "Every answer needs an id of its own, 8 to 64 letters and digits.")
    return value


def seconds_of(value: object) -> float:
    """Return how long it took; a clock that jumps, or nonsense, makes no answer void.

    Examples:
        >>> seconds_of(3), seconds_of(-1.0), seconds_of("a while")
        (3.0, 0.0, 0.0)
    """
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        return 0.0
    return min(max(float(value), 0.0), LONGEST_SECONDS)


def sides(item: Item, left: str | None) -> list[str]:
    """Return the names of a pair's items as they stand on the screen, of which the left one may be given."""
    one, other = str(item.content["left"]), str(item.content["right"])
    return [other, one] if left == other else [one, other]
