from decimal import Decimal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from uard import _checks
from uard._checks import InvalidValueError, UnknownNameError


@pytest.mark.parametrize(
    ("limits", "allowed", "good", "bad"),
    [
        ({}, "a finite number", [0, -1e300, np.float32(2), np.int64(3)], [float("nan"), float("inf"), 10**400]),
        ({"low": 0}, "a finite number >= 0", [0, 0.0, 7], [-1e-9, -3]),
        ({"high": 2}, "a finite number <= 2", [2, -5.5], [2.1]),
        ({"low": 0, "high": 1}, r"a finite number in \[0, 1\]", [0, 1, 0.5], [1.01, -0.01]),
        ({"low": 0, "open_low": True}, "a finite number > 0", [1e-9], [0, 0.0]),
        ({"low": 0, "high": 1, "open_low": True}, r"a finite number in \(0, 1\]", [1], [0]),
    ],
)
def test_number_allows_what_it_says(limits, allowed, good, bad):
    for value in good:
        _checks.number("lam", value, **limits)
    for value in bad:
        with pytest.raises(InvalidValueError, match=rf"^lam = \S+: must be {allowed}$"):
            _checks.number("lam", value, **limits)


@pytest.mark.parametrize("value", [None, "2", True, np.True_, [1.0], np.array([1.0]), 1j, jnp.array(True)])
def test_number_refuses_what_is_no_number(value):
    with pytest.raises(InvalidValueError, match=r"^lam = .*: must be a finite number$"):
        _checks.number("lam", value)


@pytest.mark.parametrize("scalar", [np.array, jnp.float32, torch.tensor])
def test_an_array_without_dimensions_is_a_number(scalar):
    _checks.number("lam", scalar(0.5), low=0, high=1)
    with pytest.raises(InvalidValueError, match=r"^lam = .*2\..*: must be a finite number in \[0, 1\]$"):
        _checks.number("lam", scalar(2.0), low=0, high=1)


@pytest.mark.parametrize("value", [1.0, True, None, -1, 11, "3"])
def test_whole_names_field_value_and_range(value):
    _checks.whole("heads", np.int64(3), low=0, high=10)
    with pytest.raises(InvalidValueError, match=rf"^heads = {value!r}: must be a whole number in \[0, 10\]$"):
        _checks.whole("heads", value, low=0, high=10)


def test_traced_values_pass_unchecked():
    def function(x):
        _checks.number("x", x, low=5)
        _checks.nonnegative("x", x)
        return x

    assert jax.jit(function)(-1.0) == -1.0


