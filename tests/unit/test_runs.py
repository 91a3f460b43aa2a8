"""Many runs in one program: on a CPU one after the other, on a GPU side by side."""

import os
import subprocess
import sys

import jax
import numpy as np
import pytest

from uard.agents.tabular import QLearning
from uard.envs.grids.trapgrid import TrapGrid
from uard.method.mitigations import named
from uard.ratings.panels import PANELS
from uard.training import xla
from uard.training.compiled import runs, tabular

PROGRAM = tabular.Program(episodes=20)
FIELDS = ("log", "steps", "q")


@pytest.fixture(scope="module")
def three():
    grid = TrapGrid(size=4, traps=((1, 2),), horizon=8)
    law = grid.rating_law(PANELS["appendix"], 0.3)
    agent = QLearning(heads=2)
    return [tabular.make_run(grid.task(), law, grid.truth(), agent, named("uard-0.1"), seed) for seed in (0, 1, 2)]


def test_the_program_of_a_gpu_gives_what_the_program_of_a_cpu_gives(three):
    stacked = jax.tree.map(lambda *leaves: np.stack([np.asarray(x, runs.narrow(x)) for x in leaves]), *three)
    together = jax.tree.map(np.asarray, runs.side_by_side(stacked, tabular.train_one, PROGRAM, FIELDS))
    for i, alone in enumerate(runs.train(three, tabular.train_one, PROGRAM, FIELDS, room=3)):
        np.testing.assert_array_equal(together["steps"][i], alone["steps"])
        np.testing.assert_allclose(together["log"][i], alone["log"], rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(together["q"][i], alone["q"], rtol=1e-4, atol=1e-4)
    assert len({x.tobytes() for x in together["q"]}) == 3


def test_a_gpu_gets_its_program(three, monkeypatch):
    asked = []
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    program = runs.side_by_side
    monkeypatch.setattr(runs, "side_by_side", lambda *given: asked.append(given[1:]) or program(*given))
    assert len(runs.train(three, tabular.train_one, PROGRAM, FIELDS, room=3)) == 3
    assert asked == [(tabular.train_one, PROGRAM, FIELDS)]


def test_programs_are_forgotten_before_a_process_has_too_many(monkeypatch):
    cleared = []
    monkeypatch.setattr(xla, "_held", set())
    monkeypatch.setattr(xla, "HELD", 2)
    monkeypatch.setattr(jax, "clear_caches", lambda: cleared.append(set(xla._held)))
    for program in "abacb":
        xla.make_room(program)
    assert cleared == [{"a", "b"}]
    assert xla._held == {"c", "b"}


TRAINED = """
import jax
seen = []
jax.monitoring.register_event_listener(lambda event, **_: seen.append(event.rpartition("/")[2]))
from uard.agents.tabular import QLearning
from uard.envs.grids.trapgrid import TrapGrid
from uard.lab.cell import Cell
from uard.lab.execution import runner
from uard.lab.execution.store import Store
from uard.training import xla
xla._WORTH_KEEPING = 0.0  # on a fast machine, too
runner.run([(Cell(TrapGrid(size=4, traps=((1, 2),), horizon=8), episodes=5), 0)], Store(":memory:"), workers=1)
print(seen.count("cache_hits"), seen.count("cache_misses"))
"""


def test_a_second_process_compiles_nothing(tmp_path):
    env = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"} | {"XDG_CACHE_HOME": str(tmp_path)}

    def trained():
        done = subprocess.run([sys.executable, "-c", TRAINED], env=env, capture_output=True, text=True, check=True)
        return [int(x) for x in done.stdout.split()]

    hits, compiled = trained()
    assert (hits, compiled > 0) == (0, True)
    assert trained() == [compiled, 0]
    (folder,) = (tmp_path / "uard" / "xla").iterdir()
    assert folder.name == xla._processor()


def test_programs_are_not_kept_where_nothing_can_be_written(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    before = jax.config.jax_compilation_cache_dir
    xla.keep_programs()
    assert jax.config.jax_compilation_cache_dir == before
