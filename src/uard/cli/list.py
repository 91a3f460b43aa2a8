"""``uard list``: all names."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from uard._support.text import counted
from uard.cli import terminal

if TYPE_CHECKING:
    from rich.console import Console

    from uard.lab.study import Study
    from uard.plugins import PluginError


@dataclass(frozen=True)
class List:
    """List environments, agents, mitigations, panels and studies."""

    def run(self, console: Console) -> None:
        """Print them, and say which plugins cannot be used."""
        from uard.lab import registry, studies
        from uard.method import mitigations
        from uard.ratings.panels import PANELS, RANDOM

        theirs = {
            kind: {p.name: f"{value} (of {p.package})" for p, value in registry.brought(kind)[0].items()}
            for kind in registry.OWN
        }
        rows: dict[str, dict[str, str]] = {
            "environments": {k: str(v) for k, v in registry.ENVIRONMENTS.items()} | theirs["environment"],
            "agents": {k: str(v) for k, v in registry.AGENTS.items()} | theirs["agent"],
            "agents for Hopper and Walker2d": {k: str(v) for k, v in registry.CONTINUOUS.items()},
            "mitigations": {k: str(mitigations.named(k)) for k in mitigations.NAMED} | theirs["mitigation"],
            "panels": {k: str(v) for k, v in PANELS.items()}
            | {f"{RANDOM}SEED": "one to seven raters drawn at random, the same for the same seed"},
            **{
                f"studies of {group}": {s.name: f"{s.title} ({'; '.join(_facts(s))})" for s in members}
                for group, members in studies.groups().items()
            },
        }
        for title, entries in rows.items():
            terminal.glossary(title, entries)
        for error in broken():
            terminal.warning(console, str(error))


def _facts(study: Study) -> list[str]:
    """Return what a study answers, if anything of the paper, how large it is, and what it is for."""
    facts = [study.answers, counted(len(study.rows), "cell"), "to tune on" if study.development else ""]
    return [fact for fact in facts if fact]


def broken() -> list[PluginError]:
    """Return an error for everything that installed packages bring and that cannot be used."""
    from uard.cli.commands import brought as commands
    from uard.lab import registry, studies
    from uard.lab.views import published, sections

    of_names = [error for kind in registry.OWN for error in registry.brought(kind)[1]]
    return [*of_names, *commands()[1], *studies.broken(), *published.broken(), *sections.broken()]
