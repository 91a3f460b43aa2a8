"""Deep agents in the laboratory: cells, names, studies, divergence, published results."""

from __future__ import annotations

import json
import subprocess

import numpy as np
import pytest

from uard import InvalidValueError
from uard.agents.networks import Network
from uard.agents.off_policy import OffPolicy
from uard.agents.policy import PolicyGradient
from uard.agents.tabular import QLearning
from uard.agents.value import DeepQ
from uard.envs.grids.gaming import BoatRace, TomatoWatering
from uard.envs.grids.learned_reward import LearnedRewardGrid
from uard.envs.grids.trapgrid import TrapGrid
from uard.lab import registry as names
from uard.lab import studies
from uard.lab.cell import Cell
from uard.lab.execution import runner
from uard.lab.execution.batching import shape_of
from uard.lab.execution.store import Store
from uard.lab.study import Study, row
from uard.lab.trainers import examine
from uard.lab.views import published
from uard.lab.views.published import BIN, Published, _checkout, extract, packaged
from uard.method.mitigations import named
from uard.ratings.panels import PANELS
from uard.replication import distortion
from uard.training.feedback.rating_model import RatingModel

SMALL = DeepQ(Network(hidden=8), batch=8, buffer=64, warmup=32, target_every=16)
GRID = TrapGrid(size=4, traps=((1, 2),), horizon=12)


def small(**changes):
    return Cell(GRID, named("uard-0.1"), SMALL, episodes=20, rating_model=RatingModel(2, 8, fits=2, batch=16)).with_(
        **changes
    )


def test_an_agent_that_cannot_work_is_refused_with_those_that_can():
    with pytest.raises(InvalidValueError, match="does not fit into tables: dqn, ensemble-dqn") as error:
        Cell(TomatoWatering(), named("raw"), QLearning())
    assert "q-learning" not in str(error.value).split("tables:")[1]
    assert Cell(BoatRace(), named("raw"), QLearning()).agent == QLearning()
    assert Cell(TomatoWatering(), named("raw"), SMALL).agent == SMALL


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"snapshots": 2}, "snapshots = 2: must be 0 for an agent"),
        ({"rating_model": "table"}, "rating_model = 'table': must be a RatingModel"),
        ({"agent": QLearning()}, "rating_model = .*must be none for a tabular agent"),
        ({"agent": "dqn"}, "agent = 'dqn': must be a frozen dataclass"),
        ({"environment": "CartPole"}, "environment = 'CartPole'"),
    ],
)
def test_bad_cells_are_refused(changes, message):
    with pytest.raises(InvalidValueError, match=message):
        small(**changes)


def test_the_rating_model_is_part_of_the_key_where_ratings_are_asked_for():
    assert small().key != small(rating_model=None).key
    assert small().key != small(rating_model=RatingModel(3, 8, fits=2, batch=16)).key
    raw = small(mitigation=named("raw"))
    assert raw.rating_model is None, "who asks nobody has no model of what they say"


def test_all_deep_agents_share_network_budget_and_discount():
    network = Network(hidden=32)
    agents = names.deep_agents(network)
    assert len(set(agents) - {"cpo-oracle"}) == 9, "the paper's nine"
    assert {a.network for a in agents.values()} == {network}
    assert len({a.gamma for a in agents.values()}) == 1
    replay = [a for a in agents.values() if isinstance(a, OffPolicy)]
    assert len({(a.buffer, a.batch, a.warmup) for a in replay}) == 1
    assert all(isinstance(a, OffPolicy | PolicyGradient) for a in agents.values())


def test_every_study_has_a_name_of_its_own_and_rows_of_their_own():
    every = studies.every()
    assert len({s.name for s in every}) == len(every)
    for s in every:
        assert len({r.labels for r in s.rows}) == len(s.rows), s.name
    assert {s.name for s in studies.find(("grid-deep",))} == {s.name for s in studies.groups()["grid-deep"]}
    assert [s.name for s in studies.find(("gaming", "scale"))] == ["gaming", "scale"]


def test_deep_runs_of_one_program_are_trained_together_and_stored_one_by_one():
    store = Store(":memory:")
    cells = [
        small(),
        small(noise=0.5),
        small(environment=TrapGrid(size=4, traps=((1, 2),), trap_reward=8.0, horizon=12)),
    ]
    assert len({shape_of(c)[0] for c in cells}) == 1
    assert runner.run([(c, s) for c in cells for s in range(2)], store, workers=1) == 6
    (result, *_) = store.get(cells[0], [0]).values()
    assert result.log.shape == (20, 6)
    assert result.extra["tables"].shape == (16, 4, 9)
    assert np.isfinite(result.extra["rating_error"]).all()
    assert result.path[0] == 0
    assert runner.run([(cells[0], 0)], store, workers=1) == 0, "finished seeds are not trained again"


def test_a_diverging_run_is_named_kept_out_and_leaves_its_last_good_state(tmp_path):
    store = Store(tmp_path / "s.sqlite")
    # Squares of such rewards overflow in the scale that the mitigation measures.
    wild = small(environment=TrapGrid(size=4, traps=((1, 2),), step_reward=-1e25, horizon=12))
    tame = small()
    expected = r"training diverged: (loss|values|parameters|rating model) at step \d+ of seed 0.*last good state is in"
    with pytest.raises(runner.StudyFailedError, match=expected) as failed:
        runner.run([(wild, 0), (tame, 0)], store, workers=1)
    assert store.missing(wild, [0]) == [0]
    assert store.missing(tame, [0]) == [], "its neighbour in the same program is unharmed"
    (file,) = (tmp_path / "s.sqlite-diverged").glob("*.npz")
    assert file.name in str(failed.value)
    with np.load(file) as good:
        assert len(good.files) > 3
        assert all(np.isfinite(good[name]).all() for name in good.files)


