import pickle
import warnings

import numpy as np
import pytest

from uard import InvalidValueError
from uard.method.abstention import Abstention
from uard.method.mitigations import RatedReward, Raw, Screening, named, uard_paper
from uard.ratings.stream import NeverRatedWarning, RewardStream

TRAP = 4.0, (-1.0, 2.0, 1.0)
HONEST = -0.1, (-0.1, -0.1, -0.1)


def told(stream, steps, keyed=True):
    """Tell a stream of some (reward, ratings) pairs, and return the last batch filtered."""
    reward = np.array([r for r, _ in steps])
    ratings = np.array([k for _, k in steps])
    return stream(reward, ratings, keys=list(range(len(steps))) if keyed else None)


def test_the_operator_as_printed_by_hand():
    # sigma_h of {-1, 2, 1} is sqrt(14/9) = 1.2472; w = 1 / (1 + 2 * 0.5 * 1.2472) = 0.44500
    stream = RewardStream(uard_paper(acts_on="reward"))
    out = told(stream, [TRAP])
    assert out.sigma_h == pytest.approx([1.247219], abs=1e-6)
    assert out.weight == pytest.approx([0.444994], abs=1e-6)
    assert out.reward == pytest.approx([4 * 0.444994], abs=1e-5)
    assert out.raw == pytest.approx([4.0])
    assert out.lam == pytest.approx([2.0])


@pytest.mark.parametrize("keyed", [True, False])
def test_a_trap_is_not_worth_visiting_and_an_honest_step_keeps_its_reward(keyed):
    stream = RewardStream()
    for _ in range(30):
        out = told(stream, [TRAP] + [HONEST] * 9, keyed)
    assert out.reward[0] < -0.5
    assert out.reward[1:] == pytest.approx([-0.1] * 9, abs=0.01)
    assert out.weight[0] < 0.1 < 0.9 < out.weight[1:].min()


def test_what_was_said_of_a_key_is_remembered_when_nobody_rates_it():
    stream = RewardStream()
    for _ in range(30):
        told(stream, [TRAP] + [HONEST] * 9)
    later = stream([4.0, -0.1], None, keys=[0, 1])
    assert not later.rated.any()
    assert later.reward[0] < -0.5
    assert later.sigma_h[0] > 1.0


def test_running_means_per_key():
    stream = RewardStream(RatedReward("mean"))
    stream([1.0], [[1.0, 3.0]], keys=["a"])
    out = stream([1.0], [[5.0, 7.0]], keys=["a"])
    assert out.reward == pytest.approx([4.0])  # mean of 2 and 6


def test_a_missing_rating_is_left_out_of_mean_lowest_and_deviation():
    mean = RewardStream(RatedReward("mean"))([0.0], [[1.0, np.nan, 3.0]])
    lowest = RewardStream(RatedReward("lowest"))([0.0], [[1.0, np.nan, 3.0]])
    assert mean.reward == pytest.approx([2.0])
    assert lowest.reward == pytest.approx([1.0])
    assert mean.sigma_h == pytest.approx([1.0])


def test_a_row_without_ratings_is_not_rated_and_its_zeros_are_not_read():
    out = RewardStream(RatedReward("mean"))([7.0, 7.0], [[np.nan, np.nan], [1.0, 3.0]])
    assert out.rated.tolist() == [False, True]
    assert out.reward == pytest.approx([7.0, 2.0])


def test_an_unrated_reward_is_believed_in_part():
    out = RewardStream()([3.0], None)
    assert 0 < out.weight[0] <= 0.1
    assert out.reward == pytest.approx(3.0 * out.weight)


def test_a_single_rater_is_checked_against_the_proxy():
    stream = RewardStream()
    for _ in range(30):
        out = told(stream, [(4.0, (-1.0,))] + [(-0.1, (-0.1,))] * 9)
    assert out.reward[0] < -0.5


def test_sigma_m_makes_a_reward_less_believed():
    stream = RewardStream()
    told(stream, [HONEST, TRAP, (1.0, (1.0, 1.0, 1.0))])
    sure, doubtful = (stream.filter([1.0], stream.known(np.array([2])), [s], keyed=True).weight[0] for s in (0.0, 5.0))
    assert doubtful < 0.9 * sure


def test_the_sample_of_steps_without_keys_is_uniform_and_bounded():
    stream = RewardStream(capacity=50, seed=3)
    for i in range(100):
        stream(np.full(10, float(i)), np.full((10, 2), float(i)))
    kept = stream._sample.feedback().proxy
    assert stream.rated == 1000
    assert len(kept) == 50
    # Uniform over 0..99: mean 49.5, deviation of the mean of 50 is 4.1.
    assert abs(kept.mean() - 49.5) < 4 * 4.1


