import json
import os
import re
import signal
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from uard import InvalidValueError
from uard.envs.grids.trapgrid import TrapGrid
from uard.lab.cell import Cell
from uard.lab.execution import rows, runner
from uard.lab.execution.claims import Owner
from uard.lab.execution.store import Store, StoreError
from uard.lab.result import CorruptResultError, Result, digest
from uard.lab.study import Row, Study, results_of
from uard.lab.views import leaderboard, status
from uard.lab.views.compare import compare

CELL, OTHER = Cell(episodes=3), Cell(episodes=4)
TINY = Cell(TrapGrid(size=4, traps=((1, 2),), horizon=8), episodes=3)


def result(seed=0, episodes=3):
    rng = np.random.default_rng(seed)
    log, path = rng.normal(size=(episodes, 6)).astype(np.float32), rng.integers(0, 36, 9, np.int32)
    return Result(log, 10 * seed, path, {"calibration": rng.normal(size=4).astype(np.float32)})


def same(one, other):
    return (
        one.steps == other.steps
        and one.extra.keys() == other.extra.keys()
        and all(np.array_equal(one.extra[k], other.extra[k]) for k in one.extra)
        and np.array_equal(one.log, other.log)
        and np.array_equal(one.path, other.path)
    )


@pytest.fixture
def path(tmp_path):
    return tmp_path / "results" / "store.sqlite"


@pytest.fixture
def store(path):
    with closing(Store(path)) as opened:
        yield opened


def raw(path, statement, *values):
    with closing(sqlite3.connect(path)) as db, db:
        return db.execute(statement, values).fetchall()


def corrupt(path, seed):
    ((data,),) = raw(path, "select data from results where seed = ?", seed)
    middle = len(data) // 2
    damaged = data[:middle] + bytes([data[middle] ^ 255]) + data[middle + 1 :]
    raw(path, "update results set data = ? where seed = ?", damaged, seed)


def child(code, *arguments, **options):
    prelude = (
        "import sys, time, numpy as np\n"
        "from uard.lab.cell import Cell\nfrom uard.lab.execution.store import Store\n"
        "from uard.lab.result import Result\n"
        "def result(seed): return Result(np.full((3, 6), seed + 1, np.float32), seed, np.zeros(2, np.int32), {})\n"
        "cell, store = Cell(episodes=3), Store(sys.argv[1])\n"
    )
    command = [sys.executable, "-c", prelude + code, *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)


def test_round_trip(store, path):
    put = {seed: result(seed) for seed in (0, 1, 7)}
    store.put([(CELL, seed, r) for seed, r in put.items()])
    with closing(Store(path)) as again:
        got = again.get(CELL, range(10))
        assert got.keys() == put.keys()
        assert all(same(got[seed], put[seed]) for seed in put)
        assert again.get(CELL, [7]).keys() == {7}
        assert again.metrics(CELL, [1, 7, 9]) == {seed: put[seed].metrics() for seed in (1, 7)}
        assert again.get(OTHER, range(10)) == {}
        assert (again.have(CELL), again.missing(CELL, [2, 7, 1, 3])) == ({0, 1, 7}, [2, 3])
        assert again.count() == (1, 3)
        assert [r.steps for r in results_of(CELL, again, [7, 0])] == [70, 0]


def test_what_is_missing_is_named(store):
    store.put([(CELL, 0, result())])
    with pytest.raises(LookupError, match=r"^seeds \[1, 2\] of this cell are not in the store .*run it again: Cell"):
        results_of(CELL, store, range(3))


def test_a_result_that_is_there_is_not_overwritten(store):
    store.put([(CELL, 0, result(1))])
    store.put([(CELL, 0, result(2)), (CELL, 1, result(3))])
    assert {seed: r.steps for seed, r in store.get(CELL, range(2)).items()} == {0: 10, 1: 30}


def test_memory_keeps_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with closing(Store(":memory:")) as one, closing(Store(":memory:")) as other:
        one.put([(CELL, 0, result())])
        assert (one.count(), other.count()) == ((1, 1), (0, 0))
    assert not any(tmp_path.iterdir())


def test_a_finished_seed_is_never_run_again_and_a_corrupt_one_is(store, path):
    assert runner.run([(TINY, 0)], store, 0) == 1
    assert runner.run([(TINY, 0), (TINY, 0)], store, 0) == 0
    assert runner.run([(TINY, 0), (TINY, 1)], store, 0) == 1
    before = store.get(TINY, [0, 1])
    corrupt(path, 1)
    assert store.missing(TINY, [0, 1]) == [1]
    assert runner.run([(TINY, 0), (TINY, 1)], store, 0) == 1
    assert all(same(r, before[seed]) for seed, r in store.get(TINY, [0, 1]).items())
    assert store.quarantined() == [(TINY.key, 1, "checksum does not match")]


