"""Tables of studies, as data: for the terminal and for the report."""

from __future__ import annotations

from dataclasses import dataclass

from uard.lab.statistics import Interval, Summary
from uard.lab.study import Study
from uard.lab.views.study_results import StudyResults

SHOWN = ("hacks", "success_rate", "true_return", "observed_return", "alignment_gap")


@dataclass(frozen=True)
class Table:
    """A titled table of text; the first ``labels`` columns name the row."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    labels: int = 1
    note: str = ""


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
    """All rows of a study with the main metrics."""
    names = tuple(name for name, _ in study.rows[0].labels)
    rows = []
    for r in study.rows:
        moments = (results.moments(r.cell, m) for m in SHOWN)
        metrics = tuple(mean_sd(*x) if len(results.seeds) > 1 else f"{number(x[0])} (one run)" for x in moments)
        rows.append((*(str(v) for _, v in r.labels), *metrics))
    columns = (*names, *(m.replace("_", " ") for m in SHOWN))
    return Table(
        f"{study.title} ({study.answers})",
        columns,
        tuple(rows),
        len(names),
        f"mean ± sd over {len(results.seeds)} seeds",
    )
