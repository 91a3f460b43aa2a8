"""Values that are no ratings: a failure that was written down as a number."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from uard.ratings.pairs import TELLING

if TYPE_CHECKING:
    from jaxtyping import Float


class Sentinel(NamedTuple):
    """A value that says something else than how good the row is.

    Attributes:
        value: The value.
        others: Mean rating of the other raters in its rows.
        line: What they say where this rater means what the value says, by the rater's other rows.
    """

    value: float
    others: float
    line: float


def others_of(ratings: Float[np.ndarray, "n K"]) -> Float[np.ndarray, "n K"]:
    """Return, for each rater, the mean rating of all others; NaN where nobody else has rated.

    Examples:
        >>> others_of(np.array([[1.0, 3.0, np.nan], [np.nan, 2.0, np.nan]])).tolist()
        [[3.0, 1.0, 2.0], [2.0, nan, 2.0]]

    Args:
        ratings: A column per rater, NaN where one is missing.
    """
    here = np.isfinite(ratings)
    beside = here.sum(1)[:, None] - here
    held = np.where(here, ratings, 0.0)
    return np.where(beside > 0, (held.sum(1)[:, None] - held) / np.maximum(beside, 1), np.nan)


def sentinels(ratings: Float[np.ndarray, "n K"], k: int, others: Float[np.ndarray, " n"]) -> list[Sentinel]:
    """Return the sentinel values of a rater.

    Of the rater's most frequent values, each in turn: a line of the others' mean rating on the rater's, fitted to the
    rows with other values, says what the others would say if the value were meant. It is not meant if they are nearer
    to what they say on average (by six tenths of the way at least), by more than noise, and hardly ever give it
    themselves; and if they find its rows better than those of the next higher values, or worse than those of the next
    lower ones: without that, a bend of the line would do.

    Examples:
        >>> random = np.random.default_rng(0)
        >>> truth = random.normal(3.0, 1.0, 200)
        >>> said = (truth[:, None] + 0.3 * random.normal(size=(200, 3))).round(1)
        >>> said[:20, 0] = 0.0  # it failed
        >>> [s.value for s in sentinels(said, 0, others_of(said)[:, 0])]
        [0.0]

    Args:
        ratings: A column per rater, NaN where one is missing.
        k: The rater's column.
        others: Mean rating of all others in each row, NaN where nobody else rated.
    """
    x, m = ratings[:, k], others
    both = np.isfinite(x) & np.isfinite(m)
    rows, x, m = np.flatnonzero(both), x[both], m[both]
    values, counts = np.unique(x, return_counts=True)
    often = np.argsort(-counts, kind="stable")[:10]
    often = often[counts[often] >= max(3, 0.002 * x.size)]
    found: list[Sentinel] = []
    for value in values[often]:
        at = x == value
        a, b = x[~at], m[~at]
        if a.size < 10 or a.var() == 0 or b.var() == 0:
            continue
        r = float(np.corrcoef(a, b)[0, 1])
        if r < 0.3 or r * np.sqrt(a.size) < TELLING:
            continue
        slope, c = r * b.std() / a.std(), int(at.sum())
        line, there, usual = b.mean() + slope * (value - a.mean()), float(m[at].mean()), float(b.mean())
        noise = float((b - b.mean() - slope * (a - a.mean())).std()) * np.sqrt(a.size / (a.size - 2))
        error = noise * np.sqrt(1.0 / c + 1.0 / a.size + (value - a.mean()) ** 2 / (a.size * a.var()))
        missed = (there - line) * np.sign(usual - line)
        if missed < 0.6 * abs(usual - line) or missed < max(5.0 * error, noise):
            continue
        if not _out_of_order(value, there, c, a, b, noise):
            continue
        beside = np.delete(ratings[rows[at]], k, 1)
        if (beside == value).sum() <= 0.25 * np.isfinite(beside).sum():
            found.append(Sentinel(float(value), there, float(line)))
    return found


def _out_of_order(
    value: float, there: float, count: int, x: Float[np.ndarray, " n"], others: Float[np.ndarray, " n"], noise: float
) -> bool:
    """Return whether others find a value's rows better than its next higher rows, or worse than its next lower ones.

    Args:
        value: The value.
        there: What others say of its rows on average.
        count: How many these are.
        x: This rater's other ratings.
        others: What others say of them.
        noise: Standard deviation of ``others`` about their line.
    """
    for sign in (1.0, -1.0):
        beyond = sign * (x - value)
        near = np.sort(beyond[beyond > 0])[: max(5, x.size // 10)]
        if near.size:
            rows = (beyond > 0) & (beyond <= near[-1])
            error = noise * np.sqrt(1.0 / count + 1.0 / rows.sum())
            if sign * (there - others[rows].mean()) > 3.0 * error:
                return True
    return False
