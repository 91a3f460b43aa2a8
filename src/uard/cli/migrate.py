"""``uard migrate``: results of an older version."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tyro.conf import Positional

from uard.cli import terminal

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Migrate:
    """Bring results of an older version over to this one; the old file is kept beside the new one."""

    path: Positional[str]
    """A result store, or a JSON file of published results."""

    def run(self, console: Console) -> None:
        """Do it, and say what became of everything."""
        from uard.lab.execution.migrate import lines, migrate

        for line in lines(migrate(self.path)):
            terminal.say(terminal.output(), line)
