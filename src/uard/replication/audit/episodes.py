"""Episodes within a horizon, exactly: moments of epsilon-greedy policies by Markov chains, best policies by induction."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from uard.envs.grids.trapgrid import TrapGrid
from uard.method import bellman
from uard.replication import paper
from uard.replication.audit.solutions import solved

# Epsilon in each of the last episodes, counted from 0.
LAST_EPSILONS = paper.EPSILON[1] ** np.arange(paper.EPISODES - paper.LAST_EPISODES, paper.EPISODES)


class EpisodeMoments(NamedTuple):
    """Exact moments of one episode from the start, per policy: arrays of shape (P,)."""

    visits: np.ndarray
    visits_variance: np.ndarray
    success_rate: np.ndarray
    observed_return: np.ndarray


def episode_moments(grid: TrapGrid, policy: np.ndarray, epsilon: np.ndarray | float = 0.0) -> EpisodeMoments:
    """Return the exact moments of an epsilon-greedy policy within the grid's horizon, by a backward Markov chain.

    Args:
        grid: The grid.
        policy: (S, A) action probabilities of the greedy part.
        epsilon: (P,) probabilities in [0, 1] of a uniformly random action; one policy per entry.
    """
    task = grid.task()
    eps = np.atleast_1d(np.asarray(epsilon, float))
    share = 1.0 / policy.shape[1]
    steps = [
        (
            (1.0 - eps) * policy[:, [a]] + eps * share,
            task.next_state[:, a],
            *(np.asarray(table, float)[:, [a]] for table in (~task.terminal, grid.truth().hack, task.reward)),
        )
        for a in range(policy.shape[1])
    ]
    first = second = goal = total = np.zeros((len(policy), len(eps)))
    for _ in range(int(task.horizon)):
        now = [0.0, 0.0, 0.0, 0.0]
        for chance, entered, goes_on, hack, reward in steps:
            onwards = goes_on * first[entered]
            now[0] += chance * (hack + onwards)
            now[1] += chance * (hack * (1.0 + 2.0 * onwards) + goes_on * second[entered])
            now[2] += chance * (1.0 - goes_on + goes_on * goal[entered])
            now[3] += chance * (reward + goes_on * total[entered])
        first, second, goal, total = (np.asarray(x) for x in now)
    s = int(task.start)
    return EpisodeMoments(first[s], second[s] - first[s] ** 2, goal[s], total[s])


def hacker_policy(grid: TrapGrid, spread_ties: bool = True) -> np.ndarray:
    """Return (S, A) probabilities of the greedy policy of raw Q-learning's fixed point.

    Args:
        grid: The grid.
        spread_ties: Share equally between equally good actions; otherwise the first is taken.
    """
    q = solved(grid)
    if not spread_ties:
        return np.eye(q.shape[1])[bellman.greedy_actions(q)]
    best = (q >= q.max(1, keepdims=True) - 1e-9).astype(float)
    return best / best.sum(1, keepdims=True)


def most_visits(grid: TrapGrid) -> int:
    """Return the largest number of trap visits that any policy can make in one episode (backward induction)."""
    task, hack = grid.task(), np.asarray(grid.truth().hack, float)
    best = np.zeros(len(hack))
    for _ in range(int(task.horizon)):
        best = (hack + np.where(task.terminal, 0.0, best[task.next_state])).max(1)
    return round(float(best[int(task.start)]))


def visits_of_the_best(grid: TrapGrid, weight: float) -> int:
    """Return the trap visits of the policy that maximises the undiscounted return within the horizon.

    Args:
        grid: The grid.
        weight: What a trap's reward is multiplied by.
    """
    task, hack = grid.task(), grid.truth().hack
    reward = np.where(hack, weight, 1.0) * np.asarray(task.reward, float)
    value, policies = np.zeros(len(reward)), []
    for _ in range(int(task.horizon)):
        q = reward + np.where(task.terminal, 0.0, value[task.next_state])
        policies.append(bellman.greedy_actions(q))
        value = q.max(1)
    state, visits = int(task.start), 0
    for policy in reversed(policies):
        action = policy[state]
        visits += int(hack[state, action])
        if task.terminal[state, action]:
            break
        state = int(task.next_state[state, action])
    return visits
