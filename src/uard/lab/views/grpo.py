"""GRPO against learned reward models: gold and proxy along the way from the start, and rules at equal distance."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from uard.lab.statistics import Family, compare_all, summarise
from uard.lab.studies import grpo
from uard.lab.study import Row
from uard.lab.views import figures
from uard.lab.views.figures import Chart, Picture
from uard.lab.views.losses import Loss, of_family
from uard.lab.views.palette import DOTTED, look
from uard.lab.views.published import Published, packaged_json
from uard.lab.views.sections import Section
from uard.lab.views.tables import Number, Table, bounds, number
from uard.lab.views.templates import picture, table

STUDY = "grpo"
OURS, ORACLE = "uard", "true reward"
DISTANCES = (0.5, 1.0, 2.0)  # KL from the start, nats per answer
NEAR = DISTANCES.index(1.0)  # the one that a guide quotes
TICKS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)


def published() -> Published:
    """Return what was published of the study."""
    return Published([grpo.study()], [packaged_json("grpo.json")])


def at_distance(divergence: np.ndarray, gold: np.ndarray, distance: float) -> float:
    """Return the gold of a run when it first is so far from the start, NaN if it never is.

    Examples:
        >>> at_distance(np.array([0.0, 1.0, 0.8, 3.0]), np.array([1.0, 2.0, 5.0, 0.0]), distance=2.0)
        1.0

    Args:
        divergence: Along training, (points,); what is less than before counts as standing still.
        gold: The same of gold.
        distance: KL, > 0.
    """
    farthest = np.maximum.accumulate(divergence)
    after = int(np.searchsorted(farthest, distance))
    if after == len(farthest):
        return float("nan")
    if after == 0:
        return float(gold[0])
    # The last point that was farthest until then, and the first that is beyond.
    before = int(np.flatnonzero(divergence[:after] == farthest[after - 1])[0])
    share = (distance - divergence[before]) / (divergence[after] - divergence[before])
    return float(gold[before] + share * (gold[after] - gold[before]))


@dataclass(frozen=True)
class Compared:
    """What a rule's gold is at some distances, seed by seed.

    Attributes:
        row: Of the study.
        gold: (seeds, distances), NaN where a run does not come so far.
        end: Gold over the last tenth of training, (seeds,).
    """

    row: Row
    gold: np.ndarray
    end: np.ndarray


def compared(p: Published, row: Row) -> Compared:
    """Read a row off its curves."""
    divergence, gold = p.derived(row, "divergence"), p.derived(row, "gold")
    rows = [[at_distance(d, g, x) for x in DISTANCES] for d, g in zip(divergence, gold, strict=True)]
    return Compared(row, np.array(rows), _end(gold))


def _end(values: np.ndarray) -> np.ndarray:
    return values[:, -max(1, values.shape[1] // 10) :].mean(1)


def conditions(p: Published) -> Iterator[tuple[str, list[Compared]]]:
    """Yield conditions and the rules that were published in each."""
    rows = p.rows(STUDY)
    for condition in dict.fromkeys(r["condition"] for r in rows):
        yield condition, [compared(p, r) for r in rows if r["condition"] == condition]


def against_ours(rules: list[Compared]) -> tuple[list[tuple[Compared, int]], Family]:
    """Test the gold of every rival at every distance against that of ``uard``, on the seeds in which both come so far.

    Returns:
        Rivals and numbers of distances (the last is the end of training), and their family of comparisons.
    """
    (ours,) = (r for r in rules if r.row["rule"] == OURS)
    rivals = [r for r in rules if r.row["rule"] not in (OURS, ORACLE)]
    which = [(r, i) for r in rivals for i in range(len(DISTANCES) + 1) if _both(r, ours, i)[0]]
    return which, compare_all([_both(r, ours, i) for r, i in which])


def _both(one: Compared, other: Compared, i: int) -> tuple[list[float], list[float]]:
    a, b = ((r.end if i == len(DISTANCES) else r.gold[:, i]) for r in (one, other))
    reached = ~(np.isnan(a) | np.isnan(b))
    return a[reached].tolist(), b[reached].tolist()


def _shown(values: np.ndarray) -> Number | None:
    """Return mean and interval, and how many runs it is of where not all come so far."""
    here = values[~np.isnan(values)]
    if not len(here):
        return None
    note = "" if len(here) == len(values) else f"{len(here)} of {len(values)}"
    return Number.of_summary(summarise(here), note=note)


def tables(p: Published) -> list[Table]:
    """Return a table for every condition."""
    out = []
    columns = ("rule", *(f"gold at KL {x:g}" for x in DISTANCES), "gold at the end", "KL there", "loose words there")
    for condition, rules in conditions(p):
        lines = [
            (
                r.row["rule"],
                *(_shown(column) for column in r.gold.T),
                _shown(r.end),
                *(summarise(_end(p.derived(r.row, name))) for name in ("divergence", "loose")),
            )
            for r in rules
        ]
        has_ours = any(r.row["rule"] == OURS for r in rules)
        caption = f" Rivals against uard: {against_ours(rules)[1].caption()}" if has_ours else ""
        seeds = len(p.seeds_of(rules[0].row))
        note = (
            f"What an answer is really worth; means [95 %] over {seeds} seeds (of fewer where not all come so far). KL "
            f"from the start, nats per answer. The end is the last tenth of {grpo.STEPS} steps of GRPO.{caption}"
        )
        out.append(Table(f"GRPO, {condition}", columns, tuple(lines), 1, note))
    return out


def headline(p: Published) -> str:
    """Return the table that the guide quotes, in Markdown: gold of every rule, condition by condition."""
    every = dict(conditions(p))
    columns = [f"{condition}, {place}" for condition in every for place in ("KL 1", "end")]
    lines = [f"| rule | {' | '.join(columns)} |", "|---" * (1 + len(columns)) + "|"]
    for name in dict.fromkeys(r["rule"] for r in p.studies[STUDY].rows):
        cells = []
        for rules in every.values():
            found = next((r for r in rules if r.row["rule"] == name), None)
            cells += ["–", "–"] if found is None else [_quoted(found.gold[:, NEAR]), _quoted(found.end)]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join([*lines, "", *(f"{condition}: {_over_mean(rules)}" for condition, rules in every.items())])


def _quoted(values: np.ndarray) -> str:
    shown = _shown(values)
    if shown is None:
        return "–"
    return f"{number(shown.mean)}{bounds(shown.ci95)}" + (f" ({shown.note})" if shown.note else "")


def _over_mean(rules: list[Compared]) -> str:
    """Say by how much the gold of ``uard`` is above that of the plain mean, and what of its rivals is told apart."""
    by_rule = {r.row["rule"]: r for r in rules}
    if not {OURS, "mean"} <= set(by_rule):
        return "not trained yet."
    parts = []
    for i in range(len(DISTANCES) + 1):
        ours, mean = map(np.array, _both(by_rule[OURS], by_rule["mean"], i))
        if len(ours) > 1:
            difference = summarise(ours - mean)
            parts.append(f"{difference.mean:+.2f}{bounds(difference.ci95)} {_place(i)}")
    which, family = against_ours(rules)
    above = [f"{r.row['rule']} {_place(i)}" for k, (r, i) in enumerate(which) if family.above(k)]
    below = [f"{r.row['rule']} {_place(i)}" for k, (r, i) in enumerate(which) if family.below(k)]
    told = f"better than `uard`: {', '.join(above) or 'none'}; worse: {', '.join(below) or 'none'}"
    return f"`uard` less the plain mean, by seed, {', '.join(parts)}. After Holm correction {told}. {family.caption()}"


def losses(p: Published) -> list[Loss]:
    """Say where a rule is better than ``uard``, and where its gold falls from its best, found by rule."""
    out: list[Loss] = []
    for condition, rules in conditions(p):
        ours = next((r for r in rules if r.row["rule"] == OURS), None)
        if ours is None:
            continue
        which, family = against_ours(rules)
        for k, (r, i) in enumerate(which):
            if family.above(k):
                theirs, own = map(summarise, _both(r, ours, i))
                name = r.row["rule"]
                numbers = (name, own, theirs, "gold", *of_family(family, k))
                out.append(Loss("beaten", "GRPO", f"{name} has more gold {_place(i)}", condition, *numbers))
        gold = p.derived(ours.row, "gold")
        peak = int(np.argmax(gold.mean(0)))
        lost = summarise(ours.end - gold[:, peak])
        if lost.ci95 is not None and lost.ci95[1] < 0:
            what = f"gold falls again after step {round(grpo.STEPS * peak / (gold.shape[1] - 1))}"
            numbers = ("its best", summarise(ours.end), summarise(gold[:, peak]), "gold")
            seeds = f"paired 95 % interval below 0, {len(gold)} seeds"
            why = "every rule of judges is over-optimised in the end; stop by KL"
            out.append(Loss("fails", "GRPO", what, condition, *numbers, note=seeds, why=why))
    return out


def _place(i: int) -> str:
    return "at the end" if i == len(DISTANCES) else f"at KL {DISTANCES[i]:g}"


def picture_of(p: Published) -> Picture:
    """Draw gold (lines) and the score of ``uard`` (dotted) against KL for every condition: means over seeds."""
    every = list(conditions(p))
    titles = [condition for condition, _ in every]
    chart = Chart(titles, "KL from the start, nats per answer", "gold of an answer", columns=2, height=4.0)
    for i, (_, rules) in enumerate(every):
        chart.axes[i].set_xscale("symlog", linthresh=1.0)
        farthest = 0.0
        for r in rules:
            name = r.row["rule"]
            kl, gold, proxy = (p.derived(r.row, x).mean(0) for x in ("divergence", "gold", "proxy"))
            order = np.argsort(kl)
            farthest = max(farthest, float(kl.max()))
            chart.line(i, kl[order], gold[order], name)
            if name == OURS:
                scored = look(OURS)._replace(dash=DOTTED, width=1.2)
                chart.line(i, kl[order], proxy[order], f"{OURS}: judges", look_of=scored)
        chart.axes[i].set_xlim(0.0, 1.05 * farthest)
        chart.plain(i, [x for x in TICKS if x <= farthest])
    note = (
        "See where gold falls although the judges' mean (dotted, of uard) still rises: there the judges are "
        "over-optimised. Lines are means over seeds, drawn in the order of their KL; beyond 1 nat by its logarithm."
    )
    made = figures.made_by(p.sources, STUDY, f"uard reproduce {STUDY}")
    return chart.picture("grpo", "GRPO: gold against how far the policy went", note, made)


def section(p: Published) -> list[Section]:
    """Return the section of the report; nothing where nothing was published."""
    if not p.rows(STUDY):
        return []
    lost = len(p.studies[STUDY].rows) - len(p.rows(STUDY))
    missing = f"<p>{lost} of the {len(p.studies[STUDY].rows)} rows are not trained yet.</p>" if lost else ""
    drawn = picture_of(p)
    html = "".join([missing, picture(drawn), *map(table, tables(p))])
    return [
        Section(
            STUDY,
            "GRPO against learned reward models",
            92,
            html,
            "GRPO",
            losses=tuple(losses(p)),
            files=figures.files([drawn]),
        )
    ]
