"""Tables of studies, as data: for the terminal, for Markdown and for the report.

A cell is a text or a number. Numbers of one column are written with equal precision, which is chosen from their
intervals (``precision``), as in "8.02 [7.98, 8.05]":

    >>> from uard.lab.statistics import summarise
    >>> made = Table("By hand", ("who", "return"), (("a", summarise([8.0, 8.04])), ("b", Number(-0.001))))
    >>> print(made.markdown())
    | who | return |
    |---|---:|
    | a | 8.0 [7.8, 8.3] |
    | b | 0.0 |
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from uard import _checks
from uard.lab.statistics import Interval, Summary
from uard.lab.study import Study
from uard.lab.views.study_results import StudyResults

SHOWN = ("hacks", "success_rate", "true_return", "observed_return", "alignment_gap")
WORDS = {  # what a reader calls a metric, and a label of a row
    "hacks": "hacks per episode",
    "success_rate": "goal rate",
    "true_return": "true return",
    "observed_return": "observed return",
    "alignment_gap": "alignment gap",
    "episode_length": "steps per episode",
    "learns_from": "learns from",
}
MISSING = "–"
_MOST_DECIMALS = 3
_MOST_DIGITS = 4
_LONG = 34  # characters of a text from which on its column may break
_PIXELS, _PADDING, _ROOM = (
    7.15,
    22.0,
    955.0,
)  # of a character, of a column, of a page 1000 px wide; measured in Chromium
_LOOKS_LIKE_A_NUMBER = re.compile(r"[<+−-]?\s?[\d ,.]+( %|x)?( ± [\d.,]+)?|–|")


@dataclass(frozen=True)
class Number:
    """A number in a table.

    Examples:
        >>> Number(8.021, (7.98, 8.049), sd=0.05, runs=10).text(2)
        '8.02 [7.98, 8.05]'
        >>> Number(-0.004, signed=True).text(2), Number(2.0, runs=1).text(1)
        ('0.00', '2.0 (one run)')

    Attributes:
        mean: Over the runs, or the number itself.
        ci95: 95 % interval of the mean; None if there is none.
        sd: Standard deviation over the runs; None if it is not known.
        runs: How many; 0 if it is no mean of runs.
        of: What a run is, in the plural.
        note: Stands behind it in brackets.
        signed: Whether a plus is written: of a difference.
    """

    mean: float
    ci95: Interval | None = None
    sd: float | None = None
    runs: int = 0
    of: str = "seeds"
    note: str = ""
    signed: bool = False

    @classmethod
    def of_summary(
        cls, s: Summary, scale: float = 1.0, of: str = "seeds", note: str = "", signed: bool = False
    ) -> Number:
        """Return a summary as a number.

        Examples:
            >>> from uard.lab.statistics import summarise
            >>> Number.of_summary(summarise([0.9, 0.9]), scale=100).text(1)
            '90.0 [90.0, 90.0]'

        Args:
            s: Of one quantity.
            scale: What all is multiplied by: 100 for percent.
            of: See the class.
            note: See the class.
            signed: See the class.
        """
        ends = None if s.ci95 is None else (scale * s.ci95[0], scale * s.ci95[1])
        known = bool(s.per_seed) or s.sd > 0
        sd = abs(scale) * s.sd if known and len(s.per_seed) != 1 else None
        return cls(scale * s.mean, ends, sd, len(s.per_seed), of, note, signed)

    def text(self, digits: int) -> str:
        """Return it with so many decimals."""
        return f"{self.value(digits)}{self.interval(digits)}{self.remark}"

    def value(self, digits: int) -> str:
        """Return the mean."""
        return decimal(self.mean, digits, self.signed)

    def interval(self, digits: int) -> str:
        """Return the interval in brackets after a space; without one ± the deviation; nothing if neither is known."""
        if self.ci95 is None:
            return "" if self.sd is None else f" ± {decimal(self.sd, digits)}"
        low, high = (decimal(x, digits, self.signed) for x in self.ci95)
        return f" [{low}, {high}]"

    @property
    def remark(self) -> str:
        """What stands behind it in brackets: its note, and that it is one run."""
        said = [self.note] * bool(self.note) + ["one run"] * (self.runs == 1)
        return f" ({', '.join(said)})" if said else ""

    def details(self, digits: int) -> str:
        """Return standard deviation and number of runs; empty for one run, or if neither is known."""
        if self.runs == 1:
            return ""
        spread = "" if self.sd is None or self.ci95 is None else f"sd {decimal(self.sd, digits + 1)}"
        count = f"{self.runs} {self.of}" if self.runs else ""
        return ", ".join(part for part in (spread, count) if part)


Cell = str | float | Number | Summary | None


@dataclass(frozen=True)
class Shown:
    """A cell as it is written.

    Attributes:
        value: The number, or the text.
        interval: With a space before it.
        remark: In brackets, with a space before it.
        details: Standard deviation and number of runs.
    """

    value: str
    interval: str = ""
    remark: str = ""
    details: str = ""

    @property
    def text(self) -> str:
        """All that is seen without asking for more."""
        return f"{self.value}{self.interval}{self.remark}"


@dataclass(frozen=True)
class Table:
    """A titled table; the first ``labels`` columns name the row.

    Attributes:
        title: Above it.
        columns: Their heads, in the reader's words.
        rows: As many cells each as there are columns; None is what was not run.
        labels: So many columns name the row.
        note: Below it.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    labels: int = 1
    note: str = ""

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.whole("labels", self.labels, low=0, high=len(self.columns))
        for row in self.rows:
            if len(row) != len(self.columns):
                raise _checks.InvalidValueError("rows", row, f"as many cells as columns, {len(self.columns)}")

    def shown(self) -> list[tuple[Shown, ...]]:
        """Return all cells as they are written, the numbers of a column with equal precision."""
        columns = []
        for i in range(len(self.columns)):
            cells = [_number(row[i]) for row in self.rows]
            digits = precision(x for x in cells if isinstance(x, Number))
            columns.append([_shown(x, digits) for x in cells])
        return list(zip(*columns, strict=True)) if self.rows else []

    def texts(self) -> list[tuple[str, ...]]:
        """Return all cells as plain texts."""
        return [tuple(cell.text for cell in row) for row in self.shown()]

    def markdown(self) -> str:
        """Return the table in Markdown, without title and note."""
        return markdown(self.columns, self.texts(), self.numeric())

    def numeric(self) -> tuple[bool, ...]:
        """Return which columns hold numbers, and end at the right."""
        return tuple(
            i >= self.labels and all(_is_number(row[i]) for row in self.rows) for i in range(len(self.columns))
        )

    def long(self) -> tuple[bool, ...]:
        """Return which columns hold texts so long that they should break."""
        numeric, texts = self.numeric(), self.texts()
        return tuple(not n and any(len(row[i]) > _LONG for row in texts) for i, n in enumerate(numeric))

    def wide(self) -> bool:
        """Return whether it is probably wider than a page 1000 px wide, and has to scroll in a box."""
        long, texts = self.long(), self.texts()
        total = 0.0
        for i, head in enumerate(self.columns):
            cells = max((len(row[i]) for row in texts), default=0)
            word = max(map(len, head.split()), default=0)  # heads break between words
            total += _PADDING + _PIXELS * max(word, min(cells, _LONG) if long[i] else cells)
        return total > _ROOM


