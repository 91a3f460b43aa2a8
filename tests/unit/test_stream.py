import io
import json
import math
import pickle
import warnings
from dataclasses import dataclass

import numpy as np
import pytest

from uard import InvalidValueError
from uard.method.abstention import Abstention
from uard.method.mitigations import LearningSignal, Mitigation, RatedReward, Raw, Screening, named, uard_paper
from uard.ratings.stream import KeysForgottenWarning, NeverRatedWarning, RewardStream

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


def test_sigma_m_lowers_what_is_learned_where_nobody_has_rated():
    stream = RewardStream()
    told(stream, [HONEST, TRAP, (1.0, (1.0, 1.0, 1.0))])
    sure, doubtful = (stream([5.0], None, [s], keys=["new"]).reward[0] for s in (0.0, 5.0))
    assert doubtful == pytest.approx(sure - 5.0)


def test_sigma_m_makes_a_reward_less_believed_by_the_rule_of_0_1():
    stream = RewardStream(named("uard-0.1"))
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
        ([1.0], {"keys": np.array(7)}, r"keys = array\(7\): must be a list of keys"),
        ([1.0], {"keys": iter("a")}, "keys = <.*: must be a list of keys"),
        ([1.0, 2.0], {"keys": "ab"}, "keys = 'ab': must be a list of keys"),
        ([1.0], {"keys": {"a": 1}}, "keys = {'a': 1}: must be a list of keys"),
        ([1.0, 2.0], {"keys": ["a", ["b"]]}, r"keys\[1\] = \['b'\]: must be hashable"),
        ([1e200], {}, r"reward\[0\] = 1e\+200: must be in \[-1e\+100, 1e\+100\]"),
        ([1.0], {"ratings": [[1e200]]}, r"ratings\[0, 0\] = 1e\+200"),
        ([1.0], {"sigma_m": [1e200]}, r"sigma_m\[0\] = 1e\+200"),
        ([1.0], {"ratings": [{17: 4.0}]}, r"ratings = \[\{17: 4.0\}\]: must be real numbers"),
        (
            [1.0],
            {"ratings": np.zeros((1, 1001))},
            r"ratings.shape = \(1, 1001\): must be \(1, K\) with K <= 1000",
        ),
    ],
)
def test_bad_input_names_field_place_value_and_what_is_allowed(reward, more, message):
    with pytest.raises(InvalidValueError, match=message):
        RewardStream()(reward, **more)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mitigation": "uard"}, "mitigation = 'uard': must be a Mitigation"),
        ({"mitigation": Raw}, "mitigation = <class .*Raw'>: must be a Mitigation, not its class or its name"),
        ({"abstention": "threshold"}, "abstention = 'threshold': must be an Abstention"),
        ({"max_keys": 0}, "max_keys = 0: must be a whole number >= 1"),
        ({"seed": -1}, "seed = -1"),
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


# --- what is kept of keys -------------------------------------------------------------------------------------------


def test_the_keys_that_came_longest_ago_are_forgotten_and_it_says_so_once():
    stream = RewardStream(RatedReward("mean", unrated_weight=1.0), max_keys=2)
    stream([0.0, 0.0], [[1.0], [2.0]], keys=["a", "b"])
    stream([0.0], None, keys=["a"])  # so "b" came longest ago
    with pytest.warns(KeysForgottenWarning, match="more than max_keys = 2 keys"):
        stream([0.0], [[3.0]], keys=["c"])
    assert stream([9.0, 9.0], None, keys=["a", "c"]).reward.tolist() == [1.0, 3.0]
    out = stream([9.0], None, keys=["b"])  # a new one, which nobody has rated; "a" makes room
    assert (out.reward, out.sigma_h) == (9.0, 0.0)
    assert stream([9.0, 9.0], None, keys=["c", "b"]).reward.tolist() == [3.0, 9.0]
    with pytest.raises(InvalidValueError, match=r"len\(keys\) = 3: must be at most max_keys = 2"):
        stream(np.zeros(3), None, keys=["x", "y", "z"])


@pytest.mark.filterwarnings("ignore::uard.ratings.stream.KeysForgottenWarning")
def test_memory_is_bounded_however_many_keys_come():
    stream = RewardStream(max_keys=100)
    for i in range(60):
        stream(np.zeros(50), np.zeros((50, 3)), keys=range(50 * i, 50 * i + 50))
    assert len(stream._slots) == 100
    assert stream._table.every().count.shape == (100,)


