"""GRPO against learned reward models: gold and proxy along the way from the start, and rules at equal distance."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from uard.lab.statistics import Family, compare_all, interval, summarise
from uard.lab.studies import grpo
from uard.lab.study import Row
from uard.lab.views import figures
from uard.lab.views.published import Published, packaged_json
from uard.lab.views.sections import Section
from uard.lab.views.tables import Table, bounds, number
from uard.lab.views.templates import picture, table

STUDY = "grpo"
OURS, ORACLE = "uard", "true reward"
DISTANCES = (0.5, 1.0, 2.0)  # KL from the start, nats per answer
NEAR = DISTANCES.index(1.0)  # the one that a guide quotes
TICKS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
COLOURS = {
    "one model": "#777777",
    "mean": "#8c6d31",
    "median": "#c9a66b",
    "lowest": "#17a2b8",
    "uwo": "#d6589f",
    "log-mean-exp": "#9467bd",
    "lcb": "#3b5bdb",
    "true reward": "#222222",
    "uard": "#1b8a4b",
}


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


def _shown(values: np.ndarray) -> str:
    """Return mean and interval, and how many runs it is of where not all come so far."""
    here = values[~np.isnan(values)]
    if not len(here):
        return "–"
    ends = interval(here) if len(here) > 1 else None
    of = "" if len(here) == len(values) else f" ({len(here)} of {len(values)})"
    return f"{number(float(here.mean()))}{bounds(ends)}{of}"


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
                *(number(summarise(_end(p.derived(r.row, name))).mean) for name in ("divergence", "loose")),
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
            cells += ["–", "–"] if found is None else [_shown(found.gold[:, NEAR]), _shown(found.end)]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join([*lines, "", *(f"{condition}: {_over_mean(rules)}" for condition, rules in every.items())])


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


def losses(p: Published) -> list[str]:
    """Say where a rule is better than ``uard``, and where nothing is told apart, found by rule."""
    out = []
    for condition, rules in conditions(p):
        if not any(r.row["rule"] == OURS for r in rules):
            continue
        which, family = against_ours(rules)
        ours = next(r for r in rules if r.row["rule"] == OURS)
        better = []
        for k, (r, i) in enumerate(which):
            if family.above(k):
                theirs, own = (np.mean(x) for x in _both(r, ours, i))
                better.append(f"{r.row['rule']} {_place(i)}: {theirs:.2f} against {own:.2f}")
        gold, kl = (p.derived(ours.row, name).mean(0) for name in ("gold", "divergence"))
        peak = int(np.argmax(gold))
        worse = "; ".join(better) if better else "no rule is told apart from uard as better"
        out.append(
            f"GRPO, {condition}: {worse}. The gold of uard is {gold[0]:.2f} at the start, {gold[peak]:.2f} at its best "
            f"(KL {kl[peak]:.1f}) and {ours.end.mean():.2f}{bounds(interval(ours.end))} at the end (KL {kl[-1]:.1f})."
        )
    return out


def _place(i: int) -> str:
    return "at the end" if i == len(DISTANCES) else f"at KL {DISTANCES[i]:g}"


def figure(p: Published) -> Figure:
    """Draw gold (lines) and proxy (dotted) against KL for every condition: means over seeds at each step."""
    every = list(conditions(p))
    drawn, axes = figures.axes_of(len(every), 4.4, 4.0)
    for axis, (condition, rules) in zip(axes, every, strict=True):
        for r in rules:
            name = r.row["rule"]
            kl, gold, proxy = (p.derived(r.row, x).mean(0) for x in ("divergence", "gold", "proxy"))
            order = np.argsort(kl)
            width = 2.2 if name == OURS else 1.2
            axis.plot(kl[order], gold[order], color=COLOURS[name], lw=width, label=name)
            axis.plot(kl[order], proxy[order], color=COLOURS[name], lw=0.8, ls=":")
        axis.set(xlabel="KL from the start, nats per answer", title=condition)
        axis.set_xscale("symlog", linthresh=1.0)
        axis.set_xlim(left=0.0)
        axis.set_xticks(TICKS, [f"{x:g}" for x in TICKS])
    axes[0].set_ylabel("gold, and the judges' mean")
    drawn.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=9)
    return drawn


def section(p: Published) -> list[Section]:
    """Return the section of the report; nothing where nothing was published."""
    if not p.rows(STUDY):
        return []
    lost = len(p.studies[STUDY].rows) - len(p.rows(STUDY))
    missing = f"<p>{lost} of the {len(p.studies[STUDY].rows)} rows are not trained yet.</p>" if lost else ""
    note = (
        "Lines: gold, mean over seeds. Dotted: the mean of the judges' standardised scores; where it rises and gold "
        "falls, the judges are over-optimised. A line is drawn in the order of its KL."
    )
    image = picture("GRPO: gold and proxy against KL", note, figures.data_uri(figure(p)))
    html = "".join([missing, image, *map(table, tables(p))])
    return [Section(STUDY, "GRPO against learned reward models", 92, html, "GRPO", losses=tuple(losses(p)))]
