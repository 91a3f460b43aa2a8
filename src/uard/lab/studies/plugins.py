"""What installed packages bring (``uard.plugins``), in studies: a study of their own, and their mitigations in ours."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields, replace
from typing import Any

from uard import _checks
from uard.lab import registry as names
from uard.lab.cell import Cell
from uard.lab.studies.common import LOCOMOTION_STEPS, PANELS, can_use
from uard.lab.studies.grids import COMPARED
from uard.lab.study import Row, Study, row
from uard.method.mitigations import named
from uard.ratings.panels import as_panel

BESIDE = ("uard", "uard-0.1")  # what a study that compares mitigations holds one of
AGENTS = ("q-learning", "ensemble-dqn", "ppo")  # the first that can work in an environment learns there


def brought() -> tuple[Study, ...]:
    """Return a study of what packages bring, every mitigation and panel and the twins; none if they bring nothing."""
    rows = (*environments(), *agents())
    if not rows:
        return ()
    return (Study("own", "What installed packages bring, every mitigation", "plugins", rows),)


def mitigations() -> tuple[str, ...]:
    """Return ours that are compared, and those of installed packages."""
    return (*COMPARED, *(plugin.name for plugin in names.brought("mitigation")[0]))


def environments() -> tuple[Row, ...]:
    """Every environment of a package, and its legitimate twin if it has a field of that name."""
    rows: list[Row] = []
    for plugin, environment in names.brought("environment")[0].items():
        able = names.agents(environment)
        name = next(a for a in AGENTS if a in able and names.can_work(able[a], environment))
        rows += _crossed(plugin.name, environment, name, able[name], (*PANELS, "colluding"))
        if "legitimate" in {f.name for f in fields(environment)}:
            twin = replace(environment, legitimate=True)
            rows += _crossed(f"{plugin.name}, legitimate", twin, name, able[name], PANELS)
    return tuple(rows)


def agents() -> tuple[Row, ...]:
    """Every agent of a package, on 6x6 and its twin, or on Hopper if its actions are continuous."""
    rows: list[Row] = []
    for plugin, agent in names.brought("agent")[0].items():
        grid = names.can_work(agent, names.ENVIRONMENTS["TrapGrid6"])
        name = "TrapGrid6" if grid else "Hopper-Vibration"
        rows += _crossed(name, names.ENVIRONMENTS[name], plugin.name, agent, (*PANELS, "colluding"))
        twin = names.ENVIRONMENTS[f"{name}-Legitimate"]
        rows += _crossed(f"{name}, legitimate", twin, plugin.name, agent, PANELS)
    return tuple(rows)


def _crossed(where: str, environment: Any, name: str, agent: Any, panels: tuple[str, ...]) -> list[Row]:
    trainer = names.trainer(agent, environment)
    rating_model = trainer.usual_rating_model
    steps = LOCOMOTION_STEPS if trainer.budget == "steps" else None
    return [
        row(
            Cell(environment, named(mitigation), agent, as_panel(panel), rating_model=rating_model, steps=steps),
            environment=where,
            agent=name,
            mitigation=mitigation,
            panel=panel,
        )
        for panel in panels
        for mitigation in mitigations()
        if can_use(named(mitigation), trainer)
    ]


def compared_with(studies: Iterable[Study], others: Iterable[str]) -> tuple[Study, ...]:
    """Add mitigations to all studies that compare some: beside each row of ``BESIDE``, one for each of the others.

    Raises:
        InvalidValueError: none of the studies compares mitigations, or a name is no mitigation.
    """
    studies, added = tuple(studies), {name: named(name) for name in dict.fromkeys(others)}
    if not added:
        return studies  # whose rows need not be built
    grown, compares = [], False
    for study in studies:
        places = [r for name in BESIDE for r in study.where(mitigation=name) if r.cell.mitigation == named(name)]
        compares |= bool(places)
        new = [_instead(r, name, r.cell.with_(mitigation=m)) for name, m in added.items() for r in places]
        rows = {r.labels: r for r in (*study.rows, *new)} | {r.labels: r for r in study.rows}
        grown.append(replace(study, rows=tuple(rows.values())))
    if not compares:
        allowed = f"left out: none of {', '.join(s.name for s in studies)} compares mitigations"
        raise _checks.InvalidValueError("mitigation", ", ".join(added), allowed)
    return tuple(grown)


def _instead(of: Row, name: str, cell: Cell) -> Row:
    labels = dict(of.labels) | {"mitigation": name}
    if "sources" in labels:
        labels["sources"] = "-"  # as with our rivals: the label tells forms of uard apart
    return Row(tuple(labels.items()), cell)
