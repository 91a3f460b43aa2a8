"""Tables and paragraphs as plain text, no wider than they are told: nothing is broken inside a word.

A table whose heads do not fit breaks them, then texts, between words. What is still too wide is shown in several
tables, one below the other, each with the rows' names; or, if texts are in it, row by row.

    >>> print(text(("rater", "answers", "bias"), [("ann", "12", "0.5 [0.1, 0.9]"), ("bob", "9", "-1.5 [-2.0, -1.0]")]))
    rater  answers  bias
    ─────  ───────  ─────────────────
    ann         12   0.5 [0.1, 0.9]
    bob          9  -1.5 [-2.0, -1.0]
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

WIDTH = 80  # columns of a terminal that says nothing of its own
_GAP = 2
_TIE = "\ue000"  # of a private area: a space that no line ends at
_LEAST = 12  # characters of a name's column; narrower ones are unreadable
_NUMBER = re.compile(r"[<>~+−-]?\s?\d[\d.,]*(?: \d{3})*(?:e[+-]?\d+|/\d+|%)?(?![^\s])")
_NONE = {"", "-", "–", "?", "none", "one run", "not defined"}
_ASCII = str.maketrans({"─": "-", "–": "-", "−": "-", "…": "~", "×": "x", "•": "*", "±": "+-", "’": "'", "·": "."})
_ASCII |= str.maketrans(dict.fromkeys("╭╮╰╯┌┐└┘├┤┬┴┼", "+") | {"│": "|", "━": "-", "█": "#", "σ": "s"})


class Line(NamedTuple):
    """A line of a table.

    Attributes:
        text: Without spaces at its end.
        row: Number of the row that it shows; None for heads.
    """

    text: str
    row: int | None


def encodable(written: str, encoding: str | None) -> str:
    r"""Return text that an encoding can hold, as wide as before where that is possible.

    Examples:
        >>> encodable("8 ± 1 …", "ascii"), encodable("8 ± 1", "utf-8"), encodable("雨", "ascii")
        ('8 +- 1 ~', '8 ± 1', '\\u96e8')
    """
    encoding = encoding or "utf-8"
    try:
        written.encode(encoding)
    except UnicodeEncodeError:
        return written.translate(_ASCII).encode(encoding, "backslashreplace").decode(encoding)
    return written


def replaced(error: UnicodeError) -> tuple[str, int]:
    """Return what an encoder is to write instead: an error handler for ``codecs.register_error``."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return encodable(error.object[error.start : error.end], error.encoding), error.end


def width_of(written: str) -> int:
    """Return how many columns text takes in a terminal: two for a wide sign, none for one that joins another.

    Examples:
        >>> width_of("ann"), width_of("雨"), width_of("e\u0301")
        (3, 2, 1)
    """
    if written.isascii():
        return len(written)
    wide = sum(unicodedata.east_asian_width(c) in "WF" for c in written)
    return len(written) + wide - sum(unicodedata.combining(c) > 0 for c in written)


def fill(written: str, width: int = WIDTH, first: str = "", rest: str | None = None) -> str:
    """Break text between words; a word that is too long is left whole, for a path in two parts is none.

    Examples:
        >>> print(fill("the remedy is simple", width=16, first="  do  "))
          do  the remedy
              is simple

    Args:
        written: Line feeds count as spaces.
        width: Of the longest line.
        first: Before the first line.
        rest: Before the others; as many spaces as ``first`` is wide if left out.
    """
    indent = " " * width_of(first) if rest is None else rest
    return "\n".join(_broken(written, width, first, indent)) or first.rstrip()


def _broken(written: str, width: int, first: str = "", rest: str = "") -> list[str]:
    lines: list[str] = []
    line, empty = first, True
    for word in re.sub(r"(?<=\d) (?=%)", _TIE, written).split():  # no line begins with a percent sign
        if not empty and width_of(line) + 1 + width_of(word) > width:
            lines.append(line)
            line, empty = rest, True
        line, empty = f"{line}{word}" if empty else f"{line} {word}", False
    return [x.replace(_TIE, " ") for x in (*lines, line)] if not empty else []


def shorten(written: str, width: int) -> str:
    """Return text that fits into a line: what is too much is left out from the last word that fits.

    Examples:
        >>> shorten("A grid with a goal", 12), shorten("short", 12)
        ('A grid with…', 'short')
    """
    written = " ".join(written.split())
    if width_of(written) <= width:
        return written
    kept = written
    while kept and width_of(kept) > width - 1:
        kept = kept.rpartition(" ")[0] if " " in kept else kept[:-1]
    return kept.rstrip(" ,;:.") + "…"


