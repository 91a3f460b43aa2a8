"""The ledger itself: words, numbers and verdict of every claim, as data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from uard import __version__
from uard.lab.views.study_results import StudyResults
from uard.replication import paper
from uard.replication.ledger import (
    components,
    deep,
    distortion,
    filters,
    fixed_points,
    grids,
    locomotion,
    tables,
    text,
    words,
)
from uard.replication.ledger.claim import Conditions
from uard.replication.verdicts import Outcome, judged

CLAIMS = tuple(words.read())
CONDITIONS: dict[str, Conditions] = {
    claim: conditions
    for module in (tables, filters, fixed_points, grids, components, locomotion, distortion, deep, text)
    for claim, conditions in module.CONDITIONS.items()
}


@dataclass(frozen=True)
class Entry:
    """One line of the ledger.

    Attributes:
        claim: Inventory id.
        statement: The claim, in one sentence.
        line: Its line in the paper's source.
        source: What was run.
        ours: Our number, with its 95 % interval over seeds where it has one.
        verdict: One of ``VERDICTS``; it follows from the parts.
        count: How many of the parts that can be tested hold, e.g. ``2 of 3``; empty where none can.
        parts: What the claim says, one thing each, and whether it holds; an opinion is a judgement of the text.
        why: The reason, from the numbers.
    """

    claim: str
    statement: str
    line: int
    source: str
    ours: str
    verdict: str
    count: str
    parts: tuple[Outcome, ...]
    why: str


def entries(results: StudyResults) -> list[Entry]:
    """Return the whole ledger, tables and tests first.

    Raises:
        LookupError: a grid study of the paper is not in the store.
    """
    return [entry(claim, CONDITIONS[claim].numbers(results)) for claim in CLAIMS]


def entry(claim: str, numbers: dict[str, Any] | None) -> Entry:
    """Return the line of one claim from its numbers; None where its results are not there."""
    about, found = words.read()[claim], judged(CONDITIONS[claim].parts, numbers)
    if numbers is None:
        ours, why = "-", about.missing
    else:
        named = {"count": found.count} | numbers
        ours, why = (words.Template().vformat(template, (), named) for template in (about.ours, about.why))
    return Entry(claim, about.statement, about.line, about.source, ours, found.verdict, found.count, found.parts, why)


def as_data(entries: Sequence[Entry], seeds: Sequence[int]) -> dict[str, Any]:
    """Return the ledger as plain data, for ``ledger.json``."""
    return {
        "version": __version__,
        "paper": paper.VERSION,
        "seeds": list(seeds),
        "entries": [asdict(e) for e in entries],
    }
