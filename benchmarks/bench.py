"""Everything that people wait for, in one table with the roof beside each number: what `make bench` runs.

    python benchmarks/bench.py [--json FILE] [--only PART]

The parts are the benchmarks beside this file, each in a process of its own; more of each by calling it alone. A roof is
what no program of ours could be faster than, measured or computed in the same run: a rule that listens and does nothing
else, a wrapper that passes everything through, MuJoCo's bare steps, the arithmetic at the machine's matrix rate, a
batch without a cluster.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
PACKAGES = ("uard", "jax", "numpy", "torch", "stable-baselines3", "sb3-contrib", "mujoco", "gymnasium", "ray")


@dataclass(frozen=True)
class Line:
    """A line of the table.

    Attributes:
        what: Was measured.
        value: Median over rounds.
        low: The smallest.
        high: The largest.
        unit: Of all numbers of the line.
        asked: The bound; None if there is none.
        most: Whether it is an upper bound.
        roof: What cannot be passed, in the same unit; None if nobody knows it.
        roof_is: What the roof is.
    """

    what: str
    value: float
    low: float
    high: float
    unit: str
    asked: float | None = None
    most: bool = True
    roof: float | None = None
    roof_is: str = ""

    @property
    def met(self) -> bool | None:
        """Whether the bound is kept; None without one."""
        if self.asked is None:
            return None
        return self.value <= self.asked if self.most else self.value >= self.asked

    def text(self) -> str:
        """Return it as printed."""
        asked = "" if self.asked is None else f"{'<=' if self.most else '>='} {self.asked:g}"
        met = {None: "", True: "yes", False: "NO"}[self.met]
        roof = "" if self.roof is None else f"{self.roof:.3g} ({self.roof_is})"
        number = f"{self.value:.3g} [{self.low:.3g}, {self.high:.3g}]"
        return f"{self.what:42s} {number:>24s} {self.unit:9s} {asked:>7s} {met:3s}  {roof}"


def tables(found: dict[str, Any]) -> Iterator[Line]:
    """Read tabular.py."""
    roofs = {
        "raw / uard: what the rule costs": ("raw / mean: what listening costs", "listening alone"),
    }
    by_name = {row["ratio"]: row for row in found["ratios"]}
    for name, row in by_name.items():
        asked = None if row["asked"] is None else float(row["asked"].split()[1])
        roof, said = roofs.get(name, (None, ""))
        most = row["asked"] is None or row["asked"].startswith("<=")
        value = None if roof is None else by_name[roof]["median"]
        yield Line(f"tables: {name}", row["median"], row["min"], row["max"], "times", asked, most, value, said)


def deep(found: dict[str, Any]) -> Iterator[Line]:
    """Read deep.py."""
    for row in found["rows"]:
        part, first = row["part"], row["us_per_step"] / row["times_first"]
        if row["name"] != "uard":
            continue
        asked = 1.5 if part.endswith(("BoatRace", "TomatoWatering")) else 1.15
        low, high = (x / first for x in row["range_us"])
        floor = row["floor_times_first"]
        yield Line(f"{part}: raw to uard", row["times_first"], low, high, "times", asked, True, floor, "arithmetic")


def adapters(found: dict[str, Any]) -> Iterator[Line]:
    """Read adapters.py."""
    for row in found["rows"]:
        limit = None if row["limit"] is None else 100 * row["limit"]
        value, low, high = (100 * x for x in (row["cost"], *row["range"]))
        roof = max(0.0, 100 * row["floor"])  # less than nothing is noise
        yield Line(f"adapter: {row['name']}", value, low, high, "percent", limit, True, roof, "passes through")
        value, low, high = (100 * x for x in (row["clocked"], *row["clocked_range"]))
        yield Line(f"adapter: {row['name']}, our code", value, low, high, "percent", limit)


def physics(found: dict[str, Any]) -> Iterator[Line]:
    """Read locomotion.py."""
    for what in dict.fromkeys(row["what"] for row in found["rows"]):
        rows = {row["who"]: row for row in found["rows"] if row["what"] == what}
        theirs = rows["Gymnasium's SyncVectorEnv"]["rate"]
        name = max((n for n in rows if n.startswith("ours")), key=lambda n: int(n.split()[1]))
        row, bare = rows[name], rows["MuJoCo's steps alone, 1 thread"]["rate"]
        asked = 2.0 if what.startswith("hopper") and "8 copies" in what else None
        threads = int(name.split()[1])
        value, low, high = (x / theirs for x in (row["rate"], *row["range"]))
        label = f"{what.split(':')[0]}, {what.split(', ')[1]}: over SyncVectorEnv"
        yield Line(label, value, low, high, "times", asked, False, threads * bare / theirs, "bare steps on each core")


def cells(found: dict[str, Any]) -> Iterator[Line]:
    """Read many_cells.py."""
    for name, unit in (("driver_ms_per_cell", "ms"), ("cells_per_second", "1/s")):
        value = found[name]
        roof, said = (found["worker_ms_per_cell"], "a worker's") if unit == "ms" else (None, "")
        label = f"Ray, {found['cells']} cells: {name.replace('_', ' ')}"
        yield Line(label, value, value, value, unit, None, True, roof, said)


def start(found: dict[str, Any]) -> Iterator[Line]:
    """Read start.py."""
    for row in found["rows"]:
        low, high = row["range"]
        yield Line(f"first result of uard run, {row['name']}", row["seconds"], low, high, "s", row["asked"])


Reader = Callable[[dict[str, Any]], Iterator[Line]]
PARTS: dict[str, tuple[list[str], Reader]] = {
    "start": (["start.py", "--rounds", "3"], start),
    "tables": (["tabular.py", "--repetitions", "5"], tables),
    "deep": (["deep.py", "--rounds", "3", "--steps", "1500"], deep),
    "physics": (["locomotion.py", "--only", "physics", "--rounds", "5"], physics),
    "adapters": (["adapters.py", "--rounds", "3"], adapters),
    "cells": (["many_cells.py", "--cells", "2000", "--nodes", "4"], cells),
}


def main() -> None:
    """Run all parts, print the table, and write it."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--json", type=Path)
    options.add_argument("--only", choices=PARTS, nargs="*", default=list(PARTS))
    given = options.parse_args()
    lines: list[Line] = []
    before = os.getloadavg()[0]
    seconds: dict[str, float] = {}
    for name in given.only:
        (script, *arguments), read = PARTS[name]
        print(f"{name}: python benchmarks/{script} {' '.join(arguments)}", file=sys.stderr, flush=True)
        began = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "found.json"
            done = subprocess.run(
                [sys.executable, HERE / script, *arguments, "--json", out], capture_output=True, text=True
            )
            if done.returncode:
                print(f"{name} failed:\n{done.stderr[-2000:]}", file=sys.stderr)
                continue
            lines += read(json.loads(out.read_text(encoding="utf-8")))
        seconds[name] = round(time.perf_counter() - began, 1)
    print(f"{'what':42s} {'median [range]':>24s} {'unit':9s} {'asked':>7s} met  roof")
    for line in lines:
        print(line.text())
    if given.json is not None:
        given.json.write_text(json.dumps(report(lines, before, seconds, given.only), indent=1) + "\n", encoding="utf-8")


def report(lines: list[Line], load: float, seconds: dict[str, float], parts: list[str]) -> dict[str, Any]:
    """Return what is written: the table, where and how it was made."""
    packages: dict[str, str] = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            packages[package] = version(package)
        except PackageNotFoundError:
            packages[package] = "not installed"
    return {
        "command": "python benchmarks/bench.py" + ("" if parts == list(PARTS) else f" --only {' '.join(parts)}"),
        "machine": f"{processor()}, {len(os.sched_getaffinity(0))} cores",
        "load_at_the_start": load,
        "packages": packages,
        "seconds": seconds,
        "lines": [asdict(line) | {"met": line.met} for line in lines],
    }


def processor() -> str:
    """Return the processor's name."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.machine()


if __name__ == "__main__":
    main()
