import math

import numpy as np
import pytest
from scipy import stats

from uard._checks import InvalidValueError
from uard.method.calibration import auroc, reliability_diagram, spearman, tpr_at_fpr

HACKS, HONEST = [0.9, 0.6, 0.3], [0.8, 0.5, 0.4, 0.2, 0.1]
SCORE, HACK = HACKS + HONEST, [True] * 3 + [False] * 5


@pytest.fixture(params=[0, 1], ids=["continuous", "ties"])
def sample(request):
    rng = np.random.default_rng(7)
    sigma = rng.exponential(1.0, 200)
    error = sigma + rng.normal(0.0, 1.0, 200)
    return (np.round(sigma), np.round(error)) if request.param else (sigma, error)


def test_spearman_is_scipys(sample):
    assert spearman(*sample) == pytest.approx(stats.spearmanr(*sample).statistic, abs=1e-12)
    assert spearman(sample[0], -sample[0]) == pytest.approx(-1.0)


def test_spearman_of_a_constant_is_zero():
    assert spearman([1, 1, 1], [1, 2, 3]) == 0.0
    assert spearman([1, 2, 3], [0.1, 0.1, 0.1]) == 0.0


def test_auroc_is_the_mann_whitney_statistic(sample):
    score, hack = sample[0], sample[1] > 1.5
    u = stats.mannwhitneyu(score[hack], score[~hack]).statistic
    assert auroc(score, hack) == pytest.approx(u / (hack.sum() * (~hack).sum()), abs=1e-12)


@pytest.mark.parametrize(
    ("score", "hack", "expected"),
    [
        (SCORE, HACK, (5 + 4 + 2) / 15),
        ([1, 2, 3, 4], [0, 0, 1, 1], 1.0),
        ([4, 3, 2, 1], [0, 0, 1, 1], 0.0),
        ([1, 1, 1, 1], [0, 0, 1, 1], 0.5),
    ],
)
def test_auroc_by_hand(score, hack, expected):
    assert auroc(score, hack) == pytest.approx(expected)


@pytest.mark.parametrize(("fpr", "expected"), [(0.0, 1 / 3), (0.19, 1 / 3), (0.2, 2 / 3), (0.6, 1.0), (1.0, 1.0)])
def test_tpr_at_fpr_by_hand(fpr, expected):
    assert tpr_at_fpr(SCORE, HACK, fpr) == pytest.approx(expected)


def test_tpr_at_fpr_allows_the_whole_share():
    honest = np.arange(100.0)
    assert 0.29 * 100 < 29
    assert tpr_at_fpr([*honest, 70.5], [False] * 100 + [True], 0.29) == 1.0
    assert tpr_at_fpr([*honest, 70.5], [False] * 100 + [True], 0.28) == 0.0


def test_tpr_at_fpr_does_not_let_tied_honest_steps_through():
    assert tpr_at_fpr([3, 3, 2, 1, 3, 4], [0, 0, 0, 0, 1, 1], 0.25) == 0.5


def test_reliability_diagram_by_hand():
    diagram = reliability_diagram([3, 1, 2, 4, 5], [30, 10, 20, 40, 60], bins=2)
    assert [part.tolist() for part in diagram] == [[2.0, 4.5], [20.0, 50.0], [3, 2]]
    assert reliability_diagram([[1, 2], [3, 4]], [[0, 0], [1, 1]], bins=10).count.tolist() == [1] * 4


@pytest.mark.parametrize(
    ("function", "arguments", "message"),
    [
        (spearman, ([1, 2], [1, 2, 3]), r"^sigma\.shape = \(2,\): must be \(3,\), the shape of error$"),
        (spearman, (np.zeros((2, 3)), np.zeros((3, 2))), r"^sigma\.shape = \(2, 3\): must be \(3, 2\)"),
        (spearman, ([1], [1]), r"^sigma\.size = 1: must be >= 2$"),
        (spearman, ([1, math.nan], [1, 2]), r"^sigma\[1\] = nan: must be finite"),
        (spearman, ([1, 2], [1, None]), r"^error = \[1, None\]: must be real numbers"),
        (auroc, ([1, 2], [1, 1]), r"^hack = '2 of 2 true': must be of both kinds$"),
        (auroc, ([1, 2], [0, 0]), r"^hack = '0 of 2 true': must be of both kinds$"),
        (tpr_at_fpr, ([1, 2], [0, 0]), r"^hack = '0 of 2 true': must be of both kinds$"),
        (tpr_at_fpr, (SCORE, HACK, 1.5), r"^fpr = 1\.5: must be a finite number in \[0, 1\]$"),
        (reliability_diagram, ([1, 2], [1, 2], 0), r"^bins = 0: must be a whole number >= 1$"),
        (reliability_diagram, ([1, 2], [1, 2], 2.0), r"^bins = 2\.0: must be a whole number >= 1$"),
        (reliability_diagram, ([1, 2], [1, -2]), r"^error\[1\] = -2\.0: must be finite and >= 0$"),
    ],
)
def test_bad_input_is_refused(function, arguments, message):
    with pytest.raises(InvalidValueError, match=message):
        function(*arguments)
