"""What the engine itself costs: its share of a study's time, and how long it takes to list and report 10 000 cells.

    python benchmarks/engine.py [--cells N] [--batches N] [--json FILE]

Overhead: batches of one cell that take about a second and a half are run by ``runner.run`` in this process, with a
store on disk; the engine's share is what ``run`` takes beyond what the training calls took. Listing: a store with N
finished cells of 500 episodes is filled, then opened, asked for what is missing, for its status, and for the table of
its study, as `uard reproduce` and `uard status` do. Seconds are (wall, CPU): on a busy machine the second tells.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from uard.agents.tabular import QLearning
from uard.cli.terminal import show
from uard.envs.grids.trapgrid import TrapGrid
from uard.lab.cell import Cell
from uard.lab.execution import runner
from uard.lab.execution.store import Store
from uard.lab.execution.training import train_batch
from uard.lab.result import Result
from uard.lab.study import Row, Study
from uard.lab.trainers.tabular import Tabular
from uard.lab.views.status import lines, status
from uard.lab.views.study_results import StudyResults
from uard.lab.views.tables import study_table
from uard.method.mitigations import named


def overhead(batches: int, folder: Path) -> dict[str, Any]:
    """Run batches of about a second; a walker's horizon sets how long one takes."""
    walker = QLearning(heads=1, epsilon=1.0, epsilon_decay=1.0, epsilon_min=1.0)
    jobs = [(Cell(TrapGrid(16, horizon=10_000 + i), agent=walker, episodes=1500), 0) for i in range(batches)]
    train_batch(jobs[:1])  # compile
    inside, train = [], Tabular.train

    def timed(*work: Any) -> Any:
        began = time.perf_counter()
        finished = [f() for f in train(*work)]
        inside.append(time.perf_counter() - began)
        return [lambda r=r: r for r in finished]

    setattr(Tabular, "train", timed)  # noqa: B010
    with closing(Store(folder / "overhead.sqlite")) as store:
        began = time.perf_counter()
        runner.run(jobs, store, workers=1)
        total = time.perf_counter() - began
    setattr(Tabular, "train", train)  # noqa: B010
    share = (total - sum(inside)) / total
    return {"batches": batches, "seconds_a_batch": sum(inside) / batches, "seconds": total, "overhead": share}


def listing(cells: int, folder: Path) -> dict[str, Any]:
    random = np.random.default_rng(0)
    log = random.integers(0, 40, (500, 6)).astype(np.float32)
    result = Result(log, 20_000, np.zeros(11, np.int32), {"calibration": np.zeros(4, np.float32)})
    path = folder / "many.sqlite"

    def study() -> Study:
        rows = (Row((("lam", i),), Cell(mitigation=named("uard-0.1", lam=i / 1000))) for i in range(cells))
        return Study("many", "Many cells", "", tuple(rows))

    with closing(Store(path)) as store:
        store.put([(r.cell, 0, result) for r in study().rows])
    seconds: dict[str, tuple[float, float]] = {}

    def clocked(what: str, action: Any) -> Any:
        began = time.perf_counter(), time.process_time()
        done = action()
        seconds[what] = round(time.perf_counter() - began[0], 3), round(time.process_time() - began[1], 3)
        return done

    cold = clocked("make the study's cells", study)
    with closing(clocked("open for reading", lambda: Store(path, readonly=True))) as store:
        found = clocked("status", lambda: status(store, [cold]))
        clocked("status, its lines", lambda: lines(found.runs))
        assert found.studies[0].finished == cells
    cold = study()
    with closing(clocked("open", lambda: Store(path))) as store:
        jobs = cold.jobs([0])
        assert clocked("resume: what is missing", lambda: runner.run(jobs, store)) == 0
        table = clocked("report: the study's table", lambda: study_table(cold, StudyResults(store, [0], [cold])))
        with open(folder / "table.txt", "w") as file:
            clocked("report: print it", lambda: show(table, Console(file=file)))
    every = [round(sum(s[i] for s in seconds.values()), 2) for i in (0, 1)]
    return {"cells": cells, "megabytes": round(path.stat().st_size / 1e6), "seconds": seconds, "all": every}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, default=10_000)
    parser.add_argument("--batches", type=int, default=40)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = {"listing": listing(options.cells, Path(folder)), "overhead": overhead(options.batches, Path(folder))}
    text = json.dumps(found, indent=2)
    if options.json:
        options.json.write_text(text + "\n")
    sys.stdout.write(text + "\n")


if __name__ == "__main__":
    main()
