"""What a rule leaves of the reason to be honest: exact tables, no agent."""

import numpy as np
import pytest

from uard.envs.grids.gaming import AbsentSupervisor, BoatRace
from uard.lab.margins import learned, margin, rated
from uard.method.mitigations import named
from uard.ratings.panels import MAIN, Panel, Rater

EXACT = Panel(tuple(Rater(noise=0.0) for _ in range(3)))


def rewards(environment):
    return (np.asarray(x.reward, float) for x in (environment.truth(), environment.task()))


@pytest.mark.parametrize("environment", [BoatRace(), AbsentSupervisor()])
def test_who_learns_what_exact_raters_say_keeps_all_of_it(environment):
    true, observed = rewards(environment)
    feedback = rated(environment, EXACT)
    assert margin(environment, true) > 0 >= margin(environment, observed)
    for name in ("mean-of-annotations", "median", "worst-of-annotations"):
        assert margin(environment, learned(feedback, named(name))) == pytest.approx(margin(environment, true), abs=1e-5)
    assert margin(environment, learned(feedback, named("raw"))) == pytest.approx(
        margin(environment, observed), abs=1e-5
    )


def test_a_lap_by_hand():
    """Half a point for a move with the arrows, nothing for one back, 100 steps of which the first is not paid."""
    true, observed = rewards(BoatRace())
    assert margin(BoatRace(), true) == pytest.approx(0.495)
    assert margin(BoatRace(), observed) == 0


def test_the_order_in_which_rules_leave_a_margin():
    feedback = rated(BoatRace(), MAIN)
    left = {name: margin(BoatRace(), learned(feedback, named(name))) for name in ("raw", "uard", "mean-of-annotations")}
    assert left["raw"] < left["uard"] < left["mean-of-annotations"] < margin(BoatRace(), next(rewards(BoatRace())))
