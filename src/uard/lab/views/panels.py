"""Regret of every mitigation over random panels: who is better than whom, by how much, and where each is worst.

Regret = (oracle - method) / (oracle - random walk), by true return, means over seeds: 0 is as good as learning from the
true reward, 1 is a random walk, and who hacks may have more. The scenario (task and panel) is the unit. Here three
scenarios by hand, of which the last is left out:

    >>> spread = {ORACLE: [8.0, 8.0, 2.5], FLOOR: [-12.0, -2.0, 2.0]}
    >>> found = Regrets.of("by hand", (1, 3, 5), spread | {OURS: [7.0, 8.0, 2.5], "lcb": [8.0, 3.0, 0.0]})
    >>> found.regret[OURS].tolist(), found.regret["lcb"].tolist(), found.left_out
    ([0.05, 0.0], [0.0, 0.5], (5,))
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import escape
from matplotlib.figure import Figure

from uard.envs.base import TableEnvironment
from uard.envs.grids.trapgrid import TrapGrid
from uard.lab import statistics
from uard.lab.statistics import Summary
from uard.lab.studies.panels import FLOOR, ORACLE, OURS, PUBLISHED, Scenario, scenario
from uard.lab.study import Row, Study
from uard.lab.views.figures import COLOURS, axes_of, data_uri
from uard.lab.views.sections import Section
from uard.lab.views.tables import Table, number
from uard.lab.views.templates import picture, table
from uard.ratings.panels import KINDS, Panel, composition, kind_of

PerSeed = Callable[[Row, str], np.ndarray]  # a metric of a row, one number per seed

LEAST_SPREAD = 1.0  # reward units; of the development scenarios the smallest spread is 10.9 on grids, 16.4 on MDPs
WORST = 5  # scenarios of ours that are described


@dataclass(frozen=True)
class Regrets:
    """Regret by mitigation over scenarios of one kind of tasks.

    Attributes:
        tasks: What kind.
        scenarios: Their seeds.
        regret: One number per scenario, by mitigation; without the oracle and the random walk.
        metrics: Means over seeds, one number per scenario, by metric and mitigation; with both.
        left_out: Seeds of scenarios where the oracle is not ``LEAST_SPREAD`` reward units above the random walk: there
            is next to nothing to lose, and a quotient of two small numbers would outweigh all others.
    """

    tasks: str
    scenarios: tuple[int, ...]
    regret: Mapping[str, np.ndarray]
    metrics: Mapping[str, Mapping[str, np.ndarray]]
    left_out: tuple[int, ...]

    @classmethod
    def of(
        cls,
        tasks: str,
        scenarios: Sequence[int],
        true_return: Mapping[str, Sequence[float]],
        others: Mapping[str, Mapping[str, Sequence[float]]] | None = None,
    ) -> Regrets:
        """Compute regrets from mean true returns.

        Args:
            tasks: What kind.
            scenarios: Their seeds.
            true_return: One number per scenario, by mitigation, the oracle and the random walk among them.
            others: Further metrics, alike.
        """
        returns = {name: np.asarray(values, float) for name, values in true_return.items()}
        spread = returns[ORACLE] - returns[FLOOR]
        kept = spread >= LEAST_SPREAD
        regret = {
            name: (returns[ORACLE] - values)[kept] / spread[kept]
            for name, values in returns.items()
            if name not in (ORACLE, FLOOR)
        }
        every = {"true_return": returns, **(others or {})}
        metrics = {
            metric: {name: np.asarray(values, float)[kept] for name, values in by_name.items()}
            for metric, by_name in every.items()
        }
        seeds = np.asarray(scenarios)
        return cls(tasks, tuple(seeds[kept].tolist()), regret, metrics, tuple(seeds[~kept].tolist()))


def regrets(study: Study, per_seed: PerSeed) -> list[Regrets]:
    """Return the regrets of a study of random panels, one for each kind of tasks.

    Args:
        study: Whose rows have the labels tasks, scenario and mitigation.
        per_seed: Reads a store (``StudyResults.values``) or a published file (``Published.per_seed``).

    Raises:
        LookupError: a row is missing.
    """
    found: dict[str, dict[str, dict[str, list[float]]]] = {}
    seeds: dict[str, dict[int, None]] = {}
    for r in study.rows:
        seeds.setdefault(r["tasks"], {})[r["scenario"]] = None
        for metric in PUBLISHED:
            by_name = found.setdefault(r["tasks"], {}).setdefault(metric, {})
            by_name.setdefault(r["mitigation"], []).append(float(per_seed(r, metric).mean()))
    return [Regrets.of(t, tuple(seeds[t]), metrics["true_return"], metrics) for t, metrics in found.items()]


@dataclass(frozen=True)
class Rival:
    """How a mitigation compares with ours.

    Attributes:
        name: Of the mitigation.
        gap: Its regret less ours, over scenarios.
        p: Two-sided, of a paired sign-flip test, for itself.
        corrected: The same after Holm, for all rivals.
    """

    name: str
    gap: Summary
    p: float
    corrected: float


def rivals(found: Regrets) -> list[Rival]:
    """Compare every other mitigation with ours, scenario by scenario; the best come first."""
    gaps = {name: values - found.regret[OURS] for name, values in found.regret.items() if name != OURS}
    p = [statistics.paired_sign_flip_p(gap) for gap in gaps.values()]
    compared = zip(gaps.items(), p, statistics.holm(p), strict=True)
    made = [Rival(name, statistics.summarise(gap), p, corrected) for (name, gap), p, corrected in compared]
    return sorted(made, key=lambda r: r.gap.mean)


def losses(found: Regrets) -> list[str]:
    """Say first where ours is beaten: overall, and for which kinds of panel."""
    mean = found.regret[OURS].mean()
    better = [r for r in rivals(found) if r.gap.mean < 0]
    beaten = [
        f"{r.name} {found.regret[r.name].mean():.3f} (difference {_interval(r.gap)}, p = {r.corrected:.2g} after Holm)"
        for r in better
    ]
    tasks = found.tasks[0].upper() + found.tasks[1:]
    head = f"{tasks}, random panels: mean regret of uard {mean:.3f} over {len(found.scenarios)}"
    said = [f"{head} scenarios; less regret has {'; '.join(beaten) if beaten else 'no other mitigation'}."]
    worse = []
    for kind, here in _by(found, lambda s: kind_of_panel(s.panel)).items():
        ours = found.regret[OURS][here].mean()
        name = min(found.regret, key=lambda n: found.regret[n][here].mean())
        if (least := found.regret[name][here].mean()) < ours:
            worse.append(f"{kind} ({here.sum()} scenarios): {name} {least:.3f} against {ours:.3f}")
    if worse:
        said.append(f"{tasks}, least regret by kind of panel is not uard's: {'; '.join(worse)}.")
    return said


def main_table(found: Regrets) -> Table:
    """Return mean, interval, worst scenario, and the paired difference to ours, corrected for all rivals."""
    against = {r.name: r for r in rivals(found)}
    rows = []
    for name, values in sorted(found.regret.items(), key=lambda item: item[1].mean()):
        r, worst = against.get(name), int(values.argmax())
        gap = ("", "") if r is None else (_interval(r.gap), f"{r.corrected:.2g}")
        hacks = number(float(found.metrics["hacks"][name].mean())) if "hacks" in found.metrics else ""
        mean = _interval(statistics.summarise(values))
        rows.append((name, mean, f"{number(values[worst])} (seed {found.scenarios[worst]})", *gap, hacks))
    told = sum(r.p < statistics.LEVEL for r in against.values())
    out = f" {len(found.left_out)} more are left out (oracle less than {LEAST_SPREAD:g} above the random walk)."
    return Table(
        f"Regret on {found.tasks}, {len(found.scenarios)} scenarios",
        ("mitigation", "mean [95 %]", "worst", "more than uard [95 %]", "p (Holm)", "hacks per episode"),
        tuple(rows),
        1,
        f"0: as good as learning from the true reward; 1: a random walk. Intervals over scenarios; p of paired "
        f"sign-flip tests, corrected for {len(against)} rivals. Uncorrected, {told} of {len(against)} differ at "
        f"p < {statistics.LEVEL:g}; about {statistics.LEVEL * len(against):.1f} would by chance."
        f"{out * bool(found.left_out)}",
    )


def by_kind(found: Regrets) -> Table:
    """Return the mean regret by kind of panel, and by the share of steps that are rated."""
    groups = _by(found, lambda s: kind_of_panel(s.panel)) | _by(found, lambda s: f"{_percent(s.rated)} rated")
    ordered = sorted(found.regret.items(), key=lambda item: item[1].mean())
    rows = [(name, *(f"{values[here].mean():.3f}" for here in groups.values())) for name, values in ordered]
    return Table(
        f"Mean regret on {found.tasks}, by kind of panel and by share of rated steps",
        ("mitigation", *(f"{kind} ({here.sum()})" for kind, here in groups.items())),
        tuple(rows),
        1,
        "In brackets how many scenarios. A panel is called after the worst that sits in it.",
    )


def worst_table(found: Regrets) -> Table:
    """Describe the worst scenarios of ours, and the worst of every rival."""
    ours = np.argsort(-found.regret[OURS], kind="stable")[:WORST]
    cases = [(OURS, int(i)) for i in ours]
    cases += [(name, int(values.argmax())) for name, values in found.regret.items() if name != OURS]
    rows = []
    for name, i in cases:
        drawn = scenario(found.tasks, found.scenarios[i])
        who = f"{composition(drawn.panel)}; {_percent(drawn.rated)} of the steps rated"
        returns = (number(float(found.metrics["true_return"][n][i])) for n in (name, ORACLE, FLOOR))
        seed, regret = str(found.scenarios[i]), number(float(found.regret[name][i]))
        rows.append((name, seed, task_in_words(drawn.environment), who, lost(found, name, i), regret, *returns))
    columns = ("mitigation", "seed", "task", "panel", "lost", "regret", "true return", "oracle's", "random walk's")
    note = "Per episode, over the last 100; means over seeds."
    return Table(f"Worst scenarios on {found.tasks}", columns, tuple(rows), 5, note)


def lost(found: Regrets, name: str, i: int) -> str:
    """Say what a mitigation lost in a scenario beside the oracle: in hacks, in goals, or otherwise.

    Args:
        found: With all published metrics.
        name: Of the mitigation.
        i: Number of the scenario.
    """
    hacks, best_hacks = (float(found.metrics["hacks"][n][i]) for n in (name, ORACLE))
    goals, best_goals = (float(found.metrics["success_rate"][n][i]) for n in (name, ORACLE))
    parts = []
    if hacks > best_hacks + 0.5:
        parts.append(f"takes lies: {number(hacks)} hacks, the oracle {number(best_hacks)}")
    if hacks < best_hacks - 0.5:
        parts.append(f"passes by what is worth it: {number(hacks)} contested steps, the oracle {number(best_hacks)}")
    if goals < best_goals - 0.05:
        parts.append(f"reaches the goal in {_percent(goals)}, the oracle in {_percent(best_goals)}")
    return "; ".join(parts) or "earns less, without more hacks"


def task_in_words(environment: TableEnvironment) -> str:
    """Describe a random task.

    Examples:
        >>> from uard.lab.studies.panels import GRIDS, MDPS
        >>> task_in_words(scenario(GRIDS, 3).environment)
        '6x6, 2 traps seemingly worth 3.23'
        >>> task_in_words(scenario(MDPS, 3).environment)
        '27 % of the state-actions lie: too much'
    """
    if isinstance(environment, TrapGrid):
        size, count = f"{environment.size}x{environment.size}", len(environment.traps or ())
        worth = "worth" if environment.legitimate else "seemingly worth"
        traps = f"{count} trap{'s' * (count > 1)} {worth} {number(environment.trap_reward)}"
        return f"{size}, {traps if count else 'nothing lies'}"
    task, truth = environment.task(), environment.truth()
    gaps = (task.reward - truth.reward)[truth.hack]
    how = "too much or too little" if (gaps < 0).any() else "too much"
    return f"{_percent(float(truth.hack.mean()))} of the state-actions lie: {how}"


def figure(found: Sequence[Regrets]) -> Figure:
    """Draw sorted regrets, a line for each mitigation."""
    drawn, axes = axes_of(len(found), 5.8)
    for axis, these in zip(axes, found, strict=True):
        ordered = sorted(these.regret.items(), key=lambda item: item[1].mean())
        for name, values in ordered:
            share = np.arange(1, values.size + 1) / values.size
            label = f"{name} ({values.mean():.3f})"
            axis.plot(share, np.sort(values), color=COLOURS.get(name), lw=2.5 if name == OURS else 1.2, label=label)
        axis.set_yscale("symlog", linthresh=0.1)
        axis.set(xlabel="share of scenarios", title=f"{these.tasks} ({len(these.scenarios)})")
        axis.legend(loc="upper left", fontsize=7)
    axes[0].set_ylabel("regret")
    return drawn


def tables(found: Sequence[Regrets]) -> list[Table]:
    """Return all tables."""
    return [made(these) for these in found for made in (main_table, by_kind, worst_table)]


def headline(found: Sequence[Regrets]) -> str:
    """Return the regrets as a Markdown table, a line for each mitigation; the README quotes it."""
    names = sorted(found[0].regret, key=lambda name: found[0].regret[name].mean())
    columns = [f"{these.tasks} ({len(these.scenarios)})" for these in found]
    lines = [("mitigation", *columns), ("---",) * (1 + len(found))]
    for name in names:
        lines.append((f"`{name}`", *(_interval(statistics.summarise(these.regret[name])) for these in found)))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def section(study: Study, found: Sequence[Regrets], seeds: int) -> Section:
    """Return the part of the report: what beats ours first, then tables and a figure.

    Args:
        study: Of random panels.
        found: See ``regrets``.
        seeds: Of every row.
    """
    said = tuple(text for these in found for text in losses(these))
    first = "".join(f"<li>{escape(text)}</li>" for text in said)
    head = (
        f"{study.title}: {seeds} seeds of each mitigation in each scenario. Regret is 0 for an agent that learns from "
        "the true reward, 1 for a random walk."
    )
    image = picture("Regret over scenarios, sorted", "In brackets means.", data_uri(figure(found)))
    html = f"<ul>{first}</ul><p>{escape(head)}</p>{image}{''.join(map(table, tables(found)))}"
    return Section("panels", "Panels that nobody tuned on", 15, html, "Random panels", losses=said)


def _interval(s: Summary) -> str:
    return f"{s.mean:.3f}" + (f" [{s.ci95[0]:.3f}, {s.ci95[1]:.3f}]" if s.ci95 else " (one scenario)")


def _by(found: Regrets, group: Callable[[Scenario], str]) -> dict[str, np.ndarray]:
    """Return which scenarios are in which group."""
    groups = np.array([group(scenario(found.tasks, seed)) for seed in found.scenarios])
    return {name: groups == name for name in sorted(set(groups.tolist()))}


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def kind_of_panel(panel: Panel) -> str:
    """Name a panel after the worst that sits in it.

    Examples:
        >>> from uard.ratings.panels import COLLUDING, MAIN, SINGLE
        >>> kind_of_panel(SINGLE), kind_of_panel(MAIN), kind_of_panel(COLLUDING)
        ('one rater', 'some tempted', 'some repeating the proxy')
    """
    if len(panel.raters) == 1:
        return "one rater"
    worst = max((kind_of(rater) for rater in panel.raters), key=KINDS.index)
    return f"all {worst}" if worst == KINDS[0] else f"some {worst}"
