"""What every claim's conditions are made of, and the few comparisons that many of them share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from uard.lab.statistics import Summary
from uard.lab.views.study_results import StudyResults
from uard.replication.paper import Stat
from uard.replication.verdicts import Opinion, Part


def nothing(results: StudyResults) -> dict[str, Any]:
    """Return no numbers: for a claim that is about the paper's text alone."""
    return {}


@dataclass(frozen=True)
class Conditions:
    """What must hold of a claim; its words are in ``claims.toml``.

    Attributes:
        parts: What the claim says, one thing each.
        numbers: Gathers the named numbers of parts and words: plain numbers, ``Summary``, ``Stat``, or a dictionary
            of these by setting. None where results that are needed are not there.
    """

    parts: tuple[Part | Opinion, ...]
    numbers: Callable[[StudyResults], dict[str, Any] | None] = nothing


def agrees(ours: Summary, printed: Stat) -> bool:
    """Whether our mean lies within the printed standard deviation of the printed mean."""
    return abs(ours.mean - printed.mean) <= printed.sd


def below(a: Summary, b: Summary) -> bool:
    """Whether the 95 % interval of ``a`` lies wholly below that of ``b``."""
    return a.ci95[1] < b.ci95[0]


def reduction(ours: Summary, baseline: Summary) -> float:
    """Return by which share our mean is lower than the baseline's."""
    return 1 - ours.mean / baseline.mean
