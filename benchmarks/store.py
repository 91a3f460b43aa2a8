"""How long it takes to look at a store of 100 000 seeds: status, leaderboard, and what a study lacks.

    python benchmarks/store.py [--seeds N] [--cells C ...] [--json FILE]

For each number of cells a store with that many, N seeds in all, is filled through the store's own interface and then
looked at, each command in a process of its own. Seconds are of the wall; peak memory is the largest of these processes.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from uard.lab.cell import Cell
from uard.lab.execution.store import Store
from uard.lab.result import Result
from uard.method.mitigations import named

UARD = "from uard.cli.app import main; main()"
MISSING = """
import sys
from uard.lab.execution import runner
from uard.lab.execution.store import Store
from benchmark_store import cells

jobs = [(cell, seed) for cell in cells(int(sys.argv[2])) for seed in range(int(sys.argv[3]))]
assert runner.run(jobs, Store(sys.argv[1])) == 0
"""


def cells(count: int) -> list[Cell]:
    return [Cell(mitigation=named("uard-0.1", lam=1 + i / 1000)) for i in range(count)]


def fill(path: Path, count: int, seeds: int) -> None:
    random = np.random.default_rng(0)
    logs = [random.integers(1, 40, (100, 6)).astype(np.float32) for _ in range(100)]
    with closing(Store(path)) as store:
        for cell in cells(count):
            for first in range(0, seeds, 1000):
                some = range(first, min(seeds, first + 1000))
                made = (Result(logs[s % 100], 20_000, np.zeros(11, np.int32), {}) for s in some)
                store.put([(cell, s, result) for s, result in zip(some, made, strict=True)])


def look(count: int, seeds: int, folder: Path) -> dict[str, Any]:
    path = folder / f"{count}.sqlite"
    fill(path, count, seeds)
    (folder / "benchmark_store.py").write_text(Path(__file__).read_text())
    (folder / "missing.py").write_text(MISSING)
    commands = {
        "status": ["-c", UARD, "status", "--store", str(path)],
        "leaderboard": ["-c", UARD, "leaderboard", "--store", str(path), "--out", str(folder / "board.html")],
        "what is missing": [str(folder / "missing.py"), str(path), str(count), str(seeds)],
    }
    seconds = {}
    for name, command in commands.items():
        began = time.perf_counter()
        subprocess.run([sys.executable, *command], stdout=subprocess.DEVNULL, check=True)
        seconds[name] = round(time.perf_counter() - began, 1)
    return {"cells": count, "seeds a cell": seeds, "megabytes": round(path.stat().st_size / 1e6), "seconds": seconds}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=100_000)
    parser.add_argument("--cells", type=int, nargs="+", default=[1, 100, 10_000])
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = [look(count, options.seeds // count, Path(folder)) for count in options.cells]
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss // 1024
    text = json.dumps({"stores": found, "peak of memory, MB": peak}, indent=2)
    if options.json:
        options.json.write_text(text + "\n")
    sys.stdout.write(text + "\n")


if __name__ == "__main__":
    main()
