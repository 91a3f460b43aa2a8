"""Who is asked what, in the report: whether asking at random is as good, found by rule; one figure, three tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from uard.lab import statistics
from uard.lab.statistics import Summary
from uard.lab.views.figures import Chart, Picture
from uard.lab.views.losses import Loss
from uard.lab.views.tables import Cell, Number, Table, p_value
from uard.ratings.panels import is_for_development

BASE = "random"


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


def losses(data: Mapping[str, Any]) -> list[Loss]:
    """Say for every setting which rules are no better than asking at random, by mean regret while answers come in."""
    compared = compare(data, over_all)
    by_rule = {
        (setting["setting"], r["rule"]): statistics.summarise(over_all(data, np.array(r["regret"])))
        for setting in data["settings"]
        for r in setting["rules"]
    }
    said = []
    for c in compared:
        if c.told_apart and c.gap.mean < 0:
            continue
        what = f"asking by {c.rule} is worse than at random" if c.told_apart else f"asking by {c.rule}: as at random"
        where = f"{c.setting}, at most {data['overlap']} raters an item"
        numbers = (by_rule[c.setting, c.rule], by_rule[c.setting, BASE], "regret while answers come in")
        kind = "beaten" if c.told_apart else "no better"
        said.append(Loss(kind, "asking", what, where, BASE, *numbers, c.corrected, len(compared)))
    return said


def _named(c: Compared) -> str:
    return f"{c.rule} ({_signed(c.gap, 3)}, p = {c.corrected:.2g} after Holm)"


def _signed(gap: Summary, digits: int) -> str:
    mean, *ends = (f"{round(x, digits) + 0.0:+.{digits}f}" for x in (gap.mean, *(gap.ci95 or ())))  # no -0.0
    return f"{mean} [{', '.join(ends)}]" if ends else f"{mean} (one run)"


def tables(data: Mapping[str, Any]) -> list[Table]:
    """Return answers needed, mean regret, and regret at fixed numbers of answers, each by setting and rule."""
    last, target = data["answers"][-1], data["target"]
    return [
        _tested(
            data,
            needed,
            f"answers until regret is at most {target:g}",
            f"For good; where that is never, {last} are counted.",
        ),
        _tested(data, over_all, f"mean regret from no answer to {last}", ""),
        budgets(data),
    ]


def _tested(data: Mapping[str, Any], measure: Measure, what: str, note: str) -> Table:
    """Return a measure by setting and rule, and the difference to random."""
    compared = compare(data, measure)
    tests = {(c.setting, c.rule): c for c in compared}
    rows: list[tuple[Cell, ...]] = []
    for setting in data["settings"]:
        for r in setting["rules"]:
            regret = np.array(r["regret"])
            found = tests.get((setting["setting"], r["rule"]))
            gap: Cell = "" if found is None else Number.of_summary(found.gap, signed=True)
            p = "" if found is None else p_value(found.corrected)
            reached = f"{(regret[:, -1] <= data['target']).sum()} of {len(regret)}"
            measured = statistics.summarise(measure(data, regret))
            rows.append((setting["setting"], r["rule"], measured, gap, p, reached))
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
    rows: list[tuple[Cell, ...]] = []
    for setting in data["settings"]:
        whole = statistics.summarise(np.array(setting["everything"]))
        for r in setting["rules"]:
            regret = np.array(r["regret"])
            cells = (statistics.summarise(regret[:, i]) for i in places)
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


def picture_of(data: Mapping[str, Any]) -> Picture:
    """Draw mean regret against answers for every setting; the band is the interval of asking at random."""
    titles = [setting["setting"] for setting in data["settings"]]
    chart = Chart(titles, "answers of raters", "regret (0: best, 1: random)", columns=2, height=3.4)
    for i, setting in enumerate(data["settings"]):
        for r in setting["rules"]:
            regret = np.array(r["regret"])
            banded = r["rule"] == BASE and len(regret) > 1
            low, high = statistics.intervals(regret.T).T if banded else (None, None)
            chart.line(i, data["answers"], regret.mean(0), r["rule"], low, high)
        chart.axes[i].set(ylim=(0, None))
    note = (
        "See whether a coloured line leaves the grey band: inside it a rule is no better than asking at random. Lines "
        "are means over seeds, the band is the 95 % interval of asking at random."
    )
    first, overlap = data["seeds"][0], data["overlap"]
    title = f"Regret against answers, by rule: seeds from {first}, at most {overlap} raters an item"
    return chart.picture(f"acquisition-{first}-{overlap}", title, note, data["command"])
