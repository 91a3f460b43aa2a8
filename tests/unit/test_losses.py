"""Where uard loses, as data, and how the report draws it."""

import numpy as np
import pytest

from uard import InvalidValueError
from uard.lab import statistics
from uard.lab.statistics import summarise
from uard.lab.views.losses import KINDS, Loss, drawn, of_family, sorted_by_weight

OURS, THEIRS = summarise([34.0, 33.0, 35.0]), summarise([39.0, 40.0, 41.0])


def loss(**fields):
    known = {"kind": "beaten", "study": "games", "what": "the mean earns more", "against": "mean"}
    return Loss(**(known | {"ours": OURS, "theirs": THEIRS} | fields))


def test_how_bad_by_hand():
    assert loss().gap == -6.0
    assert loss().bad == pytest.approx(6 / 40)
    assert loss(ours=summarise([-3.0, -3.0]), theirs=summarise([1.0, 1.0])).bad == pytest.approx(4 / 3)
    assert loss(ours=summarise([0.0, 0.0]), theirs=summarise([0.0, 0.0])).bad == 0.0
    assert loss(theirs=None).bad is None


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"p": 0.0004, "of": 96}, "p < 0.001 of 96 (Holm)"),
        ({"p": 0.004, "of": 96}, "p = 0.004 of 96 (Holm)"),
        ({"p": 0.2, "of": 96}, "not told apart, p = 0.2 of 96 (Holm)"),
        ({"p": 0.2}, "not told apart, p = 0.2"),
        ({"p": 0.2, "note": "8 was to be found"}, "not told apart, p = 0.2; 8 was to be found"),
        ({}, "3 seeds"),
        ({"ours": summarise([1.0])}, "one run"),
        ({"ours": None}, ""),
    ],
)
def test_how_sure(fields, says):
    assert loss(**fields).sure == says


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"kind": "worse"}, "kind = 'worse': must be one of beaten"),
        ({"what": " "}, "what = ' ': must be some words"),
        ({"why": "x" * 200}, "why = "),
        ({"where": None}, "where = None: must be text"),
        ({"ours": 1.0}, "ours = 1.0: must be a uard.lab.statistics.Summary, or None"),
        ({"theirs": THEIRS._replace(mean=float("nan"))}, "theirs[0] = nan: must be finite"),
        ({"study": "g\ud800"}, "must be text without NUL"),
        ({"ours": OURS._replace(ci95=(1.0,))}, "must be what uard.lab.statistics.summarise gives"),
        ({"p": "small"}, "p = 'small': must be a finite number in [0, 1]"),
        ({"p": float("nan")}, "p = nan: must be"),
        ({"of": 0}, "of = 0: must be a whole number >= 1"),
    ],
)
def test_silly_losses_are_refused(fields, says):
    with pytest.raises(InvalidValueError) as refused:
        loss(**fields)
    assert says in str(refused.value)


def test_a_pair_with_one_seed_was_not_tested():
    family = statistics.compare_all([([1.0, 2.0, 3.0], [4.0, 5.0, 6.5]), ([1.0], [2.0])])
    assert of_family(family, 0) == (family.adjusted[0], 1)
    assert of_family(family, 1) == (None, 1)


def test_what_is_sure_and_large_comes_first():
    small, same = loss(theirs=summarise([35.0, 35.0])), loss(kind="no better", theirs=summarise([99.0, 99.0]))
    assert sorted_by_weight([same, small, loss()]) == [loss(), small, same]
    assert next(iter(KINDS)) == "beaten"


def test_both_numbers_are_drawn_on_one_line():
    picture = drawn(loss())
    assert picture.count("<circle") == 2
    assert 'aria-label="uard 34.0, mean 40.0"' in picture
    assert "style=" not in picture, "which the policy of the page forbids"
    assert drawn(loss(theirs=None)) == ""
    hostile = drawn(loss(against="<script>"))
    assert "<script>" not in hostile
    xs = [float(part.split('"')[0]) for part in picture.split('cx="')[1:]]
    assert xs[0] < xs[1]
    assert np.isfinite(xs).all()
