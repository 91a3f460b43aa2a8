import math
from statistics import stdev

import numpy as np
import pytest
from scipy import stats

from uard import InvalidValueError
from uard.lab import statistics
from uard.lab.statistics import (
    bonferroni,
    hedges_g,
    holm,
    interquartile_mean,
    probability_of_improvement,
    student,
    summarise,
    welch,
)

INF = math.inf
TWO_SAMPLES = (welch, student, hedges_g, probability_of_improvement)


def samples(shift=0.0, scale=1.0, sizes=(10, 10), seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(0, 1, sizes[0]), rng.normal(shift, scale, sizes[1])


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([7.0], 7.0),
        ([4, 1, 2, 9], 3.0),
        ([10, 1, 9, 2, 8, 3, 7, 4, 6, 50], (0.5 * 3 + 4 + 6 + 7 + 8 + 0.5 * 9) / 5),
        ([0, 0, 0, 0, 0, 100], 0.0),
    ],
)
def test_interquartile_mean_by_hand(values, expected):
    assert interquartile_mean(np.array(values)) == pytest.approx(expected, rel=1e-15)


@pytest.mark.parametrize("n", [4, 8, 20, 100])
def test_interquartile_mean_is_scipys_trimmed_mean_where_quarters_are_whole(n):
    x = np.random.default_rng(n).normal(size=(3, n))
    np.testing.assert_allclose(interquartile_mean(x), stats.trim_mean(x, 0.25, axis=1), rtol=1e-12)
    np.testing.assert_allclose(interquartile_mean(x.T, axis=0), interquartile_mean(x), rtol=1e-15)


def test_interquartile_mean_of_nothing_names_the_field():
    with pytest.raises(InvalidValueError, match=r"^values\.shape = \(0,\): must be at least one number"):
        interquartile_mean(np.array([]))


def test_summary_by_hand():
    s = summarise([3.0, 1.0, 2.0, 10.0])
    assert (s.mean, s.iqm, s.per_seed) == (4.0, 2.5, (3.0, 1.0, 2.0, 10.0))
    assert s.sd == pytest.approx(stdev([3.0, 1.0, 2.0, 10.0]))
    assert 1.0 <= s.ci95[0] < s.mean < s.ci95[1] <= 10.0
    assert 1.0 <= s.iqm_ci95[0] < s.iqm < s.iqm_ci95[1] <= 10.0


@pytest.mark.parametrize("values", [[0.1], [0.1] * 3, [0.1] * 10])
def test_summary_without_spread(values):
    s = summarise(values)
    assert (s.mean, s.iqm) == pytest.approx((0.1, 0.1))
    assert s.sd == pytest.approx(0, abs=1e-15)
    assert (*s.ci95, *s.iqm_ci95) == pytest.approx((0.1,) * 4)


def test_bootstrap_is_reproducible_and_equivariant():
    x = np.random.default_rng(1).normal(size=10)
    assert summarise(x) == summarise(list(x))
    np.testing.assert_allclose(summarise(2 * x + 5).ci95, 2 * np.array(summarise(x).ci95) + 5, rtol=1e-12)


def test_bootstrap_interval_covers_the_mean_as_often_as_theory_has_it():
    rng = np.random.default_rng(2)
    intervals = [summarise(rng.normal(3, 1, 10)).ci95 for _ in range(300)]
    # With ten seeds a percentile interval is short by sqrt(9/10) and by t against z: 90 %, not 95 %.
    assert 0.86 < np.mean([low <= 3 <= high for low, high in intervals]) < 0.95


def test_bootstrap_interval_agrees_with_scipys():
    x = np.random.default_rng(3).exponential(size=12)
    theirs = stats.bootstrap((x,), np.mean, n_resamples=20_000, method="percentile", rng=4).confidence_interval
    np.testing.assert_allclose(summarise(x).ci95, theirs, atol=0.03)


