"""Whether two stores agree: bit by bit, and where they do not, by how much against the noise over seeds.

Two machines or two versions whose arithmetic differs in the last bit train different agents from the same seed: each
is as good a draw as the other. So a seed's two results may be swapped if nothing else changed. The test swaps them, for
all cells and metrics at once, and asks how often the most conspicuous difference of all is as conspicuous as the
one that was found (Westfall & Young 1993, single-step minP). That keeps the chance of any false alarm among all cells
and metrics at 5 %, whatever the distributions are and however metrics and cells hang together.
"""

from __future__ import annotations

import dataclasses
import json
import math
import zlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from uard import _checks
from uard.lab.config import TYPE
from uard.lab.execution.store import Store
from uard.lab.result import Result
from uard.lab.statistics import hedges_g
from uard.lab.views.leaderboard import panel_name

LEVEL = 0.05
EXACT = 12  # seeds up to which every swap is tried
SWAPS = 2**11


@dataclass(frozen=True)
class Effect:
    """One metric of one cell, B against A.

    Attributes:
        metric: Its name.
        difference: Mean of B minus mean of A, over the seeds that both have.
        effect: The same in pooled standard deviations over seeds (Hedges' g); None for one seed or without any spread.
        p: Of the swap test, corrected for all cells and metrics.
    """

    metric: str
    difference: float
    effect: float | None
    p: float

    @property
    def differs(self) -> bool:
        """Whether the difference is more than noise."""
        return self.p < LEVEL


@dataclass(frozen=True)
class CellComparison:
    """One cell that both stores have.

    Attributes:
        key: In A.
        config: Its configuration.
        seeds: That both have.
        identical: Those of them whose results are equal bit by bit.
        parts: Which arrays differ in the others.
        effects: Per metric, most conspicuous first; none if all seeds are identical.
    """

    key: str
    config: dict[str, Any]
    seeds: tuple[int, ...]
    identical: tuple[int, ...]
    parts: tuple[str, ...]
    effects: tuple[Effect, ...]


@dataclass(frozen=True)
class Comparison:
    """Two stores.

    Attributes:
        cells: With a seed in both.
        everywhere: Per metric, the mean over all differing cells of the difference in standard deviations.
        only_a: Configurations of which only A has results, by key.
        only_b: The same of B.
        damaged: Results left out because they are not what was written: (store, key, seed), seed None for a whole cell.
        versions: Of the program, of A's results and B's.
        least_p: The smallest p that so few seeds can give; above ``LEVEL``, nothing can be found.
    """

    cells: tuple[CellComparison, ...]
    everywhere: tuple[Effect, ...]
    only_a: dict[str, dict[str, Any]]
    only_b: dict[str, dict[str, Any]]
    damaged: tuple[tuple[str, str, int | str | None], ...]
    versions: tuple[tuple[str, ...], tuple[str, ...]]
    least_p: float

    @property
    def identical(self) -> bool:
        """Whether all seeds that both have are equal bit by bit, and nothing is damaged."""
        return not self.damaged and all(len(c.identical) == len(c.seeds) for c in self.cells)

    @property
    def differs(self) -> bool:
        """Whether any difference is more than noise."""
        return any(e.differs for c in self.cells for e in c.effects) or any(e.differs for e in self.everywhere)


