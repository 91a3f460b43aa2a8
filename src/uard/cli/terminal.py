"""What reaches a terminal: lines, tables, JSON. Text of others is printed as it is, never obeyed."""

from __future__ import annotations

import json
from collections.abc import Container, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from uard import _checks
from uard._support import files
from uard._support.text import printable

if TYPE_CHECKING:
    from rich.console import Console

    from uard.lab.views.tables import Table

MANY = 20  # lines of one kind, after which the rest is counted
_PLAIN = 500  # rows from which on a table has plain columns: rich needs a second for a thousand rows


def output() -> Console:
    """Return standard output."""
    from rich.console import Console

    return Console(highlight=False)


def say(console: Console, text: str, kind: str = "") -> None:
    """Print a line whole, for a path that is broken in two can be neither copied nor found.

    Args:
        console: Where to.
        text: Is printed as it is.
        kind: What stands before it, in rich's markup.
    """
    console.print(kind + escape(text), soft_wrap=True)


def error(console: Console, text: str) -> None:
    """Say what is wrong."""
    say(console, text, "[red]error:[/red] ")


def warning(console: Console, text: str) -> None:
    """Say what is doubtful."""
    say(console, text, "[yellow]warning:[/yellow] ")


def escape(text: str) -> str:
    """Return text that rich prints as it is: markup is shown, and the rest is ``printable``."""
    from rich.markup import escape as escaped

    return escaped(printable(text))


def table(
    columns: Sequence[str],
    rows: Iterable[Sequence[str]],
    title: str = "",
    labels: int = 1,
    marked: Container[int] = (),
    out: Console | None = None,
) -> None:
    """Print a table.

    Args:
        columns: Their heads.
        rows: As many texts each as there are columns.
        title: Above it.
        labels: So many columns name the row and begin at the left; the others end at the right.
        marked: Numbers of rows that are red.
        out: Where to; standard output if left out.
    """
    out, rows = out or output(), list(rows)
    if len(rows) > _PLAIN:
        out.out(_plain(columns, rows, title, labels), highlight=False)
        return
    from rich.table import Table as RichTable

    made = RichTable(title=escape(title), title_justify="left")
    for i, column in enumerate(columns):
        made.add_column(escape(column), justify="left" if i < labels else "right")
    for i, row in enumerate(rows):
        made.add_row(*map(escape, row), style="red" if i in marked else None)
    out.print(made)


def _plain(columns: Sequence[str], rows: Sequence[Sequence[str]], title: str, labels: int) -> str:
    title, *cells = map(printable, (title, *columns, *(x for row in rows for x in row)))
    columns, *rows = (cells[i : i + len(columns)] for i in range(0, len(cells), len(columns)))
    widths = [max(map(len, column)) for column in zip(columns, *rows, strict=True)]
    lines = (
        "  ".join(x.ljust(w) if i < labels else x.rjust(w) for i, (x, w) in enumerate(zip(r, widths, strict=True)))
        for r in (columns, *rows)
    )
    return "\n".join([title, *(line.rstrip() for line in lines)])


def show(data: Table, out: Console | None = None) -> None:
    """Print a table of the laboratory's."""
    table(data.columns, data.texts(), data.title, data.labels, out=out)


def glossary(title: str, entries: Mapping[str, str]) -> None:
    """Print names and what they stand for."""
    from rich.table import Table as RichTable

    made = RichTable("name", "", title=escape(title), title_justify="left", show_header=False, box=None, padding=(0, 2))
    for name, text in entries.items():
        made.add_row(f"[bold]{escape(name)}[/bold]", escape(text))
    out = output()
    out.print(made)
    out.print()


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
