"""``uard leaderboard``: a page that ranks mitigations."""

from __future__ import annotations

import os
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from uard import InvalidValueError
from uard._support import files
from uard.cli import terminal
from uard.cli.training import DEFAULT_STORE

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Leaderboard:
    """Write a page that ranks mitigations over everything that a store holds, your own included."""

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
            for line in said_of_damaged(store.damaged):
                terminal.warning(console, line)
        terminal.say(console, f"leaderboard: {written}")
