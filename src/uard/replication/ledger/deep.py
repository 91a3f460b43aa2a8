"""The deep baselines: which of them the paper reports, and what an ensemble costs (J24, J37)."""

from __future__ import annotations

from typing import Any

from uard.lab.views import published
from uard.lab.views.study_results import StudyResults
from uard.replication import paper
from uard.replication.ledger.claim import Conditions
from uard.replication.ledger.tables import NINE
from uard.replication.verdicts import each


def _reported(results: StudyResults) -> dict[str, Any]:
    rows = published.packaged().rows("deep-baselines", mitigation="raw")
    return {
        "reported": {name: len(where) for name, where in paper.BASELINES.items()},
        "tabled": sum(any(place.startswith("F") for place in where) for where in paper.BASELINES.values()),
        "ran": len({r["agent"] for r in rows} & set(NINE)),
    }


J24 = Conditions(
    each("{} is in a table or figure of results", paper.BASELINES, lambda n, name: n["reported"][name] > 0), _reported
)

_KINDS = ("5 full networks", "5 heads, shared trunk")


def _cost(results: StudyResults) -> dict[str, Any] | None:
    speed = published.packaged_json("speed.json")
    if speed is None:
        return None
    measured = {row["name"]: row["cost_of_single"] for row in speed["rows"]}
    return {
        "cost": {kind: measured[kind] for kind in _KINDS},
        "low": paper.TEXT["overhead low"].value,
        "high": paper.TEXT["overhead high"].value,
    }


J37 = Conditions(
    each("{} cost 2 to 3 times a single network", _KINDS, lambda n, kind: n["low"] <= n["cost"][kind] <= n["high"]),
    _cost,
)

CONDITIONS = {"J24": J24, "J37": J37}
