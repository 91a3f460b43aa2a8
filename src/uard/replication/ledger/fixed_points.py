"""The operator T_lambda and its fixed points, computed exactly (J5-J9)."""

from __future__ import annotations

from typing import Any

from uard.lab.views.study_results import StudyResults
from uard.replication import paper, theory
from uard.replication.ledger.claim import Conditions
from uard.replication.ledger.tables import SIZES
from uard.replication.studies.grids import PANELS
from uard.replication.verdicts import Numbers, Opinion, Part, each

SAME = 1e-6  # fixed points that differ by less are one


def _contraction(results: StudyResults) -> dict[str, Any]:
    return {"frozen": theory.contraction(), "live": theory.live_expansion(), "gamma": paper.GAMMA}


J5 = Conditions(
    (
        Part("weights frozen: two tables come closer by gamma or more", lambda n: n["frozen"] <= n["gamma"] + 1e-9),
        Part(
            "weights that follow sigma_m(Q): two ensembles come closer by gamma or more",
            lambda n: n["live"] <= n["gamma"] + 1e-9,
        ),
    ),
    _contraction,
)


def _unique(results: StudyResults) -> dict[str, Any]:
    return {"frozen": theory.fixed_point_spread(), "live": theory.live_fixed_point_spread()}


J6 = Conditions(
    (
        Part("weights frozen: all starts lead to the same values", lambda n: n["frozen"] < SAME),
        Part("weights that follow sigma_m(Q): all starts lead to the same values", lambda n: n["live"] < SAME),
    ),
    _unique,
)

CASES = tuple(
    f"{size}, trap +{trap:g}, {raters}"
    for size in SIZES
    for trap in (paper.TRAP_REWARD, paper.HARD_TRAP_REWARD)
    for raters in theory.RATERS
)


def _hacking(results: StudyResults) -> dict[str, Any]:
    found = {f"{t.size}x{t.size}, trap +{t.trap:g}, {t.panel}": t.critical for t in theory.critical_lambdas()}
    stopping = [x for x in found.values() if x is not None]
    return {
        "critical": found,
        "lam": paper.LAMBDA,
        "lowest": min(stopping),
        "without": len(found) - len(stopping),
        "cases": len(found),
    }


def _stops(n: Numbers, case: str) -> bool:
    return n["critical"][case] is not None and n["critical"][case] <= n["lam"]


J7 = Conditions(each("{}: at lambda = 2 the fixed point does not hack", CASES, _stops), _hacking)


def _trade(results: StudyResults) -> dict[str, Any]:
    bias = theory.bias()

    def sd(agent: str) -> dict[str, float]:
        return {p: results.get("table4", "true_return", agent=agent, panel=p).sd for p in PANELS}

    return {
        "honest": bias.honest,
        "filtered": bias.filtered,
        "raw": bias.raw,
        "sd": sd("uard-paper"),
        "sd_baseline": sd("baseline"),
    }


J8 = Conditions(
    (
        Part(
            "where the reward is true the filter adds bias: it moves the fixed point off Q*",
            lambda n: n["honest"] > SAME,
        ),
        Part(
            "where the reward lies the filter adds bias: its fixed point is farther from Q* than the raw one",
            lambda n: n["filtered"] > n["raw"],
        ),
        *each(
            "{} panel: where the reward lies the true return varies less between seeds than the baseline's",
            PANELS,
            lambda n, panel: n["sd"][panel] < n["sd_baseline"][panel],
        ),
        Opinion("the text defines alpha_m and alpha_h, which are said to control the trade-off", False),
    ),
    _trade,
)


def _pessimism(results: StudyResults) -> dict[str, Any]:
    hazard = theory.hazard()
    weight = theory.weight_at_trap()
    return {
        "gain": paper.TRAP_REWARD,
        "gain_felt": paper.TRAP_REWARD * weight,
        "loss": hazard.reward,
        "loss_felt": hazard.reward * weight,
        "lam": hazard.lam,
        "enters_without": hazard.enters_without,
        "enters_with": hazard.enters_with,
    }


J9 = Conditions(
    (
        Part("a contested gain counts for less", lambda n: n["gain_felt"] < n["gain"]),
        Part("a contested loss counts for no less", lambda n: n["loss_felt"] <= n["loss"]),
        Part(
            "a contested hazard that is avoided without the filter is avoided with it",
            lambda n: not n["enters_with"] or n["enters_without"],
        ),
    ),
    _pessimism,
)

CONDITIONS = {"J5": J5, "J6": J6, "J7": J7, "J8": J8, "J9": J9}
