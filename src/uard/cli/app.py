"""The command line, ``uard run`` and its like (``uard --help``): parses, runs a command, and says how it ended."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any, Union

from uard import __version__, _checks

if TYPE_CHECKING:
    from rich.console import Console

    from uard.cli.commands import Command

_OF_LAB = ("jax", "jaxlib", "optax", "scipy", "tyro", "rich", "matplotlib", "jinja2")


class _TerminatedError(KeyboardInterrupt):
    """SIGTERM, which ends a study as an interrupt does."""


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line.

    Exit code 2 for bad input, 1 for failed runs, a danger or a difference, 130 for an interrupt, 143 for SIGTERM.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments in (["--version"], ["-V"]):
        print(f"uard {__version__}")
        return
    try:
        _run(arguments)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in _OF_LAB:
            raise
        sys.exit(f"the laboratory is not installed: pip install 'uard[lab]' ({error})")


def _run(arguments: list[str]) -> None:
    from rich.console import Console

    from uard.cli import terminal

    console = Console(stderr=True, highlight=False)
    command = _parsed(arguments, console)
    try:
        with _terminable():
            command.run(console)
    except _of_users() as error:
        terminal.error(console, str(error))
        sys.exit(2)
    except KeyboardInterrupt as stop:
        what, code = ("terminated", 143) if isinstance(stop, _TerminatedError) else ("interrupted", 130)
        terminal.say(console, f"{what}; every finished cell is stored, the same command goes on from there")
        sys.exit(code)


def _parsed(arguments: list[str], console: Console) -> Command:
    """Return the command with its options; those of packages are imported only if none of ours is named."""
    import tyro

    from uard.cli import terminal
    from uard.cli.commands import brought, own

    commands = own()
    if not (arguments and arguments[0] in commands):
        theirs, broken = brought()
        for error in broken:
            terminal.warning(console, str(error))
        commands = commands | {plugin.name: command for plugin, command in theirs.items()}
    kinds = tuple(Annotated[kind, tyro.conf.subcommand(name)] for name, kind in commands.items())
    union: Any = Union[kinds]  # noqa: UP007 (of as many as there are)
    return tyro.cli(union, prog="uard", args=arguments, description="Rewards that cannot be fully trusted.")


def _of_users() -> tuple[type[Exception], ...]:
    """Return the errors that their message explains. A module that nobody has imported has raised none."""
    names = (("uard.lab.execution.store", "StoreError"), ("uard.lab.execution.cluster", "ClusterError"))
    return (_checks.InvalidValueError, *(getattr(sys.modules[m], name) for m, name in names if m in sys.modules))


@contextmanager
def _terminable() -> Iterator[None]:
    """Let SIGTERM end the block as an interrupt does, once; a second one would only disturb the ending."""

    def stop(number: int, _: object) -> None:
        signal.signal(number, signal.SIG_IGN)
        raise _TerminatedError

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
