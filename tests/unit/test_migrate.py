"""What was trained before format 3 is what is trained today, under new keys; and nothing of an old store is lost.

``old_results/format-2.sqlite`` was made by the code of commit 7f974e8 with one thread (``NPROC=1``), ``machine.json``
says where. ``CELLS`` are the same cells as they are said today.
"""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path

import pytest

from uard import InvalidValueError
from uard.agents.actor_critic import SoftActorCritic
from uard.agents.continuous import ensemble_sac, sac
from uard.agents.networks import Ensemble, Network
from uard.agents.off_policy import OffPolicy
from uard.agents.policy import CPO, PPO, TRPO
from uard.agents.tabular import QLearning
from uard.agents.value import DeepQ
from uard.cli import app
from uard.envs.classic.specs import CartPole
from uard.envs.grids.gaming import AbsentSupervisor, BoatRace, TomatoWatering
from uard.envs.grids.learned_reward import LearnedRewardGrid
from uard.envs.grids.trapgrid import TrapGrid
from uard.envs.locomotion.locomotion import Kick, Locomotion
from uard.envs.locomotion.regions import Posture
from uard.lab import studies
from uard.lab.cell import Cell
from uard.lab.config import plain
from uard.lab.execution import format_2
from uard.lab.execution.claims import Owner
from uard.lab.execution.format_2 import UnmappedError, new_config, new_key
from uard.lab.execution.migrate import lines, migrate
from uard.lab.execution.store import Store, StoreError
from uard.lab.result import METRICS, digest
from uard.lab.trainers import TRAINERS
from uard.lab.trainers.language import LanguageModel
from uard.lab.views.compare import compare
from uard.lab.views.published import Published, packaged
from uard.method.abstention import Abstention
from uard.method.mitigations import named
from uard.ratings.panels import PANELS
from uard.training.feedback.rating_model import RatingModel
from uard.training.feedback.transition_model import TransitionModel

HERE = Path(__file__).parent / "old_results"
GRID = TrapGrid(size=4, traps=((1, 2),), horizon=12)
NET, HEADS = Network(hidden=8), Ensemble("shared", 2)
REPLAY = {"batch": 8, "buffer": 64, "warmup": 32}
ROLL = {"envs": 4, "rollout": 16, "epochs": 2, "minibatches": 2}
ON = {"envs": 4, "rollout": 32, "epochs": 1, "minibatches": 2, "count_bonus": 0.0}
SOFT = {"network": Network(16, 1e-3, 1.0), "batch": 32, "warmup": 128}
TANH = Network(16, 1e-3, 100.0, "tanh")
SHORT, LONG = {"episodes": 20}, {"episodes": 40}
MODEL = {"rating_model": RatingModel(2, 8, fits=2, batch=16, predicts="ratings")} | SHORT
TRANSITIONS = {"rating_model": TransitionModel(2, 8, fits=4, batch=32, capacity=256, predicts="ratings")}
APPENDIX, COLLUDING, SINGLE = (PANELS[name] for name in ("appendix", "colluding", "single"))
LEARNED = LearnedRewardGrid(size=6, unrated=2, horizon=20)
HOPPERS = {
    "lies": Locomotion(horizon=100),
    "leans": Locomotion("hopper", region=Posture(), horizon=100),
    "walker": Locomotion("walker2d", 5, legitimate=True, horizon=100),
    "kicked": Locomotion(region=None, kick=Kick(step=20), horizon=100),
}
CELLS = (
    Cell(GRID, named("raw"), QLearning(), **LONG),
    Cell(GRID, named("uard-0.1"), QLearning(), APPENDIX, 1.2, 0.1, **LONG),
    Cell(replace(GRID, legitimate=True), named("uard-0.1"), QLearning(), COLLUDING, **LONG),
    Cell(GRID, named("uard-consistent"), QLearning(heads=2), **LONG),
    Cell(GRID, named("uard-paper"), QLearning(abstention=Abstention(response="ask")), rated=0.1, **LONG),
    Cell(GRID, named("lcb"), QLearning(), SINGLE, **LONG),
    Cell(GRID, named("worst-of-annotations"), QLearning(bootstrap=0.5), ddof=1, **LONG),
    Cell(GRID, named("screening"), QLearning(), snapshots=2, **LONG),
    Cell(LEARNED, named("uard-0.1"), QLearning(), **LONG),
    Cell(BoatRace(horizon=20), named("mean-of-annotations"), QLearning(), **LONG),
    Cell(AbsentSupervisor(horizon=20), named("uard-operator"), QLearning(), **LONG),
    Cell(GRID, named("uard-0.1"), DeepQ(NET, target_every=16, **REPLAY), **MODEL),
    Cell(
        GRID,
        named("uard-consistent"),
        DeepQ(NET, Ensemble("shared", 3), ucb=1.0, temperature=10.0, **REPLAY),
        rated=0.5,
        **SHORT,
    ),
    Cell(GRID, named("raw"), SoftActorCritic(NET, **REPLAY), **SHORT),
    Cell(TomatoWatering(factor=0.1, horizon=20), named("uard-0.1"), DeepQ(NET, conservative=1.0, **REPLAY), **MODEL),
    Cell(CartPole(horizon=50), named("raw"), PPO(NET, HEADS, **ROLL), **SHORT),
    Cell(GRID, named("uard-0.1"), PPO(NET, HEADS, **ROLL), APPENDIX, **MODEL),
    Cell(GRID, named("screening"), TRPO(NET, HEADS, **ROLL), **MODEL),
    Cell(GRID, named("uard-paper"), CPO(NET, HEADS, **ROLL), **SHORT),
    Cell(HOPPERS["lies"], named("uard-0.1"), PPO(TANH, HEADS, **ON), rated=0.3, steps=512, **TRANSITIONS),
    Cell(HOPPERS["leans"], named("raw"), TRPO(TANH, HEADS, **ON), steps=512),
    Cell(
        HOPPERS["walker"],
        named("lcb"),
        ensemble_sac(**SOFT),
        APPENDIX,
        0.6,
        0.3,
        steps=320,
        query="doubtful",
        **TRANSITIONS,
    ),
    Cell(HOPPERS["kicked"], named("raw"), sac(**SOFT), steps=320),
)
SEEDS = {"tabular": 8, "compiled-replay": 6, "compiled-rollout": 6, "simulated-replay": 1, "simulated-rollout": 1}


