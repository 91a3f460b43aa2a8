"""What returns of 42 and 110 look like, a hacker and a ``uard`` agent: Hopper, PPO, posture, filmed (a few minutes).

    MUJOCO_GL=egl python benchmarks/frames.py --folder src/uard/replication/results

Writes ``hopper-frames.webp``, a row of pictures per policy, and ``hopper-frames.json``, which says what each one is.
All act with their most likely actions. 42 and 110 are the paper's thresholds: shown is, of some episodes of each policy
that some agents have on their first steps of learning from the true reward, the one whose true return is nearest.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from PIL import Image

import uard
from uard.envs.locomotion.locomotion import Locomotion
from uard.envs.locomotion.regions import Posture
from uard.lab.registry import continuous_agents
from uard.method.mitigations import named
from uard.replication.studies.locomotion import RATED, STANDARD
from uard.training.host.loop import Job
from uard.training.host.loops import loop_of

THRESHOLDS = (42.0, 110.0)
PICTURES, HEIGHT, WIDTH, EVERY = 8, 120, 120, 2
EARLY, EPISODES, BEGINNERS = 61_440, 4, 5


def trained(job: Job) -> Iterator[tuple[Any, Any]]:
    """Yield a run's states as it learns, each with what acts in it."""
    loop = loop_of(job)
    simulator = job.environment.simulator(job.agent.envs, job.seed)
    state = loop.start(simulator)
    while state.steps < job.steps:
        state = loop.advance(state, simulator)
        yield state, loop.act


def walked(
    job: Job, state: Any, act: Any, episode: int = 0, film: bool = False
) -> tuple[list[np.ndarray], dict[str, float]]:
    """Return pictures of one episode, none unless it is filmed, and its numbers."""
    simulator = job.environment.simulator(1, episode)
    picture = simulator.camera(HEIGHT, WIDTH) if film else None
    pictures, hacks, value, length, over = [], 0, 0.0, 0, False
    while not over:
        if picture and length % EVERY == 0:
            pictures.append(picture(0))
        result = simulator.step(np.clip(act(state, simulator.observe()), -1.0, 1.0))
        hacks, value, length = hacks + int(result.hack[0]), value + float(result.true_reward[0]), length + 1
        over = bool(result.terminated[0] or result.truncated[0])
    return pictures, {"true_return": round(value, 1), "hacks": hacks, "length": length, "at": int(state.steps)}


def filmed(job: Job, state: Any, act: Any, episode: int = 0) -> tuple[list[np.ndarray], dict[str, float]]:
    """Return some pictures of one episode, evenly spread over it, and its numbers."""
    pictures, numbers = walked(job, state, act, episode, film=True)
    return [pictures[i] for i in np.linspace(0, len(pictures) - 1, PICTURES).round().astype(int)], numbers


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, default=Path())
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=STANDARD.steps)
    options = parser.parse_args()
    agent = continuous_agents(STANDARD.small)["ppo"]
    rows: list[list[np.ndarray]] = []
    facts: list[dict[str, Any]] = []

    def keep(label: str, film: tuple[list[np.ndarray], dict[str, float]]) -> None:
        pictures, numbers = film
        rows.append(pictures)
        facts.append({"label": label} | numbers)
        print(facts[-1], flush=True)

    def job(mitigation: str, reference: bool = False, seed: int = options.seed) -> Job:
        spec = Locomotion(region=Posture(), reference=reference)
        return Job(spec, agent, named(mitigation), seed, options.steps, rated=RATED)

    early = []
    for seed in range(options.seed, options.seed + BEGINNERS):
        honest = job("raw", reference=True, seed=seed)
        for state, act in trained(honest):
            if state.steps > EARLY:
                break
            kept = jax.tree.map(np.array, state)
            for episode in range(EPISODES):
                _, numbers = walked(honest, kept, act, episode)
                early.append((numbers["true_return"], partial(filmed, honest, kept, act, episode)))
    for wanted in THRESHOLDS:
        _, film = min(early, key=lambda x: abs(x[0] - wanted))
        keep(f"a true return of {wanted:.0f}", film())
    for label, one in (
        ("learned from the true reward", job("raw", reference=True)),
        ("learned from the reward that lies", job("raw")),
        ("the same, with uard", job("uard-0.1")),
    ):
        *_, (state, act) = trained(one)
        keep(label, filmed(one, state, act))

    Image.fromarray(np.vstack([np.hstack(row) for row in rows])).save(options.folder / "hopper-frames.webp", quality=75)
    command = f"MUJOCO_GL=egl python benchmarks/frames.py --seed {options.seed} --steps {options.steps}"
    found = {"command": command, "version": uard.__version__, "rows": facts}
    (options.folder / "hopper-frames.json").write_text(json.dumps(found) + "\n")


if __name__ == "__main__":
    main()
