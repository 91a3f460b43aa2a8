"""What has a name: environments, agents, mitigations, panels, studies and groups of them, each in a line of words."""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from uard import __version__
from uard._support.text import counted
from uard.lab import registry, studies
from uard.lab.study import Study
from uard.method import mitigations
from uard.ratings.panels import PANELS, RANDOM, composition

UARD = f"uard {__version__}"
_MOST = 3  # differences that are named


@dataclass(frozen=True)
class Entry:
    """A name and what it stands for.

    Attributes:
        kind: In the singular, as people call it.
        name: As on the command line.
        text: What it is, in a line.
        value: What it stands for.
        about: More of it, for whoever asks for this one.
        note: In brackets behind the text.
        package: That brings it.
    """

    kind: str
    name: str
    text: str
    value: Any
    about: str = ""
    note: str = ""
    package: str = UARD


@dataclass(frozen=True)
class Field:
    """A setting of an entry.

    Attributes:
        name: As ``--set`` and its like take it.
        value: That it has.
        text: What it means; empty if its class does not say.
    """

    name: str
    value: Any
    text: str


def catalogue() -> dict[str, tuple[Entry, ...]]:
    """Return all entries by kind, in the plural; what packages bring stands behind what is ours."""
    return {
        "environments": _described("environment", registry.ENVIRONMENTS),
        "agents": _described("agent", registry.AGENTS),
        "agents for Hopper and Walker2d": _described(
            "agent for Hopper and Walker2d", registry.CONTINUOUS, theirs=False
        ),
        "mitigations": _described(
            "mitigation", {name: mitigations.named(name) for name in mitigations.NAMED}, mitigations.NAMED
        ),
        "panels": (
            *(Entry("panel", name, composition(panel), panel) for name, panel in PANELS.items()),
            Entry("panel", f"{RANDOM}SEED", "1 to 7 raters drawn at random, the same for the same seed", None),
        ),
        **{
            f"studies of {group}": tuple(Entry("study", s.name, s.title, s, note=_size(s)) for s in members)
            for group, members in studies.groups().items()
        },
    }


def _size(study: Study) -> str:
    return f"({counted(len(study.rows), 'cell')}{', to tune on' * study.development})"


def _described(
    kind: str, values: Mapping[str, Any], makers: Mapping[str, Callable[..., Any]] | None = None, theirs: bool = True
) -> tuple[Entry, ...]:
    """Return entries: the first of a class, and the one with its defaults, in its words, others by what differs."""
    ours = []
    for name, value in values.items():
        maker = (makers or {}).get(name)
        about = summary(maker if inspect.isfunction(maker) else type(value))
        ours.append(Entry(kind, name, _told(name, values, about, maker), value, about))
    if theirs:
        for plugin, value in registry.brought(kind)[0].items():
            about = summary(type(value))
            ours.append(Entry(kind, plugin.name, _short(about), value, about, f"(of {plugin.package})", plugin.package))
    return tuple(ours)


def _told(name: str, values: Mapping[str, Any], about: str, maker: Callable[..., Any] | None) -> str:
    value = values[name]
    own, usual = settings(value), settings(_usual(value))
    kin = [other for other in values if type(values[other]) is type(value)]
    plain = next((other for other in kin if settings(values[other]) == usual), kin[0])
    if name == plain or inspect.isfunction(maker):
        return _short(about)
    earlier = [other for other in dict.fromkeys([*kin[: kin.index(name)], plain])]
    changed = {other: _changes(own, settings(values[other])) for other in earlier}
    nearest = min(earlier, key=lambda other: len(changed[other]))
    if not changed[nearest]:
        return f"the same as {nearest}"
    told = changed[nearest]
    more = f" and {len(told) - _MOST} more" if len(told) > _MOST else ""
    return f"as {nearest}, but {', '.join(told[:_MOST])}{more}"


def _short(about: str) -> str:
    """Return the first part of a sentence."""
    return about.partition("; ")[0]


def _usual(value: Any) -> Any:
    """Return what its class makes without arguments; itself if it takes some."""
    try:
        return type(value)()
    except TypeError:
        return value


def _changes(own: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    changed = [name for name, value in own.items() if name not in other or other[name] != value]
    whole = tuple(f"{name}." for name in changed if isinstance(own[name], type))  # parts of another class
    return [f"{name} {_value(own[name])}" for name in changed if not name.startswith(whole)]


def _value(value: Any) -> str:
    if isinstance(value, type):
        return value.__name__
    if isinstance(value, bool):
        return "on" if value else "off"
    return "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value).replace(" ", "")


def settings(value: Any, prefix: str = "") -> dict[str, Any]:
    """Return the fields of a frozen dataclass by name: of a part its class, and its fields with dots."""
    found: dict[str, Any] = {}
    for field in dataclasses.fields(value):
        inner = getattr(value, field.name)
        if dataclasses.is_dataclass(inner) and not isinstance(inner, type):
            found[prefix + field.name] = type(inner)
            found |= settings(inner, f"{prefix}{field.name}.")
        else:
            found[prefix + field.name] = inner
    return found


def summary(thing: Any) -> str:
    """Return the first sentence of a docstring, in plain text."""
    doc = inspect.getdoc(thing) or ""
    if dataclasses.is_dataclass(thing) and doc.startswith(f"{getattr(thing, '__name__', '')}("):
        doc = ""  # which nobody has written
    return plain(doc.partition("\n\n")[0]).removesuffix(".") or "nothing is said of it"


def plain(text: str) -> str:
    """Return text without the marks of code."""
    return " ".join(text.replace("``", "").split())


def fields_of(value: Any, prefix: str = "") -> list[Field]:
    """Return the settings of an entry, with what the docstrings of its class and its parts say of them."""
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return []
    docs, found = _documented(type(value)), list[Field]()
    for field in dataclasses.fields(value):
        inner = getattr(value, field.name)
        name = prefix + field.name
        if dataclasses.is_dataclass(inner) and not isinstance(inner, type):
            found += fields_of(inner, f"{name}.")
        else:
            found.append(Field(name, inner, docs.get(field.name, "")))
    return found


def _documented(cls: type) -> dict[str, str]:
    """Return what a class and those that it inherits from say of their fields."""
    docs: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        lines = (inspect.cleandoc(base.__doc__) if base.__doc__ else "").splitlines()
        if "Attributes:" not in lines:
            continue
        name = ""
        for line in lines[lines.index("Attributes:") + 1 :]:
            if line and not line.startswith(" "):
                break
            if found := re.match(r" {4}(\w+)(?: \([^)]*\))?: (.*)", line):
                name, docs[found[1]] = found[1], found[2]
            elif name and line.strip():
                docs[name] += f" {line.strip()}"
    return {name: plain(text) for name, text in docs.items()}


def labels_of(study: Study) -> list[tuple[str, list[str]]]:
    """Return what tells the rows of a study from each other: each label, and its values in order."""
    values: dict[str, dict[str, None]] = {}
    for row in study.rows:
        for name, value in row.labels:
            values.setdefault(name, {})[str(value)] = None
    return [(name, list(several)) for name, several in values.items()]


def steps_of(rows: Sequence[Any]) -> int:
    """Return how many steps of an environment one seed of all rows takes at most; 0 where that is not known."""
    total = 0
    for row in rows:
        cell = row.cell
        steps = cell.steps or cell.episodes * (getattr(cell.environment, "horizon", 0) or 0)
        if not steps:
            return 0
        total += steps
    return total
