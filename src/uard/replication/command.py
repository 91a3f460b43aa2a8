"""``uard ledger``: joins the command line by the door of plugins (``uard.plugins``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tyro.conf import Positional

from uard import _checks
from uard.cli import terminal, training
from uard.cli.training import DEFAULT_STORE, UNWATCHED, WatchOptions
from uard.replication.verdicts import FAILS, HOLDS, IN_PART, UNTESTABLE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from uard.replication.ledger import Entry


@dataclass(frozen=True)
class Ledger:
    """Say of every claim of the paper that a grid can answer whether it holds."""

    claims: Positional[tuple[str, ...]] = ()
    """Only these, e.g. J5 F3; all if left out."""
    json: str | None = None
    """Write the ledger as JSON to this file; - for standard output."""
    seeds: int = 10
    """Number of seeds (0, 1, ...)."""
    store: str = DEFAULT_STORE
    """Where finished seeds are kept; what is missing is trained first."""
    workers: int | None = None
    """Processes; one per core if left out."""
    watch: WatchOptions = UNWATCHED

    def run(self, console: Console) -> None:
        """Train what is missing, then print the ledger."""
        from uard.lab import studies
        from uard.lab.execution.store import Store
        from uard.lab.views.study_results import StudyResults
        from uard.replication import ledger

        _checks.whole("seeds", self.seeds, low=2, high=100_000)
        terminal.check_workers(self.workers)
        terminal.check_json(self.json, self.store)
        for claim in self.claims:
            _checks.choose("claim", claim, ledger.CLAIMS)
        store, seeds, grid = Store(self.store), range(self.seeds), studies.grid()
        jobs = [job for study in grid for job in study.jobs(seeds)]
        what = "what the ledger needs"
        training.train(jobs, store, console, what, self.watch, workers=self.workers, studies=grid)
        results = StudyResults(store, seeds, grid)
        entries = [e for e in ledger.entries(results) if not self.claims or e.claim in self.claims]
        if self.json is not None:
            terminal.write_json(ledger.as_data(entries, seeds), self.json)
        if self.json != "-":
            show(entries)


def show(entries: Sequence[Entry]) -> None:
    """Print lines of the ledger, each as a paragraph: a table of so much text could not be read at 80 columns."""
    from rich.padding import Padding

    from uard.replication import paper

    colour = {HOLDS: "green", IN_PART: "yellow", FAILS: "red", UNTESTABLE: "dim"}
    sign = {True: "+", False: "-", None: "?"}
    out = terminal.output()
    out.print(terminal.escape(f"The paper: {paper.VERSION}"))
    for e in entries:
        out.print(f"[bold]{e.claim}[/bold] [{colour[e.verdict]}]{e.verdict}[/]" + f" ({e.count})" * bool(e.count))
        parts = (f"{sign[part.holds]} {part.name}" + " (opinion)" * part.opinion for part in e.parts)
        for text in (e.statement, f"ours: {e.ours}", *parts, f"why: {e.why}"):
            out.print(Padding(terminal.escape(text), (0, 0, 0, 4)))
