"""A reward that lies to trained agents: adjusted rewards, adaptive lambda, signs of advantages (J22, J23, J39-J41, J44).

The paper defines neither the distortion nor its measures: those of the grid are in ``uard.replication.distortion``,
those of Hopper in ``uard.lab.trainers.examine``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from uard.lab import statistics
from uard.lab.statistics import Summary
from uard.lab.study import Row
from uard.lab.trainers import examine
from uard.lab.views import published
from uard.lab.views.study_results import StudyResults
from uard.method.stability import DEFINITIONS
from uard.replication import locomotion, paper, theory
from uard.replication.ledger.claim import Conditions
from uard.replication.ledger.grids import FEW
from uard.replication.studies.grids import PANELS
from uard.replication.verdicts import Numbers, Part, each

GRID = "deep-distortion"
UARDS = {  # on Hopper: agent and critics
    "SAC, shared trunk": ("uard-0.1", "5, shared trunk"),
    "SAC, full critics": ("uard-0.1", "5, full"),
    "PPO": ("uard-0.1 (ppo)", "5, shared trunk"),
}
RIVALS = {"EDAC": ("edac", "5, full"), "SUNRISE": ("sunrise", "5, shared trunk")}


def _on_grid() -> dict[str, Row] | None:
    """Return the rows of the grid's study by agent; None if they are not all published."""
    rows = {r["agent"]: r for r in published.packaged().rows(GRID)}
    return rows if set(rows) == {"uard-0.1", "edac", "sunrise"} else None


def _on_hopper() -> dict[str, Row] | None:
    """Return the rows of Hopper's study by the names above; None if they are not all published."""
    rows = {(r["agent"], r["critics"]): r for r in published.packaged().rows(locomotion.DISTORTION)}
    named = UARDS | RIVALS
    return {name: rows[key] for name, key in named.items()} if set(named.values()) <= set(rows) else None


def _derived(row: Row, name: str) -> Summary:
    return statistics.summarise(published.packaged().derived(row, name))


def _reaction(row: Row, name: str) -> Summary:
    columns = published.packaged().derived(row, "reaction")
    return statistics.summarise(columns[:, examine.REACTION.index(name)])


# --- exploit activations and adjusted rewards ---


def _activations(results: StudyResults) -> dict[str, Any] | None:
    grid, hopper = _on_grid(), _on_hopper()
    if grid is None or hopper is None:
        return None
    return {
        "grid_ours": _derived(grid["uard-0.1"], "activations"),
        "grid_edac": _derived(grid["edac"], "activations"),
        "hopper_ours": {name: _reaction(hopper[name], "activations") for name in UARDS},
        "hopper_edac": _reaction(hopper["EDAC"], "activations"),
        "cut": paper.PERCENT["exploits"].value / 100,
    }


J22 = Conditions(
    (
        Part(
            "grid: UARD has fewer activations than EDAC, by the printed share or more",
            lambda n: n["grid_ours"].mean < (1 - n["cut"]) * n["grid_edac"].mean,
        ),
        *each(
            "Hopper, UARD in {}: fewer activations than EDAC, by the printed share or more",
            UARDS,
            lambda n, name: n["hopper_ours"][name].mean < (1 - n["cut"]) * n["hopper_edac"].mean,
        ),
    ),
    _activations,
)


def _believed(rival: str) -> dict[str, Any] | None:
    """Return the largest adjusted reward on the grid, and what of the lie is believed on Hopper, in reward units."""
    grid, hopper = _on_grid(), _on_hopper()
    if grid is None or hopper is None:
        return None
    return {
        "grid_ours": _derived(grid["uard-0.1"], "largest").mean,
        "grid_rival": _derived(grid[rival.lower()], "largest").mean,
        "hopper_ours": {name: examine.BONUS * _reaction(hopper[name], "believed").mean for name in UARDS},
        "hopper_rival": examine.BONUS * _reaction(hopper[rival], "believed").mean,
    }


