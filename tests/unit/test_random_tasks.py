"""Grids and MDPs drawn at random, and the oracle that regret is measured against."""

import numpy as np
import pytest

from uard import InvalidValueError
from uard.envs.grids.random_tasks import RandomMDP, random_grid
from uard.envs.grids.trapgrid import TrapGrid
from uard.lab import registry
from uard.lab.cell import Cell
from uard.lab.execution.training import train_batch
from uard.method.mitigations import named


def test_random_grids_are_what_they_are_said_to_be():
    grids = [random_grid(seed) for seed in range(400)]
    assert {g.size for g in grids} == set(range(5, 11))
    assert {len(g.traps) for g in grids} == {0, 1, 2, 3}
    lies = [bool(g.traps) and not g.legitimate for g in grids]
    assert np.mean(lies) == pytest.approx(0.6, abs=0.1)
    assert np.mean([not g.traps for g in grids]) == pytest.approx(0.2, abs=0.08)
    assert all(2 <= g.trap_reward <= 12 for g in grids)


def test_a_random_problem_lies_where_it_says_so_and_by_one_at_least():
    shares = []
    for seed in range(60):
        problem = RandomMDP(seed=seed)
        task, truth = problem.task(np.float64), problem.truth(np.float64)
        lie = np.abs(task.reward - truth.reward)
        assert ((lie > 0) == truth.hack).all()
        assert (lie[truth.hack] > 1.0).all()
        shares.append(truth.hack.mean())
    assert np.mean(shares) == pytest.approx((0.1 + 0.1 + 0.3) / 3, abs=0.04)
    assert RandomMDP(seed=1) == RandomMDP(seed=1)
    assert (RandomMDP(seed=1).task().reward != RandomMDP(seed=2).task().reward).any()


@pytest.mark.parametrize(("field", "value"), [("seed", -1), ("states_count", 1), ("actions", 1), ("horizon", 0)])
def test_what_makes_no_problem_is_refused_by_name(field, value):
    with pytest.raises(InvalidValueError, match=field):
        RandomMDP(**{field: value})


def test_the_oracle_learns_what_raw_cannot():
    """On 4x4 with a trap that pays 4 and costs 1, between start and goal, five seeds each."""
    grid = TrapGrid(size=4, traps=((1, 1),), trap_reward=4.0)
    cells = [Cell(grid, named(name), episodes=300) for name in ("raw", "true-reward")]
    returns = [np.mean([r.metrics()["true_return"] for r in train_batch([(c, s) for s in range(5)])]) for c in cells]
    assert returns[0] < 0 < 8 < returns[1]


def test_the_oracle_is_refused_where_no_trainer_can_tell_it_the_truth():
    with pytest.raises(InvalidValueError, match="mitigation"):
        Cell(TrapGrid(), named("true-reward"), registry.AGENTS["dqn"])
