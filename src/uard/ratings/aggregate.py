"""From ratings to ``Feedback``: the only place where the ratings of several become a mean, a lowest, a deviation.

Pure functions of NumPy, JAX or torch arrays.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from uard import _checks
from uard.method import uncertainty
from uard.method.arrays import Array, as_floats, at_least, dot, filled_like, least, namespace, total
from uard.method.feedback import ByRater, Feedback

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Integer, Shaped


def aggregate(
    ratings: Shaped[Array, "*batch K"],
    proxy: Shaped[Array, "*batch"],
    mask: Bool[Array, "*batch K"] | None = None,
    ddof: int = 0,
) -> Feedback:
    """Return the feedback of one visit to each of some state-actions.

    Examples:
        >>> feedback = aggregate(np.array([[-1.0, 2.0, np.nan], [np.nan, np.nan, np.nan]]), np.array([4.0, 0.0]))
        >>> feedback.count.tolist(), feedback.mean.tolist(), feedback.lowest.tolist(), feedback.raters.tolist()
        ([1.0, 0.0], [0.5, 0.0], [-1.0, 0.0], [2.0, 0.0])

    Args:
        ratings: A column per rater, in reward units; stars and thumbs (truth values) become floats. Without a mask NaN
            is a missing rating; inside a JAX transformation, where NaN cannot be looked for, ratings without a mask
            are complete.
        proxy: The observed reward.
        mask: True where a rating exists; what is masked out may hold anything.
        ddof: Of the deviation, >= 0; a visit with no more ratings than that has a deviation of 0.

    Returns:
        Arrays (...); where nobody rated all numbers but ``proxy`` are 0.

    Raises:
        InvalidValueError: a rating or the proxy is infinite or so large that its square overflows, the proxy is NaN,
            shapes do not fit, there is no column, the mask is not of truth values, or something is no array of numbers.
    """
    for name, array in (("ratings", ratings), ("proxy", proxy), ("mask", mask)):
        if array is not None and not hasattr(array, "ndim"):
            raise _checks.InvalidValueError(name, array, "an array of NumPy, JAX or torch")
    if ratings.ndim == 0 or ratings.shape[-1] == 0 or tuple(ratings.shape[:-1]) != tuple(proxy.shape):
        allowed = f"({', '.join([*map(str, proxy.shape), 'K'])}): one row per reward and one column per rater"
        raise _checks.InvalidValueError("ratings.shape", tuple(ratings.shape), allowed)
    _checks.whole("ddof", ddof)
    ratings, proxy = as_floats("ratings", ratings), as_floats("proxy", proxy)
    _checks.moderate("proxy", proxy)
    if mask is not None:
        _checks.same_shape("mask", mask, "ratings", ratings)
        if not namespace(mask).isdtype(mask.dtype, "bool"):
            raise _checks.InvalidValueError("mask.dtype", mask.dtype, "truth values: True where a rating exists")
    elif not (_checks.is_small(ratings) or _checks.is_traced(ratings)):
        small = abs(ratings) <= _checks.largest(ratings)  # which NaN is not
        if not small.all():
            mask = ratings == ratings
    return _complete(ratings, proxy, ddof) if mask is None else _masked(ratings, proxy, mask, ddof)


def _complete(ratings: Float[Array, "*batch K"], proxy: Float[Array, "*batch"], ddof: int) -> Feedback:
    raters = ratings.shape[-1]
    mean = total(ratings) / raters
    one = filled_like(mean, 1.0)
    if raters > max(ddof, 1):
        gap = ratings - mean[..., None]
        sd = uncertainty.root(dot(gap, gap) / (raters - ddof))
    else:
        sd = 0.0 * one
    by_rater = ByRater(filled_like(ratings, 1.0), ratings, filled_like(ratings, 0.0))
    return Feedback(one, mean, least(ratings), sd, proxy, raters * one, by_rater)


def _masked(
    ratings: Float[Array, "*batch K"], proxy: Float[Array, "*batch"], mask: Bool[Array, "*batch K"], ddof: int
) -> Feedback:
    xp = namespace(ratings)
    here = xp.astype(mask, ratings.dtype)
    held = xp.where(mask, ratings, xp.zeros_like(ratings))
    _checks.moderate("ratings", held)
    raters = xp.sum(here, axis=-1)
    rated = raters > 0
    zero = xp.zeros_like(raters)
    # The sums of ``_complete``, to the bit: what a row gives may not depend on whether another row lacks a rating.
    mean = total(held) / xp.where(rated, raters, zero + 1.0)
    lowest = xp.min(xp.where(mask, ratings, xp.full_like(ratings, np.inf)), axis=-1)
    gap = here * (held - mean[..., None])
    square = dot(gap, gap)
    enough = raters > max(ddof, 1)
    sd = uncertainty.root(xp.where(enough, square / xp.where(enough, raters - ddof, zero + 1.0), zero))
    by_rater = ByRater(here, held, xp.zeros_like(held))
    return Feedback(xp.astype(rated, ratings.dtype), mean, xp.where(rated, lowest, zero), sd, proxy, raters, by_rater)


# What is kept of a state-action that comes again is one row of numbers, so that a training step reads and writes each
# table once: count, then the running means of mean, lowest, sd and proxy, then K counts, K means and K squared sums.
_SUMMARY, _BY_RATER = slice(1, 5), 5


def empty_rows(shape: tuple[int, ...], raters: int, xp: Any = np, dtype: Any = None) -> Float[Array, "*batch width"]:
    """Return rows (*shape, width) of state-actions that nobody has rated; see ``to_rows``.

    Examples:
        >>> from_rows(empty_rows((2,), raters=3)).count.tolist()
        [0.0, 0.0]

    Args:
        shape: Of the state-actions.
        raters: K, the columns of ``by_rater``.
        xp: The array namespace: ``numpy``, ``jax.numpy`` or torch's.
        dtype: Of the rows; the namespace's default if left out.
    """
    return xp.zeros((*shape, _BY_RATER + 3 * raters), dtype=dtype)


def to_rows(visit: Feedback) -> Float[Array, "*batch width"]:
    """Return feedback (...) as rows (..., 5 + 3 K), the form in which it is kept and merged.

    Examples:
        >>> visit = aggregate(np.array([[1.0, 3.0]]), np.array([2.0]))
        >>> to_rows(visit)[0, :5].tolist()  # count, mean, lowest, sd, proxy
        [1.0, 2.0, 1.0, 1.0, 2.0]
    """
    assert visit.by_rater is not None
    summary = (visit.count, visit.mean, visit.lowest, visit.sd, visit.proxy)
    return namespace(visit.mean).concat([*(x[..., None] for x in summary), *visit.by_rater], axis=-1)


def from_rows(rows: Float[Array, "*batch width"]) -> Feedback:
    """Return rows (..., 5 + 3 K) as feedback (...); see ``to_rows``.

    Examples:
        >>> visit = aggregate(np.array([[1.0, 3.0]]), np.array([2.0]))
        >>> from_rows(to_rows(visit)).raters.tolist()
        [2.0]
    """
    counts, means, squares = _columns(rows)
    by_rater = ByRater(rows[..., counts], rows[..., means], rows[..., squares])
    raters = (by_rater.count > 0).sum(-1, dtype=rows.dtype)
    return Feedback(rows[..., 0], rows[..., 1], rows[..., 2], rows[..., 3], rows[..., 4], raters, by_rater)


def _columns(rows: Float[Array, "*batch width"]) -> tuple[slice, slice, slice]:
    """Return where the raters' counts, means and squares are."""
    k = (rows.shape[-1] - _BY_RATER) // 3
    first, second = _BY_RATER + k, _BY_RATER + 2 * k
    return slice(_BY_RATER, first), slice(first, second), slice(second, None)


