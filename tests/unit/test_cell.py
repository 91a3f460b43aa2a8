import dataclasses
import hashlib
import importlib
import json
import math
import os
import pkgutil
import subprocess
import sys
import typing
from contextlib import closing
from dataclasses import dataclass, field, replace
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import uard
from uard import InvalidValueError, LearningSignal, Mitigation, RewardDiscounting, plugins
from uard.agents.base import Agent
from uard.agents.tabular import QLearning
from uard.envs.base import Environment
from uard.envs.grids.trapgrid import TrapGrid
from uard.lab.cell import Cell
from uard.lab.config import FORMAT, key_of, plain, type_name
from uard.lab.execution import runner
from uard.lab.execution.store import Store
from uard.lab.language.setting import Grpo, Language
from uard.lab.registry import AGENTS, CONTINUOUS, ENVIRONMENTS
from uard.lab.result import Result
from uard.lab.trainers import TRAINERS
from uard.method.abstention import Abstention
from uard.method.mitigations import RatedReward, Raw, Screening, named
from uard.ratings.panels import PANELS, Panel, Rater
from uard.training.feedback.rating_model import RatingModel
from uard.training.feedback.transition_model import TransitionModel

GOLDEN = "948d549bc5d29ff78cc507a969ccdd5c"
FULL = Cell(
    TrapGrid(),
    named("uard-0.1"),
    QLearning(bootstrap=0.5, abstention=Abstention()),
    Panel((Rater(), Rater()), -1.0, 10.0),
)
CHANGED = {
    "panel.raters": (Rater(), Rater(lapse=0.1)),
    "panel.low": -2.0,
    "panel.high": 20.0,
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


RATER = {
    "temptation": 0.5,
    "bias": 0.1,
    "scale": 2.0,
    "noise": 0.3,
    "contested_noise": 0.1,
    "lapse": 0.2,
    "coverage": 0.9,
    "stars": 5,
    "outliers": 0.05,
    "veto_above": 5.0,
    "veto": -1.0,
}


@dataclass(frozen=True)
class Own(Mitigation):
    k: float = 1.0
    note: object = None
    parts: tuple = ()
    inner: Raw = field(default_factory=Raw)

    def signal(self, evidence, usual):
        return LearningSignal(evidence.reward, 1.0)


@dataclass(frozen=True)
class Misnamed(Mitigation):
    type: str = "a"

    def signal(self, evidence, usual):
        return LearningSignal(evidence.reward, 1.0)


@dataclass(frozen=True)
class Typed(Mitigation):
    on: bool = True
    count: int = 1
    size: "float | None" = None
    name: str = "x"

    def signal(self, evidence, statistics):
        return LearningSignal(evidence.reward, 1.0)


@dataclass(frozen=True)
class NoKind(Environment):
    horizon: int = 5


@dataclass(frozen=True)
class NoFamily(Agent):
    pass


class Bare(Mitigation):
    def signal(self, evidence, usual):
        return LearningSignal(evidence.reward, 1.0)


@dataclass
class Thawed(Mitigation):
    def signal(self, evidence, usual):
        return LearningSignal(evidence.reward, 1.0)


def test_every_field_is_tried_below():
    elsewhere = {"rating_model", "steps", "query"}  # test_deep_lab, test_locomotion_lab
    assert set(leaves(FULL)) | {"agent.abstention"} == set(CHANGED) | elsewhere
    assert set(RATER) == {f.name for f in dataclasses.fields(Rater)}


def test_the_key_depends_on_every_field():
    keys = {name: with_changed(FULL, name, new).key for name, new in CHANGED.items()}
    needs = {"veto": {"veto_above": 1.0}}
    changed = [Rater(**{n: v}, **needs.get(n, {})) for n, v in RATER.items()]
    raters = [FULL.with_(panel=Panel((Rater(), other), -1.0, 10.0)).key for other in changed]
    assert len({FULL.key, *keys.values(), *raters}) == len(CHANGED) + len(RATER) + 1


def test_the_key_depends_on_the_classes():
    cells = [
        Cell(mitigation=m) for m in (Raw(), RatedReward(), Screening(), Screening(0.4), RewardDiscounting(), Own())
    ]
    assert len({c.key for c in cells}) == len(cells)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (FULL, Cell(TrapGrid(), named("uard-0.1"), FULL.agent, Panel((Rater(scale=1), Rater(bias=-0.0)), -1, 10))),
        (
            FULL.with_(panel=Panel((Rater(contested_noise=1),))),
            FULL.with_(panel=Panel((Rater(contested_noise=np.float64(1.0)),))),
        ),
        (Cell(TrapGrid(6)), Cell(TrapGrid(traps=((3, 3),), goal=(5, 5), horizon=40))),
        (Cell(agent=QLearning(epsilon=1)), Cell(agent=QLearning(epsilon=1.0))),
        (Cell(agent=QLearning(heads=1, bootstrap=0.5)), Cell(agent=QLearning(heads=1))),
        (Cell(mitigation=named("uard-0.1", lam=2, kappa=0)), Cell(mitigation=named("uard-0.1", lam=2.0, kappa=-0.0))),
        (Cell(TrapGrid(size=np.int64(6), step_reward=np.float64(-0.1))), Cell()),
        (Cell(episodes=np.int32(500)), Cell()),
        (
            Cell(mitigation=named("uard-0.1"), noise=1, rated=np.float32(0.5)),
            Cell(mitigation=named("uard-0.1"), noise=1.0, rated=0.5),
        ),
        (
            Cell(mitigation=Typed(np.True_, np.int64(1), 1, np.str_("x"))),
            Cell(mitigation=Typed(True, 1, np.float32(1.0), "x")),
        ),
        (Cell(mitigation=Own(k=np.float64(2), parts=(np.int64(1), 0.0))), Cell(mitigation=Own(k=2, parts=(1, -0.0)))),
    ],
)
def test_equal_cells_have_equal_keys(one, other):
    assert one == other
    assert hash(one) == hash(other)
    assert one.key == other.key


