"""How fast is training in MuJoCo? Side by side in one run: physics, SAC's updates, PPO's steps.

    python benchmarks/locomotion.py [--rounds 3] [--only physics sac ppo] [--json FILE]

Rows that are in FILE already, and that this call does not make, stay there.

Physics: copies stepped by Gymnasium's SyncVectorEnv and by ours, per robot, with one thread and with one per core.
SAC: updates per second of SBX (where it is installed), Stable-Baselines3 and ours with networks of 256x256 and batches
of 256 on Hopper-v4, environment included, one core; the floor is the arithmetic of an update over the machine's matrix
rate measured in the same run. PPO: environment steps per CPU-second, 64x64, 8 x 256 steps, 10 epochs of 32 minibatches.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
import warnings
from collections.abc import Callable
from importlib import import_module, metadata, util
from pathlib import Path
from typing import Any

for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"

import numpy as np

import uard.training  # noqa: F401  (XLA's flags)
from uard.envs.locomotion.locomotion import ROBOTS, Locomotion

IDS = {"hopper": "Hopper-v4", "walker2d": "Walker2d-v4"}
COPIES = (8, 32)
Rate = Callable[[], float]


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def matrix_rate() -> float:
    """Measure the best rate of float32 matrix products of 256s, FLOP/s."""
    best, n = 0.0, 256
    a = np.random.default_rng(0).normal(size=(n, n)).astype(np.float32)
    for _ in range(20):
        start = time.perf_counter()
        for _ in range(50):
            a @ a
        best = max(best, 50 * 2 * n**3 / (time.perf_counter() - start))
    return best


def sync(robot: str, copies: int, steps: int) -> Rate:
    import gymnasium

    env = gymnasium.make_vec(IDS[robot], num_envs=copies, vectorization_mode="sync")
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, copies, Locomotion(robot).actions)).astype(np.float32)

    def run() -> float:
        env.reset(seed=0)
        start = time.perf_counter()
        for a in actions:
            env.step(a)
        return copies * steps / (time.perf_counter() - start)

    return run


def ours(robot: str, copies: int, steps: int, threads: int) -> Rate:
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, copies, Locomotion(robot).actions))

    def run() -> float:
        simulator = Locomotion(robot).simulator(copies, 0, threads)
        start = time.perf_counter()
        for a in actions:
            simulator.step(a)
        rate = copies * steps / (time.perf_counter() - start)
        simulator.close()
        return rate

    return run


def alone(robot: str, copies: int, steps: int) -> Rate:
    """MuJoCo's own steps and nothing else, on one thread: the roof of one core."""
    mujoco: Any = import_module("mujoco")
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, copies, Locomotion(robot).actions))
    simulator = Locomotion(robot).simulator(copies, 0)

    def run() -> float:
        model, substeps = simulator._model, simulator.model.substeps
        for i in range(copies):
            simulator.reset(i)
        start = time.perf_counter()
        for a in actions:
            for data, controls in zip(simulator._data, a, strict=True):
                data.ctrl[:] = controls
                mujoco.mj_step(model, data, substeps)
        return copies * steps / (time.perf_counter() - start)

    return run


def rolled(robot: str, copies: int, steps: int, threads: int) -> Rate:
    """MuJoCo's own threads (``mujoco.rollout``), a step of all copies at a time, as an agent needs them."""
    mujoco: Any = import_module("mujoco")
    rollout: Any = import_module("mujoco.rollout")
    spec = Locomotion(robot)
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, copies, spec.actions))
    simulator = spec.simulator(copies, 0)
    model, substeps = simulator._model, simulator.model.substeps
    whole = mujoco.mjtState.mjSTATE_FULLPHYSICS
    begun = np.zeros((copies, mujoco.mj_stateSize(model, whole)))
    for row, data in zip(begun, simulator._data, strict=True):
        mujoco.mj_getState(model, data, row, whole)
    data = [mujoco.MjData(model) for _ in range(threads)]

    def run() -> float:
        state, warm = begun, np.zeros((copies, model.nv))
        with rollout.Rollout(nthread=threads) as pool:
            start = time.perf_counter()
            for a in actions:
                controls = np.repeat(a[:, None], substeps, axis=1)
                states, _ = pool.rollout([model] * copies, data, state, controls, initial_warmstart=warm)
                state = states[:, -1]
            return copies * steps / (time.perf_counter() - start)

    return run


