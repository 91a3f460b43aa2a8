from dataclasses import replace

import pytest

from uard import InvalidValueError
from uard._checks import UnknownNameError
from uard._support.fields import changed
from uard.agents.tabular import QLearning
from uard.cli.settings import mitigation, settings
from uard.envs.grids.trapgrid import PAPER_HORIZON, PAPER_TRAPS, TrapGrid
from uard.lab import registry as names
from uard.method.abstention import Abstention
from uard.method.mitigations import NAMED, RatedReward, RewardDiscounting, named


@pytest.mark.parametrize(
    ("pair", "expected"),
    [
        ("size=12", {"size": 12}),
        ("trap_reward=4.5", {"trap_reward": 4.5}),
        ("traps=[[2,5],[7,3]]", {"traps": [[2, 5], [7, 3]]}),
        ("legitimate=true", {"legitimate": True}),
        ("goal=null", {"goal": None}),
        ("anchor=zero", {"anchor": "zero"}),
        ('anchor="zero"', {"anchor": "zero"}),
        ("note=a=b", {"note": "a=b"}),
        ("empty=", {"empty": ""}),
        ("filter.lam=2", {"filter.lam": 2}),
    ],
)
def test_settings_are_json_or_text(pair, expected):
    assert settings((pair,)) == expected


def test_settings_are_read_once_each():
    assert settings(("size=8", "horizon=9")) == {"size": 8, "horizon": 9}
    assert settings(()) == {}
    with pytest.raises(InvalidValueError, match=r"^--set = 'size=8': must be left out: size was set to 6 before"):
        settings(("size=6", "horizon=9", "size=8"))


@pytest.mark.parametrize("pair", ["size", "=12", ""])
def test_a_setting_needs_a_name_and_a_value(pair):
    with pytest.raises(InvalidValueError, match=r"^--set-agent = .*: must be name=value, such as size=12"):
        settings((pair,), "--set-agent")


@pytest.mark.parametrize(
    ("base", "changes", "expected"),
    [
        (QLearning(), {}, QLearning()),
        (QLearning(), {"heads": 3, "gamma": 0.9}, QLearning(heads=3, gamma=0.9)),
        (QLearning(abstention=Abstention()), {"abstention.limit": 2}, QLearning(abstention=Abstention(limit=2.0))),
        (
            named("uard-0.1"),
            {"filter.lam": 3, "filter.form": "exponential", "kappa": 0},
            RewardDiscounting(filter=replace(named("uard-0.1").filter, lam=3.0, form="exponential"), kappa=0.0),
        ),
        (TrapGrid(), {"traps": [[1, 2]], "start": [0, 1]}, TrapGrid(traps=((1, 2),), start=(0, 1))),
        (TrapGrid(), {"legitimate": True}, TrapGrid(legitimate=True)),
    ],
)
def test_changed(base, changes, expected):
    assert changed(base, changes, "thing") == expected


@pytest.mark.parametrize("value", [4, 4.0])
def test_whole_numbers_become_floats_where_floats_belong(value):
    assert repr(changed(TrapGrid(), {"trap_reward": value}, "environment").trap_reward) == "4.0"
    assert repr(changed(QLearning(), {"epsilon": 1}, "agent").epsilon) == "1.0"
    assert repr(changed(QLearning(), {"heads": 2}, "agent").heads) == "2"


@pytest.mark.parametrize(
    ("base", "changes", "message"),
    [
        (TrapGrid(), {"sise": 12}, r"^environment setting = 'sise': must be one of .* \(did you mean 'size'\?\)"),
        (named("uard-0.1"), {"filter.lamb": 1}, r"^environment\.filter setting = 'lamb': .*did you mean 'lam'"),
        (named("uard-0.1"), {"filter": 1}, r"^environment setting = 'filter': must be one of filter\.lam, "),
        (named("uard-0.1"), {"kappa.x": 1}, r"^environment setting = 'kappa\.x': must be kappa"),
        (QLearning(), {"abstention.rule": "ratio"}, r"^environment setting = 'abstention\.rule': must be abstention"),
        (
            named("uard-0.1"),
            {"standardise": "False"},
            r"^environment setting standardise = 'False': must be true or false",
        ),
        (named("uard-0.1"), {"standardise": 1}, r"^environment setting standardise = 1: must be true or false"),
        (QLearning(), {"heads": 2.0}, r"^heads = 2\.0: must be a whole number"),
        (QLearning(), {"epsilon": True}, "^epsilon = True"),
        (TrapGrid(), {"size": [6]}, r"^size = \(6,\)"),
    ],
)
def test_changed_refuses(base, changes, message):
    with pytest.raises(InvalidValueError, match=message):
        changed(base, changes, "environment")


@pytest.mark.parametrize("name", names.ENVIRONMENTS)
def test_every_environment_comes_as_named(name):
    grid = names.environment(name, {})
    assert grid == names.ENVIRONMENTS[name]
    assert getattr(grid, "legitimate", False) == name.endswith("Legitimate")
    if not isinstance(grid, TrapGrid):
        return
    assert names.environment(name, {"size": grid.size}) == grid
    assert (grid.trap_reward == 8) == name.endswith("Trap8")
    assert grid.horizon == (100 if name.endswith("T100") else PAPER_HORIZON[grid.size])


