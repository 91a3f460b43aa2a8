"""What tabular agents do on the paper's grids (J15, J17-J20, J26-J30, L975, L1945)."""

from __future__ import annotations

from typing import Any

import numpy as np

from uard.lab import statistics
from uard.lab.statistics import Summary
from uard.lab.views.study_results import StudyResults
from uard.replication import paper
from uard.replication.ledger.claim import Conditions, above_zero, agrees, below_in, reduction
from uard.replication.ledger.tables import SIZES
from uard.replication.studies.grids import PANELS
from uard.replication.verdicts import Opinion, Part, each

MOST = 0.5  # an agent that reaches the goal in a larger share of episodes is said to reach it
FEW = 1.0  # the paper calls 0 ± 1 visits per episode near zero


def _size(name: str) -> int:
    return int(name.split("x")[0])


# --- visits, returns, gaps ---


def _mean_rating(results: StudyResults) -> dict[str, Any]:
    labels = {"mitigation": "mean-of-annotations", "size": 6, "trap": 4.0, "noise": 0.0}
    return {"visits": {p: results.get("matrix", "hacks", panel=p, **labels) for p in PANELS}}


J15 = Conditions(
    (
        Opinion("no update reads the true reward: a test of ours changes it alone, and nothing else changes", True),
        Opinion("the environment itself is left as it is", True),
        *each(
            "{} panel: the ratings do not hand over the true reward: who learns from their mean alone still hacks",
            PANELS,
            lambda n, panel: n["visits"][panel].mean > FEW,
        ),
    ),
    _mean_rating,
)


def _fall(results: StudyResults) -> dict[str, Any]:
    ours = {p: results.get("table4", "hacks", agent="uard-paper", panel=p) for p in PANELS}
    base = {p: results.get("table4", "hacks", agent="baseline", panel=p) for p in PANELS}
    return {
        "ours": ours,
        "reduction": {p: reduction(ours[p], base[p]) for p in PANELS},
        "printed": paper.PERCENT["visits-6x6"].value / 100,
    }


J17 = Conditions(
    each(
        "{} panel: visits fall by the printed share or more",
        PANELS,
        lambda n, panel: n["reduction"][panel] >= n["printed"],
    ),
    _fall,
)


def _reductions(results: StudyResults) -> dict[str, float]:
    return {
        name: reduction(
            *(
                results.get("scale", "hacks", agent=a, size=_size(name), panel="main")
                for a in ("uard-paper", "baseline")
            )
        )
        for name in SIZES
    }


def _falls(results: StudyResults) -> dict[str, Any]:
    printed = {name: paper.PERCENT[f"hits-{name}"].value / 100 for name in SIZES[1:]}
    return {"reduction": {name: _reductions(results)[name] for name in SIZES[1:]}, "printed": printed}


J18 = Conditions(
    each(
        "{}: hits fall by the printed share or more",
        SIZES[1:],
        lambda n, size: n["reduction"][size] >= n["printed"][size],
    ),
    _falls,
)


def _gap(results: StudyResults) -> dict[str, Any]:
    ours, base = (results.get("table4", "alignment_gap", agent=a, panel="appendix") for a in ("uard-paper", "baseline"))
    uard = next(row for row in paper.TABLE_4 if row.agent == "UARD")
    implied = abs(uard.observed_return.mean - uard.true_return.mean)
    return {
        "ours": ours,
        "baseline": base,
        "reduction": reduction(ours, base),
        "printed": paper.PERCENT["gap"].value / 100,
        "printed_gap": uard.gap,
        "implied": implied,
        "implied_reduction": 1 - implied / paper.TEXT["baseline gap"].value,
    }


J19 = Conditions(
    (
        Part("the gap falls by the printed share or more", lambda n: n["reduction"] >= n["printed"]),
        Part("UARD's gap lies within the printed SD", lambda n: agrees(n["ours"], n["printed_gap"])),
        Part(
            "the paper's own returns give the printed share, to a hundredth",
            lambda n: abs(n["implied_reduction"] - n["printed"]) < 0.01,
        ),
    ),
    _gap,
)


def _stability(results: StudyResults) -> dict[str, Any]:
    ours, base = (
        results.curves("table4", "true_return", agent=a, panel="main")[:, -paper.LAST_EPISODES :].std(1, ddof=1)
        for a in ("uard-paper", "baseline")
    )
    numbers: dict[str, Any] = paper.FIGURES["G8"].numbers
    return {
        "fall": statistics.summarise(100 * (1 - ours / base)),
        "printed": paper.PERCENT["stability"].value,
        "level": abs(numbers["UARD"]),
        "worst": abs(numbers["baseline"][0]),
    }


