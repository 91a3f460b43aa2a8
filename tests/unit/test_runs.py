"""Many runs in one program: on a CPU one after the other, on a GPU side by side."""

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
