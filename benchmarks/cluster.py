"""What docs/guides/cluster.md computes with.

``python benchmarks/cluster.py cells``: CPU seconds per seed of each family, compilation apart. ``... store``: bytes per
seed, and seeds written per CPU second. ``... driver``: batches handed out and taken in per CPU second of the driver
(needs the extra ``uard[ray]``).
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import uard.training  # noqa: F401  isort: skip  (sets XLA's flags)
import numpy as np

from uard.envs.grids.trapgrid import paper_grid
from uard.lab import registry as names
from uard.lab.cell import Cell
from uard.lab.execution import cluster
from uard.lab.execution.store import Store
from uard.lab.execution.training import train_batch
from uard.lab.result import Result
from uard.lab.trainers.compiled import Compiled
from uard.lab.trainers.tabular import Tabular
from uard.method.mitigations import named
from uard.training.feedback.rating_model import RatingModel


def cells():
    deep = {"rating_model": RatingModel()}
    for name, cell, seeds in (
        ("tabular", Cell(paper_grid(10), named("uard")), Tabular.at_once),
        ("dqn", Cell(paper_grid(10), named("uard"), names.AGENTS["dqn"], **deep), 1),
        ("ppo", Cell(paper_grid(10), named("uard"), names.AGENTS["ppo"], **deep), 1),
    ):
        taken, results = [], []
        for first in (0, seeds):
            started = time.process_time()
            results = train_batch([(cell, first + i) for i in range(seeds)])
            taken.append(time.process_time() - started)
        size = sum(len(r.pack()[0]) for r in results) / seeds
        print(
            f"{name}: {taken[1] / seeds:.3f} s of CPU per seed, {taken[0] - taken[1]:.1f} s to compile, "
            f"{np.mean([r.steps for r in results]):.0f} steps, {size:.0f} bytes per seed",
            flush=True,
        )


def made_up(i):
    """A result of a deep agent's size."""
    draw = np.random.default_rng(i)
    log = draw.integers(0, 99, (500, 6)).astype(np.float32)
    return Result(log, 1, np.zeros(80, np.int32), {"tables": draw.normal(size=(100, 4, 5)).astype(np.float32)})


def store():
    for batch in (1, Compiled.at_once, Tabular.at_once):
        with tempfile.TemporaryDirectory() as folder:
            target = Store(Path(folder) / "s.sqlite")
            cell, results = Cell(), [made_up(i) for i in range(640)]
            started = time.process_time()
            for i in range(0, len(results), batch):
                target.put([(cell, i + j, r) for j, r in enumerate(results[i : i + batch])])
            taken = time.process_time() - started
            target.close()
            size = (Path(folder) / "s.sqlite").stat().st_size / len(results)
        print(
            f"batches of {batch}: {len(results) / taken:.0f} seeds per CPU second, {size:.0f} bytes per seed",
            flush=True,
        )


def _at_once(data, versions):
    return [made_up(i) for i in range(5)]


def driver(batches=400):
    cluster.train_on_node = _at_once
    queue = [[(Cell(episodes=i + 1), s) for s in range(5)] for i in range(batches)]
    started = wall = None
    for n, _ in enumerate(cluster.Ray()(queue, None, list)):
        if n == batches // 4:
            started, wall = time.process_time(), time.perf_counter()
    count = batches - batches // 4
    print(f"{count / (time.process_time() - started):.0f} batches per CPU second of the driver")
    print(f"{count / (time.perf_counter() - wall):.0f} batches per second of the clock, all on this machine")


if __name__ == "__main__":
    {"cells": cells, "store": store, "driver": driver}[sys.argv[1]]()
