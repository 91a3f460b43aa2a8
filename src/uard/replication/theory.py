"""What can be computed exactly about T_lambda on the paper's grids: for the ledger and the report."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from uard.envs.grids.trapgrid import PAPER_TRAPS, TrapGrid, paper_grid
from uard.envs.tables import Task
from uard.method import bellman
from uard.method.stability import DEFINITIONS, Definition, sign_preservation_radius
from uard.method.weights import reciprocal_weight
from uard.ratings.panels import as_panel
from uard.replication import paper

RATERS = (
    "1.247 at traps, 0 elsewhere",
    "panel main",
    "panel appendix",
)  # the paper's constants {-1, 2, 1}, and its panels


def expected_sigma_h(panel: str, size: int, trap: float, draws: int = 20_000, ddof: int = 0) -> tuple[float, float]:
    """Mean sigma_h of one visit's ratings, at a trap and elsewhere (seeded Monte Carlo)."""
    grid = paper_grid(size, trap)
    truth = grid.truth()
    law = grid.rating_law(as_panel(panel))
    rng = np.random.default_rng(0)
    means = []
    for where in (truth.hack, ~truth.hack):
        s, a = np.argwhere(where)[0]
        ratings = law.centre[s, a] + law.deviation[s, a] * rng.normal(size=(draws, law.centre.shape[-1]))
        means.append(float(ratings.std(-1, ddof=ddof).mean()))
    return means[0], means[1]


@dataclass(frozen=True)
class Critical:
    """The smallest lambda at which T_lambda's fixed point stops hacking, or None."""

    size: int
    trap: float
    panel: str
    critical: float | None


@cache
def critical_lambdas() -> tuple[Critical, ...]:
    """Every grid, trap reward and kind of ``RATERS``."""
    out = []
    for size in PAPER_TRAPS:
        for trap in (4.0, 8.0):
            grid = paper_grid(size, trap)
            task, hack = grid.task(), grid.truth().hack
            panels = (expected_sigma_h(p, size, trap) for p in ("main", "appendix"))
            kinds = ((paper.SIGMA_H_AT_TRAP, 0.0), *panels)
            for name, (at_trap, elsewhere) in zip(RATERS, kinds, strict=True):
                sigma = np.where(hack, at_trap, elsewhere)
                out.append(Critical(size, trap, name, bellman.critical_lambda(task, hack, sigma)))
    return tuple(out)


def weight_at_trap() -> float:
    """Return the filter's weight where sigma_h is the paper's 1.247 and the heads agree."""
    return float(reciprocal_weight(paper.BETA * paper.SIGMA_H_AT_TRAP, paper.LAMBDA))


def _sigma_h(grid: TrapGrid) -> np.ndarray:
    """Return what the main panel's raters are expected to disagree by, (S, A)."""
    at_trap, elsewhere = expected_sigma_h("main", grid.size, 4.0)
    return np.where(grid.truth().hack, at_trap, elsewhere)


def _frozen(size: int) -> tuple[Task, np.ndarray]:
    grid = paper_grid(size)
    return grid.task(), np.asarray(reciprocal_weight(paper.BETA * _sigma_h(grid), paper.LAMBDA))


@cache
def contraction() -> float:
    """Largest measured contraction ratio of T_lambda with frozen weights over the paper's grids."""
    ratios = []
    for size in PAPER_TRAPS:
        task, w = _frozen(size)
        ratios.append(bellman.contraction_ratio(task.reward, w, task.next_state, task.terminal, paper.GAMMA))
    return max(ratios)


@cache
def live_expansion() -> float:
    """How far the ensemble map with live weights can drive two ensembles apart, on 6x6 at the trap."""
    grid = paper_grid(6)
    task = grid.task()
    place = tuple(int(i) for i in np.argwhere(grid.truth().hack)[0])
    return bellman.live_weight_expansion(
        task.reward, task.next_state, task.terminal, paper.GAMMA, place=(place[0], place[1])
    ).ratio


@cache
def fixed_point_spread(starts: int = 20) -> float:
    """Largest difference between fixed points reached from random starts, 6x6."""
    task, w = _frozen(6)
    rng = np.random.default_rng(0)
    points = [
        bellman.fixed_point(
            task.reward, w, task.next_state, task.terminal, paper.GAMMA, start=rng.normal(0, 100, task.reward.shape)
        ).q
        for _ in range(starts)
    ]
    return float(np.ptp(np.stack(points), axis=0).max())


