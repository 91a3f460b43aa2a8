"""Ten minutes: a task of your own, three people who rate, and the same training without and with the filter (seconds).

The task is a corridor of ten cells. The robot shall reach the right end; cell 3 has a broken sensor that pays 2 for
every step into it, and truly costs 1. Copy the file, put your environment into the place of ``Corridor`` and what your
people say into the place of ``people``.
"""

import gymnasium
import numpy as np
from gymnasium import spaces

from uard.adapters.gymnasium import ReliabilityWrapper

CELLS, BROKEN, GOAL = 10, 3, 9


class Corridor(gymnasium.Env):
    """Walk to the right end in at most 40 steps."""

    observation_space = spaces.Discrete(CELLS)
    action_space = spaces.Discrete(2)  # left, right

    def reset(self, *, seed=None, options=None):
        """Begin at the left end."""
        super().reset(seed=seed)
        self.cell, self.steps = 0, 0
        return self.cell, {}

    def step(self, action):
        """Go left or right; the info holds what it was truly worth, for whoever evaluates."""
        self.cell = int(np.clip(self.cell + (1 if action else -1), 0, CELLS - 1))
        self.steps += 1
        reward = 10.0 if self.cell == GOAL else 2.0 if self.cell == BROKEN else -0.1
        truth = -1.0 if self.cell == BROKEN else reward  # which nobody who learns ever sees
        return self.cell, reward, self.cell == GOAL, self.steps == 40, {"truth": truth}


def people(random):
    """Return a function that says what three people say of a batch of steps, in the reward's unit; NaN: no answer."""

    def rate(observations, actions, next_observations, rewards):
        truth = np.where(np.asarray(next_observations) == BROKEN, -1.0, rewards)
        ann = truth + random.normal(0.0, 0.2, len(truth))
        bob = truth + 0.5 + random.normal(0.0, 0.3, len(truth))  # is kind
        cat = 0.5 * (truth + rewards) + random.normal(0.0, 0.3, len(truth))  # half believes the sensor
        said = np.stack([ann, bob, cat], axis=1)
        return np.where(random.random(said.shape) < 0.5, said, np.nan)  # each answers every second time

    return rate


def learn(env, seed=0, episodes=200):
    """Learn with tabular Q-learning; return reward, truth and broken-sensor steps per episode over the last 50."""
    random = np.random.default_rng(seed)
    values = np.zeros((CELLS, 2))
    log = []
    for episode in range(episodes):
        cell, _ = env.reset(seed=seed + episode)
        paid, truth, broken, over = 0.0, 0.0, 0, False
        while not over:
            explore = random.random() < max(0.05, 1 - episode / 100)
            action = int(random.integers(2)) if explore else int(values[cell].argmax())
            after, reward, terminated, truncated, info = env.step(action)
            target = reward + 0.95 * values[after].max() * (not terminated)
            values[cell, action] += 0.2 * (target - values[cell, action])
            cell, over = after, terminated or truncated
            paid, truth = paid + info.get("raw_reward", reward), truth + info["truth"]
            broken += after == BROKEN
        log.append((paid, truth, broken))
    return np.mean(log[-50:], axis=0)


def main():
    raw = Corridor()
    filtered = ReliabilityWrapper(Corridor(), ratings=people(np.random.default_rng(1)))
    for name, env in (("without the filter", raw), ("with the filter", filtered)):
        paid, truth, broken = learn(env)
        print(f"{name:18}  paid {paid:6.1f}  worth {truth:6.1f}  broken sensor {broken:4.1f} times")
    filtered.reset(seed=0)
    for cell in (1, 2, 3):
        _, believed, _, _, info = filtered.step(1)
        print(
            f"into cell {cell}: paid {info['raw_reward']:5.2f}, learned {believed:5.2f}, believed {info['weight']:4.0%}"
        )


if __name__ == "__main__":
    main()
