"""The paper's figures (G2-G16) from our runs. Every function returns a figure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from uard.lab import statistics
from uard.lab.trainers import examine
from uard.lab.views.figures import COLOURS, axes_of
from uard.lab.views.study_results import StudyResults
from uard.method.stability import DEFINITIONS, perturbed_advantage
from uard.method.weights import exponential_weight, linear_weight, reciprocal_weight
from uard.replication import paper, theory
from uard.replication.studies import derive


def _smooth(curves: np.ndarray, width: int = 10) -> np.ndarray:
    kernel = np.ones(width) / width
    return np.stack([np.convolve(c, kernel, "valid") for c in curves])


def _curve(axis: Axes, curves: np.ndarray, label: str, colour: str) -> None:
    """Seeds as thin lines, mean as a thick one; moving average over 10 episodes."""
    smooth = _smooth(curves)
    x = np.arange(smooth.shape[1]) + 10
    for line in smooth:
        axis.plot(x, line, color=colour, lw=0.4, alpha=0.35)
    axis.plot(x, smooth.mean(0), color=colour, lw=2, label=label)


def filters(results: StudyResults) -> Figure:
    """G2: weights against uncertainty, and what each form does to the paper's trap."""
    figure, (left, right) = axes_of(2, 5.5)
    u = np.linspace(0, 5, 400)
    for label, weight in (
        ("reciprocal", reciprocal_weight(u)),
        ("exponential", exponential_weight(u)),
        ("linear (mu = 4)", linear_weight(u, np.full_like(u, 4.0))),
    ):
        left.plot(u, weight, lw=2, label=label)
    left.axvline(0.5 * paper.SIGMA_H_AT_TRAP, color="k", ls=":", lw=1)
    left.annotate("the paper's trap", (0.5 * paper.SIGMA_H_AT_TRAP, 0.95), (0.9, 0.95), fontsize=9)
    left.set(xlabel="uncertainty U", ylabel="weight w", title="Filters at lambda = 2")
    left.legend()
    forms = list(dict.fromkeys(r["form"] for r in results.studies["filters"].rows))
    for i, reading in enumerate(("uard-paper", "uard-consistent", "uard-0.1")):
        s = [results.get("filters", "success_rate", form=f, reading=reading) for f in forms]
        place = np.arange(len(forms)) + (i - 1) * 0.26
        right.bar(place, [x.mean for x in s], 0.24, color=COLOURS[reading], label=reading)
        low, high = np.abs(np.transpose([x.ci95 or (x.mean, x.mean) for x in s]) - [x.mean for x in s])
        right.errorbar(place, [x.mean for x in s], np.stack([low, high]), fmt="none", color="k", lw=1)
    right.set_xticks(range(len(forms)), [f.replace("certainty-equivalent", "certainty\nequivalent") for f in forms])
    right.set(ylabel="goal rate, 6x6", title="Where the form acts, by reading", ylim=(0, 1.25))
    right.legend(ncols=3, loc="upper center")
    return figure


def _training(results: StudyResults, column: str, agents: Sequence[str], ylabel: str, title: str) -> Figure:
    figure, axes = axes_of(2, 5.8)
    for axis, panel in zip(axes, ("main", "appendix"), strict=True):
        for agent in agents:
            _curve(axis, results.curves("table4", column, agent=agent, panel=panel), agent, COLOURS[agent])
        axis.set(xlabel="episode", ylabel=ylabel, title=f"{title}, {panel} panel")
    axes[0].legend()
    return figure


def hero(results: StudyResults) -> Figure:
    """G3: observed return against episode; the paper shows a sharp turn to the goal near episode 400."""
    figure = _training(results, "observed_return", ("baseline", "uard-paper", "uard"), "observed return", "6x6")
    for axis in figure.axes:
        axis.axvline(400, color="k", ls=":", lw=1)
        axis.annotate("the paper's turn", (400, 40), (405, 40), fontsize=9)
    return figure


