"""Bars and spinners on standard error."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from uard.cli.terminal import escape

if TYPE_CHECKING:
    from rich.console import Console


@contextmanager
def bar(console: Console, what: str) -> Iterator[Callable[[int, int, float | None], None]]:
    """Show a bar while the block runs.

    Yields:
        A function that moves it: how many are done, of how many, and seconds still to go if anybody knows.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from uard.lab.views.status import duration

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}"),
    )
    with Progress(*columns, console=console) as shown:
        task = shown.add_task(escape(what), total=None, left="", visible=False)  # perhaps there is nothing to do

        def move(done: int, total: int, seconds: float | None) -> None:
            left = "" if seconds is None else f"about {duration(seconds)} left" if done < total else "done"
            shown.update(task, completed=done, total=total, left=left, visible=True)

        yield move


@contextmanager
def spinner(console: Console, what: str) -> Iterator[None]:
    """Show that something of unknown length is going on while the block runs."""
    with console.status(escape(what)):
        yield
