import copy
import pickle
from decimal import Decimal

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import RecordEpisodeStatistics

import uard.envs  # noqa: F401 registers the ids
from uard import InvalidValueError
from uard.adapters.gymnasium import ReliabilityWrapper, VectorReliabilityWrapper
from uard.adapters.reward_ensemble import RewardEnsemble
from uard.adapters.steps import INFO, rows_of
from uard.method.abstention import Abstention
from uard.method.mitigations import RatedReward, Raw, named

GRID = "uard/TrapGrid6-v0"


class Says(gymnasium.Env):
    """Pays 1, 2, 3 ... and says of each step what it was told to; ends after ``length`` steps."""

    observation_space = gymnasium.spaces.Discrete(100)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, ratings, length=3, rewards=None):
        self.ratings, self.length, self.rewards = ratings, length, rewards

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return 0, {}

    def step(self, action):
        self.time += 1
        reward = self.time if self.rewards is None else self.rewards[self.time - 1]
        said = self.ratings(self.time) if callable(self.ratings) else self.ratings
        info = {} if said is None else {"ratings": said}
        return self.time, float(reward), self.time >= self.length, False, info


def walk(env, steps, seed=0):
    """Take random steps, and return rewards and infos."""
    env.action_space.seed(seed)
    env.reset(seed=seed)
    out = []
    for _ in range(steps):
        _, reward, terminated, truncated, info = env.step(env.action_space.sample())
        out.append((reward, info))
        if terminated or truncated:
            env.reset()
    return out


def test_a_trap_pays_no_longer_and_info_says_why():
    env = ReliabilityWrapper(gymnasium.make(GRID, panel="main"))
    steps = walk(env, 3000)[1500:]
    traps = [(r, i) for r, i in steps if i["evaluation"].hack]
    honest = [(r, i) for r, i in steps if not i["evaluation"].hack and i["raw_reward"] < 0]
    assert len(traps) > 20
    assert max(r for r, _ in traps) < -0.5
    assert np.mean([r for r, _ in honest]) == pytest.approx(-0.1, abs=0.05)
    assert set(INFO) <= set(traps[0][1])
    assert all(i["raw_reward"] == 4.0 and i["sigma_h"] > 1 and i["weight"] < 0.1 for _, i in traps)
    assert min(i["weight"] for _, i in honest) > 0.9


def test_both_returns_of_an_episode_are_logged_whichever_wrapper_counts():
    inside = RecordEpisodeStatistics(gymnasium.make(GRID, panel="main"), stats_key="raw")
    env = RecordEpisodeStatistics(ReliabilityWrapper(inside))
    ends = [i for _, i in walk(env, 400) if "episode" in i]
    assert len(ends) == 10
    for info in ends:
        assert info["raw"]["r"] == pytest.approx(info["raw_return"])
        assert info["episode"]["r"] == pytest.approx(info["filtered_return"])
    assert any(abs(i["raw_return"] - i["filtered_return"]) > 1 for i in ends)


def test_ratings_and_sigma_from_callables_and_the_built_in_ensemble():
    env = gymnasium.make(GRID)
    asked = []

    def ratings(observations, actions, following, rewards):
        asked.append((observations.shape, actions.shape, following.shape, rewards.shape))
        return np.stack([rewards, rewards + 1.0], 1)

    ensemble = RewardEnsemble(env.observation_space, env.action_space)
    env = ReliabilityWrapper(env, named("uard-0.1"), ratings=ratings, sigma_m=ensemble)
    steps = walk(env, 1500)
    assert set(asked) == {((1,), (1,), (1,), (1,))}
    early, late = (np.mean([i["sigma_m"] for _, i in part]) for part in (steps[:20], steps[-20:]))
    assert late < 0.5 * early
    assert steps[0][1]["sigma_h"] > 0


def test_a_key_tells_state_actions_apart_where_numbers_do_not():
    env = ReliabilityWrapper(Says([0.0, 2.0]), RatedReward("mean"), key=lambda observation, action: "all the same")
    assert [r for r, _ in walk(env, 3)] == [1.0, 1.0, 1.0]
    assert env.steps.stream.known(np.array([0])).count.tolist() == [3]


