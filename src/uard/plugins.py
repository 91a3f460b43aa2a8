"""Environments, agents and mitigations of other packages, found by their entry points.

A package names them in its ``pyproject.toml``, and they are known as soon as it is installed:

    [project.entry-points."uard.mitigations"]
    ceiling = "my_package:Ceiling"

What an entry point names is called, without arguments or with a mitigation's parameters, and must return a frozen
dataclass of its kind. It is imported when somebody asks for it by name, never by ``import uard``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from typing import Any

from uard import _checks

KINDS = {"environment": "uard.environments", "agent": "uard.agents", "mitigation": "uard.mitigations"}


class PluginError(_checks.InvalidValueError):
    """An entry point that cannot be used; the message names it, its package, and why."""

    def __init__(self, plugin: Plugin, why: str):
        """Say that ``plugin`` cannot be used."""
        super().__init__(plugin.kind, plugin.name, f"usable, but {plugin.origin}: {why}")
        self.plugin = plugin


@dataclass(frozen=True)
class Plugin:
    """One entry point.

    Attributes:
        kind: One of ``KINDS``.
        name: As on the command line.
        package: Name and version of the package that brings it.
        entry: The entry point.
    """

    kind: str
    name: str
    package: str
    entry: metadata.EntryPoint

    @property
    def origin(self) -> str:
        """Where it comes from, in words."""
        return f"entry point {self.name} = {self.entry.value} of package {self.package}"

    def load(self, is_one: Callable[[Any], bool]) -> Callable[..., Any]:
        """Import it and return what builds it.

        Args:
            is_one: Whether an object is of this plugin's kind.

        Raises:
            PluginError: it cannot be imported or called, or what it returns is of another kind.
        """
        try:
            build = self.entry.load()
            made = build()
        except Exception as error:
            raise PluginError(self, f"{type(error).__name__}: {error}") from error
        if not (is_one(made) and _checks.is_frozen(made)):
            article = "an" if self.kind[0] in "ae" else "a"
            raise PluginError(self, f"{_checks.short(made)} is no frozen dataclass that is {article} {self.kind}")
        return build


@cache
def found(kind: str) -> tuple[Plugin, ...]:
    """Return all entry points of a kind, sorted by name and package; looked up once per process."""
    entries = metadata.entry_points(group=KINDS[kind])
    every = {Plugin(kind, e.name, f"{e.dist.name} {e.dist.version}" if e.dist else "unknown", e) for e in entries}
    return tuple(sorted(every, key=lambda p: (p.name, p.package, p.entry.value)))


def usable(kind: str, own: Container[str]) -> dict[str, Plugin]:
    """Return a kind's plugins by name, without those whose name is taken: in ``own`` (uard's), or by each other."""
    return {p.name: p for p in found(kind) if _taken(p, own) is None}


def clashes(kind: str, own: Container[str]) -> list[PluginError]:
    """Return an error for every plugin whose name is taken."""
    return [PluginError(p, why) for p in found(kind) if (why := _taken(p, own)) is not None]


def pick(kind: str, name: str, own: Container[str], names: list[str]) -> Plugin:
    """Return the plugin of that name.

    Args:
        kind: One of ``KINDS``.
        name: What is asked for.
        own: All names of the kind that are uard's.
        names: Those of them that would do, for the message.

    Raises:
        PluginError: several packages bring it.
        UnknownNameError: there is none; with the nearest name.
    """
    for clash in clashes(kind, own):
        if clash.plugin.name == name and name not in own:
            raise clash
    brought = usable(kind, own)
    return brought[_checks.choose(kind, name, [*names, *brought])]


def _taken(plugin: Plugin, own: Container[str]) -> str | None:
    if plugin.name in own:
        return f"the name is uard's own {plugin.kind}"
    if Counter(p.name for p in found(plugin.kind))[plugin.name] > 1:
        others = [p.package for p in found(plugin.kind) if p.name == plugin.name and p != plugin]
        return f"the name is also brought by {', '.join(others)}"
    return None
