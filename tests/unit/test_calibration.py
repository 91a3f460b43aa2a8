import math

import numpy as np
import pytest
from scipy import stats

from uard._checks import InvalidValueError
from uard.method.calibration import auroc, spearman

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
    ],
)
def test_bad_input_is_refused(function, arguments, message):
    with pytest.raises(InvalidValueError, match=message):
        function(*arguments)
