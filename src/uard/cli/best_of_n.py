"""``uard best-of-n``: over-optimisation without an agent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from uard import __version__, _checks
from uard._support.text import counted
from uard.cli import progress, terminal

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class BestOfN:
    """Choose the best of n = 1 .. 10 000 by K reward models, and see what it is worth in gold."""

    seeds: int = 20
    """Number of seeds (0, 1, ...); about a second each."""
    json: str | None = None
    """Write one JSON object to this file; - for standard output."""

    def run(self, console: Console) -> None:
        """Run the study and print its table."""
        from uard.lab.studies import best_of_n
        from uard.lab.views import best_of_n as shown

        _checks.whole("seeds", self.seeds, low=2, high=100_000)
        terminal.check_json(self.json)
        with progress.spinner(console, f"choosing the best of n, {counted(self.seeds, 'seed')}"):
            result = best_of_n.run(range(self.seeds))
        data = {"command": f"uard best-of-n --seeds {self.seeds}", "version": __version__} | result.as_data()
        if self.json is not None:
            terminal.write_json(data, self.json, indent=None)
        if self.json != "-":
            terminal.show(shown.table(data))
            for loss in shown.losses(data):
                terminal.paragraph(terminal.output(), loss.sentence(), rest="  ")
