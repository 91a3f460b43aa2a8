"""``uard raters``: who said what in a file of ratings, and how far it can be relied on. Needs no JAX."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from tyro.conf import Positional

from uard import InvalidValueError, __version__
from uard.cli import terminal
from uard.cli.settings import Words

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from uard.diagnosis.finding import Stratum
    from uard.ratings.log import RatingLog


@dataclass(frozen=True)
class Raters:
    """Say who of the raters in a file is noisy, biased, contrary, constant or a copy, and how many they are worth.

    Prints for every rater noise and bias with 95 % intervals, agreement over all and within parts, the effective number
    of raters, and how the pooled order of what was rated agrees with the raters' own.
    """

    file: Positional[str]
    """A CSV, JSON, JSONL or Parquet file, as `uard doctor` reads it: a row per answer, or a column per rater."""
    reward: str = "reward"
    """The column of rewards, if there is one; biases are against it."""
    ratings: tuple[str, ...] = ()
    """The annotators' columns; all that start with `rating` if left out."""
    rater: str | None = None
    """In a file of one answer per row, the column that says who rated."""
    item: str | None = None
    """The column that says what was rated."""
    rating: str | None = None
    """In a file of one answer per row, the column of ratings, or the question whose answers are read."""
    missing: Words = ()
    """A further word that means that a number is missing, e.g. '?'. Repeatable."""
    by: str | None = None
    """A column that divides the rows into parts, such as who wrote the answer; agreement is reported within each."""
    rank: str | None = None
    """In a file of one answer per row, a column of ranks (1 is the best) that the pooled order is compared with; the
    ratings if left out."""
    within: str | None = None
    """A column that divides the rows into groups, such as the question; only what is in one group is put in order."""
    json: str | None = None
    """Write one JSON object to this file; - for standard output."""

    def run(self, console: Console) -> None:
        """Read the file and print what is known of its raters."""
        from uard.diagnosis.strata import strata_of
        from uard.ratings.agreement import alpha_interval, krippendorff_alpha
        from uard.ratings.orders import orders
        from uard.ratings.raters import summary

        terminal.check_json(self.json, self.file)
        log = self._log(by=self.by)
        panel = summary(log)
        group = None if self.within is None else self._log(by=self.within).by
        order = orders(log, self._ranks(), group, self.within)
        alpha, ends = krippendorff_alpha(log.ratings), alpha_interval(log.ratings, log.item)
        strata = strata_of(log.by, log.ratings, log.item)
        if self.json is not None:
            agreement = {"alpha": alpha, "interval": ends, "within": [asdict(s) for s in strata]}
            data = panel.as_data() | {"agreement": agreement, "order": order.as_data()}
            terminal.write_json({"version": __version__} | data, self.json)
        if self.json != "-":
            width = terminal.width()
            terminal.lines("\n\n".join([panel.text(width), _agreement(alpha, ends, strata, width), order.text(width)]))

    def _log(self, by: str | None = None, rating: str | None = None) -> RatingLog:
        from uard.ratings import readers

        columns = {"rater": self.rater, "item": self.item, "rating": rating or self.rating, "by": by}
        return readers.read(self.file, self.reward, self.ratings or None, **columns, missing=self.missing)

    def _ranks(self) -> RatingLog | None:
        """Return the ranks as preferences: the lower, the better."""
        from dataclasses import replace

        if self.rank is None:
            return None
        if self.ratings:
            raise InvalidValueError("--rank", self.rank, "left out: it is for a file of one answer per row")
        log = self._log(rating=self.rank)
        return replace(log, ratings=-log.ratings, repeats=None)


def _agreement(alpha: float | None, ends: tuple[float, float] | None, strata: Sequence[Stratum], width: int) -> str:
    """Return a table of Krippendorff's alpha over all and within parts."""
    from uard._support.columns import text
    from uard.diagnosis.finding import interval

    found = [("over all", "", alpha, *(ends or (None, None)))]
    found += [(f"within {s.name}", str(s.rows), s.agreement, s.low, s.high) for s in strata]
    rows = [
        (name, n, "not defined" if a is None else f"{a:z.2f}{interval(low, high)}") for name, n, a, low, high in found
    ]
    return text(("agreement (1 perfect, 0 chance)", "rows", "Krippendorff's alpha [95 %]"), rows, width)
