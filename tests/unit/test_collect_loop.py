"""What a training run and its raters give each other."""

import io

import gymnasium
import numpy as np
import pytest

import uard.envs  # noqa: F401 - registers the environments
from uard._checks import InvalidValueError
from uard.adapters.gymnasium import ReliabilityWrapper
from uard.collect import Project, Question, clip_item, recorder, sheets
from uard.collect.clip_model import FEWEST, ClipModel, RatedClip
from uard.collect.loop import StoreRatings, UnusableClipWarning
from uard.collect.recorder import ClipRecorder
from uard.ratings.table import Answer

NUMBERED = gymnasium.spaces.Discrete(9), gymnasium.spaces.Discrete(4)
SMOOTH = gymnasium.spaces.Box(-1.0, 1.0, (2,)), gymnasium.spaces.Box(-1.0, 1.0, (1,))


@pytest.fixture
def project(tmp_path):
    return Project.create(tmp_path / "project")


def step(state, action):
    return clip_item("0" * 64 + ".webp", 2, 2, (8, 8), reward=1.0, key=[state, action])


def ask(ratings, state, action):
    return ratings(np.array([state]), np.array([action]), np.array([0]), np.array([1.0]))[0].tolist()


def test_a_rating_is_handed_on_once_when_its_state_comes_again(project):
    x = step(1, 3)
    ratings = StoreRatings(project, *NUMBERED, poll=0.0)
    assert np.isnan(ask(ratings, 1, 3)).all()
    with project.store() as store:
        store.add_items([x])
        store.invite("ann")
        store.put([Answer("a1", x.id, "ann", -1.0)])
        store.put([Answer("a2", x.id, "ann", -0.5)])
        assert np.isnan(ask(ratings, 1, 2)).all()
        assert ask(ratings, 1, 3) == [-1.0]
        assert ask(ratings, 1, 3) == [-0.5]
        assert np.isnan(ask(ratings, 1, 3)).all()
        store.invite("bob")
        store.put([Answer("b1", x.id, "bob", 0.25)])
        np.testing.assert_array_equal(ask(ratings, 1, 3), [np.nan, 0.25])
    assert (ratings.heard, ratings.raters) == (3, ("ann", "bob"))


def test_practice_choices_and_what_is_taken_back_are_no_ratings(project):
    x = step(1, 3)
    ratings = StoreRatings(project, *NUMBERED, poll=0.0)
    with project.store() as store:
        store.add_items([x])
        store.invite("ann")
        store.put([Answer("a1", x.id, "ann", -1.0, kind="practice")])
        store.put([Answer("a2", x.id, "ann", choice="skip")])
        store.put([Answer("a3", x.id, "ann", 5.0)])
        store.put([Answer("a4", x.id, "ann", supersedes="a3")])
        store.put([Answer("a5", x.id, "ann", 0.5, attribute="safe")])
    assert np.isnan(ask(ratings, 1, 3)).all()
    assert ratings.heard == 0


def test_the_store_is_looked_into_no_more_often_than_asked(project):
    now = [0.0]
    x = step(1, 3)
    ratings = StoreRatings(project, *NUMBERED, poll=1.0, clock=lambda: now[0])
    ask(ratings, 0, 0)
    with project.store() as store:
        store.add_items([x])
        store.invite("ann")
        store.put([Answer("a1", x.id, "ann", -1.0)])
    assert np.isnan(ask(ratings, 1, 3)).all()
    now[0] = 1.0
    assert ask(ratings, 1, 3) == [-1.0]


def test_an_answer_that_is_corrected_in_time_is_not_handed_on(project):
    x = step(1, 3)
    ratings = StoreRatings(project, *NUMBERED, poll=0.0)
    with project.store() as store:
        store.add_items([x])
        store.invite("ann")
        store.put([Answer("a1", x.id, "ann", 1.0)])
        ratings.refresh()
        store.put([Answer("a2", x.id, "ann", -1.0, supersedes="a1")])
        assert ask(ratings, 1, 3) == [-1.0]
        assert np.isnan(ask(ratings, 1, 3)).all()


