"""Help: what docstrings say about options and commands, in lines that fit, whoever wrote them.

tyro keeps the line feeds of a field's docstring whose lines are indented, and does not break descriptions at all.
So it gets the docstrings joined, and what it prints is broken here.
"""

from __future__ import annotations

import dataclasses
import os
import re
import shutil
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any, cast, get_args, get_type_hints

from uard._support.columns import fill

_LEAST = 40
_CODES = re.compile("\x1b\\[[0-9;]*m")
_CHOICES = re.compile(r"\{[\w,-]{30,}\}")
_BOX = "│╭╰+|"  # with which tyro's boxes begin


def asked(arguments: Iterable[str]) -> bool:
    """Return whether somebody asks for help."""
    return not {"-h", "--help"}.isdisjoint(arguments)


def explain(kind: Any) -> None:
    """Let the fields of a command, and of all that is nested in it, have their docstrings as help, in one line each."""
    for part in _parts(kind, set()):
        docs = _documented(part)
        for field in dataclasses.fields(part):
            if "help" not in field.metadata and field.name in docs:
                text = " ".join(docs[field.name].split()).replace(" Repeatable.", "")  # tyro says it, too
                field.metadata = MappingProxyType({**field.metadata, "help": text})  # pyright: ignore[reportAttributeAccessIssue]


def _parts(kind: Any, seen: set[Any]) -> Iterator[Any]:
    """Yield a dataclass and those that its fields' types are made of."""
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        if kind in seen:
            return
        seen.add(kind)
        yield kind
        try:
            hints = get_type_hints(kind, include_extras=True)
        except Exception:  # of a package that names what is not there: tyro says so
            return
        for hint in hints.values():
            yield from _parts(hint, seen)
    for part in get_args(kind):
        yield from _parts(part, seen)


def _documented(kind: Any) -> dict[str, str]:
    """Return what docstrings say about a class's fields, inherited ones too."""
    import docstring_parser

    docs: dict[str, str] = {}
    for cls in reversed(kind.__mro__[:-1]):
        try:
            found = docstring_parser.parse_from_object(cls).params
        except Exception:  # of a package whose source is not there
            continue
        docs |= {p.arg_name: p.description for p in found if p.description}
    return docs


@contextmanager
def broken() -> Iterator[None]:
    """Break what the block prints into lines that fit."""
    import tyro

    if os.environ.get("NO_COLOR"):  # which tyro does not know
        tyro._experimental_options["ansi_codes"] = False  # pyright: ignore[reportPrivateUsage]
    before = sys.stdout
    sys.stdout = cast(Any, _Broken(before))
    try:
        yield
    finally:
        sys.stdout = before


class _Broken:
    """A stream that breaks long lines between words; boxes are as they should be."""

    def __init__(self, stream: Any):
        self._stream = stream

    def write(self, text: str) -> int:
        width = max(_LEAST, shutil.get_terminal_size().columns)
        self._stream.write("\n".join(self._fitting(line, width) for line in text.split("\n")))
        return len(text)

    def _fitting(self, line: str, width: int) -> str:
        bare = _CODES.sub("", line)
        if len(bare) <= width or bare.startswith(tuple(_BOX)):
            return line
        if bare.startswith("usage: "):
            return fill(_CHOICES.sub("COMMAND", line), width + len(line) - len(bare), rest="    ")
        return fill(line, width)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)
