"""Training from the command line: options, progress, logs, and what failed."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

from uard import InvalidValueError
from uard._support import files
from uard._support.text import counted
from uard.cli import progress
from uard.cli.terminal import MANY, error, say

if TYPE_CHECKING:
    from rich.console import Console

    from uard.lab.execution.runner import StudyFailedError
    from uard.lab.execution.store import Store
    from uard.lab.study import Study

DEFAULT_STORE = "results/uard.sqlite"


@dataclass(frozen=True)
class Watch:
    """What to leave for those who watch."""

    tensorboard: str | None = None
    """Write TensorBoard event files of every finished seed below this folder."""
    log: str | None = None
    """Append what happens to this file."""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """The least that is worth a line there."""


WatchOptions = Annotated[Watch, arg(name="")]
UNWATCHED = Watch()


def train(
    jobs: Sequence[Any],
    store: Store,
    console: Console,
    what: str,
    watch: Watch,
    *,
    workers: int | None = None,
    studies: Sequence[Study] = (),
    engine: Any = None,
    again: str = "",
) -> int:
    """Train what is not in the store yet, with a bar, and return how many seeds that were.

    Args:
        jobs: (cell, seed).
        store: Gets the results.
        console: Gets bar and messages.
        what: Is being done, beside the bar.
        watch: What to leave for those who watch.
        workers: Processes; one per core if left out.
        studies: What the cells belong to, which gives them names.
        engine: Who trains; processes of this machine if left out.
        again: What to say after failures: how to run only those.

    Raises:
        SystemExit: seeds failed, exit code 1; the others are stored, and it was said which failed and why.
    """
    from uard.lab.execution import runner
    from uard.lab.views.status import titles

    events = None
    if watch.tensorboard is not None:
        from uard.lab.views.tensorboard import Events

        events = Events(watch.tensorboard, titles(studies))
        events.catch_up(store, jobs)
    try:
        with _logging(watch, store.path), progress.bar(console, what) as move:
            trained = runner.run(jobs, store, workers, move, events.write if events else None, engine)
    except runner.StudyFailedError as failed:
        _tell(failed, titles(studies), console)
        if again:
            say(console, again)
        raise SystemExit(1) from None
    if events:
        events.catch_up(store, jobs)  # what other processes have trained
    return trained


def _tell(failed: StudyFailedError, names: dict[str, str], console: Console) -> None:
    """Say which cells failed, one line each."""
    error(console, str(failed))
    cells: dict[tuple[str, str], list[int]] = {}
    for failure in failed.failures:
        why = failure.error.strip().rpartition("\n")[2]
        for cell, seed in failure.jobs:
            cells.setdefault((names.get(cell.key) or str(cell), why), []).append(seed)
    for (name, why), seeds in list(cells.items())[:MANY]:
        say(console, f"failed: {name}, seeds {sorted(seeds)}: {why}")
    if len(cells) > MANY:
        say(console, f"and {counted(len(cells) - MANY, 'more cell')}")


@contextmanager
def _logging(watch: Watch, store: str) -> Iterator[None]:
    """Append to the file what the library logs, as long as the block runs."""
    import logging
    import time

    if watch.log is None:
        yield
        return
    files.prepare(watch.log, "log", store)
    try:
        handler = logging.FileHandler(watch.log, encoding="utf-8")
    except OSError as wrong:
        raise InvalidValueError("log", watch.log, f"a file that can be written ({wrong})") from None
    form = logging.Formatter(f"%(asctime)s.%(msecs)03dZ {os.getpid()} %(levelname)s %(message)s", "%Y-%m-%dT%H:%M:%S")
    form.converter = time.gmtime
    handler.setFormatter(form)
    logger = logging.getLogger("uard")
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(watch.log_level.upper())
    try:
        yield
    except BaseException as wrong:
        logger.error("ended by %s", type(wrong).__name__)
        raise
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)
        handler.close()
