"""A study that is killed again and again, and goes on each time, ends as one that nobody disturbed.

    python benchmarks/kill_loop.py [--kills N] [--study NAME] [--seeds N] [--workers N] [--seed S]

The real program, ``uard reproduce``, is started, killed at a random moment (three times in five by SIGKILL, else by
SIGTERM or SIGINT), and started again with the same command until it ends by itself; then from an empty store, until
there were N kills. After each, what is in the store must be what an undisturbed study has; SIGTERM and SIGINT must end
the process within 5 seconds, with 143 and 130. Whatever is not so is printed, and the exit code is 1.
"""

from __future__ import annotations

import argparse
import random
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

# Python ignores SIGINT where its parent does, as a job in the background.
PROGRAM = "import signal; signal.signal(2, signal.default_int_handler); from uard.cli.app import main; main()"
# A signal in the moment in which Python itself ends, after the program, kills the process; shells say the same number.
CODES = {
    signal.SIGKILL: {-signal.SIGKILL},
    signal.SIGTERM: {143, -signal.SIGTERM},
    signal.SIGINT: {130, -signal.SIGINT},
}
PATIENCE = 5.0  # seconds from a signal to the end


def start(store: Path, options: argparse.Namespace) -> subprocess.Popen[str]:
    words = ["reproduce", options.study, "--seeds", str(options.seeds), "--workers", str(options.workers)]
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *words, "--store", str(store)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def finished(store: Path) -> dict[tuple[str, int], tuple[Any, ...]]:
    """Return what is in a store, by cell and seed."""
    if not store.exists():
        return {}
    with closing(sqlite3.connect(store, timeout=60)) as db:
        if not db.execute("select 1 from sqlite_master where name = 'quarantine'").fetchone():
            return {}
        assert db.execute("select count(*) from quarantine").fetchone() == (0,)
        return {row[:2]: row[2:] for row in db.execute("select key, seed, data, checksum, metrics from results")}


def kill(process: subprocess.Popen[str], number: signal.Signals, after: float) -> tuple[int, float, str]:
    """Wait, then send a signal; return exit code, seconds until the end, and what was said."""
    try:
        said = process.communicate(timeout=after)[1]
        return process.returncode, 0.0, said
    except subprocess.TimeoutExpired:
        began = time.monotonic()
        process.send_signal(number)
    with suppress(subprocess.TimeoutExpired):
        process.wait(60)
    took = time.monotonic() - began
    process.kill()  # if it has not ended
    said = process.communicate()[1]  # waits for workers that are still starting, too
    return process.returncode, took, said


def loop(options: argparse.Namespace, folder: Path) -> list[str]:
    """Return what went wrong."""
    began = time.monotonic()
    undisturbed = start(folder / "undisturbed.sqlite", options)
    said = undisturbed.communicate()[1]
    if undisturbed.returncode:
        sys.exit(f"the undisturbed study ended with {undisturbed.returncode}: {said}")
    seconds, want = time.monotonic() - began, finished(folder / "undisturbed.sqlite")
    chance, wrong, counted, rounds, slowest, told = random.Random(options.seed), [], Counter[str](), 0, 0.0, 0
    while counted.total() < options.kills:
        rounds += 1
        store, before, code = folder / f"{rounds}.sqlite", {}, None
        while code != 0:
            last = counted.total() >= options.kills
            number = chance.choice([signal.SIGKILL] * 3 + [signal.SIGTERM, signal.SIGINT])
            process = start(store, options)
            code, took, said = kill(process, number, 600 if last else chance.uniform(0.1, 0.9) * seconds)
            if code == 0:
                break
            counted[number.name] += 1
            where = f"kill {counted.total()} ({number.name})"
            if code not in CODES[number]:
                wrong.append(f"{where}: exit code {code}, none of {CODES[number]}: {said[-300:]}")
            if took > PATIENCE:
                wrong.append(f"{where}: ended after {took:.1f} s")
            slowest, after = max(slowest, took), finished(store)
            if not before.items() <= after.items() or not after.items() <= want.items():
                wrong.append(f"{where}: the store is not a part of the undisturbed one")
            before = after
        if finished(store) != want:
            wrong.append(f"study {rounds}: not what the undisturbed one has")
        said = (
            f"{dict(counted)}, {rounds} studies of {len(want)} seeds; slowest end {slowest:.1f} s; {len(wrong)} wrong"
        )
        print("\n".join([said, *wrong[told:]]), flush=True)
        told = len(wrong)
    return wrong


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--study", default="control")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=20261122)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        wrong = loop(options, Path(folder))
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