@pytest.fixture
def old(tmp_path):
    return Path(shutil.copy(HERE / "format-2.sqlite", tmp_path / "s.sqlite"))


def rows(path, statement):
    with closing(sqlite3.connect(path)) as db:
        return db.execute(statement).fetchall()


def change(path, *statements):
    with closing(sqlite3.connect(path)) as db, db:
        for statement, *values in statements:
            db.execute(statement, values)


def key_of(path, mitigation):
    ((key,),) = rows(path, f"select key from cells where config like '%{mitigation}%' limit 1")
    return key


def machine():
    """Return what decides the last bits of a result, as ``machine.json`` has it."""
    info = Path("/proc/cpuinfo")
    said = dict(line.split(":", 1) for line in info.read_text().split("\n\n")[0].splitlines()) if info.exists() else {}
    said = {name.strip(): value.strip() for name, value in said.items()}
    flags = sorted(f for f in said.get("flags", "").split() if f.startswith(("avx", "fma", "amx")))
    packages = {p: metadata.version(p) for p in ("jax", "jaxlib", "numpy", "optax", "mujoco")}
    return {"cpu": said.get("model name"), "flags": " ".join(flags), **packages}


def test_every_old_result_has_the_key_and_the_configuration_of_todays_cell(old):
    before = old.read_bytes()
    found = migrate(old)
    with closing(Store(old)) as store:
        assert {c: store.have(c) for c in CELLS} == {c: set(range(SEEDS[c.trainer.name])) for c in CELLS}
        assert store.configs() == {c.key: plain(c) for c in CELLS}
        assert store.quarantined() == []
    assert {type(c.trainer) for c in CELLS} == {type(t) for t in TRAINERS} - {LanguageModel}, (
        "all kinds that were there"
    )
    assert (found.cells, found.rows["results"], found.left) == (23, store_seeds(), {})
    assert found.backup.read_bytes() == before
    assert [p.name for p in old.parent.iterdir() if "migrating" in p.name] == []


def store_seeds():
    return sum(SEEDS[c.trainer.name] for c in CELLS)


