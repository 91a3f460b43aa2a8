"""One way to compute with NumPy, JAX and torch arrays alike; neither JAX nor torch is imported.

Signatures say shapes with jaxtyping: ``Float[Array, "*batch K"]`` is an array of floats whose last axis has K entries,
and a name means one size in all of a signature. The test run checks them. ``Numbers`` is an array of any shape or a
plain number; functions of several broadcast them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from array_api_compat import array_namespace

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