def shaking(robot: str) -> float:
    """Return the mean root mean square of the joints' accelerations under random actions, rad/s^2."""
    spec, seen = Locomotion(robot), []
    simulator, random = spec.simulator(8, 0), np.random.default_rng(0)
    for _ in range(1000):
        simulator.step(random.uniform(-1, 1, (8, spec.actions)))
        seen.append(np.sqrt((simulator._acceleration[:, 3:] ** 2).mean(1)))
    return float(np.mean(seen))


def sac_flops(critics: int, shared: bool, hidden: int = 256, batch: int = 256) -> float:
    """Arithmetic of an update: targets and actor forward; critics and actor with gradients; Hopper's 11 + 3."""
    wide = 1 if shared else critics
    heads = critics if shared else 1
    q = 2 * batch * wide * (14 * hidden + hidden**2 + hidden * heads)
    q_inner = 2 * batch * wide * (hidden**2 + hidden * heads)
    pi = 2 * batch * (11 * hidden + hidden**2 + 6 * hidden)
    pi_inner = 2 * batch * (hidden**2 + 6 * hidden)
    # critics: target, own forward and both gradients; under the actor: forward and the gradient of the input only
    return q + (2 * q + q_inner) + 2 * q + pi + (2 * pi + pi_inner)


def our_sac(agent: Any, mitigation: str, updates: int) -> Rate:
    from uard.method.mitigations import named
    from uard.training.host.loop import Job
    from uard.training.host.loops import loop_of

    steps = updates + agent.warmup
    job = Job(Locomotion(region=None), agent, named(mitigation), 0, 10**6)
    loop = loop_of(job)
    simulator = job.environment.simulator(1, 0)
    state = loop.start(simulator)
    while state.steps < agent.warmup + 128:
        state = loop.advance(state, simulator)
    reached = [state]

    def run() -> float:
        state = reached[0]
        begun, done = time.perf_counter(), int(state.steps)
        while state.steps < done + steps:
            state = loop.advance(state, simulator)
        state.agent.trained.log_temperature.block_until_ready()
        reached[0] = state
        return (int(state.steps) - done) / (time.perf_counter() - begun)

    return run


def their_sac(library: str, updates: int) -> Rate:
    import gymnasium

    if library == "sbx":
        from sbx import SAC
    else:
        import torch
        from stable_baselines3 import SAC

        torch.set_num_threads(1)
    agent: Any = SAC(
        "MlpPolicy",
        gymnasium.make("Hopper-v4"),
        policy_kwargs={"net_arch": [256, 256]},
        batch_size=256,
        learning_starts=300,
        train_freq=1,
        gradient_steps=1,
        buffer_size=100_000,
        **({} if library == "sbx" else {"device": "cpu"}),
    )
    agent.learn(500)

    def run() -> float:
        begun = time.perf_counter()
        agent.learn(updates, reset_num_timesteps=False)
        return updates / (time.perf_counter() - begun)

    return run


def our_ppo(mitigation: str, rollouts: int) -> Rate:
    from uard.lab.registry import continuous_agents
    from uard.method.mitigations import named
    from uard.training.host.loop import Job
    from uard.training.host.loops import loop_of

    job = Job(Locomotion(region=None), continuous_agents()["ppo"], named(mitigation), 0, 10**6)
    loop = loop_of(job)
    simulator = job.environment.simulator(8, 0)
    reached = [loop.advance(loop.start(simulator), simulator)]

    def run() -> float:
        state, begun = reached[0], time.process_time()
        done = int(state.steps)
        for _ in range(rollouts):
            state = loop.advance(state, simulator)
        np.asarray(state.agent.policy.log_deviation)
        reached[0] = state
        return (int(state.steps) - done) / (time.process_time() - begun)

    return run