def hacks(results: StudyResults) -> Figure:
    """G4: trap visits per episode."""
    agents = ("baseline", "multi-head", "uard-paper", "uard")
    return _training(results, "hacks", agents, "trap visits per episode", "6x6")


def alignment_gap(results: StudyResults) -> Figure:
    """G5: observed and true return of the baseline drift apart; of ``uard`` they do not."""
    figure, axes = axes_of(2, 5.8)
    for axis, agent in zip(axes, ("baseline", "uard"), strict=True):
        _curve(axis, results.curves("table4", "observed_return", agent=agent, panel="main"), "observed", "#2c6fbb")
        _curve(axis, results.curves("table4", "true_return", agent=agent, panel="main"), "true", "#e08214")
        axis.set(xlabel="episode", ylabel="return", title=f"{agent}, 6x6, main panel")
        axis.legend()
    return figure


def true_return(results: StudyResults) -> Figure:
    """G8: true return against episode."""
    return _training(results, "true_return", ("baseline", "multi-head", "uard-paper", "uard"), "true return", "6x6")


def uncertainty(results: StudyResults) -> Figure:
    """G9: both uncertainties over training, at the trap and elsewhere."""
    figure, axes = axes_of(2, 5.8)
    for axis, panel in zip(axes, ("main", "appendix"), strict=True):
        row = results.row("uncertainty", agent="uard-paper", panel=panel, heads="bootstrapped")
        curves = np.stack([r.extra["uncertainty"] for r in results.results(row.cell)]).astype(float)
        x = (np.arange(curves.shape[1]) + 1) * 500 / curves.shape[1]
        lines = (("sigma_m, trap", "#2c6fbb", "-"), ("sigma_m, elsewhere", "#2c6fbb", ":"))
        lines += (("sigma_h, trap", "#c1272d", "-"), ("sigma_h, elsewhere", "#c1272d", ":"))
        for i, (label, colour, style) in enumerate(lines):
            mean, sd = curves[:, :, i].mean(0), curves[:, :, i].std(0, ddof=1)
            axis.plot(x, mean, color=colour, ls=style, lw=2, label=label)
            axis.fill_between(x, mean - sd, mean + sd, color=colour, alpha=0.12, lw=0)
        axis.axhline(paper.SIGMA_H_AT_TRAP, color="k", lw=1, ls="--")
        axis.annotate("1.247 in the paper", (10, paper.SIGMA_H_AT_TRAP + 0.02), fontsize=9)
        axis.set(xlabel="episode", ylabel="uncertainty", title=f"uard-paper, 6x6, {panel} panel", ylim=(0, None))
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def noise(results: StudyResults) -> Figure:
    """G11 on the grid: trap visits against rater noise, in both units."""
    figure, axes = axes_of(2, 5.8)
    rng = np.random.default_rng(0)
    agents = ("baseline", "mean of ratings", "uard-paper", "uard")
    for axis, unit in zip(axes, ("reward units", "of the trap's reward"), strict=True):
        for agent in agents:
            colour = COLOURS.get(agent, COLOURS["mean-of-annotations"])
            levels = (0, 10, 20, 30)
            v = [results.per_seed("noise", "hacks", agent=agent, panel="main", percent=p, unit=unit) for p in levels]
            mean, sd = np.array([x.mean() for x in v]), np.array([x.std(ddof=1) for x in v])
            axis.plot(levels, mean, "o-", color=colour, lw=2, label=agent)
            axis.fill_between(levels, mean - sd, mean + sd, color=colour, alpha=0.15, lw=0)
            for level, x in zip(levels, v, strict=True):
                axis.plot(level + rng.uniform(-0.6, 0.6, x.size), x, ".", color=colour, ms=3, alpha=0.5)
        axis.set(xlabel=f"noise on every rater, % {unit}", ylabel="trap visits per episode", title="6x6, main panel")
        axis.set_xticks((0, 10, 20, 30))
    axes[0].legend()
    return figure


