"""SAC and EDAC in the replay loop: probe tasks whose values are known."""

from __future__ import annotations

from functools import cache
from typing import Any

import jax
import numpy as np
import pytest

from uard.agents.actor_critic import SoftActorCritic
from uard.agents.networks import Ensemble, Network
from uard.envs.tables import HiddenTruth, Task
from uard.envs.world import table_world
from uard.method.mitigations import named
from uard.ratings.panels import RatingLaw
from uard.training.compiled import off_policy, runs
from uard.training.compiled.common import QUANTITIES, Program, Run, make_run

# One program for all: EDAC, of which SAC is a case in numbers.
PROGRAM = Program(episodes=2500, steps=2500, walk=8)
FIELDS = ("log", "steps", "values", "walk", "fault", "good")
NETWORK = Network(hidden=16, learning_rate=3e-3, value_scale=2.0)


def probe(next_state: list, reward: list, terminal: list, horizon: int, seed: int = 0, **agent: Any) -> Run:
    task = Task(np.int32(next_state), np.float32(reward), np.array(terminal, bool), np.int32(0), np.int32(horizon))
    shape = task.reward.shape
    truth = HiddenTruth(task.reward, np.zeros(shape, bool), task.terminal)
    law = RatingLaw(np.zeros((*shape, 3), np.float32), np.ones((*shape, 3), np.float32))
    settings: dict[str, Any] = {"network": NETWORK, "ensemble": Ensemble("full", 2, 0.0), "buffer": 1000, "batch": 32}
    settings |= {"warmup": 64, "tau": 0.05, "entropy_decay": 0.998, "entropy_min": 0.2}
    return make_run(table_world(task, truth, law, 3), SoftActorCritic(**(settings | agent)), named("raw"), seed)


def train(*several: Run) -> list[dict[str, Any]]:
    return runs.train(list(several), off_policy.train_one, PROGRAM, FIELDS, 2)


def temperature(out: dict[str, Any]) -> float:
    return float(NETWORK.value_scale * np.exp(out["good"].trained.log_temperature))


def surprise(out: dict[str, Any]) -> np.ndarray:
    """Entropy of the final policy in every state."""
    x = np.eye(3, dtype=np.float32)
    for i, (weight, bias) in enumerate(out["good"].trained.actor):
        x = x @ weight + bias
        x = np.maximum(x, 0) if i < 2 else x
    log_chances = np.asarray(jax.nn.log_softmax(x))
    return -(np.exp(log_chances) * log_chances).sum(-1)


def chain(**agent: Any) -> Run:
    """Two steps; the second action of the first state ends the episode."""
    return probe([[1, 0], [1, 1]], [[0.5, 0.3], [2.0, 1.0]], [[False, True], [True, True]], 9, **agent)


@cache
def trained() -> dict[str, Any]:
    return train(chain())[0]


def test_a_step_is_worth_its_reward_and_the_soft_value_after_it():
    out = trained()
    assert out["fault"] == 0
    mean, _, low = out["values"]
    np.testing.assert_allclose(mean[1], [2.0, 1.0], atol=0.1)
    np.testing.assert_allclose(mean[0, 1], 0.3, atol=0.1)
    entropies = surprise(out)
    share = float(np.exp(-entropies[1]))  # bound of what the policy loses by its randomness
    after = 0.95 * np.array([2.0 - (1 - share) + temperature(out) * entropies[1], 2.0 + temperature(out) * np.log(2)])
    assert after[0] - 0.1 < low[0, 0] - 0.5 < after[1] + 0.1
    np.testing.assert_array_equal(out["walk"][0][:3], [0, 2, -1], err_msg="the best way, though it begins unvisited")


def test_the_policy_keeps_about_the_wanted_entropy():
    out = trained()
    visited = surprise(out)[:2].mean() / np.log(2)
    assert 0.05 < visited < 0.5, "asked for 0.2"
    late = out["log"][int(out["log"][:, 4].astype(bool).sum()) - 200 :]
    assert late[late[:, 4] > 0, 2].mean() > 1.9, "of 2.5, with a fifth of the entropy left"


@pytest.mark.parametrize("horizon", [1, 7])
def test_a_cut_off_episode_bootstraps_and_a_finished_one_does_not(horizon: int):
    """An endless loop is worth (r + temperature x entropy) / (1 - gamma), however early it is cut off."""
    settings: dict[str, Any] = {"gamma": 0.6, "entropy": 1.0, "entropy_decay": 1.0, "temperature": 0.01}
    cut, ended = train(*(probe([[0, 0]], [[2.0, 2.0]], [[over, over]], horizon, **settings) for over in (False, True)))
    mean = cut["values"][0][0]
    assert 4.9 < mean.min() <= mean.max() < 2.0 / 0.4 + 0.6 * temperature(cut) * np.log(2) / 0.4 + 0.15
    np.testing.assert_allclose(ended["values"][0][0], 2.0, atol=0.05)


def test_the_same_run_twice_gives_the_same():
    (again,), (other,) = train(chain()), train(chain(seed=1))
    jax.tree.map(np.testing.assert_array_equal, trained(), again)
    assert (other["values"][0] != again["values"][0]).any()


def test_divergence_is_noticed_and_harms_no_other_run():
    broken = probe([[1, 0], [0, 0]], [[0.5, 0.3], [0.0, np.nan]], [[False, True], [True, False]], 9)
    out, healthy = train(broken, chain())
    jax.tree.map(np.testing.assert_array_equal, trained(), healthy)
    assert QUANTITIES[int(out["fault"])] in ("reward", "loss")
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(out["good"]))


def test_diversity_drives_the_critics_apart():
    together, apart = train(chain(diversity=0.0), chain(diversity=0.3))
    assert apart["fault"] == 0
    assert apart["values"][1][:2].mean() > together["values"][1][:2].mean()
