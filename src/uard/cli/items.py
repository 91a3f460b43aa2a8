"""``uard collect items``: what is in a project, by name."""

from __future__ import annotations

from collections import Counter
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from uard import __version__
from uard._support.text import counted
from uard.cli import terminal

if TYPE_CHECKING:
    from rich.console import Console

    from uard.collect import Item

WIDEST = 34  # characters of a text


@dataclass(frozen=True)
class Items:
    """List what a project shows, with the names that [[practice]], [[gold]] and [[example]] in project.toml take."""

    project: Positional[str]
    """A project's folder."""
    json: str | None = None
    """Write one JSON object to this file; - for standard output."""

    def run(self, console: Console) -> None:
        """List."""
        from uard.collect import Project

        project = Project.open(self.project)
        project.outside(self.json, "json")
        with closing(project.store()) as store:
            (items, _), (answers, _) = store.items(), store.answers()
        told = Counter(a.item for a in answers.standing() if not a.attribute and a.kind != "practice")
        rows: list[dict[str, Any]] = [
            {
                "item": i.id,
                "kind": i.kind,
                "answers": told[i.id],
                "reward": i.reward,
                "stratum": i.stratum,
                "is": _is(i),
            }
            for i in items
        ]
        if self.json is not None:
            terminal.write_json({"version": __version__, "project": self.project, "items": rows}, self.json)
        if self.json != "-":
            shown = [
                (r["item"], str(r["answers"]), "" if r["reward"] is None else f"{r['reward']:.3g}", r["is"])
                for r in rows
            ]
            terminal.table(("item", "answers", "reward", "what it is"), shown, self.project)
            terminal.say(console, counted(len(rows), "item"))


def _is(item: Item) -> str:
    """Return in a few words what an item is."""
    if item.kind == "pair":
        return f"{item.content['left'][:8]} and {item.content['right'][:8]}"
    if item.kind == "clip":
        return f"{item.content['frames']} frames, {item.stratum}"
    text = " ".join(str(item.content["completion"]).split())
    return text if len(text) <= WIDEST else text[: WIDEST - 1] + "…"
