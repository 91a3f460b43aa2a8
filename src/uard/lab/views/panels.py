"""Regret of every mitigation over random panels: who is better than whom, by how much, and where each is worst.

Regret = (oracle - method) / (oracle - random walk), by true return: 0 is as good as learning from the true reward, 1
is a random walk, and who hacks may have more. The scenario (grid or problem, and panel) is the unit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from uard.lab import statistics
from uard.lab.statistics import Summary
from uard.lab.studies.panels import FLOOR, ORACLE
from uard.lab.views.study_results import StudyResults
from uard.lab.views.tables import Table, number
from uard.ratings.panels import Panel

LEAST_SPREAD = 1e-6  # between oracle and random walk, below which there is nothing to regret


class Regrets(NamedTuple):
    """Regret by mitigation, one number per scenario.

    Attributes:
        scenarios: Their seeds.
        by_mitigation: Arrays of that length, by name.
    """

    scenarios: tuple[int, ...]
    by_mitigation: dict[str, np.ndarray]


def regrets(results: StudyResults, study: str) -> Regrets:
    """Return the regret of every mitigation in every scenario of a study.

    Args:
        results: Finished.
        study: Its name.
    """
    returns: dict[int, dict[str, float]] = {}
    for r in results.studies[study].rows:
        mean = float(results.values(r.cell, "true_return").mean())
        returns.setdefault(r["scenario"], {})[r["mitigation"]] = mean
    kept = {s: x for s, x in returns.items() if x[ORACLE] - x[FLOOR] > LEAST_SPREAD}
    names = [n for n in next(iter(kept.values())) if n not in (ORACLE, FLOOR)]
    by_name = {n: np.array([(x[ORACLE] - x[n]) / (x[ORACLE] - x[FLOOR]) for x in kept.values()]) for n in names}
    return Regrets(tuple(kept), by_name)


def table(found: Regrets, study: str, mine: str) -> Table:
    """Return mean, interval, worst scenario, and the paired difference to one mitigation, corrected for all rivals.

    Args:
        found: See ``regrets``.
        study: What the table is of.
        mine: The mitigation that the others are compared with.
    """
    rivals = [n for n in found.by_mitigation if n != mine]
    gaps = {n: found.by_mitigation[n] - found.by_mitigation[mine] for n in rivals}
    corrected = dict(zip(rivals, statistics.holm([_paired_p(gaps[n]) for n in rivals]), strict=True))
    rows = []
    for name, values in sorted(found.by_mitigation.items(), key=lambda item: item[1].mean()):
        worst = int(values.argmax())
        gap = "" if name == mine else _interval(statistics.summarise(gaps[name]))
        p = "" if name == mine else f"{corrected[name]:.2g}"
        mean = _interval(statistics.summarise(values))
        rows.append((name, mean, f"{number(values[worst])} (seed {found.scenarios[worst]})", gap, p))
    return Table(
        f"{study}: regret over {len(found.scenarios)} scenarios that nothing was tuned on",
        ("mitigation", "mean [95 %]", "worst", f"more than {mine} [95 %]", "p (Holm)"),
        tuple(rows),
        1,
        "0: as good as learning from the true reward; 1: a random walk. Intervals are bootstrapped over scenarios, p "
        f"values of paired sign-flip tests, corrected for {len(rivals)} rivals.",
    )


def _interval(s: Summary) -> str:
    return f"{s.mean:.3f} [{s.ci95[0]:.3f}, {s.ci95[1]:.3f}]"


def _paired_p(gaps: np.ndarray, flips: int = 9999) -> float:
    """Return the two-sided p value of a sign-flip test of mean 0."""
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (flips, len(gaps)))
    return float((1 + (np.abs(signs @ gaps) >= abs(gaps.sum()) - 1e-12).sum()) / (flips + 1))


def kind_of(panel: Panel) -> str:
    """Say what a random panel is like, by the worst that sits in it.

    Examples:
        >>> from uard.ratings.panels import MAIN, SINGLE
        >>> kind_of(SINGLE), kind_of(MAIN)
        ('one rater', 'some tempted')
    """
    if len(panel.raters) == 1:
        return "one rater"
    if any(r.lapse == 1 for r in panel.raters):
        return "some spamming"
    if any(r.temptation == 1 for r in panel.raters):
        return "some repeating"
    return "some tempted" if any(r.temptation > 0 for r in panel.raters) else "all truthful"


def by_kind(found: Regrets, panels: dict[int, Panel], study: str) -> Table:
    """Return the mean regret by kind of panel.

    Args:
        found: See ``regrets``.
        panels: Of every scenario.
        study: What the table is of.
    """
    kinds = np.array([kind_of(panels[s]) for s in found.scenarios])
    names = sorted(set(kinds.tolist()))
    rows = [
        (name, *(f"{values[kinds == k].mean():.3f}" for k in names)) for name, values in found.by_mitigation.items()
    ]
    return Table(
        f"{study}: mean regret by kind of panel",
        ("mitigation", *(f"{k} ({(kinds == k).sum()})" for k in names)),
        tuple(rows),
        1,
        "A panel is named by the worst that sits in it; how many scenarios in brackets.",
    )