def test_a_size_of_the_paper_brings_the_papers_traps_goal_and_horizon():
    for size, traps in PAPER_TRAPS.items():
        grid = names.environment("TrapGrid", {"size": size})
        assert (grid.traps, grid.goal, grid.horizon) == (traps, (size - 1, size - 1), PAPER_HORIZON[size])


def test_another_size_brings_its_own_goal_and_horizon():
    grid = names.environment("TrapGrid", {"size": 12, "traps": [[2, 5], [7, 3]], "trap_reward": 6})
    assert grid == TrapGrid(size=12, traps=((2, 5), (7, 3)), trap_reward=6.0)
    assert (grid.goal, grid.horizon) == ((11, 11), 96)
    assert names.environment("TrapGrid", {"size": 12}).traps == ()
    assert names.environment("TrapGrid10-T100", {"size": 12}).horizon == 96
    assert names.environment("TrapGrid", {"size": 12, "horizon": 90}).horizon == 90
    assert names.environment("TrapGrid", {"horizon": 90}) == TrapGrid(horizon=90)


def test_a_new_size_keeps_what_the_name_stands_for():
    assert names.environment("TrapGrid6-Trap8", {"size": 7}) == TrapGrid(size=7, trap_reward=8.0)
    assert names.environment("TrapGrid8-Legitimate", {"size": 10}) == TrapGrid(size=10, legitimate=True)
    assert names.environment("TrapGrid8-Trap8", {"size": 10, "trap_reward": 1}).trap_reward == 1.0


@pytest.mark.parametrize("size", [1, 257, 6.0, "six", True, None, {}])
def test_a_silly_size_is_refused(size):
    with pytest.raises(InvalidValueError, match=r"^size = .*: must be a whole number in \[2, 256\]"):
        names.environment("TrapGrid", {"size": size})


@pytest.mark.parametrize("name", NAMED)
def test_every_mitigation_comes_as_named(name):
    assert mitigation(name, {}) == named(name)


@pytest.mark.parametrize(
    ("name", "changes", "expected"),
    [
        ("uard-0.1", {"lam": 2, "kappa": 1}, named("uard-0.1", lam=2.0, kappa=1.0)),
        ("uard-0.1", {"filter.lam": 2}, named("uard-0.1", lam=2.0)),
        (
            "uard-paper",
            {"alpha": 0, "beta": 1, "form": "wiener"},
            named("uard-paper", alpha=0.0, beta=1.0, form="wiener"),
        ),
        ("lcb", {"k": 2}, RatedReward("bound", k=2.0)),
    ],
)
def test_mitigations_take_the_filters_settings_as_their_own(name, changes, expected):
    assert mitigation(name, changes) == expected


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("urad", {}, r"^mitigation = 'urad': .*did you mean 'uard'"),
        ("uard-0.1", {"lamda": 1}, r"^mitigation setting = 'lamda': must be one of .*did you mean 'lam'"),
        ("raw", {"lam": 1}, r"^mitigation setting = 'lam'"),
        ("lcb", {"lam": 1}, r"^mitigation setting = 'lam': must be one of k, statistic, unrated_weight"),
        ("uard-0.1", {"lam": -1}, r"^lam = -1\.0: must be a finite number >= 0"),
        ("uard-0.1", {"alpha": 2}, r"^alpha = 2\.0: must be a finite number in \[0, 1\]"),
        ("uard-0.1", {"form": "expnential"}, r"^form = 'expnential': .*did you mean 'exponential'"),
        ("uard-0.1", {"anchor": 5}, r"^anchor = 5: must be one of lowest, zero"),
    ],
)
def test_mitigations_refuse(name, changes, message):
    with pytest.raises(InvalidValueError, match=message):
        mitigation(name, changes)


def test_agents():
    assert names.agent("q-learning", {"heads": 1}) == QLearning(heads=1)
    walker = names.agent("random-walk", {})
    assert (walker.epsilon, walker.epsilon_decay, walker.epsilon_min) == (1, 1, 1)
    abstaining = names.agent("q-learning", {"abstention.rule": "threshold", "abstention.limit": 2})
    assert abstaining.abstention == Abstention("threshold", 2.0)


@pytest.mark.parametrize("value", ["safe", {"rule": "ratio"}, True])
def test_abstention_is_set_by_its_parts(value):
    with pytest.raises(InvalidValueError, match=r"^agent setting = 'abstention': must be one of abstention\.rule, "):
        names.agent("q-learning", {"abstention": value})


@pytest.mark.parametrize(
    ("look_up", "wrong", "right"),
    [
        (lambda n: names.environment(n, {}), "TrapGird", "TrapGrid"),
        (lambda n: names.environment(n, {}), "trapgrid", "TrapGrid"),
        (lambda n: names.agent(n, {}), "qlearning", "q-learning"),
        (lambda n: names.agent(n, {}), "randomwalk", "random-walk"),
        (lambda n: mitigation(n, {}), "uardpaper", "uard-paper"),
    ],
)
def test_unknown_names_suggest_the_nearest(look_up, wrong, right):
    with pytest.raises(UnknownNameError, match=rf"= '{wrong}': must be one of .*\(did you mean '{right}'\?\)"):
        look_up(wrong)
