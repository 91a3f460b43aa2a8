import json
import sqlite3
import zlib
from contextlib import closing

import numpy as np
import pytest

from uard import InvalidValueError
from uard.lab.cell import Cell
from uard.lab.execution.store import Store
from uard.lab.result import METRICS, Result, digest
from uard.lab.views.compare import LEVEL, _tested, as_data, compare, lines, title

CELLS = [Cell(episodes=3 + i) for i in range(4)]


def result(rng, shift=0.0):
    log = rng.normal(10, 1, (3, 6)).astype(np.float32)
    log[:, 1] += shift
    return Result(log, 30, np.zeros(2, np.int32), {})


def filled(path, shift=0.0, stream=0, cells=CELLS, seeds=10):
    store = Store(path)
    rng = np.random.default_rng(stream)
    store.put([(c, s, result(rng, shift)) for c in cells for s in range(seeds)])
    return store


@pytest.fixture
def compared(tmp_path):
    opened = []

    def make(*options):
        opened.extend(filled(tmp_path / f"{i}.sqlite", **o) for i, o in enumerate(options))
        return compare(*opened)

    yield make
    for store in opened:
        store.close()


def test_equal_stores_are_identical(compared):
    found = compared({}, {})
    assert (found.identical, found.differs) == (True, False)
    assert [c.identical for c in found.cells] == [tuple(range(10))] * 4
    assert lines(found)[0] == "4 cells, 40 seeds in both: 40 seeds identical bit by bit, 0 not"
    assert lines(found)[-1] == "verdict: identical"


def test_other_compression_of_the_same_bits_is_no_difference(tmp_path):
    with closing(filled(tmp_path / "a")) as a, closing(filled(tmp_path / "b")) as b:
        db = sqlite3.connect(b.path)
        for key, seed, data, metrics in db.execute("select key, seed, data, metrics from results").fetchall():
            packed = zlib.compress(zlib.decompress(data), 9)
            assert packed != data
            db.execute(
                "update results set data = ?, checksum = ? where key = ? and seed = ?",
                (packed, digest(packed + metrics.encode()), key, seed),
            )
        db.commit()
        db.close()
        assert compare(a, b).identical


def test_another_draw_is_equal_within_noise(compared):
    found = compared({}, {"stream": 1})
    assert (found.identical, found.differs) == (False, False)
    assert all(c.parts == ("log",) and c.identical == () and len(c.effects) == len(METRICS) for c in found.cells)
    assert lines(found)[-1] == "verdict: equal within seed noise"


def test_a_shift_in_one_metric_is_found_and_measured(compared):
    found = compared({}, {"stream": 1, "shift": 3.0})
    assert found.differs
    for cell in found.cells:
        effect = {e.metric: e for e in cell.effects}["true_return"]
        assert effect.difference == pytest.approx(3.0, abs=1.0)
        assert effect.effect == pytest.approx(effect.difference / np.sqrt(1 / 3), rel=0.5)
        assert effect.differs
        assert not {e.metric: e for e in cell.effects}["hacks"].differs
    assert {e.metric for e in found.everywhere if e.differs} >= {"true_return"}
    assert lines(found)[-1] == "verdict: differ"
    assert json.loads(json.dumps(as_data(found), allow_nan=False))["differs"] is True


def test_too_few_seeds_are_said_to_be_too_few(compared):
    found = compared({"seeds": 5}, {"stream": 1, "shift": 50.0, "seeds": 5})
    assert found.least_p == 1 / 16 > LEVEL
    assert not found.differs
    assert "no difference could have been found; 6 seeds of a cell" in " ".join(lines(found))


def test_false_alarms_are_as_rare_as_promised():
    rng, alarms = np.random.default_rng(0), 0
    for _ in range(300):
        pairs = [
            (i, range(7), [[dict(zip("abc", row, strict=True)) for row in rng.normal(size=(7, 3))] for _ in "AB"])
            for i in range(3)
        ]
        effects, everywhere, _ = _tested(pairs)
        alarms += any(e.differs for several in (*effects.values(), everywhere) for e in several)
    assert alarms < 300 * LEVEL + 3 * np.sqrt(300 * LEVEL * (1 - LEVEL))
    assert alarms > 0


def test_a_constant_difference_without_spread_has_no_effect_in_sd():
    rows = [[{"a": v} for _ in range(10)] for v in (1.0, 2.0)]
    ((effect,),) = _tested([(0, range(10), rows)])[0].values()
    assert (effect.difference, effect.effect, effect.differs) == (1.0, None, True)


def test_what_only_one_has_and_what_is_damaged_is_named(compared, tmp_path):
    found = compared({"cells": CELLS[:3]}, {"cells": CELLS[1:], "seeds": 8})
    assert (list(found.only_a), list(found.only_b)) == ([CELLS[0].key], [CELLS[3].key])
    assert [c.seeds for c in found.cells] == [tuple(range(8))] * 2
    with closing(Store(tmp_path / "0.sqlite")) as a, closing(Store(tmp_path / "1.sqlite")) as b:
        with closing(sqlite3.connect(a.path)) as db, db:
            db.execute("update results set metrics = replace(metrics, '1', '2') where seed = 2")
        again = compare(a, b)
        assert {seed for _, _, seed in again.damaged} == {2}
        assert all(2 not in c.seeds for c in again.cells)
        assert len(again.damaged) == 2
        assert "left out, for they are damaged: 2 results" in lines(again)
        assert lines(again)[-1] == "verdict: differ in what can be read"
        assert a.quarantined() == []


def test_what_is_damaged_is_not_called_identical(compared, tmp_path):
    compared({}, {})
    with closing(Store(tmp_path / "0.sqlite")) as a, closing(Store(tmp_path / "1.sqlite")) as b:
        with closing(sqlite3.connect(a.path)) as db, db:
            db.execute("update results set metrics = replace(metrics, '1', '2') where seed = 2")
        again = compare(a, b)
    assert (again.identical, again.differs) == (False, False)
    assert lines(again)[-1] == "verdict: identical in what can be read"


def test_nothing_in_common_is_refused(compared):
    with pytest.raises(InvalidValueError, match="must be one that has a seed of a cell in common with"):
        compared({"cells": CELLS[:1]}, {"cells": CELLS[1:]})


def test_a_cell_of_no_study_has_a_title():
    assert title(CELLS[0].config()) == "TrapGrid, Raw, QLearning, panel main, 3 long"
