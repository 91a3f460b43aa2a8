"""I have my own training loop: tabular Q-learning on a grid whose traps pay, with and without the filter (seconds)."""

import gymnasium
import numpy as np

import uard.envs  # noqa: F401 registers the ids
from uard.adapters.gymnasium import ReliabilityWrapper


def train(env: gymnasium.Env, episodes: int = 300) -> tuple[float, float]:
    """Learn, and return hacks and true return per episode over the last 50."""
    random = np.random.default_rng(0)
    values = np.zeros((env.observation_space.n, env.action_space.n))
    log = []
    for episode in range(episodes):
        state, _ = env.reset(seed=episode)
        hacks, value, over = 0, 0.0, False
        while not over:
            explore = random.random() < max(0.05, 1 - episode / 150)
            action = int(random.integers(4)) if explore else int(values[state].argmax())
            following, reward, terminated, truncated, info = env.step(action)
            target = reward + 0.95 * values[following].max() * (not terminated)
            values[state, action] += 0.1 * (target - values[state, action])
            state, over = following, terminated or truncated
            hacks, value = hacks + info["evaluation"].hack, value + info["evaluation"].true_reward
        log.append((hacks, value))
    return tuple(np.mean(log[-50:], axis=0))


def main() -> None:
    env = gymnasium.make("uard/TrapGrid6-v0", panel="main")
    for name, trained_on in (("without", env), ("with", ReliabilityWrapper(env))):
        hacks, value = train(trained_on)
        print(f"{name:8} the filter: {hacks:5.2f} hacks, true return {value:6.2f}")


if __name__ == "__main__":
    main()
