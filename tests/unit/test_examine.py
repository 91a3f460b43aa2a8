"""What a trained agent makes of a distorted reward, and what its sigma_m knows: hand-made cases, real physics."""

from types import SimpleNamespace

import numpy as np
import pytest

from uard.agents.continuous import edac, sunrise
from uard.agents.networks import Ensemble, Network
from uard.agents.policy import PPO
from uard.envs.locomotion.locomotion import Locomotion
from uard.envs.simulator import StepResult
from uard.lab import studies
from uard.lab.cell import Cell
from uard.lab.execution import runner
from uard.lab.execution.store import Store
from uard.lab.study import Study, row
from uard.lab.trainers import examine
from uard.lab.views.published import Published, extract
from uard.method.mitigations import Raw, named
from uard.replication import locomotion
from uard.replication.studies import derive
from uard.training.feedback.transition_model import TransitionModel
from uard.training.host.loop import Job, run
from uard.training.host.loops import loop_of

TINY = Network(16, 1e-3, 1.0)
OFF = {"network": TINY, "batch": 32, "warmup": 64, "buffer": 500}
ON = PPO(TINY, Ensemble("shared", 3), envs=4, rollout=32, epochs=1, count_bonus=0.0)
SMALL = TransitionModel(hidden=8, fits=5, batch=16, capacity=64)
WHERE = Locomotion(region=None, reference=True)


def trained(agent, mitigation):
    loop = loop_of(Job(WHERE, agent, mitigation, 1, 256, rating_model=SMALL, evaluations=1))
    return loop, run(loop).state


def test_a_reaction_by_hand():
    here = examine.inside()
    assert here.sum() == 60
    true = np.full(examine.STEPS, 2.0)
    observed = true + examine.BONUS * here
    doubled = np.where(here, 6.0, 3.0)
    for adjusted, activations, believed in ((observed, 60, 1.0), (true, 0, 0.0), (true + 2.0 * here, 0, 0.5)):
        trace = np.column_stack([observed, adjusted, observed, doubled, true])
        assert examine.reaction(trace) == (activations, believed, 6.0, 3.0)


def test_a_raw_agent_believes_everything_and_each_epsilon_costs_its_advantage_epsilon():
    found = examine.examine(*trained(ON, Raw()))
    observed, adjusted, caution, lam, true = found["trace"].T
    np.testing.assert_array_equal(adjusted, observed)
    np.testing.assert_array_equal(caution, observed)
    assert not lam.any()
    np.testing.assert_allclose(observed - true, examine.BONUS * examine.inside(), atol=1e-5)
    filtered, raw, kept_filtered, kept_raw = found["perturbed"].T
    np.testing.assert_array_equal(filtered, raw)
    np.testing.assert_array_equal(kept_filtered, kept_raw)
    np.testing.assert_allclose(raw, raw[0] - examine.EPSILONS, atol=1e-4)
    assert kept_raw[0] == 1.0
    assert raw[0] > 0


def test_edac_takes_its_pessimism_off_and_sunrise_weighs():
    observed, adjusted, *_ = examine.examine(*trained(edac(3, **OFF), Raw()))["trace"].T
    assert (adjusted < observed).all()
    observed, adjusted, *_ = examine.examine(*trained(sunrise(3, **OFF), Raw()))["trace"].T
    share = adjusted / observed
    assert (share > 0.5).all()
    assert (share < 1.0).all()


def test_what_a_random_action_would_do_leaves_no_trace_in_the_walk(monkeypatch):
    loop, state = trained(ON, named("uard-0.1"))
    found = examine.examine(loop, state)
    monkeypatch.setattr(examine, "EVERY", 250)
    np.testing.assert_array_equal(found["trace"], examine.examine(loop, state)["trace"])
    assert (found["trace"][:, examine.TRACE.index("lam")] > 0).all()
    assert np.isfinite(found["perturbed"]).all()


def test_a_kick_changes_nothing_before_it_and_throws_sigma_m_at_its_step(monkeypatch):
    monkeypatch.setattr(examine, "KICKED_AT", 5)
    loop, state = trained(ON, named("uard"))
    none, mild, hard = examine.examine(loop, state)["kicked"]
    assert none.shape == (examine.KICKED_STEPS, len(examine.KICKED))
    names = examine.KICKED.index
    for kicked in (mild, hard):
        np.testing.assert_array_equal(kicked[:5], none[:5])
        rewards = [names("observed"), names("true")]
        np.testing.assert_array_equal(kicked[5, rewards], none[5, rewards])  # the step itself is paid for as it was
        assert kicked[5, names("sigma_m")] != none[5, names("sigma_m")]  # the state after it is another
        assert (np.diff(kicked[:, 0]) <= 0).all(), "who has fallen does not stand again"
    speed = hard[6, names("observed")] - none[6, names("observed")]
    assert 3 < speed < 6, "5 m/s more are paid for in the next step"
    assert not hard[hard[:, 0] == 0, 1:].any()


