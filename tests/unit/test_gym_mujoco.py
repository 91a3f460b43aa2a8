import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from uard import InvalidValueError
from uard.envs.base import SimulatedEnvironment
from uard.envs.gym import IDS, make
from uard.envs.locomotion.locomotion import Kick, Locomotion
from uard.envs.locomotion.regions import Posture
from uard.envs.names import ENVIRONMENTS


@pytest.mark.filterwarnings("ignore:.*A Box observation space m..imum value is")
@pytest.mark.filterwarnings("ignore:.*render_modes")
@pytest.mark.parametrize("name", ["uard/Hopper-Posture-v0", "uard/Walker2d-v0", "uard/InvertedPendulum-v0"])
def test_gymnasiums_own_checks(name):
    check_env(gymnasium.make(name).unwrapped, skip_render_check=True)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_steps_and_falls_equal_gymnasiums_to_the_bit():
    ours, theirs = gymnasium.make("uard/Hopper-v0"), gymnasium.make("Hopper-v4")
    theirs.reset(seed=0)
    ours.reset(seed=0)
    data = theirs.unwrapped.data
    physics = ours.unwrapped._simulator
    theirs.unwrapped.set_state(physics._data[0].qpos.copy(), physics._data[0].qvel.copy())
    random = np.random.default_rng(0)
    for _ in range(200):
        action = random.uniform(-1, 1, 3)
        mine, other = ours.step(action), theirs.step(action)
        assert np.array_equal(mine[0], other[0])
        assert mine[1:4] == other[1:4]
        if mine[2]:
            break
    assert mine[2]
    assert data.time > 0


def test_a_lie_its_ratings_and_what_it_is_worth():
    env = gymnasium.make("uard/Hopper-Posture-v0", panel="main")
    env.reset(seed=1)
    hacks = 0
    for _ in range(300):
        _, reward, terminated, _, info = env.step(env.action_space.sample())
        assert info["ratings"].shape == (3,)
        if info["evaluation"].hack:
            hacks += 1
            assert reward - info["evaluation"].true_reward > 5.0  # bonus 4, penalty 1.5
        if terminated:
            env.reset()
    assert hacks > 0


def test_the_legitimate_twin_pays_what_it_shows():
    env = gymnasium.make("uard/Hopper-Posture-Legitimate-v0")
    env.reset(seed=1)
    for _ in range(40):
        _, reward, terminated, _, info = env.step(np.zeros(3, np.float32))
        assert abs(reward - info["evaluation"].true_reward) < 1.0
        if terminated:
            env.reset()


def test_the_same_seed_twice_and_a_new_episode_differs():
    env = gymnasium.make("uard/Walker2d-Vibration-v0", panel="appendix")
    first, _ = env.reset(seed=5)
    other, _ = env.reset()
    again, _ = env.reset(seed=5)
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_every_simulator_has_an_id_and_every_field_is_a_keyword():
    ids = [id_ for id_, name in IDS.items() if isinstance(ENVIRONMENTS[name], SimulatedEnvironment)]
    assert len(ids) == 15
    for id_ in ids:
        env = gymnasium.make(id_)
        assert env.unwrapped.problem == ENVIRONMENTS[IDS[id_]]
        env.close()
    env = gymnasium.make("uard/Hopper-v0", region=Posture(bonus=6.0), kick=Kick(3), version=5, horizon=9)
    assert env.unwrapped.problem == Locomotion("hopper", 5, Posture(bonus=6.0), Kick(3), horizon=9)


def test_a_pendulum_is_gymnasiums_with_actions_a_third_as_large():
    ours, theirs = gymnasium.make("uard/InvertedPendulum-v0", panel="main"), gymnasium.make("InvertedPendulum-v5")
    theirs.reset(seed=0)
    first, _ = ours.reset(seed=0)
    theirs.unwrapped.set_state(first[:2], first[2:])
    fallen = False
    while not fallen:
        mine, other = ours.step(np.array([0.9])), theirs.step(np.array([2.7]))
        assert np.array_equal(mine[0], other[0])
        assert mine[1:4] == other[1:4]
        assert mine[4]["evaluation"].true_reward == mine[1]
        assert mine[4]["ratings"].shape == (3,)
        fallen = mine[2]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"region": "postur"}, "region = 'postur'.*did you mean 'posture'"),
        ({"robot": "ant"}, "robot = 'ant'"),
        ({"panel": "nobody"}, "panel = 'nobody'"),
        ({"noise": -1.0}, "noise = -1.0"),
        ({"render_mode": "human"}, "render_mode = 'human'"),
        ({"region": 3}, "region = 3"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(InvalidValueError, match=message):
        make("Hopper", **options)


def test_a_step_before_a_reset_and_an_action_out_of_bounds():
    env = gymnasium.make("uard/Hopper-v0").unwrapped
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(3))
    env.reset(seed=0)
    with pytest.raises(InvalidValueError, match=r"actions = 2\.0"):
        env.step(np.array([0.0, 2.0, 0.0]))
