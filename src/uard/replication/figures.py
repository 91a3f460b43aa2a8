"""The paper's figures (G2-G16) from our runs, with the paper's axes where it has any. Every function returns a picture.

The source of the paper holds no figure files: what its figures show is known from captions and text only
(``paper/inventory.md``), and its numbers are drawn dotted and grey where it prints them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from uard.lab import statistics
from uard.lab.trainers import examine
from uard.lab.views import figures
from uard.lab.views.figures import Chart, Picture, ends_of, moving_average
from uard.lab.views.palette import DASHED, DOTTED, LIGHT, Look, look
from uard.lab.views.study_results import StudyResults
from uard.method.stability import DEFINITIONS, perturbed_advantage
from uard.method.weights import exponential_weight, linear_weight, reciprocal_weight
from uard.replication import paper, theory
from uard.replication.studies import derive

WIDTH = 10  # episodes of a moving average
BANDS = f"Lines are means over seeds (moving average of {WIDTH} episodes, drawn at every fifth), bands 95 % intervals."
TURN, SETTLED = (
    400,
    200,
)  # episodes from which on the paper's UARD reaches the goal (line 1105), and visits no trap (1150)


def _curves(chart: Chart, panel: int, curves: np.ndarray, name: str, how: Look | None = None) -> None:
    """Draw the mean of (seeds, episodes) and its interval."""
    x, smooth = moving_average(curves, WIDTH)
    low, high = statistics.intervals(smooth.T).T if len(smooth) > 1 else (None, None)
    chart.line(panel, x, smooth.mean(0), name, low, high, how)


def _command(results: StudyResults, study: str) -> str:
    return f"uard reproduce {study} --seeds {len(results.seeds)}"


def filters(results: StudyResults) -> Picture:
    """G2: weights against uncertainty, and what each form does to the paper's trap."""
    chart = Chart(
        ["The filters at lambda = 2", "Where the form acts, 6x6"],
        ["uncertainty U, reward units", "form of the filter"],
        ["weight w", "goal rate"],
    )
    u = np.linspace(0, 5, 101)
    for label, weight, how in (
        ("reciprocal", reciprocal_weight(u), Look("blue", width=2.2)),
        ("exponential", exponential_weight(u), Look("vermillion", DASHED, 2.0)),
        ("linear (mu = 4)", linear_weight(u, np.full_like(u, 4.0)), Look("orange", DOTTED, 2.2)),
    ):
        chart.line(0, u, weight, label, look_of=how)
    chart.reference(0, paper.BETA * paper.SIGMA_H_AT_TRAP, "the paper's trap", "x", at=0.9)
    chart.axes[0].set(xlim=(0, 5), ylim=(0, 1.02))
    forms = list(dict.fromkeys(r["form"] for r in results.studies["filters"].rows))
    readings = ("uard-paper", "uard-consistent", "uard-0.1")
    for i, reading in enumerate(readings):
        s = [results.get("filters", "success_rate", form=f, reading=reading) for f in forms]
        mean, low, high = ends_of(s)
        chart.bars(1, np.arange(len(forms)) + (i - 1) * 0.26, mean, reading, low, high, 0.24)
    chart.plain(1, {float(i): f.replace("certainty-equivalent", "certainty\nequivalent") for i, f in enumerate(forms)})
    chart.axes[1].set(ylim=(0, 1.05))
    chart.axes[1].grid(axis="x", visible=False)
    chart.key({reading: look(reading)._replace(width=5.0, dash="-") for reading in readings})
    return chart.picture(
        "g2",
        "G2 · filters",
        "See that no form helps where the paper applies it. Left: the three filters, and the uncertainty at the paper's trap. "
        "Right: goal rate by form and by where it acts (key above); acting on J as printed (uard-paper) never reaches "
        "the goal, whatever the form. Bars are means over seeds with 95 % intervals; bars of one form stand side by side.",
        _command(results, "filters"),
    )


def _training(results: StudyResults, column: str, agents: Sequence[str], ylabel: str) -> Chart:
    panels = ("main", "appendix")
    chart = Chart([f"6x6, {panel} panel" for panel in panels], "episode", ylabel, share=True)
    for i, panel in enumerate(panels):
        for agent in agents:
            _curves(chart, i, results.curves("table4", column, agent=agent, panel=panel), agent)
        chart.axes[i].set(xlim=(0, paper.EPISODES))
    return chart


