"""The buffers: what they remember of what they found must be what the filter finds, step by step."""

import copy
import pickle

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import uard.envs  # noqa: F401 registers the ids
from uard import InvalidValueError
from uard.adapters import sb3_buffers
from uard.adapters.sb3 import (
    CriticDisagreement,
    ReliabilityCallback,
    ReliabilityReplayBuffer,
    ReliabilityRolloutBuffer,
    ReliabilityVecEnv,
)
from uard.method.mitigations import RatedReward, named
from uard.ratings.stream import RewardStream

GRID, HOPPER = "uard/TrapGrid6-v0", "uard/Hopper-Posture-v0"
BOX, NUMBERS, ACTIONS = (
    gymnasium.spaces.Box(-1.0, 1.0, (2,)),
    gymnasium.spaces.Discrete(6),
    gymnasium.spaces.Discrete(2),
)


def step_of(random, space, count):
    """Return a random step of ``count`` environments, some of it unrated, by few raters, or with a rater missing."""
    states = random.integers(0, 6, (count, 1)) if space is NUMBERS else random.normal(size=(count, 2)).astype("f")
    actions, rewards = random.integers(0, 2, (count, 1)), random.normal(size=count).round(1)
    infos = []
    for reward in rewards:
        row = (reward + random.normal(size=int(random.integers(1, 4)))).tolist()
        kind = random.integers(6)
        infos.append({} if kind == 0 else {"ratings": [*row, None] if kind == 1 else np.array(row)})
    return states, actions, rewards, infos


@pytest.mark.parametrize("space", [NUMBERS, BOX])
@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("whole", [sb3_buffers.WHOLE, 20])
def test_a_batch_is_filtered_as_if_every_step_had_been_taken_in_and_judged_at_once(monkeypatch, space, count, whole):
    monkeypatch.setattr(sb3_buffers, "DRAWS", 1)  # nothing waits for a later batch
    monkeypatch.setattr(sb3_buffers, "WHOLE", whole)
    buffer = ReliabilityReplayBuffer(60 * count, space, ACTIONS, n_envs=count, device="cpu")
    stream, random = RewardStream(max_keys=1000), np.random.default_rng(0)
    kept = []  # as they were stored
    for number in range(150):  # more than it holds
        states, actions, rewards, infos = step_of(random, space, count)
        buffer.add(states, states, actions, rewards, np.zeros(count, bool), copy.deepcopy(infos))
        rows = [np.array(info.get("ratings", [np.nan]), float) for info in infos]
        ratings = np.full((count, max(map(len, rows))), np.nan)  # a rater who comes later is not known before
        for i, row in enumerate(rows):
            ratings[i, : len(row)] = row
        keys = (
            [(int(s), int(a)) for s, a in zip(states[:, 0], actions[:, 0], strict=True)] if space is NUMBERS else None
        )
        kept.append((rewards, stream.observe(rewards, ratings, keys), ratings))
        del kept[:-60]
        first = max(0, number - 59)
        places = random.integers(0, len(kept), 8)
        buffer._get_samples((places + first) % 60)
        for place in places:
            raw, seen, _ = kept[place]
            known = seen.visit if seen.slots is None else stream.known(seen.slots)
            alone = stream.filter(raw, known, keyed=seen.slots is not None).reward
            assert buffer.rewards[(place + first) % 60] == pytest.approx(alone, rel=1e-5, abs=1e-6)
    assert buffer.steps.stream.rated == stream.rated


def grid_step(buffer, state, reward, ratings):
    one = np.array([[state]])
    buffer.add(one, one, np.array([[1]]), np.array([reward]), np.zeros(1, bool), [{"ratings": ratings}])


def test_what_raters_say_late_counts_at_the_latest_in_the_32nd_batch():
    buffer = ReliabilityReplayBuffer(64, NUMBERS, ACTIONS, mitigation=RatedReward("mean"), device="cpu")
    for _ in range(9):
        grid_step(buffer, 3, 4.0, [1.0])
    assert set(buffer.sample(8).rewards.ravel().tolist()) == {1.0}
    grid_step(buffer, 3, 4.0, [11.0])
    found = [buffer.sample(8).rewards.ravel().unique().tolist() for _ in range(sb3_buffers.DRAWS)]
    assert found[0] == [1.0]
    assert found[-1] == [2.0]
    # Somebody who tells the stream itself, and waits for no step, is heard in the next batch.
    buffer.steps.stream.observe([4.0], [[-9.0]], keys=[(3, 1)])
    assert buffer.sample(8).rewards.ravel().unique().tolist() == [1.0]