NEWER = {"kicked"}  # parts of a result that came later
# One of each kind of training, and both panels of old. UARD_RETRAIN=all trains all of them, in two or three minutes.
TRAINED = CELLS if os.environ.get("UARD_RETRAIN") == "all" else [CELLS[i] for i in (1, 4, 11, 16, 20, 22)]
RETRAIN = """
import sys
from test_migrate import SEEDS, TRAINED
from uard.lab.execution import runner
from uard.lab.execution.store import Store

runner.run([(c, s) for c in TRAINED for s in range(SEEDS[c.trainer.name])], Store(sys.argv[1]), workers=1)
"""


@pytest.mark.slow
def test_trained_today_they_give_what_they_gave_then(old, tmp_path, as_users_compile):
    """Bit by bit on the machine that made them, else, and with a model of ratings, but for the noise over seeds."""
    migrate(old)
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    command = [sys.executable, "-c", RETRAIN, str(tmp_path / "today.sqlite")]
    subprocess.run(command, env=os.environ | {"PYTHONPATH": path}, check=True)
    assert {c.trainer.name for c in TRAINED} == SEEDS.keys()
    with closing(Store(old)) as then, closing(Store(tmp_path / "today.sqlite")) as now:
        found = compare(then, now)
        assert len(found.cells) == len(TRAINED)
        assert (len(found.only_a), found.only_b, found.damaged) == (len(CELLS) - len(TRAINED), {}, ())
        if machine() == json.loads((HERE / "machine.json").read_text()):
            assert [c.config for c in found.cells if c.config["rating_model"] is None and set(c.parts) - NEWER] == []
        assert not found.differs
        for c in TRAINED:
            (one, other) = then.get(c, [0])[0], now.get(c, [0])[0]
            assert one.log.shape[1:] == other.log.shape[1:]
            assert {n: a.shape for n, a in one.extra.items() if n != "ends"} == {
                n: a.shape for n, a in other.extra.items() if n not in {"ends", *NEWER}
            }


def test_what_else_an_old_store_knows_goes_along(old):
    raw, lcb = key_of(old, "QLearning%mitigation.Raw"), key_of(old, '"panel": "single"')
    ended = Owner("gone", "h", "p", 1, 1)
    change(
        old,
        ("insert into runs values ('gone', 'h', 'p', 1, 1, 5, 6, 7, 3, 2, null, null)",),
        ("insert into claims values (?, 90, 'gone', 1)", raw),
        ("insert into attempts values (?, 90, 'gone', 1)", raw),
        ("insert into failures values (?, 91, 'ValueError: no', 'all of it', '0.1.0', 'gone', 1)", raw),
        ("insert into quarantine values (?, 92, ?, 'torn', 1)", raw, b"\1\2"),
        ("update results set data = substr(data, 2) where key = ? and seed = 3", lcb),
    )
    migrate(old)
    with closing(Store(old, readonly=True)) as store:
        cell = next(c for c in CELLS if c.key in {k for k, _ in store.failures()})
        assert cell.mitigation == named("raw")
        assert store.failures()[cell.key, 91].traceback == "all of it"
        assert store.attempts()[cell.key, 90] == ["gone"]
        torn = next(c for c in CELLS if c.panel == SINGLE)
        assert sorted(store.quarantined()) == sorted([(cell.key, 92, "torn"), (torn.key, 3, "checksum does not match")])
        assert (ended, 1) in [(run.owner, run.claimed) for run in store.runs()]
    with closing(Store(old)) as store:
        assert store.missing(torn, range(8)) == [3]


def test_metrics_get_their_new_names_and_stay_sound(old):
    (text,) = rows(old, "select metrics from results where seed = 7 limit 1")[0]
    migrate(old)
    with closing(Store(old)) as store:
        assert sum(len(store.have(c)) for c in CELLS) == store_seeds()
        seven = [store.metrics(c, [7])[7] for c in CELLS if 7 in store.have(c)]
    was = json.loads(text)
    assert "trap_visits" in was
    assert {format_2.METRICS.get(name, name): value for name, value in was.items()} in seven