@pytest.mark.parametrize("library", [np.asarray, jnp.asarray, torch.tensor], ids=["numpy", "jax", "torch"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_finite_names_the_place(library, bad):
    values = np.zeros((2, 3), np.float32)
    _checks.finite("r", library(values))
    values[1, 2] = bad
    with pytest.raises(InvalidValueError, match=rf"^r\[1, 2\] = {bad}: must be finite \(no NaN, no infinity\)$"):
        _checks.finite("r", library(values))


def test_nonnegative_names_the_first_place():
    _checks.nonnegative("sigma", [0.0, 1.0])
    with pytest.raises(InvalidValueError, match=r"^sigma\[1\] = -0\.5: must be finite and >= 0$"):
        _checks.nonnegative("sigma", [0.0, -0.5, -1.0])
    with pytest.raises(InvalidValueError, match=r"^sigma = -2\.0: must be"):
        _checks.nonnegative("sigma", -2.0)


ITSELF: list = [1.0]
ITSELF.append(ITSELF)
NO_NUMBERS = [
    *([1, None], ["1", "2"], [1, "x"], [[1, 2], [3]], [1j], "abc", np.array(["1"]), None, {17: 4.0}, {1.0}, ITSELF),
    *((x for x in [1.0]), [Decimal(1)], Decimal(1), 10**400, 10**5000, torch.tensor([1j]), np.zeros(1, [("a", float)])),
    *([torch.ones(2), torch.ones(3)], np.array(["1"], dtype=np.dtypes.StringDType())),
]


@pytest.mark.parametrize("values", NO_NUMBERS, ids=lambda v: type(v).__name__)
def test_as_numpy_takes_real_numbers_only(values):
    with pytest.raises(InvalidValueError, match=r"^ratings = .*must be real numbers in rows of equal length .*mask="):
        _checks.as_numpy("ratings", values)


@pytest.mark.parametrize(
    "values",
    [
        [1, 2],
        np.array([1, 2], np.int8),
        np.float16([1, 2]),
        jnp.asarray([1, 2], jnp.bfloat16),
        torch.tensor([1, 2], dtype=torch.bfloat16),
        torch.tensor([1.0, 2.0], requires_grad=True),
        [torch.tensor(1.0, requires_grad=True), torch.tensor(2.0, dtype=torch.bfloat16)],
        [jnp.float32(1), np.float16(2)],
        np.array([1, 2], np.longdouble),
    ],
    ids=lambda v: f"{type(v).__name__}-{getattr(v, 'dtype', '')}",
)
def test_as_numpy_takes_every_precision(values):
    array = _checks.as_numpy("x", values)
    assert array.dtype == np.float64
    assert array.tolist() == [1.0, 2.0]


def test_what_is_masked_out_of_a_masked_array_is_missing():
    assert np.isnan(_checks.as_numpy("x", np.ma.array([1, 2], mask=[False, True]))).tolist() == [False, True]


def test_what_would_overflow_when_squared_is_named():
    _checks.moderate("r", np.array([1e100, -1e100]))
    _checks.moderate("r", np.zeros(0))
    with pytest.raises(InvalidValueError, match=r"^r\[1\] = -1e\+200: must be in \[-1e\+100, 1e\+100\], or its square"):
        _checks.moderate("r", np.array([0.0, -1e200]))
    with pytest.raises(InvalidValueError, match=r"^r\[0\] = .*e\+16: must be in \[-1e\+15, 1e\+15\]"):
        _checks.moderate("r", torch.tensor([2e16]))
    with pytest.raises(InvalidValueError, match=r"^r\[0\] = nan: must be finite"):
        _checks.moderate("r", np.array([np.nan]))


def test_what_does_not_fit_the_precision_in_which_it_leaves_is_named():
    assert _checks.fitting("r", np.array([1.5, 3e38]), np.float32).dtype == np.float32
    with pytest.raises(InvalidValueError, match=r"^r\[1\] = 1e\+39: must be in \[-3\.40\S+, 3\.40\S+\], for it leaves"):
        _checks.fitting("r", np.array([1.0, 1e39]), np.float32)


@pytest.mark.parametrize("value", ["false", 0, None, 1.0])
def test_truth_is_true_or_false(value):
    _checks.truth("standardise", np.True_)
    with pytest.raises(InvalidValueError, match=r"^standardise = .*: must be true or false$"):
        _checks.truth("standardise", value)


def test_a_name_is_text_and_an_array_is_none():
    with pytest.raises(UnknownNameError, match=r"^form = array\(\['wiener', 'wiener'\]"):
        _checks.choose("form", np.array(["wiener", "wiener"]), ["wiener"])


@pytest.mark.parametrize(
    ("wrong", "hint"),
    [
        ("reciprocl", r" \(did you mean 'reciprocal'\?\)"),
        ("WIENER", r" \(did you mean 'wiener'\?\)"),
        ("xyzzy", ""),
        (None, ""),
        (3, ""),
    ],
)
def test_choose_lists_the_names_and_suggests_the_nearest(wrong, hint):
    assert _checks.choose("form", "wiener", ["wiener", "reciprocal"]) == "wiener"
    with pytest.raises(
        UnknownNameError, match=rf"^form = {wrong!r}: must be one of reciprocal, wiener{hint}$"
    ) as caught:
        _checks.choose("form", wrong, ["wiener", "reciprocal"])
    assert caught.value.field == "form"


def test_long_values_are_cut():
    with pytest.raises(InvalidValueError, match=r"^lam = '1{196}\.\.\.: must be") as caught:
        _checks.number("lam", "1" * 500)
    assert len(str(caught.value)) < 250


def test_same_shape_names_both():
    _checks.same_shape("mask", np.zeros((2, 3)), "ratings", torch.zeros(2, 3))
    with pytest.raises(InvalidValueError, match=r"^mask\.shape = \(3,\): must be \(2, 3\), the shape of ratings$"):
        _checks.same_shape("mask", np.zeros(3), "ratings", np.zeros((2, 3)))


@pytest.mark.parametrize("bad", [(1,), (1, 2, 3), 5, None, (0, 4), (-1, 0), (0.0, 1), (True, 1), "ab"])
def test_pair_is_a_cell_of_the_grid(bad):
    assert _checks.pair("goal", [np.int32(3), 0], 4) == (3, 0)
    with pytest.raises(InvalidValueError, match=r"^goal = .*must be a \(row, column\) pair with both in 0\.\.3$"):
        _checks.pair("goal", bad, 4)
