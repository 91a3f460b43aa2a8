"""Writes the numbers of README and docs from stored results: ``python docs/make_numbers.py [--check] [--train]``.

A number stands between ``<!-- numbers: NAME -->`` and ``<!-- end -->``, in a paragraph or around a whole table, and
NAME is a function of this file. ``--check`` writes nothing, names what differs, and exits with 1 if anything does.
Everything but the paper's table and the first example comes from results that are published with the package; these two
are trained (a minute), and only with ``--train``.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from uard._support import moved
from uard.lab import statistics, studies
from uard.lab.execution import runner
from uard.lab.execution.store import Store
from uard.lab.statistics import Family, Summary
from uard.lab.views import choice, grpo, panels, robots
from uard.lab.views.panels import Regrets
from uard.lab.views.published import packaged
from uard.lab.views.study_results import StudyResults

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"<!-- numbers: ([\w-]+) -->(.*?)<!-- end -->", re.DOTALL)
OURS = "uard"
MUCH = 0.25  # regret: a quarter of what the true reward is worth
WORDS = {  # what a panel is called after the worst that sits in it
    "all truthful": "all tell the truth",
    "some answering at random": "some answer at random",
    "some tempted": "some are tempted by the same lie",
    "some repeating the proxy": "some repeat the reward",
    "one rater": "one rater",
}
TASKS = {"random grids": "grids", "random MDPs": "MDPs"}
HEADLINE = {  # of the README: from what needs no thought to ours
    "raw": "the reward as it is (`raw`)",
    "mean-of-annotations": "the mean of the ratings (`mean-of-annotations`)",
    "min-proxy-median": "the reward, at most the median rating (`min-proxy-median`)",
    "excess": "the reward, capped by what raters agree on (`excess`)",
    OURS: "**`uard`**",
}


def pages() -> list[Path]:
    """Return all pages that may hold numbers."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


@cache
def regrets() -> tuple[Regrets, ...]:
    """Return what was published of random panels, one for each kind of tasks."""
    (study,) = studies.find(("panels",))
    return tuple(panels.regrets(study, packaged().per_seed))


def shown(s: Summary | None, digits: int = 2) -> str:
    """Return mean and interval, such as 0.05 [0.01, 0.10]."""
    if s is None:
        return "–"
    mean, *ends = (fixed(x, digits) for x in (s.mean, *(s.ci95 or ())))
    return f"{mean} [{', '.join(ends)}]" if ends else f"{mean} (one run)"


def fixed(x: float, digits: int) -> str:
    """Return a number with so many decimals, and no minus before a nought."""
    return f"{round(x, digits) + 0.0:.{digits}f}"


