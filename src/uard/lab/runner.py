"""Runs what is missing of some cells, on all cores, and stores every batch as soon as it is done."""

from __future__ import annotations

import multiprocessing as mp
import os
import pickle
import signal
import traceback
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import numpy as np

from uard.agents.tabular import QLearning
from uard.envs.spec import Tables
from uard.envs.tabular import MIN_STATES
from uard.feedback.learned import RatingModel
from uard.feedback.transitions import TransitionModel
from uard.lab.cell import Cell
from uard.lab.result import DivergedError, Result
from uard.lab.store import Store

BATCH = 64  # lanes trained by one call; about half a second of work
DEEP_BATCH = 5  # the same for deep agents; some ten seconds

Job = tuple[Cell, int]
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Failure:
    """Jobs that raised together, and the traceback."""

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
    if isinstance(cell.environment, Tables):
        where: Any = type(cell.environment).__name__, max(MIN_STATES, cell.environment.states)
    else:
        where = structure(plain(cell.environment))
    raters = 1 if cell.panel == "single" else 3
    program = (mitigation, agent, where, raters, cell.episodes, cell.ddof, cell.snapshots, str(cell.feedback))
    if cell.steps is not None:
        return (*program, cell.steps), cell.steps * 1000
    return program, (cell.environment.horizon or 0) * cell.episodes * (1 if _tabular(cell) else 1000)


def _tabular(cell: Cell) -> bool:
    return isinstance(cell.agent, QLearning)


def batches(jobs: Iterable[Job], size: int = BATCH) -> list[list[Job]]:
    """Group jobs that one program can train, longest first; ``DEEP_BATCH`` of deep agents at most, in MuJoCo one."""
    groups: dict[Any, list[Job]] = {}
    for job in jobs:
        groups.setdefault(shape_of(job[0]), []).append(job)
    cut = []
    for group in groups.values():
        first = group[0][0]
        most = size if _tabular(first) else 1 if first.steps is not None else min(size, DEEP_BATCH)
        cut += [group[i : i + most] for i in range(0, len(group), most)]
    return sorted(cut, key=lambda batch: -shape_of(batch[0][0])[1] * len(batch))


def train_batch(batch: Sequence[Job]) -> list[Result]:
    """Train a batch in this process.

    Raises:
        FloatingPointError: a run diverged.
    """
    return [finished() for finished in _train_lanes(batch)]


def _train_lanes(batch: Sequence[Job], folder: Path | None = None) -> list[Callable[[], Result]]:
    """Train a batch; what is returned finishes one job each, and raises if that one diverged.

    Long runs keep checkpoints in ``folder``, and go on from them.
    """
    if batch[0][0].steps is not None:
        return [partial(_train_host, cell, seed, folder) for cell, seed in batch]
    if not _tabular(batch[0][0]):
        return _train_deep(batch)
    from uard.lab.finish import finish
    from uard.training import fused

    tables: dict[Cell, Any] = {}
    lanes = []
    for cell, seed in batch:
        if cell not in tables:
            spec = cell.environment
            tables[cell] = spec.task(), spec.truth(), spec.speech(cell.panel, cell.noise)
        task, truth, ratings = tables[cell]
        lanes.append(fused.lane(task, ratings, truth, cell.agent, cell.mitigation, seed, cell.rated))
    first = batch[0][0]
    program = fused.Program(first.episodes, first.ddof, first.snapshots)
    fields = ("log", "steps", "q", "feedback")
    if first.snapshots:
        fields = (*fields, "q_snapshots", "feedback_snapshots")
    out = fused.train(lanes, program, fields)
    finishers = []
    for (cell, _), outcome in zip(batch, out, strict=True):
        task, truth, ratings = tables[cell]
        finishers.append(partial(finish, cell, task, truth, ratings.centre.shape[-1], outcome))
    return finishers


def checkpoint_of(folder: Path, cell: Cell, seed: int) -> Path:
    """Return where a run keeps its checkpoint."""
    return folder / f"{cell.key}-{seed}.checkpoint"


