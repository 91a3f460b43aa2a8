"""What raters have in common on the rows that two of them rated, for all pairs at once."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float, Integer

CELLS = 2_000_000  # of a table whose raters are compared by pairs, at least 500 rows of it
MOST_RATERS = 2_000  # that are compared by pairs
EXACT = 1e-12  # of the largest: a spread below this is rounding
ENOUGH = 30  # rows that a correlation of two raters takes
FEWEST = 10  # rows that a mean or a spread of two raters takes
APART = 3.0  # times the scale of another rater: another unit
SHIFTED = 1.75  # standard deviations of both between their means: another unit
TELLING = 3.0  # standard errors of a correlation that two raters rate the same thing


class Shared(NamedTuple):
    """Statistics of every pair of raters over the rows that both rated; entry [i, j] is of rater i beside rater j.

    Attributes:
        rows: How many rows both rated.
        mean: Mean of rater i there.
        sd: Standard deviation of rater i there (divided by the number of rows).
        correlation: Of the two, in [-1, 1]; 0 where one of them is constant or there are fewer than 3 rows.
    """

    rows: Float[np.ndarray, "K K"]
    mean: Float[np.ndarray, "K K"]
    sd: Float[np.ndarray, "K K"]
    correlation: Float[np.ndarray, "K K"]


def sample_of_rows(n: int, raters: int) -> Integer[np.ndarray, " m"]:
    """Return rows at even distances, all of them in a small table: what comparing all pairs of raters can afford.

    Args:
        n: Rows of the table.
        raters: Its columns.
    """
    most = min(100_000, max(500, CELLS // max(raters, 1)))
    return np.unique(np.linspace(0, n - 1, min(n, most), dtype=int))


def sample_of_raters(raters: int) -> Integer[np.ndarray, " m"]:
    """Return raters at even distances, all of them if they are no more than ``MOST_RATERS``."""
    return np.unique(np.linspace(0, raters - 1, min(raters, MOST_RATERS), dtype=int))


def shared(ratings: Float[np.ndarray, "n K"]) -> Shared:
    """Return what every pair of raters has in common.

    Examples:
        >>> both = shared(np.array([[1.0, 10.0], [2.0, 20.0], [3.0, 30.0], [4.0, np.nan]]))
        >>> both.rows.tolist(), both.mean.round(6).tolist(), both.correlation.round(6).tolist()
        ([[4.0, 3.0], [3.0, 3.0]], [[2.5, 2.0], [20.0, 20.0]], [[1.0, 1.0], [1.0, 1.0]])

    Args:
        ratings: A column per rater, NaN where one is missing; no number beyond 1e100.
    """
    here = np.isfinite(ratings)
    held = np.where(here, ratings, 0.0)
    size = np.abs(held).max(0, initial=0.0)
    x = held / np.where(size > 0, size, 1.0)  # so that squares neither overflow nor vanish
    centre = x.sum(0) / np.maximum(here.sum(0), 1)
    x = np.where(here, x - centre, 0.0)
    spread = np.abs(x).max(0, initial=0.0)
    x = np.where(spread > EXACT, x / np.where(spread > EXACT, spread, 1.0), 0.0)
    if here.all():  # three products less, which are all the time that this takes
        rows = np.full((x.shape[1], x.shape[1]), float(len(x)))
        mean, square = (np.broadcast_to(y.mean(0)[:, None], rows.shape) for y in (x, x * x))
        some = np.maximum(rows, 1.0)
    else:
        weight = here.astype(float)
        rows = weight.T @ weight
        some = np.maximum(rows, 1.0)
        mean, square = (y.T @ weight / some for y in (x, x * x))
    variance = square - mean**2
    sd = np.sqrt(np.where(variance > EXACT, variance, 0.0))
    both = sd * sd.T
    defined = (both > 0) & (rows >= 3)
    covariance = x.T @ x / some - mean * mean.T
    correlation = np.clip(np.where(defined, covariance / np.where(defined, both, 1.0), 0.0), -1.0, 1.0)
    unit = (size * spread)[:, None]
    return Shared(rows, (size * centre)[:, None] + unit * mean, unit * sd, correlation)


def residuals(ratings: Float[np.ndarray, "n K"], against: Float[np.ndarray, "n p"]) -> Float[np.ndarray, "n K"]:
    """Return what is left of each rater's ratings after the best straight line on other columns.

    Bias and scale are the line's, so they are not in what is left.

    Examples:
        >>> residuals(np.array([[1.0], [3.0], [5.0], [9.0]]), np.array([[0.0], [1.0], [2.0], [4.0]])).round(6).tolist()
        [[0.0], [0.0], [0.0], [0.0]]

    Args:
        ratings: A column per rater, NaN where one is missing; no number beyond 1e100.
        against: The columns that the lines are on, NaN where one is not known.

    Returns:
        (n, K): NaN where a rating is missing or a column is not known, and of raters with too few rows for a line.
    """
    known = np.all(np.isfinite(against), axis=1)
    line = np.where(known[:, None], against, 0.0)
    line = line / np.maximum(np.abs(line).max(0, initial=0.0), 1e-100)
    design = np.column_stack([np.ones(len(line)), line])
    left = np.full(ratings.shape, np.nan)
    for k in range(ratings.shape[1]):
        rows = np.flatnonzero(known & np.isfinite(ratings[:, k]))
        if rows.size > design.shape[1]:
            x = ratings[rows, k]
            line_of_rater = cast("np.ndarray", np.linalg.lstsq(design[rows], x, rcond=None)[0])  # untyped
            error: np.ndarray = x - design[rows] @ line_of_rater
            left[rows, k] = np.where(np.abs(error).max() > 1e-9 * np.abs(x).max(), error, 0.0)
    return left


def units_of(both: Shared) -> Integer[np.ndarray, " K"] | None:
    """Return the number of each rater's unit, 0..U-1, -1 where it is not known; None if there is but one.

    Two raters who rate the same thing (their correlation on the rows that both rated is over three standard errors
    above 0) are in different units if their scales differ by a factor of over 3, or their means by over 1.75 standard
    deviations. How much noise each has is not known; but the slope of a regression of the wider on the narrower is
    no larger than the ratio of their scales, whatever the noise (Frisch 1934), so noise alone makes no unit.

    Examples:
        >>> stars = np.arange(20.0)
        >>> units_of(shared(np.column_stack([stars, 10 * stars, stars + 1]))).tolist()
        [0, 1, 0]
    """
    known = (both.rows >= FEWEST) & (both.correlation * np.sqrt(both.rows) > TELLING)
    np.fill_diagonal(known, False)
    narrow, wide = np.minimum(both.sd, both.sd.T), np.maximum(both.sd, both.sd.T)
    known &= narrow > 0
    slope = both.correlation * wide / np.where(known, narrow, 1.0)
    shift = np.abs(both.mean - both.mean.T) / np.where(known, np.hypot(narrow, wide) / np.sqrt(2.0), 1.0)
    apart = known & ((slope > APART) | (shift > SHIFTED))
    if not apart.any():
        return None
    unit = np.full(len(apart), -1)
    left = known.any(1)
    number = 0
    while left.any():  # connected parts of the graph of raters whom nothing sets apart
        part = np.zeros_like(left)
        part[int(np.argmax(left))] = True
        while (more := left & ~part & (~apart[part]).any(0)).any():
            part |= more
        unit[part], left, number = number, left & ~part, number + 1
    return unit if number > 1 else None


def line_between(both: Shared, of: int, to: Integer[np.ndarray, " m"]) -> tuple[float, float] | None:
    """Return slope and offset of the line that gives a rater's ratings the mean and the spread of others.

    Examples:
        >>> both = shared(np.column_stack([np.arange(20.0), 50 + 10 * np.arange(20.0)]))
        >>> [round(x, 6) for x in line_between(both, 1, np.array([0]))]
        [0.1, -5.0]

    Args:
        both: What they have in common.
        of: Number of the rater.
        to: Numbers of the others; the line is the mean of those to each of them.

    Returns:
        None where there are fewer than ten common rows with any, or the rater's answers are all equal there.
    """
    to = to[(both.rows[of, to] >= FEWEST) & (both.sd[of, to] > 0)]
    if not to.size:
        return None
    slope = float((both.sd[to, of] / both.sd[of, to]).mean())
    return slope, float((both.mean[to, of] - slope * both.mean[of, to]).mean())


def equal_share(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " n"], tolerance: float) -> float:
    """Return in which share of the rows that have both they are equal; 0 below 30 rows, or where b is constant.

    Examples:
        >>> equal_share(np.arange(40.0), np.arange(40.0) + 1e-9, tolerance=1e-6)
        1.0
    """
    both = np.isfinite(a) & np.isfinite(b)
    a, b = a[both], b[both]
    return float((np.abs(a - b) <= tolerance).mean()) if a.size >= ENOUGH and np.ptp(b) > 0 else 0.0