def test_steps_that_nobody_rates():
    env = ReliabilityWrapper(Says(lambda time: [0.0, 2.0] if time == 2 else None), key=lambda o, a: int(o))
    weights = [i["weight"] for _, i in walk(env, 3)]
    assert weights[0] <= 0.1
    assert weights[1] > weights[0]


def test_a_rater_who_is_missing_is_no_zero():
    env = ReliabilityWrapper(Says([None, 4.0, float("nan"), 8.0]), RatedReward("mean"))
    assert [r for r, _ in walk(env, 3)] == [6.0, 6.0, 6.0]


def test_abstention_is_marked():
    env = ReliabilityWrapper(Says([-5.0, 5.0]), named("uard-0.1"), abstention=Abstention("threshold", 0.5))
    assert [i["abstained"] for _, i in walk(env, 3)] == [True, True, True]


def test_dict_observations_reach_the_callables_in_batches():
    class Two(Says):
        observation_space = gymnasium.spaces.Dict({"a": gymnasium.spaces.Box(-9, 9, (2,)), "b": FOUR})

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return {"a": np.zeros(2, np.float32), "b": 1}, {}

        def step(self, action):
            _, *rest = super().step(action)
            return {"a": np.ones(2, np.float32), "b": 2}, *rest

    seen = []

    def ratings(observations, actions, following, rewards):
        seen.append((observations["a"].shape, observations["b"].shape, following["b"].item()))
        return rewards[:, None] + np.array([[0.0, 1.0]])

    walk(ReliabilityWrapper(Two(None), ratings=ratings), 2)
    assert seen == [((1, 2), (1,), 2)] * 2


FOUR = gymnasium.spaces.Discrete(4)


def test_spec_pickling_and_copying_keep_what_was_learned():
    env = ReliabilityWrapper(gymnasium.make(GRID, panel="main"))
    walk(env, 200)
    assert env.spec.additional_wrappers[-1].name == "ReliabilityWrapper"
    for twin in (pickle.loads(pickle.dumps(env)), copy.deepcopy(env)):
        assert twin.steps.stream.rated == env.steps.stream.rated
        mine, other = (e.steps.stream.known(np.arange(5)) for e in (env, twin))
        assert all(np.array_equal(a, b) for a, b in zip(mine[:6], other[:6], strict=True))
    assert ReliabilityWrapper(gymnasium.make(GRID), Raw()).spec.make().unwrapped.problem.size == 6


