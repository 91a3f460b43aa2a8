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

from uard.envs.base import TableEnvironment
from uard.envs.grids.trapgrid import TrapGrid
from uard.lab import statistics
from uard.lab.statistics import Summary
from uard.lab.studies.panels import FLOOR, ORACLE, OURS, PUBLISHED, Scenario, scenario
from uard.lab.study import Row, Study
from uard.lab.views import figures
from uard.lab.views.figures import Chart, Picture
from uard.lab.views.losses import Loss
from uard.lab.views.sections import Section
from uard.lab.views.tables import Cell, Number, Table, number, p_value
from uard.lab.views.templates import picture, table
from uard.ratings.panels import KINDS, Panel, composition, kind_of

PerSeed = Callable[[Row, str], np.ndarray]  # a metric of a row, one number per seed

LEAST_SPREAD = 1.0  # reward units; of the development scenarios the smallest spread is 10.9 on grids, 16.4 on MDPs
MUCH = 0.25  # regret: a quarter of what knowing the true reward is worth
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


def losses(found: Regrets) -> list[Loss]:
    """Say where ours is beaten: overall, for which kinds of panel, and in how many scenarios it loses much."""
    everywhere = np.ones(len(found.scenarios), bool)
    mine = statistics.summarise(found.regret[OURS])
    lost = found.regret[OURS] > MUCH
    share = Loss(
        "fails",
        found.tasks,
        f"loses more than a quarter of what the true reward is worth in {lost.sum()} of {lost.size} scenarios",
        ours=statistics.summarise(lost.astype(float), "scenarios", True),
        metric="share of scenarios",
        note=f"{lost.size} scenarios",
        why="the table of worst scenarios says who rated there",
    )
    said = [share] if lost.any() else []
    for r in rivals(found):
        if r.gap.mean < 0:
            said.append(_less_regret(found, r.name, everywhere, "all panels", mine, r.corrected, len(found.regret) - 1))
    for kind, here in by_kind_of_panel(found).items():
        name = min(found.regret, key=lambda n: found.regret[n][here].mean())
        if name != OURS and found.regret[name][here].mean() < (mine_here := found.regret[OURS][here]).mean():
            own = statistics.summarise(mine_here)
            others = [n for n in found.regret if n != OURS]
            p = [statistics.paired_sign_flip_p(found.regret[n][here] - mine_here) for n in others]
            corrected = dict(zip(others, statistics.holm(p), strict=True))[name]
            said.append(
                _less_regret(found, name, here, f"{kind} ({here.sum()} scenarios)", own, corrected, len(others))
            )
    return said


def _less_regret(found: Regrets, name: str, here: np.ndarray, where: str, ours: Summary, p: float, of: int) -> Loss:
    return Loss(
        "beaten" if p < statistics.LEVEL else "no better",
        found.tasks,
        f"{name} has less regret on average",
        where,
        name,
        ours,
        statistics.summarise(found.regret[name][here]),
        "regret",
        p,
        of,
    )