def test_published_results_come_back_and_stale_ones_do_not():
    store, cell = Store(":memory:"), small()
    runner.run([(cell, s) for s in range(3)], store, workers=1)
    rows = row(cell, agent="a"), row(small(noise=0.1), agent="b")

    def derive(cell, found):
        return {"largest": [r.metrics()["hacks"] / 3 for r in found.values()]}

    study = Study("deep-baselines", "t", "", rows, ("hacks",), derive)
    data = json.loads(json.dumps(extract((study,), store, range(3), "made so")))
    back = Published((study,), [data])
    assert [r["agent"] for r in back.rows("deep-baselines")] == ["a"]
    expected = [r.metrics()["hacks"] for r in store.get(cell, range(3)).values()]
    np.testing.assert_allclose(back.per_seed(study.rows[0], "hacks"), expected, rtol=1e-5)
    assert back.curves(study.rows[0], "hacks").shape == (3, 20 // BIN)
    assert back.derived(study.rows[0], "rating_error").shape == (3, 5)
    np.testing.assert_allclose(back.derived(study.rows[0], "largest"), np.array(expected) / 3, rtol=1e-5)
    assert list(data["cells"]) == [cell.key]
    assert list(data["cells"][cell.key]["curves"]) == ["hacks"]
    assert back.sources[0]["command"] == "made so"
    assert back.sources[0]["commit"] == _checkout()
    with pytest.raises(LookupError, match="not published"):
        back.get("deep-baselines", "hacks", agent="b")
    for older in ({"format": 1}, {"format": None, "results": 2}):
        with pytest.raises(InvalidValueError, match=r"format = .*`uard migrate FILE\.json` brings"):
            Published((study,), [data | older])


def test_the_checkout_is_named_only_where_the_code_belongs_to_it(tmp_path, monkeypatch):
    def git(*words):
        who = ("-c", "user.name=a", "-c", "user.email=a@b.c")
        return subprocess.run(["git", "-C", tmp_path, *who, *words], check=True, capture_output=True, text=True).stdout

    code = tmp_path / "code.py"
    code.write_text("1\n")
    git("init", "-q")
    monkeypatch.setattr(published, "__file__", str(code))
    assert _checkout() is None, "a repository around an installed package is not its own"
    git("add", "code.py")
    git("commit", "-qm", "code")
    commit = git("rev-parse", "HEAD").strip()[:12]
    assert _checkout() == commit
    code.write_text("2\n")
    assert _checkout() == f"{commit}-dirty"


def test_what_is_packaged_belongs_to_the_present_definitions():
    deep = packaged()
    known = {r.cell.key for s in studies.every() for r in s.rows}
    stale = [key for key in deep.cells if key not in known]
    assert not stale, "a study has changed since it was published; run it and extract it again"
    for s in studies.groups()["grid-deep"]:
        assert {deep.seeds(s.name)} <= {0, 10}, f"{s.name}: all rows have ten seeds"


def test_distortion_counts_only_windows_and_never_the_goal():
    assert examine.inside().sum() == 60
    zero = np.zeros(examine.STEPS)
    everywhere = distortion.Trace(zero, zero + 1.0, zero, zero, examine.inside())
    assert distortion.activations(everywhere) == 60
    assert distortion.activations(everywhere._replace(adjusted=zero + distortion.THRESHOLD)) == 0
    assert distortion.activations(everywhere._replace(counts=zero.astype(bool))) == 0


def test_a_learned_reward_is_right_where_it_was_rated_and_in_doubt_elsewhere():
    spec = LearnedRewardGrid(model_seed=1)
    task, truth, said = spec.task(), spec.truth(), spec.rating_law(PANELS["main"])
    reach = np.asarray(said.reach) > 0
    mean_rating = said.centre.mean(-1)
    assert np.abs(task.reward - mean_rating)[reach].max() < 0.1
    assert np.median(task.doubt[reach]) < 0.1 < 1.0 < np.median(task.doubt[~reach])
    assert truth.hack[reach].any(), "the contested trap pays"
    assert truth.hack[~reach].any(), "so does extrapolation"
    assert (LearnedRewardGrid(model_seed=2).task().reward != task.reward).any()
    honest = LearnedRewardGrid(unrated=0)
    assert honest.rating_law(PANELS["main"]).reach.all()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("size", 5),
        ("unrated", 9),
        ("members", 1),
        ("frequency", 0.0),
        ("amplitude", -1.0),
        ("horizon", 0),
        ("model_seed", -1),
    ],
)
def test_bad_learned_rewards_are_refused(field, value):
    with pytest.raises(InvalidValueError, match=f"{field} = "):
        LearnedRewardGrid(**{field: value})


def test_grids_with_a_doubtful_reward_are_batched_apart():
    cells = [
        Cell(TrapGrid(size=10), named("uard-0.1"), episodes=2),
        Cell(LearnedRewardGrid(), named("uard-0.1"), episodes=2),
    ]
    store = Store(":memory:")
    assert runner.run([(c, s) for c in cells for s in range(2)], store, workers=1) == 4
