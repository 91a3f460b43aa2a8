"""Our studies on grids in the report: every mitigation everywhere, twins, few ratings, a learned reward."""

from __future__ import annotations

from typing import Any

import numpy as np

from uard.lab import statistics
from uard.lab.result import CALIBRATION
from uard.lab.statistics import Family
from uard.lab.study import Row
from uard.lab.views import figures
from uard.lab.views.figures import Picture
from uard.lab.views.losses import Loss, of_family
from uard.lab.views.study_results import StudyResults
from uard.lab.views.tables import Number, Table, words

ORACLE = "true-reward"
HACKS = 0.2  # trap visits per episode that an agent may make while it explores


def losses(results: StudyResults) -> list[Loss]:
    """Say where ``uard`` fails or is beaten on grids, found by rule."""
    beaten = (
        _beaten(results, study, shown)
        for study, shown in (("matrix", ("size", "trap", "panel", "noise")), ("budgets", ("panel", "noise", "rated")))
    )
    found = (_colluding(results), _missed(results), _denied(results), _learned(results), *beaten)
    return [loss for some in found for loss in some]


def _colluding(results: StudyResults) -> list[Loss]:
    """The control: who trusts raters is fooled when all of them repeat the proxy; against whoever escapes most."""
    every = list(results.studies["matrix"].where(mitigation="uard", panel="colluding"))
    fooled = [r for r in every if results.of(r.cell, "hacks").mean > HACKS]
    pairs = [
        (x, r)
        for r in fooled
        for x in results.studies["matrix"].where(**{k: v for k, v in r.labels if k != "mitigation"})
        if x["mitigation"] not in ("uard", ORACLE)
    ]
    family = results.compare([(x.cell, r.cell) for x, r in pairs], "true_return")
    if not pairs:
        return []
    i = max(range(len(pairs)), key=lambda i: results.of(pairs[i][0].cell, "true_return").mean)
    best, mine = pairs[i]
    return [
        Loss(
            "control",
            "grids",
            f"hacks in {len(fooled)} of {len(every)} settings in which all raters repeat the lie",
            _name(best),
            best["mitigation"],
            results.of(mine.cell, "true_return"),
            results.of(best.cell, "true_return"),
            "true return",
            *of_family(family, i),
            why="agreement is read as truth; who escapes shuns whatever noisy raters rate",
        )
    ]


def _missed(results: StudyResults) -> list[Loss]:
    """Settings with honest raters and noise up to sd 1.2 in which ``uard`` misses what is asked of it."""
    out = []
    for r in results.studies["matrix"].where(mitigation="uard"):
        if r["panel"] == "colluding" or r["noise"] > 1.2:
            continue
        hacks, goals = (results.of(r.cell, m) for m in ("hacks", "success_rate"))
        least = HACKS if r["noise"] else 0.15
        if hacks.mean > least:
            out.append(Loss("fails", "grids", f"more than {least:g} trap visits", _name(r), ours=hacks, metric="hacks"))
        if goals.mean < 0.98:
            out.append(Loss("fails", "grids", "less than 98 % goals", _name(r), ours=goals, metric="goal rate"))
    return out


def _denied(results: StudyResults) -> list[Loss]:
    """One rater of several who denies the goal: where `uard` loses it, and who does not."""
    ours = list(results.studies["dissent"].where(mitigation="uard"))
    pairs = [(x, r) for r in ours for x in results.studies["dissent"].where(panel=r["panel"]) if x is not r]
    family = results.compare([(x.cell, r.cell) for x, r in pairs], "success_rate")
    out = []
    for r in ours:
        better = [i for i, (x, mine) in enumerate(pairs) if mine is r and family.above(i) and x["mitigation"] != ORACLE]
        if better:
            i = max(better, key=lambda i: results.of(pairs[i][0].cell, "success_rate").mean)
            best = pairs[i][0]
            rules = "rule reaches" if len(better) == 1 else "rules reach"
            own, theirs = (results.of(x.cell, "success_rate") for x in (r, best))
            what = f"one rater against all others takes the goal away; {len(better)} {rules} it more often"
            why = "of three nobody can know who is right; of five vetoes=1 overrules a lone one"
            against = (best["mitigation"], own, theirs, "share of goals", *of_family(family, i))
            out.append(Loss("beaten", "grids", what, r["panel"], *against, why=why))
    return out


def _learned(results: StudyResults) -> list[Loss]:
    """The reward that is itself a model of ratings."""
    out = []
    for r in results.studies["sources"].where(mitigation="uard-0.1", sources="sigma_m and sigma_h"):
        hacks, goals = (results.of(r.cell, m) for m in ("hacks", "success_rate"))
        if hacks.mean > 1 or goals.mean < 0.95:
            metric, ours = ("hacks", hacks) if hacks.mean > 1 else ("share of goals", goals)
            where = ", ".join(f"{k} {v}" for k, v in r.labels if k not in ("mitigation", "sources"))
            why = "a tenth of what nobody has rated is believed, and the model extrapolates far"
            what = "uard-0.1 fails where the reward is itself a model of ratings"
            out.append(Loss("fails", "grids, uard-0.1", what, where, ours=ours, metric=metric, why=why))
    return out


