"""The paper's experiments, and ours, as data."""

from __future__ import annotations

from uard import _checks
from uard.lab.study import Study
from uard.studies import deep, locomotion, ours, paper


def grid() -> tuple[Study, ...]:
    """Return all studies of the tabular grids: what ``uard reproduce`` runs."""
    return (*paper.studies(), *ours.studies())


def groups() -> dict[str, tuple[Study, ...]]:
    """Return the studies by the name under which they are run together."""
    sizes = {
        f"mujoco-{scale.name}": locomotion.studies(scale)
        for scale in (locomotion.SMOKE, locomotion.STANDARD, locomotion.PAPER)
    }
    return {"grid": grid(), "grid-deep": deep.studies(), "games": deep.others(), **sizes}


def every() -> tuple[Study, ...]:
    """Return all studies."""
    return tuple(study for group in groups().values() for study in group)


def find(names: tuple[str, ...]) -> tuple[Study, ...]:
    """Return the studies of these names or groups; all grid studies for none.

    Raises:
        UnknownNameError: with the nearest name.
    """
    known = {s.name: (s,) for s in every()} | groups()
    chosen: dict[str, Study] = {}
    for name in names or ("grid",):
        chosen |= {s.name: s for s in known[_checks.choose("study", name, known)]}
    return tuple(chosen.values())