J20 = Conditions(
    (
        Part(
            "the true return varies less from episode to episode, by the printed share or more",
            lambda n: n["fall"].mean >= n["printed"],
        ),
    ),
    _stability,
)


# --- when, where, at what cost ---


def _turn(results: StudyResults) -> dict[str, Any]:
    def goals(first: int, last: int) -> dict[str, Summary]:
        return {p: results.window("table4", "success", first, last, agent="uard-paper", panel=p) for p in PANELS}

    repaired = np.convolve(
        results.curves("table4", "success", agent="uard", panel="main").mean(0), np.ones(10) / 10, "valid"
    )
    return {
        "before": goals(201, 300),
        "late": goals(401, 500),
        "first": int(np.argmax(repaired > MOST)) + 10 if (repaired > MOST).any() else None,
    }


J26 = Conditions(
    each(
        "{} panel: most of episodes 401-500 end at the goal, and few of episodes 201-300",
        PANELS,
        lambda n, panel: n["late"][panel].mean > MOST > n["before"][panel].mean,
    ),
    _turn,
)


def _settled(results: StudyResults) -> dict[str, Any]:
    def late(column: str) -> dict[str, Summary]:
        return {p: results.window("table4", column, 200, 500, agent="uard-paper", panel=p) for p in PANELS}

    printed = next(row.true_return for row in paper.TABLE_4 if row.agent == "UARD")
    return {"visits": late("hacks"), "true": late("true_return"), "printed": printed}


J27 = Conditions(
    (
        *each(
            "{} panel: from episode 200 on there is less than one visit per episode",
            PANELS,
            lambda n, panel: n["visits"][panel].mean < FEW,
        ),
        *each(
            "{} panel: from episode 200 on the true return lies within the printed SD of its level",
            PANELS,
            lambda n, panel: agrees(n["true"][panel], n["printed"]),
        ),
    ),
    _settled,
)


def _scaling(results: StudyResults) -> dict[str, Any]:
    def of(metric: str, agent: str) -> dict[str, Summary]:
        return {name: results.get("scale", metric, agent=agent, size=_size(name), panel="main") for name in SIZES}

    base, length = of("hacks", "baseline"), of("episode_length", "baseline")
    return {
        "reduction": _reductions(results),
        "smallest": min(paper.PERCENT[name].value for name in ("hits-8x8", "hits-10x10")) / 100,
        "baseline": base,
        "per_step": {name: base[name].mean / length[name].mean for name in SIZES},
        "goal": max(s.mean for s in of("success_rate", "uard-paper").values()),
    }


J28 = Conditions(
    (
        *each(
            "{}: UARD's hits are fewer than the baseline's by the smaller printed share or more",
            SIZES,
            lambda n, size: n["reduction"][size] >= n["smallest"],
        ),
        Part(
            "the baseline makes more visits per episode the larger the grid",
            lambda n: n["baseline"]["6x6"].mean < n["baseline"]["8x8"].mean < n["baseline"]["10x10"].mean,
        ),
        Part(
            "and not only because episodes are longer: its visits per step rise by a tenth",
            lambda n: n["per_step"]["10x10"] > n["per_step"]["6x6"] + 0.1,
        ),
    ),
    _scaling,
)


def _reward(results: StudyResults) -> dict[str, Any]:
    ours, walker, best = (
        results.get("table3", "observed_return", agent=a, horizon=100, panel="main")
        for a in ("uard-paper", "random walk", "uard")
    )
    return {"ours": ours, "walker": walker, "best": best, "printed": paper.TABLE_3[-1].reward}


J29 = Conditions(
    (
        Part("stable: it varies over seeds by the printed SD or less", lambda n: n["ours"].sd <= n["printed"].sd),
        Part("its level lies within the printed SD", lambda n: agrees(n["ours"], n["printed"])),
        Part("performance is maintained: it is above a random walker's", lambda n: n["ours"].mean > n["walker"].mean),
    ),
    _reward,
)

CELLS = {f"{size}, {panel} panel": (_size(size), panel) for size in SIZES for panel in PANELS}


