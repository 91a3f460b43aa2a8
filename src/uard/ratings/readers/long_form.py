"""From one answer per row to a row per item and a column per rater."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from uard import _checks
from uard.ratings.log import RatingLog, Repeats, bad_cell
from uard.ratings.readers.columns import MISSING, Numbers, name_of
from uard.ratings.readers.layout import Layout

if TYPE_CHECKING:
    from jaxtyping import Float, Integer

LARGEST = 2 * 10**7  # cells of the table of items and raters: 160 MB, and the doctor needs several times as much


def long_log(columns: dict[str, Any], layout: Layout, numbers: Numbers) -> RatingLog:
    """Return a log of one answer per row as a row per item, in order of appearance, and a column per rater, by name.

    Where a rater has rated an item more than once, the latest answer counts: by the column of times if there is one,
    else, and among equal times, the last in the source. The others are kept as ``RatingLog.repeats``.

    Args:
        columns: Those that the layout names, as cells.
        layout: Of the long form.
        numbers: Reads the cells.

    Raises:
        InvalidValueError: a cell is no number, an answer has no rater or no item, the rewards of an item differ, or the
            table would have over ``LARGEST`` cells.
    """
    assert layout.rater is not None
    assert layout.item is not None
    source = numbers.source
    cells = parted(columns, layout, source) if layout.parted else columns[layout.ratings[0]]
    rating = numbers.rated(numbers.of(cells, layout.ratings[0].partition(":::")[0], text=True))
    more = {name: numbers.of(columns[name], name) for name in (layout.reward, *layout.others) if name is not None}
    numbers.check()
    if not rating.size:
        raise _checks.InvalidValueError("log", source, "a log with at least one row")
    heard = np.flatnonzero(~np.isnan(rating))
    item, items = _numbered([name_of(x) for x in columns[layout.item]], layout.item, source, np.arange(rating.size))
    said = columns[layout.rater]
    rater, raters = _numbered([name_of(said[i]) for i in heard], layout.rater, source, heard)
    by_name = sorted(range(len(raters)), key=raters.__getitem__)
    rater, raters = np.argsort(by_name)[rater] if raters else rater, tuple(raters[k] for k in by_name)
    if len(items) * len(raters) > LARGEST:
        sizes = f"{len(items)} items and {len(raters)} raters"
        raise _checks.InvalidValueError(source, sizes, f"a table of at most {LARGEST} cells; read a part of the log")
    when = None if layout.time is None else columns[layout.time]
    table, repeats = _table(item[heard], rater, rating[heard], (len(items), len(raters)), heard, when, layout, source)
    of_item = {name: _per_item(column, item, items, name, source) for name, column in more.items()}
    first = np.unique(item, return_index=True)[1]
    return RatingLog(
        reward=None if layout.reward is None else of_item[layout.reward],
        ratings=table,
        raters=raters,
        **{name: of_item[name] for name in layout.others},
        item=np.array(items, dtype=object),
        **{name: np.array([str(columns[name][i]) for i in first], dtype=object) for name in layout.names},
        by=None if layout.by is None else _part_of_items(columns[layout.by], item, items, layout.by, source),
        source=source,
        repeats=repeats,
    )


def _numbered(
    names: Sequence[str | None], column: str, source: str, rows: Integer[np.ndarray, " n"]
) -> tuple[Integer[np.ndarray, " n"], list[str]]:
    """Return names as numbers 0..M-1, and the names."""
    codes: dict[str | None, int] = {}
    numbered = np.array([codes.setdefault(name, len(codes)) for name in names], dtype=int)
    if None in codes:
        row = int(rows[names.index(None)])
        raise bad_cell(source, row, column, None, "a name: every answer says who rated what")
    return numbered, [name for name in codes if name is not None]


def _table(
    item: Integer[np.ndarray, " m"],
    rater: Integer[np.ndarray, " m"],
    rating: Float[np.ndarray, " m"],
    shape: tuple[int, int],
    rows: Integer[np.ndarray, " m"],
    when: Sequence[Any] | None,
    layout: Layout,
    source: str,
) -> tuple[Float[np.ndarray, "items raters"], Repeats | None]:
    """Return the latest answers as a table, and the earlier ones."""
    cell = item * shape[1] + rater
    table = np.full(shape, np.nan)
    again = np.bincount(cell, minlength=1)[cell] > 1
    table.flat[cell[~again]] = rating[~again]
    if not again.any():
        return table, None
    cell, rating, rows = cell[again], rating[again], rows[again]
    time = np.zeros(rows.size) if when is None else _times([when[i] for i in rows], rows, layout.time or "", source)
    order = np.lexsort((rows, time, cell))
    cell, rating = cell[order], rating[order]
    last = np.append(cell[1:] != cell[:-1], True)
    table.flat[cell[last]] = rating[last]
    before = cell[~last]
    return table, Repeats(before // shape[1], before % shape[1], rating[~last])


def _times(cells: Sequence[Any], rows: Integer[np.ndarray, " n"], column: str, source: str) -> Float[np.ndarray, " n"]:
    """Return times as numbers; one that is missing is before all others."""
    return np.array([_time(cell, int(row), column, source) for cell, row in zip(cells, rows, strict=True)])


def _time(cell: Any, row: int, column: str, source: str) -> float:
    if cell is None or cell != cell or (isinstance(cell, str) and cell.strip().lower() in MISSING):
        return -np.inf
    is_date = isinstance(cell, str) and re.fullmatch(r"(19|20)\d{6}", cell.strip()) is not None  # not so many seconds
    try:
        if not is_date:
            return float(cell) if not isinstance(cell, datetime) else _seconds(cell)
    except (TypeError, ValueError, OverflowError):
        pass
    try:
        return _seconds(datetime.fromisoformat(str(cell).strip()))
    except (ValueError, OverflowError):
        allowed = (
            "a number or a time as in ISO 8601 (2026-10-01T09:30:00Z): a rater has answered twice, and the later counts"
        )
        raise bad_cell(source, row, column, cell, allowed) from None


def _seconds(time: datetime) -> float:
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()


def _per_item(
    column: Float[np.ndarray, " n"], item: Integer[np.ndarray, " n"], items: Sequence[str], name: str, source: str
) -> Float[np.ndarray, " items"]:
    """Return what all rows of an item say alike."""
    known = ~np.isnan(column)
    found = np.full(len(items), np.nan)
    found[item[known]] = column[known]
    differ = known & (found[item] != column)
    if differ.any():
        row = int(np.argmax(differ))
        where = f"{source}: item {items[item[row]]!r}, column {name!r}"
        allowed = (
            "the same in all rows of an item; if each row is a visit with a reward of its own and each rater has a "
        )
        allowed += "column, ratings (--ratings) names these columns"
        raise _checks.InvalidValueError(where, (float(column[row]), float(found[item[row]])), allowed)
    return found


def _part_of_items(
    cells: Sequence[Any], item: Integer[np.ndarray, " n"], items: Sequence[str], name: str, source: str
) -> np.ndarray:
    """Return the part of the log that each item belongs to."""
    found: dict[int, str] = {}
    for i, cell in zip(item.tolist(), cells, strict=True):
        if found.setdefault(i, str(cell)) != str(cell):
            where = f"{source}: item {items[i]!r}, column {name!r}"
            raise _checks.InvalidValueError(where, (found[i], str(cell)), "the same in all rows of an item")
    return np.array([found[i] for i in range(len(items))], dtype=object)


def parted(columns: dict[str, Any], layout: Layout, source: str) -> list[Any]:
    """Return potato's answers, of which a row fills at most one of several columns ``schema:::label``."""
    found: list[Any] = []
    for row, cells in enumerate(zip(*(columns[n] for n in layout.ratings), strict=True)):
        labels = (n.partition(":::")[2] for n in layout.ratings)
        chosen = {label: x for label, x in zip(labels, cells, strict=True) if x not in (None, "") and x == x}
        found.append(chosen_value(chosen, f"{source}: row {row + 1}"))
    return found


def chosen_value(chosen: dict[str, Any], where: str) -> Any:
    """Return what potato's answer to one question says: the label if that is a number, else its value.

    Examples:
        >>> chosen_value({"scale_4": "4"}, "row 1"), chosen_value({"4": True}, "row 1"), chosen_value({}, "row 1")
        ('4', '4', None)

    Args:
        chosen: Label -> value; what is false is not chosen.
        where: For the message.

    Raises:
        InvalidValueError: several labels are chosen.
    """
    chosen = {label: x for label, x in chosen.items() if str(x).lower() not in ("false", "none")}
    if len(chosen) > 1:
        raise _checks.InvalidValueError(where, chosen, "one label per question, a number")
    for label, value in chosen.items():
        return label if value is True or str(value).lower() in ("true", "on", label.lower()) else value
    return None