@pytest.mark.parametrize("sizes", [(10, 10), (5, 17), (2, 2), (2, 40)])
@pytest.mark.parametrize("scale", [1.0, 30.0])
@pytest.mark.parametrize(("ours", "equal"), [(welch, False), (student, True)])
def test_t_tests_are_scipys(ours, equal, scale, sizes):
    a, b = samples(shift=1.5, scale=scale, sizes=sizes)
    mine, theirs = ours(a, b), stats.ttest_ind(a, b, equal_var=equal)
    assert (mine.t, mine.df, mine.p) == pytest.approx((theirs.statistic, theirs.df, theirs.pvalue), rel=1e-10)
    assert mine.difference == pytest.approx(a.mean() - b.mean())
    assert mine.effect == hedges_g(a, b)
    swapped = ours(b, a)
    assert (swapped.t, swapped.p) == pytest.approx((-mine.t, mine.p))


def test_degrees_of_freedom_by_hand():
    a, b = [1.0, 2.0, 3.0], [0.0, 4.0, 8.0, 12.0]
    va, vb = 1 / 3, (80 / 3) / 4
    assert student(a, b).df == 5
    assert welch(a, b).df == pytest.approx((va + vb) ** 2 / (va**2 / 2 + vb**2 / 3))


def test_tiny_p_values_do_not_vanish():
    a, b = samples(shift=40.0)
    assert 0 < welch(a, b).p < 1e-20


@pytest.mark.parametrize("test", [welch, student])
@pytest.mark.parametrize(
    ("a", "b", "t", "p"),
    [
        ([0.1] * 3, [0.1] * 10, 0, 1),
        ([0.0] * 2, [0.0] * 2, 0, 1),
        ([0.1] * 10, [0.2] * 10, -INF, 0),
        ([1e9 + 1] * 3, [1e9] * 3, INF, 0),
    ],
)
def test_two_constant_samples(test, a, b, t, p):
    result = test(a, b)
    assert (result.t, result.p, result.effect, result.df) == (t, p, t, len(a) + len(b) - 2)
    assert result.difference == pytest.approx(a[0] - b[0])


@pytest.mark.parametrize("constant", [0.0, 0.1, 1.0])
def test_one_constant_sample_is_no_cause_for_a_warning(constant):
    a, b = [constant] * 10, [1.0, 2.0, 3.0]
    standard_error = 1 / math.sqrt(3)
    assert welch(a, b).t == pytest.approx((constant - 2) / standard_error)
    assert welch(a, b).df == pytest.approx(2)
    assert welch(a, b).p == pytest.approx(2 * stats.t.sf((2 - constant) / standard_error, 2))
    assert student(a, b).t == pytest.approx((constant - 2) / math.sqrt(2 / 11 * (1 / 10 + 1 / 3)))


def test_hedges_g_by_hand():
    a, b = [2.0, 4.0, 6.0], [1.0, 2.0, 3.0, 4.0, 5.0]
    pooled = math.sqrt((2 * 4 + 4 * 2.5) / 6)
    assert hedges_g(a, b) == pytest.approx((4 - 3) / pooled * (1 - 3 / 23))
    assert hedges_g(b, a) == pytest.approx(-hedges_g(a, b))


def test_probability_of_improvement_by_hand():
    assert probability_of_improvement([1, 2, 3], [2, 2]) == (0 + 0.5 + 1) / 3
    assert probability_of_improvement([5], [1, 2]) == 1
    assert probability_of_improvement([1], [1]) == 0.5
    a, b = samples(0.3)
    u = stats.mannwhitneyu(a, b).statistic
    assert probability_of_improvement(a, b) == pytest.approx(u / (len(a) * len(b)))


