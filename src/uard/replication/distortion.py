"""A reward that is distorted after training (H13, H15, H16; figures G12, G14, G15).

The paper shows "confidence-adjusted rewards" under an "adversarial reward distortion" and counts "exploit activations";
it defines none of the three. These definitions are OURS:

* Agents are trained on the true reward of the 6x6 grid. Then each acts greedily (with 5 % random steps) for 1000 steps.
* In three windows of 20 steps (at 200, 400 and 750, where the paper's curves peak) an adversary adds 1.5 to the
  observed reward of every step. The raters go on telling the truth as they see it.
* The confidence-adjusted reward is what an agent would learn from: for UARD its discounted reward; for SUNRISE the
  reward times the weight of its backup; for EDAC the reward less the critics' pessimism, mean less lowest.
* An exploit activation is a step in a window whose adjusted reward exceeds 0.3, the bound that the paper states for
  UARD.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from uard.agents.value import DeepQ
from uard.lab.cell import Cell
from uard.lab.result import TABLES, Result
from uard.lab.trainers.examine import STEPS, backup_trust, inside
from uard.method.mitigations import Evidence, Feedback, RatedReward, RewardDiscounting

BONUS = 1.5
THRESHOLD = 0.3
EPSILON = 0.05


class Trace(NamedTuple):
    """One seed's walk; arrays (STEPS,).

    Attributes:
        observed: The distorted reward: what a naive agent learns from.
        adjusted: The agent's confidence-adjusted reward.
        caution: What a static pessimist learns from, mean - sd over ratings and observed reward; without ratings
            ``observed``.
        lam: With UARD: lambda_t; else 0.
        counts: Whether the step lies in a window and is no arrival at the goal, which rightly pays.
    """

    observed: np.ndarray
    adjusted: np.ndarray
    caution: np.ndarray
    lam: np.ndarray
    counts: np.ndarray


def walk(cell: Cell, result: Result, seed: int) -> Trace:
    """Let a trained agent act while its reward is distorted."""
    task = cell.environment.task()  # type: ignore[attr-defined]
    held = {name: result.extra["tables"][..., i].astype(float) for i, name in enumerate(TABLES)}
    rng = np.random.default_rng(seed)
    start = int(np.atleast_1d(task.start)[0])
    state, time, places, rewards = start, 0, [], []
    for _ in range(STEPS):
        best = int(held["mu"][state].argmax())
        action = int(rng.integers(held["mu"].shape[1])) if rng.random() < EPSILON else best
        places.append((state, action))
        rewards.append(float(task.reward[state, action]))
        over = bool(task.terminal[state, action]) or time + 1 >= task.horizon
        state, time = (start, 0) if over else (int(task.next_state[state, action]), time + 1)
    rows, columns = np.array(places).T
    at = {name: table[rows, columns] for name, table in held.items()}
    observed = np.array(rewards) + BONUS * inside()
    counts = inside() & ~np.asarray(task.terminal)[rows, columns]
    if isinstance(cell.mitigation, RewardDiscounting):
        known, every = (_feedback(tables, len(cell.panel.raters)) for tables in (at, held))
        evidence, rated = Evidence(observed, at["sigma_m"], known), held["rated"] > 0
        why = cell.mitigation.explain(evidence, cell.mitigation.fit(every, rated))
        rival = RatedReward("bound")
        caution = rival.signal(evidence, rival.fit(every, rated)).reward
        return Trace(observed, np.asarray(why.signal.reward), np.asarray(caution), np.asarray(why.lam), counts)
    if isinstance(cell.agent, DeepQ):
        weight = backup_trust(at["sigma_m"], cell.agent.temperature)
        return Trace(observed, weight * observed, observed, 0.0 * observed, counts)
    return Trace(observed, observed - (at["mu"] - at["lowest_value"]), observed, 0.0 * observed, counts)


def _feedback(tables: dict[str, np.ndarray], raters: int) -> Feedback:
    """Return what the agent had learned of its raters, all of whom answer every question."""
    count, mean, lowest, sd, proxy = (tables[name] for name in ("count", "mean", "lowest", "sd", "proxy"))
    return Feedback(count, mean, lowest, sd, proxy, raters * np.ones_like(count))


def activations(trace: Trace) -> int:
    """Return the number of exploit activations."""
    return int((trace.counts & (trace.adjusted > THRESHOLD)).sum())
