"""Our studies on grids in the report: every mitigation everywhere, twins, few ratings, a learned reward."""

from __future__ import annotations

from typing import Any

import numpy as np

from uard.lab import statistics
from uard.lab.result import CALIBRATION
from uard.lab.study import Row
from uard.lab.views import figures
from uard.lab.views.study_results import StudyResults
from uard.lab.views.tables import Table, brief, full, number


def losses(results: StudyResults) -> list[str]:
    """Say where ``uard`` fails or is beaten on grids, found by rule."""
    beaten = (
        _beaten(results, study, shown)
        for study, shown in (("matrix", ("size", "trap", "panel", "noise")), ("budgets", ("panel", "noise", "rated")))
    )
    return [_colluding(results), _missed(results), _denied(results), _learned(results), *beaten, *_rankings(results)]


def _colluding(results: StudyResults) -> str:
    """The control: who trusts raters is fooled when all of them repeat the proxy."""
    fooled = list(results.studies["matrix"].where(mitigation="uard", panel="colluding"))
    worst = min(results.of(r.cell, "hacks").mean / results.of(r.cell, "episode_length").mean for r in fooled)
    return (
        f"Colluding raters (all repeat the proxy): uard hacks in {len(fooled)} of {len(fooled)} settings, at least "
        f"{worst:.2f} hacks per step. It reads agreement as truth; this control must fail, and does. {_escaped(results)}"
    )


def _escaped(results: StudyResults) -> str:
    """Say who escapes colluding raters, and where most."""
    pairs = [
        (r, results.row("matrix", **(dict(r.labels) | {"mitigation": "uard"})).cell)
        for r in results.studies["matrix"].where(panel="colluding")
        if r["mitigation"] != "uard"
    ]
    family = results.compare([(r.cell, mine) for r, mine in pairs], "true_return")
    gains = [
        (results.of(r.cell, "true_return").mean - results.of(mine, "true_return").mean, r, mine)
        for i, (r, mine) in enumerate(pairs)
        if family.above(i)
    ]
    if not gains:
        return family.caption()
    _, best, mine = max(gains, key=lambda g: g[0])
    return (
        f"In {len(gains)} comparisons another mitigation does better there, most of all {best['mitigation']} ({_name(best)}): "
        f"{brief(results.of(best.cell, 'true_return'))} against {brief(results.of(mine, 'true_return'))}; very noisy raters make it shun "
        f"whatever they rate. Rival against uard: {family.caption()}"
    )


def _missed(results: StudyResults) -> str:
    """Settings in which ``uard`` misses what is asked of it."""
    honest = [
        r for r in results.studies["matrix"].where(mitigation="uard") if r["panel"] != "colluding" and r["noise"] <= 1.2
    ]
    missed = [
        r
        for r in honest
        if results.of(r.cell, "hacks").mean > (0.15 if r["noise"] == 0 else 0.2)
        or results.of(r.cell, "success_rate").mean < 0.98
    ]
    named = ": " + "; ".join(_name(r) for r in missed) if missed else ""
    return (
        f"Of the {len(honest)} settings with honest raters and noise up to sd 1.2, uard misses 0.2 visits (0.15 without "
        f"noise) or 98 % goals in {len(missed)}{named}."
    )


def _denied(results: StudyResults) -> str:
    """One rater of several who denies the goal: where `uard` loses it, and who does not."""
    ours = list(results.studies["dissent"].where(mitigation="uard"))
    pairs = [(x, r) for r in ours for x in results.studies["dissent"].where(panel=r["panel"]) if x is not r]
    family = results.compare([(x.cell, r.cell) for x, r in pairs], "success_rate")
    lost = []
    for r in ours:
        better = [x["mitigation"] for i, (x, mine) in enumerate(pairs) if mine is r and family.above(i)]
        if better:
            lost.append(f"{r['panel']}: {brief(results.of(r.cell, 'success_rate'))}, more with {', '.join(better)}")
    count = len(ours)
    named = f" (share of episodes that reach it: {'; '.join(lost)})" if lost else ""
    return f"One rater against all others takes the goal from uard in {len(lost)} of {count} settings{named}. Rival against uard: {family.caption()}"


