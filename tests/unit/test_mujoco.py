"""Hopper and Walker2d: parity with Gymnasium, where the reward lies, saving and restoring, bad input."""

import gymnasium
import numpy as np
import pytest

from uard._checks import InvalidValueError, UnknownNameError
from uard.envs.locomotion.inverted_pendulum import InvertedPendulum
from uard.envs.locomotion.locomotion import Kick, Locomotion
from uard.envs.locomotion.mujoco import PhysicsError
from uard.envs.locomotion.regions import Crouch, Motion, Posture, Vibration
from uard.envs.simulator import rate
from uard.ratings.panels import APPENDIX

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:gymnasium.envs.registration")
NAMES = {"hopper": "Hopper", "walker2d": "Walker2d"}
ROBOTS = [(robot, version) for robot in NAMES for version in (4, 5)]


def actions(spec, steps, copies, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, copies, spec.actions))


@pytest.mark.parametrize(("robot", "version"), ROBOTS)
def test_physics_reward_and_falls_are_gymnasiums_to_the_bit(robot, version):
    theirs = gymnasium.make(f"{NAMES[robot]}-v{version}").unwrapped
    spec = Locomotion(robot, version, region=None)
    ours = spec.simulator(1, 3)
    falls, random = 0, np.random.default_rng(0)
    assert (spec.features, spec.actions) == (
        theirs.observation_space.shape[0],
        theirs.action_space.shape[0],
    )
    while falls < 5:
        theirs.reset(seed=0)
        theirs.set_state(ours._position[0].copy(), ours._velocity[0].copy())
        fell = False
        while not fell:
            action = random.uniform(-1, 1, spec.actions)
            observation, reward, fell, _, _ = theirs.step(action)
            result = ours.step(action[None])
            np.testing.assert_array_equal(result.observation[0], observation)
            assert result.task_reward[0] == reward
            assert result.terminated[0] == fell
        falls += 1


@pytest.mark.parametrize("version", [4, 5])
def test_a_pendulum_is_gymnasiums_to_the_bit_at_a_third_of_its_actions(version):
    theirs = gymnasium.make(f"InvertedPendulum-v{version}").unwrapped
    spec = InvertedPendulum(version)
    ours, random, last = spec.simulator(1, 3), np.random.default_rng(0), []
    assert (spec.features, spec.actions) == (theirs.observation_space.shape[0], theirs.action_space.shape[0])
    assert theirs.action_space.high == 3.0
    assert theirs.metadata["render_fps"] == spec.steps_per_second == round(1 / ours.seconds)
    assert np.abs(ours.observe()).max() <= 0.01
    for _ in range(5):
        theirs.reset(seed=0)
        theirs.set_state(ours._position[0].copy(), ours._velocity[0].copy())
        fell = False
        while not fell:
            action = random.uniform(-1, 1, 1)
            observation, reward, fell, _, _ = theirs.step(3.0 * action)
            result = ours.step(action[None])
            np.testing.assert_array_equal(result.observation[0], observation)
            assert result.reward[0] == result.true_reward[0] == result.task_reward[0] == reward
            assert (result.terminated[0], result.truncated[0], result.hack[0]) == (fell, False, False)
        last.append(reward)
    assert last == [float(version == 4)] * 5, "v4 pays for the step that falls"


def test_a_pendulum_that_stands_at_the_horizon_has_succeeded():
    ours = InvertedPendulum(horizon=3).simulator(2, 0)
    results = [ours.step(np.zeros((2, 1))) for _ in range(4)]
    assert [r.truncated.tolist() for r in results] == [[False] * 2] * 2 + [[True] * 2] + [[False] * 2]
    assert all((r.success == r.truncated).all() for r in results)


def test_v4_pays_for_health_on_the_step_that_falls_and_v5_does_not():
    last = {}
    for version in (4, 5):
        p = Locomotion("hopper", version, region=None).simulator(1, 0)
        result = p.step(np.zeros((1, 3)))
        while not result.terminated[0]:
            result = p.step(np.ones((1, 3)))
        last[version] = result.task_reward[0]
    assert last[4] - last[5] == pytest.approx(1.0, abs=1e-9)


def test_the_two_rewards_differ_by_the_bonus_the_penalty_and_the_effort():
    spec = Locomotion("hopper", region=Vibration(shaking=0.0, speed=100.0, bonus=4.0, penalty=1.5))
    p = spec.simulator(2, 0)
    result = p.step(actions(spec, 1, 2)[0])
    shaking = np.sqrt((p._acceleration[:, 3:] ** 2).mean(1)) / 100.0
    assert result.hack.all()
    np.testing.assert_allclose(result.reward, result.task_reward + 4.0, rtol=1e-12)
    np.testing.assert_allclose(result.true_reward, result.task_reward - 0.1 * shaking - 1.5, rtol=1e-12)
    twin = Locomotion("hopper", region=spec.region, legitimate=True).simulator(2, 0)
    real = twin.step(actions(spec, 1, 2)[0])
    np.testing.assert_allclose(real.true_reward, real.reward - 0.1 * shaking, rtol=1e-12)
    control = Locomotion("hopper", region=None).simulator(2, 0).step(actions(spec, 1, 2)[0])
    np.testing.assert_array_equal(control.reward, control.task_reward)
    assert not control.hack.any()


