"""How far studies are, who is at work on them, and what failed: read off the store, running or dead."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from uard.lab.execution.claims import HEARTBEAT
from uard.lab.execution.rows import DamagedSeed
from uard.lab.execution.store import FailedSeed, Store, WorkerRun
from uard.lab.study import Study

SEEDS = 10  # of a study of which the store knows nothing


@dataclass(frozen=True)
class StudyStatus:
    """Numbers of seeds of one study.

    Attributes:
        name: Of the study.
        seeds: That each of its cells should have.
        finished: In the store.
        claimed: That a living process trains.
        failed: When last tried; neither finished nor claimed.
        missing: The rest.
        last: When the last one was finished, in seconds since 1970.
    """

    name: str
    seeds: int
    finished: int
    claimed: int
    failed: int
    missing: int
    last: float | None


@dataclass(frozen=True)
class FailedCell:
    """A cell whose seeds failed in the same way.

    Attributes:
        title: Study and row.
        seeds: Which.
        why: Of the first of them.
    """

    title: str
    seeds: tuple[int, ...]
    why: FailedSeed


@dataclass(frozen=True)
class Status:
    """What ``uard status`` prints.

    Attributes:
        cells: In the store, of whichever study.
        seeds: Finished ones.
        runs: Processes at work, those that died, and the last that ended.
        studies: Those asked for; those of which the store knows anything if none were.
        failures: Of these studies.
        damaged: Results that are not what was written; they count as missing, and are trained again.
    """

    cells: int
    seeds: int
    runs: tuple[WorkerRun, ...]
    studies: tuple[StudyStatus, ...]
    failures: tuple[FailedCell, ...]
    damaged: tuple[DamagedSeed, ...]


def titles(studies: Iterable[Study]) -> dict[str, str]:
    """Return what people call each cell of some studies, by key."""
    found: dict[str, str] = {}
    for study in studies:
        for row in study.rows:
            labels = ", ".join(f"{name} {value}" for name, value in row.labels)
            found.setdefault(row.cell.key, f"{study.name}: {labels}")
    return found


def status(store: Store, studies: Sequence[Study], seeds: int | None = None, every: bool = True) -> Status:
    """Read it all.

    Args:
        store: Opened for reading is enough.
        studies: Of which to tell.
        seeds: That each cell should have; as many as the store knows of any cell of a study if left out.
        every: Also of studies of which the store knows nothing.
    """
    finished, claimed, failed = store.finished(), store.claimed(), store.failures()
    busy: dict[str, set[int]] = {}
    wrong: dict[str, set[int]] = {}
    for keys, found in ((claimed, busy), (failed, wrong)):
        for key, seed in keys:
            if isinstance(seed, int):  # a claim may be damaged, too
                found.setdefault(key, set()).add(seed)
    lines = []
    for study in studies:
        keys = list(dict.fromkeys(r.cell.key for r in study.rows))
        known = [s for key in keys for where in (finished, busy, wrong) for s in where.get(key, ())]
        if not (known or every):
            continue
        wanted = seeds or (max(known) + 1 if known else SEEDS)
        done = [t for key in keys for seed, t in finished.get(key, {}).items() if seed < wanted]
        at_work, lost = 0, 0
        for key in keys:
            working = {s for s in busy.get(key, set()) - finished.get(key, {}).keys() if s < wanted}
            at_work += len(working)
            lost += len({s for s in wrong.get(key, set()) - finished.get(key, {}).keys() if s < wanted} - working)
        missing = len(keys) * wanted - len(done) - at_work - lost
        last = max(done, default=None)
        lines.append(StudyStatus(study.name, wanted, len(done), at_work, lost, missing, last))
    names = titles(studies) if failed else {}
    alike: dict[tuple[str, str], list[int]] = {}
    for (key, seed), why in failed.items():
        if key in names:
            alike.setdefault((key, why.error), []).append(seed)
    failures = tuple(
        FailedCell(names[key], tuple(sorted(which)), failed[key, which[0]]) for (key, _), which in alike.items()
    )
    cells = len(finished)
    seeds_done = sum(map(len, finished.values()))
    return Status(cells, seeds_done, tuple(store.runs()), tuple(lines), failures, store.damaged)


def duration(seconds: float) -> str:
    """Return a time as people say it."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 90 * 60:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h" if seconds < 48 * 3600 else f"{seconds / 86400:.1f} days"


def clock(when: float) -> str:
    """Return a time as people read it."""
    return time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(when))


def lines(runs: Iterable[WorkerRun], now: float | None = None) -> list[str]:
    """Return one line for every process: whether it is alive, how far it is, how fast, and how long it still needs."""
    now, found = time.time() if now is None else now, []
    for run in runs:
        stop = run.ended or run.beat
        state = "at work" if run.alive else "ended" if run.ended else "died"
        parts = [f"{run.owner} {state}, began {clock(run.began)}", f"{run.done} of {run.total} done"]
        if run.failed:
            parts.append(f"{run.failed} failed")
        if run.claimed:
            parts.append(f"{run.claimed} in work" if run.alive else f"{run.claimed} were in work")
        if run.done and stop > run.began:
            parts.append(f"{60 * run.done / (stop - run.began):,.0f} seeds/min")
        if run.alive and run.remaining is not None:
            parts.append(f"about {duration(max(0.0, run.remaining - max(0.0, now - run.beat)))} left")
        if run.alive and run.beat - now > HEARTBEAT:
            parts.append(f"perhaps: its last heartbeat is {duration(run.beat - now)} ahead of this machine's clock")
        if not run.alive:
            parts.append(f"last heartbeat {clock(stop)}")
        found.append("; ".join(parts))
    return found


def as_data(found: Status) -> dict[str, Any]:
    """Return it as plain data; times are seconds since 1970."""
    runs = [{**asdict(run), "alive": run.alive} for run in found.runs]
    return {**asdict(found), "runs": runs}


def said_of_damaged(damaged: Sequence[DamagedSeed], most: int = 3) -> list[str]:
    """Return in lines what of a store is damaged; the first ``most`` by name."""
    named = [f"cell {d.key}{'' if d.seed is None else f', seed {d.seed}'}: {d.reason}" for d in damaged[:most]]
    if not damaged:
        return []
    head = f"{len(damaged)} damaged, left out (`uard reproduce` trains damaged seeds again); such as"
    return [head, *(f"  {line}" for line in named)]
