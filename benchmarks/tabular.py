"""How fast tabular training runs, on one core: plain Python, the fused program, and hand-written C.

    python benchmarks/tabular.py [--repetitions N] [--json FILE]

Everything trains five heads on uard/TrapGrid10-v0, pinned to one core. All contenders take turns, so that a busy
machine slows all of them; a ratio is taken within a turn, and time is the process's own on its core, so that what
others take of it is not counted. The Python loop and the C loops run raw Q-learning and keep the fused program's log.
The leanest C loop leaves out what the defaults do not need, the heads' bootstrap masks; the other draws and applies
them, as the fused program does. The plain mean of the annotations is what listening costs any rule: to simulate what
the raters answer and to remember it. Steps are environment steps actually taken; compilation is not counted. It takes
less than two minutes.
"""

from __future__ import annotations

import os

CORE = max(os.sched_getaffinity(0))
os.sched_setaffinity(0, {CORE})  # before NumPy and JAX start their threads

import argparse
import ctypes
import json
import platform
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from rich.console import Console
from rich.table import Table

from uard.agents.tabular import QLearning
from uard.envs.grids.trapgrid import paper_grid
from uard.method.mitigations import named
from uard.ratings.panels import PANELS
from uard.training.compiled import tabular as fused
from uard.training.episode_log import LOG

GRID = paper_grid(10)
AGENT = QLearning(heads=5)
EPISODES = 500
MITIGATIONS = ("raw", "mean-of-annotations", "uard")
PYTHON, C, C_MASKS = "Python + Gymnasium, raw", "C, raw, leanest", "C, raw, with masks"

C_SOURCE = r"""
#include <stdint.h>
#include <string.h>

enum { STATES = 100, ACTIONS = 4, HEADS = 5, ROOM = 8, LOG = 5 };

static inline uint64_t rotate(uint64_t x, int k) { return (x << k) | (x >> (64 - k)); }

static inline uint64_t draw(uint64_t s[4]) {  /* xoshiro256++ */
    uint64_t result = rotate(s[0] + s[3], 23) + s[0], t = s[1] << 17;
    s[2] ^= s[0]; s[3] ^= s[1]; s[1] ^= s[2]; s[0] ^= s[3]; s[2] ^= t; s[3] = rotate(s[3], 45);
    return result;
}

static inline float uniform(uint32_t bits) { return (float)(bits >> 8) * 0x1p-24f; }

/* One run. scored[s][a] holds (hack, true reward, observed reward, goal, 1). Returns the number of steps. */
int64_t train(const int32_t *next_state, const float *scored, const uint8_t *terminal, int32_t start, int32_t horizon,
              float rate, float gamma, float epsilon, float decay, float least, float scale,
              float bootstrap, int32_t episodes, uint64_t seed, float *log) {
    static float q[STATES][ACTIONS][ROOM] __attribute__((aligned(64)));
    static float mu[STATES][ACTIONS] __attribute__((aligned(64)));
    uint64_t random[4];
    for (int i = 0; i < 4; i++) {  /* splitmix64 */
        uint64_t z = (seed += 0x9e3779b97f4a7c15u);
        z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
        z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
        random[i] = z ^ (z >> 31);
    }
    memset(q, 0, sizeof q);
    for (int s = 0; s < STATES; s++)
        for (int a = 0; a < ACTIONS; a++) {
            float sum = 0;
            for (int n = 0; n < HEADS; n++)
                sum += q[s][a][n] = scale * (2 * uniform((uint32_t)draw(random)) - 1);
            mu[s][a] = sum;
        }
    int64_t steps = 0;
    float limit = bootstrap * 256;
    for (int episode = 0; episode < episodes; episode++) {
        float sums[LOG] = {0};
        int state = start, done = 0;
        for (int time = 0; !done; time++) {
            uint64_t bits = draw(random), mask = MASKS ? draw(random) : 0;
            const float *m = mu[state];
            int left = m[1] > m[0], right = 2 + (m[3] > m[2]);
            int best = m[right] > m[left] ? right : left;
            int action = uniform((uint32_t)bits) < epsilon ? (int)(bits >> 62) : best;
            int place = state * ACTIONS + action, following = next_state[place], over = terminal[place];
            float reward = scored[place * LOG + 2], keep = over ? 0.0f : gamma, sum = 0;
            float *own = q[state][action];
            float (*ahead)[ROOM] = q[following], fresh[ROOM];
            for (int n = 0; n < ROOM; n++) {
                float x = ahead[0][n] > ahead[1][n] ? ahead[0][n] : ahead[1][n];
                float y = ahead[2][n] > ahead[3][n] ? ahead[2][n] : ahead[3][n];
                float chosen = MASKS ? rate * ((float)(mask >> 8 * n & 255) < limit) : rate;
                fresh[n] = own[n] + chosen * (reward + keep * (x > y ? x : y) - own[n]);
            }
            for (int n = 0; n < ROOM; n++) own[n] = fresh[n];
            for (int n = 0; n < HEADS; n++) sum += fresh[n];
            mu[state][action] = sum;
            for (int i = 0; i < LOG; i++) sums[i] += scored[place * LOG + i];
            steps++;
            done = over || time + 1 >= horizon;
            state = following;
        }
        memcpy(log + episode * LOG, sums, sizeof sums);
        epsilon = epsilon * decay > least ? epsilon * decay : least;
    }
    return steps;
}
"""


