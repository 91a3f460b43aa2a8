"""What the paper claims of its filter (J1-J3, J10), where it does not hold, and what the anchored form adds."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from uard import Evidence, Feedback, ReliabilityFilter, RewardDiscounting, discount
from uard.method.mitigations import named
from uard.method.weights import FORMS

from . import strategies as some

BOUNDED = ("reciprocal", "exponential")  # the forms whose weight depends on U alone


@given(some.filters(), st.floats(0.0, 1e3), some.sigmas, some.sigmas)
def test_j1_score_of_a_nonnegative_value_is_nonnegative(f, mu, sigma_m, sigma_h):
    assert 0.0 <= f.score(mu, sigma_m, sigma_h) <= mu


@given(some.filters(), st.floats(0.0, 1e3), some.sigmas, some.sigmas, some.sigmas, st.booleans())
def test_j2_score_falls_with_either_disagreement(f, mu, sigma, more, other, model):
    low, high = sorted((sigma, more))
    before, after = ((low, other), (high, other)) if model else ((other, low), (other, high))
    assert f.score(mu, *after) <= f.score(mu, *before)


@given(
    some.filters("reciprocal", least=1e-3), some.positive, some.sigmas, some.sigmas, st.floats(1e-3, 10), st.booleans()
)
def test_j2_strictly_if_lambda_alpha_and_beta_are_positive(f, mu, sigma, other, step, model):
    after = (sigma + step, other) if model else (other, sigma + step)
    assert f.score(mu, *after) < f.score(mu, *((sigma, other) if model else (other, sigma)))


@pytest.mark.parametrize("changes", [{"lam": 0.0}, {"alpha": 0.0, "beta": 0.0}])
def test_j2_is_not_strict_where_the_paper_allows_zero(changes):
    f = ReliabilityFilter(**changes)
    assert f.score(1.0, 0.0, 0.0) == f.score(1.0, 5.0, 5.0)


def test_j3_is_false_a_negative_value_gains_by_disagreement():
    f = ReliabilityFilter()
    assert f.score(-1.0, 0.0, 0.0) == -1.0
    assert f.score(-1.0, 0.0, 2.0) == pytest.approx(-1 / 3)
    hazard, wall = f.score(-2.0, 0.0, 4.0), f.score(-1.0, 0.0, 0.0)
    assert hazard > wall


@given(some.filters("reciprocal", least=1e-3), some.positive, some.sigmas, some.sigmas, st.floats(1e-3, 10))
def test_j3_is_false_for_every_negative_value(f, size, sigma_m, sigma_h, step):
    assert f.score(-size, sigma_m, sigma_h) < f.score(-size, sigma_m, sigma_h + step) < 0


@given(st.sampled_from(BOUNDED), some.filters(), some.sigmas, some.sigmas)
def test_j10_weight_is_positive_bounded_and_monotone(form, f, sigma, more):
    f = ReliabilityFilter(min(f.lam, 3.0), f.alpha, f.beta, form)
    low, high = sorted((sigma, more))
    assert 0.0 < f.weight(0.0, high) <= f.weight(0.0, low) <= 1.0
    assert 0.0 < f.weight(high, low) <= f.weight(low, low) <= 1.0


@given(st.sampled_from(BOUNDED), st.floats(0.0, 20.0), some.sigmas, some.sigmas)
def test_j10_weight_is_lipschitz_with_lambda(form, lam, u, v):
    f = ReliabilityFilter(lam, 0.0, 1.0, form)
    assert abs(f.weight(0.0, u) - f.weight(0.0, v)) <= lam * abs(u - v) + 1e-12


def test_j10_lambda_is_the_smallest_lipschitz_constant():
    f = ReliabilityFilter(2.0, 0.0, 1.0)
    assert (1 - f.weight(0.0, 1e-6)) / 1e-6 == pytest.approx(2.0, rel=1e-4)


@given(some.filters(), some.positive)
def test_j10_weight_without_disagreement_is_one(f, mu):
    assert f.weight(0.0, 0.0, mu=mu) == 1.0
    assert f.score(mu, 0.0, 0.0) == mu


@given(some.filters(), some.values, some.sigmas, some.sigmas)
def test_every_weight_lies_between_zero_and_one(f, mu, sigma_m, sigma_h):
    assert 0.0 <= f.weight(sigma_m, sigma_h, mu=mu) <= 1.0


@given(some.values, st.floats(0.0, 1e3), some.fractions, some.fractions)
def test_anchored_reward_lies_between_anchor_and_reward(anchor, above, weight, other):
    reward, (low, high) = anchor + above, sorted((weight, other))
    filtered = discount(reward, high, anchor)
    assert anchor - 1e-9 <= filtered <= reward + 1e-9
    assert discount(reward, low, anchor) <= filtered + 1e-9


@given(some.values, some.values, some.fractions, some.values)
def test_anchored_reward_moves_with_a_shift_of_all_rewards(reward, anchor, weight, shift):
    moved = discount(reward + shift, weight, anchor + shift)
    assert moved == pytest.approx(discount(reward, weight, anchor) + shift, abs=1e-9)


def test_the_papers_form_does_not_move_with_a_shift():
    f = ReliabilityFilter()
    certain, doubtful = np.array([1.0, 0.0]), np.array([2.0, 1.5])
    assert f.score(certain[0], 0.0, certain[1]) > f.score(doubtful[0], 0.0, doubtful[1])
    assert f.score(certain[0] - 10, 0.0, certain[1]) < f.score(doubtful[0] - 10, 0.0, doubtful[1])


def test_the_papers_form_does_not_scale():
    f = ReliabilityFilter()
    assert f.score(1.0, 0.0, 0.0) > f.score(2.0, 0.0, 3.0)
    assert f.score(0.1, 0.0, 0.0) < f.score(0.2, 0.0, 0.3)


def learned(mitigation: RewardDiscounting, table: Feedback, sigma_m: float) -> np.ndarray:
    statistics = mitigation.fit(table, table.count > 0)
    return mitigation.signal(Evidence(table.proxy, np.full(table.proxy.shape, sigma_m), table), statistics).reward


def moved(table: Feedback, shift: float) -> Feedback:
    return table._replace(mean=table.mean + shift, lowest=table.lowest + shift, proxy=table.proxy + shift)


def scaled(table: Feedback, scale: float) -> Feedback:
    names = ("mean", "lowest", "sd", "proxy")
    return table._replace(**{name: scale * getattr(table, name) for name in names})


@given(some.mitigations(anchor="lowest"), some.tables(), st.floats(0.0, 10.0), some.shifts)
def test_anchored_discounting_moves_with_a_shift_of_rewards_and_ratings(mitigation, table, sigma_m, shift):
    assume((table.count > 0).any() or mitigation.unrated_weight == 1.0)
    expected = learned(mitigation, table, sigma_m) + shift
    np.testing.assert_allclose(learned(mitigation, moved(table, shift), sigma_m), expected, atol=1e-6)


@given(
    some.mitigations(standardise=True),
    st.sampled_from(["zero", "lowest"]),
    some.tables(),
    st.floats(0.0, 10.0),
    some.scales,
)
def test_standardised_discounting_scales_with_rewards_and_ratings(mitigation, anchor, table, sigma_m, scale):
    mitigation = RewardDiscounting(**{**vars(mitigation), "anchor": anchor})
    assume(np.ptp(table.proxy[table.count > 0]) > 0 if (table.count > 0).any() else False)
    expected = scale * learned(mitigation, table, sigma_m)
    np.testing.assert_allclose(
        learned(mitigation, scaled(table, scale), scale * sigma_m), expected, rtol=1e-6, atol=1e-8
    )


@given(some.mitigations(anchor="lowest"), some.tables(), st.floats(0.0, 10.0))
def test_anchored_discounting_never_makes_a_reward_better_or_worse_than_its_anchor(mitigation, table, sigma_m):
    learns = learned(mitigation, table, sigma_m)
    statistics = mitigation.fit(table, table.count > 0)
    total = table.count + mitigation.prior_count
    anchor = np.where(
        total > 0,
        (table.count * table.lowest + mitigation.prior_count * statistics.lowest) / np.where(total > 0, total, 1.0),
        statistics.lowest,
    )
    assert (learns <= np.maximum(anchor, table.proxy) + 1e-9).all()
    assert (learns >= np.minimum(anchor, table.proxy) - 1e-9).all()


@pytest.mark.parametrize("change", [lambda t: moved(t, -10.0), lambda t: scaled(t, 0.1)], ids=["shift", "scale"])
@pytest.mark.parametrize(("name", "keeps"), [("uard-0.1", True), ("uard-operator", False)])
def test_only_the_recommended_form_keeps_the_order_of_rewards(change, name, keeps):
    three = np.array([3.0, 3.0, 3.0])
    honest, doubted = 1.0, 3.0
    table = Feedback(
        count=np.full(3, 50.0),
        mean=np.array([honest, 0.0, 0.5]),
        lowest=np.array([honest, -2.0, 0.5]),
        sd=np.array([0.0, 6.0, 0.0]),
        proxy=np.array([honest, doubted, 0.5]),
        raters=three,
    )
    before, after = (learned(named(name), t, 0.0) for t in (table, change(table)))
    assert before[0] > before[1]
    assert (after[0] > after[1]) is np.bool_(keeps)


@pytest.mark.parametrize("form", FORMS)
def test_scores_prefer_the_less_doubtful_of_two_equal_actions_unless_unanchored_and_negative(form):
    none = np.zeros(3)
    feedback = Feedback(np.ones(3), none, none, sd=np.array([0.0, 2.0, 0.0]), proxy=none, raters=np.full(3, 3.0))
    mu = np.array([-1.0, -1.0, -5.0])
    printed = named("uard-paper", form=form)
    anchored = named("uard-paper", form=form, anchor="lowest")
    statistics = printed.fit(feedback, feedback.count > 0)
    scores = printed.score(mu, np.zeros(3), feedback, statistics)
    if form in ("linear", "certainty-equivalent"):
        assert (scores == 0).all(), "the printed zero-reward collapse"
    else:
        assert np.argmax(scores) == 1
    assert np.argmax(anchored.score(mu, np.zeros(3), feedback, statistics)) == 0
