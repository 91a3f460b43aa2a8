"""The paper's tables beside ours, what a reader must see first, and Theorem 1 measured."""

from __future__ import annotations

from uard.lab.views.study_results import StudyResults
from uard.lab.views.tables import Cell, Number, Table
from uard.replication import paper, theory


def headline(results: StudyResults) -> Table:
    """Return the four agents on 10x10 at the paper's T = 80, both panels: what a reader must see first."""
    rows: list[tuple[Cell, ...]] = []
    for agent in ("baseline", "random walk", "uard-paper", "uard-consistent", "uard-0.1", "uard"):
        for panel in ("main", "appendix"):
            alone = agent in ("baseline", "random walk")
            if alone and panel == "appendix":
                continue
            metrics = ("hacks", "success_rate", "true_return")
            got = (results.get("scale", m, agent=agent, size=10, panel=panel) for m in metrics)
            rows.append((agent, "–" if alone else panel, *got))
    columns = ("agent", "panel", "trap visits per episode", "goal rate", "true return")
    return Table("10x10 grid, three traps of +4, T = 80", columns, tuple(rows), 2, "Mean [95 % interval] over seeds.")


def fewer(results: StudyResults) -> dict[str, float]:
    """Return by how many percent each agent visits traps less often than the baseline: Table 3, 10x10, T = 100."""
    labels = {"horizon": 100, "panel": "main"}
    base = results.get("table3", "hacks", agent="baseline", **labels).mean
    agents = ("uard-paper", "random walk", "uard")
    return {a: 100 * (1 - results.get("table3", "hacks", agent=a, **labels).mean / base) for a in agents}


def tables(results: StudyResults) -> list[Table]:
    """Return the paper's tables 2 to 5 beside ours."""
    return [_table2(results), _table3(results), _table4(results), _table5(results)]


def _stat(s: paper.Stat | None) -> str:
    return "–" if s is None else f"{s.mean:g} ± {s.sd:g}"


def _table2(results: StudyResults) -> Table:
    rows = []
    for p in paper.TABLE_2:
        ours = [
            results.get("scale", "hacks", agent=a, size=p.size, panel="main")
            for a in ("uard-paper", "uard", "baseline")
        ]
        rows.append((f"{p.size}x{p.size}", _stat(p.uard), ours[0], ours[1], _stat(p.baseline), ours[2]))
    return Table(
        "Table 2 (F2): trap visits by grid",
        ("grid", "paper: UARD", "ours: uard-paper", "ours: uard", "paper: baseline", "ours: baseline"),
        tuple(rows),
        1,
        "Ours per episode, main panel, T = 40/60/80. The paper's first row is per episode, its others exceed what an episode has room for.",
    )


def _table3(results: StudyResults) -> Table:
    rows: list[tuple[Cell, ...]] = [
        (p.method, "paper", _stat(p.reward), _stat(p.visits), None, None, p.reduction) for p in paper.TABLE_3
    ]
    for t in (100, 80):
        base = results.get("table3", "hacks", agent="baseline", horizon=t, panel="main")
        for agent in ("baseline", "uard-paper", "uard-consistent", "uard-0.1", "uard", "random walk"):
            r = results.row("table3", agent=agent, horizon=t, panel="main")
            v, o, g, true = (results.of(r.cell, m) for m in ("hacks", "observed_return", "success_rate", "true_return"))
            cut = 100 * (1 - v.mean / base.mean)
            total = Number.of_summary(v, scale=paper.LAST_EPISODES)
            rows.append((agent, f"ours, T = {t}", o, total, g, true, cut))
    return Table(
        "Table 3 (F3): 10x10, last 100 episodes",
        ("method", "source", "mean reward", "trap visits (total)", "goal rate", "true return", "reduction, %"),
        tuple(rows),
        2,
        "Our baseline here is tabular Q-learning, main panel; deep ones stand in a section of their own. Note the random walk.",
    )