def misstate(path, seed):
    raw(path, "update results set metrics = replace(metrics, '0', '1') where seed = ?", seed)


@pytest.mark.parametrize("damage", [corrupt, misstate])
@pytest.mark.parametrize("ask", [lambda s: s.get(CELL, [0, 1, 2]), lambda s: s.have(CELL)])
def test_a_corrupt_result_is_quarantined_once(store, path, ask, damage):
    store.put([(CELL, seed, result(seed)) for seed in range(3)])
    damage(path, 1)
    assert set(ask(store)) == set(ask(store)) == {0, 2}
    assert store.missing(CELL, range(3)) == [1]
    assert store.quarantined() == [(CELL.key, 1, "checksum does not match")]
    store.put([(CELL, 1, result(1))])
    assert same(store.get(CELL, [1])[1], result(1))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_log_that_is_not_finite_is_refused(store, bad):
    broken = result()
    broken.log[1, 2] = bad
    with pytest.raises(CorruptResultError, match="the log holds NaN or infinity"):
        Result.unpack(*broken.pack())
    store.put([(CELL, 0, broken)])
    assert store.get(CELL, [0]) == {}
    ((key, seed, reason),) = store.quarantined()
    assert (key, seed) == (CELL.key, 0)
    assert re.fullmatch(r"metrics hold \w+ = (nan|inf|-inf): must be a finite number", reason)


def test_bytes_that_are_not_what_was_written_are_refused():
    data, checksum = result().pack()
    for damaged in (data[:-1], b"", data + b"x"):
        with pytest.raises(CorruptResultError, match="checksum does not match"):
            Result.unpack(damaged, checksum)
    assert result().pack() == (data, checksum)


def filled(path, rows=60):
    with closing(Store(path)) as store:
        store.put([(CELL, seed, result(seed, 100)) for seed in range(rows)])
    return path.read_bytes()


def garbage(path):
    path.write_bytes(b"this is no database at all" * 400)


def truncated(path):
    path.write_bytes(filled(path)[:-9000])


def overwritten(path):
    data = filled(path)
    path.write_bytes(data[:4096] + bytes([255]) * 4096 + data[8192:])


def foreign(path):
    raw(path, "create table bookmarks (url text)")


def another_versions(path):
    raw(path, "create table cells (key text)")
    raw(path, "create table results (key text, seed integer, data blob)")


@pytest.mark.parametrize("make", [garbage, truncated, overwritten, foreign, another_versions])
def test_a_file_that_is_no_sound_store_is_named_and_left_alone(tmp_path, make):
    path = tmp_path / "s.sqlite"
    make(path)
    before = path.read_bytes()
    with pytest.raises(StoreError) as caught:
        Store(path)
    message = str(caught.value)
    assert message.startswith(f"store = {str(path)!r}: must be a result store, but ")
    assert message.endswith("Move the file aside and start again, or take another store")
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["s.sqlite"]


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("mine")
    for path in (tmp_path, tmp_path / "file" / "s.sqlite", tmp_path / "file" / "deeper" / "s.sqlite"):
        with pytest.raises(StoreError) as caught:
            Store(path)
        assert str(caught.value).startswith(f"store = {str(path)!r}: must be ")
        assert re.search("that can be written|a file, not a folder", str(caught.value))
    assert (tmp_path / "file").read_text() == "mine"


def test_an_empty_file_becomes_a_store(tmp_path):
    path = tmp_path / "s.sqlite"
    path.touch()
    filled(path, 1)
    assert raw(path, "select count(*) from results") == [(1,)]


def test_a_full_disk_loses_nothing_that_was_stored(store):
    store.put([(CELL, 0, result())])
    (pages,) = store._db.execute("pragma page_count").fetchone()
    store._db.execute(f"pragma max_page_count = {pages}")
    with pytest.raises(StoreError, match=r"cannot be written \(.*full\); what was finished before is safe"):
        store.put([(OTHER, seed, result(seed, 100)) for seed in range(20)])
    assert (store.have(CELL), store.have(OTHER)) == ({0}, set())


def test_two_stores_on_one_file_see_each_other(store, path):
    with closing(Store(path)) as other:
        for seed in range(10):
            (store, other)[seed % 2].put([(CELL, seed, result(seed))])
            assert store.have(CELL) == other.have(CELL) == set(range(seed + 1))