def hero(results: StudyResults) -> Picture:
    """G3: observed return against episode; the paper shows a sharp turn to the goal near episode 400."""
    chart = _training(results, "observed_return", ("baseline", "uard-paper", "uard"), "observed return per episode")
    for i in range(2):
        chart.reference(i, TURN, "the paper's turn", "x", at=0.55)
    return chart.picture(
        "g3",
        "G3 · the verification delay",
        "See that nothing happens at the dotted line, where the paper's UARD turns to the goal: as printed (uard-paper) it "
        f"never turns to the goal, and uard turns early. {BANDS}",
        _command(results, "table4"),
    )


def hacks(results: StudyResults) -> Picture:
    """G4: trap visits per episode."""
    chart = _training(results, "hacks", ("baseline", "multi-head", "uard-paper", "uard"), "trap visits per episode")
    most = paper.FIGURES["G4"].number("baseline up to")
    for i in range(2):
        chart.reference(i, most, f"up to {most:g} in the paper", at=0.5)
        chart.reference(i, SETTLED, "none from here on, in the paper", "x", at=0.35)
        chart.axes[i].set(ylim=(-0.5, None))
    return chart.picture(
        "g4",
        "G4 · trap visits",
        "See that both forms of UARD leave the trap and the plain agents stay in it, as in the paper. What this figure "
        f"cannot show is whether the goal is reached. {BANDS}",
        _command(results, "table4"),
    )


def alignment_gap(results: StudyResults) -> Picture:
    """G5: observed and true return of the baseline drift apart; of ``uard`` they do not."""
    agents = ("baseline", "uard")
    chart = Chart([f"{agent}, 6x6, main panel" for agent in agents], "episode", "return per episode", share=True)
    for i, agent in enumerate(agents):
        for column, name, how in (
            ("observed_return", "observed", Look("blue", width=2.0)),
            ("true_return", "true", Look("orange", DASHED, 2.0)),
        ):
            _curves(chart, i, results.curves("table4", column, agent=agent, panel="main"), name, how)
        chart.axes[i].set(xlim=(0, paper.EPISODES))
    above, (low, high) = paper.FIGURES["G5"].number("observed above"), paper.FIGURES["G5"].range("baseline true")
    chart.reference(0, above, f"observed: above {above:g} in the paper", at=0.02)
    chart.reference(0, low, "", at=0.02)
    chart.reference(0, high, f"true: {low:g} to {high:g} in the paper", at=0.3)
    return chart.picture(
        "g5",
        "G5 · the alignment gap",
        "See the two lines part on the left, where the agent is paid for what is worth nothing, and meet on the right. "
        f"{BANDS}",
        _command(results, "table4"),
    )


def true_return(results: StudyResults) -> Picture:
    """G8: true return against episode."""
    agents = ("baseline", "multi-head", "uard-paper", "uard")
    chart = _training(results, "true_return", agents, "true return per episode")
    printed, (lowest, _) = paper.FIGURES["G8"].number("UARD"), paper.FIGURES["G8"].range("baseline")
    for i in range(2):
        chart.reference(i, printed, f"UARD: {printed:g} in the paper", at=0.4)
        chart.reference(i, lowest, f"baseline: down to {lowest:g} in the paper", at=0.02)
    return chart.picture(
        "g8",
        "G8 · true return",
        f"See that UARD as printed (uard-paper) ends where the paper says, at {printed:g}: that is forty "
        f"steps of -0.1, an episode without the goal. {BANDS}",
        _command(results, "table4"),
    )


