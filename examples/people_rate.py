"""People rate while an agent trains: a page, five raters, and Q-learning on a grid whose traps pay (half a minute).

Here a simulated panel answers at the page in place of people, through the same interface as their browsers. With
people, leave ``simulated`` out, and give them the links that ``uard collect serve`` prints.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import threading
import time

import gymnasium
import numpy as np

import uard.envs  # noqa: F401 registers the ids
from uard.adapters.gymnasium import ReliabilityWrapper
from uard.collect import Project, Question
from uard.collect.loop import StoreRatings
from uard.collect.recorder import ClipRecorder
from uard.collect.simulate import Simulation
from uard.envs.grids.trapgrid import TrapGrid
from uard.ratings.panels import as_panel

WINDOW = 100  # episodes at the end over which we report


def train(env: gymnasium.Env, episodes: int, seed: int, pause: float = 0.0) -> dict[str, float]:
    """Learn, and return goal rate, hacks and true return per episode over the last of them."""
    random = np.random.default_rng(seed)
    values = np.zeros((env.observation_space.n, env.action_space.n))
    log = []
    for episode in range(episodes):
        state, _ = env.reset(seed=seed * 1_000_000 + episode)
        hacks, value, over, terminated = 0, 0.0, False, False
        while not over:
            explore = random.random() < max(0.05, 0.995**episode)
            action = int(random.integers(4)) if explore else int(values[state].argmax())
            following, reward, terminated, truncated, info = env.step(action)
            target = reward + 0.95 * values[following].max() * (not terminated)
            values[state, action] += 0.1 * (target - values[state, action])
            state, over = following, terminated or truncated
            hacks, value = hacks + info["evaluation"].hack, value + info["evaluation"].true_reward
        log.append((terminated, hacks, value))
        time.sleep(pause)  # raters are slower than a grid
    goal, hacks, value = np.mean(log[-WINDOW:], axis=0)
    return {"goal_rate": float(goal), "hacks": float(hacks), "true_return": float(value)}


def simulated(url: str, project: Project, panel: str, size: int, seed: int) -> Simulation:
    """Return raters who say of every step what the panel would say, by links of their own."""
    law = TrapGrid(size=size).rating_law(as_panel(panel))
    with project.store() as store:
        links = {f"rater {k + 1}": store.invite(f"rater {k + 1}") for k in range(len(as_panel(panel).raters))}
    return Simulation(url, links, project, lambda item: law.at(*item["key"]), seed, idle=1e9)


def served(folder: str) -> tuple[subprocess.Popen, str]:
    """Start the page, and return its process and its address."""
    command = [sys.executable, "-m", "uard", "collect", "serve", folder, "--port", "0"]
    page = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    for line in page.stdout:
        if line.startswith("owner: "):
            return page, line.split()[1].removesuffix("/owner")
    raise SystemExit("the page did not start")


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--panel", default="random:8", help="who rates")
    options.add_argument("--size", type=int, default=6, help="of the grid")
    options.add_argument("--episodes", type=int, default=600)
    options.add_argument("--pause", type=float, default=0.01, help="seconds between episodes")
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--json", action="store_true", help="print the numbers as JSON")
    chosen = options.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        raters = len(as_panel(chosen.panel).raters)
        project = Project.create(folder, Question(low=-12.0, high=12.0, overlap=raters, repeats=0.0))
        page, url = served(folder)
        over = threading.Event()
        visit = simulated(url, project, chosen.panel, chosen.size, chosen.seed)
        panel = threading.Thread(target=visit.run, args=(over,))
        panel.start()
        try:
            env = gymnasium.make("uard/TrapGrid-v0", size=chosen.size, render_mode="rgb_array")
            env = ClipRecorder(env, project, share=0.05, again=9, seed=chosen.seed)  # 5 % of the steps are rated
            ratings = StoreRatings(project, env.observation_space, env.action_space, poll=0.1)
            env = ReliabilityWrapper(env, ratings=ratings)
            numbers = train(env, chosen.episodes, chosen.seed, chosen.pause)
            numbers |= {"clips": env.get_wrapper_attr("recorded"), "ratings": ratings.heard}
            env.close()
        finally:
            over.set()
            panel.join()
            page.terminate()
            page.wait()
    if chosen.json:
        print(json.dumps(numbers))
    else:
        print(f"{numbers['ratings']} ratings of {numbers['clips']} steps by {raters} raters, while it trained")
        print(
            f"the last {WINDOW} episodes: goal reached {numbers['goal_rate']:.2f}, hacks {numbers['hacks']:.2f}, "
            f"true return {numbers['true_return']:.2f}"
        )


if __name__ == "__main__":
    main()