def test_a_kicked_raw_agent_asks_nobody_and_believes_all():
    kicked = examine.examine(*trained(ON, Raw()))["kicked"]
    columns = dict(zip(examine.KICKED, np.moveaxis(kicked, -1, 0), strict=True))
    assert not columns["sigma_h"].any()
    np.testing.assert_array_equal(columns["adjusted"], columns["observed"])
    np.testing.assert_array_equal(columns["weight"], columns["standing"] > 0)


def test_a_training_by_parts_of_its_steps_and_a_walk_by_groups_by_hand():
    log = np.array([[1.0, 10.0], [3.0, 30.0], [8.0, 80.0], [9.0, 90.0]])
    parts = derive.learning(log, np.array([2, 9, 195, 203]), 200)  # 10 steps a part; the last is past the end
    assert parts.shape == (derive.BINS, 2)
    np.testing.assert_array_equal(parts[[0, 1, 18, 19]], [[2, 20], [2, 20], [2, 20], [8.5, 85]])
    kicked = np.zeros((1, 10, 2))
    kicked[0, :5] = [[1.0, 2.0], [1.0, 2.0], [0.5, 8.0], [0.5, 8.0], [0.0, 0.0]]
    np.testing.assert_allclose(derive.grouped(kicked), [[[0.6, 4.0], [0.0, 0.0]]])  # (2 + 2 + 4 + 4) / 3


class RewardFn(SimpleNamespace):
    """What is learned at places 0 to 99 in a world of reward 1 and discount 0.5, with given values and doubts."""

    job = SimpleNamespace(seed=0, agent=SimpleNamespace(gamma=0.5))

    def __call__(self, steps, reward):
        return reward, reward, reward

    def value(self, observations):
        return self.values[observations[:, 0].astype(int).clip(0, 99)]

    def doubt(self, observations):
        own = self.doubts[observations[:, 0].astype(int).clip(0, 99)]
        return np.where(observations[:, 1] == 0.0, own, 9.0)


def test_the_warning_knows_wrong_values_and_states_that_were_never_visited():
    places = np.arange(100)
    wrong = places >= 80
    values = np.where(wrong, 5.0, 2.0)  # worth 1 / (1 - 0.5) = 2
    at = np.column_stack([places, np.zeros(100)]).astype(float)
    no = np.zeros(100, bool)
    ones = np.ones(100)
    result = StepResult(np.zeros((100, 2)), ones, no, no, ones, no, no, ones)
    walked = examine.Walked(at, np.zeros((100, 1)), result)
    for doubts, expected in ((wrong * 1.0, 1.0), (1.0 - wrong, 0.0), (np.ones(100), 0.5)):
        _, error = examine._warning(RewardFn(values=values, doubts=doubts), walked)
        assert error == pytest.approx(expected)
    thrown, _ = examine._warning(RewardFn(values=values, doubts=np.zeros(100)), walked)
    assert 0.6 < thrown < 0.9, "half are thrown off sideways, where it is in doubt; along the places it is not"


def test_the_study_is_published_and_shown():
    store = Store(":memory:")
    agents = {
        "uard-0.1": (ON, named("uard-0.1")),
        "uard-0.1 (ppo)": (ON, named("uard-0.1")),
        "edac": (edac(3, **OFF), Raw()),
        "sunrise": (sunrise(3, **OFF), Raw()),
    }
    rows = tuple(
        row(Cell(WHERE, mitigation, agent, steps=256, rating_model=SMALL, rated=0.1 * i), agent=name, critics="3")
        for i, (name, (agent, mitigation)) in enumerate(agents.items())
    )
    study = Study(locomotion.DISTORTION, "t", "G12", rows, derive=derive.reactions)
    runner.run([(r.cell, 0) for r in rows], store, workers=1)
    data = extract((study,), store, [0], "made so")
    others = [s for s in studies.every() if s.name != study.name]
    published = Published((*others, study), [data])
    (table,) = (t for t in locomotion.tables(published) if "distorted" in t.title)
    assert [r[0] for r in table.rows] == list(agents)
    assert len(locomotion.drawn(published)) == 3
