"""``uard preferences``: what is in a file of answers about pairs. Needs no JAX."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tyro.conf import Positional

from uard import __version__
from uard.cli import terminal

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Preferences:
    """Count the answers about pairs in a file, and say how far raters agree."""

    file: Positional[str]
    """A CSV, JSON, JSONL or Parquet file. Columns: two sides (left and right, response_a and response_b ...) and which
    was preferred (choice, winner ...), or chosen and rejected; and who answered (annotator, worker ...)."""
    json: str | None = None
    """Write one JSON object to this file; - for standard output."""

    def run(self, console: Console) -> None:
        """Read the file and print the counts."""
        from uard.ratings import preferences

        terminal.check_json(self.json, self.file)
        found = preferences.read(self.file)
        counts = {
            "comparisons": len(found),
            "ties": int((found.outcome == 0.5).sum()),
            "skipped": found.skipped,
            "swapped": found.swapped,
            "raters": len(found.raters),
            "agreement": found.agreement(),
        }
        if self.json is not None:
            terminal.write_json({"version": __version__, "source": found.source} | counts, self.json)
        if self.json != "-":
            agreement = counts.pop("agreement")
            shown = (
                "not defined (no pair was judged by two)"
                if agreement is None
                else f"{agreement:.3f} (about 0.5 by chance if there are no ties)"
            )
            terminal.table(("answers", ""), [(name, str(n)) for name, n in counts.items()], title=found.source)
            terminal.paragraph(terminal.output(), f"agreement of two raters: {shown}")
