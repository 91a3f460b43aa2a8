import jax
import numpy as np
import pytest

from uard.agents.tabular import QLearning
from uard.envs.grids.trapgrid import TrapGrid
from uard.method.mitigations import named
from uard.training import xla
from uard.training.compiled import runs as lanes
from uard.training.compiled import tabular as fused

PROGRAM = fused.Program(episodes=20)
FIELDS = ("log", "steps", "q")


@pytest.fixture(scope="module")
def three():
    grid = TrapGrid(size=4, traps=((1, 2),), horizon=8)
    ratings = grid.speech("appendix", 0.3)
    agent = QLearning(heads=2)
    return [fused.make_run(grid.task(), ratings, grid.truth(), agent, named("uard"), seed) for seed in (0, 1, 2)]


def test_the_program_of_a_gpu_gives_what_the_program_of_a_cpu_gives(three):
    stacked = jax.tree.map(lambda *leaves: np.stack([np.asarray(x, lanes.narrow(x)) for x in leaves]), *three)
    abreast = jax.tree.map(np.asarray, lanes.side_by_side(stacked, fused.run, PROGRAM, FIELDS))
    for i, alone in enumerate(lanes.train(three, fused.run, PROGRAM, FIELDS, room=3)):
        np.testing.assert_array_equal(abreast["steps"][i], alone["steps"])
        np.testing.assert_allclose(abreast["log"][i], alone["log"], rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(abreast["q"][i], alone["q"], rtol=1e-4, atol=1e-4)
    assert len({x.tobytes() for x in abreast["q"]}) == 3


def test_a_gpu_gets_its_program(three, monkeypatch):
    asked = []
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    program = lanes.side_by_side
    monkeypatch.setattr(lanes, "side_by_side", lambda *given: asked.append(given[1:]) or program(*given))
    assert len(lanes.train(three, fused.run, PROGRAM, FIELDS, room=3)) == 3
    assert asked == [(fused.run, PROGRAM, FIELDS)]


def test_programs_are_forgotten_before_a_process_has_too_many(monkeypatch):
    cleared = []
    monkeypatch.setattr(xla, "_held", set())
    monkeypatch.setattr(xla, "HELD", 2)
    monkeypatch.setattr(jax, "clear_caches", lambda: cleared.append(set(xla._held)))
    for program in "abacb":
        xla.make_room(program)
    assert cleared == [{"a", "b"}]
    assert xla._held == {"c", "b"}
