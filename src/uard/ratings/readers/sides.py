"""How columns of answers about pairs are called."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from uard.ratings.readers.spelling import among

SIDES = (
    ("left", "right"), ("responsea", "responseb"), ("response1", "response2"), ("completiona", "completionb"),
    ("completion1", "completion2"), ("outputa", "outputb"), ("output1", "output2"), ("answera", "answerb"),
    ("answer1", "answer2"), ("modela", "modelb"), ("itema", "itemb"), ("item1", "item2"), ("optiona", "optionb"),
    ("option1", "option2"), ("first", "second"),
)  # fmt: skip
CHOICES = (
    "choice", "preferred", "preference", "winner", "label", "verdict", "judgment", "judgement", "better", "answer",
)  # fmt: skip


class Sides(NamedTuple):
    """The columns of an answer about a pair.

    Attributes:
        first: One side.
        second: The other.
        choice: Which was preferred; None if the first always is (``chosen`` and ``rejected``).
    """

    first: str
    second: str
    choice: str | None


def sides_among(names: Sequence[str]) -> Sides | None:
    """Return the columns of answers about pairs, or None if there are none.

    Examples:
        >>> sides_among(["id", "left", "right", "choice"])
        Sides(first='left', second='right', choice='choice')

    Args:
        names: Of all columns.
    """
    if (kept := among(names, ("chosen",))) and (lost := among(names, ("rejected",))):
        return Sides(kept[0], lost[0], None)
    choice = next((n for c in CHOICES for n in among(names, (c,))), None) if among(names, CHOICES) else None
    for one, other in SIDES if choice is not None else ():
        if (first := among(names, (one,))) and (second := among(names, (other,))):
            return Sides(first[0], second[0], choice)
    return None