def sign_preservation(results: StudyResults) -> Figure:
    """G13: the advantage of entering the trap against a reward perturbation, by three definitions."""
    figure, axes = axes_of(3, 4.4, 3.6)
    for axis, definition, radius in zip(axes, DEFINITIONS, theory.radii(), strict=True):
        epsilon = np.linspace(0, 10, 200)
        for label, weight, colour in (("raw", 1.0, COLOURS["raw"]), ("filtered", radius.weight, COLOURS["uard-paper"])):
            y = perturbed_advantage(radius.advantage, epsilon, weight, definition)
            axis.plot(epsilon, y, color=colour, lw=2, label=label)
        axis.axhline(0, color="k", lw=1)
        axis.set(xlabel="reward perturbation", ylabel="advantage", title=f"'{definition}'")
    axes[0].legend()
    return figure


def learning_curves(results: StudyResults) -> Figure:
    """G16: observed return of every agent on 6x6."""
    agents = ("baseline", "multi-head", "uard-paper", "uard-consistent", "uard", "random walk")
    return _training(results, "observed_return", agents, "observed return", "6x6")


def walks(results: StudyResults) -> Figure:
    """What the trained agents do: visits per cell of their greedy walk on 10x10."""
    figure, axes = axes_of(3, 4.2, 4.4)
    for axis, agent in zip(axes, ("baseline", "uard-paper", "uard"), strict=True):
        cell = results.row("scale", agent=agent, size=10, panel="main").cell
        path = results.results(cell)[0].path
        grid = cell.environment
        counts = np.bincount(path, minlength=grid.states).reshape(grid.size, grid.size)
        axis.imshow(np.where(counts > 0, np.log1p(counts), np.nan), cmap="Blues", vmin=0, vmax=np.log1p(900))
        rows, columns = np.divmod(path, grid.size)
        axis.plot(columns, rows, color=COLOURS[agent], lw=1.5)
        for trap in grid.traps or ():
            axis.text(trap[1], trap[0], "+4", ha="center", va="center", color="#c1272d", weight="bold")
        axis.text(
            grid.size - 1, grid.size - 1, "goal", ha="center", va="center", color="#1b8a4b", weight="bold", fontsize=9
        )
        axis.text(0, 0, "start", ha="center", va="center", fontsize=8)
        for (r, c), n in np.ndenumerate(counts):
            if n > 1:
                axis.text(c, r + 0.3, f"{n}x", ha="center", va="center", fontsize=10, weight="bold")
        axis.set_xticks(np.arange(-0.5, grid.size), [])
        axis.set_yticks(np.arange(-0.5, grid.size), [])
        axis.tick_params(length=0)
        end = "reaches the goal" if path[-1] == grid.states - 1 else f"never arrives in {len(path) - 1} steps"
        axis.set_title(f"{agent}: {end}")
    return figure


def adjusted_reward(
    rivals: dict[str, tuple[np.ndarray, str]], ours: np.ndarray, label: str, windows: Sequence[tuple[int, int]]
) -> Figure:
    """G14, G15: the confidence-adjusted reward of each rival (steps and colour) and ours, windows shaded."""
    figure, axes = axes_of(len(rivals), 6.2, 3.8)
    for axis, (rival, (values, colour)) in zip(axes, rivals.items(), strict=True):
        _shade(axis, windows)
        axis.plot(values, color=colour, lw=1, label=rival)
        axis.plot(ours, color=COLOURS["uard-0.1"], lw=1.2, label=label)
        axis.set(ylabel="confidence-adjusted reward")
        _legend_below(axis)
    return figure


