"""Raters who lapse, skip steps and count in stars, in every training loop: a rating that is missing is missing."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
import pytest

from uard.agents.continuous import sac
from uard.agents.networks import Ensemble, Network
from uard.agents.policy import PPO
from uard.agents.tabular import QLearning
from uard.agents.value import DeepQ
from uard.envs.grids.trapgrid import TrapGrid
from uard.envs.locomotion.inverted_pendulum import InvertedPendulum
from uard.method.mitigations import named
from uard.ratings.panels import Panel, Rater
from uard.training.compiled import common, off_policy, on_policy, runs, tabular
from uard.training.feedback.rating_model import RatingModel
from uard.training.feedback.transition_model import TransitionModel
from uard.training.host import loop as host
from uard.training.host.loops import loop_of

GRID = TrapGrid(8, horizon=20)
LOW, HIGH, LEVELS = -2.0, 10.0, [-2.0, 2.0, 6.0, 10.0]
HONEST, SHY, STARRED, LAPSING = range(4)
RATERS = (Rater(noise=0.0), Rater(noise=0.3, coverage=0.5), Rater(noise=1.0, stars=4), Rater(noise=0.0, lapse=0.5))
PANEL = Panel(RATERS, LOW, HIGH)
QUIET = Panel((Rater(coverage=0.1),) * 4)
ANSWERED = 1 - 0.9**4  # share of the steps on which anybody of the quiet panel answers
NETWORK = Network(hidden=16)
SMALL = TransitionModel(hidden=8, fits=5, batch=16, capacity=64)


@cache
def tables() -> list[dict[str, Any]]:
    """Train a tabular agent with either panel."""
    both = [
        tabular.make_run(GRID.task(), GRID.rating_law(panel), GRID.truth(), QLearning(), named("uard-0.1"), 0)
        for panel in (PANEL, QUIET)
    ]
    return tabular.train(both, tabular.Program(episodes=60), ("log", "steps", "feedback"))


@cache
def deep(which: str, model: RatingModel | None = None) -> list[dict[str, Any]]:
    """Train a deep agent with either panel."""
    replay = which == "replay"
    small = {"buffer": 1000, "batch": 16, "warmup": 64} if replay else {"envs": 4, "rollout": 32, "epochs": 1}
    agent = (DeepQ if replay else PPO)(NETWORK, Ensemble("full", 2), **small)
    both = [
        common.make_run(GRID.world(panel), agent, named("uard-0.1"), 0, rating_model=model) for panel in (PANEL, QUIET)
    ]
    train_one = off_policy.train_one if replay else on_policy.train_one
    fields = ("log", "steps", "feedback", "rated", "fault")
    return runs.train(both, train_one, common.Program(episodes=60, steps=1024, walk=4), fields, 2)


LOOPS: dict[str, Callable[[], list[dict[str, Any]]]] = {
    "tables": tables,
    "replay": partial(deep, "replay"),
    "rollout": partial(deep, "rollout"),
}


@pytest.mark.parametrize("loop", LOOPS)
def test_each_rater_is_remembered_as_often_as_they_answered(loop: str):
    out, _ = LOOPS[loop]()
    feedback, states, true = out["feedback"], GRID.states, GRID.truth().reward
    assert np.isfinite(out["log"]).all()
    assert not out.get("fault", 0)
    visits, counts, means = (x[:states] for x in (feedback.count, *feedback.by_rater[:2]))
    total = float(visits.sum())
    assert total == out["steps"] > 900
    for always in (HONEST, STARRED, LAPSING):
        np.testing.assert_array_equal(counts[..., always], visits)
    assert float(counts[..., SHY].sum()) / total == pytest.approx(0.5, abs=4.5 * 0.5 / math.sqrt(total))
    np.testing.assert_array_equal(feedback.raters[:states], (counts > 0).sum(-1))
    known, once = visits > 0, visits == 1
    assert set(feedback.raters[:states][known]) == {3.0, 4.0}, "somewhere the shy one has not answered yet"
    np.testing.assert_allclose(means[known][:, HONEST], true[known], rtol=1e-5)
    assert np.isin(np.round(means[once][:, STARRED], 4), LEVELS).all()
    told = counts[once] > 0
    np.testing.assert_allclose(feedback.mean[:states][once], means[once].mean(-1, where=told), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(feedback.lowest[:states][once], means[once].min(-1, where=told, initial=99), rtol=1e-5)


@pytest.mark.parametrize("loop", LOOPS)
def test_a_visit_on_which_nobody_answers_is_no_rated_visit(loop: str):
    _, out = LOOPS[loop]()
    rated, steps = float(out["feedback"].count.sum()), float(out["steps"])
    assert rated / steps == pytest.approx(ANSWERED, abs=4.5 * 0.48 / math.sqrt(steps))
    assert np.isfinite(out["log"]).all()


def test_a_model_of_ratings_learns_from_those_that_exist():
    for out in deep("replay", RatingModel(hidden=8, fits=2, batch=16)):
        assert not out["fault"]
        assert all(np.isfinite(x).all() for x in out["feedback"][:6])


@pytest.mark.parametrize("which", ["replay", "rollout"])
def test_on_a_simulator_missing_ratings_are_kept_as_missing(which: str):
    small = {"batch": 16, "warmup": 32, "buffer": 500} if which == "replay" else {"envs": 4, "rollout": 32, "epochs": 1}
    agent: Any = sac(network=NETWORK, **small) if which == "replay" else PPO(NETWORK, count_bonus=0.0, **small)
    job = host.Job(
        InvertedPendulum(), agent, named("uard-0.1"), 0, 512, PANEL, rated=0.5, rating_model=SMALL, evaluations=1
    )
    done, quiet = (host.run(loop_of(replace(job, panel=panel))) for panel in (PANEL, QUIET))
    ratings = done.state.reservoir.targets[:, :-1]
    missing = ~done.state.reservoir.answered[:, :-1]
    assert done.state.reservoir.seen[0] > len(ratings) == 64, "the sample is full"
    assert not missing[:, [HONEST, STARRED, LAPSING]].any()
    assert 0.2 < missing[:, SHY].mean() < 0.8
    assert np.isin(ratings[:, STARRED], LEVELS).all()
    assert np.isfinite(done.log).all()
    assert all(np.isfinite(x).all() for layer in done.state.model.layers for x in layer)
    share = quiet.state.reservoir.seen[0] / quiet.state.steps
    assert share == pytest.approx(0.5 * ANSWERED, abs=4.5 * 0.4 / math.sqrt(512))
    assert quiet.state.reservoir.answered[: quiet.state.reservoir.seen[0]].any(-1).all(), (
        "none in which nobody answered"
    )
