import gc
import pickle
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from sb3_contrib import TRPO
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor, VecNormalize

import uard.envs  # noqa: F401 registers the ids
from uard import InvalidValueError
from uard.adapters.gymnasium import ReliabilityWrapper
from uard.adapters.sb3 import CriticDisagreement, ReliabilityCallback, ReliabilityReplayBuffer, ReliabilityVecEnv
from uard.method.mitigations import RatedReward, Raw, named

GRID = "uard/TrapGrid6-v0"


def grids(count=1, panel="main", **options):
    return make_vec_env(GRID, count, seed=0, env_kwargs={"panel": panel} | options)


def small(**policy):
    """Return settings of a small off-policy algorithm; Stable-Baselines3 writes into ``policy_kwargs``."""
    return {"learning_starts": 100, "buffer_size": 1000, "policy_kwargs": {"net_arch": [16]} | policy}


def scalars(model):
    """Return what a model's logger holds under uard/."""
    return {k.removeprefix("uard/"): v for k, v in model.logger.name_to_value.items() if k.startswith("uard/")}


def test_the_same_rewards_as_the_gymnasium_wrapper():
    ours = ReliabilityVecEnv(DummyVecEnv([lambda: gymnasium.make(GRID, panel="main")]))
    theirs = ReliabilityWrapper(gymnasium.make(GRID, panel="main"))
    ours.seed(7)
    ours.reset()
    theirs.reset(seed=7)
    random = np.random.default_rng(0)
    for _ in range(200):
        action = int(random.integers(4))
        _, mine, dones, infos = ours.step(np.array([action]))
        _, other, terminated, truncated, info = theirs.step(action)
        assert mine[0] == pytest.approx(other, rel=1e-5)  # DummyVecEnv keeps rewards as float32
        assert infos[0]["weight"] == pytest.approx(info["weight"], rel=1e-5)
        assert dones[0] == (terminated or truncated)
        if dones[0]:
            assert infos[0]["filtered_return"] == pytest.approx(info["filtered_return"], rel=1e-5)
            theirs.reset()


def test_the_monitor_inside_sees_raw_returns_and_one_outside_filtered_ones():
    env = VecMonitor(ReliabilityVecEnv(DummyVecEnv([lambda: gymnasium.make(GRID, panel="main")] * 2)))
    env.reset()
    random = np.random.default_rng(0)
    ends = []
    for _ in range(200):
        _, _, _, infos = env.step(random.integers(0, 4, 2))
        ends += [i for i in infos if "episode" in i]
    assert len(ends) >= 8
    for info in ends:
        assert info["episode"]["r"] == pytest.approx(info["filtered_return"], abs=1e-4)
    assert any(abs(i["raw_return"] - i["filtered_return"]) > 1 for i in ends)


def test_the_buffer_filters_old_steps_by_what_is_known_when_they_are_sampled():
    buffer = ReliabilityReplayBuffer(
        64, gymnasium.spaces.Discrete(36), gymnasium.spaces.Discrete(4), mitigation=RatedReward("mean"), device="cpu"
    )

    def add(state, reward, ratings):
        one = np.array([[state]])
        buffer.add(one, one, np.array([[1]]), np.array([reward]), np.array([False]), [{"ratings": ratings}])

    add(3, 4.0, [0.0, 2.0])
    assert set(buffer.sample(8).rewards.ravel().tolist()) == {1.0}
    add(3, 4.0, [-5.0, -5.0])
    assert set(buffer.sample(8).rewards.ravel().tolist()) == {-2.0}  # the mean of 1 and -5, for both
    assert buffer.latest.raw.tolist() == [4.0] * 8
    again = pickle.loads(pickle.dumps(buffer))
    assert set(again.sample(8).rewards.ravel().tolist()) == {-2.0}


def test_a_buffer_of_several_environments_keeps_rewards_where_they_belong():
    box = gymnasium.spaces.Box(-1.0, 1.0, (2,))
    buffer = ReliabilityReplayBuffer(40, box, box, n_envs=2, mitigation=RatedReward("lowest", unrated_weight=1.0))
    for i in range(30):
        states = np.full((2, 2), i / 100, np.float32)
        infos = [{"ratings": [float(i), i + 5.0]}, {}]
        buffer.add(states, states, states, np.array([50.0, 70.0]), np.zeros(2, bool), infos)
    batch = buffer.sample(200)
    which = np.rint(batch.observations[:, 0].numpy() * 100)
    rewards = batch.rewards.ravel().numpy()
    assert ((rewards == which) | (rewards == 70.0)).all()
    assert 50 < (rewards == 70.0).sum() < 150
    assert buffer._raw[:10].max() == 70.0


