"""Intervals of any statistic of items: the jackknife, which leaves out one group of items after the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from uard._support.columns import decimals

if TYPE_CHECKING:
    from jaxtyping import Float, Integer, Shaped

GROUPS = 25  # of items; each is left out once
FEWEST = 5  # groups, or items of one rater, below which there is no interval


class Estimate(NamedTuple):
    """A number, and the interval that holds what it estimates with a chance of 95 %.

    Attributes:
        value: The estimate.
        low: Lower end of its interval; None where too little is known for one.
        high: Upper end, likewise.
    """

    value: float
    low: float | None = None
    high: float | None = None

    def __format__(self, spec: str) -> str:
        """Return it as text, each number by ``spec``: ``1.20 [0.90, 1.50]``."""
        value = format(self.value, spec)
        if self.low is None or self.high is None:
            return value
        return f"{value} [{format(self.low, spec)}, {format(self.high, spec)}]"


def texts(estimates: Sequence[Estimate | None], sign: str = "") -> list[str]:
    """Return a column of estimates with equal precision; ``?`` where nothing is known.

    Examples:
        >>> texts([Estimate(8.021, 7.98, 8.049), None, Estimate(-0.5)])
        ['8.02 [7.98, 8.05]', '?', '-0.50']

    Args:
        estimates: Of one quantity.
        sign: ``+`` where a plus is to be written: of a difference.
    """
    known = [e for e in estimates if e is not None]
    widths = [e.high - e.low for e in known if e.low is not None and e.high is not None]
    spec = f"{sign}z.{decimals((e.value for e in known), widths)}f"
    return ["?" if e is None else format(e, spec) for e in estimates]


def jackknife(
    statistic: Callable[[Integer[np.ndarray, " m"]], Float[np.ndarray, " k"]], unit: Shaped[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Return statistics of all rows and their standard errors, NaN where one cannot be told (Shao and Wu 1989).

    Units (items, or questions with several answers) are put into at most 25 groups at random, with a fixed seed, and
    each group is left out once. Beside the bootstrap this takes few evaluations, and with Student's t the intervals
    hold with few items too.

    Examples:
        >>> x = np.array([1.0, 2.0, 3.0, 4.0, 5.0])
        >>> value, error = jackknife(lambda rows: x[rows].mean(keepdims=True), np.arange(5))
        >>> value.tolist(), error.round(4).tolist()  # the standard deviation over the root of five
        ([3.0], [0.7071])

    Args:
        statistic: Of rows, by their numbers; NaN where it is not defined.
        unit: What each row belongs to; rows of one unit are left out together.
    """
    labels, number = np.unique(unit, return_inverse=True)
    groups = min(labels.size, GROUPS)
    group = (np.random.default_rng(0).permutation(labels.size) % max(groups, 1))[number]
    value = statistic(np.arange(len(unit)))
    if groups < FEWEST:
        return value, np.full_like(value, np.nan)
    left = np.array([statistic(np.flatnonzero(group != g)) for g in range(groups)])
    return value, np.sqrt((groups - 1) / groups * ((left - left.mean(0)) ** 2).sum(0))


def interval(value: float, error: float, units: int) -> Estimate | None:
    """Return an estimate with its interval by Student's t.

    Examples:
        >>> f"{interval(3.0, 0.7071, units=5):.2f}"
        '3.00 [1.04, 4.96]'

    Args:
        value: NaN where it is not defined.
        error: Its standard error; NaN where it cannot be told.
        units: How many units it rests on; below five there is no interval.

    Returns:
        None where the value is not defined.
    """
    if not np.isfinite(value):
        return None
    freedom = min(units, GROUPS) - 1
    if not np.isfinite(error) or freedom < FEWEST - 1:
        return Estimate(float(value))
    half = t_quantile(freedom) * float(error)
    return Estimate(float(value), float(value) - half, float(value) + half)


def t_quantile(freedom: int) -> float:
    """Return the 97.5 % quantile of Student's t, to 0.01 from four degrees of freedom on [Abramowitz, Stegun 26.7.5].

    Examples:
        >>> round(t_quantile(5), 2), round(t_quantile(24), 3)
        (2.57, 2.064)
    """
    z, n = 1.959964, float(freedom)
    first = (z**3 + z) / 4
    second = (5 * z**5 + 16 * z**3 + 3 * z) / 96
    third = (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384
    return z + first / n + second / n**2 + third / n**3
