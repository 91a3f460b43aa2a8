import doctest
import math
from dataclasses import dataclass

import numpy as np
import pytest

from uard import Evidence, Feedback, LearningSignal, Mitigation, ReliabilityFilter, RewardDiscounting
from uard._checks import InvalidValueError, UnknownNameError
from uard.method.mitigations import (
    NAMED,
    ByRater,
    PanelStatistics,
    RatedReward,
    Raw,
    Screening,
    named,
    panel_statistics,
    protocol,
)
from uard.method.uncertainty import Location
from uard.method.weights import FORMS
from uard.ratings.aggregate import aggregate

SIGMA_H = math.sqrt(14 / 9)  # of the ratings {-1, 2, 1}
WITH_PROXY = math.sqrt(3.25)  # of {-1, 2, 1, 4}


def evidence(count=3.0, reward=4.0, sigma_m=0.4):
    a = np.array
    feedback = Feedback(a([count]), a([2 / 3]), a([-1.0]), a([SIGMA_H]), a([4.0]), a([3.0]))
    return Evidence(a([reward]), a([sigma_m]), feedback)


STATISTICS = PanelStatistics(Location(0.5, 0.25), 2.0, -0.5)
TABLE = Feedback(
    count=np.array([0.0, 1.0, 3.0, 10.0]),
    mean=np.array([0.1, -0.2, 2 / 3, 0.5]),
    lowest=np.array([-1.0, -2.0, -1.0, 0.2]),
    sd=np.array([0.1, 0.2, SIGMA_H, 0.0]),
    proxy=np.array([1.0, 0.5, 4.0, -0.1]),
    raters=np.full(4, 3.0),
    by_rater=ByRater(
        count=np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [3.0, 3.0, 3.0], [10.0, 9.0, 8.0]]),
        mean=np.array([[0.1, 0.1, 0.2], [-0.2, 0.1, -0.5], [-1.0, 2.0, 1.0], [0.5, 0.4, 0.6]]),
        m2=np.array([[1.0, 1.0, 1.0], [0.0, 0.0, 0.0], [0.3, 0.1, 0.2], [0.8, 0.5, 0.1]]),
    ),
)
SIGMA_M = np.array([0.0, 0.4, 1.0, 2.0])
MU = np.array([1.0, -1.0, 0.0, 4.0])


def learned(mitigation, table=TABLE):
    return mitigation.signal(Evidence(table.proxy, SIGMA_M, table), mitigation.fit(table, table.count > 0))


def scored(mitigation, mu=MU, sigma_m=SIGMA_M, table=TABLE):
    return mitigation.score(mu, sigma_m, table, mitigation.fit(table, table.count > 0))


@pytest.mark.parametrize(
    ("mitigation", "count", "expected"),
    [
        (Raw(), 3.0, 4.0),
        (RatedReward(), 3.0, 2 / 3),
        (RatedReward("lowest"), 3.0, -1.0),
        (RatedReward("bound", k=1.0), 3.0, 1.5 - WITH_PROXY),
        (RatedReward("bound", k=0.0), 3.0, 1.5),
        (RatedReward("bound"), 0.0, 4.0),
        (RatedReward(unrated_weight=0.25), 0.0, -0.5 + 0.25 * 4.5),
        (named("uard-operator"), 3.0, 4 / (1 + 2 * 0.5 * (0.4 + SIGMA_H))),
        (named("uard-operator", alpha=0.0), 3.0, 4 / (1 + SIGMA_H)),
        (named("uard-operator"), 0.0, 4 / (1 + 0.4)),  # unrated: sigma_m still counts
        (named("uard-operator", proxy_is_rater=True), 3.0, 4 / (1 + 0.4 + WITH_PROXY)),
        (named("uard-operator", standardise=True), 3.0, 4 / (1 + (0.4 + SIGMA_H) / 2)),
        (named("uard-operator", kappa=1.0), 3.0, 4 / (1 + ((SIGMA_H - 0.5) / 0.25) * (0.4 + SIGMA_H))),
        (named("uard-operator", anchor="lowest"), 3.0, -1 + 5 / (1 + 0.4 + SIGMA_H)),
        (named("uard-operator", anchor="lowest", prior_count=1.0), 0.0, -0.5 + 4.5 / (1 + 0.4)),
        (named("uard-operator", anchor="lowest", prior_count=1.0, unrated_weight=0.0), 0.0, -0.5),
        (named("uard-paper"), 3.0, 4.0),
    ],
)
def test_reward_by_hand(mitigation, count, expected):
    signal = mitigation.signal(evidence(count), STATISTICS)
    assert float(signal.reward[0]) == pytest.approx(expected, abs=1e-12)
    assert signal.sample_weight == 1.0