def compare(a: Store, b: Store) -> Comparison:
    """Compare what two stores have in common; cells are recognised by their configuration.

    Raises:
        InvalidValueError: they have no seed of any cell in common.
    """
    configs_a, configs_b = a.configs(), b.configs()
    keys_b = {_canonical(config): key for key, config in configs_b.items()}
    cells, pairs, damaged, shared = [], [], [], set()
    for key, config in configs_a.items():
        if (text := _canonical(config)) not in keys_b:
            continue
        found = []
        for store, k in ((a, key), (b, keys_b[text])):
            sound, bad = store.stored(k)
            damaged += [(store.path, k, lost.seed) for lost in bad]
            found.append(sound)
        seeds = sorted(found[0].keys() & found[1].keys())
        if not seeds:
            continue
        shared.add(text)
        same = tuple(s for s in seeds if _same(found[0][s][0], found[1][s][0]))
        parts = sorted({p for s in seeds if s not in same for p in _parts(found[0][s][0], found[1][s][0])})
        cells.append(CellComparison(key, config, tuple(seeds), same, tuple(parts), ()))
        if parts:
            pairs.append((len(cells) - 1, seeds, [[found[i][s][1] for s in seeds] for i in (0, 1)]))
    damaged += [(store.path, lost.key, None) for store in (a, b) for lost in store.damaged if lost.seed is None]
    if not cells:
        raise _checks.InvalidValueError("store", b.path, f"one that has a seed of a cell in common with {a.path!r}")
    per_cell, everywhere, least = _tested(pairs)
    return Comparison(
        cells=tuple(replace(cell, effects=per_cell.get(i, ())) for i, cell in enumerate(cells)),
        everywhere=everywhere,
        only_a={key: c for key, c in configs_a.items() if _canonical(c) not in shared},
        only_b={key: c for key, c in configs_b.items() if _canonical(c) not in shared},
        damaged=tuple(damaged),
        versions=(a.versions(), b.versions()),
        least_p=least,
    )


def _canonical(config: dict[str, Any]) -> str:
    return json.dumps(config, sort_keys=True)


def _same(one: bytes, other: bytes) -> bool:
    """Whether two packed results hold the same bits; compression may differ from machine to machine."""
    return one == other or zlib.decompress(one) == zlib.decompress(other)


def _parts(one: bytes, other: bytes) -> set[str]:
    x, y = (Result.unpack(data) for data in (one, other))
    mine, theirs = ({"log": r.log, "path": r.path, "steps": np.int64(r.steps), **r.extra} for r in (x, y))
    return {
        name
        for name in mine.keys() | theirs.keys()
        if name not in mine or name not in theirs or not _equal(mine[name], theirs[name])
    }


def _equal(x: np.ndarray, y: np.ndarray) -> bool:
    return x.dtype == y.dtype and x.shape == y.shape and x.tobytes() == y.tobytes()


def _tested(pairs: list[Any]) -> tuple[dict[int, tuple[Effect, ...]], tuple[Effect, ...], float]:
    """Return the effects per cell and over all cells, and the least possible p."""
    if not pairs:
        return {}, (), 0.0
    seeds = sorted({s for _, own, _ in pairs for s in own})
    place = {s: i for i, s in enumerate(seeds)}
    columns: list[np.ndarray] = []  # per test the differences, NaN where there is no seed
    named: list[tuple[int | None, str, float, float | None]] = []
    pooled: dict[str, list[np.ndarray]] = {}
    for i, own, (ones, others) in pairs:
        for metric in ones[0].keys() & others[0].keys():
            x, y = (np.array([m[metric] for m in rows]) for rows in (ones, others))
            column = np.full(len(seeds), np.nan)
            column[[place[s] for s in own]] = y - x
            columns.append(column)
            effect = hedges_g(y, x) if len(own) > 1 else math.nan
            named.append((i, metric, float((y - x).mean()), effect if math.isfinite(effect) else None))
            spread = np.concatenate([x, y]).std()  # the same however seeds are swapped
            pooled.setdefault(metric, []).append(column / spread if spread else column)
    for metric, several in pooled.items():
        if len(several) > 1:
            table = np.stack(several)
            have = ~np.isnan(table)
            column = np.where(have, table, 0).sum(0) / np.maximum(have.sum(0), 1)
            columns.append(np.where(have.any(0), column, np.nan))
            mean = float(np.nanmean(columns[-1]))
            named.append((None, metric, mean, mean))
    signs = _swaps(len(seeds))
    effects: dict[int | None, list[Effect]] = {}
    for (i, metric, difference, effect), p in zip(named, _corrected(np.stack(columns, 1), signs), strict=True):
        effects.setdefault(i, []).append(Effect(metric, difference, effect, float(p)))
    ordered = {i: tuple(sorted(e, key=lambda e: (e.p, -abs(e.effect or 0), e.metric))) for i, e in effects.items()}
    everywhere = ordered.pop(None, ())
    return {i: e for i, e in ordered.items() if i is not None}, everywhere, 1 / len(signs)


