"""Tables of studies, as data: for the terminal and for the report."""

from __future__ import annotations

from dataclasses import dataclass

from uard.lab.statistics import Summary
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
    """Mean +- sd."""
    return mean_sd(s.mean, s.sd)


def mean_sd(mean: float, sd: float) -> str:
    """Mean +- sd."""
    return f"{number(mean)} ± {number(sd)}"


def full(s: Summary) -> str:
    """Mean +- sd [95 % interval of the mean]."""
    return f"{brief(s)} [{number(s.ci95[0])}, {number(s.ci95[1])}]"


def study_table(study: Study, results: StudyResults) -> Table:
    """All rows of a study with the main metrics."""
    names = tuple(name for name, _ in study.rows[0].labels)
    rows = []
    for r in study.rows:
        metrics = tuple(mean_sd(*results.moments(r.cell, m)) for m in SHOWN)
        rows.append((*(str(v) for _, v in r.labels), *metrics))
    columns = (*names, *(m.replace("_", " ") for m in SHOWN))
    return Table(
        f"{study.title} ({study.answers})",
        columns,
        tuple(rows),
        len(names),
        f"mean ± sd over {len(results.seeds)} seeds",
    )