def test_the_model_forgets_what_was_taken_back(project):
    random = np.random.default_rng(0)
    ratings = StoreRatings(project, *SMOOTH, poll=0.0)
    items = []
    for clip in lying(random, 2 * FEWEST):
        file = io.BytesIO()
        np.savez(file, observations=clip.observations, actions=clip.actions)
        name = project.keep(file.getvalue(), "npz")
        items.append(clip_item("0" * 64 + ".webp", 9, 3, (8, 8), data=name, reward=1.0))
    with project.store() as store:
        store.add_items(items)
        store.invite("ann")
        for i, item in enumerate(items):
            store.put([Answer(f"a{i}", item.id, "ann", 0.0)])
        assert np.isfinite(ratings(np.zeros((2, 2)), np.zeros((2, 1)), None, np.ones(2))).all()
        for i, item in enumerate(items[: FEWEST + 1]):
            store.put([Answer(f"b{i}", item.id, "ann", supersedes=f"a{i}")])
        assert np.isnan(ratings(np.zeros((2, 2)), np.zeros((2, 1)), None, np.ones(2))).all()


def test_clips_that_say_nothing_to_a_run_are_named_and_do_not_end_it(project):
    missing = clip_item("0" * 64 + ".webp", 9, 3, (8, 8), data="0" * 64 + ".npz", reward=1.0)
    with project.store() as store:
        store.add_items([missing])
        store.invite("ann")
        store.put([Answer("a1", missing.id, "ann", 0.0)])
    with pytest.warns(UnusableClipWarning, match="cannot be read"):
        StoreRatings(project, *SMOOTH)(np.zeros((2, 2)), np.zeros((2, 1)), None, np.ones(2))
    with pytest.warns(UnusableClipWarning, match="cannot be read"):
        StoreRatings(project, *NUMBERED)(np.zeros(1, int), np.zeros(1, int), None, np.ones(1))


def test_clips_of_several_steps_belong_to_no_state_action(project):
    file = io.BytesIO()
    np.savez(file, observations=np.zeros(3, int), actions=np.zeros(2, int))
    long = clip_item("0" * 64 + ".webp", 3, 3, (8, 8), data=project.keep(file.getvalue(), "npz"), reward=1.0)
    with project.store() as store:
        store.add_items([long])
        store.invite("ann")
        store.put([Answer("a1", long.id, "ann", 0.0)])
    with pytest.warns(UnusableClipWarning, match="with length 1"):
        StoreRatings(project, *NUMBERED)(np.zeros(1, int), np.zeros(1, int), None, np.ones(1))


def test_a_key_of_ones_own_finds_its_ratings(project):
    file = io.BytesIO()
    np.savez(file, observations=np.array([[0.5, 0.1], [0.5, 0.2]]), actions=np.array([[1.0]]))
    near = clip_item("0" * 64 + ".webp", 2, 2, (8, 8), data=project.keep(file.getvalue(), "npz"), reward=1.0)
    with project.store() as store:
        store.add_items([near])
        store.invite("ann")
        store.put([Answer("a1", near.id, "ann", 0.25)])
    ratings = StoreRatings(project, *SMOOTH, key=lambda observation, action: round(float(observation[0]), 1))
    assert ratings(np.array([[0.51, 0.9]]), np.zeros((1, 1)), None, np.ones(1)).tolist() == [[0.25]]


def test_pairs_give_no_ratings_of_steps(tmp_path):
    pairs = Project.create(tmp_path / "pairs", Question(kind="pairs"))
    with pytest.raises(InvalidValueError, match="of pairs nothing is known by step"):
        StoreRatings(pairs, *NUMBERED)


def lying(random, count, length=8):
    """Clips in whose right half the reward is 1 too high; ann says so, bob repeats the reward, cyd is noisy."""
    clips = []
    for _ in range(count):
        x = random.uniform(-1.0, 0.0, (length, 2)) + random.integers(2)
        lie = (x[:, 0] > 0).mean()
        said = np.array([1.0 - lie, 1.0, 1.0 - lie + random.normal(0.0, 0.3)])
        clips.append(RatedClip(x, np.zeros((length, 1)), 1.0, said))
    return clips


