"""How the scores of judges, each in a unit of its own, come to one scale: standard deviations of the judge."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float

EQUAL = 1e-9  # relative deviation at which numbers count as equal


@dataclass
class Scale:
    """Mean and standard deviation of all numbers so far, or fixed ones. Changed in place.

    Examples:
        >>> scale = Scale()
        >>> scale.observe(np.array([1.0, 3.0]))
        >>> scale.location, scale.deviation, scale.ratings(np.array([4.0])).tolist()
        (2.0, 1.0, [2.0])

    Attributes:
        count: Numbers so far.
        location: Their mean, in the judge's unit.
        square: Sum of their squared distances from it.
        fixed: The deviation that the user gave, > 0; None for the running one.
    """

    count: int = 0
    location: float = 0.0
    square: float = 0.0
    fixed: float | None = None

    @property
    def deviation(self) -> float:
        """Population standard deviation; 0 while all numbers are equal, up to rounding."""
        if self.fixed is not None:
            return self.fixed
        deviation = math.sqrt(self.square / self.count) if self.count else 0.0
        return deviation if deviation > EQUAL * abs(self.location) else 0.0

    def observe(self, values: Float[np.ndarray, "*any"]) -> None:
        """Take in some numbers, which must be finite [Chan et al. 1979]; a fixed scale does not change."""
        if self.fixed is not None or values.size == 0:
            return
        mean, total = float(values.mean()), self.count + values.size
        gap = mean - self.location
        self.square += float(((values - mean) ** 2).sum()) + gap * gap * self.count * values.size / total
        self.location += gap * values.size / total
        self.count = total

    def ratings(self, values: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
        """Return (x - location) / deviation; NaN while the deviation is 0, when numbers mean nothing."""
        return (values - self.location) / (self.deviation or math.nan)
