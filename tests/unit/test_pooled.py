"""The pooled rule: numbers derived by hand, the reference, three array libraries, and what must hold of any panel."""

import time
import tracemalloc

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from uard import Evidence, Feedback, InvalidValueError
from uard.method import pooled, rater_statistics
from uard.method.arrays import smallest
from uard.method.feedback import ByRater
from uard.method.mitigations import ExcessDisagreement, PooledDiscounting, Witness, named
from uard.ratings.aggregate import aggregate

from . import pooled_reference as reference

RULES = {
    "uard": PooledDiscounting(),
    "uard, 2 vetoes": PooledDiscounting(vetoes=2),
    "excess": ExcessDisagreement(),
    "witness": Witness(),
}
every_rule = pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
LIBRARIES = {"numpy": np.asarray, "torch": torch.tensor, "jax": jnp.asarray}


def panel_data(seed: int, rows: int = 60, raters: int | None = None) -> tuple[np.ndarray, ByRater]:
    """Ratings of K raters of several qualities about rewards of which a fifth lies."""
    random = np.random.default_rng(seed)
    k = int(random.integers(1, 7)) if raters is None else raters
    reward = 3.0 * random.normal(size=rows)
    count = random.integers(0, 5, (rows, k)).astype(float)
    meant = reward[:, None] - 4.0 * (random.random((rows, 1)) < 0.2)
    mean = meant + random.normal(size=(rows, k)) * random.uniform(0.1, 2.0, k)
    square = np.where(count > 1, random.chisquare(np.maximum(count - 1, 1e-9)), 0.0)
    return reward, ByRater(count, np.where(count > 0, mean, 0.0), square)


def feedback_of(reward, each: ByRater, convert=np.asarray) -> Feedback:
    raters = (each.count > 0).sum(-1) * 1.0
    rated = np.minimum(raters, 1.0)
    fields = (rated, each.mean.mean(-1), each.mean.min(-1), 0.0 * reward, reward, raters)
    return Feedback(*map(convert, fields), ByRater._make(map(convert, each)))


def explained(reward, each: ByRater, mitigation=None, convert=np.asarray):
    mitigation = mitigation or PooledDiscounting()
    feedback = feedback_of(reward, each, convert)
    statistics = mitigation.fit(feedback, feedback.count > 0)
    return mitigation.explain(Evidence(convert(reward), convert(0.0 * reward), feedback), statistics), statistics


def test_variance_between_by_hand():
    """Q = 2 of z = 2, 4 with unit errors; (Q - 1) / (2 - 2 / 2) = 1; equal raters differ by nothing."""
    here = np.ones((2, 2), bool)
    assert pooled.variance_between(np.array([[2.0, 4.0], [3.0, 3.0]]), here, np.ones((2, 2))).tolist() == [1.0, 0.0]


def test_bayes_factor_by_hand():
    """One rater, z = 2, v = 1, r = 0, span 3: apart -1/2 log(1 + 9), centred -1/2 4."""
    one = pooled.pool(np.zeros(1), np.array([[2.0]]), np.ones((1, 1), bool), np.ones((1, 1)), 3.0)
    assert one.log_odds[0] == pytest.approx(2.0 - 0.5 * np.log(10.0))
    assert (one.centre[0], one.tau[0], one.error[0]) == (2.0, 0.0, 1.0)


def test_noise_is_pooled_with_three_degrees_of_freedom():
    """Two raters, two ratings each, squares 2 and 0: pooled 2.01 / 3; (2 + 3 p) / 4 and 3 p / 4."""
    count, square = np.full((1, 2), 2.0), np.array([[2.0, 0.0]])
    p = 2.01 / 3
    assert rater_statistics.answer_variance(count, square, 1.0) == pytest.approx([(2 + 3 * p) / 4, 3 * p / 4])


def test_bias_is_not_moved_by_lies():
    """A rater half a unit too kind everywhere, but 5 below where the reward lies, one step in ten."""
    gap = np.full((100, 1), 0.5)
    gap[::10] = -5.0
    bias = rater_statistics.robust_bias(np.ones((100, 1)), gap, np.array([0.01]), 1.0)
    assert bias == pytest.approx([0.5 * 100 / 104])


