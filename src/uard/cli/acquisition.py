"""``uard acquisition``: is it worth choosing what raters are asked, or is asking at random as good?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from uard import __version__, _checks
from uard._support.text import counted
from uard.cli import progress, terminal

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class AcquisitionStudy:
    """Let simulated raters answer what each rule for asking asks, and see how many answers it saves against random."""

    seeds: int = 10
    """Number of seeds."""
    first_seed: int = 1000
    """The first of them; even ones below 1000 are for development, all others for what is reported."""
    overlap: int = 7
    """Raters per item; 7 are all that a panel may have."""
    extract: str | None = None
    """Write to this file what the report needs."""
    json: str | None = None
    """Write one JSON object to this file; - for standard output."""

    def run(self, console: Console) -> None:
        """Run the study and print its tables."""
        from uard.lab.studies import acquisition
        from uard.lab.views import acquisition as shown

        _checks.whole("seeds", self.seeds, low=2, high=10_000)
        _checks.whole("first_seed", self.first_seed, high=10**9)
        _checks.whole("overlap", self.overlap, low=1, high=1000)
        terminal.check_json(self.json)
        terminal.check_json(self.extract, self.json, field="extract")
        with progress.spinner(console, f"asking simulated raters, {counted(self.seeds, 'seed')}"):
            result = acquisition.run(range(self.first_seed, self.first_seed + self.seeds), overlap=self.overlap)
        command = f"uard acquisition --seeds {self.seeds} --first-seed {self.first_seed} --overlap {self.overlap}"
        data = {"command": command, "version": __version__} | result.as_data()
        for target, field in ((self.extract, "extract"), (self.json, "json")):
            if target is not None:
                terminal.write_json(data, target, field, indent=None)
        if "-" not in (self.json, self.extract):
            for table in shown.tables(data):
                terminal.show(table)
            for loss in shown.losses(data):
                terminal.paragraph(terminal.output(), loss.sentence(), rest="  ")