@pytest.mark.parametrize(
    ("p_values", "by_holm", "by_bonferroni"),
    [
        ([0.01, 0.04, 0.03], [0.03, 0.06, 0.06], [0.03, 0.12, 0.09]),
        ([0.005, 0.9, 0.6, 0.02], [0.02, 1, 1, 0.06], [0.02, 1, 1, 0.08]),
        ([0.02, 0.02], [0.04, 0.04], [0.04, 0.04]),
        ([0.2], [0.2], [0.2]),
        ([0, 1], [0, 1], [0, 1]),
        ([], [], []),
    ],
)
def test_corrections_by_hand(p_values, by_holm, by_bonferroni):
    assert holm(p_values) == pytest.approx(by_holm)
    assert bonferroni(p_values) == pytest.approx(by_bonferroni)


@pytest.mark.parametrize("correct", [holm, bonferroni])
@pytest.mark.parametrize("bad", [math.nan, -0.1, 1.1, None])
def test_corrections_refuse_what_is_no_p_value(correct, bad):
    with pytest.raises(InvalidValueError, match=r"^p_values\[1\] = .*must be a finite number in \[0, 1\]"):
        correct([0.5, bad])


@pytest.mark.parametrize("test", TWO_SAMPLES)
@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ([], r"\.size = 0: must be >= "),
        ([1.0, math.nan], r"\[1\] = nan: must be finite"),
        ([INF, 1.0], r"\[0\] = inf: must be finite"),
        ([None, 1.0], " = .*must be real numbers"),
        ("abc", " = 'abc': must be real numbers"),
        ([[1.0, 2.0], [3.0, 4.0]], r"\.shape = \(2, 2\): must be \(n,\): one number per seed"),
    ],
)
def test_errors_name_the_sample(test, bad, message):
    with pytest.raises(InvalidValueError, match=f"^a{message}"):
        test(bad, [1.0, 2.0])
    with pytest.raises(InvalidValueError, match=f"^b{message}"):
        test([1.0, 2.0], bad)


@pytest.mark.parametrize("test", TWO_SAMPLES[:3])
def test_one_seed_is_too_few_for_a_test(test):
    with pytest.raises(InvalidValueError, match=r"^b\.size = 1: must be >= 2 \(one number per seed\)"):
        test([1.0, 2.0], [1.0])


@pytest.mark.parametrize("bad", [[], [math.nan], [[1.0], [2.0]], None])
def test_summary_errors_name_the_field(bad):
    with pytest.raises(InvalidValueError, match=r"^hacks\b"):
        summarise(bad, "hacks")


@pytest.mark.parametrize(("shift", "differs"), [(3.0, True), (0.0, False)])
def test_a_permutation_test_comes_to_the_same_conclusion(shift, differs):
    a, b = samples(shift, seed=5)
    permuted = stats.permutation_test((a, b), lambda x, y: x.mean() - y.mean(), n_resamples=2000, rng=6)
    for test in (welch, student):
        assert (test(a, b).p < 0.01) == (permuted.pvalue < 0.01) == differs


def test_false_alarms_are_as_rare_as_they_should_be():
    rng = np.random.default_rng(7)
    alarms = [welch(rng.normal(0, 1, 10), rng.normal(0, 4, 10)).p < 0.05 for _ in range(1000)]
    assert 0.03 < np.mean(alarms) < 0.07


def test_resamples_are_shared_by_equal_sizes():
    assert next(statistics._resampled(10)) is next(statistics._resampled(10))


def test_many_seeds_are_resampled_in_blocks_to_the_same_numbers(monkeypatch):
    values = np.random.default_rng(3).normal(size=(3, 301))
    whole = [(summarise(v), *statistics.intervals(v[None])) for v in values]
    monkeypatch.setattr(statistics, "_AT_ONCE", 301 * 7)
    for v, (summary, interval) in zip(values, whole, strict=True):
        assert summarise(v) == summary
        np.testing.assert_allclose(statistics.intervals(v[None])[0], interval, rtol=1e-12)
        np.testing.assert_allclose(interval, summary.ci95, rtol=1e-9)
