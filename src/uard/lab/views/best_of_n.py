"""Best-of-n over-optimisation in the report: where ``uard`` loses, one figure, one table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from uard.lab.views.figures import axes_of
from uard.lab.views.tables import Table

SHOWN = (10, 100, 1000, 10_000)
COLOURS = {
    "one model": "#777777",
    "mean": "#8c6d31",
    "median": "#c9a66b",
    "worst case (WCO)": "#17a2b8",
    "mean - variance / 2 (UWO)": "#d6589f",
    "log-mean-exp": "#9467bd",
    "lcb": "#5f6b6d",
    "excess": "#e07b39",
    "uard-operator": "#2c6fbb",
    "uard-0.1": "#6abf69",
    "uard, median as proxy": "#7fd3a0",
    "uard": "#1b8a4b",
}


def losses(data: Mapping[str, Any]) -> list[str]:
    """Say for every panel which methods are worth more than ``uard``, found by rule: paired interval above 0."""
    out = []
    for panel in dict.fromkeys(c["panel"] for c in data["curves"]):
        beaten = []
        for c in data["curves"]:
            for n in SHOWN:
                i = data["n"].index(n)
                if c["over_uard"]["ci95"][i] is None:  # one seed
                    continue
                low, high = c["over_uard"]["ci95"][i]
                if c["panel"] == panel and low > 0:
                    more = f"{c['over_uard']['mean'][i]:+.3f} [{low:+.3f}, {high:+.3f}]"
                    beaten.append(f"{c['method']} at n = {n}: {more}")
        curve = next(c for c in data["curves"] if c["panel"] == panel and c["method"] == "uard")
        gold = curve["gold"]["mean"]
        peak = int(np.argmax(gold))
        fall = "the gold of uard never falls"
        if peak < len(gold) - 1:
            fall = f"the gold of uard falls from {gold[peak]:.2f} at n = {data['n'][peak]} to {gold[-1]:.2f} at n = {data['n'][-1]}"
        text = f"Best-of-n, {panel} reward models, {len(data['seeds'])} seeds: {fall}; "
        out.append(
            text + ("worth more than uard: " + "; ".join(beaten) if beaten else "nothing is worth more than uard") + "."
        )
    return out


def table(data: Mapping[str, Any]) -> Table:
    """Return gold by panel, method and n."""
    rows = []
    for c in data["curves"]:
        cells = []
        for n in SHOWN:
            i = data["n"].index(n)
            ends = c["gold"]["ci95"][i]
            shown = f"[{ends[0]:.2f}, {ends[1]:.2f}]" if ends else "(one run)"
            cells.append(f"{c['gold']['mean'][i]:.2f} {shown}")
        rows.append((c["panel"], c["method"], *cells))
    return Table(
        "Best-of-n: what the chosen answer is worth in gold",
        ("reward models", "chosen by", *(f"n = {n}" for n in SHOWN)),
        tuple(rows),
        2,
        f"Standard deviations of the pool; mean [95 % interval of the mean] over {len(data['seeds'])} seeds. Unbiased "
        f"closed-form estimator over {data['problem']['pool']} answers; {data['problem']['models']} reward models on "
        f"{data['problem']['pairs']} noisy preferences each; {data['command']}. In `contested` the people behind 2 of 5 models "
        "like flattery, in `colluding` all models share the preferences of such people: a control that must fail.",
    )


def figure(data: Mapping[str, Any]) -> Figure:
    """Draw gold (lines) and proxy (dotted) against KL for every panel; the band is the interval of ``uard``."""
    panels = list(dict.fromkeys(c["panel"] for c in data["curves"]))
    drawn, axes = axes_of(len(panels), 4.4, 4.0)
    for axis, panel in zip(axes, panels, strict=True):
        for c in data["curves"]:
            if c["panel"] != panel:
                continue
            ours = c["method"] == "uard"
            colour = COLOURS[c["method"]]
            axis.plot(data["kl"], c["gold"]["mean"], color=colour, lw=2.2 if ours else 1.5, label=c["method"])
            axis.plot(data["kl"], c["proxy"]["mean"], color=colour, lw=1, ls=":")
            if ours and all(c["gold"]["ci95"]):
                low, high = np.transpose(c["gold"]["ci95"])
                axis.fill_between(data["kl"], low, high, color=colour, alpha=0.15, lw=0)
        axis.set(xlabel="KL = log n - (n - 1) / n", title=f"{panel} reward models")
    axes[0].set_ylabel("score of the best of n, sd of the pool")
    drawn.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=6, fontsize=9)
    return drawn
