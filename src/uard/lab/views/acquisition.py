"""Who is asked what, in the report: whether asking at random is as good, found by rule; one figure, three tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from uard.lab import statistics
from uard.lab.statistics import Summary
from uard.lab.views.figures import axes_of
from uard.lab.views.tables import Table
from uard.ratings.panels import is_for_development

BASE = "random"
COLOURS = {
    "random": "#777777",
    "disputed": "#c1272d",
    "least-known": "#2c6fbb",
    "highest-reward": "#1b8a4b",
    "near-ties": "#7b4fa3",
    "half random, half disputed": "#e08214",
    "half random, half highest-reward": "#6abf69",
}


@dataclass(frozen=True)
class Compared:
    """How a rule compares with asking at random in one setting.

    Attributes:
        setting: Of the study.
        rule: Its name.
        gap: Of what is compared, the rule's less that of random, over seeds.
        p: Two-sided, of the paired sign-flip test, for itself.
        corrected: The same after Holm, for all rules and settings.
    """

    setting: str
    rule: str
    gap: Summary
    p: float
    corrected: float

    @property
    def told_apart(self) -> bool:
        """Whether they differ after correction."""
        return self.corrected < statistics.LEVEL


def needed(data: Mapping[str, Any], regret: np.ndarray) -> np.ndarray:
    """Return for each seed after how many answers regret is at most the target for good; the last number if never.

    Examples:
        >>> data = {"answers": [0, 10, 20, 30], "target": 0.2}
        >>> needed(data, np.array([[1.0, 0.0, 0.3, 0.1], [1.0, 1.0, 1.0, 1.0], [0.1, 0.2, 0.0, 0.0]])).tolist()
        [30.0, 30.0, 0.0]

    Args:
        data: Of the study.
        regret: (seeds, answers).
    """
    answers = np.array(data["answers"], float)
    # How many numbers there are up to the last at which regret is above the target.
    until = np.where(regret > data["target"], np.arange(1, len(answers) + 1), 0).max(1)
    return answers[np.minimum(until, len(answers) - 1)]


def over_all(data: Mapping[str, Any], regret: np.ndarray) -> np.ndarray:
    """Return for each seed the mean regret while answers come in, from none to the last number.

    Examples:
        >>> over_all({"answers": [0, 10, 30]}, np.array([[1.0, 0.0, 0.0]])).round(3).tolist()
        [0.167]

    Args:
        data: Of the study.
        regret: (seeds, answers).
    """
    answers = np.array(data["answers"], float)
    return np.trapezoid(regret, answers, axis=1) / answers[-1]


Measure = Callable[[Mapping[str, Any], np.ndarray], np.ndarray]


def compare(data: Mapping[str, Any], measure: Measure) -> list[Compared]:
    """Compare every rule with asking at random in every setting, seed by seed; corrected for all of them.

    Args:
        data: Of the study.
        measure: ``needed`` or ``over_all``.
    """
    gaps: dict[tuple[str, str], np.ndarray] = {}
    for setting in data["settings"]:
        values = {r["rule"]: measure(data, np.array(r["regret"])) for r in setting["rules"]}
        gaps |= {(setting["setting"], rule): v - values[BASE] for rule, v in values.items() if rule != BASE}
    p = [statistics.paired_sign_flip_p(gap) for gap in gaps.values()]
    compared = zip(gaps.items(), p, statistics.holm(p), strict=True)
    return [Compared(*key, statistics.summarise(gap), own, corrected) for (key, gap), own, corrected in compared]


def losses(data: Mapping[str, Any]) -> list[str]:
    """Say for every setting which rules are no better than asking at random, by mean regret while answers come in."""
    compared = compare(data, over_all)
    said: list[str] = []
    for setting in dict.fromkeys(c.setting for c in compared):
        here = [c for c in compared if c.setting == setting]
        parts: list[str] = []
        if same := [c for c in here if not c.told_apart]:
            seeds = f"as far as {len(data['seeds'])} seeds can tell"
            parts.append(f"random is as good as {'; '.join(map(_named, same))}: not told apart, {seeds}")
        if worse := [c for c in here if c.told_apart and c.gap.mean > 0]:
            parts.append(f"random is better than {'; '.join(map(_named, worse))}")
        if parts:
            raters = f"at most {data['overlap']} raters an item"
            head = f"Who is asked what, {setting}, {raters}, difference of mean regret [95 %]"
            said.append(f"{head}: {'. And '.join(parts)}.")
    return said


def _named(c: Compared) -> str:
    return f"{c.rule} ({_signed(c.gap, 3)}, p = {c.corrected:.2g} after Holm)"


def _signed(gap: Summary, digits: int) -> str:
    mean, *ends = (f"{round(x, digits) + 0.0:+.{digits}f}" for x in (gap.mean, *(gap.ci95 or ())))  # no -0.0
    return f"{mean} [{', '.join(ends)}]" if ends else f"{mean} (one run)"


def _mean(values: np.ndarray, digits: int) -> str:
    s = statistics.summarise(values)
    ends = f" [{s.ci95[0]:.{digits}f}, {s.ci95[1]:.{digits}f}]" if s.ci95 else " (one run)"
    return f"{s.mean:.{digits}f}{ends}"


def tables(data: Mapping[str, Any]) -> list[Table]:
    """Return answers needed, mean regret, and regret at fixed numbers of answers, each by setting and rule."""
    last, target = data["answers"][-1], data["target"]
    return [
        _tested(
            data,
            needed,
            0,
            f"answers until regret is at most {target:g}",
            f"For good; where that is never, {last} are counted.",
        ),
        _tested(data, over_all, 3, f"mean regret from no answer to {last}", ""),
        budgets(data),
    ]


def _tested(data: Mapping[str, Any], measure: Measure, digits: int, what: str, note: str) -> Table:
    """Return a measure by setting and rule, and the difference to random."""
    compared = compare(data, measure)
    tests = {(c.setting, c.rule): c for c in compared}
    rows: list[tuple[str, ...]] = []
    for setting in data["settings"]:
        for r in setting["rules"]:
            regret = np.array(r["regret"])
            found = tests.get((setting["setting"], r["rule"]))
            more = ("", "") if found is None else (_signed(found.gap, digits), f"{found.corrected:.2g}")
            reached = f"{(regret[:, -1] <= data['target']).sum()} of {len(regret)}"
            rows.append((setting["setting"], r["rule"], _mean(measure(data, regret), digits), *more, reached))
    columns = ("items", "rule", "mean [95 %]", "more than random [95 %]", "p (Holm)", "reached at last")
    alone = sum(c.p < statistics.LEVEL for c in compared)
    tuned = ", some of which may be tuned on" if any(map(is_for_development, data["seeds"])) else ""
    return Table(
        f"Who is asked what: {what}",
        columns,
        tuple(rows),
        2,
        f"{note} Over {len(data['seeds'])} seeds{tuned}; {data['command']}. Regret: 0 is the best, 1 a random walk or "
        f"a clip picked at random. Paired sign-flip tests by seed, corrected for {len(compared)}; uncorrected {alone} "
        f"differ, about {statistics.LEVEL * len(compared):.1f} would by chance.".strip(),
    )


def budgets(data: Mapping[str, Any]) -> Table:
    """Return regret at fixed numbers of answers by setting and rule."""
    places = [data["answers"].index(b) for b in data["budgets"]]
    rows: list[tuple[str, ...]] = []
    for setting in data["settings"]:
        whole = _mean(np.array(setting["everything"]), 2)
        for r in setting["rules"]:
            regret = np.array(r["regret"])
            cells = (_mean(regret[:, i], 2) for i in places)
            rows.append((setting["setting"], r["rule"], *cells, whole if r["rule"] == BASE else ""))
    sizes = "; ".join(
        f"{s['setting']}: {_span(s['items'])} items, {_span(s['raters'])} raters" for s in data["settings"]
    )
    return Table(
        "Who is asked what: regret at fixed numbers of answers",
        ("items", "rule", *(f"{b} answers" for b in data["budgets"]), "all that all can say"),
        tuple(rows),
        2,
        f"Mean [95 % interval] over {len(data['seeds'])} seeds; not tested for themselves. {sizes}.",
    )


def _span(numbers: list[int]) -> str:
    low, high = min(numbers), max(numbers)
    return f"{low}" if low == high else f"{low} to {high}"


def figure(data: Mapping[str, Any]) -> Figure:
    """Draw mean regret against answers for every setting; the band is the interval of asking at random."""
    drawn, axes = axes_of(len(data["settings"]), 4.0, 4.0)
    for axis, setting in zip(axes, data["settings"], strict=True):
        for r in setting["rules"]:
            regret, colour = np.array(r["regret"]), COLOURS[r["rule"]]
            axis.plot(data["answers"], regret.mean(0), color=colour, lw=1.6, label=r["rule"])
            if r["rule"] == BASE and len(regret) > 1:
                low, high = statistics.intervals(regret.T).T
                axis.fill_between(data["answers"], low, high, color=colour, alpha=0.15, lw=0)
        axis.set(xlabel="answers", title=setting["setting"])
    axes[0].set_ylabel("regret")
    shown = {label: line for axis in axes for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    drawn.legend(shown.values(), shown, loc="outside lower center", ncols=4, fontsize=9)
    return drawn
