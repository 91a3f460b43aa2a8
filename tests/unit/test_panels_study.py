"""The study of random panels: lazy rows, what may be tuned on, regret by hand, and what is published of it."""

import json
import subprocess
import sys

import numpy as np
import pytest

from uard import InvalidValueError
from uard.lab import studies
from uard.lab.cell import Cell
from uard.lab.execution.store import Store
from uard.lab.result import Result
from uard.lab.studies.panels import FLOOR, GRIDS, MDPS, ORACLE, OURS, scenario
from uard.lab.study import LazyRows, Study, row
from uard.lab.views import panels
from uard.lab.views.published import Published, cells_of, extract
from uard.lab.views.study_results import StudyResults
from uard.ratings.panels import as_panel, is_for_development, random_panel


def test_rows_are_built_once_and_only_when_one_is_read():
    built = []
    rows = LazyRows(lambda: built.append(1) or (row(Cell(), agent="a"), row(Cell(), agent="b")), count=2)
    assert (len(rows), built) == (2, [])
    assert [r["agent"] for r in rows] == ["a", "b"] == [rows[0]["agent"], rows[-1]["agent"]]
    assert built == [1]
    with pytest.raises(InvalidValueError, match="count"):
        LazyRows(lambda: (), count=1)[0]


def test_registering_and_finding_build_no_random_panel():
    program = (
        "from uard.lab import studies; from uard.ratings import panels; panels.random_panel = None\n"
        "from uard.lab.studies import panels as own; own.scenario = None\n"
        "assert len(studies.find(('panels',))[0].rows) > 3000 and studies.every()"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_what_is_reported_is_never_what_may_be_tuned_on():
    for name, development in (("panels", False), ("panels-development", True)):
        (study,) = studies.find((name,))
        assert study.development is development
        assert {is_for_development(r["scenario"]) for r in study.rows} == {development}
        assert len({r.cell.key for r in study.rows}) == len(study.rows)
    (held_out,) = studies.find(("panels",))
    assert len({(r["tasks"], r["scenario"]) for r in held_out.rows}) == 300


def test_panels_of_mdps_are_of_the_mdps_size():
    assert scenario(MDPS, 7).panel == as_panel("random:7:0.3") == random_panel(7, 0.3) != scenario(GRIDS, 7).panel


@pytest.mark.parametrize("name", ["random:x", "random:-1", "random:7:0", "random:7:-1", "random:7:nan", "random:7:"])
def test_what_names_no_random_panel_is_refused(name):
    with pytest.raises(InvalidValueError, match=r"random:SEED:SCALE"):
        as_panel(name)


def by_hand():
    """Ten scenarios: the oracle 8, the walk -12; ours 7, lcb 3, excess 7 but once 8."""
    returns = {ORACLE: [8.0] * 10, FLOOR: [-12.0] * 10, OURS: [7.0] * 10, "lcb": [3.0] * 10}
    return panels.Regrets.of(GRIDS, range(1, 20, 2), returns | {"excess": [7.0] * 9 + [8.0]})


def test_rivals_by_hand():
    """Regrets .05, .25 and .05 but once 0. Of 2^10 sign patterns two give the sum of ten equal gaps: p near .002."""
    lcb = {r.name: r for r in panels.rivals(by_hand())}["lcb"]
    excess = {r.name: r for r in panels.rivals(by_hand())}["excess"]
    assert lcb.gap.mean == pytest.approx(0.2)
    assert excess.gap.mean == pytest.approx(-0.005)
    assert lcb.p == pytest.approx(2 / 1024, abs=0.0015)
    assert (lcb.corrected, excess.p, excess.corrected) == (pytest.approx(2 * lcb.p), 1.0, 1.0)
    first, kind = panels.losses(by_hand())
    assert (first.kind, first.against, first.where, first.of) == ("no better", "excess", "all panels", 2)
    assert (first.ours.mean, first.theirs.mean) == (pytest.approx(0.05), pytest.approx(0.045))
    assert first.sure == "not told apart, p = 1 of 2 (Holm)"
    assert (kind.where, kind.of) == ("some repeating the proxy (5 scenarios)", 2)


def test_what_is_published_in_brief_gives_the_same_regrets():
    names = {ORACLE: 8.0, FLOOR: -12.0, OURS: 7.0}
    cells = {n: Cell(episodes=20 + i) for i, n in enumerate(names)}
    rows = [row(cell, tasks=GRIDS, scenario=1, mitigation=n) for n, cell in cells.items()]
    study, store = Study("mine", "", "", rows, brief=("true_return", "hacks", "success_rate")), Store(":memory:")
    for name, cell in cells.items():
        log = np.full((cell.episodes, 6), names[name])
        store.put([(cell, seed, Result(log, steps=20, path=np.array([0]), extra={})) for seed in (0, 1)])
    data = json.loads(json.dumps(extract([study], store, [0, 1], "by hand")))
    assert data["cells"] == {}
    assert data["brief"]["cells"][cells[OURS].key][0] == [7.0, 7.0]
    results, published = StudyResults(store, [0, 1], [study]), Published([study], [data])
    for per_seed in (published.per_seed, lambda r, m: results.values(r.cell, m)):
        assert panels.regrets(study, per_seed)[0].regret[OURS].tolist() == pytest.approx([0.05])
    data["brief"]["cells"][cells[OURS].key].pop()
    with pytest.raises(InvalidValueError, match=r"brief.cells\["):
        cells_of(data)
