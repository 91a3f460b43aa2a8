"""From ratings to ``Feedback``: the only place where what several raters said becomes a mean, a lowest, a deviation.

Pure functions of NumPy, JAX or torch arrays.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from uard import _checks
from uard.method import uncertainty
from uard.method.arrays import Array, namespace
from uard.method.feedback import ByRater, Feedback


def aggregate(ratings: Array, proxy: Array, mask: Array | None = None, ddof: int = 0) -> Feedback:
    """Return the feedback of one visit to each of some state-actions.

        >>> import numpy as np
        >>> feedback = aggregate(np.array([[-1.0, 2.0, np.nan], [np.nan, np.nan, np.nan]]), np.array([4.0, 0.0]))
        >>> feedback.count.tolist(), feedback.mean.tolist(), feedback.lowest.tolist(), feedback.raters.tolist()
        ([1.0, 0.0], [0.5, 0.0], [-1.0, 0.0], [2.0, 0.0])

    Args:
        ratings: (..., K), a column per rater, in reward units. Without a mask NaN is a missing rating; inside a JAX
            transformation, where NaN cannot be looked for, ratings without a mask are complete.
        proxy: (...), the observed reward.
        mask: (..., K), True where a rating exists; what is masked out may hold anything.
        ddof: Of the deviation; a visit with no more ratings than that has a deviation of 0.

    Returns:
        Arrays (...); where nobody rated all numbers but ``proxy`` are 0.

    Raises:
        InvalidValueError: a rating is infinite, shapes do not fit, or there is no column.
    """
    if ratings.ndim == 0 or ratings.shape[-1] == 0 or tuple(ratings.shape[:-1]) != tuple(proxy.shape):
        allowed = f"({', '.join([*map(str, proxy.shape), 'K'])}): one row per reward and one column per rater"
        raise _checks.InvalidValueError("ratings.shape", tuple(ratings.shape), allowed)
    xp = namespace(ratings)
    if not xp.isdtype(ratings.dtype, "real floating"):  # stars and thumbs
        ratings = xp.astype(ratings, xp.asarray(0.0).dtype)
    if mask is not None:
        _checks.same_shape("mask", mask, "ratings", ratings)
    if mask is None and not _checks.is_traced(ratings):
        here = ratings == ratings
        mask = None if bool(here.all()) else here
    return _complete(ratings, proxy, ddof) if mask is None else _masked(ratings, proxy, mask, ddof)


def _complete(ratings: Array, proxy: Array, ddof: int) -> Feedback:
    xp = namespace(ratings)
    _checks.finite("ratings", ratings)
    raters = ratings.shape[-1]
    mean, lowest = xp.mean(ratings, axis=-1), xp.min(ratings, axis=-1)
    one = xp.ones_like(mean)
    sd = uncertainty.deviation(ratings, -1, ddof) if raters > max(ddof, 1) else 0.0 * one
    by_rater = ByRater(xp.ones_like(ratings), ratings, xp.zeros_like(ratings))
    return Feedback(one, mean, lowest, sd, proxy, raters * one, by_rater)


def _masked(ratings: Array, proxy: Array, mask: Array, ddof: int) -> Feedback:
    xp = namespace(ratings)
    here = xp.astype(mask, ratings.dtype)
    held = xp.where(mask, ratings, xp.zeros_like(ratings))
    _checks.finite("ratings", held)
    raters = xp.sum(here, axis=-1)
    rated = raters > 0
    zero = xp.zeros_like(raters)
    mean = xp.sum(held, axis=-1) / xp.where(rated, raters, zero + 1.0)
    lowest = xp.min(xp.where(mask, ratings, xp.full_like(ratings, np.inf)), axis=-1)
    square = xp.sum(here * (held - mean[..., None]) ** 2, axis=-1)
    enough = raters > max(ddof, 1)
    sd = uncertainty.root(xp.where(enough, square / xp.where(enough, raters - ddof, zero + 1.0), zero))
    by_rater = ByRater(here, held, xp.zeros_like(held))
    return Feedback(xp.astype(rated, ratings.dtype), mean, xp.where(rated, lowest, zero), sd, proxy, raters, by_rater)


# What is kept of a state-action that comes again is one row of numbers, so that a training step reads and writes each
# table once: count, then the running means of mean, lowest, sd and proxy, then K counts, K means and K squared sums.
_SUMMARY, _BY_RATER = slice(1, 5), 5


def empty_rows(shape: tuple[int, ...], raters: int, xp: Any = np, dtype: Any = None) -> Array:
    """Return rows (*shape, width) of state-actions that nobody has rated."""
    return xp.zeros((*shape, _BY_RATER + 3 * raters), dtype=dtype)


def to_rows(visit: Feedback) -> Array:
    """Return feedback (...) as rows (..., width)."""
    assert visit.by_rater is not None
    xp = namespace(visit.mean)
    summary = xp.stack([visit.count, visit.mean, visit.lowest, visit.sd, visit.proxy], axis=-1)
    return xp.concat([summary, *visit.by_rater], axis=-1)


def from_rows(rows: Array) -> Feedback:
    """Return rows (..., width) as feedback (...)."""
    k = (rows.shape[-1] - _BY_RATER) // 3
    by_rater = ByRater(*(rows[..., _BY_RATER + i * k : _BY_RATER + (i + 1) * k] for i in range(3)))
    heard = namespace(rows).astype(by_rater.count > 0, rows.dtype)
    summary = (rows[..., i] for i in range(_BY_RATER))
    return Feedback(*summary, namespace(rows).sum(heard, axis=-1), by_rater)


def merged(rows: Array, visit: Array, rated: Array) -> Array:
    """Return rows (..., width) after one more visit; unchanged where ``rated`` (...) is 0 and not 1.

    The visit's mean, lowest, deviation and observed reward enter running means; each rater's rating enters that
    rater's count, mean and squared deviations [Welford 1962].
    """
    xp = namespace(rows, visit)
    raters = (rows.shape[-1] - _BY_RATER) // 3
    count = rows[..., 0] + rated
    share = rated / xp.maximum(count, xp.ones_like(count))
    summary = rows[..., _SUMMARY] + share[..., None] * (visit[..., _SUMMARY] - rows[..., _SUMMARY])
    counts, means, squares = (slice(_BY_RATER + i * raters, _BY_RATER + (i + 1) * raters) for i in range(3))
    new = visit[..., counts] * rated[..., None]
    each = rows[..., counts] + new
    gap = visit[..., means] - rows[..., means]
    mean = rows[..., means] + new / xp.maximum(each, xp.ones_like(each)) * gap
    square = rows[..., squares] + new * gap * (visit[..., means] - mean)
    return xp.concat([count[..., None], summary, each, mean, square], axis=-1)


def nothing(shape: tuple[int, ...], raters: int, xp: Any = np, dtype: Any = None) -> Feedback:
    """Return the feedback of state-actions that nobody has rated: arrays of that shape, all 0.

    Args:
        shape: Of the state-actions.
        raters: Columns of ``by_rater``.
        xp: The array namespace: ``numpy``, ``jax.numpy`` or torch's.
        dtype: Of the arrays; the namespace's default if left out.
    """
    of_all = (xp.zeros(shape, dtype=dtype) for _ in range(6))
    return Feedback(*of_all, ByRater(*(xp.zeros((*shape, raters), dtype=dtype) for _ in range(3))))


def by_item(visits: Feedback, item: np.ndarray) -> Feedback:
    """Return what is known of every item after all visits to it, (M,) arrays (NumPy).

    Args:
        visits: (n,) arrays, as ``aggregate`` gives them.
        item: (n,), numbers of the visited items in 0..M-1.
    """
    assert visits.by_rater is not None
    size, raters = int(item.max(initial=-1)) + 1, visits.by_rater.count.shape[-1]
    count = np.bincount(item, visits.count, size)
    share = np.maximum(count, 1.0)

    def mean(column: np.ndarray) -> np.ndarray:
        return np.bincount(item, column * visits.count, size) / share

    each = ByRater(*(np.zeros((size, raters)) for _ in range(3)))
    for k in range(raters):
        here, rating = (x[:, k] for x in visits.by_rater[:2])
        each.count[:, k] = np.bincount(item, here, size)
        each.mean[:, k] = np.bincount(item, here * rating, size) / np.maximum(each.count[:, k], 1.0)
        each.m2[:, k] = np.bincount(item, here * (rating - each.mean[item, k]) ** 2, size)
    columns = (mean(x) for x in (visits.mean, visits.lowest, visits.sd, visits.proxy))
    return Feedback(count, *columns, (each.count > 0).sum(-1).astype(float), each)