def uncertainty(results: StudyResults) -> Picture:
    """G9: both uncertainties over training, at the trap and elsewhere."""
    panels = ("main", "appendix")
    titles = [f"uard-paper, 6x6, {panel} panel" for panel in panels]
    chart = Chart(titles, "episode", "uncertainty, reward units", share=True)
    lines = (
        ("sigma_m, trap", Look("blue", width=2.0)),
        ("sigma_m, elsewhere", Look("blue", DASHED)),
        ("sigma_h, trap", Look("vermillion", width=2.0)),
        ("sigma_h, elsewhere", Look("vermillion", DASHED)),
    )
    for i, panel in enumerate(panels):
        row = results.row("uncertainty", agent="uard-paper", panel=panel, heads="bootstrapped")
        curves = np.stack([r.extra["uncertainty"] for r in results.results(row.cell)]).astype(float)
        x = (np.arange(curves.shape[1]) + 1) * paper.EPISODES / curves.shape[1]
        for j, (label, how) in enumerate(lines):
            values = curves[:, :, j]
            low, high = statistics.intervals(values.T).T if len(values) > 1 else (None, None)
            chart.line(i, x, values.mean(0), label, low, high, how)
        chart.reference(i, paper.SIGMA_H_AT_TRAP, f"{paper.SIGMA_H_AT_TRAP} in the paper", at=0.35)
        chart.axes[i].set(xlim=(0, paper.EPISODES), ylim=(0, None))
    return chart.picture(
        "g9",
        "G9 · two uncertainties",
        "See that sigma_h at the trap stays, as in the paper, and that sigma_m falls there after its peak while elsewhere it "
        "grows with the values. Bootstrapped heads; lines are means over seeds, bands 95 % intervals.",
        _command(results, "uncertainty"),
    )


def noise(results: StudyResults) -> Picture:
    """G11 on the grid: trap visits against rater noise, in both units."""
    units = {"reward units": "a reward unit", "of the trap's reward": "the trap's reward"}
    chart = Chart(
        [f"6x6, main panel, noise in % of {unit}" for unit in units.values()],
        [f"noise of every rater (sd, % of {unit})" for unit in units.values()],
        "trap visits per episode",
        share=True,
    )
    for i, unit in enumerate(units):
        for agent in ("baseline", "mean of ratings", "uard-paper", "uard"):
            levels = tuple(round(100 * x) for x in paper.NOISE_LEVELS)
            s = [results.get("noise", "hacks", agent=agent, panel="main", percent=p, unit=unit) for p in levels]
            mean, low, high = ends_of(s)
            chart.line(i, levels, mean, agent, low, high, markers=True)
        for who, how in (("baseline", Look("grey", DASHED)), ("UARD", Look("grey", DOTTED))):
            ends = (paper.FIGURES["G11"].stat(f"{who} at {percent}").mean for percent in (0, 30))
            chart.line(i, [0, 30], list(ends), f"paper: {who}", look_of=how)
        chart.plain(i, [0, 10, 20, 30])
    return chart.picture(
        "g11",
        "G11 on the grid · noisy raters",
        "See that the raw agent (baseline) reads no ratings, so noise cannot hurt it: its line is flat, where the paper's "
        "(grey: its first and last point, of an unnamed task) rises by 277 %. Points are means over seeds, bands 95 % intervals.",
        _command(results, "noise"),
    )


def sign_preservation(results: StudyResults) -> Picture:
    """G13: the advantage of entering the trap against a reward perturbation, by three definitions."""
    titles = [f"'{definition}'" for definition in DEFINITIONS]
    chart = Chart(titles, "reward perturbation", "advantage of entering the trap", height=3.2)
    epsilon = np.linspace(0, 10, 51)
    for i, (definition, radius) in enumerate(zip(DEFINITIONS, theory.radii(), strict=True)):
        for label, weight, how in (
            ("raw", 1.0, look("raw")),
            ("filtered", radius.weight, Look("blue", DASHED, 2.0)),
        ):
            y = perturbed_advantage(radius.advantage, epsilon, weight, definition)
            chart.line(i, epsilon, y, label, look_of=how)
        chart.reference(i, 0.0, "")
        chart.axes[i].set(xlim=(0, 10))
    return chart.picture(
        "g13",
        "G13 · sign preservation",
        "See where each line crosses the dotted zero: that is how far the reward may be perturbed before the sign turns. By "
        "three meanings of one word the filtered agent bears as much, less, or more. Computed exactly.",
        figures.command(results),
    )


def learning_curves(results: StudyResults) -> Picture:
    """G16: observed return of every agent on 6x6."""
    agents = ("baseline", "multi-head", "uard-paper", "uard-consistent", "uard", "random walk")
    chart = _training(results, "observed_return", agents, "observed return per episode")
    return chart.picture(
        "g16",
        "G16 · observed return of all agents",
        "See that a low observed return, which the paper calls intended, is no virtue: a random walk has it too. "
        f"{BANDS}",
        _command(results, "table4"),
    )


WALKERS = ("baseline", "uard-paper", "uard")


