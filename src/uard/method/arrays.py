"""One way to compute with NumPy, JAX and torch arrays alike; neither JAX nor torch is imported.

Signatures say shapes with jaxtyping: ``Float[Array, "*batch K"]`` is an array of floats whose last axis has K entries,
and a name means one size in all of a signature. The test run checks them. ``Numbers`` is an array of any shape or a
plain number; functions of several broadcast them.
"""

from __future__ import annotations

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