def test_clips_say_of_steps_what_raters_mean():
    random = np.random.default_rng(0)
    model = ClipModel(*SMOOTH)
    model.fit(lying(random, 200))
    x = random.uniform(-0.9, 0.9, (400, 2))
    x = x[np.abs(x[:, 0]) > 0.3]
    gaps = model(x, np.zeros((len(x), 1)))
    assert np.isfinite(gaps).mean() > 0.9
    lies = x[:, 0] > 0
    for k in (0, 2):
        known = np.isfinite(gaps[:, k])
        assert ((gaps[known, k] < -0.5) == lies[known]).mean() > 0.75  # half by chance
    assert np.nanmean(np.abs(gaps[:, 1])) < 0.1


def test_nothing_is_said_of_what_is_far_from_every_clip():
    space = gymnasium.spaces.Box(-10.0, 10.0, (2,)), SMOOTH[1]
    model = ClipModel(*space)
    model.fit([c._replace(observations=c.observations) for c in lying(np.random.default_rng(0), 60)])
    near = model(np.full((50, 2), 0.5) + np.random.default_rng(1).normal(0, 0.05, (50, 2)), np.zeros((50, 1)))
    far = model(np.random.default_rng(1).uniform(-10, -6, (50, 2)) * [1, -1], np.ones((50, 1)))
    assert np.isfinite(near[:, 0]).mean() > np.isfinite(far[:, 0]).mean() + 0.3


def test_raters_who_agree_with_the_reward_say_nothing_of_what_they_did_not_see():
    random = np.random.default_rng(0)
    clips = [
        RatedClip(random.uniform(-1, 0, (8, 2)), np.zeros((8, 1)), r, np.array([r])) for r in np.linspace(0, 1, 60)
    ]
    model = ClipModel(*SMOOTH)
    model.fit(clips)
    seen = model(random.uniform(-0.8, -0.2, (50, 2)), np.zeros((50, 1)))
    unseen = model(random.uniform(0.8, 1.0, (50, 2)), np.ones((50, 1)))
    assert np.isfinite(seen).mean() > np.isfinite(unseen).mean() + 0.3
    assert np.nanmean(np.abs(seen)) < 0.1


def test_a_rater_is_heard_after_some_clips_only():
    model = ClipModel(*SMOOTH)
    assert model(np.zeros((3, 2)), np.zeros((3, 1))).shape == (3, 0)
    model.fit([])
    clips = lying(np.random.default_rng(0), FEWEST)
    model.fit([c._replace(ratings=np.array([c.ratings[0], np.nan])) for c in clips])
    gaps = model(np.zeros((3, 2)), np.zeros((3, 1)))
    assert gaps.shape == (3, 2)
    assert np.isnan(gaps[:, 1]).all()


def test_a_run_records_each_numbered_step_once(project):
    env = gymnasium.make("uard/TrapGrid6-v0", render_mode="rgb_array")
    env = ClipRecorder(env, project, share=1.0)
    for seed in (0, 1):
        env.reset(seed=seed)
        for action in (1, 1, 3, 0, 2):
            env.step(action)
    assert env.recorded == 5
    env.close()
    with project.store() as store:
        items, _ = store.items()
    assert [item.content["key"] for item in items] == [[0, 1], [6, 1], [12, 3], [13, 0], [7, 2]]
    assert project.damaged(items) == {}
    assert {item.stratum for item in items} == {"training"}


def test_a_rare_step_does_not_wait_for_others(project, monkeypatch):
    monkeypatch.setattr(recorder, "SOON", 0.0)
    env = ClipRecorder(gymnasium.make("uard/TrapGrid6-v0", render_mode="rgb_array"), project, share=1.0)
    env.reset(seed=0)
    for action in [1, 1, 1, 1, 3, 3, 3, 3, 0, 0, 0, 0, 2, 2, 2, 2, 1, 0, 1, 0, 1, 3]:
        env.step(action)
    env.reset(seed=0)
    with project.store() as store:
        assert len(store.items()[0]) == env.recorded > 16
    env.close()


def test_what_a_run_does_often_is_asked_again(project):
    env = gymnasium.make("uard/TrapGrid6-v0", render_mode="rgb_array")
    env = ClipRecorder(env, project, share=1.0, again=2)
    with project.store() as store:
        store.invite("ann")
        for seed in range(5):
            env.reset(seed=seed)
            env.step(1)
        env.close()
        (item,), _ = store.items()
        kinds = [lease.kind for lease in store.lease("ann", 9)]
    assert item.content["key"] == [0, 1]
    assert kinds == ["repeat"]  # never two of one item at once
    assert env.recorded == 1


