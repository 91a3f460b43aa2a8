"""What reaches a terminal: lines, tables, JSON. Text of others is printed as it is, never obeyed."""

from __future__ import annotations

import codecs
import io
import json
import os
import shutil
import sys
from collections.abc import Container, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from uard import _checks
from uard._support import columns as layout
from uard._support import files
from uard._support.text import printable

if TYPE_CHECKING:
    from rich.console import Console

    from uard.lab.views.tables import Table

MANY = 20  # lines of one kind, after which the rest is counted
_NARROW, _WIDE = 40, 120  # columns that are made use of, whatever a terminal says


def output() -> Console:
    """Return standard output."""
    from rich.console import Console

    return Console(highlight=False)


def width(console: Console | None = None) -> int:
    """Return how many columns a line may take: 80 where nobody says."""
    return min(_WIDE, max(_NARROW, (console or output()).width))


def is_wide_enough() -> None:
    """Let rich and tyro never see a terminal of no columns, in which the one prints nothing and the other never ends.

    ``COLUMNS=0`` is what some containers set; then the terminal itself is asked, or it is 80.
    """
    if not os.environ.get("COLUMNS", "1").strip("0"):
        del os.environ["COLUMNS"]
    if shutil.get_terminal_size().columns < _NARROW:
        os.environ["COLUMNS"] = str(_NARROW)


def shows_what_it_can() -> None:
    """Let output whose encoding has no box or dash have something like it, instead of an error."""
    codecs.register_error("uard.alike", layout.replaced)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and codecs.lookup(stream.encoding).name != "utf-8":
            stream.reconfigure(errors="uard.alike")


def say(console: Console, text: str, kind: str = "") -> None:
    """Print a line whole, for a path that is broken in two can be neither copied nor found.

    Args:
        console: Where to.
        text: Is printed as it is.
        kind: What stands before it, in rich's markup.
    """
    console.print(kind + escape(text), soft_wrap=True)


def paragraph(console: Console, text: str, first: str = "", rest: str | None = None, style: str | None = None) -> None:
    """Print text in lines that fit, broken between words; see ``uard._support.columns.fill``."""
    shown = _shown(text, console)
    console.out(layout.fill(shown, width(console), first, rest), style=style, highlight=False)


def lines(text: str, out: Console | None = None) -> None:
    """Print text that has lines already as it is."""
    out = out or output()
    out.out(_shown(text, out), highlight=False)


def error(console: Console, text: str) -> None:
    """Say what is wrong."""
    _message(console, text, "error:", "red")


def warning(console: Console, text: str) -> None:
    """Say what is doubtful."""
    _message(console, text, "warning:", "yellow")


def _message(console: Console, text: str, kind: str, colour: str) -> None:
    """Print a message: in one line where programs read it, between words where people do."""
    if console.is_terminal:
        text = layout.fill(printable(text), width(console) - len(kind) - 1, rest="").replace("\n", "\n  ")
    say(console, text, f"[{colour}]{kind}[/{colour}] ")


def escape(text: str) -> str:
    """Return text that rich prints as it is: markup is shown, and the rest is ``printable``."""
    from rich.markup import escape as escaped

    return escaped(printable(text))


def _shown(text: str, out: Console) -> str:
    return layout.encodable(printable(text), out.encoding)


def table(
    columns: Sequence[str],
    rows: Iterable[Sequence[str]],
    title: str = "",
    labels: int = 1,
    marked: Container[int] = (),
    out: Console | None = None,
) -> None:
    """Print a table, as wide as the terminal at most; see ``uard._support.columns.lay_out``.

    Args:
        columns: Their heads.
        rows: As many texts each as there are columns.
        title: Above it.
        labels: So many columns name the row.
        marked: Numbers of rows that are red.
        out: Where to; standard output if left out.
    """
    out = out or output()
    if title:
        paragraph(out, title, style="bold")
    heads, *texts = ([_shown(x, out) for x in row] for row in (columns, *rows))
    part: list[str] = []
    before: str | None = None

    def tell() -> None:
        if part:
            out.out("\n".join(part), style=before, highlight=False)
            part.clear()

    for line in layout.lay_out(heads, texts, width(out), labels):
        style = "dim" if line.row is None else "red" if line.row in marked else None
        if style != before:
            tell()
        before = style
        part.append(layout.encodable(line.text, out.encoding))
    tell()


def show(data: Table, out: Console | None = None) -> None:
    """Print a table of the laboratory's."""
    table(data.columns, data.texts(), data.title, data.labels, out=out)


def entries(title: str, rows: Sequence[tuple[str, str, str]], out: Console | None = None) -> None:
    """Print names and what they stand for, a line each: of a text that is too long, the beginning.

    Args:
        title: Above them.
        rows: Name, text, and what stands behind it and is never cut.
        out: Where to; standard output if left out.
    """
    out = out or output()
    room = width(out) - 4
    told = [tuple(_shown(x, out) for x in row) for row in rows]
    longest = max((n for name, *_ in told if (n := layout.width_of(name)) <= room // 2), default=0)
    paragraph(out, title, style="bold")
    for name, text, note in told:
        left = room - max(longest, layout.width_of(name)) - layout.width_of(note) - bool(note)
        shown = layout.shorten(text, left) if left >= _LEAST_TEXT else ""
        gap = " " * max(0, longest - layout.width_of(name))
        out.out(layout.encodable(f"  {name}{gap}  {f'{shown} {note}'.strip()}".rstrip(), out.encoding), highlight=False)


_LEAST_TEXT = 12  # characters; less of a text says nothing


def write_json(data: Any, target: str, field: str = "json", indent: int | None = 2) -> None:
    """Write data to a file; ``-`` is standard output.

    Args:
        data: Plain.
        target: As the user gave it.
        field: The option's name, for the error.
        indent: None for one line.

    Raises:
        InvalidValueError: the file cannot be written.
    """
    text = json.dumps(data, indent=indent, allow_nan=False)
    if target == "-":
        print(text)
    else:
        files.write(target, text + "\n", field)


def check_json(target: str | None, *read: str | None, field: str = "json") -> None:
    """Refuse before the work, not after it, what cannot be written, and to write over what is read.

    Raises:
        InvalidValueError: so it is.
    """
    if target is not None and target != "-":
        files.prepare(target, field, *read)


def check_workers(workers: int | None) -> None:
    """Refuse a number of processes that nobody has.

    Raises:
        InvalidValueError: so it is.
    """
    if workers is not None:
        _checks.whole("workers", workers, low=0, high=1024)
