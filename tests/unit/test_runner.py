import importlib
import multiprocessing
import os
import signal
import subprocess
import sys
from dataclasses import dataclass, replace
from itertools import pairwise
from types import SimpleNamespace

import pytest

from uard import LearningSignal, Mitigation
from uard.agents.tabular import QLearning
from uard.envs.grids.trapgrid import TrapGrid, paper_grid
from uard.lab.cell import Cell
from uard.lab.execution import runner
from uard.lab.execution.batching import batches, shape_of
from uard.lab.execution.runner import StudyFailedError, run
from uard.lab.execution.store import Store
from uard.lab.execution.training import train_batch
from uard.method.mitigations import named
from uard.ratings.panels import PANELS

GRID = TrapGrid(size=4, traps=((1, 2),), horizon=8)
USERS = """
import os
from dataclasses import dataclass
from uard import LearningSignal, Mitigation

@dataclass(frozen=True)
class Raises(Mitigation):
    def signal(self, evidence, usual):
        raise RuntimeError("I do not like this reward")

@dataclass(frozen=True)
class Dies(Mitigation):
    def signal(self, evidence, usual):
        os._exit(41)

@dataclass(frozen=True)
class Divides(Mitigation):
    by: float = 1.0

    def signal(self, evidence, usual):
        return LearningSignal(evidence.reward / self.by - (self.by - self.by) / self.by, 1.0)
"""


def cell(mitigation, episodes=30, **changes):
    return Cell(replace(GRID, **changes), mitigation, QLearning(heads=2), episodes=episodes)


def same(one, other):
    return one.steps == other.steps and one.pack() == other.pack()


@pytest.fixture(scope="module")
def users(tmp_path_factory):
    """Two modules as users write them; workers can import the first and not the second."""
    folder = tmp_path_factory.mktemp("users")
    (folder / "users_here.py").write_text(USERS)
    (folder / "gone").mkdir()
    (folder / "gone" / "users_gone.py").write_text(USERS)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        here = importlib.import_module("users_here")
        with patch.context() as inner:
            inner.syspath_prepend(folder / "gone")
            gone = importlib.import_module("users_gone")
        yield SimpleNamespace(here=here, gone=gone)


@pytest.fixture(scope="module")
def good(users):
    """Jobs of three programs, the second of two horizons."""
    mitigations = (named("raw"), users.here.Divides(), users.here.Divides(2.0), named("lcb"))
    cells = [*(cell(m) for m in mitigations), cell(users.here.Divides(), horizon=6)]
    return [(c, seed) for c in cells for seed in (0, 1)]


@pytest.fixture(scope="module")
def calm(good):
    """Everything good, trained in this process."""
    store, seen = Store(":memory:"), []
    trained = run([*good, *good], store, workers=0, progress=lambda *x: seen.append(x[:2]))
    yield SimpleNamespace(store=store, trained=trained, seen=seen)
    store.close()


@pytest.fixture(scope="module")
def wreck(users, good):
    """Everything good and everything bad, trained by two processes; the longest, which come first, kill them."""

    @dataclass(frozen=True)
    class Local(Mitigation):
        def signal(self, evidence, usual):
            return LearningSignal(evidence.reward, 1.0)

    bad = {
        "dies": [(cell(users.here.Dies(), episodes=90), 0), (cell(users.here.Dies(), episodes=80), 1)],
        "gone": [(cell(users.gone.Divides()), 0)],
        "raises": [(cell(users.here.Raises()), 0), (cell(users.here.Raises()), 1)],
        "diverges": [(cell(users.here.Divides(0.0)), 1)],
    }
    every, local = [job for jobs in bad.values() for job in jobs], [(cell(Local()), 0)]
    store, seen = Store(":memory:"), []
    with pytest.raises(StudyFailedError) as caught:
        run([*bad["dies"], *every, *good, *local], store, 2, lambda *x: seen.append(x[:2]))
    yield SimpleNamespace(store=store, error=caught.value, bad=bad, every=every, local=local, seen=seen)
    store.close()