def test_whoever_looks_at_what_a_buffer_knows_sees_all_that_was_added():
    buffer = ReliabilityReplayBuffer(64, BOX, ACTIONS, device="cpu")
    for i in range(5):
        state = np.zeros((1, 2), np.float32)
        buffer.add(state, state, np.array([[1]]), np.array([1.0]), np.zeros(1, bool), [{"ratings": [float(i)]}])
    assert pickle.loads(pickle.dumps(buffer)).steps.stream.rated == 5
    assert buffer.steps.stream.rated == 5


def test_another_stream_or_rule_judges_everything_anew():
    buffer = ReliabilityReplayBuffer(64, NUMBERS, ACTIONS, mitigation=RatedReward("mean"), device="cpu")
    grid_step(buffer, 3, 4.0, [1.0, 2.0])
    assert buffer.sample(2).rewards.ravel().tolist() == [1.5] * 2
    buffer.steps.stream.mitigation = RatedReward("lowest")
    assert buffer.sample(2).rewards.ravel().tolist() == [1.0] * 2


def test_more_pairs_than_are_worth_it_are_judged_batch_by_batch(monkeypatch):
    monkeypatch.setattr(sb3_buffers, "MOST_PAIRS", 3)
    buffer = ReliabilityReplayBuffer(64, NUMBERS, ACTIONS, mitigation=RatedReward("mean"), device="cpu")
    for i in range(6):
        grid_step(buffer, i, 4.0, [float(i)])
        assert buffer._get_samples(np.array([i])).rewards.item() == i
    assert buffer._get_samples(np.arange(6)).rewards.ravel().tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]


def test_a_buffer_that_was_pickled_before_it_remembered_goes_on():
    buffer = ReliabilityReplayBuffer(64, BOX, ACTIONS, mitigation=RatedReward("mean"), device="cpu")
    state = np.zeros((1, 2), np.float32)
    buffer.add(state, state, np.array([[1]]), np.array([4.0]), np.zeros(1, bool), [{"ratings": [1.0, 2.0]}])
    old = dict(vars(buffer), steps=buffer.steps, latest=None)
    for name in (
        "_steps",
        "_waiting",
        "_soon",
        "_drawn",
        "_latest",
        "_pairs",
        "_singles",
        "_draws",
        "_rated",
        "_judge",
    ):
        del old[name]
    again = ReliabilityReplayBuffer.__new__(ReliabilityReplayBuffer)
    again.__setstate__(old)
    assert again.sample(2).rewards.ravel().tolist() == [1.5] * 2


# --- critics ---------------------------------------------------------------------------------------------------------


def small_sac(**options):
    env = make_vec_env(HOPPER, 1, seed=0, env_kwargs={"panel": "appendix"})
    policy = {"net_arch": [16]}
    return SAC("MlpPolicy", env, learning_starts=20, seed=0, policy_kwargs=policy, **options)


def test_critics_are_asked_once_and_training_is_the_same(monkeypatch):
    weights, asked = [], []
    for lend in (True, False):
        count = [0]
        with monkeypatch.context() as patch:
            if not lend:
                patch.setattr(CriticDisagreement, "lend", lambda self: None)
            rule = {"mitigation": named("uard-0.1")}  # in which sigma_m always has a say
            model = small_sac(replay_buffer_class=ReliabilityReplayBuffer, replay_buffer_kwargs=rule)
            hook = model.critic.q_networks[0].register_forward_hook(lambda *_, n=count: n.__setitem__(0, n[0] + 1))
            model.learn(60, callback=ReliabilityCallback())
            hook.remove()
        weights.append(model.policy.state_dict())
        asked.append(count[0])
        assert "forward" not in vars(model.critic)
    assert all(torch.equal(weights[0][name], value) for name, value in weights[1].items())
    assert (asked[0], asked[1]) == (2 * 40, 3 * 40)  # with what the actor asks


