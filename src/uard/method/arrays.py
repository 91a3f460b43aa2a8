"""One way to compute with NumPy, JAX and torch arrays alike; neither JAX nor torch is imported."""

from __future__ import annotations

from typing import Any

import numpy as np
from array_api_compat import array_namespace

Array = Any
_NUMPY = (np.ndarray, np.generic)


def namespace(*arrays: Array) -> Any:
    """Return the array namespace of the arguments; plain numbers are NumPy's, and NumPy's give way to others."""
    others = [a for a in arrays if hasattr(a, "shape") and not isinstance(a, _NUMPY)]
    return array_namespace(*others) if others else np


def where(condition: Array, yes: Array, no: Array) -> Array:
    """Choose elementwise; ``yes`` and ``no`` may be plain numbers."""
    return namespace(condition, yes, no).where(condition, yes, no)
