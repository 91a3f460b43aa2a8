"""The paper's experiments, and ours, as data."""

from __future__ import annotations

from uard import _checks
from uard.lab.study import Study
from uard.studies import ours, paper


def grid() -> tuple[Study, ...]:
    """Return all studies of the tabular grids: what ``uard reproduce`` runs."""
    return (*paper.studies(), *ours.studies())


def find(names: tuple[str, ...]) -> tuple[Study, ...]:
    """Return the studies of these names; all grid studies for none, or for ``grid``.

    Raises:
        UnknownNameError: with the nearest name.
    """
    known = {s.name: s for s in grid()}
    chosen: dict[str, Study] = {}
    for name in names or ("grid",):
        _checks.choose("study", name, [*known, "grid"])
        chosen |= known if name == "grid" else {name: known[name]}
    return tuple(chosen.values())
