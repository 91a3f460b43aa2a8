"""``uard status``: how far studies are."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tyro.conf import Positional

from uard import _checks
from uard._support.text import counted
from uard.cli import terminal
from uard.cli.training import DEFAULT_STORE

if TYPE_CHECKING:
    from rich.console import Console

    from uard.lab.views.status import Status as Found


@dataclass(frozen=True)
class Status:
    """Say how far studies are, who is at work on them, and what failed; changes nothing."""

    studies: Positional[tuple[str, ...]] = ()
    """Which studies or groups of them; those of which the store knows anything if left out."""
    seeds: int | None = None
    """Seeds that every cell should have; as many as the store knows of any cell of a study if left out."""
    errors: bool = False
    """Print the tracebacks of what failed."""
    json: str | None = None
    """Write one JSON object to this file; - for standard output."""
    store: str = DEFAULT_STORE
    """Where finished seeds are kept."""

    def run(self, console: Console) -> None:
        """Read the store and print a table."""
        from uard.lab import studies
        from uard.lab.execution.store import Store
        from uard.lab.views import status

        if self.seeds is not None:
            _checks.whole("seeds", self.seeds, low=1, high=100_000)
        terminal.check_json(self.json, self.store)
        chosen = studies.find(self.studies) if self.studies else studies.every()
        with closing(Store(self.store, readonly=True)) as store:
            found = status.status(store, chosen, self.seeds, every=bool(self.studies))
        if self.json is not None:
            terminal.write_json(status.as_data(found), self.json)
        if self.json != "-":
            self._print(found)

    def _print(self, found: Found) -> None:
        from uard.lab.views import status

        out = terminal.output()
        told = [f"{self.store}: {counted(found.cells, 'cell')}, {counted(found.seeds, 'seed')}"]
        for line in (*told, *status.said_of_damaged(found.damaged), *status.lines(found.runs)):
            terminal.paragraph(out, line, rest="  ")
        columns = ("study", "seeds a cell", "finished", "in work", "failed", "missing", "last (UTC)")
        rows = []
        for s in found.studies:
            numbers = (s.seeds, s.finished, s.claimed, s.failed, s.missing)
            rows.append((s.name, *map(str, numbers), status.clock(s.last)[:16] if s.last else "-"))
        if rows:
            terminal.table(columns, rows, marked={i for i, s in enumerate(found.studies) if s.failed}, out=out)
        for failure in found.failures:
            when, what = status.clock(failure.why.created), failure.why.error
            head = f"failed {when}: {failure.title}, seeds {list(failure.seeds)}:"
            if self.errors:
                terminal.paragraph(out, head, rest="  ")
                terminal.lines(failure.why.traceback, out)
            else:
                terminal.paragraph(out, f"{head} {what}", rest="  ")
