# ruff: noqa: D101, D102, NPY002 the names say it; Stable-Baselines3 draws from NumPy's global numbers
"""What the adapters cost: training in Stable-Baselines3 with and without one, side by side on one core.

    taskset -c 0 python benchmarks/adapters.py --json FILE

Three trainings of each kind take turns in one process, a piece at a time: without anything, with a wrapper, a buffer
and a callback that only pass on what they are given (the floor: what any adapter of this form costs), and with ours.
Ours computes all that it computes for a user, but hands on the raw reward (``Unchanged``): so all three take the same
actions, meet the same episodes and end with the same networks, which is checked. Time is the processor's. The cost of a
round is the median of its pieces; the table gives the median of the rounds and their range.

``clocked`` is measured in one training: how long our code is at work, without what it calls of Stable-Baselines3,
divided by the rest. On a machine that others use it is the steadier number; what our code makes dearer elsewhere, by
emptying caches, is not in it.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import stable_baselines3
import torch
from sb3_contrib import TRPO
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper

import uard.envs
from uard.adapters.sb3 import (
    ReliabilityCallback,
    ReliabilityReplayBuffer,
    ReliabilityRolloutBuffer,
    ReliabilityVecEnv,
)
from uard.method.mitigations import Evidence, Explanation, LearningSignal
from uard.method.mitigations.pooled import PooledDiscounting

HOPPER, GRID = "uard/Hopper-Posture-v0", "uard/TrapGrid6-v0"
WITHOUT, FLOOR, WITH = range(3)


@dataclass(frozen=True)
class Unchanged(PooledDiscounting):
    """Computes what ``uard`` learns, and learns the raw reward."""

    def explain(self, evidence: Evidence, statistics: Any) -> Explanation:
        why = super().explain(evidence, statistics)
        return why._replace(signal=LearningSignal(evidence.reward, 1.0))


class PassingEnv(VecEnvWrapper):
    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        return self.venv.step_wait()


class PassingReplayBuffer(ReplayBuffer):
    def add(self, *arguments: Any) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        super().add(*arguments)

    def _get_samples(self, batch_inds: Any, env: Any = None) -> Any:
        return super()._get_samples(batch_inds, env)


class PassingRolloutBuffer(RolloutBuffer):
    def add(self, *arguments: Any) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        super().add(*arguments)

    def compute_returns_and_advantage(self, last_values: Any, dones: Any) -> None:
        super().compute_returns_and_advantage(last_values, dones)


class PassingCallback(BaseCallback):
    def _on_step(self) -> bool:
        return True


@dataclass(frozen=True)
class Case:
    """A training; ``build`` makes its model, without, with the floor, or with ours."""

    name: str
    limit: float | None
    piece: int
    pieces: int
    build: Callable[[int], Any]


def _env(name: str, count: int) -> Any:
    if not name.startswith("uard/"):
        return make_vec_env(name, count, seed=0, wrapper_class=Rated)
    return make_vec_env(name, count, seed=0, env_kwargs={"panel": "appendix"})


def _off_policy(algorithm: Any, name: str, **options: Any) -> Callable[[int], Any]:
    def build(kind: int) -> Any:
        buffer = [
            {},
            {"replay_buffer_class": PassingReplayBuffer},
            {
                "replay_buffer_class": ReliabilityReplayBuffer,
                "replay_buffer_kwargs": {"mitigation": Unchanged()},
            },
        ][kind]
        return algorithm("MlpPolicy", _env(name, 1), seed=0, **options, **buffer)

    return build


def _on_policy(algorithm: Any, wrapped: bool) -> Callable[[int], Any]:
    def build(kind: int) -> Any:
        env, buffer = _env(HOPPER, 8), {}
        if wrapped and kind:
            env = PassingEnv(env) if kind == FLOOR else ReliabilityVecEnv(env, Unchanged())
        elif kind == FLOOR:
            buffer = {"rollout_buffer_class": PassingRolloutBuffer}
        elif kind == WITH:
            buffer = {
                "rollout_buffer_class": ReliabilityRolloutBuffer,
                "rollout_buffer_kwargs": {"mitigation": Unchanged()},
            }
        return algorithm("MlpPolicy", env, n_steps=256, batch_size=64, seed=0, **buffer)

    return build


DQN_OPTIONS = {"learning_starts": 100, "train_freq": 1, "batch_size": 64, "buffer_size": 10_000}
CASES = [
    Case("PPO, Hopper, 8 envs, rollout buffer", 0.02, 2048, 1, _on_policy(PPO, False)),
    Case("TRPO, Hopper, 8 envs, rollout buffer", 0.02, 2048, 1, _on_policy(TRPO, False)),
    Case("PPO, Hopper, 8 envs, wrapped", None, 2048, 1, _on_policy(PPO, True)),
    Case("TRPO, Hopper, 8 envs, wrapped", None, 2048, 1, _on_policy(TRPO, True)),
    Case("SAC, Hopper, critics lent", 0.04, 20, 6, _off_policy(SAC, HOPPER, learning_starts=10)),
    Case("DQN, grid, an update a step", 0.06, 100, 8, _off_policy(DQN, GRID, **DQN_OPTIONS)),
    Case("DQN, CartPole, no keys", None, 100, 5, _off_policy(DQN, "CartPole-v1", **DQN_OPTIONS)),
]


class Rated(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment with three raters."""

    def step(self, action: Any) -> Any:
        *rest, info = self.env.step(action)
        return *rest, {**info, "ratings": [float(rest[1]), 0.9, 1.1]}