def merged(
    rows: Float[Array, "*batch width"], visit: Float[Array, "*batch width"], rated: Float[Array, "*batch"]
) -> Float[Array, "*batch width"]:
    """Return rows after one more visit; unchanged where ``rated`` is 0 and not 1.

    The visit's mean, lowest, deviation and observed reward enter running means; each rater's rating enters that
    rater's count, mean and squared deviations [Welford 1962].

    Examples:
        >>> first, second = (to_rows(aggregate(np.array([[x]]), np.array([0.0]))) for x in (1.0, 3.0))
        >>> from_rows(merged(first, second, np.ones(1))).mean.tolist()
        [2.0]

    Args:
        rows: What is known so far, see ``to_rows``.
        visit: The visit, alike.
        rated: Whether somebody rated it.
    """
    xp = namespace(rows, visit)
    count = rows[..., 0] + rated
    share = rated / at_least(count, 1.0)
    before = rows[..., _SUMMARY]
    summary = before + share[..., None] * (visit[..., _SUMMARY] - before)
    counts, means, squares = _columns(rows)
    before, rating = rows[..., means], visit[..., means]
    new = visit[..., counts] * rated[..., None]
    each = rows[..., counts] + new
    gap = rating - before
    mean = before + new / at_least(each, 1.0) * gap
    square = rows[..., squares] + new * gap * (rating - mean)
    return xp.concat([count[..., None], summary, each, mean, square], axis=-1)


