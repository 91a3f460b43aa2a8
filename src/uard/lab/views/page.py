"""The report: one static page and ``ledger.json``, made from the store alone; opens without a server or a network."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from uard import InvalidValueError, __version__
from uard.lab import statistics, studies
from uard.lab.execution.store import Store
from uard.lab.result import CALIBRATION, WINDOW
from uard.lab.statistics import Summary
from uard.lab.study import Row
from uard.lab.views import best_of_n as overoptimisation
from uard.lab.views import leaderboard, published
from uard.lab.views.evidence import Evidence
from uard.lab.views.tables import Table, brief, full, number, study_table
from uard.replication import audit, deep, figures, ledger, locomotion, paper, theory

_PACKAGES = ("jax", "numpy", "scipy", "gymnasium", "matplotlib")


def write(folder: Path, store: Store, seeds: Sequence[int], mitigations: tuple[str, ...] = ()) -> Path:
    """Write ``index.html``, ``leaderboard.html`` and ``ledger.json`` into a folder and return the first one's path.

    Args:
        folder: Made if it is not there.
        store: Holds all grid studies, and whatever else the leaderboard shows.
        seeds: Over these.
        mitigations: Further ones that took part in the studies.

    Raises:
        InvalidValueError: the folder cannot be written.
        LookupError: a study is not finished.
    """
    import jinja2

    chosen = studies.find(("grid",), mitigations)
    evidence = Evidence(store, seeds, chosen)
    entries = ledger.entries(evidence)
    best_of_n = published.packaged_json("best-of-n.json")
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    page = environment.get_template("page.html.j2").render(
        version=__version__,
        seeds=len(evidence.seeds),
        window=WINDOW,
        headline=_headline(evidence),
        losses=[
            *_losses(evidence),
            *deep.losses(published.packaged()),
            *locomotion.losses(published.packaged()),
            *overoptimisation.losses(best_of_n),
        ],
        deep_tables=[_sources(evidence), *deep.tables(published.packaged())],
        deep_figures=deep.drawn(published.packaged()),
        mujoco_tables=locomotion.tables(published.packaged()),
        mujoco_figures=[*locomotion.drawn(published.packaged()), *locomotion.film()],
        deep_made=published.packaged().sources,
        best_of_n=overoptimisation.table(best_of_n),
        best_of_n_figure=figures.data_uri(overoptimisation.figure(best_of_n)),
        film=json.dumps(_film(evidence)),
        tables=_paper_tables(evidence),
        figures=_figures(evidence),
        ours=_our_tables(evidence),
        theory=_theory_tables(),
        entries=entries,
        verdicts={v: sum(e.verdict == v for e in entries) for v in ledger.VERDICTS},
        checks=[_check(c) for c in audit.run()],
        everything=[study_table(s, evidence) for s in chosen if s.name != "matrix"],
        versions={p: metadata.version(p) for p in _PACKAGES} | {"python": platform.python_version()},
        machine=f"{platform.machine()}, {os.cpu_count()} cores",
        runs=store.count(),
    )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        data = json.dumps(ledger.as_data(entries, evidence.seeds), indent=2, allow_nan=False)
        (folder / "ledger.json").write_text(data + "\n", encoding="utf-8")
        target = folder / "index.html"
        target.write_text(page, encoding="utf-8")
    except OSError as error:
        raise InvalidValueError("report", str(folder), f"a folder that can be written ({error})") from None
    leaderboard.write(folder / "leaderboard.html", store)
    return target


def _headline(e: Evidence) -> list[dict[str, str]]:
    """The four agents on 10x10 at the paper's T = 80, both panels: what a reader must see first."""
    rows = []
    for agent in ("baseline", "random walk", "uard-paper", "uard-consistent", "uard"):
        for panel in ("main", "appendix"):
            if agent in ("baseline", "random walk") and panel == "appendix":
                continue
            get = [
                e.get("scale", m, agent=agent, size=10, panel=panel)
                for m in ("trap_visits", "goal_rate", "true_return")
            ]
            name = agent if agent in ("baseline", "random walk") else f"{agent}, {panel} panel"
            rows.append({"agent": name, "visits": full(get[0]), "goal": full(get[1]), "true": full(get[2])})
    return rows


def _better(a: Summary, b: Summary) -> bool:
    return a.ci95[0] > b.ci95[1]


