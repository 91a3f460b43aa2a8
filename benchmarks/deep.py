"""How fast are the deep agents, and what does a rule cost them? One core, one table.

    python benchmarks/deep.py [--rounds 3] [--steps 3000] [--only PART] [--json FILE]

Deep agents of the 10x10 grid beside Stable-Baselines3 (one update per step, same network and batch); then, of agents on
grids, in reward-gaming gridworlds and in MuJoCo, the raw reward beside the plainest rule that listens (the mean of the
raters, which shows what a model of ratings costs) and beside `uard`. Rounds are interleaved; a number is the median,
with the smallest and the largest; time is that of the processor, so that what else runs on the machine counts little.

*Floor* is the arithmetic over the machine's measured matrix rate: of a network's update; of a rule that listens, the
measured time of the raw agent and the arithmetic of its model of ratings. *First* is the first call, compilation
included: programs are kept on disk, and a second run of the benchmark reads them. The first takes several minutes.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"

import numpy as np

import uard.training  # noqa: F401  (XLA's flags)

HIDDEN, BATCH, BUFFER, TARGET = 64, 64, 10_000, 250
WARMUP = BATCH  # so that of all, few steps are without an update
RULES = ("raw", "mean-of-annotations", "uard")


@dataclass(frozen=True)
class Contender:
    """One row.

    Attributes:
        part: Contenders of a part are compared with its first.
        name: Printed.
        run: Trains for about so many environment steps and gives microseconds per step.
        steps: How many.
        work: FLOPs per step that no program can do without; 0 where nobody has counted them.
        on_top: Whether ``work`` is what comes on top of the part's first.
    """

    part: str
    name: str
    run: Callable[[int], float]
    steps: int
    work: float = 0.0
    on_top: bool = False


def matrix_rate() -> float:
    """Measure the best rate of float32 matrix products of the sizes that matter, FLOP/s."""
    best = 0.0
    for n in (256, 512):
        a = np.random.default_rng(0).normal(size=(n, n)).astype(np.float32)
        for _ in range(5):
            start = time.perf_counter()
            for _ in range(10):
                a @ a
            best = max(best, 10 * 2 * n**3 / (time.perf_counter() - start))
    return best


def flops(features: int, outputs: int, members: int, kind: str) -> float:
    """Arithmetic of one update: online and target forward, and the gradient of the weights and hidden layers.

    ``features`` is 0 where the first layer is looked up.
    """
    wide = members if kind == "full" else 1
    heads = outputs * (members if kind == "shared" else 1)
    first, second, last = features * HIDDEN, HIDDEN * HIDDEN, HIDDEN * heads
    forward = 2 * BATCH * (first + second + last) * wide
    backward = 2 * BATCH * (first + 2 * second + 2 * last) * wide  # no gradient with respect to the observation
    return 2 * forward + backward


def model_flops(fits: int, features: int, actions: int, raters: int, table: bool) -> float:
    """Arithmetic of fitting a model of ratings, per environment step."""
    from uard.training.compiled.common import CHUNK
    from uard.training.feedback.rating_model import REST, RatingModel

    model, width = RatingModel(), actions * (raters + REST)
    if table:  # all states at once: the second layer there, its gradient, and that of the first
        one = 3 * features * model.hidden * width
    else:  # forward twice, the priors' too; backward without a gradient of the observations
        one = model.batch * (3 * features * model.hidden + 4 * model.hidden * width)
    return 2 * model.members * one * fits / CHUNK


def transition_flops(environment: Any, raters: int, every: int = 2048) -> float:
    """The same of the model of ratings in MuJoCo."""
    from uard.training.feedback import transition_model as transitions

    model = transitions.TransitionModel()
    first = transitions.width(environment.features, environment.actions) * model.hidden
    second, last = model.hidden * model.hidden, model.hidden * (raters + 1)
    one = (first + last) + (first + second + last) + (first + 2 * second + 2 * last)
    return 2 * model.members * model.batch * one * model.fits / every


def trained(world: Any, agent: Any, mitigation: str, fits: int = 16) -> Callable[[int], float]:
    """Return a function that trains a compiled agent and gives microseconds per step."""
    from uard.lab.trainers import TRAINERS
    from uard.method.mitigations import named
    from uard.training.compiled import common as deep
    from uard.training.compiled import runs
    from uard.training.feedback.rating_model import RatingModel

    trainers: tuple[Any, ...] = tuple(TRAINERS)
    (loop,) = {t.loop() for t in trainers if hasattr(t, "loop") and agent.family in t.families}
    model = None if mitigation == "raw" else RatingModel(fits=fits)
    one = deep.make_run(world, agent, named(mitigation), 0, rating_model=model)

    def run(steps: int) -> float:
        start = time.process_time()
        (out,) = runs.train([one], loop, deep.Program(10**6 // 100, steps), ("steps", "fault"), deep.ROOM)
        return 1e6 * (time.process_time() - start) / float(out["steps"])

    return run


def simulated(environment: Any, agent: Any, mitigation: str) -> Callable[[int], float]:
    """The same on a simulator, physics included; it goes on where the last call ended."""
    from uard.method.mitigations import named
    from uard.training.host.loop import Job
    from uard.training.host.loops import loop_of

    loop = loop_of(Job(environment, agent, named(mitigation), steps=10**7))
    simulator = environment.simulator(loop.copies, 0)
    reached = [loop.start(simulator)]

    def run(steps: int) -> float:
        state = reached.pop()
        start, before = time.process_time(), int(state.steps)
        while int(state.steps) - before < steps:
            state = loop.advance(state, simulator)
        np.asarray(state.sums)
        reached.append(state)
        return 1e6 * (time.process_time() - start) / (int(state.steps) - before)

    return run


def grid_agents(steps: int) -> list[Contender]:
    """DQN on the 10x10 grid: a library, one network, and what ensembles cost."""
    from uard.agents.networks import Ensemble
    from uard.agents.value import DeepQ
    from uard.envs.grids.trapgrid import paper_grid
    from uard.ratings.panels import MAIN

    world = paper_grid(10, horizon=100).world(MAIN)
    kinds = ("shared", 5, "5 heads, shared trunk"), ("full", 5, "5 full networks"), ("dropout", 5, "dropout, 5 passes")
    rows = []
    for kind, members, name in (("full", 1, "single network"), *kinds):
        agent = DeepQ(ensemble=Ensemble(kind, members), buffer=BUFFER, batch=BATCH, warmup=WARMUP, target_every=TARGET)
        work = flops(0, 4, 1 if kind == "dropout" else members, kind)
        rows.append(Contender("DQN", name, trained(world, agent, "raw"), 5 * steps, work))
    return [*rows, Contender("DQN", "Stable-Baselines3", sb3(), steps, flops(100, 4, 1, "full"))]


def listeners(steps: int) -> list[Contender]:
    """What rules cost."""
    from uard.envs.grids.gaming import BoatRace, TomatoWatering
    from uard.envs.grids.trapgrid import paper_grid
    from uard.envs.locomotion.locomotion import Locomotion
    from uard.lab.registry import continuous_agents, deep_agents
    from uard.lab.studies.games import MODEL
    from uard.ratings.panels import MAIN

    agents, motors = deep_agents(), continuous_agents(small=True)
    grid, boat = paper_grid(10, horizon=100).world(MAIN), BoatRace().world(MAIN)
    garden, hopper = TomatoWatering(factor=0.1).world(MAIN), Locomotion("hopper")
    usual, more = 16, MODEL.fits
    rows = []
    for part, world, agent, fits, many in (
        ("ensemble-dqn, 10x10", grid, "ensemble-dqn", usual, 2 * steps),
        ("ppo, 10x10", grid, "ppo", usual, 4 * steps),
        ("dqn, BoatRace", boat, "dqn", more, steps),
        ("ppo, TomatoWatering", garden, "ppo", more, steps),
    ):
        work = model_flops(fits, world.features, world.actions, world.raters, world is not garden)
        for rule in RULES:
            run = trained(world, agents[agent], rule, fits)
            rows.append(Contender(part, rule, run, many, work * (rule != "raw"), on_top=rule != "raw"))
    for agent in ("ppo", "sac"):
        for rule in RULES:
            work, run = transition_flops(hopper, len(MAIN.raters)), simulated(hopper, motors[agent], rule)
            rows.append(Contender(f"{agent}, Hopper", rule, run, 2048, work * (rule != "raw"), on_top=rule != "raw"))
    return rows


def sb3() -> Callable[[int], float]:
    """The same for Stable-Baselines3's DQN."""
    import gymnasium
    import torch
    from stable_baselines3 import DQN

    import uard.envs  # noqa: F401

    torch.set_num_threads(1)

    def run(steps: int) -> float:
        env = gymnasium.make("uard/TrapGrid10-T100-v0")
        env = gymnasium.wrappers.TransformObservation(
            env, lambda s: np.eye(100, dtype=np.float32)[s], gymnasium.spaces.Box(0, 1, (100,), np.float32)
        )
        agent = DQN(
            "MlpPolicy",
            env,
            policy_kwargs={"net_arch": [HIDDEN, HIDDEN]},
            batch_size=BATCH,
            buffer_size=BUFFER,
            learning_starts=WARMUP,
            train_freq=1,
            gradient_steps=1,
            target_update_interval=TARGET,
            learning_rate=1e-3,
            gamma=0.95,
            device="cpu",
        )
        start = time.process_time()
        agent.learn(steps)
        return 1e6 * (time.process_time() - start) / steps

    return run