def markdown(columns: Sequence[str], rows: Iterable[Sequence[str]], numeric: Sequence[bool] = ()) -> str:
    """Return a table in Markdown.

    Args:
        columns: Their heads.
        rows: Texts.
        numeric: Which columns end at the right; none if left out.
    """
    marks = ["---:" if n else "---" for n in numeric] or ["---"] * len(columns)
    body = (f"| {' | '.join(x.replace('|', chr(92) + '|') for x in row)} |" for row in (columns, *rows))
    head, *lines = body
    return "\n".join([head, f"|{'|'.join(marks)}|", *lines])


def precision(numbers: Iterable[Number]) -> int:
    """Return how many decimals all numbers of a column have.

    A step of the last one is at most a fifth of the width of an interval, for three of four intervals of the column:
    finer steps say nothing, coarser ones hide where an interval ends. Where there is only a standard deviation, four
    standard errors count as the width. With neither, the number in the middle has three digits. There are at most
    three decimals, the largest number has at most four digits if it has decimals at all, and whole numbers without an
    interval have none.

    Examples:
        >>> precision([Number(8.021, (7.98, 8.05)), Number(6.5, (6.4, 6.6))])
        2
        >>> precision([Number(1031.2, (950.0, 1100.0))]), precision([Number(3.0), Number(40.0)]), precision([])
        (0, 0, 0)
    """
    here = [x for x in numbers if math.isfinite(x.mean)]
    widths = sorted(filter(None, map(_width, here)))
    if not here or (not widths and all(x.mean == round(x.mean) for x in here)):
        return 0
    if widths:
        narrow = widths[(len(widths) - 1) // 4]
        wanted = math.ceil(-math.log10(narrow / 5) - 1e-9)
    else:
        sizes = sorted(abs(x.mean) for x in here if x.mean != 0) or [1.0]
        wanted = 2 - math.floor(math.log10(sizes[len(sizes) // 2]))
    largest = max(abs(x.mean) for x in here)
    before = 1 + math.floor(math.log10(largest)) if largest >= 1 else 0
    return max(0, min(wanted, _MOST_DECIMALS, _MOST_DIGITS - before))


def _width(x: Number) -> float:
    if x.ci95 is not None:
        return x.ci95[1] - x.ci95[0]
    return 4 * (x.sd or 0.0) / math.sqrt(max(1, x.runs))


def decimal(x: float, digits: int, signed: bool = False) -> str:
    """Write a number with so many decimals; what rounds to nothing has no sign.

    Examples:
        >>> decimal(-0.004, 2), decimal(0.25, 1, signed=True), decimal(1234.5, 0), decimal(-12345.0, 0)
        ('0.00', '+0.2', '1234', '-12 345')
    """
    if not math.isfinite(x):
        return MISSING
    rounded = round(x, digits) + 0.0  # no -0.0
    sign = "+" if signed and rounded else ""
    group = "," if abs(rounded) >= 10_000 else ""
    return f"{rounded:{sign}{group}.{digits}f}".replace(",", " ")


def p_value(p: float) -> str:
    """Write a p value with three decimals.

    Examples:
        >>> p_value(0.0312), p_value(0.0002), p_value(1.0)
        ('0.031', '< 0.001', '1.000')
    """
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def words(name: str) -> str:
    """Return what a reader calls a metric or a label.

    Examples:
        >>> words("success_rate"), words("learned_from")
        ('goal rate', 'learned from')
    """
    return WORDS.get(name, name.replace("_", " "))


def _number(x: Cell) -> str | Number | None:
    if isinstance(x, Summary):
        return Number.of_summary(x)
    return Number(float(x)) if isinstance(x, int | float) else x


def _is_number(x: Cell) -> bool:
    return not isinstance(x, str) or bool(_LOOKS_LIKE_A_NUMBER.fullmatch(x))


def _shown(x: str | Number | None, digits: int) -> Shown:
    if isinstance(x, Number):
        if math.isnan(x.mean):
            return Shown(MISSING)
        return Shown(x.value(digits), x.interval(digits), x.remark, x.details(digits))
    return Shown(MISSING if x is None else x)


def number(x: float) -> str:
    """Format with three significant digits, never as an exponent."""
    if x == 0:
        return "0"
    magnitude = abs(x)
    return (
        f"{x:.0f}"
        if magnitude >= 1000
        else f"{x:.1f}"
        if magnitude >= 10
        else f"{x:.2f}"
        if magnitude >= 1
        else f"{x:.3f}"
    )


def brief(s: Summary) -> str:
    """Mean +- sd; of one seed its value, and that it is one run."""
    return mean_sd(s.mean, s.sd) if len(s.per_seed) > 1 else f"{number(s.mean)} (one run)"


def mean_sd(mean: float, sd: float) -> str:
    """Mean +- sd."""
    return f"{number(mean)} ± {number(sd)}"


def full(s: Summary) -> str:
    """Mean +- sd [95 % interval of the mean]; one seed has none."""
    return f"{brief(s)}{bounds(s.ci95)}"


def bounds(interval: Interval | None) -> str:
    """Return an interval in brackets after a space; nothing if there is none."""
    return "" if interval is None else f" [{number(interval[0])}, {number(interval[1])}]"


def study_table(study: Study, results: StudyResults) -> Table:
    """All rows of a study with the main metrics, without intervals: thousands of them would have to be resampled."""
    names = tuple(name for name, _ in study.rows[0].labels)
    count = len(results.seeds)
    rows = []
    for r in study.rows:
        moments = (results.moments(r.cell, m) for m in SHOWN)
        metrics = (Number(mean, None, sd if count > 1 else None, count) for mean, sd in moments)
        rows.append((*(str(v) for _, v in r.labels), *metrics))
    columns = (*map(words, names), *map(words, SHOWN))
    note = f"Mean ± standard deviation over {count} seeds."
    return Table(f"{study.title} ({study.answers})", columns, tuple(rows), len(names), note)
