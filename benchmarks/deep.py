"""How fast are the deep agents? Side by side with Stable-Baselines3 in one run, one core, same network and batch.

    python benchmarks/deep.py [--rounds 3] [--steps 3000]

Prints for each: environment steps per second of a DQN on the 10x10 grid (one update per step), the floor (arithmetic of
an update over the machine's measured matrix rate) beside the measured time, and what ensembles cost. Rounds are
interleaved; the number is the median, with the smallest and the largest.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"

import numpy as np

import uard.training  # noqa: F401  (XLA's flags)

HIDDEN, BATCH, BUFFER, TARGET = 64, 64, 10_000, 250
WARMUP = BATCH  # so that of all, few steps are without an update


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


def ours(kind: str, members: int, mitigation: str) -> Callable[[int], float]:
    """Return a function that trains for some steps and gives steps per second."""
    import jax

    from uard.agents.networks import Ensemble
    from uard.agents.value import DeepQ
    from uard.envs.grids.trapgrid import paper_grid
    from uard.method.mitigations import named
    from uard.ratings.panels import PANELS
    from uard.training.compiled import common as deep
    from uard.training.compiled import off_policy, runs
    from uard.training.feedback.rating_model import RatingModel

    agent = DeepQ(ensemble=Ensemble(kind, members), buffer=BUFFER, batch=BATCH, warmup=WARMUP, target_every=TARGET)
    world = paper_grid(10, horizon=100).world(PANELS["main"])
    model = RatingModel() if mitigation != "raw" else None

    def run(steps: int) -> float:
        program = deep.Program(10**6 // 100, steps)
        one = deep.make_run(world, agent, named(mitigation), 0, rating_model=model)
        start = time.perf_counter()
        (out,) = runs.train([one], off_policy.train_one, program, ("steps", "fault"), deep.ROOM)
        return float(out["steps"]) / (time.perf_counter() - start)

    jax.config.update("jax_compilation_cache_dir", None)
    return run


def sb3() -> Callable[[int], float]:
    """The same for Stable-Baselines3's DQN: one update per step."""
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
        start = time.perf_counter()
        agent.learn(steps)
        return steps / (time.perf_counter() - start)

    return run


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=3000, help="environment steps of Stable-Baselines3; ours take 10x")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    rate = matrix_rate()
    print(f"one core multiplies float32 matrices at {rate / 1e9:.0f} GFLOP/s")
    contenders: dict[str, tuple[Callable[[int], float], int, float]] = {
        "Stable-Baselines3 DQN": (sb3(), 1, flops(100, 4, 1, "full")),
        "DQN, single network": (ours("full", 1, "raw"), 10, flops(0, 4, 1, "full")),
        "5 heads, shared trunk": (ours("shared", 5, "raw"), 10, flops(0, 4, 5, "shared")),
        "5 full networks": (ours("full", 5, "raw"), 10, flops(0, 4, 5, "full")),
        "dropout, 5 passes": (ours("dropout", 5, "raw"), 10, flops(0, 4, 1, "full")),
        "5 heads with uard and a model of the ratings": (ours("shared", 5, "uard-0.1"), 10, flops(0, 4, 5, "shared")),
    }
    for name, (run, factor, _) in contenders.items():
        print(f"compiling and warming up: {name}", flush=True)
        run(arguments.steps * factor)
    speeds: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(arguments.rounds):
        for name, (run, factor, _) in contenders.items():
            speeds[name].append(run(arguments.steps * factor))
    single, theirs = (statistics.median(speeds[n]) for n in ("DQN, single network", "Stable-Baselines3 DQN"))
    rows = []
    heads = ("steps/s", 8), ("min-max", 13), ("us/step", 8), ("floor us", 8), ("x SB3", 6), ("x cost of one", 13)
    print(" " * 46, *(f"{text:>{width}s}" for text, width in heads))
    for name, (_, _, work) in contenders.items():
        s = speeds[name]
        middle = statistics.median(s)
        row = {
            "name": name,
            "steps_per_second": middle,
            "range": [min(s), max(s)],
            "us_per_step": 1e6 / middle,
            "floor_us": 1e6 * work / rate,
            "times_sb3": middle / theirs,
            "cost_of_single": single / middle,
        }
        rows.append(row)
        print(
            f"{name:46s} {middle:8.0f} {min(s):6.0f}-{max(s):6.0f} {row['us_per_step']:8.1f} {row['floor_us']:8.1f} "
            f"{row['times_sb3']:6.1f} {row['cost_of_single']:13.2f}"
        )
    if arguments.json:
        packages = {p: metadata.version(p) for p in ("uard", "jax", "stable-baselines3", "torch")}
        made = {
            "command": f"python benchmarks/deep.py --rounds {arguments.rounds} --steps {arguments.steps}",
            "machine": f"{platform.machine()}, one core of {os.cpu_count()}",
            "packages": packages | {"python": platform.python_version()},
        }
        arguments.json.write_text(json.dumps(made | {"matrix_rate": rate, "rows": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()
