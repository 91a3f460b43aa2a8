"""One way to compute with NumPy, JAX and torch arrays alike; neither JAX nor torch is imported.

Signatures say shapes with jaxtyping: ``Float[Array, "*batch K"]`` is an array of floats whose last axis has K entries,
and a name means one size in all of a signature. The test run checks them. ``Numbers`` is an array of any shape or a
plain number; functions of several broadcast them.
"""

from __future__ import annotations

import sys
from functools import lru_cache
from typing import Any

import numpy as np
from array_api_compat import array_namespace

from uard import _checks

Array = Any
"""A NumPy, JAX or torch array."""
Numbers = Any
"""An array of any shape, or a number."""

_NUMPY = (np.ndarray, np.generic, float, int)


def namespace(*arrays: Numbers) -> Any:
    """Return the array namespace of the arguments; plain numbers are NumPy's, and NumPy's give way to others.

    Examples:
        >>> namespace(1.0, np.zeros(2)) is np
        True
    """
    others = [a for a in arrays if not isinstance(a, _NUMPY) and hasattr(a, "shape")]
    return array_namespace(*others) if others else np


def where(condition: Array, yes: Numbers, no: Numbers) -> Array:
    """Choose elementwise; ``yes`` and ``no`` may be plain numbers.

    Examples:
        >>> where(np.array([True, False]), np.array([1.0, 2.0]), 0.0).tolist()
        [1.0, 0.0]
    """
    return namespace(condition, yes, no).where(condition, yes, no)


def all_true(mask: Array) -> bool:
    """Whether an array of truth values of NumPy is true everywhere; of JAX and torch it does not look, and says no.

    With what it says a step can be left out that would change nothing: streams of small batches live on few steps.

    Examples:
        >>> all_true(np.array([True, True])), all_true(np.array([True, False]))
        (True, False)
    """
    return type(mask) is np.ndarray and bool(np.count_nonzero(mask) == mask.size)


def at_least(values: Array, low: float) -> Array:
    """Return values that are no smaller than a number.

    Examples:
        >>> at_least(np.array([0.5, 2.0]), 1.0).tolist()
        [1.0, 2.0]
    """
    xp = namespace(values)
    return np.maximum(values, low) if xp is np else xp.maximum(values, low * xp.ones_like(values))


def within(values: Array, limit: float) -> Array:
    """Return values that are no further from 0 than a number.

    Examples:
        >>> within(np.array([-5.0, 2.0]), 3.0).tolist()
        [-3.0, 2.0]
    """
    xp = namespace(values)
    return np.maximum(np.minimum(values, limit), -limit) if xp is np else xp.clip(values, -limit, limit)


def filled_like(values: Array, number: float) -> Array:
    """Return an array like another one, with one number everywhere.

    Examples:
        >>> filled_like(np.array([3.0, 2.0]), 1.0).tolist()
        [1.0, 1.0]
    """
    if type(values) is np.ndarray:  # which takes a quarter of the time that NumPy's full_like does
        filled = np.empty(values.shape, values.dtype)
        filled.fill(number)
        return filled
    return namespace(values).full_like(values, number)


def least(values: Array) -> Array:
    """Return the smallest value along the last axis.

    Examples:
        >>> least(np.array([[3.0, 2.0]])).tolist()
        [2.0]
    """
    if type(values) is not np.ndarray:
        return namespace(values).min(values, axis=-1)
    return np.minimum.reduce(values, -1)


def dot(a: Array, b: Array) -> Array:
    """Return the sum of products over the last axis.

    Examples:
        >>> dot(np.array([[1.0, 2.0]]), np.array([[3.0, 4.0]])).tolist()
        [11.0]
    """
    if type(a) is np.ndarray and type(b) is np.ndarray:
        # In rows of another layout NumPy adds in another order: a row's number would depend on what stands beside it.
        return np.vecdot(np.ascontiguousarray(a), np.ascontiguousarray(b))
    return (a * b).sum(-1)


def total(values: Array) -> Array:
    """Return the sum over the last axis.

    Examples:
        >>> total(np.array([[1.0, 2.0]])).tolist()
        [3.0]
    """
    # Of a few numbers a product with ones takes half as long as a reduction.
    if type(values) is not np.ndarray:
        return values.sum(-1)
    return np.vecdot(np.ascontiguousarray(values), _ones(values.shape[-1], values.dtype.char))


@lru_cache(maxsize=64)
def _ones(count: int, kind: str) -> np.ndarray:
    ones = np.ones(count, kind)
    ones.flags.writeable = False
    return ones