def nothing(shape: tuple[int, ...], raters: int, xp: Any = np, dtype: Any = None) -> Feedback:
    """Return the feedback of state-actions that nobody has rated: arrays of that shape, all 0.

    Examples:
        >>> nothing((2,), raters=3).raters.tolist()
        [0.0, 0.0]

    Args:
        shape: Of the state-actions.
        raters: K, the columns of ``by_rater``.
        xp: The array namespace: ``numpy``, ``jax.numpy`` or torch's.
        dtype: Of the arrays; the namespace's default if left out.
    """
    by_rater = ByRater._make(xp.zeros((*shape, raters), dtype=dtype) for _ in range(3))
    return Feedback._make([*(xp.zeros(shape, dtype=dtype) for _ in range(6)), by_rater])


def by_item(visits: Feedback, item: Integer[np.ndarray, " n"]) -> Feedback:
    """Return what is known of every item after all visits to it, (M,) arrays (NumPy).

    Examples:
        >>> visits = aggregate(np.array([[1.0], [3.0], [5.0]]), np.zeros(3))
        >>> by_item(visits, np.array([0, 0, 1])).mean.tolist()
        [2.0, 5.0]

    Args:
        visits: (n,) arrays, as ``aggregate`` gives them.
        item: The number of each visit's item, in 0..M-1.
    """
    assert visits.by_rater is not None
    size, raters = int(item.max(initial=-1)) + 1, visits.by_rater.count.shape[-1]

    def total(column: Float[np.ndarray, " n"]) -> Float[np.ndarray, " M"]:
        return np.bincount(item, column, size).astype(float)  # of nothing it counts in whole numbers

    count = total(visits.count)
    each = ByRater._make(np.zeros((size, raters)) for _ in range(3))
    for k in range(raters):
        here, rating = visits.by_rater.count[:, k], visits.by_rater.mean[:, k]
        each.count[:, k] = total(here)
        each.mean[:, k] = total(here * rating) / np.maximum(each.count[:, k], 1.0)
        each.m2[:, k] = total(here * (rating - each.mean[item, k]) ** 2)
    of_all = (visits.mean, visits.lowest, visits.sd, visits.proxy)
    columns = [total(x * visits.count) / np.maximum(count, 1.0) for x in of_all]
    return Feedback._make([count, *columns, (each.count > 0).sum(-1).astype(float), each])
