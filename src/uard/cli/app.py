"""The command line, ``uard run`` and its like (``uard --help``): parses, runs a command, and says how it ended."""

from __future__ import annotations

import errno
import signal
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Annotated, Any, Union

from uard import __version__
from uard._support import signals

if TYPE_CHECKING:
    from rich.console import Console

    from uard.cli.commands import Command

_OF_LAB = ("jax", "jaxlib", "optax", "scipy", "tyro", "rich", "matplotlib", "jinja2")


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line.

    Exit code 2 for bad input, 1 for failed runs, a danger, a difference or a closed output, 130 for SIGINT, 143 for
    SIGTERM.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    signals.open_output()
    if arguments in (["--version"], ["-V"]):
        print(f"uard {__version__}")
        return
    try:
        with signals.ending():
            _run(arguments)
            sys.stdout.flush()
    except BaseException as error:
        if signals.received() is None and not isinstance(error, KeyboardInterrupt):
            _end(error)
            raise
        _stop()
    if signals.received() is not None:  # and its exception was swallowed
        _stop()


def _end(error: BaseException) -> None:
    """End the program in some words if they explain the error."""
    if isinstance(error, BrokenPipeError):
        signals.quiet_output()
        sys.exit(1)
    if isinstance(error, OSError) and error.errno == errno.ENOSPC:
        signals.quiet_output()
        sys.exit(f"error: the output cannot be written ({error.strerror})")
    if isinstance(error, ModuleNotFoundError) and "pip install 'uard[" in str(error):  # which says what to do already
        sys.exit(f"error: {error}")
    if isinstance(error, ModuleNotFoundError) and (error.name or "").partition(".")[0] in _OF_LAB:
        sys.exit(f"the laboratory is not installed: pip install 'uard[lab]' ({error})")


def _stop() -> None:
    """Say that a signal has ended the program, whatever it has disturbed on its way, and end with its exit code."""
    number = signals.received() or signal.SIGINT
    stored = "; every finished cell is stored, the same command goes on from there"
    with suppress(OSError):  # of a terminal that is gone
        print(signals.WORDS[number] + stored * ("uard.lab.execution.store" in sys.modules), file=sys.stderr, flush=True)
    if signals.received() is None:
        sys.exit(128 + number)
    signals.end()


def _run(arguments: list[str]) -> None:
    from rich.console import Console

    from uard.cli import terminal

    terminal.shows_what_it_can()
    terminal.is_wide_enough()
    console = Console(stderr=True, highlight=False)
    command = _parsed(arguments, console)
    try:
        command.run(console)
    except _of_users() as error:
        terminal.error(console, str(error))
        sys.exit(2)
    except SystemExit as end:
        if end.code in (None, 0) and type(command).__module__.startswith("uard."):  # which none of ours does
            where = traceback.extract_tb(end.__traceback__)[-1]
            why = f"{where.filename}, line {where.lineno}, tried to end the program as if all were done"
            terminal.error(console, f"{why}: a package must not call sys.exit")
            sys.exit(1)
        raise


def _parsed(arguments: list[str], console: Console) -> Command:
    """Return the command with its options; those of packages are imported only if none of ours is named."""
    import tyro

    from uard.cli import help as helping
    from uard.cli import settings, terminal
    from uard.cli.commands import brought, own

    commands = own()
    if not (arguments and arguments[0] in commands):
        theirs, broken = brought()
        for error in broken:
            terminal.warning(console, str(error))
        commands = commands | {plugin.name: command for plugin, command in theirs.items()}
    kinds = tuple(Annotated[kind, tyro.conf.subcommand(name)] for name, kind in commands.items())
    union: Any = Union[kinds]  # noqa: UP007 (of as many as there are)
    text = "Rewards that cannot be fully trusted."
    if not helping.asked(arguments):
        return tyro.cli(union, prog="uard", args=arguments, description=text, registry=settings.numbers())
    for kind in commands.values():
        helping.explain(kind)
    with helping.broken():
        return tyro.cli(union, prog="uard", args=arguments, description=text, registry=settings.numbers())


def _of_users() -> tuple[type[Exception], ...]:
    """Return the errors that their message explains. A module that nobody has imported has raised none."""
    from uard import _checks

    names = (
        ("uard.lab.execution.store", "StoreError"),
        ("uard.lab.execution.cluster", "ClusterError"),
        ("uard.collect.store", "StoreError"),
    )
    return (_checks.InvalidValueError, *(getattr(sys.modules[m], name) for m, name in names if m in sys.modules))
