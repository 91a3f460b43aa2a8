"""The paper's arithmetic, recomputed: what its own numbers imply, and where they contradict each other.

Every number comes from ``uard.replication.paper`` or is computed here, exactly where that is possible (value iteration,
Markov chains, quadrature). One module per section of ``paper/audit.md``; the words stand in ``checks.toml``. ``run`` does
all in a few seconds.
"""

from __future__ import annotations

from collections.abc import Callable

from uard.replication.audit import (
    annotators,
    consistency,
    fixed_point,
    fresh_ratings,
    negative_values,
    other_rewards,
    readings,
    rivals,
    sign_preservation,
    significance,
    table_2,
    table_3,
    table_4,
    theorem,
)
from uard.replication.audit.checks import Check, one_by_one

__all__ = ["SECTIONS", "Check", "one_by_one", "run"]


def _operator() -> list[Check]:
    return [check for part in (fixed_point, fresh_ratings, theorem, other_rewards) for check in part.checks()]


SECTIONS: dict[str, Callable[[], list[Check]]] = {
    "0": readings.checks,
    "a": table_3.checks,
    "a2": table_2.checks,
    "b": table_4.checks,
    "c": significance.checks,
    "d": annotators.checks,
    "e": negative_values.checks,
    "f": _operator,
    "g": sign_preservation.checks,
    "h": consistency.checks,
    "i": rivals.checks,
}


def run() -> list[Check]:
    """Do the whole audit; takes a few seconds."""
    return [check for section in SECTIONS.values() for check in section()]
