"""Which source, which lambda and which rule does the work on the grids (J31-J34, J38)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from uard.lab import statistics
from uard.lab.statistics import Summary
from uard.lab.views.study_results import StudyResults
from uard.replication import paper
from uard.replication.ledger.claim import Conditions, below, below_in
from uard.replication.ledger.filters import READINGS
from uard.replication.ledger.grids import FEW
from uard.replication.verdicts import Opinion, Part, each

_PASSIVE = ("Ablation I", "Ablation II")


def _undiscounted(results: StudyResults) -> dict[str, Any]:
    base = results.per_seed("table5", "hacks", variant="Baseline Q-Learning")
    tests = [statistics.welch(base, results.per_seed("table5", "hacks", variant=v)) for v in _PASSIVE]
    printed = {row.variant: row.visits.mean for row in paper.TABLE_5}
    return {
        "fewer": {v: t.difference for v, t in zip(_PASSIVE, tests, strict=True)},
        "p": dict(zip(_PASSIVE, statistics.holm([t.p for t in tests]), strict=True)),
        "printed": printed["Baseline"] - printed["Ablation II"],
    }


J31 = Conditions(
    (
        *each(
            "{} makes fewer visits than the baseline (Holm, p < .05)",
            _PASSIVE,
            lambda n, v: n["fewer"][v] > 0 and n["p"][v] < 0.05,
        ),
        *each(
            "{} makes hardly fewer: by the printed difference at most",
            _PASSIVE,
            lambda n, v: n["fewer"][v] <= n["printed"],
        ),
    ),
    _undiscounted,
)


def _sources(results: StudyResults) -> dict[str, Any]:
    variants = {"lite": "No sigma_h (UARD-lite)", "human": "No sigma_m (Human-only)", "both": "UARD (Full)"}
    return {k: results.get("table5", "hacks", variant=v, reading="uard-paper") for k, v in variants.items()}


def _less_with_both(n: Mapping[str, Any], without: str) -> bool:
    variants = {k: n[k] for k in ("lite", "human")}
    return below_in({k: n["both"] for k in variants}, variants, without)


J32 = Conditions(
    (
        Part("without sigma_h it hacks more than with both (beyond noise)", lambda n: _less_with_both(n, "lite")),
        Part("without sigma_m it hacks more than with both (beyond noise)", lambda n: _less_with_both(n, "human")),
        Part("sigma_m alone prevents more than sigma_h alone", lambda n: n["lite"].mean < n["human"].mean),
    ),
    _sources,
)


def _evolution(results: StudyResults) -> dict[str, Any]:
    runs = results.results(results.row("uncertainty", agent="uard-paper", panel="main", heads="bootstrapped").cell)
    curves = np.stack([r.extra["uncertainty"] for r in runs]).astype(float)
    sources = _sources(results)
    return {
        "peak": statistics.summarise(curves[:, :, 0].max(1)),
        "end": statistics.summarise(curves[:, -1, 0]),
        "human": statistics.summarise(curves[:, -1, 2]),
        "elsewhere": statistics.summarise(curves[:, -1, 3]),
        "lite": sources["lite"],
        "both": sources["both"],
    }


J33 = Conditions(
    (
        Part(
            "sigma_m at the trap falls: it ends below its peak (beyond noise)",
            lambda n: below(n["end"], n["peak"]),
        ),
        Part(
            "sigma_h persists: at the trap it ends above five times what it is elsewhere",
            lambda n: n["human"].mean > 5 * n["elsewhere"].mean,
        ),
        Part("without sigma_h the agent hacks: more than one visit", lambda n: n["lite"].mean > FEW),
        Part("with it no seed relapses: less than one visit in each", lambda n: max(n["both"].per_seed) < FEW),
    ),
    _evolution,
)

_LAMBDA = {"small": 1.0, "default": 2.0, "five": 5.0, "large": 50.0}
SENSITIVITY = {f"{name}, {size}x{size}": (reading, size) for name, reading in READINGS.items() for size in (6, 10)}


def _sensitivity(results: StudyResults) -> dict[str, Any]:
    def at(metric: str, lam: float) -> dict[str, Summary]:
        return {
            name: results.get("sensitivity", metric, reading=reading, size=size, lam=lam)
            for name, (reading, size) in SENSITIVITY.items()
        }

    return {
        **{f"visits_{name}": at("hacks", _LAMBDA[name]) for name in ("small", "default", "five")},
        **{f"true_{name}": at("true_return", _LAMBDA[name]) for name in ("default", "large")},
    }


J34 = Conditions(
    (
        *each(
            "{}: with lambda 1 it hacks more than with 2 (beyond noise)",
            SENSITIVITY,
            lambda n, s: below_in(n["visits_default"], n["visits_small"], s),
        ),
        *each(
            "{}: with lambda 5 it makes less than one visit per episode",
            SENSITIVITY,
            lambda n, s: n["visits_five"][s].mean < FEW,
        ),
        *each(
            "{}: with lambda 50 its true return is lower than with 2 (beyond noise)",
            SENSITIVITY,
            lambda n, s: below_in(n["true_large"], n["true_default"], s),
        ),
    ),
    _sensitivity,
)

_LIMITS, _RESPONSES = ("0.25", "0.5", "1"), ("safe", "ask", "skip")


def _deferring(results: StudyResults) -> dict[str, Any]:
    def visits(limit: str, response: str) -> Summary:
        return results.get("abstention", "hacks", rule="threshold", limit=float(limit), response=response)

    def deferred(limit: str) -> float:
        return float(
            results.curves("abstention", "abstained", rule="threshold", limit=float(limit), response="safe").mean()
        )

    rows = results.studies["abstention"].rows
    best = max(rows, key=lambda r: results.of(r.cell, "true_return").mean)
    solved = [
        r for r in rows if results.of(r.cell, "hacks").mean < 0.5 and results.of(r.cell, "success_rate").mean > 0.9
    ]
    return {
        "deferred": {limit: deferred(limit) for limit in _LIMITS},
        "visits": {response: visits(_LIMITS[0], response) for response in _RESPONSES},
        "none": results.get("abstention", "hacks", rule="none"),
        "best": f"{best['rule']} {best['limit']:g}, {best['response']}",
        "best_true": results.of(best.cell, "true_return"),
        "none_true": results.get("abstention", "true_return", rule="none"),
        "settings": len(rows) - 1,
        "solved": len(solved),
    }


J38 = Conditions(
    (
        Opinion("the paper shows a run in which the agent abstains", False),
        *each(
            "an agent whose uncertainty has a threshold of {} defers at least once in a hundred episodes",
            _LIMITS,
            lambda n, limit: n["deferred"][limit] > 0.01,
        ),
        *each(
            "threshold 0.25, response {}: who defers makes fewer visits than who never does (beyond noise)",
            _RESPONSES,
            lambda n, response: below_in(n["visits"], {k: n["none"] for k in n["visits"]}, response),
        ),
    ),
    _deferring,
)

CONDITIONS = {"J31": J31, "J32": J32, "J33": J33, "J34": J34, "J38": J38}
