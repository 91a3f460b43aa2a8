"""What can be computed exactly about T_lambda on the paper's grids: for the ledger and the report."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from uard.envs.grids.trapgrid import PAPER_TRAPS, paper_grid
from uard.envs.tables import Task
from uard.method import bellman
from uard.method.stability import DEFINITIONS, Definition, sign_preservation_radius
from uard.method.weights import reciprocal_weight
from uard.ratings.panels import ratings
from uard.replication import paper


def expected_sigma_h(panel: str, size: int, trap: float, draws: int = 20_000, ddof: int = 0) -> tuple[float, float]:
    """Mean sigma_h of one visit's ratings, at a trap and elsewhere (seeded Monte Carlo)."""
    grid = paper_grid(size, trap)
    task, truth = grid.task(), grid.truth()
    said = ratings(panel, task, truth)
    rng = np.random.default_rng(0)
    means = []
    for where in (truth.hack, ~truth.hack):
        s, a = np.argwhere(where)[0]
        spoken = said.centre[s, a] + said.deviation[s, a] * rng.normal(size=(draws, said.centre.shape[-1]))
        means.append(float(spoken.std(-1, ddof=ddof).mean()))
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
    """Every grid, trap reward and kind of rater: the paper's constants {-1, 2, 1}, and both panels as we build them."""
    out = []
    for size in PAPER_TRAPS:
        for trap in (4.0, 8.0):
            grid = paper_grid(size, trap)
            task, hack = grid.task(), grid.truth().hack
            kinds = {"1.247 at traps, 0 elsewhere": (paper.SIGMA_H_AT_TRAP, 0.0)}
            kinds |= {f"panel {p}": expected_sigma_h(p, size, trap) for p in ("main", "appendix")}
            for name, (at_trap, elsewhere) in kinds.items():
                sigma = np.where(hack, at_trap, elsewhere)
                out.append(Critical(size, trap, name, bellman.critical_lambda(task, hack, sigma)))
    return tuple(out)


def _frozen(size: int) -> tuple[Task, np.ndarray]:
    grid = paper_grid(size)
    at_trap, elsewhere = expected_sigma_h("main", size, 4.0)
    u = paper.BETA * np.where(grid.truth().hack, at_trap, elsewhere)
    return grid.task(), np.asarray(reciprocal_weight(u, paper.LAMBDA))


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
    w = float(reciprocal_weight(paper.BETA * paper.SIGMA_H_AT_TRAP, paper.LAMBDA))
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
