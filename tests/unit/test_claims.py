import os
import secrets
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from uard.lab.cell import Cell
from uard.lab.execution import claims, runner
from uard.lab.execution.claims import LEASE, Owner
from uard.lab.execution.store import Store, StoreError, record_heartbeat
from uard.lab.execution.training import attempt
from uard.lab.result import Result
from uard.lab.trainers.tabular import Tabular

ONE, TWO = Cell(episodes=3), Cell(episodes=4)
JOBS = [(ONE, 0), (ONE, 1), (TWO, 0)]
LINUX = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes can be looked at on Linux only")


def result(steps=1):
    return Result(np.zeros((3, 6), np.float32) + 1, steps, np.zeros(2, np.int32), {})


@pytest.fixture
def path(tmp_path):
    return tmp_path / "s.sqlite"


@pytest.fixture
def store(path):
    with closing(Store(path)) as opened:
        yield opened


@pytest.fixture
def owner():
    made = Owner.here()
    yield made
    made.stop()


@pytest.fixture
def stranger():
    """An owner in a process that has been killed and not been waited for."""
    code = "import time; from uard.lab.execution.claims import Owner; print(repr(Owner.here()), flush=True)"
    code += "; time.sleep(60)"
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    yield process, eval(process.stdout.readline(), {"Owner": Owner})
    process.kill()
    process.communicate()


@LINUX
def test_a_process_is_alive_until_it_is_killed_whatever_its_last_heartbeat(stranger):
    process, other = stranger
    assert other.alive(beat=0)
    assert not replace(other, born=other.born - 1).alive(beat=time.time()), "a later process with the same id"
    process.send_signal(signal.SIGKILL)
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    assert not other.alive(beat=time.time()), "a zombie"
    process.wait()
    assert not other.alive(beat=time.time())


def test_one_that_has_stopped_is_dead_though_its_process_lives(owner):
    assert owner.alive(beat=time.time())
    owner.stop()
    assert not owner.alive(beat=time.time()) or not owner.place


class Clocks:
    """The date and the steady clock of this machine; the first can be set."""

    def __init__(self, monkeypatch):
        self.date, self.steady = 1.8e9, 500.0
        monkeypatch.setattr(claims, "time", SimpleNamespace(time=lambda: self.date, monotonic=lambda: self.steady))

    def wait(self, seconds):
        self.date += seconds
        self.steady += seconds


@pytest.mark.parametrize("place", ["another kernel", ""])
@pytest.mark.parametrize("ahead", [-LEASE + 1, 0, 3600, 86400, 1e9])
def test_elsewhere_one_is_dead_when_its_heartbeat_has_not_changed_whatever_its_clock_said(monkeypatch, place, ahead):
    clocks, far = Clocks(monkeypatch), Owner(secrets.token_hex(), "far", place, 1, 1)
    beat = clocks.date + ahead
    assert far.alive(beat)
    clocks.wait(LEASE - 1 if ahead >= 0 else 0)
    assert far.alive(beat)
    clocks.wait(1)
    assert not far.alive(beat)
    assert far.alive(beat + 15), "it was only slow"
    clocks.wait(LEASE - 1)
    assert far.alive(beat + 15), "whose heart beats, however far its clock is behind"
    clocks.wait(1)
    assert not far.alive(beat + 15)


@pytest.mark.parametrize("jump", [-86400, 86400])
def test_setting_this_clock_while_one_elsewhere_works_neither_ends_nor_revives_it(monkeypatch, jump):
    clocks, far = Clocks(monkeypatch), Owner(secrets.token_hex(), "far", "another kernel", 1, 1)
    start = clocks.date
    for i in range(3):
        assert far.alive(start + 15 * i)
        clocks.wait(15)
    clocks.date += jump
    assert far.alive(start + 30)
    clocks.wait(LEASE)
    assert not far.alive(start + 30)


def test_one_elsewhere_whose_last_heartbeat_is_old_is_dead_at_once(monkeypatch):
    clocks, far = Clocks(monkeypatch), Owner(secrets.token_hex(), "far", "another kernel", 1, 1)
    assert not far.alive(clocks.date - LEASE)


def test_what_is_claimed_is_claimed_once(store, path, owner):
    other = Owner.here()
    with closing(Store(path)) as second:
        store.begin(owner, 3)
        second.begin(other, 3)
        assert store.claim(JOBS[:2], owner) == JOBS[:2]
        assert second.claim(JOBS, other) == JOBS[2:]
        assert store.claim(JOBS, owner) == []
        assert {job: run.owner for job, run in store.claimed().items()} == {
            (ONE.key, 0): owner,
            (ONE.key, 1): owner,
            (TWO.key, 0): other,
        }
        store.put([(ONE, 0, result())])
        assert (ONE.key, 0) not in second.claimed()
        assert second.claim(JOBS[:1], other) == [], "finished"
        store.end(owner)
        assert second.claim(JOBS, other) == [(ONE, 1)]
        assert store.attempts()[ONE.key, 1] == [owner.token, other.token]
        assert [(r.owner, r.claimed) for r in store.runs() if r.ended is None] == [(other, 2)]
    other.stop()


@LINUX
def test_claims_of_the_dead_are_taken_over(store, owner, stranger):
    process, dead = stranger
    store.begin(dead, 3)
    assert store.claim(JOBS, dead) == JOBS
    store.begin(owner, 3)
    assert store.claim(JOBS, owner) == []
    process.kill()
    process.wait()
    assert store.claimed() == {}
    assert store.claim(JOBS[:1], owner) == JOBS[:1]
    third = Owner.here()
    store.begin(third, 2)
    assert {r.owner for r in store.runs() if r.ended is None} == {owner, third}
    assert len(store.claimed()) == 1
    store.put([(ONE, 0, result(1))])
    store.put([(ONE, 0, result(2))])
    assert store.get(ONE, [0])[0].steps == 1, "a late result of a process that counted as dead changes nothing"