def _losses(e: Evidence) -> list[str]:
    """Where ``uard`` fails or is beaten, found by rule: every setting where another mitigation has the higher true return."""
    out = []
    fooled = [r for r in e.studies["matrix"].where(mitigation="uard", panel="colluding")]
    worst = min(e.of(r.cell, "trap_visits").mean / e.of(r.cell, "episode_length").mean for r in fooled)
    out.append(
        f"Colluding raters (all repeat the proxy): uard hacks in {len(fooled)} of {len(fooled)} settings, at least "
        f"{worst:.2f} trap visits per step. It reads agreement as truth; this control must fail, and does. {_escaped(e)}"
    )
    target = [
        r
        for r in e.studies["matrix"].where(mitigation="uard")
        if r["panel"] != "colluding"
        and r["noise"] <= 1.2
        and (
            e.of(r.cell, "trap_visits").mean > (0.15 if r["noise"] == 0 else 0.2)
            or e.of(r.cell, "goal_rate").mean < 0.98
        )
    ]
    out.append(
        f"Of the {sum(1 for r in e.studies['matrix'].where(mitigation='uard') if r['panel'] != 'colluding' and r['noise'] <= 1.2)} "
        f"settings with honest raters and noise up to sd 1.2, uard misses 0.2 visits (0.15 without noise) or 98 % goals in "
        f"{len(target)}{': ' + '; '.join(_name(r) for r in target) if target else ''}."
    )
    learned = [r for r in e.studies["sources"].where(mitigation="uard", sources="sigma_m and sigma_h")]
    fooled = [r for r in learned if e.of(r.cell, "trap_visits").mean > 1 or e.of(r.cell, "goal_rate").mean < 0.95]
    out.append(
        f"A reward that is itself a model of ratings (study sources): uard as recommended fails for {len(fooled)} of "
        f"{len(learned)} models: it believes a tenth of what nobody has rated, and their extrapolation is large enough for "
        "that. A plain filter with both sources and a large constant lambda does not (table below)."
    )
    for study, shown in (("matrix", ("size", "trap", "panel", "noise")), ("budgets", ("panel", "noise", "rated"))):
        beaten = []
        rows = [r for r in e.studies[study].where(mitigation="uard") if r["panel"] != "colluding"]
        for r in rows:
            labels = {k: r[k] for k in shown}
            mine = e.of(r.cell, "true_return")
            for rival in e.studies[study].where(**labels):
                if rival["mitigation"] != "uard" and _better(theirs := e.of(rival.cell, "true_return"), mine):
                    where = ", ".join(f"{k} {v:g}" if isinstance(v, float) else f"{k} {v}" for k, v in labels.items())
                    beaten.append(f"{where}: {rival['mitigation']} {brief(theirs)} against {brief(mine)}")
        text = f"Study {study}: in {len(beaten)} comparisons over {len(rows)} settings another mitigation has the higher true return (95 % intervals apart)"
        out.append(text + ("." if not beaten else ": " + "; ".join(beaten) + "."))
    for noise in (1.2, 3.3):
        for panel in ("main", "appendix"):
            ranking = sorted(
                (
                    (e.of(r.cell, "true_return"), r["mitigation"])
                    for r in e.studies["matrix"].where(size=10, trap=4.0, panel=panel, noise=noise)
                ),
                key=lambda pair: -pair[0].mean,
            )
            (best, first), (second, runner) = ranking[:2]
            out.append(
                f"10x10, {panel} panel, noise sd {noise:g}: highest true return {first} {full(best)}, then {runner} {full(second)}."
            )
    return out


def _escaped(e: Evidence) -> str:
    """Say who escapes colluding raters, and where most."""
    gains = []
    for r in e.studies["matrix"].where(panel="colluding"):
        mine = e.row("matrix", **(dict(r.labels) | {"mitigation": "uard"})).cell
        if r["mitigation"] != "uard" and _better(e.of(r.cell, "true_return"), e.of(mine, "true_return")):
            gains.append((e.of(r.cell, "true_return").mean - e.of(mine, "true_return").mean, r, mine))
    if not gains:
        return ""
    _, best, mine = max(gains, key=lambda g: g[0])
    return (
        f"In {len(gains)} comparisons another mitigation does better there, most of all {best['mitigation']} ({_name(best)}): "
        f"{brief(e.of(best.cell, 'true_return'))} against {brief(e.of(mine, 'true_return'))}; very noisy raters make it shun "
        "whatever they rate."
    )


