"""The two sources of doubt: an ensemble's disagreement and annotators' disagreement (A12-A18).

Pure functions of NumPy, JAX or torch arrays. All sigmas carry the unit of the reward.
"""

from __future__ import annotations

import contextlib
import math
import warnings
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from uard import _checks
from uard.method.arrays import Array, Numbers, as_floats, namespace, where

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


_NUMPY: tuple[type[Any], ...] = (np.ndarray, np.generic)


class OneAnnotatorWarning(UserWarning):
    """sigma_h of a single annotator is 0 everywhere, which means blind trust."""


def sigma_model(values: Array, axis: int = -1, ddof: int = 1) -> Array:
    """sigma_m: standard deviation over the members of an ensemble (A12, A17).

    Examples:
        >>> float(sigma_model([1.0, 3.0, 5.0]))
        2.0

    Args:
        values: Estimates of the members, e.g. (..., N) with N members on ``axis``; a list will do.
        axis: The axis of the members.
        ddof: 1 for the paper's 1/(N-1), 0 for 1/N.

    Returns:
        An array without that axis, in the unit of the values.

    Raises:
        InvalidValueError: if a value is not finite, its square is not, or there are no more than ``ddof`` members.
    """
    _checks.whole("ddof", ddof)
    values = _floats("values", values)
    _enough("members", values.shape[axis] if values.ndim else 0, ddof)
    _checks.moderate("values", values)
    return deviation(values, axis, ddof)


def sigma_human(
    ratings: Array,
    axis: int = -1,
    ddof: int = 0,
    mask: Array | None = None,
    empty: float | None = None,
) -> Array:
    """sigma_h: standard deviation over the annotators' ratings of one state-action (A14, A18).

    Examples:
        >>> round(float(sigma_human([-1.0, 2.0, 1.0])), 4)
        1.2472
        >>> float(sigma_human([-1.0, 2.0, 7.0], mask=[True, False, True]))
        4.0

    Args:
        ratings: Ratings, e.g. (..., K) with K annotators on ``axis``; a list will do.
        axis: The axis of the annotators.
        ddof: 0, the population form, is what the paper's number 1.247 needs ({-1, 2, 1}); its equation (A14)
            prints 1.
        mask: True where a rating exists; same shape. Masked-out entries may hold anything, NaN included.
        empty: What to return where no more than ``ddof`` ratings exist. Without it such a place is an error (NaN
            inside a JAX transformation, which can raise none).

    Returns:
        An array without that axis, in the unit of the ratings; of single precision for ratings of half.

    Raises:
        InvalidValueError: for NaN, infinity or ``None`` where a rating should be, a mask of another shape, no
            annotators at all, or places without ratings and no ``empty``.

    Warns:
        OneAnnotatorWarning: a single annotator never disagrees with itself.
    """
    _checks.whole("ddof", ddof)
    if mask is not None and not hasattr(mask, "shape"):
        mask = _checks.as_numpy("mask", mask)
    ratings = _floats("ratings", ratings, mask)
    raters = ratings.shape[axis] if ratings.ndim else 0
    if raters == 0:
        raise _checks.InvalidValueError("ratings.shape", tuple(ratings.shape), "at least one annotator on the axis")
    if raters == 1:
        warnings.warn(
            "one annotator: sigma_h is 0 everywhere, which means blind trust in the reward; "
            "count the observed reward as one more rater (uncertainty.with_proxy)",
            OneAnnotatorWarning,
            stacklevel=2,
        )
    if mask is None:
        _checks.moderate("ratings", ratings)
        if raters <= ddof:
            if empty is None:
                _enough("annotators", raters, ddof)
            return namespace(ratings).sum(ratings * 0.0, axis=axis) + empty
        return deviation(ratings, axis, ddof)
    xp = namespace(ratings, mask)
    ratings, here = xp.asarray(ratings), xp.asarray(mask)
    _checks.same_shape("mask", here, "ratings", ratings)
    if not xp.isdtype(here.dtype, "bool"):
        if not _checks.is_traced(here) and bool(xp.any((here != 0) & (here != 1))):
            raise _checks.InvalidValueError("mask", mask, "truth values, or 0 and 1")
        here = here != 0
    return _masked_std(ratings, here, axis, ddof, empty)


def _floats(field: str, values: Any, mask: Array | None = None) -> Float[Array, "*rest"]:
    """Return an array of floats: lists become NumPy's, integers (stars, thumbs) become floats."""
    if not hasattr(values, "shape") or (isinstance(values, _NUMPY) and values.dtype.kind != "f"):
        if mask is not None:
            with contextlib.suppress(ValueError):  # rows of unequal length: the check below says so
                cells = np.asarray(values, dtype=object)
                values = np.where(mask, cells, 0.0).tolist() if cells.shape == np.shape(mask) else values
        return _checks.as_numpy(field, values)
    return as_floats(field, values)


def deviation(values: Float[Array, "*any"], axis: int, ddof: int) -> Float[Array, "*rest"]:
    """Standard deviation along an axis, nothing checked; its gradient where all agree is 0, see ``root``.

    Examples:
        >>> deviation(np.array([[1.0, 3.0], [2.0, 2.0]]), axis=-1, ddof=0).tolist()
        [1.0, 0.0]
    """
    xp = namespace(values)
    size = values.shape[axis]
    gap = values - xp.sum(values, axis=axis, keepdims=True) / size
    return root(xp.sum(gap * gap, axis=axis) / (size - ddof))


