"""One rule for every verdict: a claim is a list of named parts, and the verdict follows from how many of them hold.

Words are data (TOML), numbers come from results, and each part is one expression of the named numbers:

    >>> parts = (Part("fewer visits than the baseline", lambda n: n["ours"] < n["baseline"]),)
    >>> judged(parts, {"ours": 1.0, "baseline": 2.0}).verdict
    'holds'
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

VERDICTS = HOLDS, IN_PART, FAILS, UNTESTABLE = "holds", "holds in part", "does not hold", "cannot be tested"

Numbers = Mapping[str, Any]


@dataclass(frozen=True)
class Part:
    """One thing that a claim says.

    Attributes:
        name: What must hold, in words.
        holds: One expression of the claim's named numbers; None where it cannot be tested. Never called without numbers.
    """

    name: str
    holds: Callable[[Numbers], bool | None]


@dataclass(frozen=True)
class Opinion:
    """A part that is a judgement of the paper's text: no number answers it, and it is shown as such.

    Attributes:
        name: What the text would have to say.
        holds: Our reading; None where neither the text nor any number of ours can answer it.
    """

    name: str
    holds: bool | None


def each(name: str, settings: Iterable[str], holds: Callable[[Numbers, str], bool | None]) -> tuple[Part, ...]:
    """Return one part per setting of a claim that is made of several: a grid, a panel, an agent.

    Args:
        name: What must hold, ``{}`` standing for the setting.
        settings: Their names, as the claim's numbers are keyed by.
        holds: One expression of the numbers and of the setting's name.
    """
    return tuple(Part(name.format(s), partial(_in_setting, holds, s)) for s in settings)


def _in_setting(holds: Callable[[Numbers, str], bool | None], setting: str, numbers: Numbers) -> bool | None:
    return holds(numbers, setting)


@dataclass(frozen=True)
class Outcome:
    """What became of one part.

    Attributes:
        name: Of the part.
        holds: Whether it does; None where it cannot be tested.
        opinion: Whether that is a judgement of text.
    """

    name: str
    holds: bool | None
    opinion: bool


@dataclass(frozen=True)
class Judgement:
    """A verdict, and the parts that it follows from."""

    verdict: str
    parts: tuple[Outcome, ...]

    @property
    def count(self) -> str:
        """How many parts hold, in words, e.g. ``2 of 3``; empty where nothing could be tested."""
        tested = [p for p in self.parts if p.holds is not None]
        return f"{sum(bool(p.holds) for p in tested)} of {len(tested)}" if tested else ""


def judged(parts: Sequence[Part | Opinion], numbers: Numbers | None) -> Judgement:
    """Judge a claim.

    Args:
        parts: At least one.
        numbers: What the parts are expressions of; None where there are no results, so that only opinions are left.
    """
    outcomes = tuple(_outcome(part, numbers) for part in parts)
    return Judgement(rule([o.holds for o in outcomes]), outcomes)


def _outcome(part: Part | Opinion, numbers: Numbers | None) -> Outcome:
    if isinstance(part, Opinion):
        return Outcome(part.name, part.holds, True)
    holds = None if numbers is None else part.holds(numbers)
    return Outcome(part.name, None if holds is None else bool(holds), False)


def rule(holds: Sequence[bool | None]) -> str:
    """Return the verdict: all parts hold, some do, none does, or none can be tested.

    A part that cannot be tested keeps the others from making the claim hold, but not from making it fail.
    """
    tested = [h for h in holds if h is not None]
    if not tested:
        return UNTESTABLE
    if all(tested):
        return HOLDS if len(tested) == len(holds) else IN_PART
    return IN_PART if any(tested) else FAILS
