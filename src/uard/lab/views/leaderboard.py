"""The leaderboard: mitigations x environments, made of whatever cells a store holds and of nothing else.

Names are found by comparing a cell's stored configuration with what names stand for, so that a cell needs neither its
study nor, if a package brought it, that package.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from uard import InvalidValueError, __version__
from uard._support import files
from uard.lab import registry as names
from uard.lab import statistics
from uard.lab.config import TYPE, plain
from uard.lab.execution.store import Store
from uard.lab.views.tables import number
from uard.lab.views.templates import HERE, render
from uard.method.mitigations import NAMED, named
from uard.ratings.panels import PANELS, Panel, Rater

RAW = "raw"
HONEST, OWN, COLLUDING, TWIN = "honest raters", "panels without a name", "colluding raters", "legitimate twin"


@dataclass(frozen=True)
class Estimate:
    """A mean over seeds, its 95 % interval (``statistics.interval``; None for one seed), and the values by seed."""

    mean: float
    ci95: statistics.Interval | None
    values: Mapping[int, float]


@dataclass(frozen=True)
class Line:
    """One cell.

    Attributes:
        environment: Its name, and what differs from what the name stands for; so are those of ``agent`` and
            ``mitigation``.
        agent: See ``environment``.
        mitigation: See ``environment``.
        panel: Who rates; "–" for the raw reward.
        noise: Standard deviation of extra noise on every rater.
        rated: Fraction of steps that are rated.
        trained: For how long, and whatever else is unusual.
        control: ``HONEST``, ``OWN``, ``COLLUDING`` or ``TWIN``.
        seeds: Finished ones.
        failed: Seeds that could not be trained.
        hacks: Share of steps that are hacks; None without finished seeds.
        true: True return; None without finished seeds.
    """

    environment: str
    agent: str
    mitigation: str
    panel: str
    noise: float
    rated: float
    trained: str
    control: str
    seeds: int
    failed: int
    hacks: Estimate | None
    true: Estimate | None

    @property
    def compared(self) -> bool:
        """Whether it has an interval: one seed has none."""
        return self.seeds > 1

    @property
    def place(self) -> tuple[str, str, str]:
        """Where and how it was trained: what it shares with its raw rival."""
        return self.environment, self.agent, self.trained

    @property
    def setting(self) -> tuple[Any, ...]:
        """All but the mitigation."""
        return (*self.place, self.panel, self.noise, self.rated)


@dataclass(frozen=True)
class Standing:
    """One mitigation over all its settings; pairs are (how many, of how many).

    Attributes:
        mitigation: Its name.
        settings: Lines with honest raters.
        tamer: Settings in which it hacks less than the raw agent (after Holm correction).
        richer: In which its true return is higher than the raw agent's.
        poorer: In which its true return is lower than the raw agent's.
        unbeaten: In which no other mitigation has a higher true return, of those with rivals.
        colluding: ``tamer`` where all raters repeat the lie; a mitigation that listens to them alone should fail.
        cautious: ``poorer`` in legitimate twins, where the bonus is real: the price of caution.
        failed: Seeds that could not be trained.
    """

    mitigation: str
    settings: int
    tamer: tuple[int, int]
    richer: tuple[int, int]
    poorer: tuple[int, int]
    unbeaten: tuple[int, int]
    colluding: tuple[int, int]
    cautious: tuple[int, int]
    failed: int


def lines(store: Store) -> list[Line]:
    """Return a line for every cell of the store, sorted by setting, the highest true return first."""
    cells = store.cells()
    known = _Names([cell.config for cell in cells])
    seeds = [cell.metrics for cell in cells]
    rates = [{i: m["hacks"] / m["episode_length"] for i, m in s.items()} for s in seeds]
    both = _estimates(rates + [{i: m["true_return"] for i, m in s.items()} for s in seeds])
    hacks, true = both[: len(cells)], both[len(cells) :]
    made = [_line(c.config, known, len(c.metrics), c.failed, h, t) for c, h, t in zip(cells, hacks, true, strict=True)]
    return sorted(made, key=lambda x: (*x.setting, -x.true.mean if x.true else np.inf, x.mitigation))


def standings(these: Sequence[Line]) -> list[Standing]:
    """Sum the lines up by mitigation, first the one that is surely unbeaten in the largest share of its settings.

    Sure is the lower end of Wilson's interval: one setting of one proves less than 131 of 131.
    """
    of: dict[str, list[Line]] = defaultdict(list)
    for x in these:
        of[x.mitigation].append(x)
    raw, rivals, _, larger = _tested(these)

    def against_raw(some: Iterable[Line], metric: str, sign: int) -> tuple[int, int]:
        pairs = [(x, raw[x.place]) for x in some if x.compared and x.mitigation != RAW and x.place in raw]
        return sum(larger[metric, id(x), id(r)] == sign for x, r in pairs), len(pairs)

    def unbeaten(some: Iterable[Line]) -> tuple[int, int]:
        won = []
        for x in (x for x in some if x.compared and x.mitigation != RAW):
            others = [y for y in (*rivals[x.setting], raw.get(x.place)) if y is not None and y is not x]
            if others:
                won.append(all(larger["true", id(x), id(y)] >= 0 for y in others))
        return sum(won), len(won)

    out = []
    for mitigation, every in of.items():
        honest, fooled, twins = ([x for x in every if x.control == c] for c in (HONEST, COLLUDING, TWIN))
        out.append(
            Standing(
                mitigation,
                len(honest),
                against_raw(honest, "hacks", -1),
                against_raw(honest, "true", 1),
                against_raw(honest, "true", -1),
                unbeaten(honest),
                against_raw(fooled, "hacks", -1),
                against_raw(twins, "true", -1),
                sum(x.failed for x in every),
            )
        )
    return sorted(out, key=lambda s: (-_surely(s.unbeaten), -s.settings, s.mitigation))


def _surely(pair: tuple[int, int]) -> float:
    return statistics.wilson(pair[0] / pair[1], pair[1])[0] if pair[1] else -1.0


def caption(these: Sequence[Line]) -> str:
    """Say how many comparisons the standings rest on, and how many differ by chance and after correction."""
    return _tested(these)[2].caption()


def _tested(
    these: Sequence[Line],
) -> tuple[dict[Any, Line], dict[Any, list[Line]], statistics.Family, dict[tuple[str, int, int], int]]:
    """Return the raw line of each place, the others of each setting, their tests, and who is larger (+1), smaller (-1).

    All comparisons of the page are one family: with raw, and of each two mitigations of a setting with honest raters.
    """
    raw = {x.place: x for x in these if x.mitigation == RAW and x.compared}
    rivals: dict[Any, list[Line]] = defaultdict(list)
    for x in these:
        if x.compared and x.mitigation != RAW:
            rivals[x.setting].append(x)
    pairs = [
        (m, x, raw[x.place]) for some in rivals.values() for x in some if x.place in raw for m in ("hacks", "true")
    ]
    pairs += [("true", x, y) for some in rivals.values() if some[0].control == HONEST for x, y in combinations(some, 2)]
    family = statistics.compare_all(_paired(getattr(x, m).values, getattr(y, m).values) for m, x, y in pairs)
    larger: dict[tuple[str, int, int], int] = {}
    for i, (metric, x, y) in enumerate(pairs):
        sign = family.above(i) - family.below(i)
        larger[metric, id(x), id(y)], larger[metric, id(y), id(x)] = sign, -sign
    return raw, rivals, family, larger


def _paired(a: Mapping[int, float], b: Mapping[int, float]) -> tuple[list[float], list[float]]:
    """Return the numbers of the seeds that both have; all of both where that is fewer than two."""
    shared = sorted(a.keys() & b.keys())
    return ([a[s] for s in shared], [b[s] for s in shared]) if len(shared) > 1 else ([*a.values()], [*b.values()])


def share(pair: tuple[int, int]) -> float:
    """Return how many of how many as a fraction; -1 of none."""
    return pair[0] / pair[1] if pair[1] else -1.0


def write(target: Path, store: Store, pages: Sequence[tuple[str, str]] = ()) -> Path:
    """Write the page and return its path.

    Args:
        target: The page.
        store: What it shows.
        pages: That stand beside it, itself among them: their files, and what links call them.

    Raises:
        InvalidValueError: the store is empty, or the file cannot be written.
    """
    these = lines(store)
    if not these:
        raise InvalidValueError("store", store.path, "one with finished cells")
    every = standings(these)
    page = render(
        HERE,
        "leaderboard.html.j2",
        number=number,
        compared=caption(these),
        share=share,
        version=__version__,
        named=[s for s in every if ", " not in s.mitigation],
        varied=[s for s in every if ", " in s.mitigation],
        sections=[(c, [x for x in these if x.control == c]) for c in (HONEST, OWN, COLLUDING, TWIN)],
        filters={
            name: list(dict.fromkeys(sorted(getattr(x, name) for x in these)))
            for name in ("mitigation", "environment", "panel", "agent")
        },
        seeds=sum(x.seeds for x in these),
        cells=len(these),
        damaged=len(store.damaged),
        pages=pages,
        here=target.name,
        program=(HERE / "tables.js").read_text(encoding="utf-8"),
    )
    files.write(target, page, "out")
    return target


def _estimates(values: list[dict[int, float]]) -> list[Estimate | None]:
    out: list[Estimate | None] = [None] * len(values)
    for size in {len(v) for v in values} - {0}:
        places = [i for i, v in enumerate(values) if len(v) == size]
        sample = np.array([[*values[i].values()] for i in places])
        ends = statistics.intervals(sample) if size > 1 else [None] * len(places)
        for i, mean, interval in zip(places, sample.mean(1), ends, strict=True):
            ci95 = None if interval is None else (float(interval[0]), float(interval[1]))
            out[i] = Estimate(float(mean), ci95, values[i])
    return out


def _line(
    config: dict[str, Any], known: _Names, seeds: int, failed: int, hacks: Estimate | None, true: Estimate | None
) -> Line:
    mitigation = known.of("mitigation", config["mitigation"])
    panel, twin = panel_name(config["panel"]), config["environment"].get("legitimate", False)
    steps = config["steps"]
    trained = [f"{config['episodes']:,} episodes" if steps is None else f"{steps:,} steps"]
    tabular = "heads" in config["agent"]
    if steps is None and not tabular:
        trained.append("learned ratings" if config["rating_model"] else "running means")
    trained += [f"{name} {config[name]}" for name in ("ddof", "snapshots") if config[name]]
    return Line(
        known.of("environment", config["environment"]),
        known.of("agent", config["agent"]),
        mitigation,
        "–" if mitigation == RAW else panel,
        config["noise"],
        config["rated"],
        ", ".join(trained),
        TWIN if twin else COLLUDING if panel == "colluding" else HONEST if panel in PANELS else OWN,
        seeds,
        failed,
        hacks,
        true,
    )


def panel_name(config: Any) -> str:
    """Return what the panel of a stored configuration is called; its raters if it has no name."""
    known = next((name for name, panel in PANELS.items() if plain(panel) == config), None)
    if known is not None:
        return known
    try:
        raters = [Rater(**{name: x for name, x in r.items() if name != TYPE}) for r in config["raters"]]
        return str(Panel(tuple(raters), config["low"], config["high"]))
    except (KeyError, TypeError, InvalidValueError):  # of a class or a version that is not here
        return "of its own"


class _Names:
    """What stored configurations are called."""

    def __init__(self, configs: list[dict[str, Any]]):
        """Learn the names in use, ours and those of installed packages."""
        own = {
            "environment": names.ENVIRONMENTS,
            "agent": names.AGENTS,
            "mitigation": {name: named(name) for name in NAMED},
        }
        self._prototypes: dict[tuple[str, str], list[tuple[str, dict[str, Any]]]] = defaultdict(list)
        for kind, values in own.items():
            theirs = {plugin.name: value for plugin, value in names.brought(kind)[0].items()}
            more = names.CONTINUOUS if kind == "agent" else {}
            for name, value in [*values.items(), *theirs.items(), *more.items()]:
                config = plain(value)
                self._prototypes[kind, config[TYPE]].append((name, _leaves(config)))
        self._seen: dict[str, str] = {}
        self._varies: dict[str, set[str]] = defaultdict(set)
        first: dict[str, dict[str, Any]] = {}
        for config in configs:
            for kind in own:
                leaves = _leaves(config[kind])
                before = first.setdefault(config[kind][TYPE], leaves)
                changed = {k for k in leaves.keys() | before.keys() if leaves.get(k) != before.get(k)}
                self._varies[config[kind][TYPE]] |= changed

    def of(self, kind: str, config: dict[str, Any]) -> str:
        """Return the nearest name and what differs from it; the class and what varies if there is no name for it."""
        key = f"{kind} {config}"
        if key not in self._seen:
            self._seen[key] = self._describe(kind, config)
        return self._seen[key]

    def _describe(self, kind: str, config: dict[str, Any]) -> str:
        leaves, cls = _leaves(config), config[TYPE]
        candidates = [(_different(leaves, base), name) for name, base in self._prototypes[kind, cls]]
        exact = [name for changes, name in candidates if not changes]
        if exact:
            return exact[-1]  # of TrapGrid and TrapGrid6, which are equal, the one that says more
        if candidates:
            changes, name = min(candidates, key=lambda c: len(c[0]))
        else:
            changes, name = {k: leaves[k] for k in sorted(self._varies[cls]) if k in leaves}, cls.rpartition("/")[2]
        return ", ".join([name, *(_said(k.rpartition(".")[2], v) for k, v in changes.items())])


def _leaves(config: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return a configuration's settings by their dotted names."""
    out: dict[str, Any] = {}
    for name, value in config.items():
        if isinstance(value, dict):
            out |= _leaves(value, f"{prefix}{name}.")
        elif name != TYPE or prefix:
            out[prefix + name] = value
    return out


def _different(leaves: dict[str, Any], base: dict[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in sorted(leaves.items()) if k not in base or base[k] != v}


def _said(name: str, value: Any) -> str:
    if isinstance(value, bool):
        return name if value else f"{name} off"
    return f"{name} {value:g}" if isinstance(value, float) else f"{name} {str(value).replace(' ', '')}"
