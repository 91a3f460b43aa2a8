"""The paper's tables (F2 to F5) and statistical tests (I1 to I3), number by number."""

from __future__ import annotations

from functools import partial
from typing import Any

from uard.lab import statistics
from uard.lab.views import published
from uard.lab.views.study_results import StudyResults
from uard.replication import deep, paper
from uard.replication.ledger.claim import Conditions, agrees
from uard.replication.paper import Stat
from uard.replication.verdicts import Numbers, Part, each

SIZES = tuple(f"{row.size}x{row.size}" for row in paper.TABLE_2)


def _agree(n: Numbers, setting: str, ours: str, printed: str) -> bool:
    return agrees(n[ours][setting], n[printed][setting])


def _scale(results: StudyResults) -> dict[str, Any]:
    def visits(agent: str) -> dict[str, Any]:
        return {
            name: results.get("scale", "hacks", agent=agent, size=row.size, panel="main")
            for name, row in zip(SIZES, paper.TABLE_2, strict=True)
        }

    return {
        "baseline": visits("baseline"),
        "ours": visits("uard-paper"),
        "printed_baseline": {name: row.baseline for name, row in zip(SIZES, paper.TABLE_2, strict=True)},
        "printed_ours": {name: row.uard for name, row in zip(SIZES, paper.TABLE_2, strict=True)},
    }


F2 = Conditions(
    (
        *each(
            "{}: the baseline's hits lie within the printed SD",
            SIZES,
            partial(_agree, ours="baseline", printed="printed_baseline"),
        ),
        *each("{}: UARD's hits lie within the printed SD", SIZES, partial(_agree, ours="ours", printed="printed_ours")),
    ),
    _scale,
)

METHODS = tuple(row.method for row in paper.TABLE_3)


def _per_episode(total: Stat) -> Stat:
    return Stat(total.mean / paper.LAST_EPISODES, total.sd / paper.LAST_EPISODES)


def _baselines(results: StudyResults) -> dict[str, Any] | None:
    p = published.packaged()
    rows = {r["agent"]: r for r in p.rows("deep-baselines", horizon=100, mitigation="raw")}
    if not set(deep.AGENT.values()) <= set(rows):
        return None

    def of(metric: str) -> dict[str, Any]:
        found = {method: p.of(rows[agent], metric) for method, agent in deep.AGENT.items()}
        return found | {"UARD": ours(metric, "uard-paper")}

    def ours(metric: str, agent: str) -> statistics.Summary:
        return results.get("table3", metric, agent=agent, horizon=100, panel="main")

    return {
        "visits": of("hacks"),
        "reward": of("observed_return"),
        "printed_visits": {row.method: _per_episode(row.visits) for row in paper.TABLE_3},
        "printed_reward": {row.method: row.reward for row in paper.TABLE_3},
        "tabular": ours("hacks", "baseline"),
        "walker": ours("hacks", "random walk"),
        "goal": ours("success_rate", "uard-paper").mean,
    }


F3 = Conditions(
    (
        *each(
            "{}: trap visits lie within the printed SD",
            METHODS,
            partial(_agree, ours="visits", printed="printed_visits"),
        ),
        *each(
            "{}: mean reward lies within the printed SD",
            METHODS,
            partial(_agree, ours="reward", printed="printed_reward"),
        ),
    ),
    _baselines,
)

_AGENTS = {"Baseline": "baseline", "Multi-Head": "multi-head", "UARD": "uard-paper"}
_COLUMNS = {
    "true return": ("true_return", "true_return"),
    "observed return": ("observed_return", "observed_return"),
    "trap visits": ("hacks", "visits"),
    "alignment gap": ("alignment_gap", "gap"),
}
PERFORMANCE = {
    f"{row.agent}, {column}": (_AGENTS[row.agent], metric, getattr(row, field))
    for row in paper.TABLE_4
    for column, (metric, field) in _COLUMNS.items()
    if getattr(row, field) is not None
}


def _performance(results: StudyResults) -> dict[str, Any]:
    return {
        "ours": {
            name: results.get("table4", metric, agent=agent, panel="appendix")
            for name, (agent, metric, _) in PERFORMANCE.items()
        },
        "printed": {name: stat for name, (_, _, stat) in PERFORMANCE.items()},
    }


F4 = Conditions(
    each("{} lies within the printed SD", PERFORMANCE, partial(_agree, ours="ours", printed="printed")), _performance
)