def _competence(results: StudyResults) -> dict[str, Any]:
    def goals(agent: str) -> dict[str, Summary]:
        return {
            name: results.get("scale", "success_rate", agent=agent, size=size, panel=panel)
            for name, (size, panel) in CELLS.items()
        }

    def true(agent: str) -> dict[str, Summary]:
        return {p: results.get("table4", "true_return", agent=agent, panel=p) for p in PANELS}

    return {
        "goal": goals("uard-paper"),
        "repaired": min(s.mean for s in goals("uard").values()),
        "true": true("uard-paper"),
        "baseline": true("baseline"),
    }


J30 = Conditions(
    (
        *each("{}: most episodes end at the goal", CELLS, lambda n, cell: n["goal"][cell].mean > MOST),
        *each(
            "6x6, {} panel: its true return is no lower than the baseline's",
            PANELS,
            lambda n, panel: n["true"][panel].mean >= n["baseline"][panel].mean,
        ),
    ),
    _competence,
)


def _complexity(results: StudyResults) -> dict[str, Any]:
    def of(metric: str, size: str) -> np.ndarray:
        return results.per_seed("scale", metric, agent="uard-paper", size=_size(size), panel="main")

    return {
        "visits": {name: statistics.summarise(of("hacks", name)) for name in SIZES},
        "per_step": {name: statistics.summarise(of("hacks", name) / of("episode_length", name)) for name in SIZES},
        "reduction": _reductions(results),
        "printed": {f"{row.size}x{row.size}": row.uard for row in paper.TABLE_2},
    }


L975 = Conditions(
    (
        *each(
            "{}: UARD makes more visits per episode than on 6x6 (paired, Holm)",
            SIZES[1:],
            lambda n, size: below_in({s: n["visits"]["6x6"] for s in SIZES[1:]}, n["visits"], size),
        ),
        *each(
            "{}: and not only because episodes are longer: more visits per step, too (paired, Holm)",
            SIZES[1:],
            lambda n, size: below_in({s: n["per_step"]["6x6"] for s in SIZES[1:]}, n["per_step"], size),
        ),
        *each(
            "{}: relative to the baseline the reduction remains substantial: half or more",
            SIZES[1:],
            lambda n, size: n["reduction"][size] >= 0.5,
        ),
    ),
    _complexity,
)


def _fluctuation(results: StudyResults) -> dict[str, Any]:
    curves = {a: results.curves("table4", "true_return", agent=a, panel="main") for a in ("baseline", "multi-head")}
    goals = results.curves("table4", "success", agent="baseline", panel="main")
    late = {a: c[:, -paper.LAST_EPISODES :].std(1, ddof=1) for a, c in curves.items()}
    numbers: dict[str, Any] = paper.FIGURES["G8"].numbers
    return {
        "lowest": float(curves["baseline"].min()),
        "highest": float(curves["baseline"].max()),
        "lowest_heads": float(curves["multi-head"].min()),
        "goals": statistics.summarise(goals.mean(1)),
        "late_goals": float(goals[:, -paper.LAST_EPISODES :].mean()),
        "steadier": statistics.summarise(late["baseline"] - late["multi-head"]),
        "printed": numbers["baseline"][0],
        "printed_high": numbers["baseline"][1],
        "printed_heads": numbers["multi-head lowest"],
    }


L1945 = Conditions(
    (
        Part("the baseline's worst episode of all seeds is as low as printed", lambda n: n["lowest"] <= n["printed"]),
        Part(
            "its best episode of all seeds is no higher than printed",
            lambda n: n["highest"] <= n["printed_high"],
        ),
        Part(
            "it reaches the goal occasionally: in some of its episodes, and in fewer than half",
            lambda n: 0 < n["goals"].mean < MOST,
        ),
        Part(
            "the multi-head agent is more stable: the SD of its true return over the last hundred episodes is lower "
            "(interval of the difference above 0)",
            lambda n: above_zero(n["steadier"]),
        ),
        Part(
            "and prone to drops: its worst episode is as low as printed",
            lambda n: n["lowest_heads"] <= n["printed_heads"],
        ),
    ),
    _fluctuation,
)

CONDITIONS = {
    "J15": J15,
    "J17": J17,
    "J18": J18,
    "J19": J19,
    "J20": J20,
    "J26": J26,
    "J27": J27,
    "J28": J28,
    "J29": J29,
    "J30": J30,
    "L975": L975,
    "L1945": L1945,
}