def test_what_has_no_new_key_is_told_and_stays_in_the_backup(old):
    raw = key_of(old, "QLearning%mitigation.Raw")
    config = rows(old, f"select config from cells where key = '{raw}'")[0][0]
    for key, name, new in (
        ("a", "uard.mitigation.Raw", "uard.mitigation.Vanished"),
        ("b", "uard.agents.tabular.QLearning", "no_such_package.Learner"),
        ("c", "uard.mitigation.Raw", "scripts.make.<locals>.Mine"),
        ("d", '"panel": "main"', '"panel": "two"'),
    ):
        change(old, ("insert into cells values (?, ?)", key, config.replace(name, new)))
        change(old, ("insert into failures values (?, 0, 'e', 't', 'v', 'x', 1)", key))
    change(old, ("insert into attempts values ('nobody', 0, 'x', 1)",))
    found = migrate(old)
    said = "\n".join(lines(found))
    assert sorted(found.left.values()) == [1] * 5
    for why in (
        "uard had no class uard.mitigation.Vanished",
        "its agent no_such_package.Learner cannot be imported",
        "the class scripts.make.<locals>.Mine is local to a function",
        "no cell of format 2 looked like that",
        "no configuration is stored with their keys",
    ):
        assert f"only in {found.backup}: 1 rows, for {why}" in said
    assert rows(found.backup, "select count(*) from failures") == [(4,)]
    assert rows(old, "select count(*) from failures") == [(0,)]


def test_a_field_that_is_no_more_can_only_be_left_out():
    old = json.loads(rows(HERE / "format-2.sqlite", "select config from cells where config like '%Locomotion%'")[0][0])
    assert old["environment"]["spikes"] is None
    assert "spikes" not in new_config(old)["environment"]
    old["environment"]["spikes"] = {"class": "uard.envs.mujoco.Spikes", "chance": 0.1, "size": 10.0}
    with pytest.raises(UnmappedError, match="the spikes of a Locomotion are no more"):
        new_config(old)


@dataclass(frozen=True)
class Theirs(DeepQ):
    """An agent of another package."""


def test_what_other_packages_bring_has_the_name_of_its_package():
    cell = next(c for c in CELLS if isinstance(c.agent, SoftActorCritic))
    old = rows(HERE / "format-2.sqlite", "select config from cells where config like '%SoftActorCritic%'")[0][0]
    theirs = json.loads(old.replace("uard.mitigation.Raw", "pack.deep.inside.Own"))
    config = new_config(theirs)
    assert config == plain(cell) | {"mitigation": {"type": "pack.deep.inside/Own"}}
    assert new_key(config, theirs) != cell.key
    theirs["agent"]["class"] = f"{__name__}.Theirs"
    sys.modules.setdefault(__name__, sys.modules[Theirs.__module__])
    config = new_config(theirs)
    assert config["agent"]["type"].endswith("/Theirs")
    assert issubclass(Theirs, OffPolicy)
    assert new_key(config, theirs)
    theirs["agent"]["class"] = "pathlib.Path"
    with pytest.raises(UnmappedError, match=r"its agent pathlib\.Path is no uard\.agents\.base\.Agent"):
        new_key(new_config(theirs), theirs)


def test_an_old_store_is_opened_by_nobody_and_left_alone(old):
    before = old.read_bytes()
    for readonly in (False, True):
        with pytest.raises(StoreError, match=r"of format 3, but it is of format 2: `uard migrate .*` brings it over"):
            Store(old, readonly=readonly)
    change(old, ("pragma user_version = 4",))
    with pytest.raises(StoreError, match="but it is of format 4: a newer uard is needed"):
        Store(old)
    change(old, ("pragma user_version = 0",))
    assert old.read_bytes()[100:] == before[100:], "all but the counters in its head"


def test_a_store_at_work_is_not_migrated(old):
    owner = Owner.here()
    place = owner.host, owner.place, owner.pid, owner.born
    change(old, ("insert into runs values (?, ?, ?, ?, ?, 5, 6, 7, 0, 0, null, null)", owner.token, *place))
    with pytest.raises(StoreError, match=f"{owner.pid} is at work on it"):
        migrate(old)
    owner.stop()
    with closing(sqlite3.connect(old)) as other:
        other.execute("pragma journal_mode = wal")
        other.execute("begin immediate")
        with pytest.raises(StoreError, match=r"could not be migrated .*locked.*nothing was changed"):
            migrate(old)
        other.rollback()
    assert sorted(p.name for p in old.parent.iterdir()) == ["s.sqlite"]
    migrate(old)