def test_the_same_stream_twice_and_through_pickle():
    random = np.random.default_rng(0)
    steps = [(random.normal(size=4), random.normal(size=(4, 3))) for _ in range(40)]
    one, two = RewardStream(capacity=20), RewardStream(capacity=20)
    for reward, ratings in steps[:20]:
        one(reward, ratings)
        two(reward, ratings)
    two = pickle.loads(pickle.dumps(two))
    for reward, ratings in steps[20:]:
        assert np.array_equal(one(reward, ratings).reward, two(reward, ratings).reward)


def test_filter_remembers_nothing():
    stream = RewardStream()
    told(stream, [TRAP, HONEST])
    before = pickle.dumps(stream)
    visit = pickle.loads(before).observe([1.0], [[1.0, 2.0]]).visit
    stream.filter([1.0], visit, keyed=False)
    assert pickle.loads(pickle.dumps(stream)).rated == pickle.loads(before).rated


def test_raw_changes_nothing():
    out = told(RewardStream(Raw()), [TRAP, HONEST])
    assert np.array_equal(out.reward, out.raw)
    assert out.weight.tolist() == [1.0, 1.0]


def test_abstention_marks_what_the_rule_would_not_act_on():
    stream = RewardStream(abstention=Abstention("threshold", 0.5))
    assert told(stream, [TRAP, HONEST]).abstained.tolist() == [True, False]


def test_it_says_once_that_nobody_ever_rated():
    stream = RewardStream()
    stream(np.zeros(999))
    with pytest.warns(NeverRatedWarning, match="1000 steps and no rating"):
        stream(np.zeros(1))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(20):
            stream(np.zeros(100))
        for _ in range(20):
            RewardStream(Raw())(np.zeros(100))


@pytest.mark.parametrize(
    ("reward", "more", "message"),
    [
        ([1.0, np.nan], {}, r"reward\[1\] = nan: must be finite"),
        ([[1.0]], {}, r"reward.shape = \(1, 1\): must be \(B,\)"),
        (["a"], {}, r"reward = \['a'\]: must be real numbers"),
        ([1.0], {"ratings": [1.0, 2.0]}, r"ratings.shape = \(2,\): must be \(1, K\)"),
        ([1.0, 2.0], {"ratings": [[1.0, 2.0]]}, r"ratings.shape = \(1, 2\): must be \(2, K\)"),
        ([1.0], {"ratings": [[]]}, r"ratings.shape = \(1, 0\)"),
        ([1.0], {"ratings": [[1.0, np.inf]]}, r"ratings\[0, 1\] = inf: must be finite"),
        ([1.0], {"ratings": [[1.0, None]]}, r"ratings = .*None.*: must be real numbers"),
        ([1.0], {"sigma_m": [-1.0]}, r"sigma_m\[0\] = -1.0: must be finite and >= 0"),
        ([1.0], {"sigma_m": [np.nan]}, r"sigma_m\[0\] = nan"),
        ([1.0], {"sigma_m": [1.0, 1.0]}, r"len\(sigma_m\) = 2: must be 1, one per reward"),
        ([1.0, 2.0], {"keys": ["a"]}, r"len\(keys\) = 1: must be 2, one per reward"),
    ],
)
def test_bad_input_names_field_place_value_and_what_is_allowed(reward, more, message):
    with pytest.raises(InvalidValueError, match=message):
        RewardStream()(reward, **more)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mitigation": "uard"}, "mitigation = 'uard': must be a Mitigation"),
        ({"mitigation": named("uard-paper")}, "mitigation.acts_on = 'score': must be 'reward'"),
        ({"ddof": 2}, "ddof = 2"),
        ({"capacity": 1}, "capacity = 1: must be a whole number >= 2"),
        ({"refresh": 0}, "refresh = 0"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(InvalidValueError, match=message):
        RewardStream(**options)


def test_a_mitigation_that_leaves_steps_out_is_refused_where_it_would():
    stream = RewardStream(Screening())
    stream.observe([4.0, -0.1], [TRAP[1], HONEST[1]], keys=[0, 1])
    with pytest.raises(InvalidValueError, match="leaves steps out of learning"):
        told(stream, [TRAP, HONEST])


def test_a_printed_filter_with_another_lambda():
    out = told(RewardStream(uard_paper(lam=0.0, acts_on="reward")), [TRAP])
    assert out.reward == pytest.approx([4.0])
