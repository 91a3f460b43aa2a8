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