def _beaten(results: StudyResults, study: str, shown: tuple[str, ...]) -> list[Loss]:
    """Every setting of a study in which another mitigation has the higher true return, if only in its mean."""
    rows = [r for r in results.studies[study].where(mitigation="uard") if r["panel"] != "colluding"]
    pairs = [
        (rival, r)
        for r in rows
        for rival in results.studies[study].where(**{k: r[k] for k in shown})
        if rival["mitigation"] not in ("uard", ORACLE)
    ]
    family = results.compare([(rival.cell, r.cell) for rival, r in pairs], "true_return")
    best: dict[Row, int] = {}
    for i, (rival, r) in enumerate(pairs):
        mean = results.of(rival.cell, "true_return").mean
        if r not in best or mean > results.of(pairs[best[r]][0].cell, "true_return").mean:
            best[r] = i
    above = [i for i in range(len(pairs)) if family.above(i)]
    higher = [i for r, i in best.items() if i not in above and _higher(results, pairs[i][0], r)]
    return [_loss(results, *pairs[i], family, i) for i in (*above, *higher)]


def _higher(results: StudyResults, rival: Row, ours: Row) -> bool:
    """Whether a rival's mean is higher by more than a hundredth of ours: less is nobody's loss."""
    theirs, own = (results.of(r.cell, "true_return").mean for r in (rival, ours))
    return theirs - own > 0.01 * abs(own)


def _loss(results: StudyResults, rival: Row, ours: Row, family: Family, i: int) -> Loss:
    name = rival["mitigation"]
    told = family.above(i)
    return Loss(
        "beaten" if told else "no better",
        "grids",
        f"{name} earns more" if told else f"{name} has the highest mean",
        _name(ours),
        name,
        results.of(ours.cell, "true_return"),
        results.of(rival.cell, "true_return"),
        "true return",
        *of_family(family, i),
    )


def _name(r: Row) -> str:
    return ", ".join(f"{k} {v}" for k, v in r.labels if k != "mitigation")


def tables(results: StudyResults) -> list[Table]:
    """Return all tables."""
    matrices = (_matrix(results, metric) for metric in ("true_return", "hacks", "success_rate"))
    return [*matrices, _twins(results), _dissent(results), _calibration(results), _sources(results)]


def pictures(results: StudyResults) -> list[Picture]:
    """Return all pictures."""
    return [figures.competition(results), figures.budgets(results)]


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
                table.append((panel, f"{trap:+g}", name, *s))
    columns = ("panel", "trap", "mitigation", *(f"noise {z:g}" for z in noises))
    note = "Noise is the sd in reward units on every rater; divide by 4 for the fraction of a +4 trap."
    note = f"{note} {_against_ours(results, 'matrix', metric, size=10)}"
    return Table(f"10x10: {words(metric)} of every mitigation", columns, tuple(table), 3, note)


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
                    shares.append(Number.of_summary(s, scale=100 / raw))
                rows.append((f"{size}x{size}", f"{trap:+g}", panel, *shares))
    return Table(
        "Legitimate twins: the bonus is real and the raters say so; true return kept, % of the raw agent's",
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
        rows.append((panel, *found))
    return Table(
        "One rater against all others: share of episodes that reach the goal, 10x10",
        ("panel", *names),
        tuple(rows),
        1,
        "Whoever denies the goal, which pays 10 and is worth it, tells the truth elsewhere, as the others do everywhere "
        "(noise of sd 0.1). In the last rows all but one are drawn towards what a trap seems to pay. Of three raters nobody "
        "can know who is right. Of five, uard may overrule one who is alone, low and no more precise than the others "
        "(vetoes=1), and then overrules the only one who tells the truth, too. "
        f"{_against_ours(results, 'dissent', 'success_rate')}",
    )


def _calibration(results: StudyResults) -> Table:
    rows = []
    for panel in ("main", "appendix", "colluding"):
        for noise in (0.0, 0.3, 1.2, 3.3):
            r = results.row("matrix", mitigation="uard", size=10, trap=4.0, panel=panel, noise=noise)
            values = np.stack([x.extra["calibration"] for x in results.results(r.cell)]).astype(float)
            rows.append((panel, f"{noise:g}", *(statistics.summarise(values[:, i]) for i in range(len(CALIBRATION)))))
    return Table(
        "Does sigma tell the truth (A15)? 10x10, what uard has learned of its raters",
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
                Number.of_summary(means["hacks"], of="models"),
                worst,
                Number.of_summary(means["true_return"], of="models"),
                f"{solved} of {len(cells)}",
            )
        )
    return Table(
        "Which source does the work? The reward is a model of ratings, learned from a part of the grid",
        ("mitigation", "sources", "hacks per episode", "of the worst model", "true return", "solved"),
        tuple(rows),
        2,
        "Five reward models (mean over models of the mean over seeds); solved: at most 1 hack and 95 % goals. Inside the "
        "rated part the trap is contested (sigma_h), outside the model extrapolates (sigma_m). The plain filter needs "
        "both, and a far larger lambda than the paper's. uard-0.1 believes a tenth of what nobody rated.",
    )