def test_critics_are_asked_only_where_they_have_a_say():
    """Of steps that somebody has rated `uard` learns the same whatever critics say: those rewards are looked up."""

    def half(observations, actions, following, rewards):
        said = np.stack([rewards, rewards + 0.5, rewards - 4.0], 1)
        return np.where((np.abs(1e5 * observations[:, :1]).astype(int) % 2 > 0), said, np.nan)

    model = small_sac(replay_buffer_class=ReliabilityReplayBuffer, replay_buffer_kwargs={"ratings": half})
    model.learn(120, callback=ReliabilityCallback())
    buffer, critics = model.replay_buffer, CriticDisagreement(model)
    buffer.steps.sigma_m = critics
    rated = ~np.isnan(buffer._ratings[:120, 0]).all(-1)
    assert 0.2 < rated.mean() < 0.8
    places = np.arange(120)
    batch = buffer._get_samples(places)
    sigma_m = critics.of_batch(batch.observations, batch.actions)
    anew = buffer._filtered(places, sigma_m)
    assert np.allclose(batch.rewards.numpy().ravel(), anew.reward, rtol=1e-5, atol=1e-6)
    assert np.allclose(buffer.latest.sigma_m, sigma_m)
    assert np.allclose(buffer.latest.reward, anew.reward)
    asked = []
    hook = model.critic.q_networks[0].register_forward_hook(lambda *_: asked.append(1))
    buffer._get_samples(places[rated])
    assert asked == []
    buffer._get_samples(places[~rated][:1])
    hook.remove()
    assert asked == [1]
    with torch.no_grad():
        model.critic.q_networks[0][-1].bias.add_(50.0)  # the critics have learned something else
    other = buffer._get_samples(places).rewards.numpy().ravel()
    assert np.array_equal(other[rated], batch.rewards.numpy().ravel()[rated])
    assert (other[~rated] < batch.rewards.numpy().ravel()[~rated] - 1.0).all()


def test_an_answer_is_not_given_to_another_question():
    model = small_sac()
    critics = CriticDisagreement(model)
    states = torch.zeros(4, model.observation_space.shape[0])
    actions = torch.zeros(4, model.action_space.shape[0])
    critics.lend()
    critics.of_batch(states, actions)
    with torch.no_grad():
        next(model.critic.parameters()).add_(1.0)  # the critics are others now
    now = torch.cat(model.critic(states, actions), 1)
    critics.take_back()
    assert torch.equal(now, torch.cat(model.critic(states, actions), 1))


# --- rollouts --------------------------------------------------------------------------------------------------------


def rollout_buffer(**options):
    return {"rollout_buffer_class": ReliabilityRolloutBuffer, "rollout_buffer_kwargs": options}


def test_a_rollout_is_filtered_by_all_that_was_said_until_its_end():
    model = PPO("MlpPolicy", make_vec_env(GRID, 3, seed=0, env_kwargs={"panel": "main"}), n_steps=40, batch_size=60,
                seed=0, **rollout_buffer())  # fmt: skip
    seen, stream = [], RewardStream()

    class Watching(ReliabilityCallback):
        def _on_step(self):
            going = super()._on_step()
            step = self.locals
            keys = list(zip(model._last_obs.tolist(), step["clipped_actions"].tolist(), strict=True))
            seen.append((step["rewards"].astype(float), [x["ratings"] for x in step["infos"]], keys, step["dones"]))
            return going

        def _on_rollout_end(self):
            super()._on_rollout_end()
            raw = np.concatenate([x[0] for x in seen])
            out = stream(raw, np.concatenate([x[1] for x in seen]), keys=[key for x in seen for key in x[2]])
            latest = model.rollout_buffer.latest
            assert np.allclose(latest.reward, out.reward)
            assert np.array_equal(latest.raw, raw)
            learned = model.rollout_buffer.rewards.ravel()
            ended = np.concatenate([x[3] for x in seen])  # where a time limit may have added a value
            assert np.allclose(learned[~ended], out.reward[~ended], atol=1e-5)
            seen.clear()

    model.learn(240, callback=Watching())
    assert stream.rated == model.rollout_buffer.steps.stream.rated == 240


def test_episodes_go_on_across_rollouts_and_their_returns_are_whole():
    class Five(gymnasium.Env):
        observation_space, action_space = BOX, ACTIONS

        def reset(self, *, seed=None, options=None):
            self.left = 5
            return np.zeros(2, np.float32), {}

        def step(self, action):
            self.left -= 1
            return np.zeros(2, np.float32), 1.0, self.left == 0, False, {"ratings": [3.0]}

    env = DummyVecEnv([Five, Five])
    buffer = rollout_buffer(mitigation=RatedReward("mean"))
    model = A2C("MlpPolicy", env, n_steps=4, **buffer)
    ends = []

    class Watching(ReliabilityCallback):
        def _on_rollout_end(self):
            super()._on_rollout_end()
            ends.append(list(model.rollout_buffer.episodes))

    model.learn(2 * 4 * 5, callback=Watching())
    assert ends == [[], *[[(5.0, 15.0)] * 2] * 4]


