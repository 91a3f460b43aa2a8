"""A simulated panel says at the page what it says to the laboratory."""

import numpy as np
import pytest

from uard._checks import InvalidValueError
from uard.collect import Project, Question
from uard.collect.simulate import Simulation, Visitor, law_by_reward, nearest
from uard.ratings.panels import PANELS, Panel, Rater


def simulation(tmp_path, panel, **question):
    project = Project.create(tmp_path / "project", Question(**question))
    return Simulation("http://127.0.0.1:1", {}, project, law_by_reward(panel))


def said(visit, *rewards, place=0):
    return visit.said([{"reward": r} for r in rewards], place, np.random.default_rng(0))


TRUTHFUL = Panel((Rater(noise=0.0), Rater(noise=0.0, bias=1.0)))


def test_values_are_within_what_can_be_answered(tmp_path):
    visit = simulation(tmp_path, TRUTHFUL, low=-1.0, high=1.0)
    assert said(visit, 0.25) == {"values": {"": 0.25}, "choice": None}
    assert said(visit, 0.25, place=1)["values"] == {"": 1.0}


def test_stars_thumbs_and_attributes(tmp_path):
    assert said(simulation(tmp_path / "a", TRUTHFUL, kind="stars", low=0.0, high=4.0), 2.4)["values"] == {"": 2.0}
    thumbs = simulation(tmp_path / "b", TRUTHFUL, kind="thumbs")
    assert [said(thumbs, r)["choice"] for r in (-0.1, 0.1)] == ["down", "up"]
    assert said(simulation(tmp_path / "c", TRUTHFUL, attributes=("safe",)), 0.5)["values"] == {"": 0.5, "safe": 0.5}


def test_pairs(tmp_path):
    visit = simulation(tmp_path, TRUTHFUL, kind="pairs")
    assert [said(visit, *r)["choice"] for r in ((1.0, 0.5), (0.5, 1.0), (0.5, 0.5))] == ["left", "right", "tie"]


def test_who_does_not_answer_skips(tmp_path):
    panel = Panel((Rater(coverage=1e-9),), low=-1.0, high=1.0)
    assert said(simulation(tmp_path / "a", panel), 0.5) == {"values": None, "choice": "skip"}
    assert said(simulation(tmp_path / "b", panel, kind="pairs"), 0.5, 0.1)["choice"] == "cannot tell"


def test_an_address_that_is_none(tmp_path):
    with pytest.raises(InvalidValueError, match=r"url = '127\.0\.0\.1:80'"):
        Visitor("127.0.0.1:80")
    with pytest.raises(OSError, match="refused"):
        Visitor("http://127.0.0.1:1", patience=0.0).ask("/api/next", {})


def test_nearest():
    assert nearest(9.0, Question(low=-1.0, high=1.0)) == 1.0
    assert nearest(0.3, Question(kind="stars", low=0.0, high=1.0, stars=3)) == 0.5


def test_the_law_by_reward_takes_it_for_true():
    law = law_by_reward(PANELS["main"])({"reward": 2.0})
    assert law.centre.tolist() == [2.0, 2.0, 2.0]
    assert law_by_reward(PANELS["main"])({"reward": None}).centre.tolist() == [0.0, 0.0, 0.0]