def test_recommended_form_by_hand():
    z = (WITH_PROXY - 0.5) / 0.25
    lam = 0.2 * (1 + 20.0 * (z - 1))
    w = (3 + 0.1) / 4 / (1 + lam * 0.5 * (0.4 + WITH_PROXY) / 2)
    anchor = (3 * -1.0 - 0.5) / 4
    signal = named("uard-0.1", kappa=20.0, unrated_weight=0.1, prior_count=1.0).signal(evidence(), STATISTICS)
    assert float(signal.reward[0]) == pytest.approx(anchor + w * (4 - anchor), abs=1e-12)
    assert float(signal.reward[0]) == pytest.approx(-0.5112, abs=1e-4)


def test_recommended_form_believes_a_bonus_that_all_raters_confirm():
    feedback = Feedback(*(np.array([x]) for x in (100.0, 4.0, 4.0, 0.0, 4.0, 3.0)))
    signal = named("uard-0.1").signal(Evidence(np.array([4.0]), np.array([0.0]), feedback), STATISTICS)
    assert float(signal.reward[0]) == pytest.approx(4.0, abs=0.05)


@pytest.mark.parametrize(("limit", "count", "weight"), [(0.5, 3.0, 0.0), (0.91, 3.0, 1.0), (0.5, 0.0, 1.0)])
def test_screening_leaves_out_contested_steps(limit, count, weight):
    signal = Screening(limit).signal(evidence(count), STATISTICS)
    assert signal.sample_weight.tolist() == [weight]
    assert signal.reward.tolist() == [4.0]


@pytest.mark.parametrize(
    ("changes", "expected", "unrated"),
    [
        ({}, MU / (1 + 2 * 0.5 * (SIGMA_M + TABLE.sd)), MU / (1 + SIGMA_M)),
        (
            {"anchor": "lowest"},
            -1 + (MU + 1) / (1 + 2 * 0.5 * (SIGMA_M + TABLE.sd)),
            -1 + (MU + 1) / (1 + SIGMA_M),
        ),
        ({"lam": 0.0}, MU, MU),
        ({"acts_on": "reward"}, MU, MU),
    ],
)
def test_score_by_hand(changes, expected, unrated):
    rated = TABLE._replace(count=np.ones(4))
    np.testing.assert_allclose(scored(named("uard-paper", **changes), table=rated), expected)
    silent = TABLE._replace(count=np.zeros(4))
    np.testing.assert_allclose(scored(named("uard-paper", **changes), table=silent), unrated)


def test_the_score_of_an_only_action_is_drawn_towards_the_ensembles_lower_bound():
    rated = TABLE._replace(count=np.ones(4))
    mitigation = named("uard-paper", anchor="lowest")
    got = mitigation.score(MU, SIGMA_M, rated, STATISTICS, one_action=True)
    weight = 1 / (1 + 2 * 0.5 * (SIGMA_M + TABLE.sd))
    np.testing.assert_allclose(got, MU - SIGMA_M + weight * SIGMA_M)
    assert (got[1:] < MU[1:]).all()


def test_panel_statistics_are_over_what_was_rated():
    seen = TABLE.count > 0
    statistics = panel_statistics.fit(TABLE, seen, proxy_is_rater=False)
    assert statistics.disagreement.location == pytest.approx((0.2 + SIGMA_H) / 3)
    assert statistics.scale == pytest.approx(np.std([0.5, 4.0, -0.1]))
    assert statistics.lowest == pytest.approx(-2.8 / 3)
    with_proxy = panel_statistics.fit(TABLE, TABLE.count == 3, proxy_is_rater=True)
    assert with_proxy.disagreement == pytest.approx((WITH_PROXY, 0.0))
    before = panel_statistics.fit(TABLE, np.zeros(4, bool), proxy_is_rater=True)
    assert (before.disagreement, before.scale, before.lowest) == ((0.0, 0.0), 1.0, 0.0)


