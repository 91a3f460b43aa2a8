"""What a learned reward costs at most: V*(R) - V_pi(R) <= (E_d*[(R - r~)+] + E_d[(r~ - R)+]) / (1 - gamma)."""

import numpy as np
import pytest

from uard import Evidence
from uard.envs.grids.random_tasks import RandomMDP
from uard.method import bellman
from uard.method.mitigations import named
from uard.ratings.aggregate import aggregate

GAMMA = 0.9


def exact(task, policy: np.ndarray, reward: np.ndarray) -> tuple[float, np.ndarray]:
    """Return a policy's value at the start and its discounted visits of state-actions, by linear algebra."""
    states = np.arange(len(policy))
    ahead = np.zeros((len(policy), len(policy)))
    ahead[states, np.asarray(task.next_state)[states, policy]] = 1.0
    start = np.eye(len(policy))[int(task.start)]
    visits = np.zeros(reward.shape)
    visits[states, policy] = (1 - GAMMA) * np.linalg.solve(np.eye(len(policy)) - GAMMA * ahead.T, start)
    return float(np.linalg.solve(np.eye(len(policy)) - GAMMA * ahead, reward[states, policy])[int(task.start)]), visits


def regret_and_bound(task, truth: np.ndarray, learned: np.ndarray) -> tuple[float, float]:
    best, ours = (
        bellman.greedy_actions(bellman.solve(r, 1.0, task.next_state, task.terminal, GAMMA)) for r in (truth, learned)
    )
    (value_of_best, where_best), (value, where) = (exact(task, policy, truth) for policy in (best, ours))
    caution = (where_best * np.maximum(truth - learned, 0.0)).sum()
    overpaid = (where * np.maximum(learned - truth, 0.0)).sum()
    return value_of_best - value, (caution + overpaid) / (1 - GAMMA)


@pytest.mark.parametrize("name", ["raw", "median", "excess", "uard", "witness"])
def test_regret_is_bounded_by_what_is_lost_on_the_best_path_and_overpaid_on_ours(name):
    """Forty random problems of twelve states, four raters of whom one is tempted by every lie."""
    mitigation, regrets, bounds = named(name), [], []
    for seed in range(40):
        problem = RandomMDP(seed=seed, states_count=12, actions=3)
        task, random = problem.task(np.float64), np.random.default_rng(seed)
        truth = problem.truth(np.float64).reward
        said = truth[..., None] + 0.3 * random.normal(size=(*truth.shape, 4))
        said[..., 3] += 0.8 * (task.reward - truth)
        feedback = aggregate(said, task.reward)
        statistics = mitigation.fit(feedback, feedback.count > 0)
        learned = mitigation.signal(Evidence(task.reward, 0.0 * truth, feedback), statistics).reward
        regret, bound = regret_and_bound(task, truth, learned)
        assert -1e-9 <= regret <= bound + 1e-9
        regrets.append(regret)
        bounds.append(bound)
    assert max(regrets) > 0.0
    assert sum(regrets) > 0.03 * sum(bounds)  # and no such sum is far from what is really lost


def test_the_bound_is_attained():
    """A loop worth 0 seems worth 1, one worth 1 seems worth a little less: 10 are lost, and 10 are the bound."""

    class Loops:
        next_state, terminal = np.array([[0, 1], [1, 1]]), np.zeros((2, 2), bool)
        start = 0

    truth, learned = np.array([[0.0, 1.0], [1.0, 1.0]]), np.array([[1.0, 1.0 - 1e-9], [1.0 - 1e-9] * 2])
    assert regret_and_bound(Loops, truth, learned) == (pytest.approx(10.0), pytest.approx(10.0))
