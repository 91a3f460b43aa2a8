"""Our studies on grids in the report: every mitigation everywhere, twins, few ratings, a learned reward."""

from __future__ import annotations

import numpy as np

from uard.lab import statistics
from uard.lab.result import CALIBRATION
from uard.lab.statistics import Summary
from uard.lab.study import Row
from uard.lab.views import figures
from uard.lab.views.evidence import Evidence
from uard.lab.views.tables import Table, brief, full, number


def losses(e: Evidence) -> list[str]:
    """Say where ``uard`` fails or is beaten on grids, found by rule."""
    beaten = (
        _beaten(e, study, shown)
        for study, shown in (("matrix", ("size", "trap", "panel", "noise")), ("budgets", ("panel", "noise", "rated")))
    )
    return [_colluding(e), _missed(e), _learned(e), *beaten, *_rankings(e)]


def _colluding(e: Evidence) -> str:
    """The control: who trusts raters is fooled when all of them repeat the proxy."""
    fooled = list(e.studies["matrix"].where(mitigation="uard", panel="colluding"))
    worst = min(e.of(r.cell, "hacks").mean / e.of(r.cell, "episode_length").mean for r in fooled)
    return (
        f"Colluding raters (all repeat the proxy): uard hacks in {len(fooled)} of {len(fooled)} settings, at least "
        f"{worst:.2f} trap visits per step. It reads agreement as truth; this control must fail, and does. {_escaped(e)}"
    )


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


def _missed(e: Evidence) -> str:
    """Settings in which ``uard`` misses what is asked of it."""
    honest = [
        r for r in e.studies["matrix"].where(mitigation="uard") if r["panel"] != "colluding" and r["noise"] <= 1.2
    ]
    missed = [
        r
        for r in honest
        if e.of(r.cell, "hacks").mean > (0.15 if r["noise"] == 0 else 0.2) or e.of(r.cell, "success_rate").mean < 0.98
    ]
    named = ": " + "; ".join(_name(r) for r in missed) if missed else ""
    return (
        f"Of the {len(honest)} settings with honest raters and noise up to sd 1.2, uard misses 0.2 visits (0.15 without "
        f"noise) or 98 % goals in {len(missed)}{named}."
    )


def _learned(e: Evidence) -> str:
    """The reward that is itself a model of ratings."""
    learned = list(e.studies["sources"].where(mitigation="uard", sources="sigma_m and sigma_h"))
    fooled = [r for r in learned if e.of(r.cell, "hacks").mean > 1 or e.of(r.cell, "success_rate").mean < 0.95]
    return (
        f"A reward that is itself a model of ratings (study sources): uard as recommended fails for {len(fooled)} of "
        f"{len(learned)} models: it believes a tenth of what nobody has rated, and their extrapolation is large enough for "
        "that. A plain filter with both sources and a large constant lambda does not (table below)."
    )


def _beaten(e: Evidence, study: str, shown: tuple[str, ...]) -> str:
    """Every setting of a study in which another mitigation has the higher true return."""
    beaten = []
    rows = [r for r in e.studies[study].where(mitigation="uard") if r["panel"] != "colluding"]
    for r in rows:
        labels = {k: r[k] for k in shown}
        mine = e.of(r.cell, "true_return")
        for rival in e.studies[study].where(**labels):
            if rival["mitigation"] != "uard" and _better(theirs := e.of(rival.cell, "true_return"), mine):
                where = ", ".join(f"{k} {v:g}" if isinstance(v, float) else f"{k} {v}" for k, v in labels.items())
                beaten.append(f"{where}: {rival['mitigation']} {brief(theirs)} against {brief(mine)}")
    named = ": " + "; ".join(beaten) if beaten else ""
    return (
        f"Study {study}: in {len(beaten)} comparisons over {len(rows)} settings another mitigation has the higher true "
        f"return (95 % intervals apart){named}."
    )


def _rankings(e: Evidence) -> list[str]:
    """Say who is best and second where raters are noisy."""
    out = []
    for noise in (1.2, 3.3):
        for panel in ("main", "appendix"):
            there = e.studies["matrix"].where(size=10, trap=4.0, panel=panel, noise=noise)
            ranking = sorted(((e.of(r.cell, "true_return"), r["mitigation"]) for r in there), key=lambda x: -x[0].mean)
            (best, first), (second, runner) = ranking[:2]
            out.append(
                f"10x10, {panel} panel, noise sd {noise:g}: highest true return {first} {full(best)}, then {runner} {full(second)}."
            )
    return out


def _better(a: Summary, b: Summary) -> bool:
    return a.ci95[0] > b.ci95[1]


def _name(r: Row) -> str:
    return ", ".join(f"{k} {v}" for k, v in r.labels if k != "mitigation")


def tables(e: Evidence) -> list[Table]:
    """Return all tables."""
    matrices = (_matrix(e, metric) for metric in ("true_return", "hacks", "success_rate"))
    return [*matrices, _twins(e), _calibration(e), _sources(e)]


def pictures(e: Evidence) -> list[tuple[str, str, str]]:
    """Return (title, what to see, image) of all figures."""
    return [
        (
            "Against the serious rivals",
            "Learning from pessimistic ratings is nearly as good without noise; with noise it is not.",
            figures.data_uri(figures.competition(e)),
        ),
        (
            "Few ratings",
            "Dashed: the same rivals with our treatment of steps that nobody has rated.",
            figures.data_uri(figures.budgets(e)),
        ),
    ]


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
        worst = max(e.of(c, "hacks").mean for c in cells)
        solved = sum(e.of(c, "hacks").mean <= 1.0 and e.of(c, "success_rate").mean >= 0.95 for c in cells)
        means = {m: statistics.summarise([e.of(c, m).mean for c in cells]) for m in ("hacks", "true_return")}
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
        "both, and a far larger lambda than the paper's. `uard` as recommended believes a tenth of what nobody rated.",
    )