def test_two_processes_lose_nothing(path):
    code = "for s in range(40): store.put([(cell, s * 2 + int(sys.argv[2]), result(s)), (cell, 1000 + s, result(s))])"
    writers = [child(code, path, parity) for parity in (0, 1)]
    assert [(w.communicate()[1], w.returncode) for w in writers] == [("", 0)] * 2
    with closing(Store(path)) as store:
        assert store.get(CELL, range(80)).keys() == set(range(80))
        assert store.have(CELL) == {*range(80), *range(1000, 1040)}


def test_a_process_killed_while_it_writes_leaves_nothing_half_written(path):
    code = """
store.put([(cell, 0, result(0))])
def slowly():
    yield cell, 1, result(1)
    yield cell, 2, result(2)
    print("writing", flush=True)
    time.sleep(60)
store.put(slowly())
"""
    writer = child(code, path)
    assert writer.stdout.readline() == "writing\n"
    writer.send_signal(signal.SIGKILL)
    writer.communicate()
    with closing(Store(path)) as store:
        assert store.have(CELL) == store.get(CELL, range(3)).keys() == {0}
        store.put([(CELL, 1, result(1))])
        assert store.have(CELL) == {0, 1}
        assert store.quarantined() == []


def tampered(path, metrics, **columns):
    """Change a result and give it the checksum of what it then is."""
    ((key, data, version, created),) = raw(path, "select key, data, version, created from results where seed = 1")
    row = {"data": data, "version": version, "created": created, "metrics": json.dumps(metrics)} | columns
    row["checksum"] = rows.checksum_of(key, 1, row["data"], row["metrics"])
    raw(path, f"update results set {', '.join(f'{name} = ?' for name in row)} where seed = 1", *row.values())


GOOD = result(1).metrics()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"metrics": {}}, "must be JSON with a number for each metric"),
        ({"metrics": [1]}, "must be JSON with a number for each metric"),
        ({"metrics": GOOD | {"hacks": "6.29"}}, "metrics hold hacks = '6.29': must be a finite number"),
        ({"metrics": GOOD | {"true_return": float("nan")}}, "metrics hold true_return = nan: must be a finite number"),
        ({"metrics": GOOD | {"true_return": True}}, "metrics hold true_return = True: must be a finite number"),
        ({"metrics": GOOD | {"episode_length": 0.0}}, "episode_length = 0"),
        ({"metrics": GOOD, "created": 1e18}, "created = 1e+18: must be a finite number in [0, "),
        ({"metrics": GOOD, "created": -1.0}, "created = -1.0: must be a finite number in [0, "),
        ({"metrics": GOOD, "version": b"\xff"}, "version = b'\\xff': must be text"),
        ({"metrics": GOOD, "data": b"short"}, "it is no packed result"),
    ],
)
def test_a_row_that_is_readable_but_means_nothing_is_named_everywhere(store, path, change, says):
    store.put([(CELL, seed, result(seed)) for seed in range(3)])
    tampered(path, **change)
    with closing(Store(path, readonly=True)) as read:
        assert read.get(CELL, range(3)).keys() == {0, 2}
        (damaged,) = read.damaged
        assert (damaged.key, damaged.seed) == (CELL.key, 1)
        assert says in damaged.reason
        assert [x.seeds for x in leaderboard.lines(read)] == [3 if "data" in change else 2]
        study = Study("s", "", "", (Row((), CELL),))
        found = status.status(read, [study])
        assert found.studies[0].finished == (3 if "data" in change else 2)
        assert said_of(found) == [f"  cell {CELL.key}, seed 1: {damaged.reason}"]
        assert read.quarantined() == []
    assert store.get(CELL, range(3)).keys() == {0, 2}
    assert [(key, seed) for key, seed, _ in store.quarantined()] == [(CELL.key, 1)]


def said_of(found):
    return status.said_of_damaged(found.damaged)[1:]


def test_a_result_of_another_seed_or_cell_is_not_taken_for_this_one(store, path):
    store.put([(CELL, 0, result(0)), (OTHER, 5, result(5))])
    raw(path, "update results set seed = 1 where seed = 0")
    raw(path, "update results set key = ? where seed = 5", CELL.key)
    with closing(Store(path, readonly=True)) as read:
        assert read.cells() == []
        assert {d.reason for d in read.damaged} == {"checksum does not match"}
    assert (store.have(CELL), store.have(OTHER)) == (set(), set())


