"""Experiments as data: ours, and those that installed packages bring (``uard.plugins``), the paper's among them."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

from uard import _checks
from uard.lab.studies import games, grids, grpo, panels, robots
from uard.lab.studies import plugins as own
from uard.lab.study import Study
from uard.plugins import Plugin, PluginError, brought


def groups() -> dict[str, tuple[Study, ...]]:
    """Return the studies by the name under which they are run together; groups of one name are joined."""
    return _joined()[0]


def broken() -> list[PluginError]:
    """Return an error for each package's studies that cannot be used; nothing that its entry point brings is."""
    return _joined()[1]


def _joined() -> tuple[dict[str, tuple[Study, ...]], list[PluginError]]:
    joined = {**_ours(), **({"plugins": crossed} if (crossed := own.brought()) else {})}
    studies = {s.name for group in joined.values() for s in group}

    def join(plugin: Plugin) -> None:
        theirs = _called(plugin)
        new = [s.name for group in theirs.values() for s in group]
        for name in new:
            if name in studies or name in joined or name in theirs or new.count(name) > 1:
                raise PluginError(plugin, f"the name of its study {name!r} is taken")
        for name in theirs:
            if name in studies:
                raise PluginError(plugin, f"the name of its group {name!r} is that of a study")
        studies.update(new)
        joined.update({name: joined.get(name, ()) + group for name, group in theirs.items()})

    return joined, brought("studies", join)[1]


@cache
def _ours() -> dict[str, tuple[Study, ...]]:
    return {
        "grid": grids.studies(),
        "games": games.studies(),
        "panels": panels.studies(),
        "robots": robots.studies(),
        "grpo": (grpo.study(),),
        "panels-development": panels.studies(development=True),
    }


@cache
def _called(plugin: Plugin) -> dict[str, tuple[Study, ...]]:
    made = plugin.call()
    good = isinstance(made, Mapping) and all(
        isinstance(name, str) and isinstance(group, tuple) and all(isinstance(s, Study) for s in group)
        for name, group in made.items()
    )
    if not good:
        raise PluginError(plugin, f"{_checks.short(made)} is no dictionary of groups, (Study, ...) by name")
    return dict(made)


def grid() -> tuple[Study, ...]:
    """Return all studies of the tabular grids: what ``uard reproduce`` runs."""
    return groups()["grid"]


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