def _times(ours: float, rival: float, ratio: float) -> bool | None:
    """Whether the rival's is more than a multiple of ours; None where ours is no positive number to take it of."""
    return rival > ratio * ours if ours > 0 else None


def _against_sunrise(results: StudyResults) -> dict[str, Any] | None:
    found, numbers = _believed("SUNRISE"), dict[str, Any](paper.FIGURES["G15"].numbers)
    return None if found is None else found | {"ratio": numbers["ratio above"]}


J23 = Conditions(
    (
        Part(
            "grid: SUNRISE's largest adjusted reward is more than the printed multiple of UARD's, a positive number",
            lambda n: _times(n["grid_ours"], n["grid_rival"], n["ratio"]),
        ),
        *each(
            "Hopper, UARD in {}: SUNRISE believes more than the printed multiple of what UARD believes",
            UARDS,
            lambda n, name: _times(n["hopper_ours"][name], n["hopper_rival"], n["ratio"]),
        ),
    ),
    _against_sunrise,
)


def _against_edac(results: StudyResults) -> dict[str, Any] | None:
    found, numbers = _believed("EDAC"), dict[str, Any](paper.FIGURES["G14"].numbers)
    return None if found is None else found | {"gap": numbers["gap above"], "level": numbers["UARD below"]}


J44 = Conditions(
    (
        Part(
            "grid: EDAC's largest adjusted reward exceeds UARD's by more than the printed gap",
            lambda n: n["grid_rival"] - n["grid_ours"] > n["gap"],
        ),
        Part("grid: UARD's largest adjusted reward is below the printed level", lambda n: n["grid_ours"] < n["level"]),
        *each(
            "Hopper, UARD in {}: EDAC believes more of the lie, by more than the printed gap",
            UARDS,
            lambda n, name: n["hopper_rival"] - n["hopper_ours"][name] > n["gap"],
        ),
        *each(
            "Hopper, UARD in {}: what it believes of the lie is below the printed level",
            UARDS,
            lambda n, name: n["hopper_ours"][name] < n["level"],
        ),
    ),
    _against_edac,
)

# --- adaptive against static pessimism ---

STATIC = {  # study and labels of pessimism whose strength is a constant
    "uard-0.1 with constant lambda 0.2": ("settings", {"variant": "kappa 0 (not adaptive)"}),
    "uard-0.1 with constant lambda 2": ("settings", {"variant": "lam 2, kappa 0"}),
    "UARD as printed": ("matrix", {"mitigation": "uard-paper"}),
    "UARD with a consistent backup": ("matrix", {"mitigation": "uard-consistent"}),
    "screening of contested steps": ("matrix", {"mitigation": "screening"}),
    "mean less deviation of the ratings": ("matrix", {"mitigation": "lcb"}),
    "the lowest rating": ("matrix", {"mitigation": "worst-of-annotations"}),
}
ADAPTIVE = ("settings", {"variant": "as recommended"})


def _settings(results: StudyResults, study: str, labels: dict[str, Any]) -> list[Row]:
    """Return a mitigation's rows on 10x10: both panels, +4 and +8, noise 0 and 1.2."""
    return [
        r
        for r in results.studies[study].where(**labels)
        if r["panel"] in PANELS and r["noise"] in (0.0, 1.2) and dict(r.labels).get("size", 10) == 10
    ]


def _solved(results: StudyResults, study: str, labels: dict[str, Any]) -> int:
    """Return in how many settings there is less than one visit, and the goal in nine of ten episodes."""
    rows = _settings(results, study, labels)
    return sum(results.of(r.cell, "hacks").mean < FEW and results.of(r.cell, "success_rate").mean >= 0.9 for r in rows)


def _trace(row: Row) -> dict[str, np.ndarray]:
    """Return the published walk of a row's first seed by column."""
    return dict(zip(examine.TRACE, published.packaged().derived(row, "trace"), strict=False))


def _caution(row: Row) -> float:
    """Return how much more of the lie a static pessimist believes than UARD on the same steps: the windows' median."""
    walk = _trace(row)
    return float(np.median((walk["caution"] - walk["adjusted"])[examine.inside()]))


