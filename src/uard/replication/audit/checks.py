"""What a check of the audit is: its words are data, its numbers are computed, and its verdict follows from named parts."""

from __future__ import annotations

import re
import string
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from typing import Any

from uard._checks import InvalidValueError, UnknownNameError
from uard.replication.verdicts import FAILS, HOLDS, UNTESTABLE, Judgement, Opinion, Outcome, Part, judged

Values = Mapping[str, float | str | None]

# Keys of the sentences in checks.toml. A claim that holds in part has the outcomes of its parts in their order.
_WHOLE = {HOLDS: "holds", FAILS: "fails", UNTESTABLE: "untestable"}
_SAID = {True: "yes", False: "no", None: "untested"}
_KEY = re.compile(r"found|holds|fails|untestable|(yes|no|untested)(-(yes|no|untested))+")


@dataclass(frozen=True)
class Words:
    """The prose of one check; ``{name}`` and ``{name:format}`` stand for its numbers.

    Attributes:
        question: What is asked.
        concerns: Ids of the inventory.
        verdict: The sentence for each outcome that one was written for: ``holds``, ``fails``, the outcomes of the parts
            in their order (``no-yes``), or ``found`` where the paper claims nothing.
        paper: What the paper says in words, by name.
    """

    question: str
    concerns: tuple[str, ...]
    verdict: Mapping[str, str]
    paper: Mapping[str, str] = field(default_factory=dict)


@cache
def all_words() -> Mapping[str, Words]:
    """Read ``checks.toml``: the words of every check by its id.

    Raises:
        InvalidValueError: if a sentence is written for something that is no outcome.
    """
    text = resources.files("uard.replication.audit").joinpath("checks.toml").read_text(encoding="utf-8")
    words = {name: Words(**{**w, "concerns": tuple(w["concerns"])}) for name, w in tomllib.loads(text).items()}
    for name, w in words.items():
        for key in w.verdict:
            if not _KEY.fullmatch(key):
                raise InvalidValueError(f"checks.toml: {name}: verdict", key, "holds, fails, found or e.g. yes-no")
    return words


class _ByName(string.Formatter):
    """Names of numbers may hold any character but ``{}:!``: nothing is looked up inside of a number."""

    def get_field(self, field_name: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> tuple[Any, str]:
        if field_name not in kwargs:
            raise UnknownNameError("number", field_name, kwargs)
        return kwargs[field_name], field_name

    def format_field(self, value: Any, format_spec: str) -> str:
        text = format(value, format_spec)
        return f"{text[:-1]} %" if format_spec.endswith("%") else text


def filled(template: str, numbers: Mapping[str, Any]) -> str:
    """Return a template with its numbers.

    Raises:
        UnknownNameError: if it names a number that is not there.
    """
    return _ByName().vformat(template, (), numbers)


@dataclass(frozen=True)
class Check:
    """One question put to the paper, and the answer.

    A name stands for one number: ``printed``, ``recomputed`` and ``others`` share none.

    Attributes:
        id: Section of the audit and a name, e.g. ``a.horizon``; its words stand under it in ``checks.toml``.
        printed: The paper's numbers, by name.
        recomputed: What comes out here, by name.
        others: Further numbers that words and parts need and that no table shows.
        claims: What the paper says; empty where it says nothing to hold or fail.
        findings: What our sentence says beyond that. Where one fails, the sentence is not used.
    """

    id: str
    printed: Values = field(default_factory=dict)
    recomputed: Values = field(default_factory=dict)
    others: Values = field(default_factory=dict)
    claims: tuple[Part | Opinion, ...] = ()
    findings: tuple[Part | Opinion, ...] = ()

    def __post_init__(self) -> None:
        """Check the names.

        Raises:
            InvalidValueError: if a name stands for two numbers.
            UnknownNameError: if ``checks.toml`` has no words for this check.
        """
        names = [*self.printed, *self.recomputed, *self.others]
        for name in {n for n in names if names.count(n) > 1}:
            raise InvalidValueError(f"{self.id}: number", name, "a name that stands for one number only")
        if self.id not in all_words():
            raise UnknownNameError("check", self.id, all_words())

    @property
    def words(self) -> Words:
        """The prose, with places for numbers."""
        return all_words()[self.id]

    @property
    def numbers(self) -> Values:
        """Every number that parts and words may name."""
        return {**self.printed, **self.recomputed, **self.others}

    @property
    def question(self) -> str:
        """What is asked."""
        return filled(self.words.question, self.numbers)

    @property
    def paper(self) -> Values:
        """What the paper prints, by name; empty where it prints nothing."""
        return {**self.words.paper, **self.printed}

    @property
    def concerns(self) -> tuple[str, ...]:
        """Ids of the inventory (claims J, tables F, figures G...)."""
        return self.words.concerns

    @property
    def judgement(self) -> Judgement | None:
        """What became of the paper's claims; None where it says nothing to hold or fail."""
        return judged(self.claims, self.numbers) if self.claims else None

    @property
    def parts(self) -> tuple[Outcome, ...]:
        """What became of each claim of the paper."""
        return self.judgement.parts if self.judgement else ()

    @property
    def found(self) -> tuple[Outcome, ...]:
        """What became of each finding: all hold, or the sentence is not used."""
        return judged(self.findings, self.numbers).parts

    @property
    def holds(self) -> bool | None:
        """Whether all that the paper says follows; None where it says nothing to hold or fail."""
        return self.judgement and self.judgement.verdict == HOLDS

    @property
    def _outcome(self) -> str:
        if self.judgement is None:
            return "found"
        return _WHOLE.get(self.judgement.verdict) or "-".join(_SAID[o.holds] for o in self.parts)

    @property
    def verdict(self) -> str:
        """The answer in a sentence: the one written for this outcome, or else the parts one by one."""
        sentence = self.words.verdict.get(self._outcome)
        if sentence is not None and all(o.holds for o in self.found):
            return filled(sentence, self.numbers)
        return one_by_one([*self.parts, *self.found])


def one_by_one(outcomes: Sequence[Outcome]) -> str:
    """Return in words what became of each part."""
    return "; ".join(f"{o.name}: {_SAID[o.holds]}{' (our reading)' if o.opinion else ''}" for o in outcomes)