@pytest.mark.parametrize(
    ("mitigation", "proxy_is_rater"),
    [(named("uard-0.1"), True), (named("uard-paper"), False), (Screening(), True), (RatedReward(), False)],
)
def test_panel_statistics_count_the_proxy_as_the_mitigation_does(mitigation, proxy_is_rater):
    seen = TABLE.count > 0
    assert mitigation.fit(TABLE, seen) == panel_statistics.fit(TABLE, seen, proxy_is_rater)
    assert mitigation.fit(TABLE, seen) != panel_statistics.fit(TABLE, seen, not proxy_is_rater)


def scale_of(table, seen):
    return panel_statistics.fit(table, seen, proxy_is_rater=False).scale


@pytest.mark.parametrize("size", [7, 400])
def test_scale_of_equal_rewards_is_one_whatever_their_rounding(backend, size):
    seen = np.arange(size) % 7 < 6
    for reward in (-0.1, 1e6 / 3, 1e-6 / 3):
        table = Feedback(*(np.full(size, reward),) * 5, np.full(size, 3.0))
        assert float(backend.call(scale_of, table, seen)) == 1.0
        varied = table._replace(proxy=np.where(np.arange(size) % 2, 1.1, 1.0) * reward)
        assert float(backend.call(scale_of, varied, seen)) == pytest.approx(np.std(varied.proxy[seen]), rel=1e-2)


MORE = {f"both-{form}": (lambda f=form: RewardDiscounting(ReliabilityFilter(form=f), acts_on="both")) for form in FORMS}


@pytest.mark.parametrize("name", [*NAMED, *MORE])
def test_every_array_library_gives_the_same(backend, name):
    mitigation = (NAMED | MORE)[name]()

    def everything(table, mu, sigma_m):
        statistics = mitigation.fit(table, table.count > 0)
        evidence = Evidence(table.proxy, sigma_m, table)
        signal, why = mitigation.signal(evidence, statistics), mitigation.explain(evidence, statistics)
        return statistics, signal, why, mitigation.score(mu, sigma_m, table, statistics)

    backend.agrees(everything, TABLE, MU, SIGMA_M)


@pytest.mark.parametrize("name", [*NAMED, *MORE])
def test_what_was_never_rated_means_nothing(name):
    mitigation = (NAMED | MORE)[name]()
    known = TABLE.count > 0
    poisoned = TABLE.map(lambda x: np.where(known if x.ndim == 1 else known[:, None], x, np.nan))
    each = poisoned.by_rater._replace(count=TABLE.by_rater.count)
    poisoned = poisoned._replace(count=TABLE.count, by_rater=each)
    clean, dirty = (learned(mitigation, t._replace(proxy=TABLE.proxy)) for t in (TABLE, poisoned))
    np.testing.assert_array_equal(clean.reward, dirty.reward)
    np.testing.assert_array_equal(clean.sample_weight, dirty.sample_weight)
    np.testing.assert_array_equal(scored(mitigation), scored(mitigation, table=poisoned))


@pytest.mark.parametrize(
    ("name", "reads_sigma_m", "reads_sigma_h"),
    [
        ("raw", False, False),
        ("uard-paper", True, True),
        ("uard-lite", True, False),
        ("human-only", False, True),
        ("no-discount", False, False),
    ],
)
def test_ablations_read_what_they_say(name, reads_sigma_m, reads_sigma_h):
    mitigation, more = named(name), TABLE._replace(sd=TABLE.sd + 1)
    assert (scored(mitigation, sigma_m=SIGMA_M + 1) != scored(mitigation)).any() == reads_sigma_m
    assert (scored(mitigation, table=more) != scored(mitigation)).any() == reads_sigma_h


@pytest.mark.parametrize("name", NAMED)
def test_named_mitigations_keep_the_contract(name):
    mitigation = named(name)
    assert isinstance(mitigation, Mitigation)
    assert mitigation.reads_feedback is (name not in ("raw", "true-reward"))
    assert mitigation.backup == ("consistent" if name == "uard-consistent" else "greedy")
    assert mitigation == named(name)
    assert hash(mitigation) == hash(named(name))


