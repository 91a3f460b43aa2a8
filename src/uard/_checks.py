"""Checks of what users hand in: every error names the field, the value and what is allowed."""

from __future__ import annotations

import difflib
import math
import re
import sys
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar, cast

import numpy as np

T = TypeVar("T")

LARGEST = 1e100
"""What a reward, a rating or a disagreement may be at most, so that squares and sums of squares are numbers too."""
LARGEST_SINGLE = 1e15
"""The same where numbers are held in single precision."""


class InvalidValueError(ValueError):
    """A value that the library cannot work with; the message names field, value and what is allowed."""

    def __init__(self, field: str, value: object, allowed: str):
        """Say that ``field`` has ``value`` but must be ``allowed``."""
        super().__init__(f"{field} = {short(value)}: must be {allowed}")
        self.field = field


class UnknownNameError(InvalidValueError):
    """A name that is not in the list; the message suggests the nearest one."""

    def __init__(self, field: str, value: str, known: Iterable[str]):
        """Say that ``value`` is no ``field`` and which of the ``known`` names comes nearest."""
        names = sorted(known)
        near = difflib.get_close_matches(value.lower(), names, n=1, cutoff=0.5) if isinstance(value, str) else ()
        hint = f" (did you mean {near[0]!r}?)" if near else ""
        super().__init__(field, value, f"one of {', '.join(names)}{hint}" if names else "left out: there is none")


def short(value: object) -> str:
    """Return the value as text of at most 200 characters."""
    try:
        text = repr(value)
    except (Exception, SystemExit):  # of somebody else's class; of an int of 5000 digits
        text = f"<{type(value).__name__}>"
    return text if len(text) <= 200 else text[:197] + "..."  # a path must be legible


def is_frozen(value: object) -> bool:
    """Whether ``value`` is a frozen dataclass."""
    parameters = getattr(type(value), "__dataclass_params__", None)
    return parameters is not None and parameters.frozen


def not_frozen(value: object, kind: type) -> str | None:
    """Say what ``value`` must be if it is no frozen dataclass of a class; None if it is one."""
    if isinstance(value, kind) and is_frozen(value):
        return None
    article = "an" if kind.__name__[0] in "AE" else "a"
    hint = f", and this is a class: {value.__name__}(...) makes one" if isinstance(value, type) else ""
    return f"a frozen dataclass that is {article} {kind.__name__}{hint}"


def choose(field: str, value: str, known: Iterable[str]) -> str:
    """Return ``value`` if it is among the ``known`` names.

    Raises:
        UnknownNameError: with the nearest known name.
    """
    names = list(known)
    if not isinstance(value, str) or value not in names:  # "in" would compare an array place by place
        raise UnknownNameError(field, value, names)
    return value


def instance(field: str, value: object, kind: type[T], allowed: str) -> T:
    """Return ``value`` if it is of a class; else the error says what is ``allowed``."""
    if not isinstance(value, kind):
        raise InvalidValueError(field, value, allowed)
    return value


def text(field: str, value: object) -> str:
    """Return text as a plain ``str``; refuse what no page and no file can hold.

    Raises:
        InvalidValueError: it is no text, or has a NUL or half of a surrogate pair in it.
    """
    if not isinstance(value, str) or re.search("[\0\ud800-\udfff]", value):
        raise InvalidValueError(field, value, "text without NUL and without half of a surrogate pair")
    return str(value)  # of a subclass that calls itself HTML, too


def number(
    field: str,
    value: Any,
    *,
    low: float = -math.inf,
    high: float = math.inf,
    open_low: bool = False,
) -> None:
    """Check that ``value`` is a finite real number in ``[low, high]`` (``(low, high]`` if ``open_low``).

    Arrays without dimensions are numbers too.

    Values that are being traced by JAX pass unchecked: they were checked before tracing.
    """
    if type(value) is float and low < value <= high and value < math.inf:
        return  # nearly always
    if is_traced(value):
        return
    plain = _plain(value)
    good = isinstance(plain, int | float | np.floating) and not isinstance(plain, bool)
    good = good and abs(plain) <= sys.float_info.max and low <= plain <= high and not (open_low and plain == low)
    if not good:
        raise InvalidValueError(field, value, _interval("a finite number", low, high, open_low))


def truth(field: str, value: object) -> None:
    """Check that ``value`` is true or false; text and numbers would count as true."""
    if not isinstance(value, bool | np.bool_):
        raise InvalidValueError(field, value, "true or false")


def _plain(value: Any) -> Any:
    return value.item() if getattr(value, "shape", None) == () else value


def whole(field: str, value: Any, *, low: float = 0, high: float = math.inf) -> None:
    """Check that ``value`` is an integer in ``[low, high]``."""
    good = isinstance(value, int | np.integer) and not isinstance(value, bool) and low <= value <= high
    if not good:
        raise InvalidValueError(field, value, _interval("a whole number", low, high, False))


def _interval(kind: str, low: float, high: float, open_low: bool) -> str:
    if low == -math.inf and high == math.inf:
        return kind
    if high == math.inf:
        return f"{kind} {'>' if open_low else '>='} {low:g}"
    if low == -math.inf:
        return f"{kind} <= {high:g}"
    return f"{kind} in {'(' if open_low else '['}{low:g}, {high:g}]"


def is_traced(value: Any) -> bool:
    """Whether ``value`` is an abstract value inside a JAX transformation (never imports JAX)."""
    jax = sys.modules.get("jax")
    return jax is not None and isinstance(value, jax.core.Tracer)


