"""Hopper and Walker2d in the laboratory: cells, names, studies, checkpoints beside the store."""

import base64
import dataclasses
import io
import os
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from uard._checks import InvalidValueError
from uard.agents.continuous import ensemble_sac
from uard.agents.networks import Ensemble, Network
from uard.agents.policy import PPO, TRPO
from uard.agents.tabular import QLearning
from uard.envs.grids.trapgrid import TrapGrid
from uard.envs.locomotion.locomotion import Locomotion
from uard.envs.locomotion.regions import Vibration
from uard.lab import registry as names
from uard.lab.cell import Cell
from uard.lab.config import FORMAT
from uard.lab.execution import runner
from uard.lab.execution.store import Store
from uard.lab.execution.training import packed, train_batch
from uard.lab.result import METRICS
from uard.lab.studies import every
from uard.lab.trainers import examine
from uard.lab.trainers.simulated import checkpoint_of
from uard.lab.views.published import Published, packaged, packaged_json
from uard.method.mitigations import Raw, named
from uard.ratings.panels import PANELS
from uard.replication import locomotion as shown
from uard.replication.studies import derive, locomotion
from uard.training.feedback.rating_model import RatingModel
from uard.training.feedback.transition_model import TransitionModel

TINY = PPO(Network(16, 1e-3, 100.0), Ensemble("shared", 3), envs=4, rollout=32, epochs=1, count_bonus=0.0)
WHERE = Locomotion("hopper", region=Vibration(shaking=0.5, speed=5.0))


def cell(**changes):
    return Cell(**({"environment": WHERE, "mitigation": named("uard-0.1"), "agent": TINY, "steps": 512} | changes))


def test_a_cell_knows_what_matters_of_it():
    assert cell(rating_model=TransitionModel()).key == cell().key
    assert cell(episodes=7).key == cell().key, "episodes mean nothing here"
    assert cell(steps=513).key != cell().key
    assert cell(steps=None).steps == 1_000_000
    assert cell(environment=dataclasses.replace(WHERE, version=5)).key != cell().key
    assert cell(query="doubtful").key != cell().key
    raw = cell(mitigation=Raw(), panel=PANELS["appendix"], rated=0.5, query="doubtful")
    assert raw.key == cell(mitigation=Raw()).key, "nobody is asked"
    curved = dataclasses.replace(TINY, network=dataclasses.replace(TINY.network, activation="tanh"))
    assert cell(agent=curved).key != cell().key


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"agent": QLearning()}, "continuous: ppo, trpo"),
        ({"agent": names.AGENTS["dqn"]}, "ppo, trpo"),
        ({"environment": TrapGrid(), "agent": ensemble_sac(), "steps": None}, "discrete: q-learning"),
        ({"environment": TrapGrid(), "agent": QLearning(), "steps": 10}, "episodes"),
        ({"rating_model": RatingModel()}, "TransitionModel"),
        ({"steps": 0}, "steps"),
        ({"query": "sometimes"}, "random"),
        (
            {"environment": TrapGrid(), "agent": QLearning(), "steps": None, "query": "doubtful"},
            "random, except",
        ),
    ],
)
def test_pairs_that_cannot_work_are_refused_with_those_that_can(changes, says):
    with pytest.raises(InvalidValueError, match=says):
        cell(**changes)


def test_every_continuous_agent_has_the_network_of_its_family():
    for small in (False, True):
        agents = names.continuous_agents(small)
        policy = [a for a in agents.values() if a.family == "rollout"]
        critic = [a for a in agents.values() if a.family == "continuous-replay"]
        assert len(policy) == 4
        assert len(critic) == 5
        for family in (policy, critic):
            assert len({a.network for a in family}) == 1
            assert len({a.gamma for a in family}) == 1
        assert len({(a.batch, a.buffer, a.warmup) for a in critic}) == 1


def test_a_run_is_stored_its_checkpoint_is_gone_and_another_process_gives_the_same(tmp_path):
    store = Store(tmp_path / "s.sqlite")
    jobs = [(cell(), s) for s in range(2)]
    here = train_batch([jobs[0]])[0]
    assert runner.run(jobs, store, workers=2) == 2
    assert list((tmp_path / "s.sqlite-checkpoints").glob("*")) == []
    found = store.get(cell(), [0, 1])
    np.testing.assert_array_equal(found[0].log, here.log)
    np.testing.assert_array_equal(found[0].extra["evaluation"], here.extra["evaluation"])
    assert found[0].steps == 512
    assert not np.array_equal(found[0].log[:5], found[1].log[:5])
    assert set(found[0].metrics()) >= {"hacks", "true_return"}