def test_statistics_over_many_keys_are_measured_less_often():
    measured = []

    @dataclass(frozen=True)
    class Counts(Raw):
        def fit(self, feedback, rated):
            measured.append(len(rated))

    stream = RewardStream(Counts(), refresh=1, max_keys=10_000)
    for i in range(2000):
        stream([0.0], [[0.0]], keys=[i])
    assert measured[:9] == [1, 2, 3, 4, 5, 6, 7, 8, 9]
    assert len(measured) < 8 * (1 + math.log(2000 / 8)) + 8  # one measurement after every eighth
    assert sum(measured) <= 9 * 2000


def test_an_error_remembers_nothing():
    stream = RewardStream()
    for bad in ({"sigma_m": [-1.0]}, {"keys": [["unhashable"]]}, {"ratings": [[np.inf]]}):
        with pytest.raises(InvalidValueError):
            stream([1.0], **({"ratings": [[1.0]]} | bad))
    assert (stream.rated, stream._steps, len(stream._sample.feedback().count)) == (0, 0, 0)


# --- mitigations of others ------------------------------------------------------------------------------------------


def giving(reward, **explanation):
    """Return a mitigation that gives this reward, and whose explanation has these entries."""

    class Other(Mitigation):
        def signal(self, evidence, statistics):
            return reward(evidence) if callable(reward) else reward

        def explain(self, evidence, statistics):
            return super().explain(evidence, statistics)._replace(**explanation)

    return Other()


@pytest.mark.parametrize(
    ("mitigation", "message"),
    [
        (giving(lambda e: e.reward), r"^Other\.signal\(\.\.\.\) = array\(.*\): must be a LearningSignal"),
        (
            giving(LearningSignal(0.5, 1.0)),
            r"^Other\.signal\(\.\.\.\)\.reward\.shape = \(\): must be \(2,\)",
        ),
        (
            giving(LearningSignal(np.ones((2, 2)), 1.0)),
            r"reward\.shape = \(2, 2\): must be \(2,\)",
        ),
        (giving(LearningSignal(np.array([1.0, np.nan]), 1.0)), r"^filtered reward\[1\] = nan: must be finite"),
        (giving(LearningSignal(np.array(["1", "2"]), 1.0)), r"^Other\.signal\(\.\.\.\)\.reward\.dtype = dtype"),
        (giving(LearningSignal(np.ones(2), 0.5)), "leaves steps out of learning"),
        (
            giving(LearningSignal(np.ones(2), 1.0), weight=np.ones((2, 1))),
            r"\.weight\.shape = \(2, 1\): must",
        ),
        (
            giving(LearningSignal(np.ones(2), 1.0), lam=np.nan),
            r"^Other\.explain\(\.\.\.\)\[2, 0\] = nan: must",
        ),
    ],
    ids=range(8),
)
def test_what_another_mitigation_gives_is_checked(mitigation, message):
    with pytest.raises(InvalidValueError, match=message):
        RewardStream(mitigation)([1.0, 2.0], [[1.0], [2.0]])


# --- saved as data --------------------------------------------------------------------------------------------------

KEYS = [0, -3, 2.5, math.inf, "text", b"\x00\xff", None, ("grid", (1, b"a"), True)]


def keyed_stream(steps=40, **options):
    stream, random = RewardStream(named("uard-0.1", lam=0.3), **options), np.random.default_rng(0)
    for _ in range(steps):
        stream(random.normal(size=8), random.normal(size=(8, 3)), keys=KEYS)
        stream(random.normal(size=3), np.where(random.random((3, 2)) < 0.3, np.nan, 1.0))
    return stream


def test_what_was_saved_goes_on_exactly_as_the_stream_does(tmp_path):
    stream = keyed_stream(abstention=Abstention("threshold", 0.5), capacity=20, refresh=64, max_keys=9)
    stream.save(tmp_path / "stream.npz")
    again = RewardStream.load(tmp_path / "stream.npz")
    assert (again.mitigation, again.abstention) == (stream.mitigation, stream.abstention)
    random = np.random.default_rng(1)
    for i in range(30):
        reward, ratings = random.normal(size=8), random.normal(size=(8, 4))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the tenth key makes one be forgotten, the same one in both
            keys = [*KEYS[1:], i] if i % 2 else None
            one, other = (s(reward, ratings, keys=keys) for s in (stream, again))
        for mine, theirs in zip(one, other, strict=True):
            np.testing.assert_array_equal(mine, theirs)