@pytest.mark.parametrize("changes", [{"panel": PANELS["appendix"]}, {"noise": 2.0}, {"rated": 0.1}])
def test_what_the_raters_do_does_not_matter_to_a_mitigation_that_asks_nobody(changes):
    assert Cell(mitigation=Raw(), **changes) == Cell(mitigation=Raw())
    assert Cell(mitigation=RatedReward(), **changes).key != Cell(mitigation=RatedReward()).key


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"panel": "main"}, r"^panel = 'main': must be .* a Panel, such as uard\.ratings\.panels\.PANELS\['main'\]$"),
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
        ({"environment": 6}, "^environment = 6: must be a frozen dataclass that is an Environment"),
        ({"agent": "q-learning"}, "^agent = 'q-learning': must be a frozen dataclass that is an Agent"),
        (
            {"mitigation": "uard"},
            r"^mitigation = 'uard': must be .*, such as uard\.method\.mitigations\.named\('",
        ),
        ({"mitigation": None}, "^mitigation = None"),
        (
            {"mitigation": Raw},
            r"^mitigation = <class .*Raw'>: must be .*this is a class: Raw\(\.\.\.\) makes one",
        ),
        ({"environment": NoKind()}, r"^environment = .*must be an Environment that declares its kind: tables, world, "),
        ({"agent": NoFamily()}, r"^agent = .*must be an Agent that declares its family: tabular, replay"),
        ({"feedback": None}, "^feedback = None: must be left out: the field is called rating_model now"),
        ({"mitigation": Typed(on=1)}, r"^mitigation\.on = 1: must be true or false"),
        ({"mitigation": Typed(count=1.0)}, r"^mitigation\.count = 1\.0: must be a whole number"),
        ({"mitigation": Typed(count=True)}, r"^mitigation\.count = True: must be a whole number"),
        ({"mitigation": Typed(size=True)}, r"^mitigation\.size = True: must be a finite number"),
        ({"mitigation": Typed(name=1)}, r"^mitigation\.name = 1: must be a text"),
        ({"mitigation": Bare()}, "^mitigation = .*Bare.*: must be a frozen dataclass"),
        ({"mitigation": Thawed()}, "^mitigation = .*Thawed.*: must be a frozen dataclass"),
        ({"mitigation": Own(k=math.nan)}, r"^mitigation\.k = nan: must be a finite number"),
        ({"mitigation": Own(k=np.float64(math.inf))}, r"^mitigation\.k = inf"),
        ({"mitigation": Own(note=[1])}, r"^mitigation\.note = \[1\]: must be a number, text"),
        ({"mitigation": Own(parts=(1, np.zeros(2)))}, r"^mitigation\.parts\[1\] = array"),
        ({"mitigation": Own(inner=Thawed())}, r"^mitigation\.inner = "),
        ({"mitigation": Misnamed()}, r"^mitigation\.type = .*without a field named 'type'"),
    ],
)
def test_errors_name_the_field(changes, message):
    with pytest.raises(InvalidValueError, match=message):
        Cell(**changes)


def test_classes_that_are_local_to_a_function_are_told_apart_and_kept_in_no_file(tmp_path):
    def local():
        @dataclass(frozen=True)
        class Mine(Raw):
            pass

        return Mine

    one, other = local(), local()
    assert Cell(mitigation=one()).key == Cell(mitigation=one()).key != Cell(mitigation=other()).key
    with closing(Store(tmp_path / "s.sqlite")) as store:
        with pytest.raises(InvalidValueError, match=r"class = '.*<locals>\.Mine': must be a class outside functions"):
            runner.run([(Cell(mitigation=one()), 0)], store)
        with pytest.raises(InvalidValueError, match="class = "):
            store.put([(Cell(mitigation=one()), 0, Result(np.ones((1, 6)), 1, np.zeros(1), {}))])
        assert store.count() == (0, 0)
    with closing(Store(":memory:")) as store:
        assert runner.run([(Cell(TrapGrid(3), mitigation=m(), episodes=5), 0) for m in (one, other)], store, 1) == 2


def test_changing_a_cell_checks_it_again():
    assert FULL.with_(noise=1).noise == 1.0
    with pytest.raises(InvalidValueError, match=r"^noise"):
        FULL.with_(noise=-1)