def finite(field: str, values: Any) -> None:
    """Check that an array (NumPy, JAX or torch) holds no NaN and no infinity; traced arrays pass."""
    if type(values) is np.ndarray and values.dtype == np.float64 and np.logical_and.reduce(np.isfinite(values), None):
        return  # the usual case, without the search for the place
    _check_all(field, values, lambda x: np.isfinite(x), "finite (no NaN, no infinity)")


def moderate(field: str, values: Any) -> None:
    """Check that an array holds no NaN and nothing above ``LARGEST`` (``LARGEST_SINGLE``); traced arrays pass."""
    if is_small(values) or is_traced(values):
        return
    limit = largest(values)
    _check_all(field, values, np.isfinite, "finite (no NaN, no infinity)")
    _check_all(field, values, lambda x: np.abs(x) <= limit, f"in [-{limit:g}, {limit:g}], or its square overflows")


def is_small(values: Any) -> bool:
    """Whether ``values`` is an array of doubles that surely pass ``moderate``: the usual case, in one operation."""
    if type(values) is not np.ndarray or values.dtype.char != "d":
        return False
    return bool(np.vdot(values, values) <= LARGEST * LARGEST)


def largest(values: Any) -> float:
    """Return how large the numbers of an array may be, by the size of its items in bytes."""
    return LARGEST if getattr(getattr(values, "dtype", None), "itemsize", 8) > 4 else LARGEST_SINGLE


def fitting(field: str, values: np.ndarray, dtype: Any) -> np.ndarray:
    """Return finite numbers in another precision.

    Raises:
        InvalidValueError: one of them does not fit, and would become infinite.
    """
    with np.errstate(over="ignore"):
        cast = values.astype(dtype)
    if not np.isfinite(cast).all():
        kind = np.dtype(dtype)
        allowed = f"in [-{np.finfo(kind).max:g}, {np.finfo(kind).max:g}], for it leaves as {kind}"
        _check_all(field, values, lambda _: np.isfinite(cast), allowed)
    return cast


def nonnegative(field: str, values: Any) -> None:
    """Check that an array is finite and nowhere negative; traced arrays pass."""
    plain = type(values) is np.ndarray and values.dtype == np.float64 and values.size > 0
    if plain and np.minimum.reduce(values, None) >= 0 and np.maximum.reduce(values, None) < math.inf:
        return
    _check_all(field, values, lambda x: np.isfinite(x) & (x >= 0), "finite and >= 0")


def _check_all(field: str, values: Any, good: Any, allowed: str) -> None:
    if is_traced(values):
        return
    array = as_numpy(field, values)
    bad = ~good(array)
    if bad.any():
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        where = "" if not index else f"[{', '.join(map(str, index))}]"
        raise InvalidValueError(f"{field}{where}", array[index].item(), allowed)


def as_numpy(field: str, values: Any) -> np.ndarray:
    """Return ``values`` as a NumPy array of floats.

    Numbers are real numbers of any precision and truth values (0 and 1): arrays of NumPy, JAX and torch (without their
    gradient), and nested lists and tuples of numbers. What is masked out of a masked array becomes NaN.

    Raises:
        InvalidValueError: for all else: text, ``None``, complex numbers, decimals, dictionaries, sets, generators.
    """
    if type(values) is np.ndarray and values.dtype.char in "df":
        return values if values.dtype.char == "d" else values.astype(np.float64)
    try:
        try:
            return _floats(values)
        except (TypeError, RuntimeError):  # NumPy reads no tensors in a list that have a gradient or are bfloat16
            return _floats(_detached(values))
    except (TypeError, ValueError, RuntimeError):
        allowed = "real numbers in rows of equal length (a missing rating is marked with mask=)"
        raise InvalidValueError(field, values, allowed) from None


def _detached(values: Any) -> Any:
    if isinstance(values, list | tuple):
        return [_detached(part) for part in cast("list[Any]", values)]
    return _floats(values) if hasattr(values, "detach") else values


def _floats(values: Any) -> np.ndarray:
    if hasattr(values, "detach"):
        if values.is_complex():
            raise TypeError
        values = values.detach().cpu().double()  # NumPy has no bfloat16
    array = np.asarray(values)
    if array.dtype.kind in "OSUTMmc" or array.dtype.names is not None:
        raise TypeError
    if isinstance(values, np.ma.MaskedArray):
        return np.ma.filled(values.astype(np.float64), np.nan)
    with np.errstate(over="ignore"):  # of a long double; the checks that follow find the infinity
        return array.astype(np.float64, copy=False)


def same_shape(field: str, value: Any, other_field: str, other: Any) -> None:
    """Check that two arrays have the same shape."""
    if tuple(value.shape) != tuple(other.shape):
        raise InvalidValueError(
            f"{field}.shape", tuple(value.shape), f"{tuple(other.shape)}, the shape of {other_field}"
        )


def pair(field: str, value: Sequence[int], size: int) -> tuple[int, int]:
    """Return ``value`` as a (row, column) cell of a ``size`` x ``size`` grid."""
    allowed = f"a (row, column) pair with both in 0..{size - 1}"
    try:
        row, column = value
    except (TypeError, ValueError):
        raise InvalidValueError(field, value, allowed) from None
    for part in (row, column):
        if isinstance(part, bool) or not isinstance(part, int | np.integer) or not 0 <= part < size:
            raise InvalidValueError(field, value, allowed)
    return int(row), int(column)