def root(variance: Float[Array, "*any"]) -> Float[Array, "*any"]:
    """Return the square root; its gradient where all agree is 0, not infinite: an actor may climb a score of it.

    Examples:
        >>> root(np.array([0.0, 4.0])).tolist()
        [0.0, 2.0]
    """
    xp = namespace(variance)
    if xp is np:
        return np.sqrt(variance)  # the same number; NumPy knows no gradients
    agreed = xp.astype(variance == 0, variance.dtype)
    return xp.sqrt(variance + agreed) - agreed


def _masked_std(
    ratings: Float[Array, "*any"], mask: Bool[Array, "*any"], axis: int, ddof: int, empty: float | None
) -> Float[Array, "*rest"]:
    xp = namespace(ratings)
    values = xp.where(mask, ratings, xp.zeros_like(ratings))
    _checks.moderate("ratings", values)
    here = xp.astype(mask, ratings.dtype)
    count = xp.sum(here, axis=axis, keepdims=True)
    few = count <= ddof
    if empty is None and not _checks.is_traced(few) and bool(xp.any(few)):
        raise _checks.InvalidValueError(
            "mask", "a place with too few ratings", f"more than {ddof} everywhere, or give empty="
        )
    one = xp.ones_like(count)
    centre = xp.sum(values, axis=axis, keepdims=True) / xp.where(count > 0, count, one)
    square = xp.where(mask, (values - centre) * (values - centre), xp.zeros_like(values))
    variance = xp.sum(square, axis=axis, keepdims=True) / xp.where(few, one, count - ddof)
    sigma = xp.where(few, one * (math.nan if empty is None else empty), root(variance))
    return xp.squeeze(sigma, axis=axis)


def _enough(what: str, count: int, ddof: int) -> None:
    if count <= ddof:
        raise _checks.InvalidValueError(f"number of {what}", count, f"more than ddof = {ddof}")


def with_proxy(mean: Numbers, sigma: Numbers, proxy: Numbers, raters: Numbers) -> Array:
    """sigma_h over K ratings *and* the observed reward, the proxy counted as one more rater.

    The population standard deviation of the union, from its parts: with K ratings of mean m and deviation s,
    var = K/(K+1) s^2 + K/(K+1)^2 (m - r)^2. Its second term is the plainest sign that a reward lies.

    Examples:
        >>> with_proxy(mean=1.0, sigma=0.0, proxy=4.0, raters=2)  # the deviation of {1, 1, 4}
        1.4142135623730951

    Args:
        mean: Mean rating m, in reward units.
        sigma: Population deviation s of the ratings, in reward units, >= 0.
        proxy: Observed reward r, in reward units.
        raters: Number of annotators K >= 1.

    Returns:
        The deviation in reward units, of the shape that all broadcast to.
    """
    union = raters + 1.0
    share = raters / union
    gap = mean - proxy
    variance = share * (sigma * sigma) + share / union * (gap * gap)
    return namespace(variance).sqrt(variance) if hasattr(variance, "shape") else variance**0.5


def shrink(sigma: Numbers, count: Numbers, prior: Numbers, strength: Numbers = 1.0) -> Array:
    """(n sigma + n0 prior) / (n + n0): a statistic of few ratings, drawn towards its mean over all state-actions.

    Examples:
        >>> shrink(sigma=4.0, count=3, prior=0.0, strength=1.0)
        3.0

    Args:
        sigma: Estimate from ``count`` rated visits; means nothing (may be NaN) where that is 0.
        count: Number of rated visits n >= 0.
        prior: What is expected without any rating, e.g. the mean over all state-actions.
        strength: Pseudo-count n0 >= 0; with n0 = 0 nothing is shrunk (and n = 0 gives the prior).

    Returns:
        A number between estimate and prior, of the shape that all broadcast to.
    """
    total = count + strength
    if not hasattr(total, "shape"):
        return prior if count == 0 else (count * sigma + strength * prior) / total
    n = count + 0.0 * strength  # an array, even if only the strength is one
    known = where(n > 0, n * sigma, 0.0) + strength * prior
    if isinstance(strength, float) and strength > 0:  # then the total is nowhere 0
        return known / total
    xp = namespace(total, sigma)
    return xp.where(total > 0, known / xp.where(total > 0, total, xp.ones_like(total)), prior + 0.0 * total)


class Location(NamedTuple):
    """Mean and mean absolute deviation of a quantity over distinct state-actions, in its unit."""

    location: Float[Array, ""] | float
    mad: Float[Array, ""] | float


def location_and_mad(values: Float[Array, "*batch"], mask: Bool[Array, "*batch"]) -> Location:
    """Mean and mean absolute deviation of the masked-in values; both 0 if there are none.

    Taken over *distinct* state-actions: an agent that sits in a trap must not dilute its own alarm.

    Examples:
        >>> [float(x) for x in location_and_mad(np.array([1.0, 3.0, 99.0]), np.array([True, True, False]))]
        [2.0, 1.0]

    Args:
        values: One per state-action; what is masked out may hold anything.
        mask: Which of them count.
    """
    location = masked_mean(values, mask)
    return Location(location, masked_mean(abs(values - location), mask))


def masked_mean(values: Float[Array, "*batch"], mask: Bool[Array, "*batch"]) -> Float[Array, ""]:
    """Mean of the masked-in values, 0 if there are none; what is masked out may hold anything.

    Examples:
        >>> float(masked_mean(np.array([1.0, 3.0, 99.0]), np.array([True, True, False])))
        2.0
    """
    xp = namespace(values)
    zero = xp.zeros_like(values)
    count = xp.sum(xp.astype(mask, values.dtype))
    return xp.sum(xp.where(mask, values, zero)) / xp.where(count > 0, count, xp.ones_like(count))
