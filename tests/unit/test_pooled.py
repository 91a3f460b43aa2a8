"""The pooled rule: numbers derived by hand, the reference, three array libraries, and what must hold of any panel."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from uard import Evidence, Feedback, InvalidValueError
from uard.method import pooled, rater_statistics
from uard.method.feedback import ByRater
from uard.method.mitigations import PooledDiscounting, named
from uard.ratings.aggregate import aggregate

from . import pooled_reference as reference


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


@pytest.mark.parametrize("convert", [torch.tensor, jnp.asarray], ids=["torch", "jax"])
def test_libraries_agree(convert):
    reward, each = panel_data(3, rows=40, raters=7)
    mitigation = PooledDiscounting(vetoes=2)
    expected, _ = explained(reward, each, mitigation)
    found, _ = explained(reward, each, mitigation, convert)
    np.testing.assert_allclose(np.asarray(found.signal.reward), expected.signal.reward, rtol=1e-3, atol=1e-4)


def test_gradients_are_finite():
    reward, each = panel_data(4, rows=30, raters=5)
    feedback = feedback_of(reward, each, jnp.asarray)
    mitigation = PooledDiscounting(vetoes=1)

    def learned(mean):
        known = feedback._replace(by_rater=feedback.by_rater._replace(mean=mean))
        evidence = Evidence(feedback.proxy, 0.0 * feedback.proxy, known)
        return mitigation.signal(evidence, mitigation.fit(known, known.count > 0)).reward.sum()

    assert np.isfinite(np.asarray(jax.grad(learned)(feedback.by_rater.mean))).all()


some_panels = st.tuples(st.integers(0, 10_000), st.integers(1, 64))


@settings(max_examples=30)
@given(some_panels, st.randoms(use_true_random=False))
def test_order_of_raters_is_irrelevant(panel, random):
    reward, each = panel_data(panel[0], raters=panel[1])
    order = random.sample(range(panel[1]), panel[1])
    shuffled = ByRater._make(x[:, order] for x in each)
    np.testing.assert_allclose(
        explained(reward, shuffled)[0].signal.reward, explained(reward, each)[0].signal.reward, rtol=1e-9, atol=1e-9
    )


@settings(max_examples=30)
@given(some_panels, st.integers(0, 2))
def test_a_rater_who_answers_nothing_changes_nothing(panel, vetoes):
    reward, each = panel_data(panel[0], raters=panel[1])
    silent = ByRater._make(np.concatenate([x, 0.0 * x[:, :1]], axis=1) for x in each)
    mitigation = PooledDiscounting(vetoes=vetoes)
    np.testing.assert_allclose(
        explained(reward, silent, mitigation)[0].signal.reward,
        explained(reward, each, mitigation)[0].signal.reward,
        rtol=1e-9,
        atol=1e-9,
    )


@settings(max_examples=30)
@given(some_panels, st.floats(-100, 100), st.floats(0.01, 100))
def test_all_rewards_may_be_shifted_and_scaled(panel, shift, factor):
    reward, each = panel_data(panel[0], raters=panel[1])
    moved = ByRater(each.count, np.where(each.count > 0, factor * each.mean + shift, 0.0), factor**2 * each.m2)
    found, _ = explained(factor * reward + shift, moved)
    expected, _ = explained(reward, each)
    np.testing.assert_allclose(found.weight, expected.weight, rtol=1e-5, atol=1e-7)
    scale = factor * (1.0 + np.abs(reward).max()) + abs(shift)
    np.testing.assert_allclose(found.signal.reward, factor * expected.signal.reward + shift, atol=1e-6 * scale)


@given(st.integers(1, 12), st.integers(1, 20), st.floats(0.01, 10), st.floats(-5, 5))
def test_more_agreeing_ratings_never_lower_the_weight(raters, more, variance, reward):
    def odds(k):
        said, here = np.full((1, k), reward), np.ones((1, k), bool)
        return pooled.pool(np.array([reward]), said, here, np.full((1, k), variance), 10.0).log_odds[0]

    assert odds(raters + more) <= odds(raters)


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