@pytest.mark.parametrize("mode", list(AutoresetMode))
@pytest.mark.parametrize("count", [1, 3])
def test_vectors_filter_as_single_environments_do_in_every_autoreset_mode(mode, count):
    """One environment's rewards, in order, do not depend on the mode; reset steps are left alone."""
    lengths = [3, 4, 5][:count]
    vector = SyncVectorEnv([lambda n=n: Says([0.0, 2.0], n) for n in lengths], autoreset_mode=mode)
    env = ReliabilityWrapper(vector, RatedReward("mean"), key=lambda o, a: int(o))
    assert isinstance(env, VectorReliabilityWrapper)
    env.reset(seed=0)
    got = [[] for _ in lengths]
    ends = [[] for _ in lengths]
    for _ in range(14):
        _, rewards, terminated, _, info = env.step(np.zeros(count, int))
        for i in range(count):
            if info.get("_weight", np.zeros(count, bool))[i]:
                got[i].append((info["raw_reward"][i], rewards[i]))
            else:
                assert mode is AutoresetMode.NEXT_STEP
                assert rewards[i] == 0.0
            if info.get("_raw_return", np.zeros(count, bool))[i]:
                ends[i].append((info["raw_return"][i], info["filtered_return"][i]))
        if mode is AutoresetMode.DISABLED and terminated.any():
            env.reset(options={"reset_mask": terminated})
    for n, steps, returns in zip(lengths, got, ends, strict=True):
        assert [raw for raw, _ in steps] == [float(1 + k % n) for k in range(len(steps))]
        assert {filtered for _, filtered in steps} == {1.0}  # the mean of 0 and 2
        assert len(steps) >= 14 - 14 // n
        assert returns == [(n * (n + 1) / 2, float(n))] * (len(steps) // n)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_callables_of_a_vector_see_where_the_episode_ended_not_where_the_next_began(mode):
    seen = []

    def ratings(observations, actions, following, rewards):
        seen.extend(zip(observations.tolist(), following.tolist(), strict=True))
        return rewards[:, None] + np.array([[0.0, 1.0]])

    vector = SyncVectorEnv([lambda: Says(None, 3), lambda: Says(None, 4)], autoreset_mode=mode)
    env = ReliabilityWrapper(vector, ratings=ratings)
    env.reset(seed=0)
    for _ in range(12):
        env.step(np.zeros(2, int))
    assert set(seen) == {(0, 1), (1, 2), (2, 3), (3, 4)}


def test_ratings_missing_for_some_environments_of_a_vector_are_not_zeros():
    vector = SyncVectorEnv([lambda: Says([0.0, 2.0], 9), lambda: Says(None, 9)])
    env = ReliabilityWrapper(vector, RatedReward("mean"), key=lambda o, a: None)
    env = VectorReliabilityWrapper(vector, RatedReward("mean", unrated_weight=1.0), key=lambda o, a: int(o))
    env.reset(seed=0)
    for time in range(1, 5):
        _, _, _, _, info = env.step(np.zeros(2, int))
        assert info["raw_reward"].tolist() == [time, time]
        assert env.steps.stream.rated == time
    unkeyed = VectorReliabilityWrapper(vector, RatedReward("mean", unrated_weight=1.0), key=None)
    unkeyed.steps.key = None
    unkeyed.reset(seed=0)
    for time in range(1, 5):
        _, rewards, _, _, _ = unkeyed.step(np.zeros(2, int))
        assert rewards.tolist() == [1.0, float(time)]


def test_a_vector_of_grids_learns_from_all_of_them():
    env = ReliabilityWrapper(gymnasium.make_vec(GRID, num_envs=4, vectorization_mode="sync", panel="main"))
    env.reset(seed=0)
    env.action_space.seed(0)
    traps = []
    for step in range(1500):
        _, rewards, _, _, info = env.step(env.action_space.sample())
        if step > 750:
            traps += [rewards[i] for i in range(4) if info["_raw_reward"][i] and info["raw_reward"][i] == 4.0]
    assert len(traps) > 20
    assert max(traps) < -0.5


@pytest.mark.parametrize(
    ("ratings", "rewards", "message"),
    [
        ([1.0, float("inf")], None, "ratings of environment 0 = .*inf.*: must be a row of K finite numbers"),
        ("good", None, "ratings of environment 0 = 'good': must be a row"),
        (3.0, None, "ratings of environment 0 = 3.0"),
        ([], None, r"ratings of environment 0 = \[\]"),
        ([[1.0, 2.0]], None, r"ratings of environment 0 = \[\[1.0, 2.0\]\]"),
        ([1.0, 2.0], [float("nan")], r"reward\[0\] = nan: must be finite"),
        ([1.0, 2.0], [1e200], r"reward\[0\] = 1e\+200"),
        ([1.0, 1e200], None, r"ratings\[0, 1\] = 1e\+200"),
    ],
)
def test_training_is_never_fed_what_is_no_number(ratings, rewards, message):
    env = ReliabilityWrapper(Says(ratings, rewards=rewards))
    env.reset()
    with pytest.raises(InvalidValueError, match=message):
        env.step(0)
    vector = ReliabilityWrapper(SyncVectorEnv([lambda: Says(ratings, rewards=rewards)]))
    vector.reset()
    if ratings == "good":
        return  # Gymnasium has no array for it
    with pytest.raises(InvalidValueError, match=message.replace(r"= \[\]", "").replace("= .*inf.*", "")[:22]):
        vector.step(np.zeros(1, int))


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda n: np.zeros(n), r"ratings\(...\).shape = \(1,\): must be \(1, K\)"),
        (lambda n: np.zeros((n + 1, 2)), r"ratings\(...\).shape = \(2, 2\)"),
        (lambda n: [["a"]], r"ratings\(...\) = \[\['a'\]\]"),
    ],
)
def test_a_callable_that_answers_nonsense(answer, message):
    env = ReliabilityWrapper(Says(None), ratings=lambda o, a, f, r: answer(len(r)))
    env.reset()
    with pytest.raises(InvalidValueError, match=message):
        env.step(0)


