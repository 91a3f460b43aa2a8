"""Who trains batches: this process, or several, one per core."""

from __future__ import annotations

import multiprocessing as mp
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Hashable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from uard.lab.execution.batching import Job, cost_of, shape_of
from uard.lab.execution.training import Answer, attempt, attempt_packed, packed

Claim = Callable[[list[Job]], list[Job]]  # returns what of a batch is to be trained here and now
Outcomes = Generator[tuple[list[Job], Answer]]
Engine = Callable[[list[list[Job]], Path | None, Claim], Outcomes]  # of batches (longest first), a folder, a claim


def in_this_process(queue: Iterable[list[Job]], folder: Path | None, claim: Claim) -> Outcomes:
    """Train batches one after the other."""
    for batch in queue:
        if mine := claim(batch):
            yield mine, attempt(mine, folder)


def in_processes(workers: int, queue: list[list[Job]], folder: Path | None, claim: Claim) -> Outcomes:
    """Train batches in several processes, each on a core of its own; what cannot be pickled is trained here at last.

    Args:
        workers: Most processes.
        queue: Batches, the longest first.
        folder: Of checkpoints.
        claim: Asked before a batch is handed out.
    """
    waiting = _Waiting(queue, folder, claim)
    pool = _Pool(waiting)
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    complete = False
    try:
        for i in range(min(workers, len(queue))):
            pool.start(cores[i % len(cores)] if cores else None)
        yield from pool.outcomes()
        complete = True
    finally:
        pool.close(kill=not complete)
    for batch in waiting.unpicklable:
        yield batch, attempt(batch, folder)


class _Waiting:
    """Batches that nobody trains yet, by program, longest first."""

    def __init__(self, queue: list[list[Job]], folder: Path | None, claim: Claim):
        self.unpicklable: list[list[Job]] = []
        self._folder, self._claim = folder, claim
        self._batches: dict[Hashable, deque[list[Job]]] = {}
        for batch in queue:
            self._batches.setdefault(shape_of(batch[0][0])[0], deque()).append(batch)

    def next(self, own: set[Hashable], of_others: set[Hashable]) -> tuple[list[Job], bytes] | None:
        """Return a batch, claimed and pickled; None if none is left.

        Args:
            own: Programs that the worker has compiled, whose batches come first; what it gets now is added.
            of_others: Programs that others have compiled, whose batches come last.
        """

        def rank(program: Hashable) -> tuple[int, float]:
            known = 0 if program in own else 1 if program not in of_others else 2
            return known, -cost_of(self._batches[program][0])

        while self._batches:
            program = min(self._batches, key=rank)
            batch = self._claim(self._batches[program].popleft())
            if not self._batches[program]:
                del self._batches[program]
            if not batch:
                continue
            if (data := packed(batch, self._folder)) is not None:
                own.add(program)
                return batch, data
            self.unpicklable.append(batch)
        return None


@dataclass(eq=False)
class _Worker:
    """A process, its end of the pipe, what it has compiled, and what it trains (nothing if it is idle)."""

    process: Any
    core: int | None
    pipe: Connection
    compiled: set[Hashable] = field(default_factory=set)
    batch: list[Job] | None = None


class _Pool:
    """The processes that are at work."""

    def __init__(self, waiting: _Waiting):
        self._waiting, self._context = waiting, mp.get_context("spawn")
        self._workers: list[_Worker] = []

    def start(self, core: int | None) -> None:
        """Start a process on a core and give it a batch, if one is left."""
        compiled: set[Hashable] = set()
        work = self._next(compiled)
        if work is None:
            return
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=_work, args=(theirs, core), daemon=True)
        worker = _Worker(process, core, ours, compiled)
        self._workers.append(worker)  # before an interrupt can come between
        _start_with_signals_blocked(process)
        theirs.close()
        _give(worker, work)

    def outcomes(self) -> Outcomes:
        """Yield batches and their answers until all are trained; a process that dies is replaced."""
        while busy := {worker.pipe: worker for worker in self._workers if worker.batch is not None}:
            for pipe in wait(list(busy)):
                assert isinstance(pipe, Connection)
                worker = busy[pipe]
                batch, worker.batch = worker.batch, None
                assert batch is not None
                try:
                    answer = pipe.recv()
                except (EOFError, OSError):
                    answer = self._replace(worker)
                else:
                    _give(worker, self._next(worker.compiled))
                yield batch, answer

    def close(self, kill: bool) -> None:
        """End all processes, at once if they are to be killed, else when they have nothing to do."""
        begun = [worker.process for worker in self._workers if worker.process.pid is not None]
        for process in begun:
            if kill:
                process.kill()
        for worker in self._workers:
            worker.pipe.close()
        for process in begun:
            process.join()

    def _next(self, compiled: set[Hashable]) -> tuple[list[Job], bytes] | None:
        others = (worker.compiled for worker in self._workers if worker.compiled is not compiled)
        return self._waiting.next(compiled, set().union(*others))

    def _replace(self, worker: _Worker) -> str:
        """Start another process instead of one that has died; return what is to be said of its batch."""
        self._workers.remove(worker)
        worker.pipe.close()
        worker.process.join()
        self.start(worker.core)
        return f"the worker process died (exit code {worker.process.exitcode}), out of memory perhaps"


def _give(worker: _Worker, work: tuple[list[Job], bytes] | None) -> None:
    if work:
        worker.batch = work[0]
        with suppress(OSError):  # that a worker has died is noticed when its answer is read
            worker.pipe.send_bytes(work[1])


_SIGNALS = {signal.SIGINT, signal.SIGTERM}


def _work(pipe: Connection, core: int | None) -> None:
    """Train what comes through the pipe, on one core."""
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)  # the parent decides
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if core is not None:
        os.sched_setaffinity(0, {core})
    try:
        while True:
            pipe.send(attempt_packed(pipe.recv_bytes()))
    except (EOFError, OSError):
        return  # the parent is done, or gone


def _end_with_parent() -> None:
    """End at once when the parent is gone, killed perhaps: somebody else may train the batch again."""
    parent = mp.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)


def _start_with_signals_blocked(process: Any) -> None:
    """Start a process that a keyboard interrupt or SIGTERM does not reach, not even while it is starting."""
    if not hasattr(signal, "pthread_sigmask"):
        process.start()
        return
    resource_tracker.ensure_running()  # started later, it would undo the mask
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