@dataclass
class Run:
    """What a contender did in one turn: steps, seconds, and the mean log of its runs' last tenth of episodes."""

    steps: int
    seconds: float
    late: dict[str, float] | None = None


def python_loop(seconds: float) -> Callable[[int], Run]:
    """Raw Q-learning with NumPy tables on the Gymnasium environment."""
    env = gymnasium.make("uard/TrapGrid10-v0")
    states, actions = GRID.states, 4

    def turn(seed: int) -> Run:
        rng = np.random.default_rng(seed)
        q = rng.uniform(-AGENT.init_scale, AGENT.init_scale, (states, actions, AGENT.heads))
        epsilon, steps, begun = AGENT.epsilon, 0, time.process_time()
        log = []
        while time.process_time() - begun < seconds:
            state, _ = env.reset(seed=seed if not steps else None)
            visits, true_return, observed_return, length, done = 0, 0.0, 0.0, 0, False
            while not done:
                action = int(rng.integers(actions)) if rng.random() < epsilon else int(q[state].mean(1).argmax())
                following, reward, terminated, truncated, info = env.step(action)
                target = reward if terminated else reward + AGENT.gamma * q[following].max(0)
                q[state, action] += AGENT.learning_rate * (target - q[state, action])
                visits += info["evaluation"].hack
                true_return += info["evaluation"].true_reward
                observed_return += float(reward)
                length += 1
                state, done = following, terminated or truncated
            log.append((visits, true_return, observed_return, terminated, length))
            steps += length
            epsilon = max(AGENT.epsilon_min, AGENT.epsilon_decay * epsilon)
        return Run(steps, time.process_time() - begun)

    return turn


def fused_program(mitigation: str, count: int) -> Callable[[int], Run]:
    """The library's compiled program on ``count`` runs, one after the other."""
    task, truth = GRID.task(), GRID.truth()
    law, program = GRID.rating_law(PANELS["main"]), fused.Program(EPISODES)

    def turn(seed: int) -> Run:
        batch = [fused.make_run(task, law, truth, AGENT, named(mitigation), seed * count + i) for i in range(count)]
        begun = time.process_time()
        out = fused.train(batch, program)
        seconds = time.process_time() - begun
        logs = np.stack([o["log"] for o in out])
        return Run(int(sum(int(o["steps"]) for o in out)), seconds, late(logs))

    return turn


