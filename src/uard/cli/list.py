"""``uard list``: what has a name, and what it stands for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from uard import __version__, _checks
from uard._support.text import counted
from uard.cli import terminal

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rich.console import Console

    from uard.cli.catalogue import Entry
    from uard.lab.study import Study
    from uard.plugins import PluginError

SEEDS = 10  # that `uard reproduce` runs
FEW = 2  # that are enough where scenarios are the unit of intervals
_VALUES = 12  # of a label, that are named
_OPTIONS = {"environment": "--set", "agent": "--set-agent", "mitigation": "--set-mitigation"}


@dataclass(frozen=True)
class List:
    """List environments, agents, mitigations, panels and studies, or say all of one name."""

    name: Positional[str | None] = None
    """A kind (environments, agents, mitigations, panels, studies), a group of studies, or a name, of which all details
    are shown; everything that has a name if left out."""
    json: str | None = None
    """Write one JSON object to this file; - for standard output."""

    def run(self, console: Console) -> None:
        """Print them, and say which plugins cannot be used."""
        from uard.cli.catalogue import catalogue

        terminal.check_json(self.json)
        everything = catalogue()
        listed, found = everything, tuple[Any, ...]()
        if self.name is not None:
            listed, found = _chosen(self.name, everything)
        if self.json is not None:
            terminal.write_json(_as_data(listed, found), self.json)
        if self.json != "-":
            for title, entries in listed.items():
                terminal.entries(f"{title} ({len(entries)})", [(e.name, e.text, e.note) for e in entries])
                terminal.lines("")
            for entry in found:
                _details(entry)
                terminal.lines("")
            if self.name is None:
                terminal.paragraph(
                    terminal.output(), "all of one name: uard list NAME; all of one kind: uard list panels"
                )
        if self.name is None:
            for error in broken():
                terminal.warning(console, str(error))


def _chosen(
    name: str, everything: Mapping[str, tuple[Entry, ...]]
) -> tuple[dict[str, tuple[Entry, ...]], tuple[Entry, ...]]:
    """Return the lists that a name stands for, and the entries that it is the name of.

    Raises:
        InvalidValueError: neither; with the nearest names.
    """
    from uard.ratings.panels import RANDOM, as_panel, composition

    kinds = dict.fromkeys(title.partition(" ")[0] for title in everything)
    listed = {t: e for t, e in everything.items() if name in (t, t.partition(" ")[0], t.removeprefix("studies of "))}
    found = tuple(e for entries in everything.values() for e in entries if e.name == name)
    if name.startswith(RANDOM) and not found:
        from uard.cli.catalogue import Entry

        panel = as_panel(name)
        return {}, (Entry("panel", name, composition(panel), panel),)
    if not listed and not found:
        groups = [t.removeprefix("studies of ") for t in everything if t.startswith("studies of ")]
        names = [*kinds, *groups, *(e.name for entries in everything.values() for e in entries)]
        raise _checks.InvalidValueError("name", name, f"one of those that `uard list` shows{_near(name, names)}")
    return listed, found


def _near(name: str, names: Sequence[str]) -> str:
    """Return the nearest names as a question; nothing if none is near."""
    from difflib import get_close_matches

    spelt = {known.casefold(): known for known in reversed(names)}
    near = [repr(spelt[x]) for x in get_close_matches(name.casefold(), spelt, n=3)]
    return f"; did you mean {' or '.join(near)}?" if near else f": {', '.join(dict.fromkeys(names[:4]))}, ..."


def _details(entry: Entry) -> None:
    """Print all that is known of an entry."""
    from uard.cli.catalogue import fields_of

    out = terminal.output()
    terminal.paragraph(out, f"{entry.name}: {entry.kind}", style="bold")
    if entry.kind == "study":
        _of_study(entry.value)
        return
    for text in dict.fromkeys((entry.about or entry.text, entry.text)):
        if text == entry.about or not entry.about.startswith(text):
            terminal.paragraph(out, text, "  ")
    cls = type(entry.value)
    where = f" ({cls.__module__}.{cls.__qualname__})" if entry.value is not None else ""
    terminal.paragraph(out, f"from {entry.package}{where}", "  ")
    if entry.kind == "panel":
        _of_panel(entry)
        return
    rows = [(f.name, _shown(f.value), f.text) for f in fields_of(entry.value)]
    if rows:
        terminal.lines("")
        terminal.table(("field", "value", "what it means"), rows, labels=2)
    option = _OPTIONS[entry.kind.partition(" ")[0]]
    terminal.paragraph(out, f"try it: {_command(entry)}" + f" {option} FIELD=VALUE" * bool(rows), "  ")


def _command(entry: Entry) -> str:
    from uard.lab import registry

    if entry.kind == "environment":
        able = [name for name, agent in registry.agents(entry.value).items() if registry.can_work(agent, entry.value)]
        return f"uard run {entry.name}" + (f" --agent {able[0]}" if able and able[0] != "q-learning" else "")
    place = " Hopper" if "Hopper" in entry.kind else ""
    return f"uard run{place} --{entry.kind.partition(' ')[0]} {entry.name}"


def _shown(value: Any) -> str:
    """Return a value as ``--set`` and its like take it."""
    import json

    try:
        return value if isinstance(value, str) else json.dumps(value)
    except TypeError:
        return str(value)


def _of_panel(entry: Entry) -> None:
    out = terminal.output()
    if entry.value is not None:
        for number, rater in enumerate(entry.value.raters, 1):
            terminal.paragraph(out, f"rater {number}: {rater}", "  ", "    ")
    terminal.paragraph(out, f"try it: uard run --panel {entry.name}", "  ")


def _of_study(study: Study) -> None:
    from uard.cli.catalogue import labels_of, steps_of

    every = list({row.cell.key: row for row in study.rows}.values())  # two rows may be one cell: raw asks no panel
    out, steps, cells = terminal.output(), steps_of(every), len(every)
    seeds = FEW if study.brief else SEEDS
    terminal.paragraph(out, study.title, "  ")
    if study.answers:
        terminal.paragraph(out, f"answers: {study.answers}", "  ")
    runs = f"{counted(cells, 'cell')} x {seeds} seeds = {cells * seeds} runs"
    if steps:
        runs += f" of {_grouped(steps / cells)} steps at most on average, {_grouped(steps * seeds)} steps in all"
    terminal.paragraph(out, runs, "  ")
    if study.development:
        terminal.paragraph(out, "to tune constants on: what is reported comes from other studies", "  ")
    for label, values in labels_of(study):
        more = f" and {len(values) - _VALUES} more" if len(values) > _VALUES else ""
        terminal.paragraph(out, f"{label}: {', '.join(values[:_VALUES])}{more}", "  ", "    ")
    terminal.paragraph(out, f"run it: uard reproduce {study.name} --seeds {seeds}", "  ")
    terminal.paragraph(out, f"how far it is: uard status {study.name}", "  ")


def _grouped(count: float) -> str:
    return f"{count:,.0f}".replace(",", " ")


def _as_data(listed: Mapping[str, Sequence[Entry]], found: Sequence[Entry]) -> dict[str, Any]:
    """Return names and what they stand for as plain data."""
    kinds = {
        title: [{"name": e.name, "text": e.text, "package": e.package} for e in entries]
        for title, entries in listed.items()
    }
    return {"version": __version__, "kinds": kinds, "entries": [_as_entry(entry) for entry in found]}


def _as_entry(entry: Entry) -> dict[str, Any]:
    from uard.cli.catalogue import fields_of, labels_of

    data: dict[str, Any] = {"kind": entry.kind, "name": entry.name, "text": entry.text, "package": entry.package}
    if entry.kind == "study":
        return data | {"cells": len(entry.value.rows), "labels": dict(labels_of(entry.value))}
    if entry.kind == "panel":
        return data | {"raters": [] if entry.value is None else [str(r) for r in entry.value.raters]}
    return data | {
        "fields": [{"name": f.name, "value": _shown(f.value), "text": f.text} for f in fields_of(entry.value)]
    }


def broken() -> list[PluginError]:
    """Return an error for everything that installed packages bring and that cannot be used."""
    from uard.cli.commands import brought as commands
    from uard.lab import registry, studies
    from uard.lab.views import published, sections

    of_names = [error for kind in registry.OWN for error in registry.brought(kind)[1]]
    return [*of_names, *commands()[1], *studies.broken(), *published.broken(), *sections.broken()]