def test_a_callable_that_raises_is_not_swallowed():
    def broken(*_):
        raise RuntimeError("the raters went home")

    env = ReliabilityWrapper(Says(None), ratings=broken)
    env.reset()
    with pytest.raises(RuntimeError, match="went home"):
        env.step(0)


# --- what is no row of numbers --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "ratings",
    [
        {17: -1.0, 42: -1.0},
        "123",
        ["1", "2"],
        {1.0, 2.0},
        (x for x in [1.0]),
        [1j],
        [Decimal(1)],
        [[1.0], [2.0, 3.0]],
        7,
    ],
    ids=lambda r: type(r).__name__,
)
def test_ratings_are_a_list_a_tuple_or_an_array_of_real_numbers(ratings):
    with pytest.raises(InvalidValueError, match=r"^ratings of environment 0 = .*: must be a row of K finite numbers"):
        rows_of({0: ratings}, 1)


@pytest.mark.parametrize(
    "ratings",
    [
        (1, 0),
        [True, False],
        np.array([1.0, None], object),
        np.float16([1, 0]),
        torch.tensor([1.0, 0.0], requires_grad=True),
        [torch.tensor(1.0, requires_grad=True), np.float32(0)],
        jnp.array([1, 0], jnp.bfloat16),
    ],
    ids=lambda r: type(r).__name__,
)
def test_ratings_of_every_library_and_precision_are_read(ratings):
    assert np.nan_to_num(rows_of({0: ratings, 1: None}, 2))[0].tolist() == [1.0, 0.0]


def test_ratings_by_name_are_refused_in_vectors_too():
    vector = ReliabilityWrapper(SyncVectorEnv([lambda: Says({"ann": 1.0})]))
    vector.reset()
    with pytest.raises(InvalidValueError, match=r"^ratings = \{'ann': .*: must be a row of K numbers for each"):
        vector.step(np.zeros(1, int))


class Pays(Says):
    """Pays what it is told to, of whatever type."""

    def __init__(self, reward):
        super().__init__([1.0, 2.0])
        self.reward = reward

    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, self.reward, *rest


@pytest.mark.parametrize("reward", [None, "3", [1.0], np.ones(2), 1j, Decimal(1), 10**400], ids=str)
def test_a_reward_that_is_no_number_is_named(reward):
    env = ReliabilityWrapper(Pays(reward))
    env.reset()
    with pytest.raises(InvalidValueError, match=r"^reward(\.shape)? = "):
        env.step(0)


@pytest.mark.parametrize(
    "reward", [3, np.float16(3), np.float32(3), torch.tensor(3.0, requires_grad=True), jnp.float32(3)]
)
def test_a_reward_of_every_library_is_a_number(reward):
    env = ReliabilityWrapper(Pays(reward), Raw())
    env.reset()
    assert env.step(0)[1] == 3.0


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"sigma_m": lambda o, a: None}, r"^sigma_m\(\.\.\.\) = None: must be real numbers"),
        ({"sigma_m": lambda o, a: 0.5}, r"^sigma_m\.shape = \(\): must be \(B,\)"),
        ({"sigma_m": lambda o, a: ["1"]}, r"^sigma_m\(\.\.\.\) = \['1'\]"),
        ({"ratings": lambda *_: None}, r"^ratings\(\.\.\.\) = None"),
        ({"key": lambda o, a: [o]}, r"^keys\[0\] = \[.*\]: must be hashable"),
    ],
)
def test_callables_that_give_nothing_to_compute_with(given, message):
    env = ReliabilityWrapper(Says(None), **given)
    env.reset()
    with pytest.raises(InvalidValueError, match=message):
        env.step(0)