def decimals(values: Iterable[float], widths: Iterable[float] = (), most: int = 3) -> int:
    """Return how many decimals all numbers of a column have.

    A step of the last one is at most a fifth of the width of an interval, for three of four intervals; without any,
    the number in the middle has three digits.

    Examples:
        >>> decimals([8.021, 6.5], widths=[0.07, 0.2]), decimals([1031.2], widths=[150.0]), decimals([0.123, 12.0])
        (2, 0, 1)

    Args:
        values: The numbers; what is not finite does not count.
        widths: Of their intervals.
        most: Decimals.
    """
    sizes = sorted(abs(x) for x in values if math.isfinite(x) and x)
    narrow = sorted(w for w in widths if math.isfinite(w) and w > 0)
    if not sizes:
        return 0
    if narrow:
        wanted = math.ceil(-math.log10(narrow[(len(narrow) - 1) // 4] / 5) - 1e-9)
    elif all(x == round(x) for x in sizes):
        return 0
    else:
        wanted = 2 - math.floor(math.log10(sizes[len(sizes) // 2]))
    before = 1 + math.floor(math.log10(sizes[-1])) if sizes[-1] >= 1 else 0
    return max(0, min(wanted, most, 4 - before))


def text(columns: Sequence[str], rows: Iterable[Sequence[str]], width: int = WIDTH, labels: int = 1) -> str:
    """Return a table as text; see ``lay_out``."""
    return "\n".join(line.text for line in lay_out(columns, list(rows), width, labels))


def lay_out(columns: Sequence[str], rows: Sequence[Sequence[str]], width: int = WIDTH, labels: int = 1) -> list[Line]:
    """Return a table as lines.

    Columns of numbers end at the right, the brackets behind them one below the other; all others begin at the left.

    Args:
        columns: Their heads.
        rows: As many texts each as there are columns.
        width: Of the longest line, unless a word is longer.
        labels: So many columns name the row: they are repeated where a table is divided.
    """
    made = [_Column.of(head, [row[i] for row in rows], i < labels) for i, head in enumerate(columns)]
    if (widths := _fitted(made, width)) is not None:
        return _drawn(made, widths)
    if (widths := _overhanging(made, width, labels)) is not None:
        return _drawn(made, widths, overhang=width)
    if len(made) - labels > 1 and all(column.numeric for column in made[labels:]):
        return _divided(columns, rows, made, width, labels)
    return _row_by_row(columns, rows, width, labels)


@dataclass(frozen=True)
class _Column:
    """A column, and how wide it is.

    Attributes:
        head: Its head.
        cells: Its texts, numbers one below the other.
        numeric: Whether it holds numbers, which are not broken.
        natural: Width of its widest cell.
        word: Width of the longest word in its cells; of a whole number.
        head_word: Width of the longest word of its head.
    """

    head: str
    cells: tuple[str, ...]
    numeric: bool
    natural: int
    word: int
    head_word: int

    @classmethod
    def of(cls, head: str, cells: list[str], label: bool) -> _Column:
        numeric = not label and all(c in _NONE or _NUMBER.match(c) for c in cells) and any(map(_NUMBER.match, cells))
        if numeric:
            cells = _aligned(cells)
        natural = max(map(width_of, cells), default=0)
        word = natural if numeric else max((width_of(w) for c in cells for w in c.split()), default=0)
        return cls(head, tuple(cells), numeric, natural, word, max(map(width_of, head.split()), default=0))

    @property
    def least(self) -> int:
        """How narrow it can be."""
        return max(self.word, self.head_word)

    @property
    def usual(self) -> int:
        """How wide it is if only its head is broken."""
        return max(self.natural, self.head_word)

    def lines(self, row: int, width: int) -> list[str]:
        """Return the lines of a cell."""
        cell = self.cells[row]
        return [cell] if self.numeric or width_of(cell) <= width else _broken(cell, width)


def _aligned(cells: list[str]) -> list[str]:
    """Return numbers one below the other, and what stands behind them, too."""
    parts = []
    for cell in cells:
        found = _NUMBER.match(cell)
        parts.append((found[0], cell[found.end() :].strip()) if found else (cell, ""))
    before, after = (max((width_of(part[i]) for part in parts), default=0) for i in (0, 1))
    return [_padded(a, before, right=True) + f" {_padded(b, after)}" * (after > 0) for a, b in parts]


def _padded(written: str, width: int, right: bool = False) -> str:
    room = " " * max(0, width - width_of(written))
    return room + written if right else written + room


def _total(widths: Sequence[int]) -> int:
    return sum(widths) + _GAP * (len(widths) - 1)


def _fitted(columns: Sequence[_Column], width: int) -> list[int] | None:
    """Return the columns' widths: heads are broken first, then texts; None if that is not enough."""
    widths = [max(c.natural, width_of(c.head)) for c in columns]
    if _total(widths) <= width:
        return widths
    widths = [c.usual for c in columns]
    if _total(widths) <= width:
        for i, c in enumerate(columns):  # heads are whole as long as there is room
            widths[i] += min(max(0, width_of(c.head) - widths[i]), width - _total(widths))
        return widths
    for cap in range(max(widths), 0, -1):
        widths = [min(c.usual, max(c.least, cap)) for c in columns]
        if _total(widths) <= width:
            return widths
    return None


def _overhanging(columns: Sequence[_Column], width: int, labels: int) -> list[int] | None:
    """Return the columns' widths where long names stand on lines of their own; None if there is no room for others."""
    if labels != 1 or len(columns) < 2:
        return None
    widths = [c.least for c in columns[1:]]
    room = width - _total(widths) - _GAP
    return [room, *widths] if room >= max(_LEAST, columns[0].head_word) else None


def _drawn(columns: Sequence[_Column], widths: Sequence[int], overhang: int = 0) -> list[Line]:
    heads = [_broken(c.head, w) for c, w in zip(columns, widths, strict=True)]
    height = max(map(len, heads))
    right = [c.numeric and bool(c.natural) and " " not in c.cells[0].strip() for c in columns]
    made = []
    for i in range(height):
        parts = [h[i - height + len(h)] if i >= height - len(h) else "" for h in heads]
        made.append(_joined(parts, widths, right))
    lines = [Line(x, None) for x in (*made, _joined(["─" * w for w in widths], widths, right))]
    for number in range(len(columns[0].cells)):
        cells = [c.lines(number, w) for c, w in zip(columns, widths, strict=True)]
        if overhang and any(width_of(x) > widths[0] for x in cells[0]):
            lines += [Line(x, number) for x in _broken(columns[0].cells[number], overhang)]
            cells[0] = []
        for i in range(max(map(len, cells))):
            parts = [c[i] if i < len(c) else "" for c in cells]
            lines.append(Line(_joined(parts, widths, [c.numeric for c in columns]), number))
    return lines


def _joined(parts: Iterable[str], widths: Sequence[int], right: Sequence[bool]) -> str:
    padded = (_padded(p, w, r) for p, w, r in zip(parts, widths, right, strict=True))
    return (" " * _GAP).join(padded).rstrip()


def _divided(
    columns: Sequence[str], rows: Sequence[Sequence[str]], made: Sequence[_Column], width: int, labels: int
) -> list[Line]:
    """Return several tables, one below the other, each with some of the columns."""
    room = width - sum(c.usual + _GAP for c in made[:labels])
    groups: list[list[int]] = [[]]
    for i in range(labels, len(made)):
        if groups[-1] and _total([made[k].usual for k in (*groups[-1], i)]) > room:
            groups.append([])
        groups[-1].append(i)
    if len(groups) == 1:
        return _row_by_row(columns, rows, width, labels)
    lines: list[Line] = []
    for group in groups:
        chosen = [*range(labels), *group]
        part = lay_out([columns[i] for i in chosen], [[row[i] for i in chosen] for row in rows], width, labels)
        lines += [Line("", None)] * bool(lines) + part
    return lines


def _row_by_row(columns: Sequence[str], rows: Sequence[Sequence[str]], width: int, labels: int) -> list[Line]:
    """Return a paragraph for each row."""
    lines: list[Line] = []
    for number, row in enumerate(rows):
        named = ", ".join(x for x in row[:labels] if x)
        parts = [fill(named, width, rest="  ")] * bool(named)
        parts += [
            fill(f"{head}: {x}" if head else x, width, "  ", "    ")
            for head, x in zip(columns[labels:], row[labels:], strict=True)
            if x
        ]
        lines += [Line(x, number) for part in parts for x in part.split("\n")]
    return lines
