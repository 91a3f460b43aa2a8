"""A row of a store that was changed in any way gives what was written, or is named as damaged: never another number."""

from __future__ import annotations

import json
import sqlite3
import zlib
from contextlib import closing

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uard.lab.cell import Cell
from uard.lab.execution.claims import Owner
from uard.lab.execution.store import Store, StoreError
from uard.lab.result import CorruptResultError, Result
from uard.lab.study import Row, Study
from uard.lab.views import leaderboard, status

CELLS = [Cell(episodes=3 + i) for i in range(2)]
STUDY = Study("s", "S", "", tuple(Row((("n", c.episodes),), c) for c in CELLS))
COLUMNS = ("key", "seed", "data", "checksum", "metrics", "version", "created")


def result(seed):
    log = np.random.default_rng(seed).uniform(1, 9, (3, 6)).astype(np.float32)
    return Result(log, 30, np.zeros(2, np.int32), {"calibration": log[:2, 0]})


RESULTS = {(cell.key, seed): result(10 * i + seed) for i, cell in enumerate(CELLS) for seed in range(3)}
METRICS = {place: r.metrics() for place, r in RESULTS.items()}


@pytest.fixture(scope="module")
def filled(tmp_path_factory):
    path = tmp_path_factory.mktemp("store") / "s.sqlite"
    with closing(Store(path)) as store:
        store.put([(cell, seed, RESULTS[cell.key, seed]) for cell in CELLS for seed in range(3)])
        owner = Owner.here()
        store.begin(owner, 2)
        store.claim([(CELLS[0], 7)], owner)
        store.fail([(CELLS[0], 8)], "ValueError: no", owner)
        owner.stop()
    return path


@pytest.fixture(scope="module")
def copy(filled, tmp_path_factory):
    """Returns a store that is as it was written, but for what one statement changed."""
    path = tmp_path_factory.mktemp("changed") / "s.sqlite"

    def make(statement, *values):
        for suffix in ("", "-wal", "-shm"):
            path.with_name(path.name + suffix).unlink(missing_ok=True)
        path.write_bytes(filled.read_bytes())
        with closing(sqlite3.connect(path)) as db, db:
            db.execute(f"update or ignore {statement}", values)
        return path

    return make


def look(path):
    """Read in all ways; whatever is read is what was written, or missing, or the error is a named one."""
    with closing(Store(path, readonly=True)) as store:
        try:
            found = status.status(store, [STUDY])
            status.lines(found.runs)
            status.said_of_damaged(found.damaged)
            json.dumps(status.as_data(found), allow_nan=False)
        except StoreError as error:
            assert f"store = {str(path)!r}" in str(error)  # noqa: PT017
        try:
            lines = leaderboard.lines(store)
        except StoreError:
            lines = []
        for line in lines:
            if line.seeds == 3:
                assert line.true.mean in [np.mean([METRICS[c.key, s]["true_return"] for s in range(3)]) for c in CELLS]
        for cell in CELLS:
            check(store, cell)
        assert len(store.damaged) <= 1
    with closing(Store(path)) as store:
        for cell in CELLS:
            assert store.have(cell) == set(check(store, cell))
            lost = store.missing(cell, range(3))
            store.put([(cell, seed, RESULTS[cell.key, seed]) for seed in lost])
            assert sorted(check(store, cell)) == [0, 1, 2], "what was damaged can be trained again"


def check(store, cell):
    found = store.get(cell, range(20))
    for seed, r in found.items():
        assert r.pack() == RESULTS[cell.key, seed].pack()
    for seed, metrics in store.metrics(cell, range(20)).items():
        assert metrics == METRICS[cell.key, seed]
    sound, _ = store.stored(cell.key)
    assert sound.keys() >= found.keys()
    return found


anything = st.one_of(
    st.none(),
    st.integers(-(2**63), 2**63 - 1),
    st.floats(allow_nan=False),
    st.text(max_size=20),
    st.binary(max_size=20),
    st.sampled_from(["{}", "[]", "NaN", '{"hacks": 1}', "[" * 5000, CELLS[0].key, CELLS[1].key, 0, 1, 2, 1e18]),
)


@given(column=st.sampled_from(COLUMNS), row=st.integers(1, 6), value=anything)
def test_a_column_that_was_replaced(copy, column, row, value):
    look(copy(f"results set {column} = ? where rowid = ?", value, row))


@given(column=st.sampled_from(["data", "metrics", "checksum"]), row=st.integers(1, 6), data=st.data())
def test_a_byte_that_was_flipped(copy, filled, column, row, data):
    with closing(sqlite3.connect(filled)) as db:
        ((kind, raw),) = db.execute(
            f"select typeof({column}), cast({column} as blob) from results where rowid = ?", [row]
        )
    place, bits = data.draw(st.integers(0, len(raw) - 1)), data.draw(st.integers(1, 255))
    changed = raw[:place] + bytes([raw[place] ^ bits]) + raw[place + 1 :]
    look(copy(f"results set {column} = cast(? as {kind}) where rowid = ?", changed, row))


@given(column=st.sampled_from(["key", "config"]), row=st.integers(1, 2), value=anything)
def test_a_configuration_that_was_replaced(copy, column, row, value):
    look(copy(f"cells set {column} = ? where rowid = ?", value, row))


@given(table=st.sampled_from(["runs", "failures", "claims"]), place=st.integers(0, 11), value=anything)
def test_what_is_said_of_work_that_was_replaced(copy, filled, table, place, value):
    with closing(sqlite3.connect(filled)) as db:
        columns = [row[1] for row in db.execute(f"pragma table_info({table})")]
    look(copy(f"{table} set {columns[place % len(columns)]} = ?", value))


@given(data=st.binary(max_size=60) | st.binary(max_size=60).map(zlib.compress))
def test_bytes_that_are_no_result_are_named(data):
    with pytest.raises(CorruptResultError):
        Result.unpack(data)
