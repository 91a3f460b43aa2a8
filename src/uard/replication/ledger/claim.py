"""What every claim's conditions are made of, and the few comparisons that many of them share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from uard.lab.statistics import Summary, compare_all
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


def above_zero(difference: Summary) -> bool:
    """Whether the interval of a difference lies above 0; one seed has none, and shows nothing."""
    return difference.ci95 is not None and difference.ci95[0] > 0


def below_zero(difference: Summary) -> bool:
    """Whether the interval of a difference lies below 0."""
    return difference.ci95 is not None and difference.ci95[1] < 0


def below(a: Summary, b: Summary) -> bool:
    """Whether ``a`` is lower than ``b`` beyond noise (paired test where they have as many seeds, 5 %)."""
    return compare_all([(a.per_seed, b.per_seed)]).below(0)


def below_in(a: Mapping[str, Summary], b: Mapping[str, Summary], setting: str) -> bool:
    """Whether ``a`` is lower than ``b`` in one setting, corrected for all settings of the claim (Holm)."""
    both = [s for s in a if s in b]
    return compare_all([(a[s].per_seed, b[s].per_seed) for s in both]).below(both.index(setting))


def reduction(ours: Summary, baseline: Summary) -> float:
    """Return by which share our mean is lower than the baseline's."""
    return 1 - ours.mean / baseline.mean
