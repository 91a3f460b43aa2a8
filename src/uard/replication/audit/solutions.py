"""Values, greedy walks and critical strengths of the filter on the paper's grids, exact by policy iteration."""

from __future__ import annotations

from functools import cache

import numpy as np

from uard.envs.grids.trapgrid import TrapGrid, paper_grid
from uard.method import bellman
from uard.method.weights import Form
from uard.replication import paper

SIZES = (6, 8, 10)
TRAP_REWARDS = (paper.TRAP_REWARD, paper.HARD_TRAP_REWARD)


def solved(grid: TrapGrid, weight: float | np.ndarray = 1.0, reward: np.ndarray | None = None) -> np.ndarray:
    """Return the fixed point of T_lambda, (S, A).

    Args:
        grid: The grid.
        weight: (S, A) or a number: w.
        reward: (S, A) rewards to learn from; those that the grid seems to pay if left out.
    """
    task = grid.task()
    r = np.asarray(task.reward if reward is None else reward, float)
    return bellman.solve(r, weight, task.next_state, task.terminal, paper.GAMMA)


def walk(grid: TrapGrid, scores: np.ndarray) -> bellman.GreedyPath:
    """Return the greedy walk from the start within the grid's horizon; ``scores`` is (S, A)."""
    return bellman.greedy_path(scores, grid.task(), grid.truth().hack)


def in_words(path: bellman.GreedyPath) -> str:
    """Say how often a walk visited traps, and whether it arrived."""
    return f"{path.total_visits} visits, {'goal' if path.reached_goal else 'no goal'}"


def at_traps(grid: TrapGrid, there: float, elsewhere: float = 0.0) -> np.ndarray:
    """Return an (S, A) table of one number for steps onto a trap and another one for all others."""
    return np.where(grid.truth().hack, there, elsewhere)


def straight_return(size: int) -> float:
    """Return of the shortest way to the goal that avoids the traps."""
    grid = paper_grid(size, trap_reward=paper.STEP_REWARD * 1000)
    path = walk(grid, solved(grid))
    rewards = np.asarray(grid.task().reward, float)
    return round(float(rewards[list(path.states[:-1]), list(path.actions)].sum()), 6)


def by_size(name: str, values: dict[int, float | None]) -> dict[str, float | None]:
    """Return values by grid size under names of their own."""
    return {f"{name}, {size}": value for size, value in values.items()}


def arriving(lambdas: dict[str, float | None]) -> list[float]:
    """Return the lambdas of those settings in which one arrives."""
    return [lam for lam in lambdas.values() if lam is not None]


def critical_ratio(size: int, trap_reward: float) -> float:
    """Return the largest w(trap) / w(elsewhere) at which T_lambda's fixed point goes to the goal."""
    grid = paper_grid(size, trap_reward)
    sigma = at_traps(grid, 2.0)
    lam = bellman.critical_lambda(grid.task(), grid.truth().hack, sigma, gamma=paper.GAMMA, beta=0.5)
    assert lam is not None
    return 1.0 / (1.0 + lam)


@cache
def critical_ratios() -> dict[tuple[int, float], float]:
    """Return the critical ratio by size and trap reward."""
    return {(size, reward): critical_ratio(size, reward) for reward in TRAP_REWARDS for size in SIZES}


@cache
def critical_lambdas(
    trap: float,
    elsewhere: float,
    trap_reward: float,
    form: Form = "reciprocal",
    anchor: float = 0.0,
    visits_allowed: int | None = None,
) -> dict[int, float | None]:
    """Return the smallest lambda at which T_lambda's fixed point goes to the goal, by grid size.

    Args:
        trap: sigma_h at traps.
        elsewhere: sigma_h of all other steps.
        trap_reward: What a trap pays.
        form: Of the filter.
        anchor: The pessimistic reward b.
        visits_allowed: Traps that may be crossed on the way; any number if left out.
    """
    grids = {size: paper_grid(size, trap_reward) for size in SIZES}
    return {
        size: bellman.critical_lambda(
            grid.task(),
            grid.truth().hack,
            at_traps(grid, trap, elsewhere),
            gamma=paper.GAMMA,
            beta=paper.BETA,
            form=form,
            anchor=anchor,
            visits_allowed=visits_allowed,
        )
        for size, grid in grids.items()
    }
