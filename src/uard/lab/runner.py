"""Runs what is missing of some cells, on all cores, and stores every batch as soon as it is done."""

from __future__ import annotations

import multiprocessing as mp
import os
import signal
import traceback
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any

from uard.lab.cell import Cell
from uard.lab.result import Result
from uard.lab.store import Store

BATCH = 64  # lanes trained by one call; about half a second of work

Job = tuple[Cell, int]
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Failure:
    """A batch that raised: its jobs and the traceback."""

    jobs: tuple[Job, ...]
    error: str


class StudyFailedError(RuntimeError):
    """Some cells could not be trained; all others are in the store."""

    def __init__(self, failures: Sequence[Failure]):
        """Name the first failed cell and its error."""
        first = failures[0]
        lost = sum(len(f.jobs) for f in failures)
        super().__init__(f"{lost} seeds failed, the rest is stored; first: {first.jobs[0][0]}\n{first.error}")
        self.failures = tuple(failures)


def shape_of(cell: Cell) -> tuple[Any, ...]:
    """Cells with equal shapes are likely to share a compiled program and to take equally long."""
    from uard.lab.cell import plain

    def structure(value: Any) -> Any:
        if isinstance(value, dict):
            return tuple((k, structure(v)) for k, v in value.items())
        return "number" if isinstance(value, float) else str(value)

    agent, mitigation = structure(plain(cell.agent)), structure(plain(cell.mitigation))
    room = max(100, cell.environment.states)
    raters = 1 if cell.panel == "single" else 3
    program = (mitigation, agent, room, raters, cell.episodes, cell.ddof, cell.snapshots)
    return program, (cell.environment.horizon or 0) * cell.episodes


def batches(jobs: Iterable[Job], size: int = BATCH) -> list[list[Job]]:
    """Group jobs that one program can train, the longest first."""
    groups: dict[Any, list[Job]] = {}
    for job in jobs:
        groups.setdefault(shape_of(job[0]), []).append(job)
    cut = [group[i : i + size] for group in groups.values() for i in range(0, len(group), size)]
    return sorted(cut, key=lambda batch: -shape_of(batch[0][0])[1] * len(batch))


def train_batch(batch: Sequence[Job]) -> list[Result]:
    """Train a batch in this process."""
    from uard.envs import panels
    from uard.lab.result import finish
    from uard.training import fused

    tables: dict[Cell, Any] = {}
    lanes = []
    for cell, seed in batch:
        if cell not in tables:
            task, truth = cell.environment.task(), cell.environment.truth()
            tables[cell] = task, truth, panels.ratings(cell.panel, task, truth, cell.noise)
        task, truth, ratings = tables[cell]
        lanes.append(fused.lane(task, ratings, truth, cell.agent, cell.mitigation, seed, cell.rated))
    first = batch[0][0]
    program = fused.Program(first.episodes, first.ddof, first.snapshots)
    fields = ("log", "steps", "q", "feedback")
    if first.snapshots:
        fields = (*fields, "q_snapshots", "feedback_snapshots")
    out = fused.train(lanes, program, fields)
    results = []
    for (cell, _), outcome in zip(batch, out, strict=True):
        task, truth, ratings = tables[cell]
        results.append(finish(cell, task, truth, ratings.centre.shape[-1], outcome))
    return results


def run(jobs: Sequence[Job], store: Store, workers: int | None = None, progress: Progress | None = None) -> int:
    """Train the jobs that are not in the store yet; return how many that were.

    Args:
        jobs: (cell, seed) pairs; doubles are trained once.
        store: Receives every finished batch at once, so an interrupt loses at most what is in flight.
        workers: Processes, one per core if left out; up to 1 trains in this one.
        progress: Called with (finished, to do) after every batch.

    Raises:
        StudyFailedError: some batches raised; all others are stored.
    """
    wanted: dict[Cell, list[int]] = {}
    for cell, seed in jobs:
        wanted.setdefault(cell, []).append(seed)
    todo = [(cell, seed) for cell, seeds in wanted.items() for seed in store.missing(cell, dict.fromkeys(seeds))]
    if not todo:
        return 0
    queue = batches(todo)
    if workers is None:
        workers = min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, 64)
    done, failures = 0, []
    if progress:
        progress(0, len(todo))
    outcomes = _here(queue) if workers <= 1 or len(queue) == 1 else _spread(queue, workers)
    for batch, answer in outcomes:
        if isinstance(answer, str):
            failures.append(Failure(tuple(batch), answer))
        else:
            store.put([(cell, seed, result) for (cell, seed), result in zip(batch, answer, strict=True)])
        done += len(batch)
        if progress:
            progress(done, len(todo))
    if failures:
        raise StudyFailedError(failures)
    return len(todo)


Outcomes = Iterable[tuple[list[Job], list[Result] | str]]


def _here(queue: list[list[Job]]) -> Outcomes:
    for batch in queue:
        yield batch, _attempt(batch)


def _attempt(batch: list[Job]) -> list[Result] | str:
    try:
        return train_batch(batch)
    except Exception:
        return traceback.format_exc()


def _work(pipe: Connection, core: int | None) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    if core is not None:
        os.sched_setaffinity(0, {core})
    try:
        while True:
            pipe.send(_attempt(pipe.recv()))
    except (EOFError, BrokenPipeError):
        return  # the parent is done, or gone


def _spread(queue: list[list[Job]], workers: int) -> Outcomes:
    """Hand batches to processes, one per core; a process prefers programs that it has compiled already."""
    context = mp.get_context("spawn")
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    pipes: dict[Connection, Any] = {}
    compiled: dict[Connection, set[Any]] = {}
    busy: dict[Connection, list[Job]] = {}
    queue = list(queue)

    def give(pipe: Connection) -> None:
        if not queue:
            return
        mine = compiled[pipe]
        others = set().union(*(programs for other, programs in compiled.items() if other is not pipe))

        def rank(i: int) -> int:
            program = shape_of(queue[i][0][0])[0]
            return 0 if program in mine else 1 if program not in others else 2

        batch = queue.pop(min(range(len(queue)), key=rank))
        mine.add(shape_of(batch[0][0])[0])
        busy[pipe] = batch
        pipe.send(batch)

    try:
        for i in range(min(workers, len(queue))):
            ours, theirs = context.Pipe()
            core = cores[i % len(cores)] if cores else None
            process = context.Process(target=_work, args=(theirs, core), daemon=True)
            process.start()
            theirs.close()
            pipes[ours], compiled[ours] = process, set()
            give(ours)
        while busy:
            for pipe in wait(list(busy)):
                assert isinstance(pipe, Connection)
                batch = busy.pop(pipe)
                try:
                    answer = pipe.recv()
                except EOFError:
                    code = pipes[pipe].exitcode
                    answer = f"the worker process died (exit code {code}), out of memory perhaps"
                    compiled.pop(pipe)
                else:
                    give(pipe)
                yield batch, answer
    finally:
        for pipe, process in pipes.items():
            pipe.close()
            if busy:
                process.terminate()
        for process in pipes.values():
            process.join()
