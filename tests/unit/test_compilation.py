"""What is compiled, how often, and on which device."""

import os
import subprocess
import sys

import jax
import numpy as np
import pytest

from uard.agents.networks import SINGLE, Network
from uard.agents.policy import PPO
from uard.envs.grids.gaming import AbsentSupervisor, BoatRace
from uard.envs.grids.trapgrid import TrapGrid
from uard.lab.cell import Cell
from uard.method.mitigations import named
from uard.ratings.panels import PANELS
from uard.training import xla
from uard.training.compiled import common, on_policy, runs
from uard.training.feedback.rating_model import RatingModel

AGENT = PPO(network=Network(hidden=8), ensemble=SINGLE, envs=2, rollout=16)
MODEL = RatingModel(members=2, hidden=8, fits=2, batch=16)
PROGRAM = common.Program(episodes=3)

COUNT = """
import sys
import jax
compiled, hits, misses = [], [], []
listen = {"cache_hits": hits, "cache_misses": misses}
jax.monitoring.register_event_listener(lambda event, **_: listen.get(event.rpartition("/")[2], []).append(event))
jax.monitoring.register_event_duration_secs_listener(
    lambda event, _, **__: compiled.append(event) if event.endswith("backend_compile_duration") else None
)
from uard.agents.continuous import sac
from uard.agents.networks import SINGLE, Network
from uard.agents.policy import PPO
from uard.envs.grids.trapgrid import TrapGrid
from uard.envs.locomotion.inverted_pendulum import InvertedPendulum
from uard.lab.cell import Cell
from uard.lab.execution import runner
from uard.lab.execution.store import Store
from uard.method.mitigations import named
from uard.training.feedback.rating_model import RatingModel
from uard.training.feedback.transition_model import TransitionModel
ppo = PPO(network=Network(hidden=8), ensemble=SINGLE, envs=2, rollout=16)
of_steps = TransitionModel(members=2, hidden=8, fits=2, batch=16, capacity=64)
cell = {
    "grid": lambda: Cell(
        TrapGrid(size=3, horizon=8), named("uard"), ppo, episodes=3, rating_model=RatingModel(2, 8, fits=2, batch=16)
    ),
    "rollout": lambda: Cell(InvertedPendulum(horizon=20), named("uard"), ppo, steps=64, rating_model=of_steps),
    "replay": lambda: Cell(
        InvertedPendulum(horizon=20),
        named("uard"),
        sac(network=Network(8), batch=8, warmup=32),
        steps=64,
        rating_model=of_steps,
    ),
}[sys.argv[1]]()
runner.run([(cell, 0)], Store(":memory:"), workers=1)
print(len(compiled), len(hits), len(misses))
"""


@pytest.mark.parametrize("loop", ["grid", "rollout", "replay"])
def test_a_second_process_compiles_nothing(loop, tmp_path):
    env = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"} | {"XDG_CACHE_HOME": str(tmp_path)}

    def trained():
        done = subprocess.run([sys.executable, "-c", COUNT, loop], env=env, capture_output=True, text=True, check=True)
        return [int(x) for x in done.stdout.split()[-3:]]

    programs, _, compiled = trained()
    assert compiled > 0
    assert trained() == [programs, programs, 0]  # each is asked of the disk, and is there


def run_of(environment, panel, seed, **changes):
    world = environment.world(PANELS[panel], noise=0.1 * seed)
    return common.make_run(world, AGENT, named("uard", **changes), seed, rating_model=MODEL)


def test_panels_games_and_numbers_of_a_rule_share_a_program():
    compiled = []

    def listen(event, _, **more):
        if event.endswith("backend_compile_duration") and "one_by_one" in str(more.get("fun_name", "")):
            compiled.append(more)

    several = [
        run_of(TrapGrid(size=3, horizon=8), "main", 0),
        run_of(TrapGrid(size=4, horizon=9), "appendix", 1),
        run_of(BoatRace(horizon=7), "main", 2),
        run_of(AbsentSupervisor(horizon=10), "main", 3, slack=0.2),
    ]
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        for one in several:
            runs.train([one], on_policy.train_one, PROGRAM, ("log", "steps"), 2)
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert len(compiled) == 1
    cells = [
        Cell(TrapGrid(size=3, horizon=8), named("uard"), AGENT, PANELS["main"], rating_model=MODEL),
        Cell(TrapGrid(size=4, horizon=9), named("uard", slack=0.2), AGENT, PANELS["appendix"], rating_model=MODEL),
    ]
    assert len({cell.trainer.program(cell) for cell in cells}) == 1


def test_a_deep_agent_learns_the_same_side_by_side():
    several = [run_of(TrapGrid(size=3, horizon=8), "main", seed) for seed in (0, 1, 2)]
    stacked = jax.tree.map(lambda *leaves: np.stack([np.asarray(x, runs.narrow(x)) for x in leaves]), *several)
    together = runs.side_by_side(stacked, on_policy.train_one, PROGRAM, ("log", "steps"))
    alone = runs.train(several, on_policy.train_one, PROGRAM, ("log", "steps"), 3)
    for i, one in enumerate(alone):
        assert int(together["steps"][i]) == int(one["steps"])
        np.testing.assert_allclose(together["log"][i], one["log"], rtol=1e-4, atol=1e-3)
    assert len({np.asarray(x).tobytes() for x in together["log"]}) == 3


DEVICES = """
import jax
from uard.envs.grids.trapgrid import TrapGrid
from uard.lab.cell import Cell
from uard.lab.execution import runner
from uard.lab.execution.store import Store
import uard.training
if "{n}" == "2":
    jax.config.update("jax_num_cpu_devices", 2)
cell, store = Cell(TrapGrid(size=3, horizon=8), episodes=5), Store(":memory:")
runner.run([(cell, 0)], store, workers=1)
print(len(jax.devices()), store.get(cell, [0])[0].log.sum(0).tolist())
"""


def test_the_device_is_named():
    assert xla.device_name() == f"1 x {jax.devices()[0].device_kind}"


def test_a_second_device_changes_nothing():
    def trained(n):
        env = os.environ | {"JAX_PLATFORMS": "cpu"}
        code = DEVICES.format(n=n)
        done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
        return done.stdout.strip().split(" ", 1)

    (one, alone), (two, both) = trained(1), trained(2)
    assert (one, two) == ("1", "2")
    assert alone == both
