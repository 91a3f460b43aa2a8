"""Section f: Theorem 1 with frozen weights, with live ones, and what is left of sigma_m at the fixed point."""

from __future__ import annotations

import numpy as np

from uard.envs.grids.trapgrid import paper_grid
from uard.method import bellman
from uard.method.weights import reciprocal_weight
from uard.replication import paper
from uard.replication.audit.checks import Check
from uard.replication.audit.solutions import at_traps, solved, walk
from uard.replication.verdicts import Part

GRID = paper_grid(6)
WEIGHT = reciprocal_weight(paper.BETA * at_traps(GRID, paper.SIGMA_H_AT_TRAP), paper.LAMBDA)


def checks() -> list[Check]:
    """Return the checks of this part of the section."""
    return [_contraction(), _live(), _sigma_m()]


def _contraction() -> Check:
    task, pairs = GRID.task(), 500
    reward = np.asarray(task.reward, float)
    ratio = bellman.contraction_ratio(reward, WEIGHT, task.next_state, task.terminal, paper.GAMMA, pairs=pairs)
    return Check(
        "f.contraction",
        printed={"gamma": paper.GAMMA},
        recomputed={"largest ratio": ratio},
        others={"pairs": pairs},
        claims=(Part("no pair contracts by less", lambda n: n["largest ratio"] <= n["gamma"] + 1e-9),),
    )


def _live() -> Check:
    task, hack = GRID.task(), GRID.truth().hack
    reward = np.asarray(task.reward, float)
    first, second = (int(i) for i in np.argwhere(hack)[0])
    ratios = {
        f"trap +{r:g}": bellman.live_weight_expansion(
            np.where(hack, r, reward), task.next_state, task.terminal, paper.GAMMA, gap=1e-4, place=(first, second)
        ).ratio
        for r in (4.0, 10.0)
    }
    ratios["worst place of the 6x6 grid (entering the goal)"] = bellman.live_weight_expansion(
        reward, task.next_state, task.terminal, paper.GAMMA, gap=1e-4
    ).ratio
    return Check(
        "f.live",
        printed={"gamma": paper.GAMMA},
        recomputed=ratios,
        others={"least": min(ratios.values()), "heads": paper.HEADS},
        claims=tuple(Part(f"no expansion: {place}", lambda n, x=place: n[x] <= n["gamma"] + 1e-9) for place in ratios),
    )


def _sigma_m() -> Check:
    task = GRID.task()
    reward = np.asarray(task.reward, float)
    heads = np.random.default_rng(0).normal(0.0, 3.0, (*reward.shape, paper.HEADS))
    start = float(np.ptp(heads, axis=-1).max())
    for _ in range(600):
        heads = bellman.ensemble_backup(heads, reward, task.next_state, task.terminal, paper.GAMMA)
    raw = solved(GRID)
    lite, human = "UARD-lite visits", "human-only visits, acting on J"
    printed = {r.variant: r.visits.mean for r in paper.TABLE_5}
    return Check(
        "f.sigma-m",
        printed={"UARD-lite, printed": printed["UARD-lite"], "human-only, printed": printed["Human-only"]},
        recomputed={
            "largest gap between heads at first": start,
            "after 600 sweeps": float(np.ptp(heads, axis=-1).max()),
            "distance from raw Q": float(np.abs(heads.mean(-1) - raw).max()),
            lite: float(walk(GRID, heads.mean(-1)).total_visits),
            human: float(walk(GRID, raw * WEIGHT).total_visits),
        },
        claims=(
            Part("sigma_m vanishes (L1960)", lambda n: n["after 600 sweeps"] < 1e-9),
            Part("UARD-lite visits no more traps than Table 5 says", lambda n: n[lite] <= n["UARD-lite, printed"]),
            Part("UARD-lite visits fewer than human-only", lambda n: n[lite] < n[human]),
        ),
        findings=(
            Part("UARD-lite becomes raw Q-learning", lambda n: n["distance from raw Q"] < 1e-6),
            Part("Table 5 has it the other way round", lambda n: n["UARD-lite, printed"] < n["human-only, printed"]),
        ),
    )