def table(columns: Sequence[str], rows: Sequence[Sequence[str]], words: Sequence[str] = ()) -> str:
    """Return a Markdown table; all columns but the first are numbers, and those of these names."""
    sides = ["---" if i == 0 or name in words else "---:" for i, name in enumerate(columns)]
    lines = [columns, sides, *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def listed(names: Sequence[str], last: str = "and") -> str:
    """Return names in one phrase.

    >>> listed(["a", "b", "c"])
    '`a`, `b` and `c`'
    """
    quoted = [f"`{name}`" for name in names]
    return quoted[0] if len(quoted) == 1 else f"{', '.join(quoted[:-1])} {last} {quoted[-1]}"


# What README and docs/results.md say.


def headline() -> str:
    """Return regret of five rules, in two columns."""
    columns = [f"{len(these.scenarios)} random {TASKS[these.tasks]}" for these in regrets()]
    rows = [
        (words, *(shown(statistics.summarise(these.regret[name])) for these in regrets()))
        for name, words in HEADLINE.items()
    ]
    return table(("what the agent learns from", *columns), rows)


def not_better() -> str:
    """Say in a few lines where ``uard`` loses or is not better, the simplest rule first."""
    first, *others = (set(_like_ours(these)) for these in regrets())
    everywhere = first.intersection(*others)
    parts = []
    if everywhere:
        verb = "is" if len(everywhere) == 1 else "are"
        parts.append(f"{listed(_by_simplicity(everywhere))} {verb} different from `uard` beyond noise in no column")
    for these, same in zip(regrets(), (first, *others), strict=True):
        if more := _by_simplicity(same - everywhere):
            parts.append(f"on {TASKS[these.tasks]} neither {'is' if len(more) == 1 else 'are'} {listed(more)}")
    for these, c in _each_choice():
        if c.told_apart and c.simplest != OURS:
            who = WORDS[c.kind].replace("some ", "some raters ").replace("all ", "all raters ")
            parts.append(
                f"on {TASKS[these.tasks]} where {who} `{c.simplest}` is better, {shown(c.simplest_regret)} "
                f"against {shown(c.ours)}"
            )
    return f"**Where it is not better:** {'; '.join([*parts, lost()])}."


def _like_ours(these: Regrets) -> list[str]:
    """Return the rules that are not told apart from ours, but for ours in another setting."""
    every = (r for r in panels.rivals(these) if not r.name.startswith(f"{OURS},"))
    return [r.name for r in every if r.corrected >= statistics.LEVEL]


def _by_simplicity(names: set[str]) -> list[str]:
    return [name for name in choice.SIMPLICITY if name in names]


def lost() -> str:
    """Say in how many scenarios ``uard`` loses much."""
    counts = [
        f"{int((these.regret[OURS] > MUCH).sum())} of {len(these.scenarios)} {TASKS[these.tasks]}"
        for these in regrets()
    ]
    return f"in {' and '.join(counts)} `uard` loses more than a quarter of what the true reward is worth"


def _each_choice() -> Iterator[tuple[Regrets, choice.Choice]]:
    for these in regrets():
        for c in choice.choices(these):
            yield these, c


def told_apart() -> str:
    """Say of every rule whether it has more or less regret than ``uard`` beyond noise."""
    lines = []
    for these in regrets():
        apart = [r for r in panels.rivals(these) if r.corrected < statistics.LEVEL]
        parts = (
            ("less regret beyond noise", [r.name for r in apart if r.gap.mean < 0]),
            ("not told apart from `uard`", _like_ours(these)),
            ("more regret beyond noise", [r.name for r in apart if r.gap.mean > 0]),
        )
        said = "; ".join(f"{what}: {listed(names) if names else 'none'}" for what, names in parts)
        lines.append(f"* On {these.tasks}, {said}.")
    return "\n".join(lines)


def every_panel() -> str:
    """Return the regret of every rule, in two columns."""
    return panels.headline(regrets())


def every_robot() -> str:
    """Return true return and hacks of robots."""
    return robots.headline(robots.published())


def every_grpo() -> str:
    """Return gold of a language model against reward models."""
    return grpo.headline(grpo.published())


# What docs/choose.md says.


def choose_short() -> str:
    """Say for each kind of panel what is enough, on each kind of tasks."""
    found: dict[str, list[str]] = {}
    for these, c in _each_choice():
        rule = f"`{c.simplest}`" if c.simplest else "nothing"
        found.setdefault(c.kind, []).append(f"{rule} on {TASKS[these.tasks]}")
    rows = [f"* **{WORDS[kind].capitalize()}**: {', '.join(rules)}." for kind, rules in _in_order(found).items()]
    both = set.intersection(*(set(_overall(these).sufficient) for these in regrets()))
    order = [name for name in choice.SIMPLICITY if name in both]
    return "\n".join([*rows, f"* **Nobody knows who they are**: {listed(order, 'or')}."])


def _overall(these: Regrets) -> choice.Choice:
    (made,) = choice.choices(these, {"all": np.ones(len(these.scenarios), bool)})
    return made


def _in_order(by_kind: Mapping[str, list[str]]) -> dict[str, list[str]]:
    return {kind: by_kind[kind] for kind in WORDS if kind in by_kind}


def _choices(these: Regrets, first: str, groups: Mapping[str, np.ndarray]) -> str:
    rows = []
    for c in choice.choices(these, groups):
        apart = "–" if c.simplest in (OURS, None) else "yes" if c.told_apart else "no"
        enough = f"`{c.simplest}`" if c.simplest else f"nothing; least: `{c.best}`"
        rows.append((f"{c.kind} ({c.scenarios})", enough, shown(c.simplest_regret), shown(c.ours), apart))
    return table((first, "enough", "its regret", "`uard`", "told apart"), rows, ("enough", "told apart"))


def _kinds(these: Regrets) -> str:
    by_kind = choice.by_kind(these)
    return _choices(
        these,
        "raters",
        {WORDS[kind]: by_kind[kind] for kind in WORDS} | {"all panels": np.ones(len(these.scenarios), bool)},
    )


def choose_grids() -> str:
    """Return what is enough on random grids, by kind of panel."""
    return _kinds(regrets()[0])


def choose_decisions() -> str:
    """Return what is enough on random MDPs, by kind of panel."""
    return _kinds(regrets()[1])


def choose_share() -> str:
    """Return what is enough by the share of steps that are rated."""
    made = []
    for these in regrets():
        groups = {
            f"{TASKS[these.tasks]}, {kind.split(' of ')[0]}": g for kind, g in choice.by_share_rated(these).items()
        }
        made.append(_choices(these, "steps rated", groups))
    first, *others = made
    return "\n".join([first, *("\n".join(m.splitlines()[2:]) for m in others)])


def choose_judges() -> str:
    """Return gold of the mean of judges and of ``uard``, and which rules are told apart from it."""
    rows = []
    for condition, rules in grpo.conditions(grpo.published()):
        by_name = {r.row["rule"]: r for r in rules}
        which, family = grpo.against_ours(rules)
        for i, place in ((grpo.NEAR, "at KL 1"), (len(grpo.DISTANCES), "at the end")):
            golds = (by_name[n].end if place == "at the end" else by_name[n].gold[:, i] for n in ("mean", OURS))
            mean, ours = (shown(statistics.summarise(gold)) for gold in golds)
            here = [k for k, (_, j) in enumerate(which) if j == i]
            told = [which[k][0].row["rule"] for k in here if family.adjusted[k] < statistics.LEVEL]
            found = fixed(float(np.median([family.detectable[k] for k in here])), 2)
            rows.append((f"{condition}, {place}", mean, ours, listed(told) if told else "none", found))
    told_apart = "told apart from `uard`"
    return table(("judges", "mean of judges", "`uard`", told_apart, "would be found"), rows, (told_apart,))


def choose_robots() -> str:
    """Return the true return of the mean of ratings and of ``uard``, and which rules are told apart from it."""
    p = robots.published()
    rows = []
    for s in robots.settings(p):
        ours, mean = s.one(OURS), s.one("mean-of-annotations")
        if ours is None or mean is None:
            continue
        rivals = [r for r in s.rows if r["mitigation"] not in (OURS, *robots.REFERENCES)]
        family = p.compare([(r, ours) for r in rivals], "true_return")
        told = [f"`{rivals[i]['mitigation']}` ({_way(family, i)})" for i in family.found]
        numbers = (shown(p.of(r, "true_return"), 0) for r in (mean, ours))
        rows.append((s.name, *numbers, ", ".join(told) or "none"))
    told_apart = "told apart from `uard`"
    return table(("robot", "mean of the ratings", "`uard`", told_apart), rows, (told_apart,))


def _way(family: Family, i: int) -> str:
    return "more" if family.above(i) else "less"


# What docs/migrating.md says.


@cache
def bench() -> Mapping[str, Any]:
    """Return what `make bench` wrote."""
    return json.loads((ROOT / "benchmarks" / "results" / "bench.json").read_text(encoding="utf-8"))


def speed() -> str:
    """Return the table of `make bench`, and where it was made."""
    found = bench()
    rows = [
        (
            x["what"],
            f"{x['value']:.3g} [{x['low']:.3g}, {x['high']:.3g}] {x['unit']}",
            "" if x["asked"] is None else f"{'at most' if x['most'] else 'at least'} {x['asked']:g}",
            {None: "", True: "yes", False: "**no**"}[x["met"]],
            "" if x["roof"] is None else f"{x['roof']:.3g} ({x['roof_is']})",
        )
        for x in found["lines"]
    ]
    versions = ", ".join(f"{name} {number}" for name, number in found["packages"].items() if number != "not installed")
    busy = f"load {found['load_at_the_start']:.1f} when it began"
    took = f"{sum(found['seconds'].values()) / 60:.0f} minutes"
    made = f"`{found['command']}`: {took}, {found['machine']}, {busy}; {versions}."
    return table(("what", "median [range]", "asked", "met", "roof"), rows, ("what", "met", "roof")) + f"\n\n{made}"


def cells_of_ray() -> Mapping[str, Any]:
    """Return what `benchmarks/many_cells.py` wrote."""
    return json.loads((ROOT / "benchmarks" / "results" / "many-cells.json").read_text(encoding="utf-8"))


def many_cells() -> str:
    """Return what a study of very many small cells costs on a cluster, and what the loss of its head."""
    found = cells_of_ray()
    lost, whole = found["head_lost"], _spaced(found["cells"])
    again = f"{lost['kept']} kept; the same command did the other {lost['then']}, none twice"
    rows = [
        (
            f"{whole} cells on 8 nodes of 2 workers",
            f"{found['seconds']:.0f} s, {found['cells_per_second']:.0f} a second",
        ),
        ("the driver's own CPU time a cell: handing out, packing, storing", f"{found['driver_ms_per_cell']:.2f} ms"),
        ("a worker's, the same batches without a cluster", f"{found['worker_ms_per_cell']:.2f} ms"),
        ("what these two leave of the cores", f"{_left(found):.0f} %: Ray, sixteen starts and compilations"),
        ("in the store", f"{found['bytes_per_cell']:.0f} bytes a cell"),
        (f"{_spaced(lost['in_all'])} cells, the head killed at a third of them", again),
    ]
    versions = ", ".join(f"{name} {number}" for name, number in found["versions"].items())
    made = f"`{found['command']}`: {found['cores']} cores for all nodes together; {versions}."
    return table(("measured", ""), rows, ("measured", "")) + f"\n\n{made}"


def _spaced(x: float) -> str:
    return f"{x:,.0f}".replace(",", " ")


def _left(found: Mapping[str, Any]) -> float:
    busy = 1e-3 * (found["driver_ms_per_cell"] + found["worker_ms_per_cell"]) * found["cells"]
    return 100 * (1 - busy / (found["cores"] * found["seconds"]))


TRAINING = (("a table (0.009 s)", 0.009), ("PPO on the grid (0.34 s)", 0.34), ("DQN on the grid (1.5 s)", 1.5))
TRAINING += (("the mix of `grid-deep` (7.5 s)", 7.5), ("MuJoCo, PPO, 150 000 steps (100 s)", 100.0))
"""CPU seconds of a seed, as the table of the guide has them."""
STORING = 1 / 500
"""CPU seconds that a result of full size takes to be packed and stored, as the table has it."""


def million() -> str:
    """Return the plan for a million cells of one seed, from what training takes and what the driver takes."""
    driver = 1e-3 * cells_of_ray()["driver_ms_per_cell"] + STORING
    rows = []
    for name, each in TRAINING:
        hours = [f"{max(1e6 * each / cores, 1e6 * driver) / 3600:.1f} h" for cores in (32, 320, 3200)]
        rows.append((name, _spaced(1e6 * each / 3600), *hours, _spaced(each / driver)))
    columns = ("a cell", "core hours", "1 node of 32", "10", "100", "cores that one driver feeds")
    said = f"The driver's {1e3 * driver:.1f} ms a cell, {1e6 * driver / 3600:.1f} h in all, are the least there is."
    return table(columns, rows, ("a cell",)) + f"\n\n{said}"


def adapters_cost() -> str:
    """Return what the adapters cost, side by side and in their own code."""
    lines = {x["what"].removeprefix("adapter: "): x for x in bench()["lines"] if x["what"].startswith("adapter: ")}
    rows = [
        (name, *(f"{y['value']:.1f} % [{y['low']:.1f}, {y['high']:.1f}]" for y in (x, lines[f"{name}, our code"])))
        for name, x in lines.items()
        if not name.endswith(", our code")
    ]
    return table(("training", "side by side", "in our own code"), rows, ("training",))


def _renamed(names: Mapping[str, str]) -> str:
    """Return old and new names, but for those that nobody outside could have used."""
    known = {old: new for old, new in names.items() if not re.search(r"(^|\.)_", old)}
    return table(("was", "is"), [(f"`uard.{old}`", f"`uard.{new}`") for old, new in known.items()], ("is",))


def moved_modules() -> str:
    """Return modules that have another name now."""
    return _renamed(moved.MODULES)


def moved_names() -> str:
    """Return names that went elsewhere than the rest of their module."""
    return _renamed(moved.NAMES)


# What is trained: the paper's table, and the first example.

PAPER = {
    "Q-learning on the raw reward": {"agent": "baseline", "panel": "main"},
    "a random walk": {"agent": "random walk", "panel": "main"},
    "`uard-paper`, as printed": {"agent": "uard-paper"},
    "`uard`": {"agent": "uard"},
}
PAPER_ROWS = (
    ("Q-learning on the raw reward", "any"),
    ("a random walk", "any"),
    ("`uard-paper`, as printed", "main"),
    ("`uard`", "main"),
    ("`uard`", "appendix"),
)
PAPER_METRICS = ("hacks", "success_rate", "true_return")


@cache
def paper_results() -> StudyResults:
    """Train the paper's grid, ten seeds of each agent."""
    (study,) = studies.find(("scale",))
    store, seeds = Store(":memory:"), range(10)
    rows = [r for r in study.rows if r["size"] == 10 and r["agent"] != "uard-consistent"]
    runner.run([(r.cell, s) for r in rows for s in seeds], store, workers=1)
    return StudyResults(store, seeds, [study])


def paper_row(results: StudyResults, name: str, panel: str) -> tuple[Summary, ...]:
    """Return the metrics of a row."""
    labels = {"panel": panel} | PAPER[name] | {"size": 10}
    return tuple(results.get("scale", metric, **labels) for metric in PAPER_METRICS)


def paper() -> str:
    """Return the paper's headline, ours beside it: mean and deviation over seeds."""
    rows = []
    for name, panel in PAPER_ROWS:
        found = paper_row(paper_results(), name, panel)
        rows.append(
            (name, panel, *(f"{fixed(s.mean, n)} ± {fixed(s.sd, n)}" for s, n in zip(found, (2, 2, 1), strict=True)))
        )
    return table(("agent", "panel", "trap visits", "goal rate", "true return"), rows, ("panel",))


def ten_minutes() -> str:
    """Return what the first example prints."""
    command = [sys.executable, str(ROOT / "examples" / "ten_minutes.py")]
    return f"```text\n{subprocess.run(command, capture_output=True, text=True, check=True).stdout}```"


TRAINED: dict[str, Callable[[], str]] = {"paper": paper, "ten-minutes": ten_minutes}
PUBLISHED: dict[str, Callable[[], str]] = {
    "headline": headline,
    "not-better": not_better,
    "lost": lost,
    "told-apart": told_apart,
    "panels": every_panel,
    "robots": every_robot,
    "grpo": every_grpo,
    "choose-short": choose_short,
    "choose-grids": choose_grids,
    "choose-decisions": choose_decisions,
    "choose-share": choose_share,
    "choose-judges": choose_judges,
    "choose-robots": choose_robots,
    "speed": speed,
    "many-cells": many_cells,
    "million": million,
    "adapters-cost": adapters_cost,
    "moved": moved_modules,
    "moved-names": moved_names,
}


def filled(text: str, makers: Mapping[str, Callable[[], str]]) -> str:
    """Return a page with the blocks of these makers written anew, and all others as they are.

    >>> filled("so <!-- numbers: two -->3<!-- end --> is it", {"two": lambda: "2"})
    'so <!-- numbers: two -->2<!-- end --> is it'

    Raises:
        KeyError: a block has a name that nobody here makes.
    """

    def block(found: re.Match[str]) -> str:
        name, old = found.groups()
        if name not in PUBLISHED | TRAINED | dict(makers):
            raise KeyError(f"<!-- numbers: {name} --> is none of {', '.join(PUBLISHED | TRAINED)}")
        made = makers[name]() if name in makers else old.strip("\n")
        end = "\n" if old.startswith("\n") else ""  # of a block, not of a phrase
        return f"<!-- numbers: {name} -->{end}{made}{end}<!-- end -->"

    return BLOCK.sub(block, text)


def stale(makers: Mapping[str, Callable[[], str]]) -> Iterator[tuple[Path, str, str]]:
    """Yield pages whose numbers are not what they would be: the page, what it is, what it would be."""
    for page in pages():
        text = page.read_text(encoding="utf-8")
        if (new := filled(text, makers)) != text:
            yield page, text, new


def main() -> int:
    """Write or check all pages."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if a page differs")
    parser.add_argument("--train", action="store_true", help="also what has to be trained")
    chosen = parser.parse_args()
    found = 0
    for page, old, new in stale(PUBLISHED | (TRAINED if chosen.train else {})):
        found += 1
        changed = [a.group(1) for a, b in zip(BLOCK.finditer(old), BLOCK.finditer(new), strict=True) if a[0] != b[0]]
        print(f"{page.relative_to(ROOT)}: {', '.join(changed)}{' is not what it should be' if chosen.check else ''}")
        if not chosen.check:
            page.write_text(new, encoding="utf-8")
    return int(chosen.check and found > 0)


if __name__ == "__main__":
    raise SystemExit(main())