def _swaps(seeds: int) -> np.ndarray:
    """Return signs, (swaps, seeds); the first swaps nothing, and swaps that are opposites are alike: one is in."""
    if seeds <= EXACT:
        bits = np.arange(2 ** (seeds - 1))[:, None] >> np.arange(seeds) & 1
        return 1.0 - 2.0 * bits
    signs = 1.0 - 2.0 * np.random.default_rng(20260101).integers(0, 2, (SWAPS, seeds))
    signs[0] = 1
    return signs


def _corrected(differences: np.ndarray, signs: np.ndarray) -> np.ndarray:
    """Return p of every column of (seeds, tests): how often the smallest of all is as small, over swaps."""
    from scipy.special import stdtr

    n = (~np.isnan(differences)).sum(0)
    d = np.nan_to_num(differences)
    scale = np.abs(d).max(0)
    tested = (n > 1) & (scale > 0)
    p = np.ones(d.shape[1])
    if not tested.any():
        return p
    d, n = d[:, tested] / scale[tested], n[tested]
    squares = (d**2).sum(0) / n

    def alone(rows: np.ndarray) -> np.ndarray:
        mean = rows @ d / n
        variance = squares - mean**2
        t = np.abs(mean) / np.sqrt(np.maximum(variance, 1e-12 * squares) / (n - 1))
        return 2 * stdtr(n - 1, -t)

    found = alone(signs[:1])[0]
    step = max(1, 4_000_000 // d.shape[1])
    smallest = np.concatenate([alone(signs[i : i + step]).min(1) for i in range(0, len(signs), step)])
    smallest.sort()
    p[tested] = np.searchsorted(smallest, found * (1 + 1e-9), side="right") / len(signs)
    return p


def as_data(comparison: Comparison) -> dict[str, Any]:
    """Return it as plain data."""
    head = {"identical": comparison.identical, "differs": comparison.differs, "level": LEVEL}
    return head | dataclasses.asdict(comparison)


def title(config: dict[str, Any]) -> str:
    """Return what a cell is about, for one that is in no study."""
    names = [config[part][TYPE].rpartition("/")[2] for part in ("environment", "mitigation", "agent")]
    return ", ".join(
        [*names, f"panel {panel_name(config['panel'])}", f"{config.get('steps') or config['episodes']} long"]
    )


def lines(comparison: Comparison) -> list[str]:
    """Return the verdict, and all that a reader must know of it, in sentences."""
    cells = comparison.cells
    seeds = sum(len(c.seeds) for c in cells)
    equal = sum(len(c.identical) for c in cells)
    differ = [c for c in cells if c.effects]
    found = [f"{len(cells)} cells, {seeds} seeds in both: {equal} seeds identical bit by bit, {seeds - equal} not"]
    if differ:
        worse = sum(any(e.differs for e in c.effects) for c in differ)
        found.append(
            f"{len(differ)} cells differ, {worse} of them by more than seed noise (swap test over seeds, corrected for "
            f"all cells and metrics, level {LEVEL:g})"
        )
        tested = [e for c in differ for e in c.effects] + list(comparison.everywhere)
        found.append(
            f"{len(tested)} comparisons: {LEVEL * len(tested):.1f} would differ by chance at 5 % uncorrected, "
            f"{sum(e.differs for e in tested)} do after correction"
        )
    if comparison.least_p >= LEVEL:
        found.append(
            f"with so few seeds p cannot be below {comparison.least_p:.3g}: no difference could have been found; 6 "
            "seeds of a cell are the least that can tell"
        )
    for name, only in (("A", comparison.only_a), ("B", comparison.only_b)):
        if only:
            some = [title(config) for config in list(only.values())[:3]]
            found.append(f"only in {name}: {len(only)} cells, such as {'; '.join(some)}")
    if comparison.damaged:
        found.append(f"left out, for they are damaged: {len(comparison.damaged)} results")
    versions = " and ".join("/".join(v) or "none" for v in comparison.versions)
    verdict = "differ" if comparison.differs else "identical" if equal == seeds else "equal within seed noise"
    verdict += " in what can be read" * bool(comparison.damaged)
    return [*found, f"versions: {versions}", f"verdict: {verdict}"]
