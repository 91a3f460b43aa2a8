"""``uard compare``: whether two stores agree."""

from __future__ import annotations

import sys
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tyro.conf import Positional

from uard._support.columns import decimals
from uard._support.text import counted
from uard.cli import terminal
from uard.cli.terminal import MANY

if TYPE_CHECKING:
    from rich.console import Console

    from uard.lab.views.compare import Comparison


@dataclass(frozen=True)
class Compare:
    """Say whether two stores agree: bit by bit, or but for the noise over seeds. Exit code 1 if they do not."""

    store_a: Positional[str]
    """One store."""
    store_b: Positional[str]
    """The other: of another machine, version, engine."""
    json: str | None = None
    """Write one JSON object to this file; - for standard output."""

    def run(self, console: Console) -> None:
        """Read both and print what differs."""
        from uard.lab.execution.store import Store
        from uard.lab.views import compare

        terminal.check_json(self.json, self.store_a, self.store_b)
        with (
            closing(Store(self.store_a, readonly=True)) as a,
            closing(Store(self.store_b, readonly=True)) as b,
        ):
            found = compare.compare(a, b)
        if self.json is not None:
            terminal.write_json(compare.as_data(found), self.json)
        if self.json != "-":
            _print(found)
        if found.differs:
            sys.exit(1)


def _print(found: Comparison) -> None:
    from uard.lab import studies
    from uard.lab.views import compare
    from uard.lab.views.status import titles

    out = terminal.output()
    differing = sorted((c for c in found.cells if c.effects), key=lambda c: c.effects[0].p)
    if differing:
        names = titles(studies.every())
        shown = [("all cells that differ", None, e) for e in found.everywhere[:1]]
        shown += [(names.get(c.key) or compare.title(c.config), c, c.effects[0]) for c in differing[:MANY]]
        digits = decimals([e.difference for _, c, e in shown if c], most=4)
        rows = []
        for name, c, e in shown:
            counts = (str(len(c.seeds)), str(len(c.identical))) if c else ("", "")
            effect = "none" if e.effect is None else f"{e.effect:+z.2f}"
            difference = f"{e.difference:+z.{digits}f}" if c else ""
            rows.append((name, *counts, e.metric, difference, effect, f"{e.p:.4f}"))
        columns = ("cell", "seeds", "identical", "metric", "B - A", "in seed sd", "p, corrected")
        marked = {i for i, (_, _, e) in enumerate(shown) if e.differs}
        terminal.table(columns, rows, marked=marked, out=out)
        if len(differing) > MANY:
            more = counted(len(differing) - MANY, "more cell")
            terminal.paragraph(out, f"and {more} with differences; --json has them all")
    for line in compare.lines(found):
        terminal.paragraph(out, line, rest="  ")