OURS = (
    (ReliabilityVecEnv, "step_wait"),
    (ReliabilityReplayBuffer, "add"),
    (ReliabilityReplayBuffer, "_get_samples"),
    (ReliabilityRolloutBuffer, "compute_returns_and_advantage"),
    (ReliabilityCallback, "_on_step"),
    (ReliabilityCallback, "_on_rollout_end"),
)
THEIRS = (
    (DummyVecEnv, "step_wait"),
    (ReplayBuffer, "add"),
    (ReplayBuffer, "_get_samples"),
    (RolloutBuffer, "compute_returns_and_advantage"),
    (ContinuousCritic, "forward"),  # whose answer is used again
)


@contextmanager
def clock() -> Iterator[list[float]]:
    """Yield the seconds spent in our code, in a list of one, while the block runs."""
    spent, inside, before = [0.0], [False], []

    def patch(cls: Any, name: str, ours: bool) -> None:
        real = cls.__dict__[name]
        before.append((cls, name, real))

        def timed(*arguments: Any, **options: Any) -> Any:
            if inside[0] == ours:
                return real(*arguments, **options)
            inside[0], sign, started = ours, 1 if ours else -1, time.process_time()
            try:
                return real(*arguments, **options)
            finally:
                spent[0] += sign * (time.process_time() - started)
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


class Training:
    """One of the trainings that take turns; each has random numbers of its own."""

    def __init__(self, case: Case, kind: int):
        """Build the model, and do once what is done once: imports, the first batches."""
        self.model, self._steps = case.build(kind), case.piece
        self._callback = [None, PassingCallback(), ReliabilityCallback()][kind]
        self._random = torch.get_rng_state(), np.random.get_state()
        self.piece()

    def piece(self) -> float:
        """Train a piece further, and return the processor's seconds."""
        torch.set_rng_state(self._random[0])
        np.random.set_state(self._random[1])
        started = time.process_time()
        self.model.learn(self._steps, callback=self._callback, reset_num_timesteps=False)
        taken = time.process_time() - started
        self._random = torch.get_rng_state(), np.random.get_state()
        return taken


def measure(case: Case, rounds: int) -> dict[str, Any]:
    """Return what a training costs with and without."""
    trainings = [Training(case, kind) for kind in range(3)]
    seconds = np.zeros((rounds, case.pieces, 3))
    for i in range(rounds * case.pieces):
        for kind in np.roll(range(3), i):  # everybody comes first, second and last
            seconds[i // case.pieces, i % case.pieces, kind] = trainings[kind].piece()
    plain = trainings[0].model.policy.state_dict()
    for other in trainings[1:]:
        for name, weights in other.model.policy.state_dict().items():
            assert torch.equal(weights, plain[name]), f"{case.name}: {name} differs, so that these are not one training"
    clocked = []
    with clock() as spent:
        for _ in range(rounds):
            spent[0] = 0.0
            everything = sum(trainings[WITH].piece() for _ in range(case.pieces))
            clocked.append(spent[0] / (everything - spent[0]))
    # Each piece with itself, which is the same work: others on this machine disturb a few pieces, not their median.
    cost = np.median(seconds / seconds[:, :, :1], axis=1) - 1
    each = 1e6 * np.median(seconds, axis=(0, 1)) / case.piece
    return {
        "name": case.name,
        "limit": case.limit,
        "steps": case.piece * case.pieces * rounds,
        "microseconds": dict(zip(("without", "floor", "with"), each.round(2).tolist(), strict=True)),
        "cost": float(np.median(cost[:, WITH])),
        "range": [float(cost[:, WITH].min()), float(cost[:, WITH].max())],
        "floor": float(np.median(cost[:, FLOOR])),
        "floor_range": [float(cost[:, FLOOR].min()), float(cost[:, FLOOR].max())],
        "clocked": float(np.median(clocked)),
        "clocked_range": [min(clocked), max(clocked)],
        "seconds": seconds.round(4).tolist(),
    }


def line(row: dict[str, Any]) -> str:
    """Return a row of the table."""
    us, (low, high), limit = row["microseconds"], row["range"], row["limit"]
    asked = "" if limit is None else f"{100 * limit:.0f} %"
    return (
        f"{row['name']:38}{us['without']:9.1f}{us['with']:9.1f}{100 * row['cost']:8.1f} "
        f"{f'({100 * low:.1f} to {100 * high:.1f})':>16}{100 * row['clocked']:9.1f}{100 * row['floor']:8.1f}{asked:>7}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--only", help="cases whose name begins with this")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cases = [case for case in CASES if case.name.startswith(arguments.only or "")]
    print(f"{'':38}{'us/step':>9}{'with':>9}{'cost %':>8}{'(range)':>17}{'clocked':>9}{'floor':>8}{'limit':>7}")
    rows = []
    for case in cases:
        rows.append(measure(case, arguments.rounds))
        print(line(rows[-1]), flush=True)
    if arguments.json:
        versions = {
            "uard": uard.__version__,
            "stable_baselines3": stable_baselines3.__version__,
            "torch": torch.__version__,
            "numpy": np.__version__,
            "python": platform.python_version(),
        }
        made = {"versions": versions, "machine": platform.processor() or platform.machine(), "rows": rows}
        arguments.json.write_text(json.dumps(made, indent=1))


if __name__ == "__main__":
    main()
