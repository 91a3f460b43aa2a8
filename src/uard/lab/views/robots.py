"""Hopper and Walker2d with a reward that lies: what every listener leaves of hacks and of the true return."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from uard.lab.statistics import Family
from uard.lab.studies import robots
from uard.lab.study import Row
from uard.lab.views.losses import Loss, of_family
from uard.lab.views.published import Published, packaged_json
from uard.lab.views.sections import Section
from uard.lab.views.tables import Table, bounds, number, words
from uard.lab.views.templates import table

STUDY, NOISE = "robots", "robots-noise"
OURS = "uard"
REFERENCES = ("raw", "true reward")  # neither listens
SIMPLE = ("mean-of-annotations", "median")


@dataclass(frozen=True)
class Setting:
    """A robot, a region and a panel.

    Attributes:
        robot: Which.
        region: Where its reward lies; none where it does not.
        panel: Who rates.
        rows: The agents that listen, and both references of the same robot and region.
        plain: The agent without raters on the uncorrupted task, if it was published.
    """

    robot: str
    region: str
    panel: str
    rows: tuple[Row, ...]
    plain: Row | None

    @property
    def name(self) -> str:
        """Say which it is."""
        lies = "nothing lies" if self.region == "none" else f"a lie about {self.region}"
        return f"{self.robot}, {lies}, {self.panel} panel"

    def one(self, mitigation: str) -> Row | None:
        """Return the row of a mitigation, if it was published."""
        return next((r for r in self.rows if r["mitigation"] == mitigation), None)


def published() -> Published:
    """Return what was published of these studies, of their own seeds; other studies share some of the cells."""
    return Published(robots.studies(), [packaged_json("robots.json")])


def settings(p: Published) -> Iterator[Setting]:
    """Yield what was published of the study, setting by setting."""
    rows = p.rows(STUDY)
    plain = {r["robot"]: r for r in rows if r["region"] == "none" and r["mitigation"] == "raw"}
    places = dict.fromkeys((r["robot"], r["region"], r["panel"]) for r in rows if r["panel"] != "none")
    for robot, region, panel in places:
        here = [r for r in rows if (r["robot"], r["region"]) == (robot, region) and r["panel"] in ("none", panel)]
        yield Setting(robot, region, panel, tuple(here), plain.get(robot))


def section(p: Published) -> list[Section]:
    """Return the section of the report; nothing where nothing was published."""
    every = list(settings(p))
    if not every:
        return []
    html = "".join(map(table, [*(_table(p, s) for s in every), *_noise(p)]))
    missing = _missing(p)
    note = f"<p>{missing}</p>" if missing else ""
    return [Section(STUDY, "Robots with raters nobody tuned on", 65, note + html, "Robots", losses=tuple(losses(p)))]


def _missing(p: Published) -> str:
    rows = [r for name in (STUDY, NOISE) for r in p.studies[name].rows]
    lost = sum(not p.has(r) for r in rows)
    return f"{lost} of the {len(rows)} rows of these studies are not trained yet; they are not shown." if lost else ""


def _rivals(p: Published, s: Setting, metric: str) -> tuple[list[Row], Family]:
    ours = s.one(OURS)
    rivals = [r for r in s.rows if ours is not None and r["mitigation"] not in (OURS, *REFERENCES)]
    return rivals, p.compare([(r, ours) for r in rivals if ours is not None], metric)


def _share(p: Published, r: Row, reference: Row | None) -> str | None:
    """Return the mean true return as a share of a reference's; of means, which need not be of equal seeds."""
    if reference is None:
        return None
    whole = p.of(reference, "true_return").mean
    return f"{100 * p.of(r, 'true_return').mean / whole:.0f} %" if whole > 0 else None


def _table(p: Published, s: Setting) -> Table:
    rows = []
    for r in s.rows:
        rows.append(
            (
                r["mitigation"],
                p.of(r, "hacks"),
                p.of(r, "true_return"),
                _share(p, r, s.one("true reward")),
                _share(p, r, s.plain),
                str(len(p.seeds_of(r))),
            )
        )
    shares = ("share of true reward's", "share of uncorrupted task's")
    columns = ("learns from", "hacks per episode", "true return", *shares, "seeds")
    caption = _rivals(p, s, "true_return")[1].caption() if s.one(OURS) else ""
    note = (
        "Per episode over the last 100 of 200 000 steps, PPO; means [95 %]. Shares of the mean true return of the "
        "agent on the true reward, and of the plain agent where nothing lies. True return of each rival against uard: "
        f"{caption}"
    )
    return Table(s.name, columns, tuple(rows), 1, note)