def _adaptation(results: StudyResults) -> dict[str, Any] | None:
    grid, hopper = _on_grid(), _on_hopper()
    if grid is None or hopper is None:
        return None
    rows = {"grid": grid["uard-0.1"]} | {f"Hopper, {name}": hopper[name] for name in UARDS}
    walks, here = {name: _trace(row) for name, row in rows.items()}, examine.inside()
    lowest = _settings(results, *STATIC["the lowest rating"])
    return {
        "inside": {name: float(walk["lam"][here].mean()) for name, walk in walks.items()},
        "outside": {name: float(walk["lam"][~here].mean()) for name, walk in walks.items()},
        "caution": {name: _caution(row) for name, row in rows.items()},
        "settings": len(_settings(results, *ADAPTIVE)),
        "solved": _solved(results, *ADAPTIVE),
        "static_solved": {name: _solved(results, *where) for name, where in STATIC.items()},
        "lowest_visits": max(results.of(r.cell, "hacks").mean for r in lowest),
        "lowest_goal": min(results.of(r.cell, "success_rate").mean for r in lowest),
    }


_PLACES = ("grid", *(f"Hopper, {name}" for name in UARDS))
J39 = Conditions(
    (
        *each(
            "{}: lambda_t is larger in the Hacking Region than outside",
            _PLACES,
            lambda n, where: n["inside"][where] > n["outside"][where],
        ),
        *each(
            "{}: in the Hacking Region static pessimism (mean less deviation) believes more of the lie than uard-0.1",
            _PLACES,
            lambda n, where: n["caution"][where] > 0,
        ),
        Part("adaptive discounting is enough: it solves every grid setting", lambda n: n["solved"] == n["settings"]),
        *each(
            "static pessimism is not enough: {} does not solve every grid setting",
            STATIC,
            lambda n, name: n["static_solved"][name] < n["settings"],
        ),
    ),
    _adaptation,
)

# --- sign preservation ---


def _signs(results: StudyResults) -> dict[str, Any] | None:
    hopper, p = _on_hopper(), published.packaged()
    if hopper is None:
        return None
    radii = {r.definition: r for r in theory.radii()}

    def kept(name: str, column: str) -> float:
        shares = p.derived(hopper[name], "perturbed").reshape(-1, len(examine.PERTURBED))
        return float(shares[:, examine.PERTURBED.index(column)].mean())

    return {
        "raw": {d: radii[d].raw for d in DEFINITIONS},
        "filtered": {d: radii[d].filtered for d in DEFINITIONS},
        "kept_raw": {name: kept(name, "sign_kept_raw") for name in UARDS},
        "kept_filtered": {name: kept(name, "sign_kept_filtered") for name in UARDS},
    }


def _larger(n: Numbers, setting: str, more: str, less: str) -> bool:
    return n[more][setting] > n[less][setting] + 1e-9


J40 = Conditions(
    (
        *each(
            "perturbation '{}': the filtered agent's radius is larger than the raw one's",
            DEFINITIONS,
            lambda n, d: _larger(n, d, "filtered", "raw"),
        ),
        *each(
            "Hopper, {}: the filtered advantage keeps its sign more often than the raw one",
            UARDS,
            lambda n, name: _larger(n, name, "kept_filtered", "kept_raw"),
        ),
    ),
    _signs,
)
J41 = Conditions(
    (
        *each(
            "perturbation '{}': the raw agent's radius is larger than the filtered one's",
            DEFINITIONS,
            lambda n, d: _larger(n, d, "raw", "filtered"),
        ),
        *each(
            "Hopper, {}: the raw advantage keeps its sign more often than the filtered one",
            UARDS,
            lambda n, name: _larger(n, name, "kept_raw", "kept_filtered"),
        ),
    ),
    _signs,
)

CONDITIONS = {"J22": J22, "J23": J23, "J39": J39, "J40": J40, "J41": J41, "J44": J44}
