"""What the adapters cost: Stable-Baselines3 with and without them, interleaved, CPU seconds of one core.

    python benchmarks/adapters.py --rounds 3 --json FILE

Ratings are made by the environment in both runs. The share is of the whole training: (with - without) / without.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from sb3_contrib import TRPO
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.env_util import make_vec_env

import uard.envs
from uard.adapters.sb3 import ReliabilityCallback, ReliabilityReplayBuffer, ReliabilityVecEnv

HOPPER, GRID = "uard/Hopper-Posture-v0", "uard/TrapGrid6-v0"


def _env(name: str, count: int) -> Any:
    return make_vec_env(name, count, seed=0, env_kwargs={"panel": "appendix"})


def _on_policy(algorithm: Any, steps: int) -> Callable[[bool], Any]:
    def build(filtered: bool) -> Any:
        env = _env(HOPPER, 8)
        return algorithm("MlpPolicy", ReliabilityVecEnv(env) if filtered else env, n_steps=256, batch_size=64), steps

    return build


def _off_policy(algorithm: Any, name: str, steps: int, **options: Any) -> Callable[[bool], Any]:
    def build(filtered: bool) -> Any:
        more = {"replay_buffer_class": ReliabilityReplayBuffer} if filtered else {}
        return algorithm("MlpPolicy", _env(name, 1), **options, **more), steps

    return build


DQN_OPTIONS = {"learning_starts": 100, "train_freq": 1, "batch_size": 64, "buffer_size": 10_000}
CASES = {
    "PPO, Hopper, 8 environments, wrapped": _on_policy(PPO, 8192),
    "TRPO, Hopper, 8 environments, wrapped": _on_policy(TRPO, 8192),
    "SAC, Hopper, replay buffer, critics lent": _off_policy(SAC, HOPPER, 1500, learning_starts=100),
    "DQN, grid, replay buffer": _off_policy(DQN, GRID, 3000, **DQN_OPTIONS),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for name, build in CASES.items():
        spent: dict[bool, list[float]] = {False: [], True: []}
        for _ in range(arguments.rounds):
            for filtered in (False, True):
                model, steps = build(filtered)
                started = time.process_time()
                model.learn(steps, callback=ReliabilityCallback() if filtered else None)
                spent[filtered].append(time.process_time() - started)
        shares = np.array(spent[True]) / np.array(spent[False]) - 1.0
        rows.append(
            {
                "name": name,
                "steps": steps,
                "without": [round(x, 2) for x in spent[False]],
                "with": [round(x, 2) for x in spent[True]],
                "share": float(np.median(shares)),
                "range": [float(shares.min()), float(shares.max())],
            }
        )
        low, high = rows[-1]["range"]
        print(f"{name:45} {100 * rows[-1]['share']:5.1f} % ({100 * low:.1f} to {100 * high:.1f})", flush=True)
    if arguments.json:
        made = {"version": uard.__version__, "python": platform.python_version(), "rows": rows}
        with open(arguments.json, "w") as file:
            json.dump(made, file, indent=1)


if __name__ == "__main__":
    main()
