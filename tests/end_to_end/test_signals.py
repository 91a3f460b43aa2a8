"""SIGINT and SIGTERM at random moments: each ends the program within five seconds, with its own exit code.

UARD_SIGNALS=30 makes it that many of every kind instead of a few.
"""

import os
import random
import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest

from uard.lab.execution.store import Store

pytestmark = pytest.mark.slow

TIMES = int(os.environ.get("UARD_SIGNALS", "2"))
MOST = 5.0  # seconds
CODES = {signal.SIGTERM: 143, signal.SIGINT: 130}
MAIN = "import signal; signal.signal(2, signal.default_int_handler); from uard.cli.app import main; main()"
COMMANDS = {  # and until when a signal is sent, in seconds
    "compiled rollouts": ("run CartPole --agent ppo --episodes 100000 --seeds 1", 20),
    "physics on the host": (
        "run Hopper --agent ppo --steps 10000000 --seeds 1 --set-agent envs=4 --set-agent rollout=32",
        25,
    ),
    "workers": ("reproduce scale --seeds 100 --workers 2", 15),
}


def start(code, *arguments, **options):
    """Start Python and wait until it has taken SIGTERM into its own hands."""
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        **options,
    )
    status = Path(f"/proc/{process.pid}/status")
    while process.poll() is None:
        caught = next(line for line in status.read_text().splitlines() if line.startswith("SigCgt"))
        if int(caught.split()[1], 16) >> (signal.SIGTERM - 1) & 1:
            break
        time.sleep(0.001)
    return process


def end(process, number, times=1):
    """Send a signal; return exit code, seconds until the end, and what was said."""
    began = time.monotonic()
    for _ in range(times):
        os.killpg(process.pid, number)
        time.sleep(0.1)
    out, error = process.communicate(timeout=30)
    return process.returncode, time.monotonic() - began, out, error


@pytest.mark.parametrize("what", COMMANDS)
def test_at_any_moment_it_ends_within_seconds_with_its_own_code(what, tmp_path):
    command, longest = COMMANDS[what]
    chance = random.Random(what)
    for i in range(TIMES):
        number, delay = chance.choice([*CODES]), chance.uniform(0, longest)
        process = start(MAIN, *command.split(), "--store", f"{i}.sqlite", cwd=tmp_path)
        time.sleep(delay)
        code, seconds, out, error = end(process, number)
        print(f"{what}: {number.name} after {delay:.2f} s: exit code {code} after {seconds:.2f} s", flush=True)
        assert (code, out) == (CODES[number], ""), error
        assert seconds < MOST
        if (tmp_path / f"{i}.sqlite").exists():
            with closing(Store(tmp_path / f"{i}.sqlite")) as store:
                assert store.failures() == {}, "an interrupt is no failure of a seed"
                assert store.claimed() == {}, "the claims of what has ended are free"


SWALLOWED = """
import time
from uard._support import signals
class Loud:
    def __del__(self):
        print("in", flush=True)
        time.sleep(30)  # an exception here is ignored
with signals.ending():
    Loud()
    print("on", flush=True)
    {}
"""
LOOP = "for _ in range(1000): signals.check(); time.sleep(0.01)"
DEAF = "time.sleep(60)"


@pytest.mark.parametrize(
    ("code", "low", "high"),
    [(SWALLOWED.format(LOOP), 0, 1.5), (SWALLOWED.format(DEAF), 1.8, MOST)],
    ids=["a loop that checks", "nobody checks"],
)
def test_an_exception_that_is_swallowed_does_not_lose_the_signal(code, low, high):
    process = start(code)
    assert process.stdout.readline() == "in\n"
    code, seconds, out, error = end(process, signal.SIGTERM)
    assert "Exception ignored in" in error
    assert low < seconds < high
    assert (out, code) == ("on\n", 143 if low else 1)


def test_a_second_signal_ends_it_at_once():
    process = start(SWALLOWED.format(DEAF))
    process.stdout.readline()
    code, seconds, _, error = end(process, signal.SIGTERM, times=2)
    assert (code, seconds < 1.5) == (143, True), error
    assert "terminated, without waiting" in error


def test_an_ignored_signal_stays_ignored():
    code = "import signal, time; signal.signal(2, signal.SIG_IGN); from uard._support import signals\n"
    process = start(code + "with signals.ending(): print(signal.getsignal(2) == signal.SIG_IGN)")
    assert process.communicate(timeout=30) == ("True\n", "")


@pytest.mark.parametrize("number", CODES)
def test_a_page_that_is_served_ends_by_one_signal_without_alarm(number, tmp_path):
    """The server takes the signal, closes, and raises it again: that is no second one of the user's."""
    pytest.importorskip("uvicorn")
    (tmp_path / "texts.jsonl").write_text('{"prompt": "2 + 2", "completion": "4"}\n')
    subprocess.run(
        [sys.executable, "-c", MAIN, "collect", "texts", "texts.jsonl", "sums"],
        cwd=tmp_path,
        check=True,
        capture_output=True,
    )
    process = start(MAIN, "collect", "serve", "sums", "--port", "0", cwd=tmp_path)
    while "Ctrl-C" not in (line := process.stdout.readline()):
        assert line, process.stderr.read()
    code, seconds, _, error = end(process, number)
    assert (code, seconds < MOST) == (CODES[number], True)
    assert error == f"{'terminated' if number is signal.SIGTERM else 'interrupted'}\n"