def test_clips_of_a_run_end_with_its_episodes(project):
    env = gymnasium.make("uard/TrapGrid6-v0", render_mode="rgb_array", max_episode_steps=12)
    env.action_space.seed(0)
    env = ClipRecorder(env, project, share=1.0, length=5)
    for _ in range(4):
        env.reset(seed=0)
        over = False
        while not over:
            *_, terminated, truncated, _ = env.step(env.action_space.sample())
            over = terminated or truncated
    env.close()
    with project.store() as store:
        items, _ = store.items()
    frames = [item.content["frames"] for item in items]
    assert len(frames) > 2
    assert max(frames) == 6
    assert all(f >= 2 for f in frames)


def test_the_filter_of_a_gymnasium_run_hears_the_store(project):
    """The wrapper keys by state and action, as the clips do."""
    env = gymnasium.make("uard/TrapGrid6-v0", render_mode="rgb_array")
    env = ClipRecorder(env, project, share=1.0)
    ratings = StoreRatings(project, env.observation_space, env.action_space, poll=0.0)
    env = ReliabilityWrapper(env, ratings=ratings)
    env.reset(seed=0)
    _, _, _, _, info = env.step(1)
    assert not info.get("rated", False)
    with project.store() as store:
        (item,), _ = store.items()
        for name in ("ann", "bob"):
            store.invite(name)
            store.put([Answer(f"{name}-1", item.id, name, -3.0)])
    env.reset(seed=0)
    reward = env.step(1)[1]
    assert reward < -0.5  # two raters say so, the environment paid -0.1
    env.close()


class Careless(gymnasium.Env):
    """Draws into one picture and one observation again and again; its pictures and numbers may go wrong."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    render_mode = "rgb_array"
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,))
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, fails=""):
        self.fails, self.time = fails, 0
        self.seen, self.drawn = np.zeros(1, np.float32), np.zeros((160, 160, 3), np.uint8)

    def reset(self, *, seed=None, options=None):
        self.time, self.seen[:] = 0, 0.0
        return self.seen, {}

    def step(self, action):
        self.time += 1
        self.seen[:] = np.nan if self.fails == "number" and self.time > 2 else self.time
        return self.seen, 1.0, False, self.time == 6, {}

    def render(self):
        if self.fails == "picture" and self.time > 2:
            return np.zeros((80, 160, 3), np.uint8)
        self.drawn[:] = 20 * self.time
        return self.drawn


def test_an_environment_may_use_its_arrays_again(project):
    env = ClipRecorder(Careless(), project, share=1.0, length=5)
    env.reset()
    for _ in range(6):
        env.step(0)
    env.close()
    with project.store() as store:
        item = store.items()[0][0]
    with np.load(project.media(item.content["data"])) as arrays:
        times = arrays["observations"].ravel()
    assert (np.diff(times) == 1).all()
    sheet = project.media(item.content["sheet"]).read_bytes()
    frames = sheets.frames_of(sheet, item.content["frames"], item.content["columns"], (160, 160))
    assert frames[:, 0, 0, 0].tolist() == (20 * times).tolist()


@pytest.mark.parametrize("fails", ["picture", "number"])
def test_a_clip_that_cannot_be_recorded_does_not_end_a_training(project, fails):
    env = ClipRecorder(Careless(fails), project, share=1.0, length=5)
    env.reset()
    with pytest.warns(UnusableClipWarning, match="a clip was not recorded"):
        seen = [env.step(0)[4] for _ in range(6)]
    assert len(seen) == 6
    env.close()


def test_what_cannot_be_recorded_is_refused_at_once(project, tmp_path):
    env = gymnasium.make("uard/TrapGrid6-v0")
    with pytest.raises(InvalidValueError, match="rgb_array"):
        ClipRecorder(env, project)
    drawn = gymnasium.make("uard/TrapGrid6-v0", render_mode="rgb_array")
    for name, value in (("share", 0.0), ("length", 0), ("most", 0), ("again", -1), ("seed", -1)):
        with pytest.raises(InvalidValueError, match=name):
            ClipRecorder(drawn, project, **{name: value})
    with pytest.raises(InvalidValueError, match="project"):
        StoreRatings(tmp_path / "nowhere", *NUMBERED)