def test_rounding_is_no_scale():
    """Running means of equal rewards differ in their last bits; a scale of 1e-9 would call every rater exact."""
    reward = np.full(40, -0.1, np.float32)
    reward[::2] = np.nextafter(reward[::2], np.float32(0.0))
    each = ByRater(np.ones((40, 1), np.float32), reward[:, None] + 1.0, np.zeros((40, 1), np.float32))
    assert rater_statistics.fit(reward, each, np.ones(40, bool)).scale == 1.0


@pytest.mark.parametrize("seed", range(12))
def test_the_reference_gives_the_same(seed):
    reward, each = panel_data(seed)
    some = each.count.sum(1) > 0
    panel = reference.fit(each.count[some], each.mean[some], each.m2[some], reward[some])
    learned, weight, anchor, tau = reference.reward(*each, reward, panel)
    why, statistics = explained(reward, each)
    pairs = [(panel["s2"], "noise"), (panel["bias"], "bias"), (panel["tau2"], "idiosyncrasy"), (panel["span"], "span")]
    for expected, name in pairs:
        np.testing.assert_allclose(getattr(statistics.raters, name), expected, rtol=1e-5, atol=1e-6, err_msg=name)
    assert (statistics.raters.heard > 0).tolist() == panel["heard"].tolist()
    np.testing.assert_allclose(statistics.usual, panel["usual"], atol=1e-6)
    np.testing.assert_allclose(why.signal.reward, learned, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(why.weight, weight, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(why.anchor[some], anchor[some], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(why.sigma_h[some], tau[some], rtol=1e-5, atol=1e-5)


@every_rule
@pytest.mark.parametrize("convert", [torch.tensor, jnp.asarray], ids=["torch", "jax"])
def test_libraries_agree(rule, convert):
    reward, each = panel_data(3, rows=40, raters=7)
    expected, _ = explained(reward, each, rule)
    found, _ = explained(reward, each, rule, convert)
    np.testing.assert_allclose(np.asarray(found.signal.reward), expected.signal.reward, rtol=1e-3, atol=1e-4)


def awkward(name: str) -> tuple[np.ndarray, ByRater]:
    """Panels that break rules which divide by what is not there."""
    reward, each = panel_data(4, rows=24, raters=64 if name == "64 raters" else 3)
    count, mean, m2 = (x.copy() for x in each)
    if name == "silent rows":
        count[::2] = 0.0
    elif name == "nobody answers":
        count[:] = 0.0
    elif name == "one rater":
        count, mean, m2 = count[:, :1], mean[:, :1], m2[:, :1]
    elif name == "only the excluded answer here":
        count[:], mean[:, 2], m2[:, 2] = 4.0, 5.0 * (-1.0) ** np.arange(24), 400.0
        count[:12, :2] = 0.0
    elif name == "constant raters":
        count[:], mean[:], m2[:] = 5.0, 2.0, 0.0
    elif name == "nothing varies":
        reward, count[:], mean[:], m2[:] = 0.0 * reward, 5.0, 0.0, 0.0
    elif name == "far apart":
        mean = 1e3 * mean
    elif name == "single state-action":
        reward, count, mean, m2 = reward[:1], count[:1], mean[:1], m2[:1]
    return reward, ByRater(count, np.where(count > 0, mean, 0.0), np.where(count > 0, m2, 0.0))


AWKWARD = ("silent rows", "nobody answers", "one rater", "only the excluded answer here", "constant raters")
AWKWARD += ("nothing varies", "far apart", "single state-action", "64 raters")


@every_rule
@pytest.mark.parametrize("library", ["numpy", "torch", "jax"])
def test_awkward_panels_give_numbers_and_gradients(rule, library):
    """By every rating and every reward, through the panel's statistics, too."""

    def learned(reward, mean, feedback, count):
        each = feedback.by_rater._replace(mean=mean, count=count)
        known = feedback._replace(proxy=reward, by_rater=each)
        why = rule.explain(Evidence(reward, 0.0 * reward, known), rule.fit(known, known.count > 0))
        return why.signal.reward.sum(), (why.signal.reward, *why[1:])

    by_jax = jax.jit(jax.grad(learned, argnums=(0, 1), has_aux=True))
    for name in AWKWARD:
        reward, each = awkward(name)
        if library == "jax" and each.count.shape != (24, 3):
            continue  # compiled once
        feedback = feedback_of(reward, each, LIBRARIES[library])
        given = [feedback.proxy, feedback.by_rater.mean]
        if library == "jax":
            slopes, found = by_jax(*given, feedback, feedback.by_rater.count)
        else:
            given = [x.requires_grad_() for x in given] if library == "torch" else given
            total, found = learned(*given, feedback, feedback.by_rater.count)
            slopes = torch.autograd.grad(total, given) if library == "torch" else []
        found, slopes = ([np.asarray(x.detach() if library == "torch" else x) for x in y] for y in (found, slopes))
        assert all(np.isfinite(x).all() for x in (*found, *slopes)), name
        assert ((found[3] >= 0) & (found[3] <= 1)).all(), name


@every_rule
def test_what_only_excluded_raters_have_said_is_met_like_what_nobody_has(rule):
    reward, each = awkward("only the excluded answer here")
    why, statistics = explained(reward, each, rule)
    assert getattr(statistics, "raters", statistics).heard.tolist() == [1.0, 1.0, 0.0]
    feedback = feedback_of(reward, each)
    nobody = feedback._replace(by_rater=each._replace(count=0.0 * each.count))
    unrated = rule.signal(Evidence(reward, 0.0 * reward, nobody), statistics).reward
    assert why.signal.reward[:12].tolist() == unrated[:12].tolist()


some_panels = st.tuples(st.integers(0, 10_000), st.integers(1, 64))


@every_rule
@settings(max_examples=12)
@given(some_panels, st.randoms(use_true_random=False))
def test_order_of_raters_is_irrelevant(rule, panel, random):
    reward, each = panel_data(panel[0], rows=30, raters=panel[1])
    order = random.sample(range(panel[1]), panel[1])
    shuffled = ByRater._make(x[:, order] for x in each)
    np.testing.assert_allclose(
        explained(reward, shuffled, rule)[0].signal.reward,
        explained(reward, each, rule)[0].signal.reward,
        rtol=1e-6,
        atol=1e-6,
    )


@every_rule
@settings(max_examples=12)
@given(some_panels)
def test_a_rater_who_answers_nothing_changes_nothing(rule, panel):
    reward, each = panel_data(panel[0], rows=30, raters=panel[1])
    silent = ByRater._make(np.concatenate([x, 0.0 * x[:, :1]], axis=1) for x in each)
    np.testing.assert_allclose(
        explained(reward, silent, rule)[0].signal.reward,
        explained(reward, each, rule)[0].signal.reward,
        rtol=1e-6,
        atol=1e-6,
    )


@every_rule
@settings(max_examples=12)
@given(some_panels, st.floats(-100, 100), st.floats(0.01, 100))
def test_all_rewards_may_be_shifted_and_scaled(rule, panel, shift, factor):
    reward, each = panel_data(panel[0], rows=30, raters=panel[1])
    moved = ByRater(each.count, np.where(each.count > 0, factor * each.mean + shift, 0.0), factor**2 * each.m2)
    found, _ = explained(factor * reward + shift, moved, rule)
    expected, _ = explained(reward, each, rule)
    np.testing.assert_allclose(found.weight, expected.weight, rtol=1e-5, atol=1e-7)
    scale = factor * (1.0 + np.abs(reward).max()) + abs(shift)
    np.testing.assert_allclose(found.signal.reward, factor * expected.signal.reward + shift, atol=1e-6 * scale)


def odds_at_zero(said, variance) -> float:
    """Logarithm of the odds of *apart* where the reward is 0, with a span of 20."""
    said, variance = np.array([said]), np.array([variance])
    return float(pooled.pool(np.zeros(1), said, np.ones(said.shape, bool), variance, 20.0).log_odds[0])


said_of_it = st.lists(st.floats(-10, 10), min_size=1, max_size=12)
variances = st.floats(0.01, 10)


@settings(max_examples=300)
@given(said_of_it, variances, st.integers(1, 20))
def test_equally_exact_raters_who_say_the_reward_never_lower_the_weight(said, variance, more):
    """Whatever the others say; docs/method.md proves it."""
    before, after = (odds_at_zero(x, [variance] * len(x)) for x in (said, [*said, *[0.0] * more]))
    assert after <= before + 1e-9


@settings(max_examples=300)
@given(st.lists(st.tuples(st.floats(-1, 1), variances), min_size=1, max_size=12), variances, st.floats(0.05, 1))
def test_where_raters_differ_by_no_more_than_their_errors_a_rating_that_says_the_reward_never_lowers_it(
    panel, variance, shrunk
):
    """By a new rater, or by one of these, whose error it shrinks; tau is 0 before and after."""
    said, errors = (list(x) for x in zip(*panel, strict=True))
    for longer, better in (([*said, 0.0], [*errors, variance]), ([0.0, *said[1:]], [shrunk * errors[0], *errors[1:]])):
        before = (said, errors) if len(longer) > len(said) else (longer, errors)
        taus = [
            pooled.variance_between(np.array([x]), np.ones((1, len(x)), bool), np.array([v]))
            for x, v in (before, (longer, better))
        ]
        if not np.any(taus):
            assert odds_at_zero(longer, better) <= odds_at_zero(*before) + 1e-9


def test_an_inexact_rater_who_says_the_reward_may_lower_the_weight():
    """Nine standard errors tell two exact raters from a third; a fourth, who knows nothing, hides it: tau is 0 then."""
    said, variance = [0.545, 0.585, -1.025], [0.087, 0.046, 0.925]
    before, after = odds_at_zero(said, variance), odds_at_zero([*said, 0.0], [*variance, 4.938])
    assert 0.0 < after - before < 0.2


@pytest.mark.parametrize("raters", [2, 3, 5, 8, 12, 30])
def test_few_panels_lose_weight_by_a_rating_that_says_the_reward(raters):
    """By a new rater or by a better known one, tau estimated anew."""
    random, rows = np.random.default_rng(raters), 20_000
    said = np.exp(random.uniform(-2, 2, (rows, 1))) * random.normal(size=(rows, raters))
    said[:, 0], variance = 0.0, np.exp(random.uniform(-4, 2, (rows, raters)))
    better = np.concatenate([variance[:, :1] * random.uniform(0.05, 1.0, (rows, 1)), variance[:, 1:]], axis=1)

    def odds(first: int, variance: np.ndarray) -> np.ndarray:
        here = np.ones(variance[:, first:].shape, bool)
        return pooled.pool(np.zeros(rows), said[:, first:], here, variance[:, first:], 20.0).log_odds

    before = odds(0, variance)
    for grown in (before - odds(1, variance), odds(0, better) - before):
        assert np.mean(grown > 1e-9) < 0.02


def test_a_lie_that_all_see_is_doubted_as_soon_as_the_page_says():
    """All say r - g: w < 1/2 if g^2 > [log(1 + D^2 P) + 2 log 4] / P, P being the sum of 1 / v_k."""
    variance = np.array([0.5, 1.0, 2.0])
    precision = (1 / variance).sum()
    gap = np.sqrt((np.log(1 + 20.0**2 * precision) + 2 * np.log(4.0)) / precision)
    assert odds_at_zero([-gap] * 3, variance) == pytest.approx(np.log(4.0))


def test_a_million_state_actions():
    """Of five raters: statistics are of 4096 of them, the rest takes seconds and a dozen tables of 40 MB."""
    rows, raters = 1_000_000, 5
    random = np.random.default_rng(0)
    reward, two = random.normal(size=rows), np.full((rows, raters), 2.0)
    each = ByRater(two, reward[:, None] + random.normal(size=two.shape), 0.5 * two)
    tracemalloc.start()
    begin = time.process_time()
    why, _ = explained(reward, each)
    took, peak = time.process_time() - begin, tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert np.isfinite(why.signal.reward).all()
    assert took < 60
    assert peak < 15 * two.nbytes


def test_one_dissenter_of_five_decides_only_where_none_may_be_overruled():
    """All say 10 of the goal, as the reward does, and one says -3; seven more say 10 where nobody dissents."""
    reward = np.array([10.0] + 40 * [-0.1])
    ratings = np.tile(reward[:, None], (1, 5)) + 0.05 * np.random.default_rng(0).normal(size=(41, 5))
    ratings[0, 4] = -3.0
    each = aggregate(ratings, reward).by_rater
    tolerated, _ = explained(reward, each, PooledDiscounting(vetoes=1))
    assert tolerated.signal.reward[0] > 9.5
    expert = each._replace(m2=np.full((41, 5), 1.0) * [1, 1, 1, 1, 1e-4], count=np.full((41, 5), 4.0))
    of_expert, _ = explained(reward, expert, PooledDiscounting(vetoes=1))
    assert of_expert.signal.reward[0] < 8.0


def test_four_raters_are_too_few_to_overrule_one():
    here = np.ones((1, 4), bool)
    said, variance = np.array([[10.0, 10.0, 10.0, -3.0]]), np.full((1, 4), 0.1)
    assert pooled.overruled(said, here, variance, np.full(4, 0.1), 9).all()


def test_two_dissenters_are_no_lone_veto():
    here, variance = np.ones((1, 5), bool), np.full((1, 5), 0.1)
    said = np.array([[10.0, 10.0, 10.0, -3.0, -3.0]])
    assert pooled.overruled(said, here, variance, np.full(5, 0.1), 2).all()


def test_nobody_heard_is_met_with_caution():
    """No rating anywhere, or all raters silent: an extraordinary reward is believed to a twentieth, nothing is NaN."""
    reward = np.array([0.0, 4.0])
    none = ByRater(np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, 3)))
    why, statistics = explained(reward, none)
    assert why.signal.reward.tolist() == [0.0, 0.2]
    assert all(np.isfinite(x).all() for x in statistics.raters)


def test_it_is_made_by_name_and_checked():
    assert named("uard", vetoes=1) == PooledDiscounting(vetoes=1)
    for field, value in [("lies", 0.0), ("slack", -1.0), ("vetoes", 1.5), ("risk", float("nan"))]:
        with pytest.raises(InvalidValueError, match=field):
            PooledDiscounting(**{field: value})
    feedback = feedback_of(*panel_data(0))._replace(by_rater=None)
    with pytest.raises(InvalidValueError, match="by_rater"):
        PooledDiscounting().fit(feedback, feedback.count > 0)


@pytest.mark.parametrize("size", [1, 2, 5, 400])
@pytest.mark.parametrize("library", LIBRARIES)
def test_order_statistics_are_those_of_a_sort(size, library):
    """In JAX nothing is sorted: few values are compared with each other, of many the bits are halved."""
    values = np.random.default_rng(size).integers(-4, 5, (size, 3)).astype(np.float32)  # with ties and zeros
    values[:, 2] = np.random.default_rng(0).normal(size=size) * 10.0 ** np.random.default_rng(1).integers(-30, 30, size)
    convert, ranked = LIBRARIES[library], np.sort(values, axis=0)
    for first in {0, size // 3, size - 1}:
        count = min(3, size - first)
        found = smallest(convert(values), convert(np.full((1, 3), first)), axis=0, count=count)
        np.testing.assert_array_equal(np.asarray(found), ranked[first : first + count])


def test_a_tied_lowest_word_is_overruled_in_any_order_alike():
    random = np.random.default_rng(5)
    for _ in range(50):
        said = random.integers(-2, 3, (1, 6)).astype(float)
        said[0, :2] = -9.0  # two say the same lowest
        variance, noise = random.uniform(0.01, 1.0, (1, 6)), random.uniform(0.01, 1.0, 6)
        heard = pooled.overruled(said, np.ones((1, 6), bool), variance, noise, vetoes=1)
        order = random.permutation(6)
        again = pooled.overruled(said[:, order], np.ones((1, 6), bool), variance[:, order], noise[order], vetoes=1)
        assert np.array_equal(heard[:, order], again)
