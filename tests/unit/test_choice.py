"""Which rule is enough: by hand-made regrets."""

import numpy as np
import pytest

from uard.lab.studies.panels import FLOOR, GRIDS, MDPS, ORACLE, OURS, scenario
from uard.lab.views import choice
from uard.lab.views.panels import Regrets, kind_of_panel

SCENARIOS = range(1, 41, 2)  # twenty
ALL = {"all": np.ones(20, bool)}


def of(**regret):
    """The oracle earns 10, a random walk 0, so that a regret x is a return of 10 (1 - x)."""
    returns = {ORACLE: np.full(20, 10.0), FLOOR: np.zeros(20)}
    names = {name.replace("_", "-"): 10 * (1 - np.broadcast_to(x, 20)) for name, x in regret.items()}
    return Regrets.of(GRIDS, SCENARIOS, returns | names)


def only(found):
    (made,) = choice.choices(found, ALL)
    return made


def test_the_simplest_is_the_first_in_the_order_that_is_near_the_best_and_not_worse_than_ours():
    made = only(of(raw=2.0, median=0.04, lcb=0.0, uard=0.04))
    assert made.sufficient == ("median", "lcb", "uard")
    assert (made.simplest, made.best, made.scenarios) == ("median", "lcb", 20)
    assert not made.told_apart
    assert (made.simplest_regret.mean, made.ours.mean, made.best_regret.mean) == pytest.approx((0.04, 0.04, 0.0))


def test_a_little_worse_in_every_scenario_is_worse():
    """0.02 more is near enough, but all twenty signs agree: two of 2^20 patterns are as extreme."""
    assert only(of(median=0.03, uard=0.01)).sufficient == ("uard",)


def test_far_from_the_best_is_not_enough_though_nothing_is_told_apart():
    """One scenario in twenty is lost: no sign test tells that from chance, but 0.1 is more than the slack."""
    once = np.zeros(20)
    once[3] = 2.0
    made = only(of(median=once, uard=0.0))
    assert made.sufficient == ("uard",)
    near = only(of(median=once / 2, uard=0.0))  # a mean of 0.05
    assert near.sufficient == ("median", "uard")


def test_better_than_ours_beyond_noise_is_told_apart():
    made = only(of(worst_of_annotations=0.0, uard=0.04))
    assert (made.simplest, made.told_apart, made.best) == ("worst-of-annotations", True, "worst-of-annotations")
    assert OURS in made.sufficient  # near the best


def test_ours_is_not_sufficient_where_it_is_far_from_the_best():
    assert only(of(excess=0.0, uard=0.2)).sufficient == ("excess",)


def test_nothing_is_enough_where_even_the_best_loses_much():
    made = only(of(raw=0.9, uard=0.3))
    assert (made.simplest, made.simplest_regret, made.sufficient, made.told_apart) == (None, None, (), False)
    assert (made.best, made.best_regret.mean) == ("uard", pytest.approx(0.3))


def test_a_rule_whose_simplicity_nobody_ranked_comes_last():
    assert only(of(new_rule=0.0, uard=0.0)).sufficient == ("uard", "new-rule")


def test_groups_are_the_kinds_of_the_panels_that_were_drawn_and_hold_every_scenario_once():
    found = of(median=0.5, uard=0.0)
    made = choice.choices(found)
    kinds = [kind_of_panel(scenario(GRIDS, seed).panel) for seed in SCENARIOS]
    assert {m.kind: m.scenarios for m in made} == {kind: kinds.count(kind) for kind in kinds}
    assert sum(m.scenarios for m in made) == 20
    shares = choice.by_share_rated(found)
    assert sum(here.astype(int) for here in shares.values()).tolist() == [1] * 20
    assert list(shares) == sorted(shares, key=lambda name: -float(name.split()[0]))
    assert all(name.endswith("% of the steps rated") for name in shares)


@pytest.mark.parametrize("tasks", [GRIDS, MDPS])
def test_shares_are_those_of_the_tasks_own_scenarios(tasks):
    seeds = (3, 5, 9)
    shares = choice.by_share_rated(Regrets.of(tasks, seeds, {ORACLE: [9.0] * 3, FLOOR: [0.0] * 3, OURS: [9.0] * 3}))
    for i, seed in enumerate(seeds):
        assert shares[f"{100 * scenario(tasks, seed).rated:g} % of the steps rated"][i]