def _name(r: Row) -> str:
    return ", ".join(f"{k} {v}" for k, v in r.labels if k != "mitigation")


def _film(e: Evidence) -> list[dict[str, Any]]:
    """Greedy walks of three agents on every grid, the first three seeds, for the player on the page."""
    out = []
    for size in (6, 8, 10):
        for panel in ("main", "appendix"):
            walks = {}
            for agent in ("baseline", "uard-paper", "uard"):
                cell = e.row("scale", agent=agent, size=size, panel=panel).cell
                walks[agent] = [r.path.tolist() for r in e.results(cell)[:3]]
            grid = e.row("scale", agent="uard", size=size, panel=panel).cell.environment
            out.append(
                {
                    "name": f"{size}x{size}, {panel} panel",
                    "size": size,
                    "traps": [grid.state(t) for t in grid.traps or ()],
                    "goal": grid.states - 1,
                    "horizon": grid.horizon,
                    "rewards": {
                        "trap": grid.trap_reward,
                        "true": grid.true_trap_reward,
                        "goal": grid.goal_reward,
                        "step": grid.step_reward,
                    },
                    "walks": walks,
                }
            )
    return out


def _check(c: audit.Check) -> dict[str, str]:
    def text(values: Any) -> str:
        shown = ((k, f"{v:.4g}" if isinstance(v, float | int) else v) for k, v in values.items() if v is not None)
        return "; ".join(f"{k}: {v}" for k, v in shown) or "–"

    return {
        "id": c.id,
        "question": c.question,
        "printed_text": text(c.paper),
        "recomputed_text": text(c.recomputed),
        "judgement": f"{c.judgement.verdict} ({c.judgement.count})" if c.judgement else "nothing claimed",
        "verdict": c.verdict,
        "parts": audit.one_by_one([*c.parts, *(o for o in c.found if o.opinion)]),
    }


def _stat(s: paper.Stat | None) -> str:
    return "–" if s is None else f"{s.mean:g} ± {s.sd:g}"


def _paper_tables(e: Evidence) -> list[Table]:
    get = e.get
    rows2 = []
    for p in paper.TABLE_2:
        ours = [
            get("scale", "trap_visits", agent=a, size=p.size, panel="main") for a in ("uard-paper", "uard", "baseline")
        ]
        rows2.append(
            (f"{p.size}x{p.size}", _stat(p.uard), full(ours[0]), full(ours[1]), _stat(p.baseline), full(ours[2]))
        )
    table2 = Table(
        "Table 2 (F2): trap visits by grid",
        ("grid", "paper: UARD", "ours: uard-paper", "ours: uard", "paper: baseline", "ours: baseline"),
        tuple(rows2),
        1,
        "Ours per episode, main panel, T = 40/60/80. The paper's first row is per episode, its others exceed what an episode has room for.",
    )
    rows3 = [
        (p.method, "paper", _stat(p.reward), _stat(p.visits), "–", "–", f"{p.reduction:g} %") for p in paper.TABLE_3
    ]
    for t in (100, 80):
        base = get("table3", "trap_visits", agent="baseline", horizon=t, panel="main")
        for agent in ("baseline", "uard-paper", "uard-consistent", "uard", "random walk"):
            r = e.row("table3", agent=agent, horizon=t, panel="main")
            v, o, g, true = (e.of(r.cell, m) for m in ("trap_visits", "observed_return", "goal_rate", "true_return"))
            cut = f"{100 * (1 - v.mean / base.mean):.1f} %"
            total = f"{number(100 * v.mean)} ± {number(100 * v.sd)}"
            rows3.append((agent, f"ours, T = {t}", brief(o), total, brief(g), brief(true), cut))
    table3 = Table(
        "Table 3 (F3): 10x10, last 100 episodes",
        ("method", "source", "mean reward", "trap visits (total)", "goal rate", "true return", "reduction"),
        tuple(rows3),
        2,
        "Our baseline here is tabular Q-learning, main panel; deep ones stand in a section of their own. Note the random walk.",
    )
    names = {"Baseline": "baseline", "Multi-Head": "multi-head", "UARD": "uard-paper"}
    rows4 = []
    for p in paper.TABLE_4:
        rows4.append(
            (p.agent, "paper", _stat(p.true_return), _stat(p.observed_return), _stat(p.visits), _stat(p.gap), "–")
        )
        for panel in ("main", "appendix"):
            rows4.append(_row4(e, names[p.agent], panel))
    for panel in ("main", "appendix"):
        rows4.append(_row4(e, "uard-consistent", panel))
        rows4.append(_row4(e, "uard", panel))
    table4 = Table(
        "Table 4 (F4): 6x6",
        ("agent", "source", "true return", "observed return", "trap visits", "alignment gap", "goal rate"),
        tuple(rows4),
        2,
        "The paper's 'episode 500'; ours are the last 100 episodes. The gap is |observed - true| per episode.",
    )
    rows5 = []
    variant = {
        "Baseline": "Baseline Q-Learning",
        "UARD-lite": "No sigma_h (UARD-lite)",
        "Human-only": "No sigma_m (Human-only)",
        "UARD": "UARD (Full)",
    }
    for p in paper.TABLE_5:
        name = variant.get(p.variant, p.variant)
        cells = []
        for reading in ("uard-paper", "uard-consistent", "uard-operator", "uard"):
            found = list(e.studies["table5"].where(variant=name, reading=reading if p.discounting else "-"))
            v, g = e.of(found[0].cell, "trap_visits"), e.of(found[0].cell, "goal_rate")
            cells.append(f"{brief(v)} (goal {g.mean:.2f})")
        rows5.append((p.variant, _stat(p.visits), *cells))
    table5 = Table(
        "Table 5 (F5): which component does the work",
        ("variant", "paper", "as printed (acts on J)", "consistent backup", "T_lambda (on reward)", "ours (uard)"),
        tuple(rows5),
        1,
        "Trap visits per episode, 6x6, main panel, heads bootstrapped with probability 0.5. Without sigma_h no reading of the paper works. Ours then still has its anchor and lambda_t, which come from the ratings too.",
    )
    return [table2, table3, table4, table5]