@cache
def live_fixed_point_spread(starts: int = 20, iterations: int = 600) -> float:
    """Largest difference between what the ensemble map with live weights reaches from random starts, 6x6.

    The map is no contraction, but all heads are given the same reward: their gaps shrink by gamma a step, sigma_m
    vanishes, and what is left is the map with weights frozen at sigma_h.

    Args:
        starts: Number of random ensembles, values of standard deviation 100.
        iterations: Of the map; 600 leave gamma^600 = 4e-14 of a gap.
    """
    grid = paper_grid(6)
    task, sigma_h = grid.task(), _sigma_h(grid)
    rng = np.random.default_rng(0)
    reached = []
    for _ in range(starts):
        heads = rng.normal(0, 100, (*task.reward.shape, paper.HEADS))
        for _ in range(iterations):
            heads = bellman.ensemble_backup(heads, task.reward, task.next_state, task.terminal, paper.GAMMA, sigma_h)
        reached.append(heads)
    return float(np.ptp(np.concatenate(reached, axis=-1), axis=-1).max())


class Bias(NamedTuple):
    """How far fixed points on 6x6 are from Q*, the optimal values of the true reward (maximum norm).

    Attributes:
        honest: Of the filtered true reward.
        filtered: Of the filtered reward with its trap.
        raw: Of the reward with its trap, unfiltered.
    """

    honest: float
    filtered: float
    raw: float


@cache
def bias() -> Bias:
    """Return how far the filter, and the trap, move the fixed point off Q*, main panel."""
    grid = paper_grid(6)
    task, w = _frozen(6)

    def values(reward: np.ndarray, weight: np.ndarray | float) -> np.ndarray:
        return bellman.solve(reward, weight, task.next_state, task.terminal, paper.GAMMA)

    true = np.asarray(grid.truth().reward)
    best = values(true, 1.0)
    honest, filtered, raw = (
        float(np.abs(q - best).max()) for q in (values(true, w), values(task.reward, w), values(task.reward, 1.0))
    )
    return Bias(honest, filtered, raw)


@dataclass(frozen=True)
class Hazard:
    """Does the best path enter a hazard, without and with the filter?"""

    reward: float
    lam: float
    enters_without: bool
    enters_with: bool


@cache
def hazard(reward: float = -2.0, lam: float = paper.LAMBDA) -> Hazard:
    """A hazard on the direct line of a 3-row grid, rated with sigma_h = 1.247; the detour costs two steps."""
    rows, columns = 3, 7
    step, goal = -0.1, 10.0
    moves = ((-1, 0), (1, 0), (0, -1), (0, 1))
    n = rows * columns
    entered = np.zeros((n, 4), np.int32)
    for s in range(n):
        r, c = divmod(s, columns)
        for a, (dr, dc) in enumerate(moves):
            entered[s, a] = min(max(r + dr, 0), rows - 1) * columns + min(max(c + dc, 0), columns - 1)
    danger, end, start = columns + 3, columns + 6, columns
    by_cell = np.full(n, step)
    by_cell[danger], by_cell[end] = reward, goal
    task = Task(entered, by_cell[entered], entered == end, start, 40)
    hack = entered == danger

    def enters(strength: float) -> bool:
        w = reciprocal_weight(paper.BETA * np.where(hack, paper.SIGMA_H_AT_TRAP, 0.0), strength)
        q = bellman.solve(task.reward, w, task.next_state, task.terminal, paper.GAMMA)
        return sum(bellman.greedy_path(q, task, hack).visits.values()) > 0

    return Hazard(reward, lam, enters(0.0), enters(lam))


@dataclass(frozen=True)
class Radius:
    """Sign-preservation radii of the raw and of the filtered agent by one definition, and the parts they come from."""

    definition: Definition
    raw: float
    filtered: float
    advantage: float
    weight: float


@cache
def radii() -> tuple[Radius, ...]:
    """Radii of the advantage of entering the trap, beside it, on 6x6: raw values, the trap's weight (sigma_h 1.247)."""
    grid = paper_grid(6)
    task, hack = grid.task(), grid.truth().hack
    q = bellman.solve(task.reward, 1.0, task.next_state, task.terminal, paper.GAMMA)
    s, a = (int(i) for i in np.argwhere(hack)[0])
    advantage = float(q[s, a] - np.delete(q[s], a).max())
    w = weight_at_trap()
    return tuple(
        Radius(
            d,
            float(sign_preservation_radius(advantage, 1.0, d)),
            float(sign_preservation_radius(advantage, w, d)),
            advantage,
            w,
        )
        for d in DEFINITIONS
    )