def walks(results: StudyResults) -> Picture:
    """What the trained agents do: visits per cell of their greedy walk on 10x10."""
    chart = Chart(["", "", ""], "", "", height=3.6)
    rows: list[tuple[str | float | None, ...]] = []
    for axis, agent in zip(chart.axes, WALKERS, strict=True):
        cell = results.row("scale", agent=agent, size=10, panel="main").cell
        path, grid = results.results(cell)[0].path, cell.environment
        _walk(axis, path, grid.size, [*(grid.traps or ())], look(agent))
        end = "reaches the goal" if path[-1] == grid.states - 1 else f"no goal in {len(path) - 1} steps"
        axis.title.set_text(f"{agent}: {end}")
        rows += [(agent, float(step), *divmod(float(s), grid.size)) for step, s in enumerate(path)]
    drawn = chart.picture(
        "walks",
        "Greedy walks on 10x10 after training",
        "See who arrives, and where the others spend their time. Numbers are visits of a cell, where more than one. Seed "
        f"{results.seeds[0]}, main panel.",
        _command(results, "scale"),
    )
    columns = ("agent", "step", "row", "column")
    return Picture(drawn.id, drawn.title, drawn.note, drawn.image, columns, tuple(rows), drawn.command, drawn.figure)


def _walk(axis: Axes, path: np.ndarray, size: int, traps: list[tuple[int, int]], how: Look) -> None:
    """Draw a walk over a grid: a square for each visited cell, darker the more often, and the way."""
    counts = np.bincount(path, minlength=size * size).reshape(size, size)
    axis.set(xlim=(-0.5, size - 0.5), ylim=(size - 0.5, -0.5), aspect="equal")
    for (r, c), n in np.ndenumerate(counts):
        if n:
            axis.add_patch(_square(c, r, how.light, min(0.12 + 0.06 * float(np.log2(n)), 0.6)))
    rows, columns = np.divmod(path, size)
    axis.plot(columns, rows, color=how.light, lw=1.8)
    for trap in traps:
        axis.text(trap[1], trap[0], "+4", ha="center", va="center", color=LIGHT["vermillion"], weight="bold")
    axis.text(size - 0.55, size - 0.7, "goal", color=LIGHT["green"], weight="bold", fontsize=9, ha="right", va="center")
    axis.text(-0.4, -0.25, "start", color=LIGHT["ink"], fontsize=9, va="center")
    for (r, c), n in np.ndenumerate(counts):
        if n > 1:
            beside = c + 1 == size or counts[r, c + 1] <= 1
            place = (c + 0.6, r, "left") if beside and (c == 0 or counts[r, c - 1] <= 1) else (c, r + 0.8, "center")
            axis.text(*place[:2], f"{n}x", ha=place[2], va="center", fontsize=9, weight="bold", color=LIGHT["ink"])
    axis.set_xticks(np.arange(-0.5, size), [])
    axis.set_yticks(np.arange(-0.5, size), [])
    for spine in axis.spines.values():
        spine.set_visible(True)


def _square(column: float, row: float, colour: str, alpha: float) -> Rectangle:
    return Rectangle((column - 0.5, row - 0.5), 1, 1, facecolor=colour, alpha=alpha, edgecolor="none")


def adjusted_reward(
    rivals: dict[str, np.ndarray],
    ours: np.ndarray,
    label: str,
    windows: Sequence[tuple[int, int]],
    threshold: float | None = None,
) -> Chart:
    """G14, G15: the confidence-adjusted reward of each rival and ours, windows shaded, step by step."""
    titles = [f"{rival.upper()} and ours" for rival in rivals]
    chart = Chart(titles, "step after training", "confidence-adjusted reward", columns=1, height=2.7)
    steps = np.arange(len(ours))
    for i, (rival, values) in enumerate(rivals.items()):
        chart.shade(i, windows)
        chart.line(i, steps, values, rival, look_of=look(rival)._replace(width=1.0))
        chart.line(i, steps, ours, label, look_of=look("uard-0.1")._replace(width=1.0, dash="-"))
        if threshold is not None:
            chart.reference(i, threshold, f"{threshold:g}: the paper's bound", at=0.02)
        chart.axes[i].set(xlim=(0, len(ours)))
    return chart