def test_a_key_of_the_buffer_sees_the_whole_observation():
    spaces = gymnasium.spaces.Box(-1.0, 1.0, (2,)), gymnasium.spaces.Discrete(2)
    buffer = ReliabilityReplayBuffer(4, *spaces, mitigation=RatedReward(), key=lambda state, action: (*state, action))
    for y, rating in ((0.0, -1.0), (1.0, 3.0)):  # two states that differ in their second coordinate
        state = np.array([[0.5, y]], np.float32)
        buffer.add(state, state, np.array([[1]]), np.array([2.0]), np.array([False]), [{"ratings": [rating]}])
    assert buffer._get_samples(np.array([0, 1])).rewards.ravel().tolist() == [-1.0, 3.0]


def test_sac_lends_its_critics_and_takes_them_back(tmp_path):
    env = make_vec_env("uard/Hopper-Posture-v0", 1, seed=0, env_kwargs={"panel": "appendix"})
    model = SAC(
        "MlpPolicy",
        VecNormalize(env, norm_reward=False),
        replay_buffer_class=ReliabilityReplayBuffer,
        **small(n_critics=3),
    )
    model.learn(160, callback=ReliabilityCallback(), log_interval=1000)
    assert scalars(model)["sigma_m"] > 0
    assert 0 < scalars(model)["weight"] < 1
    assert model.replay_buffer.steps.sigma_m is None
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    seen = model.replay_buffer.steps.stream.rated
    model.load_replay_buffer(tmp_path / "buffer.pkl")
    assert model.replay_buffer.steps.stream.rated == seen == 160
    model.learn(30, reset_num_timesteps=False, callback=ReliabilityCallback())


def test_sac_with_wrapped_environments_takes_sigma_m_from_its_critics():
    env = ReliabilityVecEnv(
        make_vec_env("Pendulum-v1", 1, seed=0), ratings=lambda o, a, f, r: r[:, None] + [[0.0, 1.0]]
    )
    model = SAC("MlpPolicy", env, **small())
    model.learn(150, callback=ReliabilityCallback(), log_interval=1000)
    # In the environments' units: Pendulum's torque is in [-2, 2], and the critics' in [-1, 1].
    states, torque = np.zeros((4, 3), np.float32), np.array([[-2.0], [-1.0], [0.0], [2.0]], np.float32)
    critics = CriticDisagreement(model)
    assert np.allclose(critics.outside(states, torque), critics(states, torque / 2))
    assert scalars(model)["sigma_m"] > 0


@pytest.mark.parametrize("algorithm", [PPO, TRPO])
def test_on_policy_learns_from_filtered_rewards_and_reports_both(algorithm):
    wrapped = ReliabilityVecEnv(grids(4))
    model = algorithm("MlpPolicy", VecNormalize(wrapped, norm_obs=False), n_steps=64, batch_size=64, seed=0)
    model.learn(256, callback=ReliabilityCallback(), log_interval=1000)
    held = scalars(model)
    assert {"weight", "sigma_h", "lambda_t", "raw_reward", "raw_return", "filtered_return"} <= set(held)
    # What is normalised, and learned from, is the filtered reward.
    assert np.allclose(model.env.get_original_reward(), wrapped.latest.reward)
    assert not np.allclose(wrapped.latest.reward, wrapped.latest.raw)