def _row4(e: Evidence, agent: str, panel: str) -> tuple[str, ...]:
    r = e.row("table4", agent=agent, panel=panel)
    metrics = ("true_return", "observed_return", "trap_visits", "alignment_gap", "goal_rate")
    return (agent, f"ours, {panel}", *(full(e.of(r.cell, m)) for m in metrics))


def _figures(e: Evidence) -> list[tuple[str, str, str]]:
    """(title, what to see, image)."""
    made = (
        ("walks", figures.walks, "Numbers are visits of the cell, where more than one. Seed 0, main panel."),
        (
            "G2 · filters",
            figures.filters,
            "Left: the three filters. Right: goal rate by form and by where it acts. Acting on J as printed never reaches the goal, whatever the form.",
        ),
        (
            "G3 · the verification delay",
            figures.hero,
            "The paper's curve turns to the goal near episode 400. As printed, UARD stays flat near -2; `uard` turns early.",
        ),
        (
            "G4 · trap visits",
            figures.trap_visits,
            "Thin lines are seeds, thick ones their mean (moving average over 10 episodes).",
        ),
        (
            "G5 · the alignment gap",
            figures.alignment_gap,
            "The baseline's observed and true return part; those of `uard` meet.",
        ),
        ("G8 · true return", figures.true_return, "UARD as printed settles at -4: forty steps of -0.1."),
        (
            "G9 · two uncertainties",
            figures.uncertainty,
            "Bootstrapped heads. sigma_m at the trap falls after its peak, elsewhere it grows with the values; sigma_h stays. Bands are one SD over seeds.",
        ),
        (
            "G11 on the grid · noisy raters",
            figures.noise,
            "The raw agent reads no ratings, so noise cannot hurt it: its line is flat, not rising by 277 %.",
        ),
        ("G13 · sign preservation", figures.sign_preservation, "Three meanings of one word: equal, smaller, larger."),
        (
            "G16 · observed return of all agents",
            figures.learning_curves,
            "A low observed return is no virtue: a random walker has it too.",
        ),
        (
            "Against the serious rivals",
            figures.competition,
            "Learning from pessimistic ratings is nearly as good without noise; with noise it is not.",
        ),
        ("Few ratings", figures.budgets, "Dashed: the same rivals with our treatment of steps that nobody has rated."),
    )
    return [(title, note, figures.data_uri(draw(e))) for title, draw, note in made]


def _our_tables(e: Evidence) -> list[Table]:
    out = []
    for metric in ("true_return", "trap_visits", "goal_rate"):
        out.append(_matrix(e, metric))
    out.append(_twins(e))
    out.append(_calibration(e))
    return out