def hacking_region(trace: np.ndarray, windows: Sequence[tuple[int, int]]) -> Figure:
    """G12: what is learned from in a hacking region, and lambda_t.

    The trace's first rows are the observed, the adjusted and Caution's reward, and lambda_t.
    """
    figure, axes = axes_of(2, 6.2, 3.8)
    observed, adjusted, caution, lam = trace[:4]
    for axis in axes:
        _shade(axis, windows)
    axes[0].plot(observed, color=COLOURS["raw"], lw=1, label="naive (observed)")
    axes[0].plot(caution, color=COLOURS["lcb"], lw=1, label="Caution (mean - sd)")
    axes[0].plot(adjusted, color=COLOURS["uard-0.1"], lw=1.2, label="uard-0.1")
    axes[0].set(ylabel="effective reward")
    _legend_below(axes[0])
    axes[1].plot(lam, color=COLOURS["uard-0.1"], lw=1)
    axes[1].set(ylabel="lambda_t", yscale="log")
    return figure


def over_training(curves: dict[str, tuple[np.ndarray, str]], steps: int, target: float) -> Figure:
    """G6, G7: returns and hacks over a training of so many steps; of each agent (seeds, parts, columns) and a colour.

    The columns are those of ``studies.derive.LEARNED``; ``target`` is the return that the paper calls aligned.
    """
    figure, axes = axes_of(3, 4.4, 3.8)
    labels = {
        "observed_return": "observed return",
        "true_return": "true return",
        "hacks": "steps in the region per episode",
    }
    for axis, (column, label) in zip(axes, labels.items(), strict=True):
        for agent, (found, colour) in curves.items():
            x = (np.arange(found.shape[1]) + 0.5) * steps / found.shape[1] / 1000
            _interval(axis, x, found[..., derive.LEARNED.index(column)], agent, colour)
        if column != "hacks":
            axis.axhline(target, color="k", ls=":", lw=1)
        axis.set(xlabel="environment steps, thousands", ylabel=label)
    axes[0].legend()
    return figure


def kicked(walks: dict[str, tuple[np.ndarray, str]]) -> Figure:
    """G10: uncertainties, weight and who stands round a kick; of each agent (seeds, groups, columns) and a colour.

    The columns are those of ``examine.KICKED``, of steps in groups of ``studies.derive.EVERY``.
    """
    figure, axes = axes_of(4, 3.6, 3.8)
    labels = {"sigma_m": "sigma_m", "sigma_h": "sigma_h", "weight": "weight", "standing": "share of copies that stand"}
    for axis, (column, label) in zip(axes, labels.items(), strict=True):
        for agent, (found, colour) in walks.items():
            if agent == "raw" and column in ("sigma_h", "weight"):
                continue
            values = found[..., examine.KICKED.index(column)]
            if column != "standing":
                values = np.where(found[..., 0] > 0, values, np.nan)
            x = np.arange(found.shape[1]) * derive.EVERY + derive.EVERY / 2 - examine.KICKED_AT
            _interval(axis, x, values, agent, colour)
        axis.axvline(0, color="k", ls=":", lw=1)
        axis.set(xlabel="steps after the kick", ylabel=label, ylim=(0, None))
    axes[0].legend()
    return figure


def _interval(axis: Axes, x: np.ndarray, values: np.ndarray, label: str, colour: str) -> None:
    """Draw the mean of (seeds, points) and its interval where two seeds or more are no NaN; one seed as it is."""
    drawn = (np.isfinite(values).sum(0) >= min(2, len(values))).nonzero()[0]
    found = [statistics.summarise(values[np.isfinite(values[:, i]), i]) for i in drawn]
    low, high = np.array([s.ci95 for s in found]).reshape(-1, 2).T
    axis.plot(x[drawn], [s.mean for s in found], color=colour, lw=2, label=label)
    axis.fill_between(x[drawn], low, high, color=colour, alpha=0.15, lw=0)


def _shade(axis: Axes, windows: Sequence[tuple[int, int]]) -> None:
    for a, b in windows:
        axis.axvspan(a, b, color="#f2d7a0", alpha=0.6, lw=0)
    axis.set(xlabel="step")


def _legend_below(axis: Axes) -> None:
    low, high = axis.get_ylim()
    axis.set_ylim(bottom=low - 0.35 * (high - low))
    axis.legend(loc="lower right")
