"""Runs what is missing of some cells, on all cores, and stores every batch as soon as it is done.

A batch is claimed in the store before it is trained, so that several processes share the work on one store, and what a
killed one was training is trained by the next.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from uard._support import files, signals
from uard._support.text import counted
from uard.lab.cell import Cell
from uard.lab.config import check_names
from uard.lab.execution.batching import Job, batches, shape_of
from uard.lab.execution.claims import HEARTBEAT, Owner
from uard.lab.execution.forecast import Forecast
from uard.lab.execution.store import FailedSeed, Store, StoreError, record_heartbeat
from uard.lab.execution.training import Answer
from uard.lab.execution.workers import Claim, Engine, Outcomes, in_processes, in_this_process
from uard.lab.result import DivergedError, Result
from uard.lab.trainers.simulated import forget_checkpoint

log = logging.getLogger(__name__)

Progress = Callable[[int, int, float | None], None]
OnStored = Callable[[Sequence[tuple[Cell, int, Result]]], None]
POLL = 0.5  # seconds between two questions to the store for what other processes have done
MOST_WORKERS = 64


@dataclass(frozen=True)
class Failure:
    """Jobs that raised together, and the traceback.

    Examples:
        >>> failed = StudyFailedError([Failure(((Cell(), 0), (Cell(), 1)), "ValueError: no")])
        >>> [([seed for cell, seed in failure.jobs], failure.error) for failure in failed.failures]
        [([0, 1], 'ValueError: no')]
    """

    jobs: tuple[Job, ...]
    error: str


class StudyFailedError(RuntimeError):
    """Some cells could not be trained; all others are in the store."""

    def __init__(self, failures: Sequence[Failure]):
        """Name the first failed cell and its error."""
        first = failures[0]
        lost = sum(len(f.jobs) for f in failures)
        super().__init__(
            f"{counted(lost, 'seed')} failed, the rest is stored; first: {first.jobs[0][0]}\n{first.error}"
        )
        self.failures = tuple(failures)


def run(
    jobs: Sequence[Job],
    store: Store,
    workers: int | None = None,
    progress: Progress | None = None,
    stored: OnStored | None = None,
    engine: Engine | None = None,
) -> int:
    """Train the jobs that are not in the store yet; return how many of them this process has trained.

    What another process is training on the same store is waited for, and taken over if that one dies.

    Examples:
        >>> from uard.envs.grids.trapgrid import TrapGrid
        >>> cell, store = Cell(TrapGrid(size=3), episodes=20), Store(":memory:")
        >>> run([(cell, 0), (cell, 1)], store, workers=1)
        2
        >>> run([(cell, 0), (cell, 1)], store), store.get(cell, [0])[0].log.shape
        (0, (20, 6))

    Args:
        jobs: (cell, seed) pairs; doubles are trained once.
        store: Receives every finished batch at once, so an interrupt loses at most what is being trained.
        workers: Processes, one per core but 64 at most if left out; up to 1 trains in this one.
        progress: Called with (finished, to do, seconds that remain or None) after every batch.
        stored: Called with every batch's results once they are safe.
        engine: What trains the batches instead of processes on this machine: ``uard.lab.execution.cluster.Ray``, say.

    Raises:
        InvalidValueError: a cell has a class that is local to a function, and the store is a file.
        StudyFailedError: some jobs raised; all others are stored, and the store says why. Each is tried once.
        StoreError: the store cannot be written; what was finished before is safe.
    """
    missing = _missing(jobs, store)
    if not missing:
        return 0
    workers = _cores() if workers is None else workers
    log.info("%d of %d seeds are missing in %s; %d workers", len(missing), len(jobs), store.path, workers)
    with _registered(store, len(missing)) as owner:
        work = _Work(missing, store, owner, workers, progress, stored)
        work.report()
        todo = missing
        while todo:
            with closing(_train(batches(todo), workers, work.folder, work.claim, engine)) as outcomes:
                for batch, answer in outcomes:
                    signals.check()  # what it has disturbed must not be recorded as a failure
                    work.record(batch, answer)
            todo = work.wait_for_others()
    if work.failures:
        raise StudyFailedError(work.failures)
    return work.trained


def _missing(jobs: Sequence[Job], store: Store) -> list[Job]:
    wanted: dict[Cell, list[int]] = {}
    for cell, seed in jobs:
        wanted.setdefault(cell, []).append(seed)
    if store.path != ":memory:":
        for cell in wanted:
            check_names(cell.config())
    return [(cell, seed) for cell, seeds in wanted.items() for seed in store.missing(cell, dict.fromkeys(seeds))]


def _cores() -> int:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, MOST_WORKERS)


def _train(queue: list[list[Job]], workers: int, folder: Path | None, claim: Claim, engine: Engine | None) -> Outcomes:
    if engine is None:
        alone = workers <= 1 or len(queue) == 1
        engine = in_this_process if alone else partial(in_processes, workers)
    return engine(queue, folder, claim)


class _Work:
    """What a run has done so far: claims before, results and failures after, and who is told of them."""

    def __init__(
        self,
        missing: list[Job],
        store: Store,
        owner: Owner,
        workers: int,
        progress: Progress | None,
        stored: OnStored | None,
    ):
        self.failures: list[Failure] = []
        self.trained = 0
        self.folder = None if store.path == ":memory:" else Path(f"{store.path}-checkpoints")
        self._store, self._owner, self._progress, self._stored = store, owner, progress, stored
        self._total, self._done = len(missing), 0
        self._failed_before = store.failures()
        self._forecast = Forecast(batches(missing), workers, shape_of)
        self._held_by_others: list[Job] = []

    def claim(self, batch: list[Job]) -> list[Job]:
        """Return what of a batch nobody else trains; it is being trained from now on."""
        mine = self._store.claim(batch, self._owner)
        taken = set(mine)
        others = [job for job in batch if job not in taken]
        self._held_by_others += others
        self._forecast.drop(others)
        if mine:
            self._forecast.begin(mine, time.monotonic())
        return mine

    def record(self, batch: list[Job], answer: Answer) -> None:
        """Store what came of a batch, results and failures."""
        self._forecast.end(batch, time.monotonic())
        answers = [answer] * len(batch) if isinstance(answer, str) else [_kept(a, self._store) for a in answer]
        pairs = list(zip(batch, answers, strict=True))
        finished = [(cell, seed, result) for (cell, seed), result in pairs if isinstance(result, Result)]
        self._store.put(finished)
        for cell, seed, _ in finished:
            if self.folder is not None and cell.steps is not None:
                forget_checkpoint(self.folder, cell, seed)
        for error in dict.fromkeys(a for a in answers if isinstance(a, str)):
            lost = [job for job, a in pairs if a == error]
            self._store.fail(lost, error, self._owner)
            self._fail(lost, error)
        if self._stored and finished:
            self._stored(finished)
        self._done += len(batch)
        self.trained += len(finished)
        log.info("%d of %d seeds done", self._done, self._total)
        self.report()

    def wait_for_others(self) -> list[Job]:
        """Wait for what other processes train; return what they have given up, to be trained here."""
        waiting, self._held_by_others = self._held_by_others, []
        if waiting:
            log.info("waiting for %d seeds that other processes train", len(waiting))
        while waiting:
            signals.check()
            held, free, failed = _sort_out(waiting, self._store, self._failed_before)
            for error in dict.fromkeys(failed.values()):
                self._fail([job for job, e in failed.items() if e == error], error)
            if len(held) + len(free) < len(waiting):
                self._done = self._total - len(held) - len(free)
                self.report()
            waiting = [*free, *held]
            if free:
                log.warning("taking over %d seeds that nobody trains any more", len(free))
                break
            if waiting:
                time.sleep(POLL)
        return waiting

    def report(self) -> None:
        """Say how far the run is: to the store, and to who asked for it."""
        left = self._forecast.remaining(time.monotonic()) if self._done < self._total else 0.0
        self._store.report(self._owner, self._done, sum(len(f.jobs) for f in self.failures), left)
        if self._progress:
            self._progress(self._done, self._total, left)

    def _fail(self, lost: Sequence[Job], error: str) -> None:
        self.failures.append(Failure(tuple(lost), error))
        log.error("%d seeds failed, first %s:\n%s", len(lost), lost[0], error)


class _Elsewhere(NamedTuple):
    """What became of jobs that others had claimed; finished ones are in none of these.

    Attributes:
        held: A living process trains them.
        free: Nobody does.
        failed: They have failed, and why.
    """

    held: list[Job]
    free: list[Job]
    failed: dict[Job, str]


def _sort_out(jobs: list[Job], store: Store, known: dict[tuple[str, int], FailedSeed]) -> _Elsewhere:
    """Return what became of jobs; ``known`` are failures of earlier runs, which do not count."""
    finished, failures, claimed = store.places(), store.failures(), store.claimed()
    held, free, failed = [], [], {}
    for cell, seed in jobs:
        place = cell.key, seed
        if place in finished:
            continue
        if place in failures and failures[place] != known.get(place):
            failed[cell, seed] = failures[place].traceback
        else:
            (held if place in claimed else free).append((cell, seed))
    return _Elsewhere(held, free, failed)


@contextmanager
def _registered(store: Store, total: int) -> Iterator[Owner]:
    """Stand in the store as at work while the block runs; give back afterwards what was claimed and not finished."""
    owner, stop = Owner.here(), threading.Event()
    heartbeat = threading.Thread(target=_heartbeat, args=(store.path, owner, stop), daemon=True)
    try:
        store.begin(owner, total)
        if store.path != ":memory:":
            heartbeat.start()
        yield owner
    finally:
        stop.set()
        owner.stop()
        with suppress(StoreError):  # its claims are then those of a process that has ended
            store.end(owner)


def _heartbeat(path: str, owner: Owner, stop: threading.Event) -> None:
    while not stop.wait(HEARTBEAT):
        try:
            record_heartbeat(path, owner)
        except StoreError as error:
            log.warning("the heartbeat could not be recorded: %s", error)


def _kept(answer: Result | DivergedError | str, store: Store) -> Result | str:
    """Write down the last good state of a run that diverged; what is returned says where it is."""
    if not isinstance(answer, DivergedError):
        return answer
    if not answer.good:
        return str(answer)
    folder = Path("uard-diverged" if store.path == ":memory:" else f"{store.path}-diverged")
    file = folder / f"{answer.name}.npz"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with files.replacing(file) as stream:
            np.savez(stream, **answer.good)  # type: ignore[arg-type]
    except OSError as error:
        return f"{answer}; its last good state could not be written to {file} ({error})"
    return f"{answer}; its last good state is in {file}"
