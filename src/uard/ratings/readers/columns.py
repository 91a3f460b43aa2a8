"""What all readers share: which columns are read, and how they become a log."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from uard import _checks
from uard.ratings.log import LABELS, NUMBERS, RatingLog, bad_cell

if TYPE_CHECKING:
    from jaxtyping import Float

A_NUMBER = "a number, or nothing where it is missing"


@dataclass(frozen=True)
class Wanted:
    """Which columns of a source are read.

    Attributes:
        source: What the source is called in messages.
        reward: Name of the column of rewards.
        ratings: Names of the annotators' columns; all that start with ``rating`` if None.
        by: Name of the column that divides the rows into parts, or None.
    """

    source: str
    reward: str
    ratings: tuple[str, ...] | None
    by: str | None = None

    def __post_init__(self) -> None:
        """Check that the rows are not divided by a column of numbers.

        Raises:
            InvalidValueError: they are.
        """
        if self.by is not None and (self.by in (self.reward, *NUMBERS) or self._is_rating(self.by)):
            raise _checks.InvalidValueError("by", self.by, "a column that is neither the reward, a sigma nor a rating")

    def _is_rating(self, name: str) -> bool:
        if self.ratings is None:
            return name.startswith("rating")
        return name in self.ratings

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the names of the columns that are read as text."""
        return LABELS if self.by is None else (*LABELS, self.by)

    def has(self, name: str) -> bool:
        """Whether a column is read."""
        return name == self.reward or name in NUMBERS or name in self.labels or bool(self.among([name]))

    def among(self, names: Iterable[str]) -> list[str]:
        """Return the annotators' columns among ``names``; ``x[0]`` is a part of ``x``."""
        others = [n for n in names if n != self.reward]
        if self.ratings is None:
            return [n for n in others if n.startswith("rating")]
        return [n for r in self.ratings for n in others if n == r or n.startswith(f"{r}[")]

    def check(self, names: Sequence[str]) -> None:
        """Check that all columns that are needed are among ``names``, and each only once.

        Raises:
            InvalidValueError: with the names of the columns that are there.
        """
        whole = {name.partition("[")[0] for name in names} | set(names)
        for needed in (self.reward, *(self.ratings or ()), *(() if self.by is None else (self.by,))):
            if needed not in whole:
                raise _checks.UnknownNameError(f"{self.source}: column", needed, names)
        if not self.among(names):
            allowed = f"there; name them with ratings (--ratings). Columns: {', '.join(names)}"
            raise _checks.InvalidValueError(f"{self.source}: columns that start with", "rating", allowed)
        for name in names:
            if names.count(name) > 1 and self.has(name):
                raise _checks.InvalidValueError(f"{self.source}: column", name, "there only once")


def assembled(columns: Mapping[str, Any], wanted: Wanted) -> RatingLog:
    """Make a log of columns of cells.

    Raises:
        InvalidValueError: a cell is no number (the message names row and column), columns of unequal length, or no row.
    """
    numbers = {n: numbers_of(c, n, wanted.source) for n, c in columns.items() if n not in wanted.labels}
    lengths = {n: len(c) for n, c in columns.items()}
    for name, length in lengths.items():
        if length != lengths[wanted.reward]:
            allowed = f"of {lengths[wanted.reward]} rows, like {wanted.reward!r}"
            raise _checks.InvalidValueError(f"{wanted.source}: column {name!r}", f"{length} rows", allowed)
    if not lengths[wanted.reward]:
        raise _checks.InvalidValueError("log", wanted.source, "a log with at least one row")
    order = wanted.among(numbers)
    return RatingLog(
        reward=numbers[wanted.reward],
        ratings=np.stack([numbers[n] for n in order], axis=1),
        raters=tuple(order),
        **{n: numbers[n] for n in NUMBERS if n in numbers},
        **{n: np.asarray([str(x) for x in columns[n]]) for n in LABELS if n in columns},
        by=None if wanted.by is None else np.asarray([str(x) for x in columns[wanted.by]]),
        source=wanted.source,
    )


_NO_NUMBERS: tuple[type[Any], ...] = (bool, np.bool_, str, bytes)  # though float() would take them
_PLAIN = frozenset((int, float, type(None), np.float64, np.float32, np.int64, np.int32))


def numbers_of(cells: Any, column: str, source: str) -> Float[np.ndarray, " n"]:
    """Return a column as floats, NaN where a number is missing; text is none, even if it reads like one.

    Raises:
        InvalidValueError: a cell is no number; the message names row and column.
    """
    if isinstance(cells, np.ndarray):
        return cast("np.ndarray", cells)
    if set(map(type, cells)) <= _PLAIN:
        try:
            return np.array(cells, dtype=float)
        except OverflowError:  # a whole number of more than 300 digits
            pass
    return np.array([_number(x, row, column, source) for row, x in enumerate(cells)], dtype=float)


def _number(cell: Any, row: int, column: str, source: str) -> float:
    if cell is None:
        return np.nan
    try:
        if isinstance(cell, _NO_NUMBERS):
            raise TypeError
        return float(cell)
    except (TypeError, ValueError, OverflowError):
        raise bad_cell(source, row, column, cell, A_NUMBER) from None


def no_binary(text: str, path: Path) -> None:
    """Check that text has no NUL bytes.

    Raises:
        InvalidValueError: it has.
    """
    if "\0" in text:
        raise _checks.InvalidValueError("log", str(path), "text, not binary data")
