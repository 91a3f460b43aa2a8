"""Signatures are contracts while the tests run: a wrong shape does not go unnoticed."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapes
import torch

from uard import InvalidValueError
from uard.adapters import steps
from uard.diagnosis import case
from uard.judges import scales
from uard.method import uncertainty
from uard.method.arrays import Array
from uard.ratings.aggregate import aggregate

if TYPE_CHECKING:
    from jaxtyping import Float


class Pair(NamedTuple):
    first: Float[Array, "*batch"]
    second: Float[Array, "*batch"]


class Nested(NamedTuple):
    pair: Pair
    third: Float[Array, "*batch"]


@shapes.checked
def row_means(x: Float[Array, "n K"], weights: Float[Array, " K"] | None = None) -> Float[Array, " n"]:
    return x.sum() if weights is None else (x * weights).sum(-1)


@shapes.checked
def total(nested: Nested) -> float:
    return 0.0


@pytest.mark.parametrize(
    "function",
    [uncertainty.masked_mean, aggregate, scales.Scale.observe, case.mostly, steps.rows_of],
    ids=lambda f: f.__qualname__,
)
def test_the_packages_are_checked(function):
    assert hasattr(function, "__wrapped__")


def test_what_would_be_broadcast_in_silence_is_found():
    values, mask = np.ones((2, 3)), np.array([[True], [False]])
    assert uncertainty.masked_mean.__wrapped__(values, mask) == 3.0, "of ones"
    with pytest.raises(shapes.ShapeError, match=r"masked_mean: mask is bool\[2, 1\], not Bool.*batch.*float64\[2, 3\]"):
        uncertainty.masked_mean(values, mask)


@pytest.mark.parametrize("array", [np.asarray, jnp.asarray, torch.tensor])
def test_sizes_and_types_of_all_libraries(array):
    ones, whole = array([[1.0, 1.0]]), array([[1, 1]])
    assert row_means(ones, array([1.0, 2.0])).tolist() == [3.0]
    with pytest.raises(shapes.ShapeError, match=r"weights is .*\[1, 1\], not"):
        row_means(ones, array([[1.0]]))
    with pytest.raises(shapes.ShapeError, match=r"x is .*int\d\d\[1, 2\], not Float"):
        row_means(whole)


def test_what_is_returned_is_checked_too():
    with pytest.raises(shapes.ShapeError, match=r"row_means: return is float64\[\], not Float"):
        row_means(np.ones((2, 3)))


def test_the_functions_own_error_comes_first():
    with pytest.raises(InvalidValueError, match=r"^ratings\.shape = \(2, 3\): must be \(3, K\)"):
        aggregate(np.ones((2, 3)), np.ones(3))


def test_fields_of_named_tuples_are_of_one_shape():
    two = np.ones(2)
    assert total(Nested(Pair(two, two), two)) == 0.0
    with pytest.raises(shapes.ShapeError, match=r"total: nested\.pair: first is float64\[2\], not"):
        total(Nested(Pair(two, two), np.ones(3)))


def test_traced_arrays_are_checked():
    with pytest.raises(shapes.ShapeError, match="weights is"):
        jax.jit(row_means)(jnp.ones((2, 3)), jnp.ones(1))