def test_named_takes_changes():
    assert named("uard-0.1", lam=1.0, kappa=3.0) == RewardDiscounting(ReliabilityFilter(lam=1.0), kappa=3.0)
    assert named("worst-of-annotations", unrated_weight=0.5) == RatedReward("lowest", unrated_weight=0.5)
    assert named("uard-wiener").filter == ReliabilityFilter(form="wiener")


def test_a_users_own_mitigation_is_one_small_class():
    @dataclass(frozen=True)
    class Clip(Mitigation):
        limit: float = 1.0

        def signal(self, evidence, statistics):
            return LearningSignal(np.minimum(evidence.reward, self.limit), 1.0)

    clip = Clip(limit=2.0)
    assert isinstance(clip, Mitigation)
    assert (clip.reads_feedback, clip.backup) == (True, "greedy")
    assert learned(clip).reward.tolist() == [1.0, 0.5, 2.0, -0.1]
    assert scored(clip) is MU


def test_a_mitigation_without_a_signal_says_what_is_missing():
    class Nothing(Mitigation):
        pass

    with pytest.raises(TypeError, match=r"abstract method '?signal'?"):
        Nothing()  # type: ignore[abstract]


def test_a_mitigation_without_weights_explains_what_it_learns():
    why = RatedReward("lowest").explain(evidence(), STATISTICS)
    assert why.signal.reward.tolist() == [-1.0]
    assert (why.weight.tolist(), why.lam.tolist(), why.sigma_h.tolist()) == ([1.0], [0.0], [SIGMA_H])
    assert why.doubt.tolist() == pytest.approx([0.4 + SIGMA_H])
    assert RatedReward("lowest").explain(evidence(count=0.0), STATISTICS).sigma_h.tolist() == [0.0]


def test_what_a_filter_explains_is_what_it_learns():
    for name in ("uard-0.1", "uard-operator"):
        why = named(name).explain(evidence(), STATISTICS)
        assert why.signal.reward == pytest.approx(why.anchor + why.weight * (4.0 - why.anchor))
        assert named(name).signal(evidence(), STATISTICS).reward == why.signal.reward


def test_without_prior_few_ratings_count_as_all_that_will_ever_be_known():
    alone = named("uard-0.1").without_prior()
    assert alone == named("uard-0.1", prior_count=0.0)
    once, often = (alone.explain(evidence(count=n), STATISTICS) for n in (1.0, 1000.0))
    assert (once.weight, once.anchor) == (often.weight, often.anchor)
    assert RatedReward().without_prior() == RatedReward()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RatedReward("median"), "^statistic = 'median': must be one of bound, lowest, mean"),
        (lambda: RatedReward(k=-1.0), r"^k = -1\.0: must be a finite number >= 0$"),
        (lambda: RatedReward(unrated_weight=2), r"^unrated_weight = 2: must be a finite number in \[0, 1\]$"),
        (lambda: Screening(0.0), r"^limit = 0\.0: must be a finite number > 0$"),
        (lambda: RewardDiscounting(acts_on="rewards"), r"^acts_on = 'rewards': .*\(did you mean 'reward'\?\)$"),
        (lambda: RewardDiscounting(anchor="lowst"), r"^anchor = 'lowst': .*\(did you mean 'lowest'\?\)$"),
        (lambda: RewardDiscounting(backup="gredy"), r"^backup = 'gredy': .*\(did you mean 'greedy'\?\)$"),
        (lambda: RewardDiscounting(kappa=math.nan), "^kappa = nan: must be a finite number >= 0$"),
        (lambda: RewardDiscounting(unrated_weight=-0.1), r"^unrated_weight = -0\.1: .* in \[0, 1\]$"),
        (lambda: RewardDiscounting(prior_count=-1), "^prior_count = -1: must be a finite number >= 0$"),
        (lambda: named("uard-0.1", lam=-1), "^lam = -1: must be a finite number >= 0$"),
        (lambda: named("uard-paper", alpha=1.1), r"^alpha = 1\.1: must be a finite number in \[0, 1\]$"),
        (lambda: named("uard-0.1", sigma_m=0.0), "sigma_m"),
    ],
)
def test_bad_parameters_are_refused(make, message):
    with pytest.raises((InvalidValueError, TypeError), match=message):
        make()