def test_a_heartbeat_revives_one_that_counted_as_dead(store, path, owner):
    far = replace(owner, place="another kernel", token="far")
    store.begin(far, 1)
    with closing(sqlite3.connect(path)) as db, db:
        db.execute("update runs set beat = 0 where token = 'far'")
    assert [run.alive for run in store.runs()] == [False]
    store.begin(owner, 1)
    assert far not in [run.owner for run in store.runs() if run.ended is None]
    record_heartbeat(str(path), far)
    assert {run.owner.token: run.alive for run in store.runs()} == {"far": True, owner.token: True}


def test_why_a_seed_failed_is_kept_until_it_is_finished(store, owner):
    store.begin(owner, 3)
    store.claim(JOBS, owner)
    store.fail(JOBS[:2], "Traceback ...\n  in line 3\nValueError: no", owner)
    assert store.failures().keys() == {(ONE.key, 0), (ONE.key, 1)}
    why = store.failures()[ONE.key, 0]
    assert (why.error, why.token) == ("ValueError: no", owner.token)
    assert "in line 3" in why.traceback
    assert store.claimed().keys() == {(TWO.key, 0)}
    store.fail(JOBS[:1], "KeyError: again", owner)
    assert store.failures()[ONE.key, 0].error == "KeyError: again"
    store.put([(ONE, 0, result())])
    assert store.failures().keys() == {(ONE.key, 1)}


def test_a_failure_elsewhere_is_not_repeated_and_an_older_one_is(store, owner):
    store.begin(owner, 1)
    store.fail([(ONE, 0)], "old", owner)
    known = store.failures()
    assert runner._sort_out([(ONE, 0)], store, known) == ([], [(ONE, 0)], {})
    store.fail([(ONE, 0)], "new", owner)
    assert runner._sort_out([(ONE, 0)], store, known) == ([], [], {(ONE, 0): "new"})


def test_one_bad_cell_takes_no_other_of_its_batch_with_it(monkeypatch):
    def train(self, batch, folder):
        if any(cell == TWO for cell, _ in batch):
            raise ValueError("not this one")
        return [result] * len(batch)

    monkeypatch.setattr(Tabular, "train", train)
    answers = attempt(JOBS, None)
    assert [isinstance(a, Result) for a in answers] == [True, True, False]
    assert answers[2].endswith("ValueError: not this one\n")
    assert isinstance(attempt(JOBS[2:], None), str)


def test_reading_makes_no_store(tmp_path):
    for name, why in (("none.sqlite", "a result store, but there is no such file"), (".", "a file.*, not a folder")):
        with pytest.raises(StoreError, match=f"must be {why}"):
            Store(tmp_path / name, readonly=True)
    (tmp_path / "empty").touch()
    with pytest.raises(StoreError, match="it is empty"):
        Store(tmp_path / "empty", readonly=True)
    assert [p.name for p in tmp_path.iterdir()] == ["empty"]


@pytest.mark.parametrize(
    "stop", [SystemExit(0), SystemExit("no"), GeneratorExit(), type("Own", (BaseException,), {})()]
)
def test_what_is_trained_cannot_end_the_study_as_if_all_were_well(monkeypatch, store, stop):
    def train(self, batch, folder):
        def finish():
            raise stop

        if batch[0][0] == TWO:
            raise stop
        return [finish, *[result] * (len(batch) - 1)]

    monkeypatch.setattr(Tabular, "train", train)
    with pytest.raises(runner.StudyFailedError) as caught:
        runner.run(JOBS, store, workers=1)
    assert {job for failure in caught.value.failures for job in failure.jobs} == {(ONE, 0), (TWO, 0)}
    assert store.have(ONE) == {1}
    assert {why.error.partition(":")[0].rpartition(".")[2] for why in store.failures().values()} == {
        type(stop).__name__
    }


def test_an_interrupt_still_ends_the_study(monkeypatch, store):
    def train(self, batch, folder):
        raise KeyboardInterrupt

    monkeypatch.setattr(Tabular, "train", train)
    with pytest.raises(KeyboardInterrupt):
        runner.run(JOBS, store, workers=1)
    assert store.failures() == {}


@pytest.mark.parametrize("log", [np.zeros((0, 6)), np.full((3, 6), np.nan)])
def test_a_result_without_numbers_is_a_failure_and_not_stored(monkeypatch, store, log):
    monkeypatch.setattr(Tabular, "train", lambda self, batch, folder: [lambda: Result(log, 1, np.zeros(2), {})])
    with pytest.raises(runner.StudyFailedError, match=r"enough for one episode|must be a finite number"):
        runner.run(JOBS[:1], store, workers=1)
    assert store.count() == (0, 0)


def test_a_claim_of_a_dead_process_whose_clock_was_ahead_is_taken_over_by_one_that_waits(monkeypatch, store):
    far = Owner("far", "other", "another boot", 1, 1)
    store.begin(far, 1)
    store.claim(JOBS[:1], far)
    store._db.execute("update runs set beat = ?", (time.time() + 86400,))
    store._db.commit()
    monkeypatch.setattr(claims, "LEASE", 1.0)
    monkeypatch.setattr(Tabular, "train", lambda self, batch, folder: [result] * len(batch))
    began = time.monotonic()
    assert runner.run(JOBS[:1], store, workers=1) == 1
    assert 1.0 <= time.monotonic() - began < 10
    assert store.attempts()[ONE.key, 0][0] == "far"
