import dataclasses
import json
import math
import subprocess
import sys
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from uard import InvalidValueError, LearningSignal, Mitigation, RewardDiscounting
from uard._checks import UnknownNameError
from uard.agents.tabular import QLearning
from uard.envs.grids.trapgrid import TrapGrid
from uard.lab.cell import RESULTS, Cell, plain
from uard.method.abstention import Abstention
from uard.method.mitigations import RatedReward, Raw, Screening, named

GOLDEN = "f6c55a69918eb82029fdea2566d4ac39"
FULL = Cell(
    TrapGrid(),
    named("uard"),
    QLearning(bootstrap=0.5, abstention=Abstention()),
)
CHANGED = {
    "panel": "single",
    "noise": 0.5,
    "rated": 0.5,
    "episodes": 7,
    "ddof": 1,
    "snapshots": 3,
    "environment.size": 7,
    "environment.traps": ((2, 2),),
    "environment.trap_reward": 5.0,
    "environment.true_trap_reward": -2.0,
    "environment.goal": (4, 4),
    "environment.goal_reward": 9.0,
    "environment.step_reward": -0.2,
    "environment.start": (1, 1),
    "environment.horizon": 41,
    "environment.legitimate": True,
    "agent.heads": 4,
    "agent.learning_rate": 0.2,
    "agent.gamma": 0.9,
    "agent.epsilon": 0.9,
    "agent.epsilon_decay": 0.99,
    "agent.epsilon_min": 0.01,
    "agent.bootstrap": 0.7,
    "agent.init_scale": 0.2,
    "agent.abstention": None,
    "agent.abstention.rule": "threshold",
    "agent.abstention.limit": 2.0,
    "agent.abstention.response": "ask",
    "agent.abstention.eps": 1e-5,
    "mitigation.filter.lam": 0.3,
    "mitigation.filter.alpha": 0.6,
    "mitigation.filter.beta": 0.6,
    "mitigation.filter.form": "exponential",
    "mitigation.acts_on": "both",
    "mitigation.anchor": "zero",
    "mitigation.kappa": 49.0,
    "mitigation.proxy_is_rater": False,
    "mitigation.standardise": False,
    "mitigation.unrated_weight": 0.2,
    "mitigation.prior_count": 3.0,
    "mitigation.backup": "consistent",
}


def with_changed(value, name, new):
    head, _, rest = name.partition(".")
    return replace(value, **{head: with_changed(getattr(value, head), rest, new) if rest else new})


def leaves(value, prefix=""):
    for f in dataclasses.fields(value):
        inner = getattr(value, f.name)
        if dataclasses.is_dataclass(inner):
            yield from leaves(inner, f"{prefix}{f.name}.")
        else:
            yield prefix + f.name


@dataclass(frozen=True)
class Own(Mitigation):
    k: float = 1.0
    note: object = None
    parts: tuple = ()
    inner: Raw = field(default_factory=Raw)

    def signal(self, evidence, usual):
        return LearningSignal(evidence.reward, 1.0)


class Bare(Mitigation):
    def signal(self, evidence, usual):
        return LearningSignal(evidence.reward, 1.0)


@dataclass
class Thawed(Mitigation):
    def signal(self, evidence, usual):
        return LearningSignal(evidence.reward, 1.0)


def test_every_field_is_tried_below():
    assert set(leaves(FULL)) | {"agent.abstention"} == set(CHANGED) | {"feedback", "steps", "query"}, (
        "test_deep_lab, test_locomotion_lab"
    )


def test_the_key_depends_on_every_field():
    keys = {name: with_changed(FULL, name, new).key for name, new in CHANGED.items()}
    assert len({FULL.key, *keys.values()}) == len(CHANGED) + 1


def test_the_key_depends_on_the_classes():
    cells = [
        Cell(mitigation=m) for m in (Raw(), RatedReward(), Screening(), Screening(0.4), RewardDiscounting(), Own())
    ]
    assert len({c.key for c in cells}) == len(cells)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (FULL, Cell(TrapGrid(), named("uard"), QLearning(bootstrap=0.5, abstention=Abstention()))),
        (Cell(TrapGrid(6)), Cell(TrapGrid(traps=((3, 3),), goal=(5, 5), horizon=40))),
        (Cell(agent=QLearning(epsilon=1)), Cell(agent=QLearning(epsilon=1.0))),
        (Cell(agent=QLearning(heads=1, bootstrap=0.5)), Cell(agent=QLearning(heads=1))),
        (Cell(mitigation=named("uard", lam=2, kappa=0)), Cell(mitigation=named("uard", lam=2.0, kappa=-0.0))),
        (Cell(TrapGrid(size=np.int64(6), step_reward=np.float64(-0.1))), Cell()),
        (Cell(episodes=np.int32(500)), Cell()),
        (
            Cell(mitigation=named("uard"), noise=1, rated=np.float32(0.5)),
            Cell(mitigation=named("uard"), noise=1.0, rated=0.5),
        ),
        (Cell(mitigation=Own(k=np.float64(2), parts=(np.int64(1), 0.0))), Cell(mitigation=Own(k=2, parts=(1, -0.0)))),
    ],
)
def test_equal_cells_have_equal_keys(one, other):
    assert one == other
    assert hash(one) == hash(other)
    assert one.key == other.key