def test_a_mitigation_of_others_is_given_again(tmp_path):
    path = tmp_path / "stream.npz"
    RewardStream(giving(lambda e: LearningSignal(e.reward, 1.0))).save(path)
    with pytest.raises(InvalidValueError, match="mitigation = None: must be given: the file's, Other, is not one of"):
        RewardStream.load(path)
    assert RewardStream.load(path, Raw()).mitigation == Raw()


def test_a_key_that_cannot_be_written_is_named_and_the_old_file_stays_whole(tmp_path):
    path = tmp_path / "stream.npz"
    keyed_stream(2).save(path)
    before, stream = path.read_bytes(), RewardStream()
    stream([1.0], [[1.0]], keys=[frozenset({1})])
    with pytest.raises(InvalidValueError, match=r"key = frozenset\(\{1\}\): must be a number, text, bytes"):
        stream.save(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["stream.npz"]


class Executed:
    def __reduce__(self):
        return pytest.fail, ("the file was executed",)


def saved_with(path, change):
    """Save a stream, and change what is in its file: the JSON, and the arrays."""
    keyed_stream(2).save(path)
    with np.load(path) as file:
        arrays = dict(file)
    plain = json.loads(arrays.pop("plain").tobytes())
    change(plain, arrays)
    np.savez(path, plain=np.frombuffer(json.dumps(plain).encode(), np.uint8), **arrays)


@pytest.mark.parametrize(
    "change",
    [
        lambda p, a: p.update(version=2),
        lambda p, a: p.update(rated="many"),
        lambda p, a: p.update(rated=-1),
        lambda p, a: p.update(due=None),
        lambda p, a: p.update(warned=1),
        lambda p, a: p.update(max_keys=3),
        lambda p, a: p.update(ddof=7),
        lambda p, a: p.pop("capacity"),
        lambda p, a: p.pop("mitigation"),
        lambda p, a: p["mitigation"]["fields"].update(kappa="50"),
        lambda p, a: p["mitigation"]["fields"].update(more=1),
        lambda p, a: p.update(abstention={"rule": "nonsense"}),
        lambda p, a: p["keys"].append(7),
        lambda p, a: p["keys"].__setitem__(0, -3),
        lambda p, a: p["chance"].update(seen=0),
        lambda p, a: p["chance"]["random"].update(bit_generator="os.system"),
        lambda p, a: p["chance"]["random"]["state"].update(state=-1),
        lambda p, a: a.pop("table"),
        lambda p, a: a.update(table=a["table"][:, :-1]),
        lambda p, a: a.update(table=a["table"] * np.nan),
        lambda p, a: a.update(table=-a["table"]),
        lambda p, a: a.update(slots=a["slots"] * 0),
        lambda p, a: a.update(sample=np.zeros((5000, 8))),
    ],
    ids=range(23),
)
def test_a_changed_file_is_named(tmp_path, change):
    path = tmp_path / "stream.npz"
    saved_with(path, change)
    with pytest.raises(InvalidValueError, match=r"^path = '.*stream\.npz': must be a file that save wrote"):
        RewardStream.load(path)


def test_a_file_of_another_kind_is_named_and_never_executed(tmp_path):
    path = tmp_path / "stream.npz"
    keyed_stream(2).save(path)
    whole, objects = path.read_bytes(), io.BytesIO()
    np.savez(objects, plain=np.array([Executed()], object))
    array = io.BytesIO()
    np.save(array, np.zeros(3))
    for content in (
        pickle.dumps(Executed()),
        objects.getvalue(),
        array.getvalue(),
        whole[:-40],
        whole[:100],
        b"",
        b"{}",
    ):
        path.write_bytes(content)
        with pytest.raises(
            InvalidValueError, match=r"^path = '.*stream\.npz': must be a file that save wrote"
        ) as caught:
            RewardStream.load(path)
        assert "allow_pickle" not in str(caught.value)
    with pytest.raises(InvalidValueError, match="No such file"):
        RewardStream.load(tmp_path / "absent.npz")


def test_an_oracle_is_refused_where_nobody_knows_the_truth():
    with pytest.raises(InvalidValueError, match="reads no true reward"):
        RewardStream(named("true-reward"))
