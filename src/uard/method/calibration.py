"""Does the weight tell the truth? Is |proxy - true| really increasing in sigma (A15)?

NumPy functions for evaluation: they read the true reward, so no agent may call them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uard import _checks

if TYPE_CHECKING:
    from jaxtyping import Float


def _pair(name_a: str, a: object, name_b: str, b: object) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    x, y = _checks.as_numpy(name_a, a), _checks.as_numpy(name_b, b)
    _checks.finite(name_a, x)
    _checks.finite(name_b, y)
    _checks.same_shape(name_a, x, name_b, y)
    if x.size < 2:
        raise _checks.InvalidValueError(f"{name_a}.size", x.size, ">= 2")
    return x.ravel(), y.ravel()


def _ranks(x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    _, inverse, counts = np.unique(x, return_inverse=True, return_counts=True)
    ends = np.cumsum(counts)
    return (ends - (counts - 1) / 2.0)[inverse]


def spearman(sigma: object, error: object) -> float:
    """Rank correlation of sigma and |error| in [-1, 1], ties averaged; 0 if either is constant.

    Examples:
        >>> spearman(sigma=[0.1, 0.2, 0.9], error=[0.0, 1.0, 5.0])
        1.0

    Args:
        sigma: Uncertainties, at least two, an array of any shape or a list.
        error: |proxy - true| of the same state-actions, of the same shape.

    Raises:
        InvalidValueError: for other shapes, fewer than two numbers, or one that is not finite.
    """
    x, y = _pair("sigma", sigma, "error", error)
    a, b = _ranks(x), _ranks(y)
    a, b = a - a.mean(), b - b.mean()
    scale = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / scale) if scale > 0 else 0.0


def auroc(score: object, hack: object) -> float:
    """Chance in [0, 1] that a hack gets a higher score (e.g. 1 - w) than an honest step, ties counted half.

    Examples:
        >>> auroc(score=[0.9, 0.2, 0.1], hack=[True, False, False])
        1.0

    Args:
        score: At least two numbers, an array of any shape or a list.
        hack: Which of them are hacks (bool), of the same shape.

    Raises:
        InvalidValueError: for other shapes, fewer than two numbers, one that is not finite, no hack or nothing but
            hacks.
    """
    x, y = _pair("score", score, "hack", hack)
    positive = y > 0.5
    hits, rest = int(positive.sum()), int((~positive).sum())
    if hits == 0 or rest == 0:
        raise _checks.InvalidValueError("hack", f"{hits} of {x.size} true", "of both kinds")
    return float((_ranks(x)[positive].sum() - hits * (hits + 1) / 2) / (hits * rest))