def test_the_configuration_is_plain_data_of_all_fields_with_the_names_of_classes():
    config = json.loads(json.dumps(FULL.config(), allow_nan=False))
    assert config["type"] == "Cell"
    assert config["mitigation"]["type"] == "RewardDiscounting"
    assert config["mitigation"]["filter"]["lam"] == 0.2
    assert config["environment"]["traps"] == [[3, 3]]
    assert config["panel"]["raters"][0]["type"] == "Rater"
    assert config == plain(FULL)
    assert config.keys() == {"type", *(f.name for f in dataclasses.fields(Cell))}, "nothing is left out"


def another(name, module):
    """A class of a name in a module, alike but for that."""

    @dataclass(frozen=True)
    class Made(Mitigation):
        limit: float = 0.5

        def signal(self, evidence, statistics):
            return LearningSignal(evidence.reward, 1.0)

    Made.__name__ = Made.__qualname__ = name
    Made.__module__ = module
    return Made


def test_a_class_that_moves_keeps_its_key_and_no_other_package_can_take_it():
    ours = Cell(mitigation=another("Screening", "uard.elsewhere.entirely")()).key
    assert ours == Cell(mitigation=Screening(0.5)).key
    homes = [another("Screening", m)() for m in ("theirs", "theirs.deeper.still", "uardian", "theirs2.uard")]
    theirs = [Cell(mitigation=m).key for m in homes]
    assert len({ours, *theirs}) == 5, "a package may have two classes of one name"
    assert [type_name(type(m)) for m in homes[1:3]] == ["theirs.deeper.still/Screening", "uardian/Screening"]


def test_a_registered_class_of_another_package_may_move(monkeypatch):
    keys = set()
    for module in ("theirs", "theirs.deeper.still"):
        kind = another("Screening", module)
        monkeypatch.setitem(sys.modules, module, SimpleNamespace(Screening=kind))
        entry = EntryPoint("screening", f"{module}:Screening", plugins.NAMED["mitigation"])
        found = (plugins.Plugin("mitigation", "screening", "theirs 1.0", entry),)
        monkeypatch.setattr(plugins, "found", lambda kind, found=found: found)
        keys.add(Cell(mitigation=kind()).key)
        assert type_name(kind) == "theirs/Screening"
    assert len(keys) == 1


def test_no_two_classes_of_ours_that_can_be_in_a_cell_have_one_name():
    """Those of environments, agents and mitigations, and of whatever stands in their fields or in a cell's."""
    for module in pkgutil.walk_packages([str(Path(uard.__file__).parent)], "uard."):
        if module.name.split(".")[1] in ("envs", "agents", "method", "ratings", "training", "lab"):
            importlib.import_module(module.name)
    kinds, seen = [Cell, Environment, Agent, Mitigation, RatingModel, TransitionModel], []
    while kinds:
        kind = kinds.pop()
        if kind in seen:
            continue
        seen.append(kind)
        kinds += [c for c in kind.__subclasses__() if getattr(sys.modules.get(c.__module__), c.__name__, None) is c]
        if dataclasses.is_dataclass(kind):
            hints = typing.get_type_hints(kind).values()
            kinds += [c for h in hints for c in (h, *typing.get_args(h)) if dataclasses.is_dataclass(c)]
    names = [type_name(kind) for kind in seen if kind.__module__.startswith("uard.")]
    assert len(set(names)) == len(names)
    assert {"TrapGrid", "PPO", "Rater", "Ensemble", "ReliabilityFilter", "Abstention", "Kick"} <= set(names)


def test_a_raised_version_changes_the_keys_of_that_kind_of_training_only(monkeypatch):
    cells = [Cell(), Cell(agent=AGENTS["dqn"]), Cell(agent=AGENTS["ppo"])]
    cells += [Cell(ENVIRONMENTS["Hopper"], agent=CONTINUOUS[name]) for name in ("sac", "ppo")]
    cells += [Cell(Language(), agent=Grpo())]
    assert [type(c.trainer) for c in cells] == [type(t) for t in TRAINERS], "one of each kind"
    for raised in cells:
        before = [c.key for c in cells]
        monkeypatch.setattr(type(raised.trainer), "version", raised.trainer.version + 1)
        after = [replace(c).key for c in cells]
        assert [b != a for b, a in zip(before, after, strict=True)] == [c is raised for c in cells]
        monkeypatch.undo()


def test_the_key_is_a_hash_of_format_trainer_and_configuration():
    text = json.dumps({"format": FORMAT, "trainer": ["tabular", 1], "cell": FULL.config()}, sort_keys=True)
    assert FULL.key == key_of(FULL.config(), "tabular", 1) == hashlib.sha256(text.encode()).hexdigest()[:32]


def test_keys_are_the_same_in_every_process_and_release():
    code = "from uard.lab.cell import Cell; print(Cell().key)"
    environment = {"PYTHONHASHSEED": "1", "PATH": ""} | {k: v for k, v in os.environ.items() if k == "PYTHONPATH"}
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert FORMAT == 3
    assert Cell().key == other.stdout.strip() == GOLDEN