def _learned(results: StudyResults) -> str:
    """The reward that is itself a model of ratings."""
    learned = list(results.studies["sources"].where(mitigation="uard-0.1", sources="sigma_m and sigma_h"))
    fooled = [
        r for r in learned if results.of(r.cell, "hacks").mean > 1 or results.of(r.cell, "success_rate").mean < 0.95
    ]
    return (
        f"A reward that is itself a model of ratings (study sources): uard-0.1 fails for {len(fooled)} of "
        f"{len(learned)} models: it believes a tenth of what nobody has rated, and their extrapolation is large enough for "
        "that. A plain filter with both sources and a large constant lambda does not (table below)."
    )


def _beaten(results: StudyResults, study: str, shown: tuple[str, ...]) -> str:
    """Every setting of a study in which another mitigation has the higher true return."""
    rows = [r for r in results.studies[study].where(mitigation="uard") if r["panel"] != "colluding"]
    pairs = [
        (rival, r)
        for r in rows
        for rival in results.studies[study].where(**{k: r[k] for k in shown})
        if rival["mitigation"] != "uard"
    ]
    family = results.compare([(rival.cell, r.cell) for rival, r in pairs], "true_return")
    beaten = []
    for i, (rival, r) in enumerate(pairs):
        if family.above(i):
            where = ", ".join(f"{k} {r[k]:g}" if isinstance(r[k], float) else f"{k} {r[k]}" for k in shown)
            theirs, mine = (brief(results.of(x.cell, "true_return")) for x in (rival, r))
            beaten.append(f"{where}: {rival['mitigation']} {theirs} against {mine}")
    named = ": " + "; ".join(beaten) if beaten else ""
    return (
        f"Study {study}: in {len(beaten)} comparisons over {len(rows)} settings another mitigation has the higher true "
        f"return{named}. Rival against uard: {family.caption()}"
    )


def _rankings(results: StudyResults) -> list[str]:
    """Say who is best and second where raters are noisy and it is not ``uard``."""
    out = []
    for noise in (1.2, 3.3):
        for panel in ("main", "appendix"):
            there = results.studies["matrix"].where(size=10, trap=4.0, panel=panel, noise=noise)
            ranking = sorted(
                ((results.of(r.cell, "true_return"), r["mitigation"]) for r in there), key=lambda x: -x[0].mean
            )
            (best, first), (second, runner) = ranking[:2]
            if first == "uard":
                continue
            out.append(
                f"10x10, {panel} panel, noise sd {noise:g}: highest true return {first} {full(best)}, then {runner} {full(second)}."
            )
    return out


def _name(r: Row) -> str:
    return ", ".join(f"{k} {v}" for k, v in r.labels if k != "mitigation")


def tables(results: StudyResults) -> list[Table]:
    """Return all tables."""
    matrices = (_matrix(results, metric) for metric in ("true_return", "hacks", "success_rate"))
    return [*matrices, _twins(results), _dissent(results), _calibration(results), _sources(results)]


def pictures(results: StudyResults) -> list[tuple[str, str, str]]:
    """Return (title, what to see, image) of all figures."""
    return [
        (
            "Against the serious rivals",
            "Learning from pessimistic ratings is nearly as good without noise; with noise it is not.",
            figures.data_uri(figures.competition(results)),
        ),
        (
            "Few ratings",
            "Dashed: the same rivals with our treatment of steps that nobody has rated.",
            figures.data_uri(figures.budgets(results)),
        ),
    ]


def _against_ours(results: StudyResults, study: str, metric: str, **labels: Any) -> str:
    """Say of how many comparisons with ``uard``, setting by setting, one differs from chance."""
    rows = list(results.studies[study].where(**labels))
    settings = {_name(r): r for r in rows if r["mitigation"] == "uard"}
    pairs = [(r.cell, settings[_name(r)].cell) for r in rows if r["mitigation"] != "uard" and _name(r) in settings]
    return f"Every other column or row against uard: {results.compare(pairs, metric).caption()}"