TRAINED_ELSEWHERE = """
import hashlib, pathlib, sys
from uard.lab.execution.training import attempt_packed

(result,) = attempt_packed(pathlib.Path(sys.argv[1]).read_bytes())
print(hashlib.sha256(result.pack()[0]).hexdigest())
"""


def test_a_result_does_not_depend_on_the_number_of_cores(tmp_path, as_users_compile):
    """With sixteen threads XLA sums up in another order than with one, and this agent's episodes become others."""
    agent = TRPO(Network(64, 1e-3, 100.0, "tanh"), Ensemble("shared", 3), envs=8, rollout=128, epochs=1)
    job = cell(environment=Locomotion("hopper", horizon=200), mitigation=Raw(), agent=agent, steps=1024), 0
    data = packed([job], None)
    assert data is not None
    (tmp_path / "job").write_bytes(data)
    command = [sys.executable, "-c", TRAINED_ELSEWHERE, str(tmp_path / "job")]
    path = os.pathsep.join(sys.path)
    digests = {
        subprocess.run(
            command,
            env=os.environ | {"NPROC": n, "PYTHONPATH": path, "JAX_ENABLE_COMPILATION_CACHE": "0"},
            check=True,
            capture_output=True,
            text=True,
        ).stdout
        for n in ("16", "1")
    }
    assert len(digests) == 1


def test_a_truncated_checkpoint_fails_its_run_with_what_to_do_and_no_other(tmp_path):
    store = Store(tmp_path / "s.sqlite")
    bad = checkpoint_of(tmp_path / "s.sqlite-checkpoints", cell(), 0)
    bad.parent.mkdir()
    bad.write_bytes(b"uard checkpoint 1\nhalf")
    with pytest.raises(runner.StudyFailedError, match="truncated; delete"):
        runner.run([(cell(), 0), (cell(), 1)], store, workers=1)
    assert store.missing(cell(), [0, 1]) == [0]


def test_studies_of_all_sizes_are_the_same_questions():
    sizes = [locomotion.studies(s) for s in (locomotion.SMOKE, locomotion.STANDARD, locomotion.PAPER)]
    assert len({tuple(s.answers for s in studies) for studies in sizes}) == 1
    assert {r.cell.steps for s in sizes[2] for r in s.rows} == {1_000_000}
    agents = {r["agent"] for s in sizes[1] for r in s.rows if s.name.endswith("hacking")}
    assert agents == set(names.CONTINUOUS) - {"cpo-oracle"}


def test_every_study_is_shown_by_a_table_with_a_line_for_each_row():
    studies = [s for s in locomotion.studies(locomotion.STANDARD) if s.name not in (shown.DISTORTION, shown.DRIFT)]
    seeds = {
        "seeds": [0, 1],
        "metrics": {m: [1.0, 2.0] for m in METRICS},
        "derived": {"deterministic": [[1, 2], [3, 4]]},
    }
    cells = {r.cell.key: seeds for s in studies for r in s.rows}
    every_table = shown.tables(Published(every(), [{"format": FORMAT, "cells": cells}]))
    tables = [t for t in every_table if not t.title.startswith(("The same", "Speed"))]
    assert len(every_table) == len(tables) + 2
    assert sorted(len(t.rows) for t in tables) == sorted(len(s.rows) for s in studies)
    for table in tables:
        assert {len(r) for r in table.rows} == {len(table.columns)}
        assert len({r[: table.labels] for r in table.rows}) == len(table.rows), "labels tell rows apart"
        assert "2 seeds" in table.title