def hacking_region(trace: np.ndarray, windows: Sequence[tuple[int, int]]) -> Chart:
    """G12: what is learned from in a hacking region, and lambda_t.

    The trace's first rows are the observed, the adjusted and Caution's reward, and lambda_t.
    """
    chart = Chart(
        ["What each learns from", "How strictly uard-0.1 filters"],
        "step after training",
        ["effective reward", "lambda_t"],
        columns=1,
        height=2.7,
    )
    observed, adjusted, caution, lam = trace[:4]
    steps = np.arange(trace.shape[1])
    for i in range(2):
        chart.shade(i, windows)
        chart.axes[i].set(xlim=(0, trace.shape[1]))
    thin = {"width": 1.0, "dash": "-"}
    chart.line(0, steps, observed, "naive (observed)", look_of=look("raw")._replace(**thin))
    chart.line(0, steps, caution, "Caution (mean - sd)", look_of=look("lcb")._replace(**thin))
    chart.line(0, steps, adjusted, "uard-0.1", look_of=look("uard-0.1")._replace(**thin))
    chart.axes[1].set_yscale("log")
    chart.line(1, steps, lam, "uard-0.1", look_of=look("uard-0.1")._replace(**thin))
    low, high = (float(f(lam[np.isfinite(lam) & (lam > 0)])) for f in (np.min, np.max))
    ticks = [10.0**k for k in range(-6, 7) if low / 3 <= 10.0**k <= high * 3]
    if ticks:
        chart.plain(1, ticks, "y")
    return chart


def over_training(curves: dict[str, np.ndarray], steps: int, printed: Sequence[float]) -> Chart:
    """G6, G7: returns and hacks over a training of so many steps; of each agent (seeds, parts, columns).

    The columns are those of ``studies.derive.LEARNED``; ``printed`` are returns that the paper names.
    """
    labels = {"observed_return": "observed return", "true_return": "true return", "hacks": "steps in the region"}
    chart = Chart(
        list(labels.values()), "environment steps, thousands", [f"{v} per episode" for v in labels.values()], height=3.4
    )
    for i, column in enumerate(labels):
        for agent, found in curves.items():
            x = (np.arange(found.shape[1]) + 0.5) * steps / found.shape[1] / 1000
            _interval(chart, i, x, found[..., derive.LEARNED.index(column)], agent)
        if column != "hacks":
            for value in printed:
                chart.reference(i, value, f"{value:g}" if column == "true_return" else "", at=0.9)
        if column == "hacks":
            chart.axes[i].set(ylim=(0, None))
    return chart


def kicked(walks: dict[str, np.ndarray]) -> Chart:
    """G10: uncertainties, weight and who stands round a kick; of each agent (seeds, groups, columns).

    The columns are those of ``examine.KICKED``, of steps in groups of ``studies.derive.EVERY``.
    """
    labels = {
        "sigma_m": "sigma_m, reward units",
        "sigma_h": "sigma_h, reward units",
        "weight": "weight of the reward",
        "standing": "share of copies that stand",
    }
    chart = Chart(
        ["Model", "Raters", "Filter", "Robot"], "steps after the kick", list(labels.values()), columns=2, height=2.9
    )
    for i, column in enumerate(labels):
        for agent, found in walks.items():
            if agent == "raw" and column in ("sigma_h", "weight"):
                continue
            values = found[..., examine.KICKED.index(column)]
            if column != "standing":
                values = np.where(found[..., 0] > 0, values, np.nan)
            x = np.arange(found.shape[1]) * derive.EVERY + derive.EVERY / 2 - examine.KICKED_AT
            _interval(chart, i, x, values, agent)
        chart.reference(i, 0.0, "kick", "x", at=0.92)
        chart.axes[i].set(ylim=(0, 1.02 if column in ("weight", "standing") else None))
    return chart


def _interval(chart: Chart, panel: int, x: np.ndarray, values: np.ndarray, name: str) -> None:
    """Draw the mean of (seeds, points) and its interval where two seeds or more are no NaN; one seed as it is."""
    drawn = (np.isfinite(values).sum(0) >= min(2, len(values))).nonzero()[0]
    found = [statistics.summarise(values[np.isfinite(values[:, i]), i]) for i in drawn]
    if found:
        mean, low, high = ends_of(found)
        chart.line(panel, x[drawn], mean, name, low, high)


FIGURES = (filters, hero, hacks, alignment_gap, true_return, uncertainty, noise, sign_preservation, learning_curves)
