"""Runs what is missing of some cells, on all cores, and stores every batch as soon as it is done.

A batch is claimed in the store before it is trained, so that several processes share the work on one store, and what a
killed one had in flight is trained by the next.
"""

from __future__ import annotations

import logging
import multiprocessing as mp
import os
import pickle
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import numpy as np

from uard.agents.tabular import QLearning
from uard.envs.base import TableEnvironment
from uard.envs.tables import MIN_STATES
from uard.lab.cell import Cell, plain
from uard.lab.execution.claims import BEAT, Owner
from uard.lab.execution.forecast import Forecast
from uard.lab.execution.store import FailedSeed, Store, StoreError, give_sign
from uard.lab.result import DivergedError, Result
from uard.training.feedback.rating_model import RatingModel
from uard.training.feedback.transition_model import TransitionModel

log = logging.getLogger(__name__)

BATCH = 64  # lanes trained by one call; about half a second of work
DEEP_BATCH = 5  # the same for deep agents; some ten seconds

Job = tuple[Cell, int]
Progress = Callable[[int, int, float | None], None]
OnStored = Callable[[Sequence[tuple[Cell, int, Result]]], None]
Claim = Callable[[list[Job]], list[Job]]
POLL = 0.5  # seconds between two looks at what other processes have done


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


@lru_cache(maxsize=50_000)
def shape_of(cell: Cell) -> tuple[Any, int]:
    """Return program and cost: equal programs are likely to share a compiled one, and cost is how long a seed takes."""

    def structure(value: Any) -> Any:
        if isinstance(value, dict):
            return tuple((k, structure(v)) for k, v in value.items())
        return "number" if isinstance(value, float) else str(value)

    agent, mitigation = structure(plain(cell.agent)), structure(plain(cell.mitigation))
    if isinstance(cell.environment, TableEnvironment):
        where: Any = type(cell.environment).__name__, max(MIN_STATES, cell.environment.states)
    else:
        where = structure(plain(cell.environment))
    raters = len(cell.panel.raters), all(rater.plain for rater in cell.panel.raters)
    program = (mitigation, agent, where, raters, cell.episodes, cell.ddof, cell.snapshots, str(cell.rating_model))
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
    from uard.lab.execution.finish import finish
    from uard.training.compiled import tabular as fused

    tables: dict[Cell, Any] = {}
    lanes = []
    for cell, seed in batch:
        if cell not in tables:
            spec = cell.environment
            tables[cell] = spec.task(), spec.truth(), spec.rating_law(cell.panel, cell.noise)
        task, truth, ratings = tables[cell]
        lanes.append(fused.make_run(task, ratings, truth, cell.agent, cell.mitigation, seed, cell.rated))
    first = batch[0][0]
    program = fused.Program(first.episodes, first.ddof, first.snapshots)
    fields = ("log", "steps", "q", "feedback")
    if first.snapshots:
        fields = (*fields, "q_snapshots", "feedback_snapshots")
    out = fused.train(lanes, program, fields)
    finishers = []
    for (cell, _), outcome in zip(batch, out, strict=True):
        task, truth, ratings = tables[cell]
        finishers.append(partial(finish, cell, task, truth, outcome))
    return finishers


def checkpoint_of(folder: Path, cell: Cell, seed: int) -> Path:
    """Return where a run keeps its checkpoint."""
    return folder / f"{cell.key}-{seed}.checkpoint"


def _train_host(cell: Cell, seed: int, folder: Path | None) -> Result:
    from uard.lab.execution.finish import finish_host
    from uard.training.host import loop as host
    from uard.training.host.loops import loop_of
    from uard.training.xla import keep_programs, make_room

    keep_programs()
    make_room(shape_of(cell)[0])
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
        cell.rating_model if isinstance(cell.rating_model, TransitionModel) else TransitionModel(),
        cell.ddof,
        query=cell.query,
    )
    path = None if folder is None else checkpoint_of(folder, cell, seed)
    loop = loop_of(job)
    return finish_host(loop, host.run(loop, path, f"{cell.key} {seed}"))