def late(logs: np.ndarray) -> dict[str, float]:
    """Mean log of the last tenth of episodes, (runs, episodes, columns)."""
    means = logs[:, -EPISODES // 10 :].mean((0, 1))
    return {name: round(float(mean), 3) for name, mean in zip(LOG[:5], means, strict=False)}


def compiler() -> str | None:
    """Return the path of the system's C compiler, if there is one."""
    return next(
        (path for name in (os.environ.get("CC"), "cc", "gcc", "clang") if name and (path := shutil.which(name))), None
    )


def c_loop(compiler_path: str, folder: Path, runs: int, masks: bool) -> Callable[[int], Run]:
    """The same runs in C, compiled for this CPU."""
    source, library = folder / "tabular.c", folder / f"tabular-{masks:d}.so"
    source.write_text(C_SOURCE)
    options = ["-O3", "-march=native", f"-DMASKS={masks:d}", "-shared", "-fPIC", "-o", str(library), str(source)]
    subprocess.run([compiler_path, *options], check=True)
    train = ctypes.CDLL(str(library)).train
    train.restype = ctypes.c_int64
    task, truth = GRID.task(), GRID.truth()
    columns = [truth.hack, truth.reward, task.reward, truth.goal, np.ones_like(task.reward)]
    tables = (
        np.ascontiguousarray(task.next_state, np.int32),
        np.ascontiguousarray(np.stack(columns, axis=-1), np.float32),
        np.ascontiguousarray(task.terminal, np.uint8),
    )
    numbers = (
        AGENT.learning_rate,
        AGENT.gamma,
        AGENT.epsilon,
        AGENT.epsilon_decay,
        AGENT.epsilon_min,
        AGENT.init_scale,
        AGENT.bootstrap,
    )

    def turn(seed: int) -> Run:
        logs = np.zeros((runs, EPISODES, 5), np.float32)
        pointers = [ctypes.c_void_p(t.ctypes.data) for t in tables]
        settings = [ctypes.c_float(x) for x in numbers]
        begun, steps = time.process_time(), 0
        for i in range(runs):
            steps += train(
                *pointers,
                ctypes.c_int32(int(task.start)),
                ctypes.c_int32(int(task.horizon)),
                *settings,
                ctypes.c_int32(EPISODES),
                ctypes.c_uint64(seed * runs + i),
                ctypes.c_void_p(logs[i].ctypes.data),
            )
        return Run(steps, time.process_time() - begun, late(logs))

    return turn


def measure(contenders: dict[str, Callable[[int], Run]], repetitions: int) -> dict[str, list[Run]]:
    """Let all contenders take turns; the first turn of each is not counted."""
    for turn in contenders.values():
        turn(0)
    runs: dict[str, list[Run]] = {name: [] for name in contenders}
    for repetition in range(1, repetitions + 1):
        for name, turn in contenders.items():
            runs[name].append(turn(repetition))
    return runs


def speeds(runs: list[Run]) -> list[float]:
    return [r.steps / r.seconds for r in runs]


def summary(values: list[float]) -> dict[str, float]:
    return {"median": statistics.median(values), "min": min(values), "max": max(values)}


def ratios(runs: dict[str, list[Run]]) -> Iterator[dict[str, Any]]:
    """Yield each promised ratio, taken within a turn."""
    raw = "fused, raw"
    promised = [
        ("fused raw / Python", raw, PYTHON, ">=", 200.0),
        ("leanest C / fused raw", C, raw, "<=", 3.0),
        ("C with masks / fused raw", C_MASKS, raw, "<=", 3.0),
        ("raw / mean: what listening costs", raw, "fused, mean-of-annotations", "", None),
        ("raw / uard: what the rule costs", raw, "fused, uard", "<=", 2.0),
    ]
    for label, above, below, sense, bound in promised:
        if above not in runs or below not in runs:
            continue
        values = [a / b for a, b in zip(speeds(runs[above]), speeds(runs[below]), strict=True)]
        found = {"ratio": label, **summary(values), "asked": None, "met": None}
        if bound is not None:
            met = statistics.median(values) >= bound if sense == ">=" else statistics.median(values) <= bound
            found |= {"asked": f"{sense} {bound:g}", "met": met}
        yield found


def cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or "unknown"


def surroundings(compiler_path: str | None) -> dict[str, str]:
    found = {name: version(name) for name in ("uard", "jax", "numpy", "gymnasium")}
    if compiler_path:
        found["C"] = subprocess.run([compiler_path, "--version"], capture_output=True, text=True).stdout.splitlines()[0]
    load = "/".join(f"{x:.1f}" for x in os.getloadavg())
    return {"cpu": cpu(), "core": str(CORE), "load": load, "python": platform.python_version(), **found}


def show(report: dict[str, Any]) -> None:
    console = Console()
    console.print(", ".join(f"{k} {v}" for k, v in report["surroundings"].items()), highlight=False)
    table = Table("contender", title=f"10x10, five heads, one core: million steps/s, {report['repetitions']} turns")
    for heading in ("median", "min", "max", "ns/step", "visits", "goals"):
        table.add_column(heading, justify="right")
    for name, row in report["contenders"].items():
        numbers = [f"{row[k] / 1e6:.3g}" for k in ("median", "min", "max")]
        found = [f"{row['late'][k]:.2f}" for k in ("hacks", "success")] if row["late"] else ["", ""]
        table.add_row(name, *numbers, f"{1e9 / row['median']:.0f}", *found)
    console.print(table)
    table = Table("ratio", "median", "min", "max", "asked", "met")
    for row in report["ratios"]:
        numbers = [f"{row[k]:.2f}" for k in ("median", "min", "max")]
        asked = [row["asked"], "yes" if row["met"] else "no"] if row["asked"] else ["", ""]
        table.add_row(row["ratio"], *numbers, *asked)
    console.print(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--repetitions", type=int, default=7, help="turns of every contender (default 7)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers there too")
    arguments = parser.parse_args()
    if arguments.repetitions < 1:
        parser.error(f"--repetitions = {arguments.repetitions}: must be a whole number >= 1")
    compiler_path = compiler()
    with tempfile.TemporaryDirectory() as folder:
        contenders = {PYTHON: python_loop(3.0 / arguments.repetitions)}
        contenders |= {f"fused, {name}": fused_program(name, count=64) for name in MITIGATIONS}
        if compiler_path:
            contenders[C] = c_loop(compiler_path, Path(folder), runs=128, masks=False)
            contenders[C_MASKS] = c_loop(compiler_path, Path(folder), runs=128, masks=True)
        else:
            print("no C compiler (cc, gcc, clang, $CC): the floor is left out", file=sys.stderr)
        runs = measure(contenders, arguments.repetitions)
    report = {
        "surroundings": surroundings(compiler_path),
        "repetitions": arguments.repetitions,
        "contenders": {name: {**summary(speeds(r)), "late": r[-1].late} for name, r in runs.items()},
        "ratios": list(ratios(runs)),
    }
    show(report)
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