def _train_host(cell: Cell, seed: int, folder: Path | None) -> Result:
    from uard.lab.finish import finish_host
    from uard.training import host
    from uard.training.xla import keep_programs

    keep_programs()
    assert cell.steps is not None
    job = host.Job(
        cell.environment,
        cell.agent,
        cell.mitigation,
        seed,
        cell.steps,
        cell.panel,
        cell.noise,
        cell.rated,
        cell.feedback if isinstance(cell.feedback, TransitionModel) else TransitionModel(),
        cell.ddof,
    )
    path = None if folder is None else checkpoint_of(folder, cell, seed)
    return finish_host(host.run(job, path, f"{cell.key} {seed}"))


def _train_deep(batch: Sequence[Job]) -> list[Callable[[], Result]]:
    from uard.agents.off_policy import OffPolicy
    from uard.lab.finish import finish_deep
    from uard.training import deep, lanes, off_policy, on_policy
    from uard.training.xla import keep_programs

    keep_programs()
    first = batch[0][0]
    models = {cell: f if isinstance(f := cell.feedback, RatingModel) else None for cell, _ in batch}
    worlds = {cell: cell.environment.world(cell.panel, cell.noise) for cell, _ in batch}
    several = [
        deep.lane(worlds[cell], cell.agent, cell.mitigation, seed, cell.rated, models[cell]) for cell, seed in batch
    ]
    loop = off_policy.run if isinstance(first.agent, OffPolicy) else on_policy.run
    out = lanes.train(several, loop, deep.Program(first.episodes, ddof=first.ddof), deep.Outcome._fields, deep.ROOM)
    return [partial(finish_deep, cell, seed, outcome) for (cell, seed), outcome in zip(batch, out, strict=True)]