def test_tensorboard_gets_the_scalars(tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    model = PPO("MlpPolicy", ReliabilityVecEnv(grids(2)), n_steps=64, batch_size=64, tensorboard_log=str(tmp_path))
    model.learn(256, callback=ReliabilityCallback())
    model.logger.close()
    events = EventAccumulator(str(next(tmp_path.iterdir())))
    events.Reload()
    assert "uard/weight" in events.Tags()["scalars"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # it never closes its file
        del events
        gc.collect()


def test_what_was_learned_is_saved_and_loaded(tmp_path):
    env = ReliabilityVecEnv(grids(2), named("uard-0.1", lam=0.3))
    env.reset()
    random = np.random.default_rng(0)
    for _ in range(100):
        env.step(random.integers(0, 4, 2))
    env.save(tmp_path / "stream.npz")
    again = ReliabilityVecEnv.load(tmp_path / "stream.npz", grids(2))
    assert again.steps.stream.rated == 200
    assert again.steps.stream.mitigation == named("uard-0.1", lam=0.3)
    (tmp_path / "other.pkl").write_bytes(pickle.dumps([1]))
    with pytest.raises(InvalidValueError, match=r"path = .*other.pkl.*: must be a file that save wrote"):
        ReliabilityVecEnv.load(tmp_path / "other.pkl", grids(2))


def test_raw_changes_nothing_about_training():
    plain, wrapped = grids(2), ReliabilityVecEnv(grids(2), Raw())
    one, two = (PPO("MlpPolicy", e, n_steps=32, batch_size=32, seed=3).learn(128) for e in (plain, wrapped))
    for a, b in zip(one.policy.parameters(), two.policy.parameters(), strict=True):
        assert torch.equal(a, b)


def test_ratings_of_a_callable_see_where_an_episode_ended():
    ends = []

    def ratings(observations, actions, following, rewards):
        ends.extend(following[rewards > 5].ravel().tolist())  # the goal is worth 10
        return rewards[:, None] + np.array([[0.0, 0.1]])

    env = ReliabilityVecEnv(make_vec_env("uard/TrapGrid-v0", 2, env_kwargs={"size": 2}), ratings=ratings)
    env.reset()
    random = np.random.default_rng(0)
    for _ in range(60):
        env.step(random.integers(0, 4, 2))
    assert len(ends) > 3
    assert set(ends) == {3}


@pytest.mark.parametrize("bad", [[1.0, float("inf")], "good", 3.0])
def test_bad_ratings_name_the_environment(bad):
    class Bad(gymnasium.Wrapper):
        def step(self, action):
            *rest, info = super().step(action)
            return *rest, info | {"ratings": bad}

    env = ReliabilityVecEnv(
        DummyVecEnv([lambda: gymnasium.make(GRID, panel="main"), lambda: Bad(gymnasium.make(GRID))])
    )
    env.reset()
    with pytest.raises(InvalidValueError, match="ratings of environment 1 = "):
        env.step(np.zeros(2, int))


def test_orders_that_cannot_be_meant():
    with pytest.raises(InvalidValueError, match=r"must be VecNormalize\(ReliabilityVecEnv\(venv\)\)"):
        ReliabilityVecEnv(VecNormalize(grids(), norm_obs=False))
    ReliabilityVecEnv(VecNormalize(make_vec_env("Pendulum-v1"), norm_reward=False))
    with pytest.raises(InvalidValueError, match="env = 'DummyVecEnv': must be a ReliabilityVecEnv"):
        PPO("MlpPolicy", grids(), n_steps=32, batch_size=32).learn(32, callback=ReliabilityCallback())
    model = DQN("MlpPolicy", ReliabilityVecEnv(grids()), replay_buffer_class=ReliabilityReplayBuffer, **small())
    with pytest.raises(InvalidValueError, match="filtered twice"):
        model.learn(32, callback=ReliabilityCallback())
    with pytest.raises(InvalidValueError, match="model = 'DQN': must be one with two critics or more"):
        CriticDisagreement(model)


# --- filtering twice, other spaces, other precisions ----------------------------------------------------------------


def wrapped_grid():
    return ReliabilityWrapper(gymnasium.make(GRID, panel="main"))


@pytest.mark.parametrize("venv", [DummyVecEnv, SubprocVecEnv])
def test_a_vec_env_around_something_that_filters_is_refused(venv):
    def here():  # what is local travels whole to another process; this file is no module there
        return ReliabilityWrapper(gymnasium.make(f"uard.envs:{GRID}", panel="main"))

    inner = venv([here])
    try:
        with pytest.raises(InvalidValueError, match=rf"^venv = '{venv.__name__}': .*filtered twice"):
            ReliabilityVecEnv(inner)
    finally:
        inner.close()
    with pytest.raises(InvalidValueError, match=r"^venv = 'ReliabilityVecEnv': .*filtered twice"):
        ReliabilityVecEnv(VecNormalize(ReliabilityVecEnv(grids()), norm_obs=False, norm_reward=False))


@pytest.mark.parametrize("env", [lambda: DummyVecEnv([wrapped_grid]), lambda: ReliabilityVecEnv(grids())])
def test_a_buffer_behind_something_that_filters_is_refused_without_the_callback_too(env):
    model = DQN("MlpPolicy", env(), replay_buffer_class=ReliabilityReplayBuffer, **small())
    with pytest.raises(InvalidValueError, match=r"^infos\[0\]\['raw_reward'\] = .*filtered twice"):
        model.learn(8)


def test_a_vec_env_that_cannot_say_what_is_inside_is_found_out_at_the_first_step():
    class Silent(VecMonitor):
        def env_is_wrapped(self, wrapper_class, indices=None):
            raise NotImplementedError

    env = ReliabilityVecEnv(Silent(DummyVecEnv([wrapped_grid])))
    env.reset()
    with pytest.raises(InvalidValueError, match=r"^infos\[0\]\['raw_reward'\] = .*filtered twice"):
        env.step(np.zeros(1, int))


def test_an_environment_that_gives_one_info_again_and_again_is_not_taken_for_a_filtered_one():
    class Same(gymnasium.Wrapper):
        def step(self, action):
            return *super().step(action)[:4], kept

    kept = {"ratings": [1.0, 2.0]}
    env = ReliabilityVecEnv(DummyVecEnv([lambda: Same(gymnasium.make(GRID))]))
    env.reset()
    for _ in range(3):
        env.step(np.zeros(1, int))
    assert "weight" not in kept


def test_what_is_no_single_precision_number_reaches_no_algorithm():
    """1e39 is a double and would be infinity in a network."""
    high = [1e39, 1e39]
    env = ReliabilityVecEnv(grids(), RatedReward(), ratings=lambda o, a, f, r: np.array([[1e39] * 3]))
    env.reset()
    with pytest.raises(InvalidValueError, match=r"^filtered reward\[0\] = 1e\+39: must be in .* it leaves as float32"):
        env.step(np.zeros(1, int))
    box = gymnasium.spaces.Box(-1.0, 1.0, (2,))
    one, done = np.zeros((1, 2), np.float32), np.zeros(1, bool)
    buffer = ReliabilityReplayBuffer(4, box, box, mitigation=RatedReward())
    with pytest.raises(InvalidValueError, match=r"^reward\[0\] = 1e\+39: must be in .* it leaves as float32"):
        buffer.add(one, one, one, np.array([1e39]), done, [{}])
    buffer.add(one, one, one, np.ones(1), done, [{"ratings": high}])
    with pytest.raises(InvalidValueError, match=r"^filtered reward\[0\] = 1e\+39"):
        buffer.sample(1)


def test_observations_that_the_buffer_cannot_hold_are_named_before_training():
    space = gymnasium.spaces.Dict({"a": gymnasium.spaces.Box(-1.0, 1.0, (2,))})
    for options in ((4, space), (4,)):
        with pytest.raises(InvalidValueError, match=r"^observation_space = Dict.*FlattenObservation"):
            ReliabilityReplayBuffer(
                *options, **{} if len(options) > 1 else {"observation_space": space}, action_space=space["a"]
            )


def test_the_places_of_a_buffers_steps_are_never_given_to_others():
    box = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    buffer = ReliabilityReplayBuffer(150_000, box, gymnasium.spaces.Discrete(2), key=lambda state, action: state)
    assert buffer.steps.stream._max_keys == 150_000


def test_a_step_before_the_first_reset_says_so():
    with pytest.raises(gymnasium.error.ResetNeeded):
        ReliabilityVecEnv(grids()).step(np.zeros(1, int))


@pytest.mark.parametrize(
    "make",
    [
        lambda m: ReliabilityVecEnv(grids(), m),
        lambda m: ReliabilityReplayBuffer(8, gymnasium.spaces.Discrete(9), gymnasium.spaces.Discrete(4), mitigation=m),
    ],
)
def test_a_class_is_no_mitigation(make):
    with pytest.raises(InvalidValueError, match=r"^mitigation = <class .*: must be a Mitigation, not its class"):
        make(Raw)


def test_saving_again_leaves_the_old_file_whole_until_the_new_one_is(tmp_path):
    path = tmp_path / "stream.npz"
    env = ReliabilityVecEnv(grids())
    env.reset()
    env.step(np.array([1]))
    env.save(path)
    before = path.read_bytes()
    env.steps.stream([1.0], [[1.0]], keys=[frozenset()])
    with pytest.raises(InvalidValueError, match=r"^key = frozenset"):
        env.save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_rewards_in_normalised_units_are_refused():
    venv = make_vec_env("uard/TrapGrid6-v0", 1, wrapper_class=gymnasium.wrappers.NormalizeReward)
    with pytest.raises(InvalidValueError, match="normalised units"):
        ReliabilityVecEnv(venv)
