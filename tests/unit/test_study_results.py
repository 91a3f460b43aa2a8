"""Names that are not there, labels of no row, windows beyond the episodes: each is named, with what is allowed."""

from contextlib import closing

import numpy as np
import pytest

from uard import InvalidValueError
from uard._checks import UnknownNameError
from uard.lab.cell import Cell
from uard.lab.execution.store import MissingSeedsError, Store, StoreError
from uard.lab.result import Result
from uard.lab.study import Study, row
from uard.lab.views.published import Published, extract
from uard.lab.views.study_results import StudyResults

CELLS = [Cell(episodes=20 + i) for i in range(2)]
STUDY = Study("mine", "", "", tuple(row(c, name="a", size=c.episodes) for c in CELLS), curves=("hacks",))


def result(episodes, seed):
    log = np.tile(np.arange(1.0, episodes + 1)[:, None], 6) + seed
    return Result(log, episodes, np.zeros(1), {})


@pytest.fixture
def results():
    with closing(Store(":memory:")) as store:
        store.put([(c, seed, result(c.episodes, seed)) for c in CELLS for seed in (0, 1)])
        yield StudyResults(store, [0, 1], [STUDY])


def test_a_window_is_the_mean_of_its_episodes_first_and_last_included(results):
    assert results.window("mine", "hacks", 3, 5, size=20).per_seed == (4.0, 5.0)
    assert results.window("mine", "hacks", 20, 20, size=20).mean == 20.5


@pytest.mark.parametrize(
    ("first", "last", "says"),
    [
        (0, 5, r"first = 0: must be a whole number in \[1, 5\]"),
        (6, 5, r"first = 6: must be a whole number in \[1, 5\]"),
        (1, 21, r"last = 21: must be a whole number in \[1, 20\]"),
        (1.0, 2, "first = 1.0: must be a whole number"),
    ],
)
def test_a_window_beyond_the_episodes_is_refused(results, first, last, says):
    with pytest.raises(InvalidValueError, match=says):
        results.window("mine", "hacks", first, last, size=20)


def test_names_that_are_not_there_are_named(results):
    published = Published([STUDY], [extract([STUDY], results.store, [0, 1], "by hand")])
    for have in (results, published):
        with pytest.raises(UnknownNameError, match=r"study = 'mien': must be one of mine .did you mean 'mine'"):
            have.get("mien", "hacks", size=20)
        with pytest.raises(UnknownNameError, match=r"metric.* = 'colour': must be one of"):
            have.get("mine", "colour", size=20)
        with pytest.raises(
            InvalidValueError, match=r"metric.* = 'goal_rate': must be 'success_rate', as it is called now"
        ):
            have.get("mine", "goal_rate", size=20)
        for labels in ({"size": 7}, {"name": "a"}, {"colour": 1}):
            with pytest.raises(
                InvalidValueError, match=r"labels = .* exactly one row of the study 'mine'.* name, size"
            ):
                have.get("mine", "hacks", **labels)
    with pytest.raises(InvalidValueError, match=r"column = 'trap_visits': must be 'hacks', as it is called now"):
        results.curves("mine", "trap_visits", size=20)
    with pytest.raises(UnknownNameError, match=r"curves = 'success': must be one of hacks"):
        published.curves(STUDY.rows[0], "success")
    with pytest.raises(LookupError, match=r"was not published"):
        published.curves(row(Cell(episodes=7)), "hacks")
    with pytest.raises(InvalidValueError, match=r"curves\[1\] = 'goal': must be 'success', as it is called now"):
        Study("s", "", "", (), curves=("hacks", "goal"))


def test_seeds_that_are_missing_are_an_error_of_the_store(results):
    with pytest.raises(MissingSeedsError, match=r"seeds \[2\] of this cell are not in the store"):
        StudyResults(results.store, [0, 2], [STUDY]).get("mine", "hacks", size=20)
    assert issubclass(MissingSeedsError, StoreError)
    assert issubclass(MissingSeedsError, LookupError)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"metrics": {"hacks": [1.0]}}, r"metrics.hacks.shape = \(1,\): must be one entry for each of 2 seeds"),
        ({"metrics": {"hacks": [1.0, "x"]}}, "metrics.hacks = .*: must be real numbers"),
        ({"metrics": {"hacks": [1.0, float("nan")]}}, r"metrics.hacks\[1\] = nan: must be finite"),
        ({"metrics": []}, r"metrics = \[\]: must be an object"),
        ({"seeds": 2}, "seeds = 2: must be a list"),
        ({"curves": {"hacks": [1.0, 2.0]}}, r"curves.hacks.shape = \(2,\)"),
    ],
)
def test_published_numbers_that_are_none_are_named(results, change, says):
    data = extract([STUDY], results.store, [0, 1], "by hand")
    data["cells"][CELLS[0].key] |= change
    with pytest.raises(InvalidValueError, match=rf"cells\[{CELLS[0].key}\]\.{says}"):
        Published([STUDY], [data])