def run(
    jobs: Sequence[Job],
    store: Store,
    workers: int | None = None,
    progress: Progress | None = None,
    engine: Engine | None = None,
) -> int:
    """Train the jobs that are not in the store yet; return how many that were.

    Args:
        jobs: (cell, seed) pairs; doubles are trained once.
        store: Receives every finished batch at once, so an interrupt loses at most what is in flight.
        workers: Processes, one per core if left out; up to 1 trains in this one.
        progress: Called with (finished, to do) after every batch.
        engine: What trains the batches instead of processes on this machine, such as ``uard.lab.cluster.Ray``.

    Raises:
        StudyFailedError: some jobs raised; all others are stored.
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
    folder = None if store.path == ":memory:" else Path(f"{store.path}-checkpoints")
    if engine is not None:
        outcomes = engine(queue, folder, list)
    else:
        outcomes = _here(queue, folder) if workers <= 1 or len(queue) == 1 else _spread(queue, workers, folder)
    for batch, answer in outcomes:
        answers = [answer] * len(batch) if isinstance(answer, str) else [_kept(a, store) for a in answer]
        pairs = list(zip(batch, answers, strict=True))
        store.put([(cell, seed, result) for (cell, seed), result in pairs if isinstance(result, Result)])
        for (cell, seed), result in pairs:
            if folder is not None and cell.steps is not None and isinstance(result, Result):
                checkpoint_of(folder, cell, seed).unlink(missing_ok=True)
        for error in dict.fromkeys(a for a in answers if isinstance(a, str)):
            failures.append(Failure(tuple(job for job, a in pairs if a == error), error))
        done += len(batch)
        if progress:
            progress(done, len(todo))
    if failures:
        raise StudyFailedError(failures)
    return len(todo)


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
        with file.open("wb") as stream:
            np.savez(stream, **answer.good)  # type: ignore[arg-type]
    except OSError as error:
        return f"{answer}; its last good state could not be written to {file} ({error})"
    return f"{answer}; its last good state is in {file}"


# Per job its result, the divergence or a traceback; or one traceback for all of them.
Answer = list[Result | DivergedError | str] | str
Outcomes = Iterable[tuple[list[Job], Answer]]
Claim = Callable[[list[Job]], list[Job]]  # of a batch, what of it is to be trained: called when it is handed out
Engine = Callable[[list[list[Job]], Path | None, Claim], Outcomes]  # of batches (longest first), a folder, a claim


def _here(queue: Iterable[list[Job]], folder: Path | None) -> Outcomes:
    for batch in queue:
        yield batch, _attempt(lambda batch=batch: (batch, folder))


def _attempt(work: Callable[[], tuple[Sequence[Job], Path | None]]) -> Answer:
    answer = _guarded(lambda: _train_lanes(*work()))
    return answer if isinstance(answer, str) else [_guarded(finished) for finished in answer]


def _guarded(action: Callable[[], Any]) -> Any:
    try:
        return action()
    except DivergedError as error:
        return error
    except Exception:
        return traceback.format_exc()


def _work(pipe: Connection, core: int | None) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    if core is not None:
        os.sched_setaffinity(0, {core})
    try:
        while True:
            pipe.send(_attempt(partial(pickle.loads, pipe.recv_bytes())))
    except (EOFError, OSError):
        return  # the parent is done, or gone


def _spread(queue: list[list[Job]], workers: int, folder: Path | None) -> Outcomes:
    """Hand batches to processes, one per core; a process prefers programs that it has compiled already."""
    context = mp.get_context("spawn")
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    packed = [(batch, _packed((batch, folder))) for batch in queue]
    waiting = [(batch, data) for batch, data in packed if data is not None]
    processes: dict[Connection, tuple[Any, int | None]] = {}
    compiled: dict[Connection, set[Any]] = {}
    busy: dict[Connection, list[Job]] = {}

    def start(core: int | None) -> None:
        ours, theirs = context.Pipe()
        process = context.Process(target=_work, args=(theirs, core), daemon=True)
        _start_deaf(process)
        theirs.close()
        processes[ours], compiled[ours] = (process, core), set()
        give(ours)

    def give(pipe: Connection) -> None:
        if not waiting:
            return
        mine = compiled[pipe]
        others = set().union(*(programs for other, programs in compiled.items() if other is not pipe))

        def rank(i: int) -> int:
            program = shape_of(waiting[i][0][0][0])[0]
            return 0 if program in mine else 1 if program not in others else 2

        batch, data = waiting.pop(min(range(len(waiting)), key=rank))
        mine.add(shape_of(batch[0][0])[0])
        busy[pipe] = batch
        with suppress(OSError):  # a dead worker is noticed when its answer is read
            pipe.send_bytes(data)

    try:
        for i in range(min(workers, len(waiting))):
            start(cores[i % len(cores)] if cores else None)
        while busy:
            for pipe in wait(list(busy)):
                assert isinstance(pipe, Connection)
                batch = busy.pop(pipe)
                try:
                    answer = pipe.recv()
                except (EOFError, OSError):
                    process, core = processes.pop(pipe)
                    compiled.pop(pipe)
                    pipe.close()
                    process.join()
                    answer = f"the worker process died (exit code {process.exitcode}), out of memory perhaps"
                    if waiting:
                        start(core)
                else:
                    give(pipe)
                yield batch, answer
    finally:
        for pipe, (process, _) in processes.items():
            pipe.close()
            if busy:
                process.terminate()
        for process, _ in processes.values():
            process.join()
    yield from _here((batch for batch, data in packed if data is None), folder)


def _packed(work: tuple[list[Job], Path | None]) -> bytes | None:
    """Pickle a batch; one that cannot be (its class is local to a function, say) is trained in this process."""
    try:
        return pickle.dumps(work)
    except Exception:
        return None


def _start_deaf(process: Any) -> None:
    """Start a process that a keyboard interrupt does not reach, not even while it is starting."""
    if not hasattr(signal, "pthread_sigmask"):
        process.start()
        return
    resource_tracker.ensure_running()  # started later, it would undo the mask
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
