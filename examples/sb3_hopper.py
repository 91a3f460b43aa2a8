"""I train with Stable-Baselines3: PPO on a Hopper that is paid for leaning, with and without the filter.

python examples/sb3_hopper.py --steps 100000   (some eight minutes on one core)
"""

import argparse

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

import uard.envs  # noqa: F401 registers the ids
from uard.adapters.sb3 import ReliabilityCallback, ReliabilityVecEnv

ID = "uard/Hopper-Posture-v0"


def trained(filtered: bool, steps: int, seed: int, panel: str) -> PPO:
    """Train on what is paid; ``info["ratings"]`` is what the panel says of each step."""
    env = make_vec_env(ID, 8, seed=seed, env_kwargs={"panel": panel})
    if filtered:
        env = ReliabilityVecEnv(env)
    model = PPO("MlpPolicy", VecNormalize(env), n_steps=256, batch_size=64, seed=seed)
    return model.learn(steps, callback=ReliabilityCallback() if filtered else None)


def judged(model: PPO, episodes: int) -> tuple[float, float]:
    """Return the mean hacks and true return of deterministic episodes; nothing that learned has seen either."""
    normal, env = model.get_vec_normalize_env(), gymnasium.make(ID)
    assert normal is not None
    hacks = value = 0.0
    for episode in range(episodes):
        observation, _ = env.reset(seed=1000 + episode)
        over = False
        while not over:
            action, _ = model.predict(normal.normalize_obs(observation[None]), deterministic=True)
            observation, _, terminated, truncated, info = env.step(np.asarray(action)[0])
            hacks, value = hacks + info["evaluation"].hack, value + info["evaluation"].true_reward
            over = terminated or truncated
    return hacks / episodes, value / episodes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--panel", default="main")
    parser.add_argument("--episodes", type=int, default=10)
    options = parser.parse_args()
    torch.set_num_threads(1)
    for name, filtered in (("without", False), ("with", True)):
        model = trained(filtered, options.steps, options.seed, options.panel)
        hacks, value = judged(model, options.episodes)
        print(f"{name:8} the filter: {hacks:5.1f} hacks, true return {value:7.1f}", flush=True)


if __name__ == "__main__":
    main()
