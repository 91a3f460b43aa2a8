"""What each of several things is worth, from answers about pairs of them: Bradley and Terry's model."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float, Integer

PASSES = 200
ENOUGH = 1e-4  # change of a worth in a pass below which the fit has ended


def worth(
    first: Integer[np.ndarray, " m"],
    second: Integer[np.ndarray, " m"],
    wins: Float[np.ndarray, " m"],
    cases: Float[np.ndarray, " m"],
    size: int,
) -> Float[np.ndarray, " n"]:
    """Return the worth of each of n things, as the logarithm of its strength.

    Hunter's minorisation [2004]. Each thing has also tied once with one of strength 1, so that what has won or lost
    every time has a finite worth, and what was never compared has 0.

    Examples:
        >>> first, second = np.array([0, 1]), np.array([1, 2])
        >>> found = worth(first, second, wins=np.array([3.0, 2.0]), cases=np.array([4.0, 4.0]), size=4)
        >>> bool(found[0] > found[1]), found[3].item()
        (True, 0.0)

    Args:
        first: Of every pair the number of one, in 0..n-1.
        second: The number of the other.
        wins: How often the first was preferred, ties counted half.
        cases: How often the pair was judged.
        size: n.
    """
    strength = np.ones(size)
    won = 0.5 + np.bincount(first, wins, size) + np.bincount(second, cases - wins, size)
    for _ in range(PASSES):
        share = cases / (strength[first] + strength[second])
        against = np.bincount(first, share, size) + np.bincount(second, share, size) + 1.0 / (strength + 1.0)
        new = won / against
        change = np.abs(np.log(new / strength)).max(initial=0.0)
        strength = new
        if change < ENOUGH:
            break
    return np.log(strength)