def table(
    contenders: list[Contender], first: list[float], times: list[list[float]], rate: float
) -> list[dict[str, Any]]:
    """Return the rows: what was measured, beside the floor."""
    middles = [statistics.median(t) for t in times]
    base = {c.part: m for c, m in reversed(list(zip(contenders, middles, strict=True)))}
    rows = []
    for c, begun, each, middle in zip(contenders, first, times, middles, strict=True):
        floor = (base[c.part] if c.on_top else 0.0) + 1e6 * c.work / rate if c.work else None
        rows.append(
            {
                "part": c.part,
                "name": c.name,
                "steps_per_second": 1e6 / middle,
                "us_per_step": middle,
                "range_us": [min(each), max(each)],
                "times_first": middle / base[c.part],
                "floor_us": floor,
                "floor_times_first": None if floor is None else floor / base[c.part],
                "first_call_seconds": begun,
            }
        )
    return rows


def show(rows: list[dict[str, Any]]) -> None:
    """Print the table."""
    heads = (
        ("steps/s", 8),
        ("us/step", 8),
        ("min-max", 15),
        ("x first", 8),
        ("floor us", 9),
        ("floor x", 8),
        ("first s", 8),
    )
    part = None
    for row in rows:
        if row["part"] != part:
            part = row["part"]
            print(f"{part:24s}", *(f"{text:>{width}s}" for text, width in heads))
        span = "{:.1f}-{:.1f}".format(*row["range_us"])
        floor, times = ("-" if x is None else f"{x:.2f}" for x in (row["floor_us"], row["floor_times_first"]))
        print(
            f"  {row['name']:22s} {row['steps_per_second']:8.0f} {row['us_per_step']:8.1f} {span:>15s} "
            f"{row['times_first']:8.2f} {floor:>9s} {times:>8s} {row['first_call_seconds']:8.1f}"
        )


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=3000, help="environment steps of the slowest; others take more")
    parser.add_argument("--only", default="", help="parts whose name holds this text")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    from uard.training.xla import keep_programs

    keep_programs()
    rate = matrix_rate()
    print(f"one core multiplies float32 matrices at {rate / 1e9:.0f} GFLOP/s", flush=True)
    contenders = [*grid_agents(arguments.steps), *listeners(arguments.steps)]
    contenders = [c for c in contenders if arguments.only in c.part]
    first = []
    for c in contenders:
        start = time.perf_counter()
        c.run(c.steps)
        first.append(time.perf_counter() - start)
    times: list[list[float]] = [[] for _ in contenders]
    for _ in range(arguments.rounds):
        for c, each in zip(contenders, times, strict=True):
            each.append(c.run(c.steps))
    rows = table(contenders, first, times, rate)
    show(rows)
    if arguments.json:
        packages = {p: metadata.version(p) for p in ("uard", "jax", "stable-baselines3", "torch", "mujoco")}
        made = {
            "command": f"python benchmarks/deep.py --rounds {arguments.rounds} --steps {arguments.steps}",
            "machine": f"{platform.machine()}, one core of {os.cpu_count()}",
            "packages": packages | {"python": platform.python_version()},
        }
        arguments.json.write_text(json.dumps(made | {"matrix_rate": rate, "rows": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()