def _matrix(results: StudyResults, metric: str) -> Table:
    rows = list(results.studies["matrix"].rows)
    noises = list(dict.fromkeys(r["noise"] for r in rows))
    names = list(dict.fromkeys(r["mitigation"] for r in rows))
    table = []
    for panel in ("main", "appendix", "colluding"):
        for trap in (4.0, 8.0):
            for name in names:
                s = [
                    results.get("matrix", metric, mitigation=name, size=10, trap=trap, panel=panel, noise=z)
                    for z in noises
                ]
                table.append((panel, f"{trap:+g}", name, *(brief(x) for x in s)))
    columns = ("panel", "trap", "mitigation", *(f"noise {z:g}" for z in noises))
    note = "mean ± sd over seeds. Noise is the sd in reward units on every rater; divide by 4 for the fraction of a +4 trap."
    note = f"{note} {_against_ours(results, 'matrix', metric, size=10)}"
    return Table(f"10x10: {metric.replace('_', ' ')} of every mitigation", columns, tuple(table), 3, note)


def _twins(results: StudyResults) -> Table:
    names = list(dict.fromkeys(r["mitigation"] for r in results.studies["legitimate"].rows))
    rows = []
    for size in (6, 8, 10):
        for trap in (4.0, 8.0):
            for panel in ("main", "appendix"):
                raw = results.get("legitimate", "true_return", mitigation="raw", size=size, trap=trap, panel=panel).mean
                shares = []
                for n in names:
                    s = results.get("legitimate", "true_return", mitigation=n, size=size, trap=trap, panel=panel)
                    shares.append(f"{100 * s.mean / raw:.1f} %")
                rows.append((f"{size}x{size}", f"{trap:+g}", panel, *shares))
    return Table(
        "Legitimate twins: the bonus is real and the raters say so; true return kept, of the raw agent's",
        ("grid", "trap", "panel", *names),
        tuple(rows),
        3,
        "The erratic rater stays erratic at the bonus. UARD as printed gives up nearly everything. "
        f"{_against_ours(results, 'legitimate', 'true_return')}",
    )


def _dissent(results: StudyResults) -> Table:
    study = results.studies["dissent"]
    names = list(dict.fromkeys(r["mitigation"] for r in study.rows))
    rows = []
    for panel in dict.fromkeys(r["panel"] for r in study.rows):
        found = [results.get("dissent", "success_rate", mitigation=name, panel=panel) for name in names]
        rows.append((panel, *map(brief, found)))
    return Table(
        "One rater against all others: share of episodes that reach the goal, 10x10",
        ("panel", *names),
        tuple(rows),
        1,
        "Whoever denies the goal, which pays 10 and is worth it, tells the truth elsewhere, as the others do everywhere "
        "(noise of sd 0.1). In the last rows all but one are drawn towards what a trap seems to pay. Of three raters nobody "
        "can know who is right. Of five, `uard` may overrule one who is alone, low and no more precise than the others "
        "(vetoes=1), and then overrules the only one who tells the truth, too. "
        f"{_against_ours(results, 'dissent', 'success_rate')}",
    )


def _calibration(results: StudyResults) -> Table:
    rows = []
    for panel in ("main", "appendix", "colluding"):
        for noise in (0.0, 0.3, 1.2, 3.3):
            r = results.row("matrix", mitigation="uard", size=10, trap=4.0, panel=panel, noise=noise)
            values = np.stack([x.extra["calibration"] for x in results.results(r.cell)]).astype(float)
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


def _sources(results: StudyResults) -> Table:
    """Which source does the work: all models of the study together, by mitigation and source."""
    rows = []
    kinds = dict.fromkeys((r["mitigation"], r["sources"]) for r in results.studies["sources"].rows)
    for name, way in kinds:
        cells = [r.cell for r in results.studies["sources"].where(mitigation=name, sources=way)]
        worst = max(results.of(c, "hacks").mean for c in cells)
        solved = sum(results.of(c, "hacks").mean <= 1.0 and results.of(c, "success_rate").mean >= 0.95 for c in cells)
        means = {m: statistics.summarise([results.of(c, m).mean for c in cells]) for m in ("hacks", "true_return")}
        rows.append(
            (
                name,
                way,
                brief(means["hacks"]),
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
        "both, and a far larger lambda than the paper's. `uard-0.1` believes a tenth of what nobody rated.",
    )