_VARIANTS = {
    "Baseline": {"variant": "Baseline Q-Learning"},
    "Ablation I": {"variant": "Ablation I"},
    "Ablation II": {"variant": "Ablation II"},
    "UARD-lite": {"variant": "No sigma_h (UARD-lite)", "reading": "uard-paper"},
    "Human-only": {"variant": "No sigma_m (Human-only)", "reading": "uard-paper"},
    "UARD": {"variant": "UARD (Full)", "reading": "uard-paper"},
}


def _ablation(results: StudyResults) -> dict[str, Any]:
    return {
        "ours": {name: results.get("table5", "hacks", **labels) for name, labels in _VARIANTS.items()},
        "printed": {row.variant: row.visits for row in paper.TABLE_5},
    }


F5 = Conditions(
    each("{}: trap hits lie within the printed SD", _VARIANTS, partial(_agree, ours="ours", printed="printed")),
    _ablation,
)


def _visits_test(results: StudyResults) -> dict[str, Any]:
    ours, base = (results.per_seed("table4", "hacks", agent=a, panel="appendix") for a in ("uard-paper", "baseline"))
    student, welch = statistics.student(base, ours), statistics.welch(base, ours)
    printed = {row.agent: row.visits for row in paper.TABLE_4}
    error = ((printed["Baseline"].sd ** 2 + printed["UARD"].sd ** 2) / paper.SEEDS) ** 0.5
    return {
        "t": student.t,
        "df": student.df,
        "p": student.p,
        "welch_t": welch.t,
        "welch_df": welch.df,
        "welch_p": welch.p,
        "from_table": (printed["Baseline"].mean - printed["UARD"].mean) / error,
        "printed": paper.TESTS["I1"].t,
    }


I1 = Conditions(
    (
        Part("the printed means and SDs give the printed t", lambda n: abs(n["from_table"] - n["printed"]) < 0.1),
        Part("the same test on our seeds has p < .001", lambda n: n["p"] < 0.001),
    ),
    _visits_test,
)


def _stability_test(results: StudyResults) -> dict[str, Any]:
    from scipy import stats

    ours, base = (
        results.per_seed("table4", "true_return", agent=a, panel="appendix") for a in ("uard-paper", "baseline")
    )
    test = statistics.welch(ours, base)
    return {
        "difference": test.difference,
        "t": test.t,
        "p": test.p,
        "ratio": float(ours.var(ddof=1) / base.var(ddof=1)),
        # two lie equally far from their median, so that nothing can be tested
        "levene": float(stats.levene(ours, base).pvalue) if len(ours) > 2 else 1.0,
    }


I2 = Conditions(
    (
        Part(
            "read as a test of means: the true return is higher, p < .01",
            lambda n: n["difference"] > 0 and n["p"] < 0.01,
        ),
        Part(
            "read as a test of spread: its variance over seeds is smaller, p < .01",
            lambda n: n["ratio"] < 1 and n["levene"] < 0.01,
        ),
    ),
    _stability_test,
)

NINE = ("dqn", "ensemble-dqn", "cql", "cpo", "trpo", "sac", "edac", "sunrise", "ppo")  # as the paper lists them
RIVALS = ("tabular Q-learning", *NINE)


def _pairwise(results: StudyResults) -> dict[str, Any] | None:
    p = published.packaged()
    deep_rows = {r["agent"]: r for r in p.rows("deep-baselines", horizon=100, mitigation="raw")}
    if not set(NINE) <= set(deep_rows):
        return None
    ours, tabular = (
        results.per_seed("table3", "hacks", agent=a, horizon=100, panel="main") for a in ("uard-paper", "baseline")
    )
    rivals = [tabular, *(p.per_seed(deep_rows[name], "hacks") for name in NINE)]
    tests = [statistics.welch(ours, rival) for rival in rivals]
    return {
        "difference": {name: test.difference for name, test in zip(RIVALS, tests, strict=True)},
        "p": dict(zip(RIVALS, statistics.bonferroni([t.p for t in tests]), strict=True)),
        "largest": max(statistics.holm([t.p for t in tests])),
    }


I3 = Conditions(
    each(
        "UARD makes fewer visits than {}, p < .001 after Bonferroni",
        RIVALS,
        lambda n, rival: n["difference"][rival] < 0 and n["p"][rival] < 0.001,
    ),
    _pairwise,
)

CONDITIONS = {"F2": F2, "F3": F3, "F4": F4, "F5": F5, "I1": I1, "I2": I2, "I3": I3}
