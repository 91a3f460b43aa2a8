import math
from statistics import stdev

import hypothesis
import hypothesis.strategies as some
import numpy as np
import pytest
from scipy import stats

from uard import InvalidValueError
from uard.lab import statistics
from uard.lab.statistics import (
    bonferroni,
    compare_all,
    detectable_difference,
    hedges_g,
    holm,
    interquartile_mean,
    interval,
    paired,
    paired_sign_flip_p,
    probability_of_improvement,
    student,
    summarise,
    welch,
    wilson,
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
    half = 3.18244630528371 * s.sd / 2  # t(0.975) at 3 degrees of freedom, of any table
    assert s.ci95 == pytest.approx((4 - half, 4 + half))
    assert s.iqm_ci95 is None


@pytest.mark.parametrize(("n", "quantile"), [(2, 12.7062), (3, 4.30265), (5, 2.77645), (9, 2.30600)])
def test_below_ten_seeds_the_interval_is_students(n, quantile):
    x = np.arange(float(n))
    half = quantile * stdev(x) / math.sqrt(n)
    assert interval(x) == pytest.approx((x.mean() - half, x.mean() + half), rel=1e-5, abs=1e-5)


def test_from_ten_seeds_the_interval_is_the_bootstraps():
    x = np.arange(10.0)
    s = summarise(x)
    assert s.ci95 == interval(x)
    assert s.ci95[1] - s.ci95[0] < 0.9 * 2 * 2.26216 * stdev(x) / math.sqrt(10)  # Student's is wider
    assert s.ci95[0] < 4.5 < s.ci95[1]
    assert s.iqm_ci95[0] < s.iqm < s.iqm_ci95[1]


def test_one_seed_has_no_interval():
    assert summarise([0.1]) == (0.1, 0.0, None, 0.1, None, (0.1,))


@pytest.mark.parametrize("values", [[0.1] * 3, [0.1] * 10])
def test_summary_without_spread(values):
    s = summarise(values)
    assert (s.mean, s.iqm, *s.ci95) == pytest.approx((0.1,) * 4)
    assert s.sd == pytest.approx(0, abs=1e-15)


@pytest.mark.parametrize(
    ("share", "n", "expected"),
    [  # Newcombe 1998, table I: 81 of 263, 15 of 148, 0 of 20, 1 of 29
        (81 / 263, 263, (0.2553, 0.3662)),
        (15 / 148, 148, (0.0624, 0.1605)),
        (0.0, 20, (0.0, 0.1611)),
        (1 / 29, 29, (0.0061, 0.1718)),
    ],
)
def test_wilson_is_as_published(share, n, expected):
    assert wilson(share, n) == pytest.approx(expected, abs=6e-5)
    assert wilson(1 - share, n) == pytest.approx((1 - expected[1], 1 - expected[0]), abs=6e-5)


def test_a_share_of_seeds_has_wilsons_interval():
    assert summarise([1.0, 1.0, 0.0], share=True).ci95 == pytest.approx(wilson(2 / 3, 3))
    with pytest.raises(InvalidValueError, match=r"^goals .*must be shares in \[0, 1\]"):
        interval([0.5, 1.1], share=True, field="goals")


@hypothesis.given(some.lists(some.floats(-1e6, 1e6), min_size=2, max_size=9), some.randoms())
def test_students_interval_holds_the_mean_whatever_the_order(values, random):
    low, high = interval(values)
    room = 1e-9 * (1 + max(map(abs, values)))
    assert low - room <= np.mean(values) <= high + room
    random.shuffle(values)
    np.testing.assert_allclose(interval(values), (low, high), rtol=1e-9, atol=room)


@hypothesis.given(some.floats(0, 1), some.integers(1, 10_000))
def test_wilson_stays_within_0_and_1(share, n):
    low, high = wilson(share, n)
    assert 0 <= low <= share <= high <= 1
    assert low < high


@pytest.mark.parametrize("n", [3, 5, 8])
def test_students_interval_covers_a_normal_mean_95_times_in_100(n):
    ends = statistics.intervals(np.random.default_rng(n).normal(3, 2, (20_000, n)))
    covered = ((ends[:, 0] <= 3) & (ends[:, 1] >= 3)).mean()
    assert covered == pytest.approx(0.95, abs=6 * math.sqrt(0.95 * 0.05 / 20_000))  # six standard errors


def test_paired_is_scipys():
    a, b = samples(1.0)
    mine, theirs = paired(a, b), stats.ttest_rel(a, b)
    assert (mine.t, mine.df, mine.p) == pytest.approx((theirs.statistic, theirs.df, theirs.pvalue))
    assert paired([0.1, 0.2, 0.3], [0.1, 0.2, 0.3]).p == 1
    assert paired([1.1, 1.2, 1.3], [0.1, 0.2, 0.3]).p == 0  # differences are 1 but for rounding
    with pytest.raises(InvalidValueError, match=r"^b\.size = 2: must be 3"):
        paired([1.0, 2.0, 3.0], [1.0, 2.0])


def test_sign_flips_by_hand():
    assert paired_sign_flip_p([1.0, 2.0, 3.0]) == 2 / 8
    assert paired_sign_flip_p([3.0, -1.0]) == 1.0  # sums 2, -4, 4, -2
    assert paired_sign_flip_p([0.0, 0.0]) == 1.0
    assert paired_sign_flip_p(np.ones(40)) == 1 / 20_001


def test_sign_flips_drawn_and_tried_agree(monkeypatch):
    x = np.random.default_rng(1).normal(0.5, 1, 12)
    exact = paired_sign_flip_p(x)
    monkeypatch.setattr(statistics, "_EXACT", 0)
    assert paired_sign_flip_p(x) == pytest.approx(exact, abs=6 * math.sqrt(exact / 20_000))


def test_detectable_difference_by_hand():
    a, b = [1.0, 2.0, 3.0], [2.0, 3.0, 4.0]  # variances 1, standard error sqrt(2 / 3), 4 degrees of freedom
    assert detectable_difference(a, b) == pytest.approx((2.776445 + 0.940965) * math.sqrt(2 / 3), rel=1e-5)
    together = detectable_difference(a, [0.0] * 3, shared=True)  # sd 1, 2 degrees of freedom
    assert together == pytest.approx((4.302653 + 1.060660) / math.sqrt(3), rel=1e-5)
    assert detectable_difference(a, b, comparisons=5) > detectable_difference(a, b)


def test_what_is_called_detectable_is_detected_four_times_in_five():
    x = np.tile([1.0, -1.0], 4) * math.sqrt(7 / 8)  # sd 1
    true = detectable_difference(x, np.zeros(8), shared=True)
    drawn = np.random.default_rng(4).normal(true, 1, (4000, 8))
    assert np.mean([paired(y, np.zeros(8)).p < 0.05 for y in drawn]) == pytest.approx(0.8, abs=0.04)


def test_a_family_by_hand():
    base, high = [0.0, 0.1, 0.2, 0.1], [1.0, 1.2, 1.1, 1.0]
    family = compare_all([(high, base), ([0.1, 0.0, 0.1, 0.2], base), ([1.0], [2.0])])
    assert family.adjusted[0] == pytest.approx(2 * paired(high, base).p)
    assert (family.compared, family.found, family.above(0), family.below(0)) == (2, (0,), True, False)
    assert family.tests[2] is None
    assert (family.above(2), family.below(2)) == (False, False)
    assert family.caption().startswith("2 comparisons: 0.1 would differ by chance at 5 % uncorrected, 1 do uncorrected")


def test_where_nothing_differs_the_caption_says_what_would_have_been_found():
    a, b = [1.0, 2.0, 3.0], [1.5, 1.5, 3.5]
    assert f"A true difference of {detectable_difference(a, b, shared=True):.3g} " in compare_all([(a, b)]).caption()
    assert compare_all([([1.0], [2.0])]).caption() == "Nothing is compared: there is one run of each."


def test_a_family_of_noise_is_told_apart_5_times_in_100_at_most():
    rng, runs = np.random.default_rng(8), 1000
    false = np.mean([bool(compare_all(rng.normal(size=(6, 2, 5))).found) for _ in range(runs)])
    assert false < 0.05 + 4 * math.sqrt(0.05 * 0.95 / runs)


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
    for v, (summary, ends) in zip(values, whole, strict=True):
        for mine, theirs in zip(summarise(v), summary, strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-12)
        np.testing.assert_allclose(statistics.intervals(v[None])[0], ends, rtol=1e-12)