def test_what_a_time_limit_cut_off_keeps_its_value():
    class Long(gymnasium.Env):
        observation_space, action_space = BOX, ACTIONS

        def reset(self, *, seed=None, options=None):
            return np.zeros(2, np.float32), {}

        def step(self, action):
            return np.ones(2, np.float32), 1.0, False, False, {"ratings": [3.0]}

    env = DummyVecEnv([lambda: gymnasium.wrappers.TimeLimit(Long(), 3)])
    model = A2C("MlpPolicy", env, n_steps=3, gamma=0.9, **rollout_buffer(mitigation=RatedReward("mean")))
    with torch.no_grad():
        value = model.policy.predict_values(torch.ones(1, 2)).item()
    found = []

    class Watching(ReliabilityCallback):
        def _on_rollout_end(self):
            super()._on_rollout_end()
            found.append(model.rollout_buffer.rewards.ravel().tolist())

    model.learn(3, callback=Watching())
    assert found[0] == pytest.approx([3.0, 3.0, 3.0 + 0.9 * value], rel=1e-5)


def test_callables_of_a_rollout_see_what_the_environments_gave():
    asked = []

    def ratings(observations, actions, following, rewards):
        asked.append((observations.copy(), following.copy()))
        return rewards[:, None] + [[0.0, 1.0]]

    env = VecNormalize(make_vec_env("Pendulum-v1", 2, seed=0), norm_reward=False)
    model = PPO("MlpPolicy", env, n_steps=16, batch_size=32, **rollout_buffer(ratings=ratings))
    model.learn(64, callback=ReliabilityCallback())
    (before, after), (later, _) = asked
    before, after = before.reshape(16, 2, 3), after.reshape(16, 2, 3)
    assert np.array_equal(before[1:], after[:-1])
    assert np.array_equal(later.reshape(16, 2, 3)[0], after[-1])
    assert np.allclose(np.hypot(before[..., 0], before[..., 1]), 1.0, atol=1e-5)  # a cosine and a sine: not normalised


def test_a_rollout_of_which_nobody_was_told_anything_is_an_error():
    model = PPO("MlpPolicy", make_vec_env(GRID, 1, env_kwargs={"panel": "main"}), n_steps=8, batch_size=8,
                **rollout_buffer())  # fmt: skip
    with pytest.raises(
        InvalidValueError, match=r"^steps that the buffer was told of = 0: must be 8: give learn\(callback"
    ):
        model.learn(8)


def test_rewards_that_are_normalised_or_filtered_reach_no_rollout_buffer():
    grid = make_vec_env(GRID, 1, env_kwargs={"panel": "main"})
    model = PPO("MlpPolicy", VecNormalize(grid, norm_obs=False), n_steps=8, batch_size=8, **rollout_buffer())
    with pytest.raises(InvalidValueError, match=r"^venv = 'VecNormalize': must be .*normalised units"):
        model.learn(8, callback=ReliabilityCallback())
    model = PPO("MlpPolicy", ReliabilityVecEnv(grid), n_steps=8, batch_size=8, **rollout_buffer())
    with pytest.raises(InvalidValueError, match=r"rollout buffer filters: rewards would be filtered twice"):
        model.learn(8, callback=ReliabilityCallback())


def test_a_rollout_that_was_broken_off_is_remembered_and_not_learned_from():
    class Stops(ReliabilityCallback):
        def _on_step(self):
            return super()._on_step() and self.n_calls != 5

    grid = make_vec_env(GRID, 1, seed=0, env_kwargs={"panel": "main"})
    model = PPO("MlpPolicy", grid, n_steps=8, batch_size=8, **rollout_buffer())
    model.learn(8, callback=Stops())
    assert model.rollout_buffer.latest is None
    model.learn(8, callback=ReliabilityCallback())
    assert model.rollout_buffer.steps.stream.rated == 5 + 8
    assert len(model.rollout_buffer.latest.reward) == 8