@pytest.mark.parametrize(
    ("name", "nearest"),
    [("uard_paper", "uard-paper"), ("UARD", "uard"), ("lbc", "lcb"), ("mean-of-anotations", None)],
)
def test_an_unknown_name_suggests_the_nearest(name, nearest):
    nearest = nearest or "mean-of-annotations"
    with pytest.raises(UnknownNameError, match=rf"^mitigation = '{name}': .*\(did you mean '{nearest}'\?\)$"):
        named(name)


def test_negative_uncertainty_is_refused():
    with pytest.raises(InvalidValueError, match=r"^sigma_m\[0\] = -0\.2: must be finite and >= 0$"):
        named("uard-0.1").signal(evidence(sigma_m=-0.4), STATISTICS)


def test_docstring_examples_run():
    result = doctest.testmod(protocol)
    assert result.attempted > 0
    assert result.failed == 0


def test_a_class_says_what_is_wrong_with_it_when_it_is_defined():
    def signal(self, evidence, statistics):
        return LearningSignal(evidence.reward, 1.0)

    for name, value, message in (
        ("acts_on", "nonsense", r"Own\.acts_on = 'nonsense': must be one of both, reward, score"),
        ("backup", "gredy", r"Own\.backup = 'gredy': .*did you mean 'greedy'"),
        (
            "signal",
            lambda self, reward: reward,
            r"Own\.signal = '\(self, reward\)': must be \(self, evidence, statistics\)",
        ),
        ("fit", lambda self, ratings: (), r"Own\.fit = '\(self, ratings\)': must be \(self, feedback, rated\)"),
        (
            "score",
            lambda self, mu, sigma_m, feedback, statistics: mu,
            r"must be \(self, mu, .*\*, one_action=False\)",
        ),
    ):
        with pytest.raises(InvalidValueError, match=message):
            type("Own", (Mitigation,), {"signal": signal, name: value})
    assert type("Own", (Mitigation,), {"signal": lambda self, *anything: None})


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: named("uard-0.1", kapa=1.0),
            r"^parameters of 'uard-0.1' = \{'kapa': 1.0\}: must be its fields .*'kapa'",
        ),
        (lambda: named("raw", k=1.0), "^parameters of 'raw'"),
        (lambda: named(3), "^mitigation = 3: must be a name"),
        (lambda: RewardDiscounting(filter=0.2), "^filter = 0.2: must be of the class ReliabilityFilter"),
        (lambda: RewardDiscounting(standardise="false"), "^standardise = 'false': must be true or false"),
        (lambda: RewardDiscounting(proxy_is_rater=1), "^proxy_is_rater = 1: must be true or false"),
    ],
)
def test_parameters_of_another_kind_are_named(make, message):
    with pytest.raises(InvalidValueError, match=message):
        make()


@pytest.mark.parametrize("name", sorted(NAMED))
def test_where_a_mitigation_says_that_it_reads_no_sigma_m_it_reads_none(name):
    """Raters are quiet, silent, or loud; the loud one is not heard, so that what it rates alone counts as unrated."""
    rng, chosen = np.random.default_rng(0), named(name)
    reward = rng.normal(size=60)
    said = reward[:, None] + rng.normal(size=(60, 4)) * [0.1, 0.1, 0.1, 30.0]
    said[rng.random((60, 4)) < 0.5] = np.nan
    known = aggregate(said, reward)
    statistics = chosen.fit(known, known.count > 0)
    reads = np.asarray(chosen.reads_sigma_m(known, statistics))
    assert reads.shape == reward.shape
    low, high = (np.asarray(chosen.signal(Evidence(reward, np.full(60, x), known), statistics)[0]) for x in (0.0, 3.0))
    assert np.array_equal(np.broadcast_to(low, 60)[~reads], np.broadcast_to(high, 60)[~reads])
    if name == "uard":
        assert 0 < reads.sum() < 60
        assert (low[reads] > high[reads]).all()
