"""The first screen of the report: the answer in a sentence, one picture, three numbers. A reader may stop there.

Everything on it is computed from the regrets of the study of random panels (``uard.lab.views.panels``), the words of
the answer included: other results would make another sentence.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from markupsafe import Markup

from uard.lab import statistics
from uard.lab.statistics import Summary
from uard.lab.studies.panels import OURS, OWN
from uard.lab.views import choice, figures, panels
from uard.lab.views.panels import MUCH, Regrets
from uard.lab.views.sections import Section
from uard.lab.views.tables import Number, Table
from uard.lab.views.templates import HERE, render

NO_BREAK = "\N{NO-BREAK SPACE}"
RAW, PRINTED = "raw", "uard-paper"
SHADES = (0.05, 0.1, 0.25, 0.5, 1.0)  # regret from which a cell of the heat map is a shade darker


@dataclass(frozen=True)
class Square:
    """A cell of the heat map: what a mitigation loses with one kind of panel.

    Attributes:
        regret: Over scenarios.
        shade: 0 (least) to ``len(SHADES)``.
        said: All of it in words: interval, scenarios, seeds, settings.
    """

    regret: Summary
    shade: int
    said: str


@dataclass(frozen=True)
class HeatMap:
    """Regret of every mitigation by kind of panel.

    Attributes:
        groups: Kinds of tasks, and how many columns each has.
        columns: Kinds of panels, with the number of scenarios of each.
        rows: Mitigations, the least regret over all scenarios first, each with a square for every column.
    """

    groups: tuple[tuple[str, int], ...]
    columns: tuple[tuple[str, int], ...]
    rows: tuple[tuple[str, tuple[Square, ...]], ...]


def shade(regret: float) -> int:
    """Return how dark a regret is drawn.

    Examples:
        >>> [shade(x) for x in (-0.1, 0.04, 0.05, 0.3, 2.0)]
        [0, 0, 1, 3, 5]
    """
    return int(np.searchsorted(SHADES, regret, side="right"))


def heat_map(found: Sequence[Regrets], seeds: int) -> HeatMap:
    """Return the heat map of some kinds of tasks.

    Args:
        found: Regrets, of the same mitigations.
        seeds: Of every mitigation in every scenario.
    """
    everyone = sorted(found[0].regret, key=lambda name: float(np.concatenate([r.regret[name] for r in found]).mean()))
    parts = [(r, {"all": np.ones(len(r.scenarios), bool)} | panels.by_kind_of_panel(r)) for r in found]
    rows = tuple(
        (name, tuple(_square(r, name, kind, here, seeds) for r, kinds in parts for kind, here in kinds.items()))
        for name in everyone
    )
    columns = tuple((kind, int(here.sum())) for _, kinds in parts for kind, here in kinds.items())
    return HeatMap(tuple((r.tasks, len(kinds)) for r, kinds in parts), columns, rows)


def _square(found: Regrets, name: str, kind: str, here: np.ndarray, seeds: int) -> Square:
    values = found.regret[name][here]
    s = statistics.summarise(values)
    ends = "" if s.ci95 is None else f" [{s.ci95[0]:.3f}, {s.ci95[1]:.3f}]"
    who = "all panels" if kind == "all" else kind
    said = (
        f"{name}, {found.tasks}, {who}: regret {s.mean:.3f}{ends}, sd {s.sd:.3f}, worst {values.max():.2f}; "
        f"{values.size} scenarios, {seeds} seeds each"
    )
    return Square(s, shade(s.mean), said)


def answer(found: Sequence[Regrets]) -> str:
    """Answer in a few words whether the method works, as the paper prints it and as it is here.

    Examples:
        >>> from uard.lab.studies.panels import FLOOR, ORACLE
        >>> def tried(ours, printed, excess):
        ...     noise = np.linspace(-0.05, 0.05, 20)
        ...     known = {ORACLE: np.ones(20), FLOOR: np.zeros(20) - 3, "raw": -5 + noise}
        ...     given = {"uard": 1 - ours + noise, "uard-paper": 1 - printed + noise, "excess": 1 - excess - noise}
        ...     return answer([Regrets.of("grids", range(20), known | given)])
        >>> tried(0.1, 3.0, 0.1)
        'Yes, but not as the paper prints it; and a simpler rule, excess, is on average not told apart from it.'
        >>> tried(0.1, 0.2, 2.0)
        'Yes.'
        >>> tried(6.0, 7.0, 2.0)
        'No: learning from the plain reward is no worse.'
    """
    if not all(_below(r.regret[OURS], r.regret[RAW]) for r in found):
        return "No: learning from the plain reward is no worse."
    printed = all(statistics.summarise(r.regret[PRINTED]).mean < MUCH for r in found if PRINTED in r.regret)
    said = "Yes" if printed else "Yes, but not as the paper prints it"
    equal = simplest_equal(found)
    return f"{said}; and a simpler rule, {equal}, is on average not told apart from it." if equal else f"{said}."


def simplest_equal(found: Sequence[Regrets]) -> str | None:
    """Return a rule that no kind of tasks tells apart from ours, the one with the least regret; None if all are."""
    told = [{r.name: r.corrected < statistics.LEVEL for r in panels.rivals(one)} for one in found]
    equal = [n for n in found[0].regret if n not in OWN and all(n in t and not t[n] for t in told)]
    return min(equal, key=lambda n: float(np.mean([r.regret[n].mean() for r in found]))) if equal else None


def _below(ours: np.ndarray, theirs: np.ndarray) -> bool:
    return float(np.mean(theirs - ours)) > 0 and statistics.paired_sign_flip_p(theirs - ours) < statistics.LEVEL


def three(found: Sequence[Regrets]) -> list[tuple[str, str]]:
    """Return the three numbers that a reader should keep, each with what it says."""
    ours, raw = _means(found, OURS), _means(found, RAW, interval=False)
    lost = [r.regret[OURS] > MUCH for r in found]
    bad, all_of_them = sum(int(x.sum()) for x in lost), sum(x.size for x in lost)
    equal = simplest_equal(found)
    second = (
        (_means(found, equal), f"of it is lost with {equal}, a simpler rule")
        if equal
        else (_means(found, (best := best_rival(found))), f"of it is lost with {best}, the best of the others")
    )
    return [
        (
            ours,
            f"of the way from the true reward to a random walk is lost with uard; with raw {raw}",
        ),
        second,
        (
            f"{bad} of {all_of_them}",
            "scenarios in which uard loses more than a quarter of that way",
        ),
    ]


def best_rival(found: Sequence[Regrets]) -> str:
    """Return the mitigation with the least mean regret that is not ours."""
    names = [n for n in found[0].regret if n not in OWN]
    return min(names, key=lambda n: float(np.mean([r.regret[n].mean() for r in found])))


def _means(found: Sequence[Regrets], name: str, interval: bool = True) -> str:
    means = (_percent(statistics.summarise(r.regret[name]), interval) for r in found)
    named = (f"{r.tasks.removeprefix('random ')} {mean}" for r, mean in zip(found, means, strict=True))
    return ", ".join(x.replace(" ", NO_BREAK) for x in named)


def _percent(s: Summary, interval: bool) -> str:
    ends = f" [{100 * s.ci95[0]:.0f}, {100 * s.ci95[1]:.0f}]" if interval and s.ci95 else ""
    return f"{100 * s.mean:.0f} %{ends}"


def section(found: Sequence[Regrets], seeds: int, command: str) -> Section:
    """Return the first screen.

    Args:
        found: Regrets of the study of random panels.
        seeds: Of every mitigation in every scenario.
        command: What makes it.
    """
    edges = [f"{low:g}–{high:g}" for low, high in pairwise((0, *SHADES))] + [f"{SHADES[-1]:g}+"]
    html = render(
        HERE,
        "front.html.j2",
        answer=answer(found),
        map=heat_map(found, seeds),
        edges=edges,
        three=three(found),
        command=command,
        ours=OURS,
    )
    css, js = (Markup((HERE / f"front.{kind}").read_text(encoding="utf-8")) for kind in ("css", "js"))
    csv = {"regret-by-panel.csv": as_csv(heat_map(found, seeds))}
    return Section("front", "", 1, html, "Answer", css, js, files=csv, page="index.html")


def choose(found: Sequence[Regrets]) -> Section:
    """Return when a simple rule is enough: by kind of panel and by share of rated steps."""
    tables = [
        _choices(found, "by the worst rater in the panel", "panel", choice.by_kind),
        _choices(found, "by how much is rated", "rated", choice.by_share_rated),
    ]
    html = render(HERE, "choose.html.j2", tables=tables, near=choice.NEAR, much=choice.TOO_MUCH)
    return Section("choose", "When a simple rule is enough", 10, html, page="index.html")


def _choices(
    found: Sequence[Regrets], title: str, head: str, group: Callable[[Regrets], Mapping[str, np.ndarray]]
) -> Table:
    rows = [
        (
            r.tasks,
            x.kind,
            x.scenarios,
            x.simplest or "none",
            None if x.simplest_regret is None else Number.of_summary(x.simplest_regret, of="scenarios"),
            Number.of_summary(x.ours, of="scenarios"),
        )
        for r in found
        for x in choice.choices(r, group(r))
    ]
    columns = ("tasks", head, "scenarios", "simplest that is enough", "its regret", "regret of uard")
    return Table(f"The simplest rule that is enough, {title}", columns, tuple(rows), 2)


def as_csv(drawn: HeatMap) -> str:
    """Return what the heat map shows, a line for each square."""
    groups = [tasks for tasks, count in drawn.groups for _ in range(count)]
    rows: list[tuple[figures.Cell, ...]] = []
    for name, squares in drawn.rows:
        for tasks, (kind, count), square in zip(groups, drawn.columns, squares, strict=True):
            s = square.regret
            rows.append((name, tasks, kind, float(count), s.mean, *(s.ci95 or (None, None)), s.sd))
    return figures.as_csv(("mitigation", "tasks", "panel", "scenarios", "regret", "low", "high", "sd"), rows)