def _train_deep(batch: Sequence[Job]) -> list[Callable[[], Result]]:
    from uard.agents.off_policy import OffPolicy
    from uard.lab.execution.finish import finish_deep
    from uard.training.compiled import common as deep
    from uard.training.compiled import off_policy, on_policy
    from uard.training.compiled import runs as lanes
    from uard.training.xla import keep_programs, make_room

    keep_programs()
    first = batch[0][0]
    make_room(shape_of(first)[0])
    models = {cell: f if isinstance(f := cell.rating_model, RatingModel) else None for cell, _ in batch}
    worlds = {cell: cell.environment.world(cell.panel, cell.noise) for cell, _ in batch}
    several = [
        deep.make_run(worlds[cell], cell.agent, cell.mitigation, seed, cell.rated, models[cell]) for cell, seed in batch
    ]
    train_one = off_policy.train_one if isinstance(first.agent, OffPolicy) else on_policy.train_one
    out = lanes.train(
        several, train_one, deep.Program(first.episodes, ddof=first.ddof), deep.TrainedAgent._fields, deep.ROOM
    )
    return [partial(finish_deep, cell, seed, outcome) for (cell, seed), outcome in zip(batch, out, strict=True)]


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

    Args:
        jobs: (cell, seed) pairs; doubles are trained once.
        store: Receives every finished batch at once, so an interrupt loses at most what is in flight.
        workers: Processes, one per core if left out; up to 1 trains in this one.
        progress: Called with (finished, to do, seconds that remain or None) after every batch.
        stored: Called with every batch's results once they are safe.
        engine: What trains the batches instead of processes on this machine, such as ``uard.lab.execution.cluster.Ray``.

    Raises:
        StudyFailedError: some jobs raised; all others are stored, and the store says why. Each is tried once.
        StoreError: the store cannot be written; what was finished before is safe.
    """
    wanted: dict[Cell, list[int]] = {}
    for cell, seed in jobs:
        wanted.setdefault(cell, []).append(seed)
    todo = [(cell, seed) for cell, seeds in wanted.items() for seed in store.missing(cell, dict.fromkeys(seeds))]
    if not todo:
        return 0
    if workers is None:
        workers = min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, 64)
    folder = None if store.path == ":memory:" else Path(f"{store.path}-checkpoints")
    total, done, trained, failures = len(todo), 0, 0, []
    known, forecast = store.failures(), Forecast(batches(todo), workers, shape_of)
    log.info("%d of %d seeds are missing in %s; %d workers", total, len(jobs), store.path, workers)

    with _at_work(store, total) as owner:
        refused: list[Job] = []

        def claim(batch: list[Job]) -> list[Job]:
            mine = store.claim(batch, owner)
            taken = set(mine)
            others = [job for job in batch if job not in taken]
            refused.extend(others)
            forecast.drop(others)
            if mine:
                forecast.begin(mine, time.monotonic())
            return mine

        def tell() -> None:
            left = forecast.remaining(time.monotonic()) if done < total else 0.0
            store.report(owner, done, sum(len(f.jobs) for f in failures), left)
            if progress:
                progress(done, total, left)

        def fail(lost: Sequence[Job], error: str) -> None:
            failures.append(Failure(tuple(lost), error))
            log.error("%d seeds failed, first %s:\n%s", len(lost), lost[0], error)

        tell()
        while todo:
            queue = batches(todo)
            if engine is not None:
                outcomes = engine(queue, folder, claim)
            elif workers <= 1 or len(queue) == 1:
                outcomes = _here(queue, folder, claim)
            else:
                outcomes = _spread(queue, workers, folder, claim)
            with closing(outcomes):
                for batch, answer in outcomes:
                    forecast.end(batch, time.monotonic())
                    answers = [answer] * len(batch) if isinstance(answer, str) else [_kept(a, store) for a in answer]
                    pairs = list(zip(batch, answers, strict=True))
                    finished = [(cell, seed, result) for (cell, seed), result in pairs if isinstance(result, Result)]
                    store.put(finished)
                    for cell, seed, _ in finished:
                        if folder is not None and cell.steps is not None:
                            _forget(checkpoint_of(folder, cell, seed))
                    for error in dict.fromkeys(a for a in answers if isinstance(a, str)):
                        lost = [job for job, a in pairs if a == error]
                        store.fail(lost, error, owner)
                        fail(lost, error)
                    if stored and finished:
                        stored(finished)
                    done, trained = done + len(batch), trained + len(finished)
                    log.info("%d of %d seeds done", done, total)
                    tell()
            if refused:
                log.info("waiting for %d seeds that other processes train", len(refused))
            todo, refused = refused, []
            while todo:
                others, free, gone = _look(todo, store, known)
                for error in dict.fromkeys(gone.values()):
                    fail([job for job, e in gone.items() if e == error], error)
                if len(others) + len(free) < len(todo):
                    done = total - len(others) - len(free)
                    tell()
                todo = [*free, *others]
                if free:
                    log.warning("taking over %d seeds that nobody trains any more", len(free))
                    break
                if todo:
                    time.sleep(POLL)
    if failures:
        raise StudyFailedError(failures)
    return trained


@contextmanager
def _at_work(store: Store, total: int) -> Iterator[Owner]:
    """Be known in the store as long as the block runs; give back afterwards what was claimed and not finished."""
    owner, stop = Owner.here(), threading.Event()
    beats = threading.Thread(target=_beat, args=(store.path, owner, stop), daemon=True)
    try:
        store.begin(owner, total)
        if store.path != ":memory:":
            beats.start()
        yield owner
    finally:
        stop.set()
        owner.stop()
        with suppress(StoreError):  # its claims are those of the dead then
            store.end(owner)


def _beat(path: str, owner: Owner, stop: threading.Event) -> None:
    while not stop.wait(BEAT):
        try:
            give_sign(path, owner)
        except StoreError as error:
            log.warning("no sign of life could be given: %s", error)


def _look(
    jobs: list[Job], store: Store, known: dict[tuple[str, int], FailedSeed]
) -> tuple[list[Job], list[Job], dict[Job, str]]:
    """Return which jobs others still train, which nobody does, and which have failed elsewhere, and why."""
    finished, failed, held = store.finished(), store.failures(), store.claimed()
    others, free, gone = [], [], {}
    for cell, seed in jobs:
        place = cell.key, seed
        if seed in finished.get(cell.key, ()):
            continue
        if place in failed and failed[place] != known.get(place):
            gone[cell, seed] = failed[place].traceback
        else:
            (others if place in held else free).append((cell, seed))
    return others, free, gone


def _forget(checkpoint: Path) -> None:
    """Remove the checkpoint of a run that is stored, and what killed processes have left of it."""
    for file in checkpoint.parent.glob(f"{checkpoint.name}*"):
        file.unlink(missing_ok=True)


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
Outcomes = Generator[tuple[list[Job], Answer]]
Engine = Callable[[list[list[Job]], Path | None, Claim], Outcomes]  # of batches (longest first), a folder, a claim


def _here(queue: Iterable[list[Job]], folder: Path | None, claim: Claim) -> Outcomes:
    for batch in queue:
        if mine := claim(batch):
            yield mine, _attempt(lambda mine=mine: (mine, folder))


def _attempt(work: Callable[[], tuple[Sequence[Job], Path | None]]) -> Answer:
    """Train a batch; if that raises, each of its cells alone, so that one bad cell takes no other with it."""
    unpacked = _guarded(work)
    if isinstance(unpacked, str):
        return unpacked
    batch, folder = unpacked
    answer = _guarded(lambda: _train_lanes(batch, folder))
    if not isinstance(answer, str):
        return [_guarded(finished) for finished in answer]
    cells = dict.fromkeys(cell for cell, _ in batch)
    if len(cells) < 2:
        return answer
    alone: dict[Job, Any] = {}
    for cell in cells:
        jobs = [job for job in batch if job[0] == cell]
        answers = _attempt(lambda jobs=jobs: (jobs, folder))
        alone |= zip(jobs, [answers] * len(jobs) if isinstance(answers, str) else answers, strict=True)
    return [alone[job] for job in batch]


def _guarded(action: Callable[[], Any]) -> Any:
    try:
        return action()
    except DivergedError as error:
        return error
    except Exception:
        return traceback.format_exc()


def _work(pipe: Connection, core: int | None) -> None:
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)  # the parent decides
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if core is not None:
        os.sched_setaffinity(0, {core})
    try:
        while True:
            pipe.send(_attempt(partial(pickle.loads, pipe.recv_bytes())))
    except (EOFError, OSError):
        return  # the parent is done, or gone


def _end_with_parent() -> None:
    """End at once when the parent is gone, killed perhaps: somebody else may train the batch again."""
    parent = mp.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)


def _spread(queue: list[list[Job]], workers: int, folder: Path | None, claim: Claim) -> Outcomes:
    """Hand batches to processes, one per core; a process prefers programs that it has compiled already."""
    context = mp.get_context("spawn")
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    waiting: dict[Any, deque[list[Job]]] = {}  # by program, longest first
    for batch in queue:
        waiting.setdefault(shape_of(batch[0][0])[0], deque()).append(batch)
    local: list[list[Job]] = []  # cannot be pickled
    processes: dict[Connection, tuple[Any, int | None]] = {}
    compiled: dict[Connection, set[Any]] = {}
    busy: dict[Connection, list[Job]] = {}

    def take(mine: set[Any]) -> tuple[list[Job], bytes] | None:
        others = set().union(*(programs for programs in compiled.values() if programs is not mine))

        def rank(program: Any) -> tuple[int, int]:
            longest = waiting[program][0]
            known = 0 if program in mine else 1 if program not in others else 2
            return known, -shape_of(longest[0][0])[1] * len(longest)

        while waiting:
            program = min(waiting, key=rank)
            batch = claim(waiting[program].popleft())
            if not waiting[program]:
                del waiting[program]
            data = _packed((batch, folder)) if batch else None
            if data is not None:
                mine.add(program)
                return batch, data
            if batch:
                local.append(batch)
        return None

    def give(pipe: Connection, work: tuple[list[Job], bytes] | None) -> None:
        if work:
            busy[pipe] = work[0]
            with suppress(OSError):  # a dead worker is noticed when its answer is read
                pipe.send_bytes(work[1])

    def start(core: int | None) -> None:
        mine: set[Any] = set()
        work = take(mine)
        if work is None:
            return
        ours, theirs = context.Pipe()
        process = context.Process(target=_work, args=(theirs, core), daemon=True)
        processes[ours], compiled[ours] = (process, core), mine  # before an interrupt can come between
        _start_deaf(process)
        theirs.close()
        give(ours, work)

    complete = False
    try:
        for i in range(min(workers, len(queue))):
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
                    start(core)
                else:
                    give(pipe, take(compiled[pipe]))
                yield batch, answer
        complete = True
    finally:
        begun = [process for process, _ in processes.values() if process.pid is not None]
        for process in begun:
            if not complete:
                process.kill()
        for pipe in processes:
            pipe.close()
        for process in begun:
            process.join()
    for batch in local:
        yield batch, _attempt(lambda batch=batch: (batch, folder))


def _packed(work: tuple[list[Job], Path | None]) -> bytes | None:
    """Pickle a batch; one that cannot be (its class is local to a function, say) is trained in this process."""
    try:
        return pickle.dumps(work)
    except Exception:
        return None


_SIGNALS = {signal.SIGINT, signal.SIGTERM}


def _start_deaf(process: Any) -> None:
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