def smallest(values: Array, first: Array, axis: int, count: int = 1) -> Array:
    """Return some consecutive values of those along an axis, in their order; at index 0 is the smallest.

    It sorts, but not in JAX: inside a loop on a CPU XLA sorts three numbers in 1 us and 400 in 30 us.

    Examples:
        >>> smallest(np.array([5.0, 3.0, 4.0]), np.array([1]), axis=0, count=2).tolist()
        [4.0, 5.0]

    Args:
        values: Of any shape; no NaN.
        first: Index of the first, >= 0 and less than the axis is long; of the values' shape, with that axis of size 1.
        axis: Along which.
        count: How many; those beyond the end mean nothing.

    Returns:
        An array of the values' shape, with that axis of size ``count``.
    """
    xp = namespace(values)
    if "jax" not in xp.__name__:
        index = first if count == 1 else xp.concat([first + i for i in range(count)], axis=axis)
        return xp.take_along_axis(xp.sort(values, axis=axis), xp.clip(index, 0, values.shape[axis] - 1), axis=axis)
    values, first = xp.moveaxis(values, axis, -1), xp.moveaxis(first, axis, -1)
    find = _by_rank if values.shape[-1] <= FEW else _by_bisection
    return xp.moveaxis(find(values, first, count), -1, axis)


FEW = 128  # values of which each is compared with each


def _by_rank(values: Array, first: Array, count: int) -> Array:
    """Compare each with each; of equal ones the first is the smaller."""
    xp, order = namespace(values), np.arange(int(values.shape[-1]))
    one, other = values[..., :, None], values[..., None, :]
    rank = xp.sum(xp.astype((other < one) | ((other == one) & (order < order[:, None])), xp.int32), axis=-1)
    return xp.stack([xp.sum(xp.where(rank == first + i, values, 0.0), axis=-1) for i in range(count)], axis=-1)


def _by_bisection(values: Array, first: Array, count: int) -> Array:
    """Halve the range of the floats' bits, in which they are ordered, until one float is left."""
    xp, lax = namespace(values), sys.modules["jax"].lax  # it is loaded where values are JAX's, but not imported here
    kind = xp.int64 if values.dtype.itemsize == 8 else xp.int32
    limits = xp.iinfo(kind)
    bits = lax.bitcast_convert_type(lax.stop_gradient(values), kind)
    bits = xp.where(bits < 0, bits ^ limits.max, bits)

    def up_to(bound: Array) -> Array:
        return xp.sum(xp.astype(bits <= bound, xp.int32), axis=-1, keepdims=True)

    def halve(_: int, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = (low & high) + ((low ^ high) >> 1)
        enough = up_to(middle) > first
        return xp.where(enough, low, middle + 1), xp.where(enough, middle, high)

    ends = xp.full(first.shape, limits.min, kind), xp.full(first.shape, limits.max, kind)
    found = lax.fori_loop(0, limits.bits, halve, ends)[0]
    out: list[Array] = []
    for i in range(count):
        if i:
            following = xp.min(xp.where(bits > found, bits, limits.max), axis=-1, keepdims=True)
            found = xp.where(up_to(found) > first + i, found, following)
        out.append(xp.min(xp.where(bits == found, values, xp.finfo(values.dtype).max), axis=-1))
    return xp.stack(out, axis=-1)


def as_floats(field: str, array: Array) -> Array:
    """Return an array of floats, of at least single precision; whole numbers (stars) and truth values become floats.

    Examples:
        >>> as_floats("ratings", np.array([1, 5])).tolist()
        [1.0, 5.0]

    Raises:
        InvalidValueError: naming ``field``: it holds something else (text, objects, complex numbers), or is a masked
            array, whose mask would be lost.
    """
    if type(array) is np.ndarray and array.dtype.char in "df":
        return array  # nearly always
    xp = namespace(array)
    if isinstance(array, np.ma.MaskedArray) or not xp.isdtype(array.dtype, ("bool", "integral", "real floating")):
        kind = "a masked array" if isinstance(array, np.ma.MaskedArray) else array.dtype
        raise _checks.InvalidValueError(f"{field}.dtype", kind, "real numbers in a plain array")
    if not xp.isdtype(array.dtype, "real floating"):
        return xp.astype(array, xp.asarray(0.0).dtype)
    return xp.astype(array, xp.float32) if array.dtype.itemsize < 4 else array  # squares overflow beyond 256
