"""A study is killed at random points, by whatever ends processes, and by a full disk; and two work on one store.

UARD_KILLS=100 makes it that many kills instead of a few.
"""

import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing, suppress
from pathlib import Path

import pytest

from uard.agents.tabular import QLearning
from uard.envs.grids.trapgrid import TrapGrid
from uard.lab.cell import Cell
from uard.lab.execution.store import Store

KILLS = int(os.environ.get("UARD_KILLS", "8"))
JOBS, WORKERS = 30, 2
DRIVER = """
import signal, sys
from uard.lab.execution import runner
from uard.lab.execution.store import Store
from test_survival import walks

if __name__ == "__main__":
    from uard._support import signals
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with signals.ending():
        print(runner.run(walks(), Store(sys.argv[1]), int(sys.argv[2]), lambda *x: print(*x, flush=True)), flush=True)
"""

# Starts processes that have imported everything: a hundred starts of Python would take longer than the test may.
STARTER = """
import os, signal, sys, warnings
import jax
from uard._support import signals
from uard.lab import trainers
from uard.lab.execution import runner
from uard.lab.execution.store import Store
from uard.training.compiled import tabular
from test_survival import walks

warnings.simplefilter("ignore", RuntimeWarning)  # of os.fork: nothing has been computed here
for line in sys.stdin:
    pid = os.fork()
    if not pid:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        code = 1
        try:
            with signals.ending(), open("progress", "a") as progress:
                runner.run(walks(), Store(line.strip()), 1, lambda *x: print(*x, file=progress, flush=True))
            code = 0
        except KeyboardInterrupt:
            code = 130
        finally:
            os._exit(code)
    print(pid, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
"""


def walks(n=JOBS):
    """One batch each, of one program, about a third of a second long."""
    walker = QLearning(heads=1, epsilon=1.0, epsilon_decay=1.0, epsilon_min=1.0)
    return [(Cell(TrapGrid(10, horizon=2000 + i), agent=walker, episodes=500), 0) for i in range(n)]