def _table4(results: StudyResults) -> Table:
    names = {"Baseline": "baseline", "Multi-Head": "multi-head", "UARD": "uard-paper"}
    rows: list[tuple[Cell, ...]] = []
    for p in paper.TABLE_4:
        rows.append(
            (p.agent, "paper", _stat(p.true_return), _stat(p.observed_return), _stat(p.visits), _stat(p.gap), None)
        )
        for panel in ("main", "appendix"):
            rows.append(_row4(results, names[p.agent], panel))
    for panel in ("main", "appendix"):
        rows += [_row4(results, agent, panel) for agent in ("uard-consistent", "uard-0.1", "uard")]
    return Table(
        "Table 4 (F4): 6x6",
        ("agent", "source", "true return", "observed return", "trap visits", "alignment gap", "goal rate"),
        tuple(rows),
        2,
        "The paper's 'episode 500'; ours are the last 100 episodes. The gap is |observed - true| per episode.",
    )


def _row4(results: StudyResults, agent: str, panel: str) -> tuple[Cell, ...]:
    r = results.row("table4", agent=agent, panel=panel)
    metrics = ("true_return", "observed_return", "hacks", "alignment_gap", "success_rate")
    return (agent, f"ours, {panel}", *(results.of(r.cell, m) for m in metrics))


def _table5(results: StudyResults) -> Table:
    rows = []
    variant = {
        "Baseline": "Baseline Q-Learning",
        "UARD-lite": "No sigma_h (UARD-lite)",
        "Human-only": "No sigma_m (Human-only)",
        "UARD": "UARD (Full)",
    }
    readings = {
        "uard-paper": "as printed (acts on J)",
        "uard-consistent": "consistent backup",
        "uard-operator": "T_lambda (on the reward)",
        "uard-0.1": "ours (uard-0.1)",
    }
    for p in paper.TABLE_5:
        name = variant.get(p.variant, p.variant)
        found = [
            next(iter(results.studies["table5"].where(variant=name, reading=reading if p.discounting else "-"))).cell
            for reading in readings
        ]
        visits, goals = ([results.of(cell, m) for cell in found] for m in ("hacks", "success_rate"))
        rows.append((p.variant, _stat(p.visits), *(x for pair in zip(visits, goals, strict=True) for x in pair)))
    heads = (f"{what}: {label}" for label in readings.values() for what in ("visits", "goal rate"))
    return Table(
        "Table 5 (F5): which component does the work",
        ("variant", "paper: visits", *heads),
        tuple(rows),
        1,
        "Trap visits per episode and share of episodes that reach the goal, 6x6, main panel, heads bootstrapped with "
        "probability 0.5. Without sigma_h no reading of the paper works. Ours then still has its anchor and lambda_t, "
        "which come from the ratings too.",
    )


def theory_tables() -> list[Table]:
    """Return what was measured of Theorem 1."""
    rows = [
        (
            f"{t.size}x{t.size}",
            f"{t.trap:+g}",
            t.panel,
            "none" if t.critical is None else Number(t.critical),
            "yes" if t.critical is None or t.critical > 2 else "no",
        )
        for t in theory.critical_lambdas()
    ]
    critical = Table(
        "Smallest lambda at which the fixed point of T_lambda stops hacking",
        ("grid", "trap", "raters", "critical lambda", "hacks at lambda = 2"),
        tuple(rows),
        3,
        "By exact solution, gamma = 0.95, beta = 0.5, sigma_m = 0 (its limit).",
    )
    rows = [
        (
            "contraction ratio, weights frozen, 1000 random pairs per grid",
            f"{theory.contraction():.4f}",
            "<= 0.95: Theorem 1 holds",
        ),
        ("ensemble map, weights following sigma_m(Q)", f"{theory.live_expansion():.2f}", "> 1: not a contraction"),
        ("fixed points from 20 random starts differ by", f"{theory.fixed_point_spread():.1e}", "unique"),
    ]
    return [critical, Table("Theorem 1, measured", ("what", "value", "reading"), tuple(rows), 1)]