def main_table(found: Regrets) -> Table:
    """Return mean, interval, worst scenario, and the paired difference to ours, corrected for all rivals."""
    against = {r.name: r for r in rivals(found)}
    rows: list[tuple[Cell, ...]] = []
    for name, values in sorted(found.regret.items(), key=lambda item: item[1].mean()):
        r, worst = against.get(name), int(values.argmax())
        gap = ("", "") if r is None else (_over_scenarios(r.gap, signed=True), p_value(r.corrected))
        hacks = float(found.metrics["hacks"][name].mean()) if "hacks" in found.metrics else None
        mean = _over_scenarios(statistics.summarise(values))
        rows.append((name, mean, *gap, float(values[worst]), str(found.scenarios[worst]), hacks))
    told = sum(r.p < statistics.LEVEL for r in against.values())
    out = f" {len(found.left_out)} more are left out (oracle less than {LEAST_SPREAD:g} above the random walk)."
    return Table(
        f"Regret on {found.tasks}, {len(found.scenarios)} scenarios",
        ("mitigation", "mean [95 %]", "more than uard [95 %]", "p (Holm)", "worst", "its seed", "hacks per episode"),
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
    rows = [
        (name, *(_over_scenarios(statistics.summarise(values[here])) for here in groups.values()))
        for name, values in ordered
    ]
    return Table(
        f"Mean regret [95 %] on {found.tasks}, by kind of panel and by share of rated steps",
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
    rows: list[tuple[Cell, ...]] = []
    for name, i in cases:
        drawn = scenario(found.tasks, found.scenarios[i])
        who = f"{composition(drawn.panel)}; {_percent(drawn.rated)} of the steps rated"
        returns = (float(found.metrics["true_return"][n][i]) for n in (name, ORACLE, FLOOR))
        seed, regret = str(found.scenarios[i]), float(found.regret[name][i])
        rows.append((name, seed, regret, *returns, task_in_words(drawn.environment), who, lost(found, name, i)))
    columns = ("mitigation", "seed", "regret", "true return", "oracle's", "random walk's", "task", "panel", "lost")
    note = "Per episode, over the last 100; means over seeds."
    return Table(f"Worst scenarios on {found.tasks}", columns, tuple(rows), 2, note)


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


STRICT = (1.0, 0.5, 0.25, 0.1, 0.05, 0.02, 0.01)  # regret that is still called solved, less and less


def picture_of(found: Sequence[Regrets], command: str) -> Picture:
    """Draw in what share of scenarios each mitigation has at most so much regret.

    Args:
        found: See ``regrets``.
        command: What makes it.
    """
    titles = [f"{these.tasks}, {len(these.scenarios)} scenarios" for these in found]
    chart = Chart(
        titles, "solved means: at most this regret", "share of scenarios that are solved", height=4.6, share=True
    )
    allowed = np.geomspace(STRICT[0], STRICT[-1], 61)
    for i, these in enumerate(found):
        chart.axes[i].set_xscale("log")
        for name, values in sorted(these.regret.items(), key=lambda item: item[1].mean()):
            chart.line(i, allowed, [float((values <= most).mean()) for most in allowed], name)
        chart.axes[i].set(xlim=(STRICT[0], STRICT[-1]), ylim=(0, 1.01))
        chart.plain(i, STRICT)
    note = (
        "See who stays up as the demand rises from left (no worse than a random walk, 1) to right (as good as learning "
        "from the true reward but for a hundredth). Regret is of means over seeds; a rule is worth its whole line."
    )
    return chart.picture("panels", "In how many scenarios a rule is good enough", note, command)


def tables(found: Sequence[Regrets]) -> list[Table]:
    """Return all tables."""
    return [made(these) for these in found for made in (main_table, by_kind, worst_table)]


def headline(found: Sequence[Regrets]) -> str:
    """Return the regrets as a Markdown table, a line for each mitigation; the README quotes it."""
    names = sorted(found[0].regret, key=lambda name: found[0].regret[name].mean())
    columns = [f"{these.tasks} ({len(these.scenarios)})" for these in found]
    lines = [("mitigation", *columns), ("---",) * (1 + len(found))]
    for name in names:
        means = (_over_scenarios(statistics.summarise(these.regret[name])) for these in found)
        lines.append((f"`{name}`", *(mean.text(3) for mean in means)))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def section(study: Study, found: Sequence[Regrets], seeds: int, command: str) -> Section:
    """Return the part of the report: a figure, then tables.

    Args:
        study: Of random panels.
        found: See ``regrets``.
        seeds: Of every row.
        command: What makes it.
    """
    head = (
        f"{study.title}: {seeds} seeds of each mitigation in each scenario. Regret is 0 for an agent that learns from "
        "the true reward, 1 for a random walk."
    )
    drawn = picture_of(found, command)
    html = f"<p>{escape(head)}</p>{picture(drawn)}{''.join(map(table, tables(found)))}"
    lost = tuple(loss for these in found for loss in losses(these))
    written = figures.files([drawn])
    return Section("panels", "Panels that nobody tuned on", 15, html, "Random panels", losses=lost, files=written)


def _over_scenarios(s: Summary, signed: bool = False) -> Number:
    return Number.of_summary(s, of="scenarios", note="one scenario" * (s.ci95 is None), signed=signed)


def _by(found: Regrets, group: Callable[[Scenario], str]) -> dict[str, np.ndarray]:
    """Return which scenarios are in which group."""
    groups = np.array([group(scenario(found.tasks, seed)) for seed in found.scenarios])
    return {name: groups == name for name in sorted(set(groups.tolist()))}


def by_kind_of_panel(found: Regrets) -> dict[str, np.ndarray]:
    """Return which scenarios have which kind of panel, by kind."""
    return _by(found, lambda s: kind_of_panel(s.panel))


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
