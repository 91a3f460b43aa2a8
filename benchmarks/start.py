"""How long a user waits for the first result of `uard run`: with no compiled program kept, and with all of them.

python benchmarks/start.py [--rounds 3] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ASKED = {"cold": 8.0, "warm": 3.0}  # seconds


def first_result(cache: str, folder: str) -> float:
    """Return the seconds until one run of ten seeds is printed."""
    env = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"} | {"XDG_CACHE_HOME": cache}
    command = [sys.executable, "-m", "uard", "run", "TrapGrid", "--mitigation", "uard", "--store", f"{folder}/s.sqlite"]
    began = time.perf_counter()
    subprocess.run(command, env=env, check=True, capture_output=True)
    return time.perf_counter() - began


def main() -> None:
    """Measure, print, and write."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--rounds", type=int, default=3)
    options.add_argument("--json", type=Path)
    given = options.parse_args()
    found: dict[str, list[float]] = {"cold": [], "warm": []}
    for _ in range(given.rounds):
        with tempfile.TemporaryDirectory() as cache:
            for state in found:  # the first call fills the cache that the second finds
                with tempfile.TemporaryDirectory() as folder:
                    found[state].append(first_result(cache, folder))
    rows = [
        {"name": state, "seconds": statistics.median(s), "range": [min(s), max(s)], "asked": ASKED[state]}
        for state, s in found.items()
    ]
    for row in rows:
        low, high = row["range"]
        print(f"{row['name']:6s} {row['seconds']:5.1f} s ({low:.1f} to {high:.1f}), asked {row['asked']:.0f} s")
    if given.json is not None:
        given.json.write_text(json.dumps({"rows": rows}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
