import logging
import tracemalloc
from contextlib import closing

import numpy as np
import pytest

from uard import InvalidValueError
from uard.envs.grids.trapgrid import TrapGrid
from uard.lab.cell import Cell
from uard.lab.execution import runner
from uard.lab.execution.claims import Owner
from uard.lab.execution.store import Store, WorkerRun
from uard.lab.result import METRICS, Result
from uard.lab.study import Study, row
from uard.lab.views.status import duration, lines, status, titles
from uard.lab.views.tensorboard import POINTS, Events
from uard.method.mitigations import named
from uard.training.episode_log import LOG

GRID = TrapGrid(size=4, traps=((1, 2),), horizon=8)
STUDY = Study("small", "Small", "", tuple(row(Cell(GRID, named("raw"), episodes=n), episodes=n) for n in (5, 1500)))
OTHER = Study("other", "Other", "", (row(Cell(GRID, named("raw"), episodes=7), episodes=7),))


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    with closing(Store(tmp_path_factory.mktemp("store") / "s.sqlite")) as opened:
        runner.run(STUDY.jobs(range(2)), opened, workers=1)
        yield opened


def test_status_counts_what_is_finished_in_work_failed_and_missing(store):
    (line,) = status(store, [STUDY, OTHER], every=False).studies
    assert (line.name, line.seeds, line.finished, line.claimed, line.failed, line.missing) == ("small", 2, 4, 0, 0, 0)
    owner = Owner.here()
    store.begin(owner, 3)
    cell = STUDY.rows[0].cell
    store.claim([(cell, 2), (cell, 3), (cell, 4)], owner)
    store.fail([(cell, 2)], "Traceback\nValueError: no", owner)
    store.report(owner, 1, 1, 600.0)
    found = status(store, [STUDY, OTHER], seeds=6)
    small, other = found.studies
    assert (small.finished, small.claimed, small.failed, small.missing) == (4, 2, 1, 5)
    assert (other.finished, other.missing, other.last) == (0, 6, None)
    assert small.last is not None
    (failed,) = found.failures
    assert (failed.title, failed.seeds, failed.why.error) == ("small: episodes 5", (2,), "ValueError: no")
    (said,) = (line for line in lines(found.runs, now=found.runs[-1].beat + 60) if "at work" in line)
    assert said.startswith(f"{owner} at work, began ")
    for part in ("; 1 of 3 done; 1 failed; 2 in work; ", "seeds/min; about 9 min left"):
        assert part in said
    owner.stop()
    if owner.place:
        (said,) = (line for line in lines(status(store, [STUDY]).runs) if str(owner) in line and "died" in line)
        assert "; 2 were in work; " in said
        assert status(store, [STUDY]).studies[0].claimed == 0
    store.end(owner)


@pytest.mark.parametrize(("seconds", "text"), [(5, "5 s"), (600, "10 min"), (7200, "2.0 h"), (10 * 86400, "10.0 days")])
def test_durations_are_said_as_people_do(seconds, text):
    assert duration(seconds) == text


def test_tensorboard_reads_what_was_written(store, tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = Events(tmp_path / "tb", titles([STUDY]))
    events.catch_up(store, STUDY.jobs(range(2)))
    written = sorted(p.relative_to(tmp_path / "tb").as_posix() for p in (tmp_path / "tb").glob("*/*"))
    keys = [r.cell.key[:8] for r in STUDY.rows]
    names = [f"small_episodes_{n}-{key}/seed-{s}" for n, key in zip((5, 1500), keys, strict=True) for s in (0, 1)]
    assert written == sorted(names)
    assert not list((tmp_path / "tb").glob(".part*"))
    for r in STUDY.rows:
        result = store.get(r.cell, [1])[1]
        read = EventAccumulator(str(events.place(r.cell, 1)), size_guidance={"scalars": 0})
        read.Reload()
        assert set(read.Tags()["scalars"]) == {
            *(f"metrics/{m}" for m in METRICS),
            *(f"episode/{c}" for c in (*LOG, "alignment_gap")),
        }
        for name, value in result.metrics().items():
            (scalar,) = read.Scalars(f"metrics/{name}")
            assert (scalar.step, scalar.value) == (len(result.log), pytest.approx(value, rel=1e-6))
        curve = read.Scalars("episode/true_return")
        assert len(curve) == min(POINTS, len(result.log))
        assert curve[-1].step == len(result.log)
        parts = np.array_split(result.curve("true_return"), len(curve))
        np.testing.assert_allclose([s.value for s in curve], [p.mean() for p in parts], rtol=1e-5)


def test_a_run_in_tensorboard_is_written_once(store, tmp_path):
    events = Events(tmp_path, {})
    jobs = STUDY.jobs([0])[:1]
    events.catch_up(store, jobs)
    before = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*")}
    Events(tmp_path, {}).catch_up(store, jobs)
    assert {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*")} == before
    assert events.place(*jobs[0]).parent.name == f"TrapGrid_Raw_QLearning-{jobs[0][0].key[:8]}"


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InvalidValueError, match=r"tensorboard = .*file/tb'.*: must be in a folder that can be written"):
        Events(tmp_path / "file" / "tb", {})


def test_without_the_package_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "tensorboard.compat.proto", None)
    with pytest.raises(InvalidValueError, match=r"pip install 'uard\[tensorboard\]'"):
        Events(tmp_path / "tb", {})
    assert not (tmp_path / "tb").exists()


def test_the_library_logs_under_its_name_and_leaves_the_root_alone(tmp_path, caplog):
    root = list(logging.getLogger().handlers), logging.getLogger().level
    with closing(Store(tmp_path / "s.sqlite")) as store, caplog.at_level("INFO", logger="uard"):
        runner.run(OTHER.jobs([0]), store, workers=1)
    assert [r.getMessage() for r in caplog.records] == [
        f"1 of 1 seeds are missing in {tmp_path}/s.sqlite; 1 workers",
        "1 of 1 seeds done",
    ]
    assert all(r.name.startswith("uard.") for r in caplog.records)
    assert (list(logging.getLogger().handlers), logging.getLogger().level) == root


def test_status_counts_a_seed_of_a_thousand_millions_without_listing_them(tmp_path):
    cell, far = STUDY.rows[0].cell, 10**9
    log = np.ones((5, 6), np.float32)
    with closing(Store(tmp_path / "s.sqlite")) as store:
        store.put([(cell, far, Result(log, 5, np.zeros(1), {}))])
        tracemalloc.start()
        (line,) = status(store, [STUDY]).studies
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert (line.seeds, line.finished, line.missing) == (far + 1, 1, 2 * (far + 1) - 1)
    assert peak < 10e6


def test_a_heartbeat_from_the_future_is_said_to_be_one(store):
    run = WorkerRun(Owner("t", "far", "another kernel", 7, 1), 1000.0, 1.9e9, 3, 1, 0, 60.0, None, 1)
    (said,) = lines([run], now=1.9e9 - 3600)
    assert "about 60 s left" in said
    assert "its last heartbeat is 60 min ahead of this machine's clock" in said


def test_a_title_of_long_letters_makes_a_name_that_fits(tmp_path):
    cell = STUDY.rows[0].cell
    place = Events(tmp_path, {cell.key: "長" * 300}).place(cell, 0)
    assert len(place.parent.name.encode()) <= 255
    place.mkdir(parents=True)
