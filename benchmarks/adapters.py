"""What the adapters cost: the share of Stable-Baselines3's training that is spent in their code, on one core.

    python benchmarks/adapters.py --rounds 3 --json FILE

The clock runs while a wrapper, a buffer or the callback of ours is at work and stops while it waits for what it wraps.
Both times come from one run: between runs with and without an adapter a shared machine's speed differs by more than
what is to be measured. The share is of the training without the adapter: ours / (all - ours).
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from sb3_contrib import TRPO
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

import uard.envs
from uard.adapters.sb3 import ReliabilityCallback, ReliabilityReplayBuffer, ReliabilityVecEnv

HOPPER, GRID = "uard/Hopper-Posture-v0", "uard/TrapGrid6-v0"


def _env(name: str, count: int) -> Any:
    return make_vec_env(name, count, seed=0, env_kwargs={"panel": "appendix"})


def _on_policy(algorithm: Any, steps: int) -> Callable[[], Any]:
    return lambda: (algorithm("MlpPolicy", ReliabilityVecEnv(_env(HOPPER, 8)), n_steps=256, batch_size=64), steps)


def _off_policy(algorithm: Any, name: str, steps: int, **options: Any) -> Callable[[], Any]:
    buffer = {"replay_buffer_class": ReliabilityReplayBuffer}
    return lambda: (algorithm("MlpPolicy", _env(name, 1), **options, **buffer), steps)


DQN_OPTIONS = {"learning_starts": 100, "train_freq": 1, "batch_size": 64, "buffer_size": 10_000}
CASES = {
    "PPO, Hopper, 8 environments, wrapped": _on_policy(PPO, 8192),
    "TRPO, Hopper, 8 environments, wrapped": _on_policy(TRPO, 8192),
    "SAC, Hopper, replay buffer, critics lent": _off_policy(SAC, HOPPER, 1500, learning_starts=100),
    "DQN, grid, replay buffer": _off_policy(DQN, GRID, 3000, **DQN_OPTIONS),
}


OURS = (
    (ReliabilityVecEnv, "step_wait"),
    (ReliabilityReplayBuffer, "add"),
    (ReliabilityReplayBuffer, "_get_samples"),
    (ReliabilityCallback, "_on_step"),
)
THEIRS = ((DummyVecEnv, "step_wait"), (ReplayBuffer, "add"), (ReplayBuffer, "_get_samples"))


@contextmanager
def clock() -> Iterator[list[float]]:
    """Yield the seconds spent in our code, in a list of one, while the block runs."""
    spent, inside, before = [0.0], [False], []

    def patch(cls: Any, name: str, ours: bool) -> None:
        real = cls.__dict__[name]
        before.append((cls, name, real))

        def timed(*arguments: Any, **options: Any) -> Any:
            if not ours and not inside[0]:
                return real(*arguments, **options)
            inside[0], sign, started = ours, 1 if ours else -1, time.perf_counter()
            try:
                return real(*arguments, **options)
            finally:
                spent[0] += sign * (time.perf_counter() - started)
                inside[0] = not ours

        setattr(cls, name, timed)

    for ours, places in ((True, OURS), (False, THEIRS)):
        for cls, name in places:
            patch(cls, name, ours)
    try:
        yield spent
    finally:
        for cls, name, real in before:
            setattr(cls, name, real)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for name, build in CASES.items():
        ours, everything = [], []
        for _ in range(arguments.rounds):
            model, steps = build()
            started = time.perf_counter()
            with clock() as spent:
                model.learn(steps, callback=ReliabilityCallback())
            everything.append(time.perf_counter() - started)
            ours.append(spent[0])
        shares = np.array(ours) / (np.array(everything) - np.array(ours))
        low, high = float(shares.min()), float(shares.max())
        rows.append(
            {
                "name": name,
                "steps": steps,
                "seconds": [round(x, 2) for x in everything],
                "ours": [round(x, 3) for x in ours],
                "share": float(np.median(shares)),
                "range": [low, high],
            }
        )
        print(f"{name:45} {100 * rows[-1]['share']:5.1f} % ({100 * low:.1f} to {100 * high:.1f})", flush=True)
    if arguments.json:
        made = {"version": uard.__version__, "python": platform.python_version(), "rows": rows}
        with open(arguments.json, "w") as file:
            json.dump(made, file, indent=1)


if __name__ == "__main__":
    main()
