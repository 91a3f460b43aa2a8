"""Do our agents learn what others' do? Small and MuJoCo's tasks beside Stable-Baselines3, sb3-contrib and SBX.

    python benchmarks/credentials.py [--seeds 10] [--their-seeds 3] [--only dqn ppo trpo sac]
                                     [--tasks CartPole Acrobot Hopper Walker2d] [--ours-only] [--json FILE]

Rows that are in FILE already, and that this call does not make, stay there.

Same budget of environment steps, network (64, 64), batch, buffer, discount. The number is the mean return of the
training episodes that end in the last fifth of the budget, one per seed; the interval is over seeds (95 %).
Ours run on our own compiled CartPole and Acrobot, which the tests hold to Gymnasium's; theirs run on Gymnasium's.
Hopper-v4 and Walker2d-v4 tell the truth here. PPO has the million steps of published results, which stand beside it;
SAC has the size and the budget of the studies for a CPU, and SBX beside it where that is installed, else
Stable-Baselines3.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from importlib import metadata, util
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

import uard.training  # noqa: F401  (XLA's flags)
from uard import __version__
from uard.lab.statistics import Summary, summarise

CLEANRL = "CleanRL, published"
# Mean and deviation over seeds of the last episodes at 1 M steps, v4, as CleanRL's documentation publishes them.
PUBLISHED = {("ppo", "Hopper"): (2383, 272), ("ppo", "Walker2d"): (2288, 572)}
SMALL, ROBOTS = ("CartPole", "Acrobot"), ("Hopper", "Walker2d")
BUDGETS = {
    **{("dqn", task): 30_000 for task in SMALL},
    **{(name, task): 100_000 for name in ("ppo", "trpo") for task in SMALL},
    **{("ppo", task): 1_000_000 for task in ROBOTS},
    **{("sac", task): 50_000 for task in ROBOTS},
}
AGENTS = ("dqn", "ppo", "trpo", "sac")
GAMMA, RATE = 0.99, 1e-3
VALUE_SCALE = {("ppo", "CartPole"): 100.0, ("trpo", "CartPole"): 100.0}  # 30 elsewhere
Returns = list[float]


def late(ends: np.ndarray, returns: np.ndarray, budget: int) -> float:
    """Mean return of the episodes that end in the last fifth of the budget."""
    chosen = returns[(ends > 0.8 * budget) & (ends <= budget)]
    return float(chosen.mean()) if len(chosen) else float(returns[-1])


def ours(name: str, task: str, seeds: int) -> Returns:
    return (_in_mujoco if task in ROBOTS else _compiled)(name, task, seeds)


def _in_mujoco(name: str, task: str, seeds: int) -> Returns:
    from uard.envs.locomotion.locomotion import Locomotion
    from uard.lab.registry import continuous_agents
    from uard.method.mitigations import named
    from uard.training.episode_log import LOG
    from uard.training.host import loop as host
    from uard.training.host.loops import loop_of

    budget, found = BUDGETS[name, task], []
    for seed in range(seeds):
        world = Locomotion(task.lower(), region=None)
        job = host.Job(world, continuous_agents(small=name == "sac")[name], named("raw"), seed, budget)
        done = host.run(loop_of(job))
        found.append(late(done.ends, done.log[:, LOG.index("observed_return")], budget))
    return found


def _compiled(name: str, task: str, seeds: int) -> Returns:
    from uard.agents.networks import Network
    from uard.agents.policy import PPO, TRPO
    from uard.agents.value import DeepQ
    from uard.envs.classic.specs import Acrobot, CartPole
    from uard.method.mitigations import named
    from uard.ratings.panels import PANELS
    from uard.training.compiled import common as deep
    from uard.training.compiled import off_policy, on_policy, runs
    from uard.training.episode_log import LOG

    network = Network(learning_rate=RATE, value_scale=VALUE_SCALE.get((name, task), 30.0))
    agents: dict[str, Any] = {
        "dqn": DeepQ(network, gamma=GAMMA, epsilon_decay=0.98),
        "ppo": PPO(network, gamma=GAMMA, count_bonus=0.0),
        "trpo": TRPO(network, gamma=GAMMA, count_bonus=0.0),
    }
    budget = BUDGETS[name, task]
    world = (CartPole() if task == "CartPole" else Acrobot()).world(PANELS["main"])
    loop = off_policy.train_one if name == "dqn" else on_policy.train_one
    program = deep.Program(budget // 8, budget)
    several = [deep.make_run(world, agents[name], named("raw"), seed) for seed in range(seeds)]
    found = []
    for out in runs.train(several, loop, program, deep.TrainedAgent._fields, deep.ROOM):
        assert not out["fault"], deep.QUANTITIES[int(out["fault"])]
        log = out["log"][: int(out["episodes"])]
        ends = np.cumsum(log[:, LOG.index("length")])
        found.append(late(ends, log[:, LOG.index("observed_return")], budget))
    return found


def theirs(name: str, task: str, seeds: int) -> Returns:
    return (_their_sac if name == "sac" else _on_gymnasium)(name, task, seeds)


def _their_sac(name: str, task: str, seeds: int) -> Returns:
    import gymnasium
    from stable_baselines3.common.monitor import Monitor

    if util.find_spec("sbx"):
        from sbx import SAC
    else:
        from stable_baselines3 import SAC
    found = []
    for seed in range(seeds):
        agent: Any = SAC(
            "MlpPolicy",
            Monitor(gymnasium.make(f"{task}-v4")),
            learning_rate=RATE,
            batch_size=128,
            learning_starts=2_000,
            buffer_size=BUDGETS[name, task],
            policy_kwargs={"net_arch": [64, 64]},
            gamma=GAMMA,
            seed=seed,
        )
        episodes = _Episodes()
        agent.learn(BUDGETS[name, task], callback=episodes)
        found.append(late(np.array(episodes.ends), np.array(episodes.returns), BUDGETS[name, task]))
    return found


def _on_gymnasium(name: str, task: str, seeds: int) -> Returns:
    import gymnasium
    import torch
    from sb3_contrib import TRPO
    from stable_baselines3 import DQN, PPO
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import DummyVecEnv

    torch.set_num_threads(1)
    net: dict[str, Any] = {"policy_kwargs": {"net_arch": [64, 64]}, "gamma": GAMMA, "device": "cpu"}
    found = []
    for seed in range(seeds):
        copies = 1 if name == "dqn" else 8
        env = DummyVecEnv([lambda: Monitor(gymnasium.make(f"{task}-v1"))] * copies)
        agent: Any
        if name == "dqn":
            agent = DQN(
                "MlpPolicy",
                env,
                learning_rate=RATE,
                batch_size=64,
                buffer_size=10_000,
                learning_starts=500,
                train_freq=1,
                gradient_steps=1,
                target_update_interval=250,
                exploration_fraction=0.16,
                seed=seed,
                **net,
            )
        elif name == "ppo":
            # 8 x 32 steps, 4 minibatches, 4 epochs, as ours; gae_lambda and clip are the same, too.
            agent = PPO(
                "MlpPolicy",
                env,
                learning_rate=RATE,
                n_steps=32,
                batch_size=64,
                n_epochs=4,
                ent_coef=0.01,
                seed=seed,
                **net,
            )
        else:
            agent = TRPO(
                "MlpPolicy", env, learning_rate=RATE, n_steps=32, batch_size=64, target_kl=0.01, seed=seed, **net
            )
        episodes = _Episodes()
        agent.learn(BUDGETS[name, task], callback=episodes)
        found.append(late(np.array(episodes.ends), np.array(episodes.returns), BUDGETS[name, task]))
    return found


class _Episodes:
    """A callback that notes when each episode ended, and its return."""

    def __init__(self) -> None:
        self.ends: list[int] = []
        self.returns: list[float] = []

    def __call__(self, local: dict[str, Any], _: dict[str, Any]) -> bool:
        for info in local["infos"]:
            if "episode" in info:
                self.ends.append(local["self"].num_timesteps)
                self.returns.append(float(info["episode"]["r"]))
        return True


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--their-seeds", type=int, default=3)
    parser.add_argument("--only", nargs="*", default=list(AGENTS), choices=AGENTS)
    parser.add_argument("--tasks", nargs="*", default=list(SMALL), choices=[*SMALL, *ROBOTS])
    parser.add_argument("--ours-only", action="store_true")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = {}
    if arguments.json and arguments.json.exists():
        rows = {(r["task"], r["agent"], r["who"]): r for r in json.loads(arguments.json.read_text())["rows"]}
    for name in arguments.only:
        for task in arguments.tasks:
            if (name, task) not in BUDGETS:
                continue
            runs: dict[str, tuple[Callable[..., Returns], int]] = {"ours": (ours, arguments.seeds)}
            if not arguments.ours_only and (name, task) not in PUBLISHED:
                runs["theirs"] = (theirs, arguments.their_seeds)
            if (name, task) in PUBLISHED:
                mean, sd = PUBLISHED[name, task]
                row = {"task": task, "agent": name, "who": CLEANRL, "budget": BUDGETS[name, task]}
                rows[task, name, CLEANRL] = row | {"mean": mean, "sd": sd}
            library = "sbx-rl" if name == "sac" and util.find_spec("sbx") else "stable-baselines3"
            for who, (train, seeds) in runs.items():
                start = time.perf_counter()
                returns = train(name, task, seeds)
                summary: Summary = summarise(returns)
                low, high = summary.ci95 or (summary.mean, summary.mean)  # one seed has none
                took = time.perf_counter() - start
                print(
                    f"{task:9s} {name:5s} {who:7s} {summary.mean:7.1f} ± {summary.sd:5.1f} [{low:6.1f}, {high:6.1f}] "
                    f"{seeds} seeds, {BUDGETS[name, task]} steps, {took:.0f} s",
                    flush=True,
                )
                rows[task, name, who] = {
                    "task": task,
                    "agent": name,
                    "who": who,
                    "budget": BUDGETS[name, task],
                    "version": __version__ if who == "ours" else metadata.version(library),
                    "library": "uard" if who == "ours" else library,
                    "returns": returns,
                }
                if arguments.json:
                    arguments.json.write_text(json.dumps({"rows": list(rows.values())}, indent=2) + "\n")


if __name__ == "__main__":
    main()