@pytest.fixture
def study(tmp_path):
    """Starts the study in a process group of its own."""
    (tmp_path / "driver.py").write_text(DRIVER)
    (tmp_path / "starter.py").write_text(STARTER)
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    started = []

    def start(*arguments, script="driver.py", **options):
        process = subprocess.Popen(
            [sys.executable, script, *map(str, arguments or ("s.sqlite", WORKERS))],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": path},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            **options,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def done(process):
    """Wait for the first finished seeds."""
    for line in process.stdout:
        if not line.startswith("0 "):
            return line
    raise AssertionError(process.communicate())


def blobs(path):
    with closing(sqlite3.connect(path, timeout=60)) as db:
        return {row[:2]: row[2:] for row in db.execute("select key, seed, data, checksum, metrics from results")}


def pause(process, path):
    """Stop a process that trains, not one that writes: it would keep all others out."""
    while True:
        process.send_signal(signal.SIGSTOP)
        with closing(sqlite3.connect(path, timeout=0.2)) as db:
            try:
                db.execute("begin immediate")
            except sqlite3.OperationalError:
                process.send_signal(signal.SIGCONT)
            else:
                claims = db.execute("select count(*) from claims").fetchone()[0]
                db.rollback()
                if claims:
                    return
                process.send_signal(signal.SIGCONT)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    from uard.lab.execution import runner

    path = tmp_path_factory.mktemp("undisturbed") / "s.sqlite"
    with closing(Store(path)) as store:
        assert runner.run(walks(), store, workers=1) == JOBS
    return blobs(path)


def test_killed_at_random_points_a_study_ends_as_if_nothing_had_happened(study, tmp_path, undisturbed):
    starter = study(script="starter.py", stdin=subprocess.PIPE)
    chance, kills, rounds, again, progress = random.Random(20261122), 0, 0, 0, tmp_path / "progress"
    progress.touch()

    def lines():
        return progress.read_text().count("\n")

    while kills < KILLS:
        rounds += 1
        path, code, before, began, lost = tmp_path / f"{rounds}.sqlite", None, {}, 0, 0
        while code != 0:
            starter.stdin.write(f"{path}\n")
            starter.stdin.flush()
            pid, seen = int(starter.stdout.readline()), lines()
            if kills < KILLS:
                seeds, deadline = chance.randrange(5), time.monotonic() + 60
                while lines() < seen + seeds and Path(f"/proc/{pid}").exists() and time.monotonic() < deadline:
                    time.sleep(0.005)
                time.sleep(chance.uniform(0, 0.5))
                with suppress(ProcessLookupError):  # it may have ended by itself
                    os.kill(pid, chance.choice([signal.SIGKILL] * 3 + [signal.SIGTERM, signal.SIGINT]))
            code = int(starter.stdout.readline())
            assert code in (0, 130, 143, -signal.SIGKILL, -signal.SIGTERM)  # the last before it has begun
            kills += code != 0
            if not path.exists():
                continue
            with closing(Store(path)) as store:
                attempts, after = store.attempts(), blobs(path)
                assert store.quarantined() == []
            assert before.items() <= after.items(), "what was finished stays as it was"
            assert {k: v for k, v in undisturbed.items() if k in after} == after
            tried, finished = sum(map(len, attempts.values())) - began, len(after) - len(before)
            assert 0 <= tried - finished <= 1, "only what was in flight is lost"
            began, lost, before = began + tried, lost + tried - finished, after
        assert before == undisturbed
        assert began == JOBS + lost
        assert all(len(set(tokens)) == len(tokens) for tokens in attempts.values())
        again += lost
        print(f"{kills} kills, {rounds} studies of {JOBS} seeds, {again} seeds in flight trained again", flush=True)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_ends_the_real_program_at_once_with_its_code(tmp_path, number, code):
    program = "import signal; signal.signal(2, signal.default_int_handler); from uard.cli.app import main; main()"
    command = [sys.executable, "-c", program, "reproduce", "scale", "--seeds", "40"]
    log = tmp_path / "log"
    process = subprocess.Popen(
        [*command, "--store", str(tmp_path / "s.sqlite"), "--workers", "2", "--log", str(log)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    while process.poll() is None and not (log.exists() and "seeds done" in log.read_text()):
        time.sleep(0.05)
    os.killpg(process.pid, number)
    out, error = process.communicate(timeout=20)
    assert (process.returncode, out) == (code, "")
    assert "every finished cell is stored, the same command goes on from there" in error
    assert "Traceback" not in error
    with closing(Store(tmp_path / "s.sqlite", readonly=True)) as store:
        assert store.failures() == {}
        assert [(run.ended is not None, run.claimed) for run in store.runs()] == [(True, 0)]
        assert store.count()[1] > 0


def test_two_processes_share_a_study(study, tmp_path, undisturbed):
    both = [study("s.sqlite", 1), study("s.sqlite", 1)]
    answers = [p.communicate(timeout=120) for p in both]
    assert [(p.returncode, error) for p, (_, error) in zip(both, answers, strict=True)] == [(0, ""), (0, "")]
    assert sum(int(out.split()[-1]) for out, _ in answers) == JOBS
    assert all(out.splitlines()[-2].startswith(f"{JOBS} {JOBS} ") or out.split() == ["0"] for out, _ in answers)
    assert blobs(tmp_path / "s.sqlite") == undisturbed
    with closing(Store(tmp_path / "s.sqlite")) as store:
        assert {len(tokens) for tokens in store.attempts().values()} == {1}


def test_what_a_killed_process_had_in_flight_is_taken_over_by_one_that_waits(study, tmp_path, undisturbed):
    first = study("s.sqlite", 1)
    done(first)
    pause(first, tmp_path / "s.sqlite")
    second = study("s.sqlite", 1)
    with closing(Store(tmp_path / "s.sqlite")) as store:
        while store.count()[1] < JOBS - 1:
            assert second.poll() is None
            time.sleep(0.05)
        assert store.claimed() != {}, "the stopped one lives, and nobody takes its work"
        first.kill()
        first.wait()
        out, error = second.communicate(timeout=60)
        assert (second.returncode, error) == (0, "")
        assert out.split()[-1] != "0"
        assert blobs(tmp_path / "s.sqlite") == undisturbed
        assert sorted(len(tokens) for tokens in store.attempts().values()) == [1] * (JOBS - 1) + [2]


def test_workers_end_with_their_parent(study):
    process = study()
    done(process)
    tasks = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    children = [Path(f"/proc/{pid}/stat") for pid in tasks.read_text().split()]
    assert len(children) >= WORKERS
    process.kill()
    deadline = time.monotonic() + 20
    while any(c.exists() and c.read_text().rpartition(")")[2].split()[0] != "Z" for c in children):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_a_full_disk_loses_nothing_and_the_same_command_goes_on(tmp_path):
    limited = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, 400_000)); "
    program, arguments = "from uard.cli.app import main; main()", ["reproduce", "control", "--seeds", "30"]
    arguments += ["--store", "s.sqlite", "--workers", "1"]
    options = {"cwd": tmp_path, "capture_output": True, "text": True, "check": False}

    first = subprocess.run([sys.executable, "-c", limited + program, *arguments], **options)
    assert (first.returncode, first.stdout) == (2, "")
    assert "store = 's.sqlite': cannot be written (" in first.stderr
    assert "Traceback" not in first.stderr
    kept = blobs(tmp_path / "s.sqlite")
    assert 0 < len(kept) < 120
    again = subprocess.run([sys.executable, "-c", program, *arguments], **options)
    assert again.returncode == 0, again.stderr
    assert f"{120 - len(kept)} runs trained, {len(kept)} were in s.sqlite already" in again.stderr
    assert kept.items() <= blobs(tmp_path / "s.sqlite").items()


def test_the_real_program_killed_again_and_again_ends_as_if_nothing_had_happened():
    """The loop of ``benchmarks/kill_loop.py``, which kills a hundred times, in short."""
    loop = Path(__file__).parents[2] / "benchmarks" / "kill_loop.py"
    command = [sys.executable, str(loop), "--kills", "5", "--seeds", "4"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=500)
    assert done.returncode == 0, done.stdout + done.stderr