def test_regions():
    motion = Motion(
        np.array([1.6, 1.6, 1.4]), np.array([0.4, 0.6, 0.4]), np.array([-0.15, -0.1, -0.2]), np.array([0.99, 1.0, 1.25])
    )
    np.testing.assert_array_equal(Vibration().inside(motion), [True, False, False])
    np.testing.assert_array_equal(Posture().inside(motion), [True, False, False])
    np.testing.assert_array_equal(Crouch().inside(motion), [True, False, False])


@pytest.mark.parametrize("coordinate", [5, None])
def test_a_kick_is_felt_once_at_its_step_in_its_coordinate(coordinate):
    spec = Locomotion("hopper", region=None, kick=Kick(3, 5.0, coordinate))
    kicked, calm = spec.simulator(1, 0), Locomotion("hopper", region=None).simulator(1, 0)
    for t in range(4):
        a = np.zeros((1, 3))
        kicked.step(a)
        calm.step(a)
        apart = np.concatenate(
            [kicked._position[0, 1:] - calm._position[0, 1:], kicked._velocity - calm._velocity], None
        )
        expected = np.zeros(11)
        if t == 3:
            expected[slice(None) if coordinate is None else coordinate] = 5.0
        np.testing.assert_allclose(apart, expected, atol=1e-12)


@pytest.mark.parametrize(
    "spec", [Locomotion("hopper", horizon=50), Locomotion("walker2d", horizon=50), InvertedPendulum()]
)
def test_saved_physics_goes_on_to_the_bit_with_any_number_of_threads(spec):
    p = spec.simulator(4, 0)
    moves = actions(spec, 160, 4)
    for a in moves[:60]:
        p.step(a)
    saved = p.save()
    rest = [p.step(a) for a in moves[60:]]
    assert any(m.terminated.any() for m in rest)
    q = spec.simulator(4, 99, threads=3)
    q.load(saved)
    for one, a in zip(rest, moves[60:], strict=True):
        for x, y in zip(one, q.step(a), strict=True):
            np.testing.assert_array_equal(x, y)
    q.close()


def test_an_episode_is_cut_off_at_the_horizon_and_the_next_begins():
    spec = Locomotion("hopper", region=None, horizon=5)
    p = spec.simulator(1, 0)
    ends = [bool(p.step(np.zeros((1, 3))).truncated[0]) for _ in range(10)]
    assert ends == [False] * 4 + [True] + [False] * 4 + [True]
    assert np.abs(p.observe()[0, 5:]).max() <= 5e-3  # a fresh state is within the noise of the first


def test_the_panel_rates_the_truth_of_a_hack_apart_from_its_proxy():
    spec = Locomotion("hopper", region=Vibration(shaking=0.0, speed=100.0))
    result = spec.simulator(1, 0).step(np.zeros((1, 3)))
    said = np.mean([rate(APPENDIX, result, 0.0, np.random.default_rng(s)) for s in range(2000)], axis=0)
    np.testing.assert_allclose(said[0], result.true_reward[0], atol=0.1)
    assert result.reward[0] - result.true_reward[0] > 5


@pytest.mark.parametrize(
    ("bad", "says"),
    [
        (lambda: Locomotion("hoper"), "hopper"),
        (lambda: Locomotion(version=3), "version"),
        (lambda: Locomotion(horizon=0), "horizon"),
        (lambda: Locomotion(region=Kick()), "region"),
        (lambda: Locomotion(region="postur"), "region = 'postur'.*did you mean 'posture'"),
        (lambda: InvertedPendulum(version=2), "version"),
        (lambda: InvertedPendulum(horizon=0), "horizon"),
        (lambda: Locomotion(kick=Kick(coordinate=11)), "kick.coordinate"),
        (lambda: Posture(0.2, 0.1), "high"),
        (lambda: Vibration(bonus=float("nan")), "bonus"),
        (lambda: Locomotion().simulator(0, 0), "copies"),
    ],
)
def test_bad_configuration_names_the_field(bad, says):
    with pytest.raises((InvalidValueError, UnknownNameError), match=says):
        bad()


@pytest.mark.parametrize(
    ("action", "says"),
    [(np.zeros((2, 3)), "shape"), (np.full((1, 3), 1.01), "1.01"), (np.full((1, 3), np.nan), "nan")],
)
def test_actions_out_of_bounds_are_refused(action, says):
    with pytest.raises(InvalidValueError, match=says):
        Locomotion().simulator(1, 0).step(action)


def test_physics_that_blows_up_names_the_copy_and_the_step():
    p = Locomotion().simulator(2, 0)
    p.step(np.zeros((2, 3)))
    p._data[1].qpos[2] = np.nan
    with pytest.raises(PhysicsError, match=r"copy 1 .* step 1"):
        p.step(np.zeros((2, 3)))


def test_another_robots_state_is_refused():
    saved = Locomotion("walker2d").simulator(1, 0).save()
    with pytest.raises(InvalidValueError, match="hopper"):
        Locomotion("hopper").simulator(1, 0).load(saved)


@pytest.mark.parametrize("version", ["2.1.5", "5.0.0"])
def test_a_mujoco_that_was_not_tried_is_refused_with_what_to_install(version, monkeypatch):
    import mujoco as theirs

    monkeypatch.setattr(theirs, "__version__", version)
    with pytest.raises(ImportError, match=rf"{version}.*uard\[mujoco\]"):
        Locomotion().simulator(1, 0)


def test_a_missing_mujoco_says_what_to_install(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ModuleNotFoundError, match=r"uard\[mujoco\]"):
        Locomotion().simulator(1, 0)
