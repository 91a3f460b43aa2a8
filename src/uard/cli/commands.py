"""The commands: ours, and those of installed packages.

A command is a frozen dataclass: its fields are the options, its docstring the help, and ``run(console)`` what it does
(``console`` is standard error). It imports what it needs when it runs. Packages bring commands of their own by entry
points of the group ``uard.commands`` (``uard.plugins``), which are imported when no command of ours is asked for.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Protocol

from uard import _checks, plugins

if TYPE_CHECKING:
    from rich.console import Console

OWN = {
    "run": "run.Run",
    "reproduce": "reproduce.Reproduce",
    "doctor": "doctor.Doctor",
    "preferences": "preferences.Preferences",
    "raters": "raters.Raters",
    "judges": "judges.Judges",
    "collect": "collect.Collect",
    "best-of-n": "best_of_n.BestOfN",
    "acquisition": "acquisition.AcquisitionStudy",
    "leaderboard": "leaderboard.Leaderboard",
    "status": "status.Status",
    "compare": "compare.Compare",
    "list": "list.List",
    "migrate": "migrate.Migrate",
}
"""Ours: name on the command line -> module of this folder, and class."""


class Command(Protocol):
    """What a command does."""

    def run(self, console: Console) -> None:
        """Do it; results go to standard output, the rest to ``console``.

        Raises:
            InvalidValueError: bad input, exit code 2.
            SystemExit: with another exit code.
        """


@cache
def own() -> dict[str, type[Command]]:
    """Return our commands by name.

    Raises:
        ModuleNotFoundError: the core is installed without its laboratory.
    """
    places = {name: where.split(".") for name, where in OWN.items()}
    return {name: getattr(import_module(f"uard.cli.{file}"), kind) for name, (file, kind) in places.items()}


def brought() -> tuple[dict[plugins.Plugin, type[Command]], list[plugins.PluginError]]:
    """Return the commands of installed packages, and what of them is broken."""

    def read(plugin: plugins.Plugin) -> type[Command]:
        kind = plugin.get()
        parameters = getattr(kind, "__dataclass_params__", None)
        if not (isinstance(kind, type) and parameters and parameters.frozen and callable(getattr(kind, "run", None))):
            raise plugins.PluginError(plugin, f"{_checks.short(kind)} is no frozen dataclass with a method run")
        return kind

    return plugins.brought("command", read, own())
