"""What all readers share: what the user wants read, and how cells become numbers and names."""

from __future__ import annotations

import decimal
import math
import numbers
import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from uard import _checks
from uard.ratings.log import NUMBERS, bad_cell

if TYPE_CHECKING:
    from jaxtyping import Float

MISSING = frozenset(("", "nan", "na", "n/a", "null", "none", "-", "<na>", "#n/a"))
A_NUMBER = "a number, or nothing where it is missing"
_MANY = 100  # kinds of unreadable cells after which there is no use in looking for more
_SHOWN = 5  # kinds of unreadable cells that a message names


@dataclass(frozen=True)
class Wanted:
    """What a user says about a source.

    Attributes:
        source: What it is called in messages.
        reward: Name of the column of rewards.
        ratings: Wide form: names of the annotators' columns; all that start with ``rating`` if None.
        rater: Long form: name of the column that says who rated.
        item: Name of the column that says what was rated.
        rating: Long form: name of the column of ratings, or of the question whose answers they are.
        missing: Further words that mean that a number is missing; one that is a number means so among ratings alone.
        by: Name of the column that divides the rows into parts, or None.
    """

    source: str
    reward: str = "reward"
    ratings: tuple[str, ...] | None = None
    rater: str | None = None
    item: str | None = None
    rating: str | None = None
    missing: tuple[str, ...] = ()
    by: str | None = None

    def __post_init__(self) -> None:
        """Check that names are text, that the form is either wide or long, and that no column of numbers divides rows.

        Raises:
            InvalidValueError: naming the argument.
        """
        for name in ("source", "reward", "rater", "item", "rating", "by"):
            value = getattr(self, name)
            if not isinstance(value, str) and (value is not None or name in ("source", "reward")):
                raise _checks.InvalidValueError(name, value, "the name of a column")
        if self.ratings is not None and (self.rater is not None or self.rating is not None):
            allowed = (
                "left out where rater or rating names a column: either each rater has a column, or each row a rater"
            )
            raise _checks.InvalidValueError("ratings", self.ratings, allowed)
        self._check_roles()
        called_so = self.ratings is None and self.by is not None and self.by.startswith("rating")
        if self.by is not None and (
            called_so or self.by in (self.reward, self.rating, *NUMBERS, *(self.ratings or ()))
        ):
            raise _checks.InvalidValueError("by", self.by, "a column that is neither the reward, a sigma nor a rating")

    def _check_roles(self) -> None:
        """Refuse a column that is named for two roles, or twice among the ratings; ``by`` may be item or rater.

        Raises:
            InvalidValueError: naming the later role.
        """
        roles: dict[str, str] = {}
        single = (("reward", self.reward), ("rater", self.rater), ("item", self.item))  # rating may name a question
        for role, name in (*single, *(("ratings", name) for name in self.ratings or ())):
            if name is None:
                continue
            if name in roles:
                raise _checks.InvalidValueError(role, name, f"a column that is not already named as {roles[name]}")
            roles[name] = role


class Choice(ABC):
    """Which columns of a source are read."""

    @property
    def named(self) -> frozenset[str]:
        """Columns that are read wherever an annotation tool has put them."""
        return frozenset()

    @abstractmethod
    def candidate(self, name: str) -> bool:
        """Whether a column may be needed, whatever the others are called."""

    @abstractmethod
    def columns(self, names: Sequence[str]) -> tuple[Sequence[str], Sequence[str]]:
        """Return which of the columns are read as numbers, and which as text.

        Raises:
            InvalidValueError: one is missing, there twice, or it cannot be told which is meant.
        """

    def may_be_list(self, name: str) -> bool:
        """Whether a column may hold lists, one number per rater."""
        return False

    def everywhere(self, names: Sequence[str]) -> Sequence[str]:
        """Return the columns that every row must name."""
        return ()


def names_in(argument: str, value: Sequence[Any]) -> tuple[str, ...]:
    """Return several names that a user gives.

    Raises:
        InvalidValueError: it is one text, or something in it is no text.
    """
    if isinstance(value, str) or not all(isinstance(x, str) for x in value):
        raise _checks.InvalidValueError(argument, value, "several texts, such as ('a', 'b')")
    return tuple(value)


_NO_NUMBERS = (bool, np.bool_)
_NUMBERS = (numbers.Real, decimal.Decimal, np.integer, np.floating)
_PLAIN = frozenset((int, float, type(None), np.float64, np.float32, np.int64, np.int32))


