"""The door for other packages: what their entry points bring is known as soon as they are installed.

A package names what it brings in its ``pyproject.toml``:

    [project.entry-points."uard.mitigations"]
    ceiling = "my_package:Ceiling"

| group | an entry point names | which |
|---|---|---|
| ``uard.environments``, ``uard.agents``, ``uard.mitigations`` | a class or a function | called without arguments (or with a mitigation's parameters) returns a frozen dataclass of that kind |
| ``uard.studies`` | a function | returns ``{name of a group: (uard.lab.study.Study, ...)}``; groups of one name are joined |
| ``uard.results`` | a function | returns a ``uard.lab.views.published.ResultFiles``: published results that a report may show |
| ``uard.reports`` | a function of ``uard.lab.views.study_results.StudyResults`` | returns ``uard.lab.views.sections.Section`` s of the report |
| ``uard.commands`` | a frozen dataclass | is a command of ``uard``: its fields are the options, its docstring the help, ``run(console)`` what it does |

Environments, agents, mitigations and commands are known by the entry point's name, which nobody else may have; the
other names are of no account. Everything is imported when somebody asks for it, never by ``import uard``. What cannot
be used is a ``PluginError`` that names it and its package; ``uard list`` and ``uard reproduce`` print it and go on.

The replication of the paper (``uard.replication``) comes in by this door too.
"""  # noqa: E501 (a table)

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from typing import Any, TypeVar

from uard import _checks

T = TypeVar("T")

NAMED = {
    "environment": "uard.environments",
    "agent": "uard.agents",
    "mitigation": "uard.mitigations",
    "command": "uard.commands",
}
KINDS = NAMED | {"studies": "uard.studies", "results": "uard.results", "report": "uard.reports"}


class PluginError(_checks.InvalidValueError):
    """An entry point that cannot be used; the message names it, its package, and why."""

    def __init__(self, plugin: Plugin, why: str):
        """Say that ``plugin`` cannot be used."""
        super().__init__(plugin.kind, plugin.name, f"usable, but {plugin.origin}: {why}")
        self.plugin = plugin


@dataclass(frozen=True)
class Plugin:
    """One entry point.

    Examples:
        >>> entry = metadata.EntryPoint("mine", "uard.method.mitigations:Raw", "uard.mitigations")
        >>> plugin = Plugin("mitigation", "mine", "my-package 1.0", entry)
        >>> plugin.origin
        'entry point mine = uard.method.mitigations:Raw of package my-package 1.0'
        >>> plugin.call()
        Raw()

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

    def get(self) -> Any:
        """Import what the entry point names and return it.

        Raises:
            PluginError: it cannot be imported.
        """
        return self._tried(self.entry.load)

    def call(self, *arguments: Any) -> Any:
        """Import what the entry point names, call it, and return what it returns.

        Raises:
            PluginError: it cannot be imported, or raises.
        """
        function = self.get()
        return self._tried(lambda: function(*arguments))

    def make(self, fault: Callable[[Any], str | None], **parameters: Any) -> Any:
        """Build an environment, an agent or a mitigation.

        Args:
            fault: Says what an object must be if it cannot be used as this plugin's kind; None if it can.
            parameters: Handed to what the entry point names.

        Raises:
            PluginError: it cannot be imported or called, or what it returns without parameters cannot be used.
            InvalidValueError: from what it builds, for the parameters.
        """
        made = self.call()
        if (why := fault(made)) is not None:
            raise PluginError(self, f"what it gives, {_checks.short(made)}, must be {why}")
        if not parameters:
            return made
        function = self.get()
        return self._tried(lambda: function(**parameters), (_checks.InvalidValueError, TypeError))

    def _tried(self, action: Callable[[], Any], through: tuple[type[Exception], ...] = ()) -> Any:
        try:
            return action()
        except through:
            raise
        except (Exception, SystemExit) as error:  # a package must not end this process either
            raise PluginError(self, f"{type(error).__name__}: {_said(error)}") from error


def _said(error: BaseException) -> str:
    try:
        return str(error)
    except Exception:  # an error of somebody else's class
        return "which cannot be printed"


@cache
def found(kind: str) -> tuple[Plugin, ...]:
    """Return all entry points of a kind, uard's own first, then by name and package; looked up once per process."""
    entries = metadata.entry_points(group=KINDS[kind])
    every = {Plugin(kind, e.name, f"{e.dist.name} {e.dist.version}" if e.dist else "unknown", e) for e in entries}
    return tuple(sorted(every, key=lambda p: (not p.package.startswith("uard "), p.name, p.package, p.entry.value)))


def brought(
    kind: str, read: Callable[[Plugin], T], own: Container[str] = ()
) -> tuple[dict[Plugin, T], list[PluginError]]:
    """Return what packages bring of a kind, and what of it is broken.

    Examples:
        >>> good, broken = brought("command", Plugin.get)
        >>> [command.__name__ for plugin, command in good.items() if plugin.name == "ledger"]
        ['Ledger']

    Args:
        kind: One of ``KINDS``.
        read: Gets what a plugin brings, checked; raises ``PluginError``.
        own: All names of the kind that are uard's.
    """
    good: dict[Plugin, T] = {}
    bad: list[PluginError] = []
    for plugin in found(kind):
        try:
            if (why := _taken(plugin, own)) is not None:
                raise PluginError(plugin, why)
            good[plugin] = read(plugin)
        except PluginError as error:
            bad.append(error)
    return good, bad


def pick(kind: str, name: str, own: Container[str], names: list[str]) -> Plugin:
    """Return the plugin of that name.

    Examples:
        >>> pick("command", "ledger", own=("run", "list"), names=["run", "list"]).entry.value
        'uard.replication.command:Ledger'

    Args:
        kind: One of ``NAMED``.
        name: What is asked for.
        own: All names of the kind that are uard's.
        names: Those of them that would do, for the message.

    Raises:
        PluginError: several packages bring it.
        UnknownNameError: there is none, or it is uard's own; with the nearest name.
    """
    usable = {}
    for plugin in found(kind):
        why = _taken(plugin, own)
        if why is None:
            usable[plugin.name] = plugin
        elif plugin.name == name and name not in own:
            raise PluginError(plugin, why)
    if name not in usable:
        raise _checks.UnknownNameError(kind, name, {*names, *usable} - {name})
    return usable[name]


def _taken(plugin: Plugin, own: Container[str]) -> str | None:
    """Say who has a plugin's name if somebody has: uard, or another package."""
    if plugin.kind not in NAMED:
        return None
    if plugin.name in own:
        return f"the name is uard's own {plugin.kind}"
    if Counter(p.name for p in found(plugin.kind))[plugin.name] > 1:
        others = [p.package for p in found(plugin.kind) if p.name == plugin.name and p != plugin]
        return f"the name is also brought by {', '.join(others)}"
    return None