def test_rows_from_before_the_checksum_covered_key_and_seed_are_read(store, path):
    store.put([(CELL, 0, result(0))])
    ((data, metrics),) = raw(path, "select data, metrics from results")
    raw(path, "update results set checksum = ?", digest(data + metrics.encode()))
    assert same(store.get(CELL, [0])[0], result(0))


def test_a_configuration_that_its_key_is_not_of_shows_no_numbers_and_is_mended_when_the_cell_is_trained(store, path):
    store.put([(CELL, 0, result(0))])
    raw(path, "update cells set config = replace(config, '\"noise\": 0.0', '\"noise\": 9.0')")
    with closing(Store(path, readonly=True)) as read:
        assert (read.cells(), read.configs()) == ([], {})
        assert [(d.key, d.seed) for d in read.damaged] == [(CELL.key, None)]
        with pytest.raises(InvalidValueError, match="in common"):
            compare(read, store)
    store.put([(CELL, 1, result(1))])
    assert store.configs() == {CELL.key: CELL.config()}


@pytest.mark.parametrize(
    ("table", "column", "value"), [("runs", "began", "soon"), ("runs", "pid", -1), ("failures", "created", 1e18)]
)
def test_a_damaged_row_about_work_is_named(store, path, table, column, value):
    owner = Owner.here()
    store.begin(owner, 1)
    store.fail([(CELL, 3)], "ValueError: no", owner)
    owner.stop()
    raw(path, f"update {table} set {column} = ?", value)
    with pytest.raises(StoreError, match=rf"table {table}, row .*: {column} = .*: must be .*; delete that row"):
        status.status(store, [])


def test_looking_leaves_nothing_behind(path):
    before = filled(path, 3)
    with closing(Store(path, readonly=True)) as store:
        assert store.have(CELL) == {0, 1, 2}
        with pytest.raises(StoreError, match="cannot be written"):
            store.put([(CELL, 9, result())])
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_what_a_writer_has_in_its_log_is_seen(store, path):
    store.put([(CELL, 0, result())])
    with closing(Store(path, readonly=True)) as read:
        assert read.have(CELL) == {0}
        store.put([(CELL, 1, result())])
        assert read.have(CELL) == {0, 1}


READ = """
import os, sys
from contextlib import closing
from uard.lab.cell import Cell
from uard.lab.execution import runner
from uard.lab.execution.store import Store, StoreError

if os.getuid() == 0:
    os.setgid(65534)
    os.setuid(65534)
cell = Cell(episodes=3)
for readonly in (True, False):
    with closing(Store(sys.argv[1], readonly=readonly)) as store:
        print(sorted(store.have(cell)), runner.run([(cell, 0), (cell, 1)], store))
        try:
            runner.run([(cell, 7)], store)
        except StoreError as error:
            print("cannot be written" in str(error))
"""


@pytest.mark.parametrize("left", ["nothing", "wal", "wal and shm"])
def test_a_store_in_a_read_only_place_is_read(tmp_path, left):
    """Permissions do not bind root, who therefore looks as somebody else."""
    path = tmp_path / "s.sqlite"
    filled(path, 1)
    with closing(Store(path)) as store:
        store.put([(CELL, 1, result(1, 100))])
        folder = tmp_path / "closed"
        folder.mkdir()
        for suffix in {"nothing": ("",), "wal": ("", "-wal"), "wal and shm": ("", "-wal", "-shm")}[left]:
            (folder / f"s.sqlite{suffix}").write_bytes(Path(f"{path}{suffix}").read_bytes())
    if left == "nothing":  # it was closed, and everything is in the file
        (folder / "s.sqlite").write_bytes(path.read_bytes())
    names = sorted(p.name for p in folder.iterdir())
    for file in (*folder.iterdir(), folder):
        file.chmod(0o555 if file is folder else 0o444)
    opened = [p for p in (tmp_path, *tmp_path.parents) if not p.stat().st_mode & 1]
    for parent in opened:
        parent.chmod(parent.stat().st_mode | 1)
    try:
        command = [sys.executable, "-c", READ, str(folder / "s.sqlite")]
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ | {"TMPDIR": "/tmp"})
    finally:
        for parent in opened:
            parent.chmod(parent.stat().st_mode & ~1)
        folder.chmod(0o755)
    assert (done.returncode, done.stdout) == (0, "[0, 1] 0\nTrue\n" * 2), done.stderr
    assert sorted(p.name for p in folder.iterdir()) == names