def their_ppo(rollouts: int) -> Rate:
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env

    torch.set_num_threads(1)
    agent = PPO(
        "MlpPolicy",
        make_vec_env("Hopper-v4", 8),
        policy_kwargs={"net_arch": [64, 64]},
        n_steps=256,
        batch_size=64,
        n_epochs=10,
        device="cpu",
    )
    agent.learn(2048)

    def run() -> float:
        begun = time.process_time()
        agent.learn(2048 * rollouts, reset_num_timesteps=False)
        return 2048 * rollouts / (time.process_time() - begun)

    return run


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--only", nargs="*", default=["physics", "sac", "ppo"], choices=["physics", "sac", "ppo"])
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    rate = matrix_rate()
    print(f"one core multiplies float32 matrices of 256 at {rate / 1e9:.0f} GFLOP/s")
    every: dict[str, dict[str, tuple[Rate, float]]] = {}
    if "physics" in arguments.only:
        for robot in ROBOTS:
            print(f"{robot}: random actions shake its joints by {shaking(robot):.0f} rad/s^2 (c = 1)")
            for copies in COPIES:
                steps = 3200 // copies
                every[f"{robot}: steps per second, {copies} copies"] = {
                    "Gymnasium's SyncVectorEnv": (sync(robot, copies, steps), 0.0),
                    "ours, 1 thread": (ours(robot, copies, steps, 1), 0.0),
                    f"ours, {cores()} threads": (ours(robot, copies, steps, cores()), 0.0),
                    f"MuJoCo's rollout, {cores()} threads": (rolled(robot, copies, steps, cores()), 0.0),
                    "MuJoCo's steps alone, 1 thread": (alone(robot, copies, steps), 0.0),
                }
    only_core = {max(os.sched_getaffinity(0))} if hasattr(os, "sched_setaffinity") else set()
    if "sac" in arguments.only:
        from uard.agents.continuous import ensemble_sac, sac

        two, five = sac(warmup=512, buffer=100_000), ensemble_sac(warmup=512, buffer=100_000)
        full = ensemble_sac(kind="full", warmup=512, buffer=100_000)
        every["SAC: updates per second, one core"] = {
            "Stable-Baselines3, 2 critics": (their_sac("sb3", 300), sac_flops(2, False)),
            **({"SBX, 2 critics": (their_sac("sbx", 400), sac_flops(2, False))} if util.find_spec("sbx") else {}),
            "ours, 2 critics": (our_sac(two, "raw", 500), sac_flops(2, False)),
            "ours, 5 shared critics, raw": (our_sac(five, "raw", 500), sac_flops(5, True)),
            "ours, 5 shared critics, uard": (our_sac(five, "uard-0.1", 500), sac_flops(5, True)),
            "ours, 5 full critics, uard": (our_sac(full, "uard-0.1", 300), sac_flops(5, False)),
        }
    if "ppo" in arguments.only:
        every["PPO: environment steps per CPU-second, one core"] = {
            "Stable-Baselines3": (their_ppo(1), 0.0),
            "ours, raw": (our_ppo("raw", 2), 0.0),
            "ours, uard": (our_ppo("uard-0.1", 2), 0.0),
        }
    rows = []
    for title, contenders in every.items():
        if ("SAC" in title or "PPO" in title) and only_core:
            os.sched_setaffinity(0, only_core)
        found: dict[str, list[float]] = {name: [] for name in contenders}
        for _ in range(arguments.rounds):
            for name, (run, _) in contenders.items():
                found[name].append(run())
        first = statistics.median(next(iter(found.values())))
        print(title)
        for name, (_, work) in contenders.items():
            middle = statistics.median(found[name])
            share = middle * work / rate
            rows.append(
                {"what": title, "who": name, "rate": middle, "range": [min(found[name]), max(found[name])]}
                | ({"share_of_matrix_rate": share} if work else {})
            )
            tail = f"{100 * share:5.0f} % of the matrix rate" if work else ""
            print(
                f"  {name:32s} {middle:8.1f} ({min(found[name]):.1f}-{max(found[name]):.1f}) "
                f"{middle / first:5.2f}x {tail}"
            )
    if arguments.json:
        wanted = ("uard", "jax", "mujoco", "gymnasium", "stable-baselines3", "torch", "sbx-rl")
        packages = {p: metadata.version(p) for p in wanted if p != "sbx-rl" or util.find_spec("sbx")}
        made: dict[str, Any] = {
            "command": f"python benchmarks/locomotion.py --rounds {arguments.rounds}",
            "machine": f"{platform.machine()}, {os.cpu_count()} cores",
            "packages": packages | {"python": platform.python_version()},
        }
        before = json.loads(arguments.json.read_text()) if arguments.json.exists() else {"rows": [], "packages": {}}
        made["packages"] = before["packages"] | packages
        rows = [r for r in before["rows"] if r["what"] not in every] + rows
        arguments.json.write_text(json.dumps(made | {"matrix_rate": rate, "rows": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()
