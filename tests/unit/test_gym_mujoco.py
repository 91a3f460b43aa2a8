import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import uard.envs  # noqa: F401 registers the ids
from uard import InvalidValueError
from uard.envs.locomotion.gym import REGISTERED


@pytest.mark.filterwarnings("ignore:.*A Box observation space m..imum value is")
@pytest.mark.filterwarnings("ignore:.*render_modes")
@pytest.mark.parametrize("name", ["uard/Hopper-Posture-v0", "uard/Walker2d-v0"])
def test_gymnasiums_own_checks(name):
    check_env(gymnasium.make(name).unwrapped, skip_render_check=True)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_steps_and_falls_equal_gymnasiums_to_the_bit():
    ours, theirs = gymnasium.make("uard/Hopper-v0"), gymnasium.make("Hopper-v4")
    theirs.reset(seed=0)
    ours.reset(seed=0)
    data = theirs.unwrapped.data
    physics = ours.unwrapped._physics
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


def test_every_id_can_be_made():
    assert len(REGISTERED) == 10
    for name in REGISTERED:
        gymnasium.make(name).close()


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
    from uard.envs.locomotion.gym import LocomotionEnv

    with pytest.raises(InvalidValueError, match=message):
        LocomotionEnv(**options)


def test_a_step_before_a_reset_and_an_action_out_of_bounds():
    env = gymnasium.make("uard/Hopper-v0").unwrapped
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(3))
    env.reset(seed=0)
    with pytest.raises(InvalidValueError, match=r"actions = 2\.0"):
        env.step(np.array([0.0, 2.0, 0.0]))