@pytest.mark.parametrize("changes", [{"panel": "appendix"}, {"noise": 2.0}, {"rated": 0.1}])
def test_what_the_raters_do_does_not_matter_to_who_does_not_listen(changes):
    assert Cell(mitigation=Raw(), **changes) == Cell(mitigation=Raw())
    assert Cell(mitigation=RatedReward(), **changes).key != Cell(mitigation=RatedReward()).key


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"panel": "mian"}, r"^panel = 'mian': .*did you mean 'main'"),
        ({"panel": None}, "^panel = None"),
        ({"noise": -1}, r"^noise = -1: must be a finite number >= 0"),
        ({"noise": math.nan}, r"^noise = nan"),
        ({"noise": math.inf}, r"^noise = inf"),
        ({"noise": "1"}, r"^noise = '1'"),
        ({"rated": 2}, r"^rated = 2: must be a finite number in \[0, 1\]"),
        ({"rated": -0.1}, r"^rated = -0.1"),
        ({"rated": math.nan}, r"^rated = nan"),
        ({"episodes": 0}, r"^episodes = 0: must be a whole number in \[1, "),
        ({"episodes": 10**9}, "^episodes = 1000000000"),
        ({"episodes": 5.0}, r"^episodes = 5\.0"),
        ({"ddof": 2}, "^ddof = 2"),
        ({"snapshots": -1}, "^snapshots = -1"),
        ({"environment": 6}, "^environment = 6: must be a frozen dataclass that is a Spec"),
        ({"agent": "q-learning"}, "^agent = 'q-learning': must be a frozen dataclass that is a QLearning"),
        ({"mitigation": "uard"}, "^mitigation = 'uard': must be a frozen dataclass that is a Mitigation"),
        ({"mitigation": None}, "^mitigation = None"),
        ({"mitigation": Raw}, "^mitigation = <class .*Raw'>"),
        ({"mitigation": Bare()}, "^mitigation = .*Bare.*: must be a frozen dataclass"),
        ({"mitigation": Thawed()}, "^mitigation = .*Thawed.*: must be a frozen dataclass"),
        ({"mitigation": Own(k=math.nan)}, r"^mitigation\.k = nan: must be a finite number"),
        ({"mitigation": Own(k=np.float64(math.inf))}, r"^mitigation\.k = inf"),
        ({"mitigation": Own(note=[1])}, r"^mitigation\.note = \[1\]: must be a number, text"),
        ({"mitigation": Own(parts=(1, np.zeros(2)))}, r"^mitigation\.parts\[1\] = array"),
        ({"mitigation": Own(inner=Thawed())}, r"^mitigation\.inner = "),
    ],
)
def test_errors_name_the_field(changes, message):
    with pytest.raises(InvalidValueError, match=message):
        Cell(**changes)


def test_an_unknown_panel_is_an_unknown_name():
    with pytest.raises(UnknownNameError):
        Cell(panel="appendx")


def test_changing_a_cell_checks_it_again():
    assert FULL.with_(noise=1).noise == 1.0
    with pytest.raises(InvalidValueError, match=r"^noise"):
        FULL.with_(noise=-1)


def test_the_configuration_is_plain_data_that_names_its_classes():
    config = json.loads(json.dumps(FULL.config(), allow_nan=False))
    assert config["mitigation"]["class"] == "uard.method.mitigations.RewardDiscounting"
    assert config["mitigation"]["filter"]["lam"] == 0.2
    assert config["environment"]["traps"] == [[3, 3]]
    assert config == plain(FULL)
    assert not {"feedback", "steps", "query"} & set(config), "fields that came later, left out"


def test_keys_are_the_same_in_every_process_and_release():
    code = "from uard.lab.cell import Cell; print(Cell().key)"
    environment = {"PYTHONHASHSEED": "1", "PATH": ""}
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert RESULTS == 2
    assert Cell().key == other.stdout.strip() == GOLDEN
