"""``uard leaderboard``: a page that ranks mitigations."""

from __future__ import annotations

import os
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from uard import InvalidValueError
from uard._support import files
from uard._support.text import counted
from uard.cli import terminal
from uard.cli.training import DEFAULT_STORE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from uard.lab.views.leaderboard import Standing

MOST = 12  # mitigations in the terminal


@dataclass(frozen=True)
class Leaderboard:
    """Rank mitigations over everything that a store holds, your own included: the first here, all on a page."""

    store: str = DEFAULT_STORE
    """Where finished seeds are kept; nothing is trained."""
    out: str = "leaderboard.html"
    """The page."""

    def run(self, console: Console) -> None:
        """Read the store and write the page."""
        from uard.lab.execution.store import Store
        from uard.lab.views import leaderboard
        from uard.lab.views.status import said_of_damaged

        if not os.path.isfile(self.store):  # Path's raises for a long name
            allowed = "a file that is there; `uard reproduce` and `uard run --store` make one"
            raise InvalidValueError("store", self.store, allowed)
        files.prepare(self.out, "out", self.store)
        with closing(Store(self.store, readonly=True)) as store:
            written = leaderboard.write(Path(self.out), store)
            these = leaderboard.lines(store)
            for line in said_of_damaged(store.damaged):
                terminal.warning(console, line)
        _print(leaderboard.standings(these), len(these))
        terminal.say(console, f"leaderboard: {written}")


def _print(standings: Sequence[Standing], cells: int) -> None:
    """Print the first of the ranking; the page has the rest, and what it rests on."""
    out = terminal.output()
    ranked = [s for s in standings if s.unbeaten[1]]
    columns = ("mitigation", "unbeaten", "hacks less", "earns more", "earns less")
    failed = any(s.failed for s in ranked)
    rows = []
    for s in ranked[:MOST]:
        against = (f"{share[0]}/{share[1]}" for share in (s.unbeaten, s.tamer, s.richer, s.poorer))
        rows.append((s.mitigation, *against, *[str(s.failed)] * failed))
    if not rows:
        terminal.paragraph(
            out, f"{counted(cells, 'cell')}, and no two mitigations with two seeds in one setting: no ranking"
        )
        return
    title = f"{counted(cells, 'cell')}, honest raters; the first {len(rows)} of {len(ranked)} mitigations"
    terminal.table((*columns, *["failed seeds"] * failed), rows, title, out=out)
    terminal.paragraph(
        out,
        "in how many settings, of how many; unbeaten: no other mitigation has a higher true return; hacks less, earns "
        "more, earns less: than the raw reward, after Holm correction; sorted by what share is surely unbeaten",
    )