def test_a_stop_iteration_ends_nobodys_loop():
    env = ReliabilityWrapper(Says(None), ratings=lambda *_: next(iter([])))
    env.reset()
    with pytest.raises(RuntimeError, match=r"^ratings\(\.\.\.\) raised StopIteration"):
        env.step(0)


def test_a_step_before_the_first_reset_says_so():
    for env, action in ((Says(None), 0), (SyncVectorEnv([lambda: Says(None)]), np.zeros(1, int))):
        with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
            ReliabilityWrapper(env).step(action)


# --- every space ----------------------------------------------------------------------------------------------------

S = gymnasium.spaces
SPACES = {
    "tuple": S.Tuple((S.Discrete(2), S.Box(-1, 1, (2,)))),
    "dict": S.Dict({"a": S.Discrete(2), "b": S.MultiBinary(3)}),
    "sequence": S.Sequence(S.Discrete(3)),
    "graph": S.Graph(S.Box(-1, 1, (2,)), S.Discrete(2)),
    "one of": S.OneOf((S.Discrete(3), S.Box(-1, 1, (2,)))),
    "text": S.Text(4),
}


class Samples(Says):
    """Observations and actions of one space."""

    def __init__(self, space):
        super().__init__([1.0, 2.0], 9)
        self.observation_space = self.action_space = space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(0)
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), *super().step(action)[1:]


@pytest.mark.parametrize("name", SPACES)
@pytest.mark.parametrize("count", [None, 2])
def test_every_space_is_whole_in_callables_and_keys(name, count):
    """One observation and one action, as they are, are what a key is made of."""
    keyed, sizes = [], []

    def key(observation, action):
        keyed.append((observation, action))
        return len(keyed)

    def sigma_m(observations, actions):
        parts = observations
        while isinstance(parts, dict | tuple):
            parts = next(iter(parts.values())) if isinstance(parts, dict) else parts[0]
        sizes.append(len(parts))
        return np.zeros(len(parts))

    make = lambda: Samples(SPACES[name])  # noqa: E731
    env = ReliabilityWrapper(make() if count is None else SyncVectorEnv([make] * count), key=key, sigma_m=sigma_m)
    before, _ = env.reset(seed=0)
    space = SPACES[name]
    action = env.action_space.sample()
    env.step(action)
    singles = [(before, action)]
    if count is not None:
        singles = zip(*(gymnasium.vector.utils.iterate(env.env.action_space, x) for x in (before, action)), strict=True)
    assert sizes == [count or 1]
    for (observation, acted), (was, did) in zip(keyed, singles, strict=True):
        assert repr(acted) == repr(did) or np.array_equal(S.flatten(space, acted), S.flatten(space, did))
        assert repr(observation) == repr(was) or np.array_equal(S.flatten(space, observation), S.flatten(space, was))


def test_two_actions_that_differ_in_their_second_part_are_two():
    space = S.Tuple((S.Discrete(2), S.Discrete(2)))
    env = ReliabilityWrapper(Samples(space), key=lambda observation, action: tuple(map(int, action)))
    env.reset()
    env.step((1, 0))
    env.step((1, 1))
    assert list(env.steps.stream._slots) == [(1, 0), (1, 1)]


def test_an_action_given_as_a_tuple_for_a_box_is_one_array():
    class Boxed(Says):
        action_space = S.Box(-1, 1, (2,))

    seen = []
    env = ReliabilityWrapper(Boxed(None), sigma_m=lambda o, a: seen.append(a.shape) or np.zeros(1))
    env.reset()
    env.step((0.1, 0.2))
    assert seen == [(1, 2)]