def test_nothing_is_migrated_twice_or_over_a_backup(old, tmp_path):
    again = Path(shutil.copy(old, tmp_path / "again.sqlite"))
    (tmp_path / "s.sqlite.migrating").write_text("mine")
    migrate(old)
    assert (tmp_path / "s.sqlite.migrating").read_text() == "mine"
    with pytest.raises(StoreError, match="is of format 3 already; there is nothing to migrate"):
        migrate(old)
    (tmp_path / "again.sqlite.format-2").write_text("mine")
    with pytest.raises(InvalidValueError, match=r"whose backup is not there yet; move .*again\.sqlite\.format-2 away"):
        migrate(again)
    assert (tmp_path / "again.sqlite.format-2").read_text() == "mine"
    assert again.read_bytes() == (HERE / "format-2.sqlite").read_bytes()


def test_a_link_is_followed_and_the_file_behind_it_migrated(old, tmp_path):
    link, before = tmp_path / "link.sqlite", old.read_bytes()
    link.symlink_to(old)
    found = migrate(link)
    assert link.is_symlink()
    assert found.backup == Path(f"{old}.format-2")
    assert found.backup.read_bytes() == before
    with closing(Store(link)) as store:
        assert store.count()[1] == store_seeds()


def test_a_link_that_leads_nowhere_takes_the_place_of_the_backup(old, tmp_path):
    Path(f"{old}.format-2").symlink_to(tmp_path / "nowhere")
    with pytest.raises(InvalidValueError, match=r"move .* away"):
        migrate(old)
    assert not (tmp_path / "nowhere").exists()


@pytest.mark.parametrize("garbage", ["garbage", "[]", "7", "[" * 100_000, '{"class": 5}', '{"colour": "red"}'])
def test_a_row_that_is_garbage_is_told_and_stays_in_the_backup(old, garbage):
    raw = key_of(old, "QLearning%mitigation.Raw")
    if "colour" in garbage:
        (text,) = rows(old, f"select config from cells where key = '{raw}'")[0]
        garbage = json.dumps(json.loads(text) | {"colour": "red"})
    change(old, ("update cells set config = ? where key = ?", garbage, raw))
    change(old, ("update results set data = 'text' where rowid = (select max(rowid) from results)",))
    found = migrate(old)
    assert found.cells == len(CELLS) - 1
    assert any("no cell of format 2 looked like that" in why for why in found.left)
    assert found.rows["quarantine"] == 1


@pytest.mark.parametrize("garbage", ["text", {}, {"config": {"class": 5}, "seeds": [0], "metrics": {}}])
def test_a_published_cell_that_is_garbage_is_told_and_stays_in_the_backup(tmp_path, garbage):
    file = tmp_path / "p.json"
    file.write_text(json.dumps({"results": 2, "cells": {"x": garbage}}))
    found = migrate(file)
    assert (found.cells, sum(found.left.values())) == (0, 1)


def test_published_numbers_that_are_none_change_nothing(old, tmp_path):
    config = json.loads(rows(old, "select config from cells")[0][0])
    file, nan = tmp_path / "p.json", {"config": config, "seeds": [0], "metrics": {"trap_visits": [float("nan")]}}
    file.write_text(json.dumps({"results": 2, "cells": {"x": nan}}))
    with pytest.raises(InvalidValueError, match="without NaN"):
        migrate(file)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["p.json", "s.sqlite"]


def test_what_is_no_old_store_is_refused(tmp_path):
    for name, content in (("a.sqlite", "text" * 999), ("b.json", "{"), ("c.json", "[]"), ("d.json", '{"rows": []}')):
        (tmp_path / name).write_text(content)
        with pytest.raises((StoreError, InvalidValueError)):
            migrate(tmp_path / name)
        assert (tmp_path / name).read_text() == content
    with pytest.raises(InvalidValueError, match=r"path = .*none.*: must be a result store, or a JSON file"):
        migrate(tmp_path / "none")
    assert len(list(tmp_path.iterdir())) == 4


def test_published_results_are_migrated_alike(old, tmp_path):
    file, cells = tmp_path / "published.json", {}
    for key, config in rows(old, "select key, config from cells"):
        seeds = rows(old, f"select seed, metrics from results where key = '{key}' order by seed")
        each = [json.loads(text) for _, text in seeds]
        metrics = {m: [numbers[m] for numbers in each] for m in each[0]}
        cells[key] = {"config": json.loads(config), "seeds": [s for s, _ in seeds], "metrics": metrics}
    cells["x"] = {"config": {"class": "uard.lab.cell.Gone"}, "seeds": [0, 1], "metrics": {}}
    file.write_text(json.dumps({"command": "made so", "results": 2, "cells": cells}))
    before = file.read_bytes()
    found = migrate(file)
    assert (found.cells, found.rows["results"], sum(found.left.values())) == (23, store_seeds(), 2)
    assert found.backup.read_bytes() == before
    data = json.loads(file.read_text())
    assert {k: v for k, v in data.items() if k != "cells"} == {"command": "made so", "format": 3}
    assert Published((), [data]).cells == tuple(data["cells"])
    assert data["cells"].keys() == {c.key for c in CELLS}
    assert all(cell["metrics"].keys() == set(METRICS) for cell in data["cells"].values())
    with pytest.raises(InvalidValueError, match="must be published results of format 2"):
        migrate(file)


