"""How figures look, and those of our own studies. Every function that draws returns a figure."""

from __future__ import annotations

import base64
import io
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from uard.lab.study import Row
from uard.lab.views.study_results import StudyResults

matplotlib.use("Agg")

COLOURS = {
    "baseline": "#c1272d",
    "raw": "#c1272d",
    "multi-head": "#e08214",
    "uard-paper": "#2c6fbb",
    "uard-consistent": "#7b4fa3",
    "uard-0.1": "#6abf69",
    "uard": "#1b8a4b",
    "random walk": "#777777",
    "mean-of-annotations": "#8c6d31",
    "worst-of-annotations": "#17a2b8",
    "lcb": "#d6589f",
    "screening": "#999933",
}
_STYLE: Any = {
    "font.size": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "figure.dpi": 110,
    "legend.frameon": False,
    "axes.titlesize": 12,
}


def data_uri(figure: Figure) -> str:
    """Return a figure as a PNG that needs no file beside the page."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def axes_of(columns: int = 1, width: float = 7.0, height: float = 3.8) -> tuple[Figure, list[Axes]]:
    """Return a new figure of some columns, each so many inches wide and high, and its axes from left to right."""
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(width * columns, height), layout="constrained")
        axes = figure.subplots(1, columns, squeeze=False)[0]
    return figure, list(axes)


def competition(results: StudyResults) -> Figure:
    """True return of the serious rivals against rater noise, 10x10."""
    figure, axes = axes_of(2, 5.8)
    noises = list(dict.fromkeys(r["noise"] for r in results.studies["matrix"].rows))
    for axis, panel in zip(axes, ("main", "appendix"), strict=True):
        for name in ("mean-of-annotations", "worst-of-annotations", "lcb", "uard-consistent", "uard"):
            s = [
                results.get("matrix", "true_return", mitigation=name, size=10, trap=4.0, panel=panel, noise=z)
                for z in noises
            ]
            axis.plot(range(len(noises)), [x.mean for x in s], "o-", color=COLOURS[name], lw=2, label=name)
            axis.fill_between(
                range(len(noises)),
                *np.transpose([x.ci95 or (x.mean, x.mean) for x in s]),
                color=COLOURS[name],
                alpha=0.15,
                lw=0,
            )
        axis.set_xticks(range(len(noises)), [f"{z:g}" for z in noises])
        axis.set(
            xlabel="sd of rater noise, reward units",
            ylabel="true return",
            title=f"10x10, +4, {panel} panel",
            ylim=(-12, 9),
        )
    axes[0].legend(loc="lower left")
    return figure


def budgets(results: StudyResults) -> Figure:
    """True return against the share of steps that are rated, 10x10."""
    rows: list[Row] = list(results.studies["budgets"].rows)
    names = list(dict.fromkeys(r["mitigation"] for r in rows))
    figure, axes = axes_of(4, 3.6, 3.8)
    shown = [(p, z) for p in ("main", "appendix") for z in (0.0, 1.2)]
    for axis, (panel, level) in zip(axes, shown, strict=True):
        for name in names:
            s = [
                results.get("budgets", "true_return", mitigation=name, panel=panel, noise=level, rated=b)
                for b in (0.01, 0.1, 1.0)
            ]
            base = (
                name.split(",")[0]
                .replace("worst-of", "worst-of-annotations")
                .replace("-annotations-annotations", "-annotations")
            )
            axis.plot(
                range(3),
                [x.mean for x in s],
                "o--" if "," in name else "o-",
                color=COLOURS.get(base, "k"),
                lw=1.6,
                ms=4,
                label=name,
            )
        axis.set_xticks(range(3), ["1 %", "10 %", "100 %"])
        axis.set(xlabel="steps rated", title=f"{panel}, noise {level:g}", ylim=(-14, 9))
    axes[0].set_ylabel("true return")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=9)
    return figure
