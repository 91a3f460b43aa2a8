"""Fifty simulated raters at the page at once, while the server is killed again and again.

Prints how long an answer takes to be acknowledged, and whether every acknowledged answer is in the export, once and as
it was given::

    python benchmarks/people.py                 # 50 raters, 20 000 answers, 5 kills
    python benchmarks/people.py --raters 5 --answers 500 --kills 1
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from uard import __version__
from uard.collect import Project, Question, text_item
from uard.collect.simulate import Report, Simulation, law_by_reward
from uard.ratings import export
from uard.ratings.panels import Panel, Rater


def serve(folder: Path, port: int) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "uard", "collect", "serve", str(folder), "--port", str(port)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL)


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def watch(project: Project, answers: int, kills: int, over: threading.Event, folder: Path, port: int) -> list[float]:
    """Kill the server whenever another part of the answers is stored; return how long each stayed away."""
    server, away = serve(folder, port), []
    with project.store() as store:
        for k in range(1, kills + 2):
            while not over.is_set() and store.answers()[1] < k * answers / (kills + 1):
                over.wait(0.2)
            if over.is_set() or k > kills:
                break
            os.kill(server.pid, signal.SIGKILL)
            server.wait()
            began = time.perf_counter()
            server = serve(folder, port)
            while not over.is_set():
                try:
                    socket.create_connection(("127.0.0.1", port), 1).close()
                    break
                except OSError:
                    time.sleep(0.05)
            away.append(time.perf_counter() - began)
    over.wait()
    server.send_signal(signal.SIGINT)
    server.wait()
    return away


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--raters", type=int, default=50)
    parser.add_argument("--answers", type=int, default=20_000)
    parser.add_argument("--kills", type=int, default=5)
    parser.add_argument("--pause", type=float, default=0.0, help="seconds between two answers of a rater")
    parser.add_argument("--json", help="write the numbers to this file")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder, port = Path(name), free_port()
        question = Question(low=-5.0, high=5.0, overlap=chosen.raters, repeats=0.0)
        project = Project.create(folder, question)
        each = -(-chosen.answers // chosen.raters)
        raters = [f"rater-{i:02}" for i in range(chosen.raters)]
        with project.store() as store:
            store.add_items([text_item("How good is it?", f"answer {i}", reward=i % 7 - 3.0) for i in range(each)])
            links = {rater: store.invite(rater) for rater in raters}
        panel = Panel(tuple(Rater(noise=0.3) for _ in raters))
        visit = Simulation(
            f"http://127.0.0.1:{port}", links, project, law_by_reward(panel), idle=20.0, most=each, pause=chosen.pause
        )
        over, away = threading.Event(), []
        killer = threading.Thread(
            target=lambda: away.extend(watch(project, each * len(raters), chosen.kills, over, folder, port))
        )
        killer.start()
        began = time.perf_counter()
        report = visit.run()
        took = time.perf_counter() - began
        over.set()
        killer.join()
        numbers = checked(project, report) | {"seconds": took, "kills": len(away), "away": away}
    for key, value in numbers.items():
        print(f"{key}: {value}")
    if chosen.json:
        Path(chosen.json).write_text(json.dumps(numbers | {"version": __version__, "command": sys.argv}, indent=1))


def checked(project: Project, report: Report) -> dict[str, object]:
    """Compare what was acknowledged with what is exported."""
    with project.store() as store:
        stored, _ = store.answers()
    exported = export.read_record(export.write(stored, {}, "record"))
    kept = [a.id for a in exported]
    acknowledged = [name for names in report.acknowledged.values() for name in names]
    milliseconds = 1000 * np.array(report.seconds)
    return {
        "raters": len(report.acknowledged),
        "acknowledged": len(acknowledged),
        "stored": len(kept),
        "lost": len(set(acknowledged) - set(kept)),
        "doubled": len(kept) - len(set(kept)) + len(kept) - len({(a.item, a.rater) for a in exported}),
        "errors": report.errors,
        "median_ms": float(np.median(milliseconds)),
        "percentile_95_ms": float(np.quantile(milliseconds, 0.95)),
        "percentile_99_ms": float(np.quantile(milliseconds, 0.99)),
        "longest_ms": float(milliseconds.max()),
    }


if __name__ == "__main__":
    main()
