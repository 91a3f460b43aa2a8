"""A study of very many small cells on a Ray cluster of 8 nodes with 2 workers each, all on this machine.

    python benchmarks/many_cells.py [--cells 100000] [--nodes 8] [--json FILE]

Each cell is a grid of 3x3, five episodes, one seed; all differ in a number, as the cells of a study do. Measured: the
whole time and the driver's own CPU time per cell, that of a worker (the same batches in one process), what the store
takes in, and the loss of the cluster's head: at a third of the cells its process is killed, the driver must end
and lose nothing that was finished, and the same call on a new cluster does the rest.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}  # before Ray reads them

import uard.training  # noqa: F401  isort: skip  (sets XLA's flags)
import ray
from ray.cluster_utils import Cluster

from uard.agents.tabular import QLearning
from uard.envs.grids.trapgrid import TrapGrid
from uard.lab.cell import Cell
from uard.lab.execution import batching, runner
from uard.lab.execution.cluster import Ray
from uard.lab.execution.store import Store
from uard.lab.execution.training import attempt
from uard.method.mitigations import named


def jobs_of(count: int) -> list[tuple[Cell, int]]:
    """Return so many cells, one seed each, all of one program."""
    uard, agent = named("uard"), QLearning(heads=2)
    return [(Cell(TrapGrid(3, ((1, 1),), 1 + i / count, horizon=9), uard, agent, episodes=5), 0) for i in range(count)]


@contextmanager
def nodes_of(count: int) -> Iterator[Cluster]:
    """Start a head without cores and so many nodes of two cores each; end them."""
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    try:
        for _ in range(count):
            made.add_node(num_cpus=2, wait=False, object_store_memory=80_000_000)
        made.wait_for_nodes()
        yield made
    finally:
        ray.shutdown()
        made.shutdown()


def taken(work: Callable[[], Any]) -> tuple[float, float]:
    """Return how many seconds a piece of work takes, and how many of CPU time this process spends on it."""
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - cpu


def head_is_lost(count: int, path: Path, nodes: int) -> dict[str, Any]:
    """Kill the head at a third of the cells, under a driver of its own; go on with a new cluster."""
    child = [sys.executable, __file__, "--cells", str(count), "--nodes", str(nodes), "--until-head-is-lost", str(path)]
    ended = subprocess.run(child, capture_output=True, text=True)
    with closing(Store(path)) as store:
        kept = store.count()[1]
        with nodes_of(nodes) as made:
            trained = runner.run(jobs_of(count), store, engine=Ray(made.address))
        whole = store.count()[1]
    said = (ended.stderr.strip().splitlines() or [""])[-1]
    return {"driver_ended_with": ended.returncode, "said": said[:200], "kept": kept, "then": trained, "in_all": whole}


def lose_the_head(count: int, path: Path, nodes: int) -> None:
    """Run the cells, and kill the head at a third of them; Ray ends this process when it no longer answers."""
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    for _ in range(nodes):
        made.add_node(num_cpus=2, object_store_memory=80_000_000)
    killed: list[int] = []

    def kill(done: int, total: int, _: object) -> None:
        if done >= total / 3 and not killed:
            killed.append(done)
            made.head_node.kill_gcs_server(False)

    with closing(Store(path)) as store:
        runner.run(jobs_of(count), store, progress=kill, engine=Ray(made.address))


def main() -> None:
    """Measure, print, and write."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--cells", type=int, default=100_000)
    options.add_argument("--nodes", type=int, default=8)
    options.add_argument("--json", type=Path)
    options.add_argument("--until-head-is-lost", type=Path, help=argparse.SUPPRESS)
    given = options.parse_args()
    if given.until_head_is_lost is not None:
        lose_the_head(given.cells, given.until_head_is_lost, given.nodes)
        return
    jobs = jobs_of(given.cells)
    (batch, *_) = batching.batches(jobs[:64])
    attempt(batch, None)  # compiles
    alone, _ = taken(lambda: [attempt(batch, None) for _ in range(20)])
    with tempfile.TemporaryDirectory() as folder:
        with closing(Store(Path(folder) / "all.sqlite")) as store, nodes_of(given.nodes) as made:
            wall, driver = taken(lambda: runner.run(jobs, store, engine=Ray(made.address)))
            assert store.count()[1] == given.cells
            size = Path(store.path).stat().st_size / given.cells
        print(f"{given.cells} cells in {wall:.0f} s; now the head is lost", file=sys.stderr, flush=True)
        lost = head_is_lost(max(given.cells // 10, 1000), Path(folder) / "part.sqlite", given.nodes)
    found = {
        "command": f"python benchmarks/many_cells.py --cells {given.cells} --nodes {given.nodes}",
        "versions": {p: version(p) for p in ("uard", "ray", "jax")},
        "cores": len(os.sched_getaffinity(0)),
        "cells": given.cells,
        "seconds": wall,
        "cells_per_second": given.cells / wall,
        "driver_ms_per_cell": 1e3 * driver / given.cells,
        "worker_ms_per_cell": 1e3 * alone / (20 * len(batch)),
        "bytes_per_cell": size,
        "head_lost": lost,
    }
    print(json.dumps(found, indent=2))
    if given.json is not None:
        given.json.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