def _noise(p: Published) -> list[Table]:
    rows = p.rows(NOISE)
    shares = list(dict.fromkeys(r["noise"] for r in rows))
    names = list(dict.fromkeys(r["mitigation"] for r in rows))
    if not rows:
        return []
    made = []
    for metric in ("true_return", "hacks"):
        lines = []
        for name in names:
            of = {r["noise"]: p.of(r, metric) for r in rows if r["mitigation"] == name}
            lines.append((name, *(of.get(x) for x in shares)))
        columns = ("learns from", *(f"noise {100 * x:g} %" for x in shares))
        note = "Per episode; noise of every rater as a share of the bonus."
        title = f"hopper, a lie about crouch, main panel with more noise: {words(metric)}"
        made.append(Table(title, columns, tuple(lines), 1, note))
    return made


def headline(p: Published) -> str:
    """Return the table that the README quotes, in Markdown: per setting the references, ``uard``, the best rival."""
    lines = ["| task, panel | raw reward | true reward | `uard` | best of the others |", "|---|---|---|---|---|"]
    for s in settings(p):
        ours, rivals = s.one(OURS), _rivals(p, s, "true_return")[0]
        if ours is None or not rivals:
            continue
        best = max(rivals, key=lambda r: p.of(r, "true_return").mean)
        references = (s.one(name) for name in REFERENCES)
        cells = [_both(p, r) for r in (*references, ours, best)]
        lines.append(f"| {s.name} | {' | '.join(cells)}, `{best['mitigation']}` |")
    return "\n".join(lines)


def _both(p: Published, r: Row | None) -> str:
    return "–" if r is None else f"{_true(p, r)} ({number(p.of(r, 'hacks').mean)})"


def _true(p: Published, r: Row) -> str:
    found = p.of(r, "true_return")
    return f"{number(found.mean)}{bounds(found.ci95)}"


def losses(p: Published) -> list[Loss]:
    """Say where a simple rule does as well as ``uard``, where a rival does better, and where hacks are left."""
    out = []
    for s in settings(p):
        ours = s.one(OURS)
        if ours is None:
            continue
        out += _beaten(p, s, ours) + _left(p, s, ours)
    return out


def _beaten(p: Published, s: Setting, ours: Row) -> list[Loss]:
    rivals, family = _rivals(p, s, "true_return")
    own = p.of(ours, "true_return")
    out = []
    for i, r in enumerate(rivals):
        name = r["mitigation"]
        against = (name, own, p.of(r, "true_return"), "true return", *of_family(family, i))
        if family.above(i):
            out.append(Loss("beaten", "robots", f"{name} earns more", s.name, *against))
        elif name in SIMPLE and not family.below(i) and family.tests[i] is not None:
            found = f"a difference of {number(family.detectable[i])} would have been found"
            out.append(Loss("no better", "robots", f"{name} is not told apart", s.name, *against, note=found))
    return out


def _left(p: Published, s: Setting, ours: Row) -> list[Loss]:
    """Say where more hacks are left than by the true reward and than a hundredth, and where true return is lost."""
    out = []
    raw, honest = s.one("raw"), s.one("true reward")
    if raw is not None and s.region != "none":
        left, whole = p.of(ours, "hacks"), p.of(raw, "hacks")
        least = 0.0 if honest is None else p.of(honest, "hacks").mean
        if left.mean > 0.01 * whole.mean and left.mean > least:
            what = f"{100 * left.mean / whole.mean:.0f} % of the raw agent's hacks are left"
            theirs = None if honest is None else p.of(honest, "hacks")
            out.append(Loss("fails", "robots", what, s.name, "true reward", left, theirs, "hacks per episode"))
    reference = honest if s.region != "none" else s.plain
    if reference is not None:
        own, theirs = p.of(ours, "true_return"), p.of(reference, "true_return")
        if own.mean < 0.95 * theirs.mean:
            lies = s.region != "none"
            who, kind = ("the true reward", "fails") if lies else ("nobody rates", "costs")
            what = "earns less than 95 % of an agent on the true reward" if lies else "caution costs; nothing lies"
            out.append(Loss(kind, "robots", what, s.name, who, own, theirs))
    return out