def errors_of(wreck, kind):
    found = [f for f in wreck.error.failures if set(f.jobs) & set(wreck.bad[kind])]
    assert sorted((job for f in found for job in f.jobs), key=str) == sorted(wreck.bad[kind], key=str)
    return [f.error for f in found]


def test_batches_hold_every_job_once_and_one_program_each():
    cells = [
        Cell(paper_grid(size, horizon=t), named(name, **changes), noise=noise)
        for size, t in ((6, 40), (8, 40), (10, 80))
        for name, changes in (
            ("raw", {}),
            ("uard-0.1", {}),
            ("uard-0.1", {"kappa": 3.0}),
            ("uard-0.1", {"anchor": "zero"}),
        )
        for noise in (0.0, 1.0)
    ]
    jobs = list(dict.fromkeys((c, seed) for seed in range(5) for c in cells))
    made = batches(jobs, largest=8)
    assert sorted((j for b in made for j in b), key=str) == sorted(jobs, key=str)
    assert max(map(len, made)) == 8
    assert all(len({shape_of(c) for c, _ in batch}) == 1 for batch in made)
    assert len({shape_of(c)[0] for c in cells}) == 3
    work = [shape_of(b[0][0])[1] * len(b) for b in made]
    assert work == sorted(work, reverse=True)
    assert batches([]) == []