def test_all_that_is_published_is_what_studies_ask_for():
    asked = {r.cell.key for s in studies.every() for r in s.rows}
    assert len(packaged().cells) >= 843
    assert set(packaged().cells) <= asked


def test_the_command_says_what_became_of_everything(old, capsys):
    (Path(f"{old}-checkpoints")).mkdir()
    (Path(f"{old}-checkpoints") / "a-0.checkpoint").touch()
    app.main(["migrate", str(old)])
    out = " ".join(capsys.readouterr().out.split())
    assert f"{old}: 23 cells, {store_seeds()} seeds have new keys; 1 runs, {store_seeds()} attempts" in out
    assert "1 long runs begin again: their checkpoints are an older version's" in out
    assert f"the old file is kept as {old}.format-2" in out
    with pytest.raises(SystemExit) as left:
        app.main(["migrate", str(old)])
    assert left.value.code == 2


def test_a_migration_that_is_killed_leaves_the_old_store_or_the_new_one(old, tmp_path):
    """Killed when the new one is ready, before and after the backup is made."""
    code = (
        "import os, sqlite3, sys\n"
        "from uard.lab.execution import migrate\n"
        "step, left = migrate._keep, int(sys.argv[2])\n"
        "def killed(*a):\n"
        "    if sys.argv[2] == '1': step(*a)\n"
        "    os._exit(9)\n"
        "migrate._keep = killed\n"
        "migrate.migrate(sys.argv[1])\n"
    )
    for when in ("0", "1"):
        path = Path(shutil.copy(HERE / "format-2.sqlite", tmp_path / f"{when}.sqlite"))
        done = subprocess.run([sys.executable, "-c", code, str(path), when], check=False)
        assert done.returncode == 9
        assert path.read_bytes() == (HERE / "format-2.sqlite").read_bytes()
        Path(f"{path}.format-2").unlink(missing_ok=True)
        assert migrate(path).rows["results"] == store_seeds()


def test_a_damaged_store_of_todays_format_is_not_said_to_be_well(old):
    migrate(old)
    data = old.read_bytes()
    old.write_bytes(data[: 40 * 4096] + b"\xff" * 4096 + data[41 * 4096 :])
    Path(f"{old}.format-2").unlink()
    with pytest.raises(StoreError, match=r"could not be migrated .*; nothing was changed"):
        migrate(old)


def test_of_two_migrations_at_once_one_is_done_and_the_other_refused(old):
    code = "import sys; from uard.cli.app import main; main(['migrate', sys.argv[1]])"
    command = [sys.executable, "-c", code, str(old)]
    both = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    said = [p.communicate()[1] for p in both]
    assert sorted(p.returncode for p in both) == [0, 2]
    assert "Traceback" not in "".join(said)
    with closing(Store(old)) as store:
        assert sum(len(store.have(c)) for c in CELLS) == store_seeds()
    assert sorted(p.name for p in old.parent.iterdir()) == ["s.sqlite", "s.sqlite.format-2"]


@pytest.mark.parametrize("metrics", ["{}", "[", "7", '{"trap_visits": "many"}'])
def test_metrics_that_are_none_go_into_quarantine(old, metrics):
    ((key, data),) = rows(old, "select key, data from results limit 1")
    change(
        old,
        (
            "update results set metrics = ?, checksum = ? where key = ? and data = ?",
            metrics,
            digest(data + metrics.encode()),
            key,
            data,
        ),
        ("insert into runs values ('gone', 'h', 'p', 1, 1, 'soon', 6, 7, 3, 2, null, null)",),
    )
    found = migrate(old)
    assert found.rows["quarantine"] == 1
    assert found.left["they are damaged (runs: began = 'soon': must be a finite number in [0, 2.53402e+11])"] == 1
