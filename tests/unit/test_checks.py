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


@pytest.mark.parametrize("values", [[1, None], ["1", "2"], [1, "x"], [[1, 2], [3]], [1j], "abc", np.array(["1"]), None])
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
    ],
    ids=lambda v: f"{type(v).__name__}-{getattr(v, 'dtype', '')}",
)
def test_as_numpy_takes_every_precision(values):
    array = _checks.as_numpy("x", values)
    assert array.dtype == np.float64
    assert array.tolist() == [1.0, 2.0]


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
