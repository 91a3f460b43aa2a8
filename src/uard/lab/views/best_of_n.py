"""Best-of-n over-optimisation in the report: where ``uard`` loses, one figure, one table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from uard.lab.statistics import Summary
from uard.lab.views.figures import Chart, Picture
from uard.lab.views.losses import Loss
from uard.lab.views.palette import DOTTED, look
from uard.lab.views.tables import Number, Table

SHOWN = (10, 100, 1000, 10_000)
OURS = "uard"


def losses(data: Mapping[str, Any]) -> list[Loss]:
    """Say for every panel which methods are worth more than ``uard``, found by rule: paired interval above 0."""
    out: list[Loss] = []
    seeds = f"paired 95 % interval above 0, {len(data['seeds'])} seeds"
    for panel in dict.fromkeys(c["panel"] for c in data["curves"]):
        here = [c for c in data["curves"] if c["panel"] == panel]
        ours = next(c for c in here if c["method"] == "uard")
        for c in here:
            if better := [i for i in map(data["n"].index, SHOWN) if (c["over_uard"]["ci95"][i] or (0.0,))[0] > 0]:
                worst = max(better, key=lambda i: c["over_uard"]["mean"][i])
                ns = ", ".join(f"{data['n'][i]}" for i in better)
                where = f"{panel} reward models, n = {data['n'][worst]}"
                what = f"the answers that {c['method']} chooses are worth more, at n = {ns}"
                numbers = (_gold(ours, worst), _gold(c, worst), "gold")
                out.append(Loss("beaten", "best-of-n", what, where, c["method"], *numbers, note=seeds))
        gold = ours["gold"]["mean"]
        if (peak := int(np.argmax(gold))) < len(gold) - 1:
            what = f"gold falls from n = {data['n'][peak]} on, where it is highest"
            numbers = (_gold(ours, len(gold) - 1), _gold(ours, peak), "gold")
            why = "judges who agree in the wrong are believed"
            where = f"{panel} reward models, n = {data['n'][-1]}"
            out.append(Loss("fails", "best-of-n", what, where, "its best", *numbers, note=seeds, why=why))
    return out


def _gold(curve: Mapping[str, Any], i: int) -> Summary:
    """Return the gold of a curve at one n; of its seeds only mean, sd and interval are published."""
    gold = curve["gold"]
    ends = gold["ci95"][i]
    return Summary(gold["mean"][i], gold["sd"][i], tuple(ends) if ends else None, gold["mean"][i], None, ())


def table(data: Mapping[str, Any]) -> Table:
    """Return gold by panel, method and n."""
    places = list(map(data["n"].index, SHOWN))
    rows = [(c["panel"], c["method"], *(_number(data, c, i) for i in places)) for c in data["curves"]]
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


def _number(data: Mapping[str, Any], curve: Mapping[str, Any], i: int) -> Number:
    gold, ends = curve["gold"], curve["gold"]["ci95"][i]
    return Number(gold["mean"][i], tuple(ends) if ends else None, gold["sd"][i] if ends else None, len(data["seeds"]))


def picture_of(data: Mapping[str, Any]) -> Picture:
    """Draw gold of every method against KL for every panel, and the proxy's score that ``uard`` chose by (dotted)."""
    panels = list(dict.fromkeys(c["panel"] for c in data["curves"]))
    titles = [f"{panel} reward models" for panel in panels]
    chart = Chart(titles, "KL = log n - (n - 1) / n, nats", "gold, sd of the pool", columns=2, height=4.2)
    for i, panel in enumerate(panels):
        for c in (c for c in data["curves"] if c["panel"] == panel):
            ours = c["method"] == OURS and all(c["gold"]["ci95"])
            low, high = np.transpose(c["gold"]["ci95"]) if ours else (None, None)
            chart.line(i, data["kl"], c["gold"]["mean"], c["method"], low, high)
            if c["method"] == OURS:
                chosen = look(OURS)._replace(dash=DOTTED, width=1.2)
                chart.line(i, data["kl"], c["proxy"]["mean"], f"{OURS}: score", look_of=chosen)
    note = (
        "See where a line falls: from there on choosing among more answers finds worse ones. Lines are gold, means over "
        "seeds, and the band is the 95 % interval of uard; dotted is the score by which uard chose, which always rises."
    )
    return chart.picture(
        "best-of-n", "Best-of-n: what is chosen against how far the choice goes", note, data["command"]
    )