@pytest.mark.parametrize("size", [1, 3, 64])
def test_batches_are_no_larger_than_asked(size):
    jobs = [(cell(named("raw")), seed) for seed in range(10)]
    assert [len(b) for b in batches(jobs, size)] == [size] * (10 // size) + [10 % size] * (10 % size > 0)


@pytest.mark.parametrize(
    ("changes", "shared"),
    [
        ({"noise": 1.0}, True),
        ({"panel": PANELS["appendix"]}, True),
        ({"panel": PANELS["single"]}, False),
        ({"mitigation": named("uard-0.1", lam=9.0, kappa=0.0)}, True),
        ({"mitigation": named("uard-0.1", lam=9)}, True),
        ({"mitigation": named("uard-0.1", backup="consistent")}, False),
        ({"environment": TrapGrid(10)}, True),
        ({"environment": TrapGrid(30)}, False),
        ({"agent": QLearning(gamma=0.5)}, True),
        ({"agent": QLearning(epsilon=0)}, True),
        ({"agent": QLearning(heads=3)}, False),
        ({"episodes": 10}, False),
        ({"snapshots": 2}, False),
    ],
)
def test_numbers_share_a_program_and_shapes_do_not(changes, shared):
    base = Cell(mitigation=named("uard-0.1"))
    assert (shape_of(base.with_(**changes))[0] == shape_of(base)[0]) == shared


def test_doubles_are_trained_once_and_what_is_there_not_again(calm, good):
    assert calm.trained == len(good)
    assert calm.store.count() == (5, 10)
    assert run(good, calm.store, workers=2) == 0
    assert run([], calm.store) == 0


def test_results_do_not_depend_on_processes_or_company(calm, wreck, good):
    for c, seed in good:
        assert same(calm.store.get(c, [seed])[seed], wreck.store.get(c, [seed])[seed])
    (alone,) = train_batch(good[3:4])
    assert same(alone, calm.store.get(good[3][0], [1])[1])


def test_seeds_differ(calm, good):
    for c, _ in good:
        first, second = calm.store.get(c, [0, 1]).values()
        assert not same(first, second)


def test_progress_only_grows_and_reaches_the_total(calm, wreck, good):
    for seen, total in ((calm.seen, len(good)), (wreck.seen, len(good) + 7)):
        assert seen[0] == (0, total)
        assert seen[-1] == (total, total)
        assert all(a < b for (a, _), (b, _) in pairwise(seen))
        assert {t for _, t in seen} == {total}


def test_all_that_can_be_stored_is_stored(wreck, good):
    for c, seed in [*good, *wreck.local]:
        assert wreck.store.have(c) >= {seed}
    for c, seed in wreck.every:
        assert seed not in wreck.store.have(c)


def test_a_process_that_dies_is_reported(wreck):
    assert errors_of(wreck, "dies") == ["the worker process died (exit code 41), out of memory perhaps"] * 2


def test_a_mitigation_that_raises_is_reported(wreck):
    (error,) = errors_of(wreck, "raises")
    assert "RuntimeError: I do not like this reward" in error


def test_a_run_that_diverges_is_reported_alone(wreck):
    (error,) = errors_of(wreck, "diverges")
    assert "FloatingPointError: training diverged: NaN or infinity in the values or the log of Cell(" in error
    assert "Divides(by=0.0)" in error


def test_a_class_that_workers_cannot_import_is_reported(wreck):
    (error,) = errors_of(wreck, "gone")
    assert "ModuleNotFoundError: No module named 'users_gone'" in error


def test_the_message_names_the_first_cell_and_how_many_are_lost(wreck):
    text = str(wreck.error)
    assert text.startswith("6 seeds failed, the rest is stored; first: Cell(environment=TrapGrid(size=4,")
    assert str(wreck.error.failures[0].jobs[0][0].mitigation) in text


@pytest.mark.parametrize("name", ["Raises", "Divides"])
def test_failures_in_this_process(users, name):
    bad = getattr(users.here, name)(*[0.0] * (name == "Divides"))
    store = Store(":memory:")
    jobs = [(cell(bad), 0), (cell(users.here.Divides()), 0)]
    for attempt in (1, 2):
        with pytest.raises(StudyFailedError, match=rf"^1 seeds? failed, .*{name}\(") as caught:
            run(jobs[:attempt], store, workers=0)
        assert caught.value.failures[0].jobs == (jobs[0],)
    assert store.count() == (1, 1)
    with pytest.raises((RuntimeError, FloatingPointError)):
        train_batch(jobs[:1])
    store.close()


INTERRUPTED = """
import sys
from uard.lab.execution import runner
from uard.lab.execution.store import Store
from test_runner import walks

if __name__ == "__main__":
    try:
        runner.run(walks(), Store(sys.argv[1]), 2, lambda done, *_: print(done, flush=True))
    except KeyboardInterrupt:
        sys.exit(130)
"""


def walks(n=16):
    """One batch each, of one program: episodes that last until a random walker stumbles upon the goal."""
    walker = QLearning(heads=1, epsilon=1.0, epsilon_decay=1.0, epsilon_min=1.0)
    return [(Cell(TrapGrid(10, horizon=5000 + i), agent=walker, episodes=500), 0) for i in range(n)]


def test_an_interrupt_loses_nothing_that_was_finished(tmp_path):
    (tmp_path / "script.py").write_text(INTERRUPTED)
    path = os.pathsep.join([str(tmp_path), os.path.dirname(__file__), *sys.path])
    process = subprocess.Popen(
        [sys.executable, "script.py", "s.sqlite"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    while (done := int(process.stdout.readline())) < 3:
        pass
    os.killpg(process.pid, signal.SIGINT)
    rest, errors = process.communicate(timeout=30)
    assert (process.returncode, errors) == (130, "")
    jobs = walks()
    finished = [done, *map(int, rest.split())][-1]
    store = Store(tmp_path / "s.sqlite")
    kept = {c: store.get(c, [0])[0] for c, _ in jobs if store.have(c)}
    assert finished <= len(kept) < len(jobs)
    assert run(jobs, store, workers=0) == len(jobs) - len(kept)
    for (c, _), fresh in zip(jobs, train_batch(jobs), strict=True):
        assert same(store.get(c, [0])[0], fresh)
    store.close()


def test_every_core_is_used_if_nothing_is_said(monkeypatch):
    asked = []

    def several(workers, queue, *_):
        asked.append((len(queue), workers))
        yield from ()

    monkeypatch.setattr(runner, "in_processes", several)
    store = Store(":memory:")
    run([(cell(named("raw"), episodes=n), 0) for n in (1, 2)], store)
    store.close()
    assert asked == [(2, 1)] or asked == [(2, min(64, len(os.sched_getaffinity(0))))]


def test_nothing_is_left_running(wreck):
    assert multiprocessing.active_children() == []