def test_an_environment_that_writes_into_its_observation_does_not_change_the_last_one():
    class InPlace(Says):
        observation_space = S.Box(0, 99, (1,))

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.seen = np.zeros(1)
            return self.seen, {}

        def step(self, action):
            self.seen += 1
            return self.seen, *super().step(action)[1:]

    steps = []
    env = ReliabilityWrapper(InPlace(None), ratings=lambda o, a, n, r: steps.append((o.item(), n.item())) or r[:, None])
    env.reset()
    for _ in range(3):
        env.step(0)
    assert steps == [(0, 1), (1, 2), (2, 3)]


# --- filtering twice ------------------------------------------------------------------------------------------------


def test_a_wrapper_around_a_wrapper_is_refused():
    def filtered():
        return RecordEpisodeStatistics(ReliabilityWrapper(gymnasium.make(GRID, panel="main")))

    for twice in (
        lambda: ReliabilityWrapper(filtered()),
        lambda: ReliabilityWrapper(SyncVectorEnv([filtered])),
        lambda: ReliabilityWrapper(ReliabilityWrapper(SyncVectorEnv([lambda: Says(None)]))),
    ):
        with pytest.raises(InvalidValueError, match=r"^env = '.*ReliabilityWrapper': .*filtered twice"):
            twice()


def test_what_was_filtered_out_of_sight_is_refused_at_the_first_step():
    class Hides(gymnasium.Env):  # no wrapper, as an environment in another process is none
        def __init__(self):
            self.inner = ReliabilityWrapper(Says([1.0, 2.0]))
            self.observation_space, self.action_space = self.inner.observation_space, self.inner.action_space

        def reset(self, *, seed=None, options=None):
            return self.inner.reset(seed=seed)

        def step(self, action):
            return self.inner.step(action)

    for env, action in ((Hides(), 0), (SyncVectorEnv([Hides]), np.zeros(1, int))):
        outer = ReliabilityWrapper(env)
        outer.reset()
        with pytest.raises(InvalidValueError, match=r"^info\[\"raw_reward\"\] = .*filtered twice"):
            outer.step(action)


@pytest.mark.parametrize("given", [{"mitigation": Raw}, {"mitigation": "uard"}, {"abstention": 0.5}])
def test_arguments_of_another_kind_are_named(given):
    with pytest.raises(InvalidValueError, match=rf"^{next(iter(given))} = "):
        ReliabilityWrapper(Says(None), **given)


def test_the_ensemble_learns_nothing_from_what_is_no_number():
    """One NaN would stay in its sums for ever."""
    box, two = S.Box(-1, 1, (2,)), S.Discrete(2)
    ensemble = RewardEnsemble(box, two)
    state, action = np.zeros((1, 2)), np.zeros(1, int)
    before = ensemble(state, action)
    for bad in (
        (np.full((1, 2), np.nan), action, np.ones(1)),
        (state, action, np.array([np.nan])),
        (state, action, np.array([1e200])),
        (state, np.array([-1]), np.ones(1)),
        (state, np.array([2]), np.ones(1)),
        (state, np.array([0.5]), np.ones(1)),
    ):
        with pytest.raises(InvalidValueError):
            ensemble.update(*bad)
    assert ensemble(state, action) == before
    for space in (S.Sequence(two), S.Graph(box, two)):
        with pytest.raises(InvalidValueError, match=r"^action_space = .*: must be one whose samples"):
            RewardEnsemble(box, space)
    with pytest.raises(InvalidValueError, match=r"^seed = -1"):
        RewardEnsemble(box, two, seed=-1)


def test_rewards_in_normalised_units_are_refused():
    env = gymnasium.wrappers.NormalizeReward(gymnasium.make("uard/TrapGrid6-v0", panel="main"))
    with pytest.raises(InvalidValueError, match=r"env = 'NormalizeReward'.*normalised units"):
        ReliabilityWrapper(gymnasium.wrappers.TimeLimit(env, 5))