def _matrix(e: Evidence, metric: str) -> Table:
    rows = list(e.studies["matrix"].rows)
    noises = list(dict.fromkeys(r["noise"] for r in rows))
    names = list(dict.fromkeys(r["mitigation"] for r in rows))
    table = []
    for panel in ("main", "appendix", "colluding"):
        for trap in (4.0, 8.0):
            for name in names:
                s = [e.get("matrix", metric, mitigation=name, size=10, trap=trap, panel=panel, noise=z) for z in noises]
                table.append((panel, f"{trap:+g}", name, *(brief(x) for x in s)))
    columns = ("panel", "trap", "mitigation", *(f"noise {z:g}" for z in noises))
    note = "mean ± sd over seeds. Noise is the sd in reward units on every rater; divide by 4 for the fraction of a +4 trap."
    return Table(f"10x10: {metric.replace('_', ' ')} of every mitigation", columns, tuple(table), 3, note)


def _twins(e: Evidence) -> Table:
    names = list(dict.fromkeys(r["mitigation"] for r in e.studies["legitimate"].rows))
    rows = []
    for size in (6, 8, 10):
        for trap in (4.0, 8.0):
            for panel in ("main", "appendix"):
                raw = e.get("legitimate", "true_return", mitigation="raw", size=size, trap=trap, panel=panel).mean
                shares = []
                for n in names:
                    s = e.get("legitimate", "true_return", mitigation=n, size=size, trap=trap, panel=panel)
                    shares.append(f"{100 * s.mean / raw:.1f} %")
                rows.append((f"{size}x{size}", f"{trap:+g}", panel, *shares))
    return Table(
        "Legitimate twins: the bonus is real and the raters say so; true return kept, of the raw agent's",
        ("grid", "trap", "panel", *names),
        tuple(rows),
        3,
        "The erratic rater stays erratic at the bonus. UARD as printed gives up nearly everything.",
    )


def _calibration(e: Evidence) -> Table:
    rows = []
    for panel in ("main", "appendix", "colluding"):
        for noise in (0.0, 0.3, 1.2, 3.3):
            r = e.row("matrix", mitigation="uard", size=10, trap=4.0, panel=panel, noise=noise)
            values = np.stack([x.extra["calibration"] for x in e.results(r.cell)]).astype(float)
            rows.append(
                (panel, f"{noise:g}", *(brief(statistics.summarise(values[:, i])) for i in range(len(CALIBRATION))))
            )
    return Table(
        "Does sigma tell the truth (A15)? 10x10, what `uard` has learned of its raters",
        ("panel", "noise", "AUROC sigma_h", "AUROC with proxy", "Spearman sigma_h", "Spearman with proxy"),
        tuple(rows),
        2,
        "AUROC: chance that a trap has the larger sigma than another step. Spearman: rank correlation of sigma with |proxy - true|.",
    )


def _sources(e: Evidence) -> Table:
    """Which source does the work: all models of the study together, by mitigation and source."""
    rows = []
    kinds = dict.fromkeys((r["mitigation"], r["sources"]) for r in e.studies["sources"].rows)
    for name, way in kinds:
        cells = [r.cell for r in e.studies["sources"].where(mitigation=name, sources=way)]
        worst = max(e.of(c, "trap_visits").mean for c in cells)
        solved = sum(e.of(c, "trap_visits").mean <= 1.0 and e.of(c, "goal_rate").mean >= 0.95 for c in cells)
        means = {m: statistics.summarise([e.of(c, m).mean for c in cells]) for m in ("trap_visits", "true_return")}
        rows.append(
            (
                name,
                way,
                brief(means["trap_visits"]),
                number(worst),
                brief(means["true_return"]),
                f"{solved} of {len(cells)}",
            )
        )
    return Table(
        "Which source does the work? The reward is a model of ratings, learned from a part of the grid",
        ("mitigation", "sources", "hacks per episode", "worst model", "true return", "solved"),
        tuple(rows),
        2,
        "Five reward models (mean ± sd over models of the mean over seeds); solved: at most 1 hack and 95 % goals. Inside the "
        "rated part the trap is contested (sigma_h), outside the model extrapolates (sigma_m). The plain filter needs "
        "both, and a far larger lambda than the paper's. `uard` as recommended believes a tenth of what nobody rated.",
    )


def _theory_tables() -> list[Table]:
    rows = [
        (
            f"{t.size}x{t.size}",
            f"{t.trap:+g}",
            t.panel,
            "none" if t.critical is None else number(t.critical),
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
