"""How the scores of judges, each in a unit of its own, come to one scale: standard deviations of the judge."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float

EQUAL = 1e-9  # relative deviation at which numbers count as equal
FAR = 10.0  # standard deviations from the mean at which a number is cut off before it enters the scale
FARTHEST = 32  # one in so many numbers may be an accident
ABSURD = 100.0  # standard deviations from the mean beyond which a number is reported
FEW = 7  # numbers; the deviation of fewer says too little to call another one absurd
CHANGED = 3  # calls in a row with most numbers cut off, after which the judge has a new scale
LARGEST = 1e300  # larger numbers are taken for this one, so that sums are finite


class Moments(NamedTuple):
    """Of numbers in the unit of a judge.

    Attributes:
        number: How many.
        mean: Their mean; 0 of none.
        sd: Their population standard deviation, rounding included; 0 of none.
    """

    number: int = 0
    mean: float = 0.0
    sd: float = 0.0

    @property
    def deviation(self) -> float:
        """The standard deviation; 0 while all numbers are equal up to rounding."""
        return self.sd if self.sd > EQUAL * abs(self.mean) else 0.0

    def including(self, values: Float[np.ndarray, " n"]) -> Moments:
        """Return the moments of these and more numbers, without squares that overflow [Chan et al. 1979]."""
        if values.size == 0:
            return self
        mean, total = float(values.mean()), self.number + values.size
        size = float(abs(values - mean).max())
        sd = size * math.sqrt(float((((values - mean) / size) ** 2).mean())) if size else 0.0
        old, new, gap = self.number / total, values.size / total, mean - self.mean
        sd = math.hypot(math.sqrt(old) * self.sd, math.sqrt(new) * sd, math.sqrt(old * new) * gap)
        return Moments(total, self.mean + gap * new, sd)


NONE = Moments()


@dataclass
class Scale:
    """Mean and standard deviation of all numbers so far, or fixed ones. Changed in place.

    One absurd number must not silence a judge for the rest of a run, so a number enters as at most 10 standard
    deviations from the mean. While there is no deviation yet, that of the new numbers counts, without the farthest of
    them (1 in 32, at least one); where more than these would be cut off, they are no accidents, such as the few ones of
    a judge that says 0 nearly always, and all count. The only number so far that differs from all others is looked at
    again with the next ones. Where most numbers of three calls in a row are cut off, the judge has changed its unit:
    the scale starts again from the third.

    Examples:
        >>> scale = Scale()
        >>> absurd = scale.observe(np.array([1.0, 3.0]))
        >>> scale.location, scale.deviation, scale.ratings(np.array([4.0])).tolist()
        (2.0, 1.0, [2.0])

    Attributes:
        known: Moments of the numbers so far, without ``lone``; of a fixed scale only the mean counts.
        lone: The only number so far that differs from all others; None if there is none, or more than one.
        far: Calls in a row, up to now, in which most numbers were cut off.
        fixed: The deviation that the user gave, > 0; None for the running one.
    """

    known: Moments = NONE
    lone: float | None = None
    far: int = 0
    fixed: float | None = None

    @property
    def location(self) -> float:
        """Mean of all numbers so far, in the judge's unit."""
        return self._all().mean

    @property
    def deviation(self) -> float:
        """Population standard deviation; 0 while all numbers are equal, up to rounding."""
        return self._all().deviation if self.fixed is None else self.fixed

    def observe(self, values: Float[np.ndarray, "*any"]) -> Float[np.ndarray, " absurd"]:
        """Take in some numbers, which must be finite; a fixed scale does not change.

        Returns:
            Those more than 100 standard deviations from the mean, if these are given or known of at least 7 numbers.
        """
        none = np.empty(0)
        if values.size == 0:
            return none
        if self.fixed is not None:
            return values[abs(_held(values) - self.known.mean) > ABSURD * self.fixed]
        given = np.sort(values if self.lone is None else np.append(values, self.lone), axis=None)
        new, base, self.lone = _held(given), self.known, None
        if base.deviation == 0:
            base = base.including(_ordinary(new, base.mean if base.number else float(np.median(new))))
            odd = abs(new - base.mean) > EQUAL * abs(base.mean)
            if base.deviation == 0 and base.number and odd.sum() == 1:
                self.known, self.lone = self.known.including(new[~odd]), float(given[odd][0])
                return none
        unit, distance = base.deviation or math.inf, abs(new - base.mean)
        self.far = self.far + 1 if 2 * (distance > FAR * unit).sum() > new.size else 0
        if self.far >= CHANGED and NONE.including(new).deviation > 0:
            self.known, self.far = NONE, 0
            return self.observe(given)
        self.known = self.known.including(np.clip(new, base.mean - FAR * unit, base.mean + FAR * unit))
        return given[distance > ABSURD * unit] if base.number >= FEW else none

    def ratings(self, values: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
        """Return (x - location) / deviation; NaN while the deviation is 0, when numbers mean nothing."""
        with np.errstate(over="ignore"):  # a rating too large for a number is infinite
            return (values - self.location) / (self.deviation or math.nan)

    def _all(self) -> Moments:
        return self.known if self.lone is None else self.known.including(_held(np.array([self.lone])))


def _ordinary(values: Float[np.ndarray, " n"], centre: float) -> Float[np.ndarray, " ordinary"]:
    """Return numbers without the farthest of them, unless those that are far from the rest are too many for that."""
    few = max(1, values.size // FARTHEST)
    nearest = values[np.argsort(abs(values - centre), kind="stable")[:-few]]
    of_nearest = NONE.including(nearest)
    far = abs(values - of_nearest.mean) > FAR * of_nearest.deviation
    return values if of_nearest.deviation > 0 and far.sum() > few else nearest


def _held(values: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    return np.clip(values, -LARGEST, LARGEST)
