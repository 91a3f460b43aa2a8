"""The paper's experiments, and ours, as data."""

from __future__ import annotations

from uard import _checks
from uard.lab.studies import grids as ours
from uard.lab.studies import plugins as own
from uard.lab.study import Study
from uard.replication.studies import deep, locomotion
from uard.replication.studies import grids as paper


def grid() -> tuple[Study, ...]:
    """Return all studies of the tabular grids: what ``uard reproduce`` runs."""
    return (*paper.studies(), *ours.studies())


def groups() -> dict[str, tuple[Study, ...]]:
    """Return the studies by the name under which they are run together."""
    sizes = {
        f"mujoco-{scale.name}": locomotion.studies(scale)
        for scale in (locomotion.SMOKE, locomotion.STANDARD, locomotion.PAPER)
    }
    ours_and_theirs = {"grid": grid(), "grid-deep": deep.studies(), "games": deep.others(), **sizes}
    return ours_and_theirs | ({"plugins": brought} if (brought := own.brought()) else {})


def every() -> tuple[Study, ...]:
    """Return all studies."""
    return tuple(study for group in groups().values() for study in group)


def find(names: tuple[str, ...], mitigations: tuple[str, ...] = ()) -> tuple[Study, ...]:
    """Return the studies of these names or groups; all grid studies for none.

    Args:
        names: Of studies and groups.
        mitigations: Further ones, which join every study that compares mitigations.

    Raises:
        UnknownNameError: with the nearest name.
        InvalidValueError: mitigations are to join, and none of the studies compares any.
    """
    together = groups()
    known = {s.name: (s,) for group in together.values() for s in group} | together
    chosen: dict[str, Study] = {}
    for name in names or ("grid",):
        chosen |= {s.name: s for s in known[_checks.choose("study", name, known)]}
    return own.compared_with(chosen.values(), mitigations)