def test_shares_of_all_settings_together_by_hand():
    (study,) = (s for s in locomotion.studies(locomotion.STANDARD) if s.name == shown.HACKING)
    rows = list(study.where(robot="hopper", agent="ppo"))
    hacks = {"raw": [100.0, 300.0], "true reward": [0.0, 0.0], "uard-0.1": [1.0, 3.0], "uard-paper": [50.0, 0.0]}
    true = {"raw": [-5.0, -5.0], "true reward": [400.0, 200.0], "uard-0.1": [300.0, 250.0], "uard-paper": [40.0, 40.0]}
    cells = {
        r.cell.key: {"seeds": [0, 1], "metrics": {"hacks": hacks[m], "true_return": true[m]}}
        for r in rows
        for m in [r["mitigation"]]
    }
    p = Published(every(), [{"format": FORMAT, "cells": cells}])
    found = shown.pooled(p, "hopper", "ppo", "uard-0.1")
    assert found is not None
    removed, kept = found
    np.testing.assert_allclose(removed, [0.99, 0.99])
    np.testing.assert_allclose(kept, [0.75, 1.25])
    one = cells[next(r for r in rows if r["mitigation"] == "uard-0.1" and r["region"] != "none").cell.key]
    one |= {"seeds": [7, 1], "metrics": {m: [1e9, x[1]] for m, x in one["metrics"].items()}}
    found = shown.pooled(Published(every(), [{"format": FORMAT, "cells": cells}]), "hopper", "ppo", "uard-0.1")
    assert found is not None
    np.testing.assert_allclose(found, [[0.99], [1.25]])  # of the seed that all rows have
    del cells[rows[-1].cell.key]
    assert shown.pooled(Published(every(), [{"format": FORMAT, "cells": cells}]), "hopper", "ppo", "uard-0.1") is None
    assert shown.pooled(p, "walker2d", "ppo", "uard-0.1") is None


def kicks(stand):
    """Three kicks of one seed that stands as given in each group of five steps; the other columns count the groups."""
    found = np.zeros((3, 30, len(examine.KICKED)))
    found[..., 0] = stand
    found[..., 1:] = np.arange(30.0)[:, None]
    return found


def test_what_is_said_around_a_kick_by_hand():
    (study,) = (s for s in locomotion.studies(locomotion.STANDARD) if s.name == shown.DRIFT)
    stand = np.ones(30)
    stand[11:] = 0.5  # half of the copies fall in the first five steps after the kick
    fallen = np.zeros(30)
    fallen[:9] = 1.0  # all fall before it
    walks = [kicks(stand).tolist(), kicks(fallen).tolist()]
    learning = np.stack([np.full((derive.BINS, 3), x) for x in (1.0, 2.0)]).tolist()
    metrics = {m: [1.0, 2.0] for m in METRICS}
    derived = {"deterministic": [[1, 2], [3, 4]]}
    cell = {"seeds": [0, 1], "metrics": metrics, "derived": derived | {"kicked": walks, "learning": learning}}
    p = Published(every(), [{"format": FORMAT, "cells": {r.cell.key: cell for r in study.rows}}])
    found = shown.around_kick(p, study.rows[0])
    assert found[5.0, "kick"]["standing"].tolist() == [0.75], "the seed that fell before is left out"
    assert found[5.0, "later"]["standing"].tolist() == [0.5]
    assert found[5.0, "before"]["sigma_m"].tolist() == [7.0]  # groups 5 to 9
    np.testing.assert_allclose(found[5.0, "kick"]["sigma_m"], [(10 + 0.5 * 11) / 1.5])
    (table,) = (t for t in shown.tables(p) if "with a kick" in t.title)
    assert len(table.rows) == 7 * len(study.rows)
    titles = [picture.title for picture in shown.drawn(p)]
    assert [t.split(" ")[0] for t in titles] == ["G6,", "G6,", "G6", "G7", "G10", "G10"]
    bare = {r.cell.key: cell | {"derived": derived} for r in study.rows}
    other = Published(every(), [{"format": FORMAT, "cells": bare}])
    assert shown.drifting(other) == [], "published for another study, without what this one derives"


def test_losses_are_short_lines_that_name_what_they_cost():
    lines = shown.losses(packaged())
    assert lines
    for line in lines:
        assert line.study == "robots, uard-0.1", "none of it is of today's rule"
        both = line.ours is not None and line.theirs is not None
        assert both or line.note.startswith("raw "), "where nothing is lost there is no gap, but both numbers are said"
        assert line.sure


def test_the_film_has_a_strip_for_each_policy_and_says_what_it_is():
    (film,) = shown.film()
    rows = packaged_json("hopper-frames.json")["rows"]
    picture = Image.open(io.BytesIO(base64.b64decode(film.image.partition(",")[2])))
    assert picture.format == "WEBP"
    assert picture.height / len(rows) == picture.width / 8
    assert "42 and 110" in film.title
    assert len(film.rows) == len(rows)
    for row in rows:
        assert f"{row['label']}: {row['true_return']:.0f} in {row['length']} steps" in film.note