@dataclass
class Numbers:
    """Reads cells as numbers, NaN where one is missing, and names all at once those that are none.

    Attributes:
        source: What messages call the source.
        missing: See ``Wanted``.
        bad: Column and content of every cell that is no number -> how many there are, and the first row and cell.
    """

    source: str
    missing: tuple[str, ...] = ()
    bad: dict[tuple[str, str], tuple[int, int, Any]] = field(
        default_factory=dict[tuple[str, str], tuple[int, int, Any]]
    )

    def __post_init__(self) -> None:
        """Tell words from numbers among what is missing."""
        self._words = MISSING | {word.strip().lower() for word in self.missing if math.isnan(_parsed(word))}
        self.missing_numbers = tuple(x for word in self.missing if not math.isnan(x := _parsed(word)))

    def of_text(self, cells: Sequence[str], column: str, start: int = 0) -> Float[np.ndarray, " n"]:
        """Return text as numbers: plain decimals, without the underscores and foreign digits that Python takes."""
        joined = "".join(cells)
        if "_" not in joined and joined.isascii():
            try:
                return np.array([float(cell or "nan") for cell in cells])
            except ValueError:
                pass
        return np.array([self._from_text(cell, start + i, column) for i, cell in enumerate(cells)])

    def of(self, cells: Any, column: str, *, text: bool = False) -> Float[np.ndarray, " n"]:
        """Return any cells as numbers.

        Args:
            cells: An array of numbers, or a sequence.
            column: Its name.
            text: Whether text that is a number counts as one.
        """
        if isinstance(cells, np.ndarray):  # of numbers: see cells_of
            return cast("np.ndarray", cells).astype(float, copy=False)
        if set(map(type, cells)) <= _PLAIN:
            try:
                return np.array(cells, dtype=float)
            except OverflowError:  # a whole number of more than 300 digits
                pass
        return np.array([self._number(cell, row, column, text) for row, cell in enumerate(cells)], dtype=float)

    def rated(self, ratings: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return ratings without those numbers that are said to mean that one is missing."""
        none = self.missing_numbers
        return np.where(np.isin(ratings, none), np.nan, ratings) if none else ratings

    def check(self) -> None:
        """Refuse the source if any cell was no number.

        Raises:
            InvalidValueError: naming all of them, by column and with counts; the row if there is only one.
        """
        if not self.bad:
            return
        word = next((cell for _, _, cell in self.bad.values() if isinstance(cell, str)), None)
        hint = "" if word is None else f"; missing=({word!r},) or --missing {word!r} say that a word means so"
        if word is not None and re.fullmatch(r"[+-]?\d+,\d+", word.strip()):
            hint = f" (with a decimal point: {word.strip().replace(',', '.')}, not {word.strip()})"
        elif word is not None and re.match(r"\s*[+-]?\.?\d", word):
            hint = "; a number alone, without what stands behind it"
        count, row, cell = next(iter(self.bad.values()))
        if len(self.bad) == 1 and count == 1:
            raise bad_cell(self.source, row, next(iter(self.bad))[0], cell, A_NUMBER + hint)
        found: dict[str, dict[str, int]] = {}
        for (column, word), (count, _, _) in sorted(self.bad.items(), key=lambda kind: -kind[1][0])[:_SHOWN]:
            found.setdefault(column, {})[word] = count
        more = f" and {len(self.bad) - _SHOWN} other kinds" if len(self.bad) > _SHOWN else ""
        first = min(row for _, row, _ in self.bad.values())
        where = f"{self.source}: cells that are no numbers{more}, the first in row {first + 1}, by column, with counts"
        raise _checks.InvalidValueError(where, found, f"numbers, or nothing where one is missing{hint}")

    def _from_text(self, cell: str, row: int, column: str) -> float:
        if cell.strip().lower() in self._words:
            return np.nan
        number = _parsed(cell)
        return self._unreadable(cell, row, column) if math.isnan(number) else number

    def _number(self, cell: Any, row: int, column: str, text: bool) -> float:
        if isinstance(cell, str):
            known = text or cell.strip().lower() in self._words
            return self._from_text(cell, row, column) if known else self._unreadable(cell, row, column)
        if getattr(cell, "shape", None) == () and hasattr(cell, "item"):
            cell = cell.item()
        if cell is None or type(cell).__name__ == "NAType":  # pandas
            return np.nan
        try:
            if isinstance(cell, _NUMBERS) and not isinstance(cell, _NO_NUMBERS):
                return float(cast("float", cell))
        except (OverflowError, ValueError):  # more than 300 digits; a signalling NaN
            pass
        return self._unreadable(cell, row, column)

    def _unreadable(self, cell: Any, row: int, column: str) -> float:
        kind = (column, cell if isinstance(cell, str) else _checks.short(cell))
        count, first, example = self.bad.get(kind, (0, row, cell))
        self.bad[kind] = (count + 1, first, example)
        if len(self.bad) > _MANY:
            self.check()
        return np.nan


def _parsed(text: str) -> float:
    """Return a plain decimal number; NaN if it is none."""
    if "_" in text or not text.isascii():
        return math.nan
    try:
        return float(text)
    except ValueError:
        return math.nan


def name_of(cell: Any) -> str | None:
    """Return what a cell names, as text; None where it names nothing.

    Examples:
        >>> name_of(7), name_of(7.0), name_of(" ann "), name_of(""), name_of({"id": 1, "email": "ann@x"})
        ('7', '7', 'ann', None, 'ann@x')
    """
    if isinstance(cell, Mapping):  # Label Studio's users
        user = cast("Mapping[str, Any]", cell)
        cell = user.get("email") or user.get("username") or user.get("id")
    if cell is None or str(cell) in ("nan", "NaT", "<NA>"):
        return None
    if isinstance(cell, float) and cell.is_integer():  # what pandas makes of whole numbers; NumPy's are floats too
        cell = int(cell)
    return str(cell).strip() or None


def cells_of(column: Any, name: str, source: str) -> Any:
    """Return a column that was handed over in memory as an array of numbers or a list of cells.

    Raises:
        InvalidValueError: it is text, a dict or a set, has no elements, or has more than one dimension.
    """
    cells: Any = column
    if isinstance(column, str | bytes | Mapping | Set) or not isinstance(column, Iterable):
        raise _checks.InvalidValueError(f"{source}: column {name!r}", cells, "a list or an array, a cell per row")
    if isinstance(column, np.ma.MaskedArray):
        return list(cells.tolist())
    if hasattr(cells, "detach"):
        cells = cells.detach().cpu()
    if len(shape := getattr(cells, "shape", (0,))) != 1:
        raise _checks.InvalidValueError(f"{source}: column {name!r}", shape, "of one dimension, a cell per row")
    return cells if isinstance(column, np.ndarray) and cells.dtype.kind in "iuf" else list(cells)


def no_binary(text: str, path: Path) -> None:
    """Check that text has no NUL bytes.

    Raises:
        InvalidValueError: it has.
    """
    if "\0" in text:
        raise _checks.InvalidValueError("log", str(path), "text, not binary data")
