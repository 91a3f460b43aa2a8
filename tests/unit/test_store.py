import re
import signal
import sqlite3
import subprocess
import sys
from contextlib import closing

import numpy as np
import pytest

from uard.envs.grids.trapgrid import TrapGrid
from uard.lab.cell import Cell
from uard.lab.execution import runner
from uard.lab.execution.store import Store, StoreError
from uard.lab.result import CorruptResultError, Result
from uard.lab.study import results_of

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
        assert "that can be written" in str(caught.value)
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
