"""``uard collect status``: how far a project is, and what comes next."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from uard import __version__
from uard._support.text import counted
from uard.cli import projects, terminal

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from rich.console import Console

    from uard.collect import Item, Project, Request
    from uard.ratings.table import Answers


@dataclass(frozen=True)
class Status:
    """Say how far a project is: answers, by rater, and what is still to come."""

    project: Positional[str]
    """A project's folder."""
    json: str | None = None
    """Write one JSON object to this file; - for standard output."""

    def run(self, console: Console) -> None:
        """Read the store and print numbers."""
        from uard.collect import Project

        project = Project.open(self.project)
        project.outside(self.json, "json")
        found = _status(project)
        if self.json is not None:
            terminal.write_json({"version": __version__, "project": self.project} | found, self.json)
        if self.json != "-":
            rows = [_row(rater) for rater in found["raters"]]
            if rows:
                terminal.table(("rater", "answers", "skipped", "coverage", "link used"), rows, self.project)
            out = terminal.output()
            for line in _told(found):
                terminal.paragraph(out, line, rest="  ")
        for name, why in found["damaged"].items():
            terminal.warning(console, f"item {name} is not shown: {why}")
        projects.warn_unknown(console, found["unknown"])
        terminal.say(console, f"next: {_next(found, self.project)}")


def _status(project: Project) -> dict[str, Any]:
    from uard.collect.app.overview import overview

    with closing(project.store()) as store:
        (answers, _), (items, _), raters = store.answers(), store.items(), store.raters()
        opened = store.open_requests()[0]
    damaged = project.damaged(items)
    by_name = {item.id: item for item in items}
    names = [rater.name for rater in raters]
    seen = overview(answers, by_name, project.question, names, without=_aside(items, damaged))
    states = {rater.name: rater for rater in raters}
    rows = [
        {"name": r.name, "answers": r.answers, "skipped": r.skipped, "coverage": r.coverage}
        | {"entered": r.name in states and states[r.name].entered}
        | {"paused": r.name in states and states[r.name].paused}
        for r in seen.raters
    ]
    return {
        "items": seen.items,
        "rated": seen.rated,
        "complete": seen.complete,
        "answers": seen.answers,
        "wanted": seen.wanted,
        "open_requests": _waiting(opened, answers),
        "overlap": project.question.overlap,
        "raters": rows,
        "damaged": damaged,
        "unknown": project.unknown(items),
    }


def _aside(items: Sequence[Item], damaged: Collection[str]) -> set[str]:
    """Return the items that cannot be shown: what is damaged, and pairs of which one side is."""
    sides = {item.id: {item.content["left"], item.content["right"]} for item in items if item.kind == "pair"}
    return {*damaged, *(name for name, both in sides.items() if not both.isdisjoint(damaged))}


def _waiting(opened: Sequence[Request], answers: Answers) -> int:
    """Return how many questions were given out and still wait; what was answered by another way does not."""
    said = {(a.item, a.rater) for a in answers.standing()}
    return sum(r.kind == "repeat" or (r.item, r.rater) not in said for r in opened)


def _row(rater: dict[str, Any]) -> tuple[str, ...]:
    name = f"{rater['name']} (paused)" if rater["paused"] else rater["name"]
    used = "yes" if rater["entered"] else "no"
    return name, str(rater["answers"]), str(rater["skipped"]), f"{rater['coverage']:.0%}", used


def _told(found: dict[str, Any]) -> list[str]:
    items, out = counted(found["items"], "item"), counted(found["open_requests"], "question")
    return [
        f"{items}, {found['rated']} of them rated, {found['complete']} by as many as wanted",
        f"{found['answers']} of {found['wanted']} answers that are wanted; {out} given out and not answered yet",
    ]


def _next(found: dict[str, Any], folder: str) -> str:
    if not found["raters"]:
        return f"uard collect serve {folder} --raters ann,bob"
    here = sum(not rater["paused"] for rater in found["raters"])
    few = found["overlap"] - here
    if found["items"] * here <= found["answers"] < found["wanted"] and few > 0 and not found["open_requests"]:
        return f"uard collect serve {folder} --raters NAMES, for {counted(few, 'more rater')}"
    if found["answers"] < found["wanted"] or found["open_requests"]:
        return f"uard collect serve {folder}"
    return f"uard collect export {folder} answers.csv"
