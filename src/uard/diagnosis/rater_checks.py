"""Checks of each rater: each returns a finding, or None. Beyond ``uard.ratings.pairs.CELLS`` they look at a sample."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from uard.diagnosis.agreement_checks import TELLING, units
from uard.diagnosis.case import FEW, ROUNDING, Case
from uard.diagnosis.finding import Finding, listed, percent, row_count
from uard.ratings.agreement import krippendorff_alpha
from uard.ratings.pairs import residuals, shared

if TYPE_CHECKING:
    from jaxtyping import Float, Integer

COMPARISONS = 500_000_000  # of two numbers each, when all pairs of raters are compared for equality
LONG = 10  # rows of a run of one value
FLAT = 4.0  # times the standard deviation, what the others agree on has: too constant
MOST_PAIRS = 20  # that are named as copies
RARE = 1e-4  # how many such runs there would be by chance, in any rater's answers


def idle_raters(case: Case) -> Finding | None:
    """Raters who add nothing: they repeat the reward or another rater, or give every row the same rating."""
    idle: list[str] = []
    numbers: dict[str, float] = {}
    reward, ratings = case.sample.reward, case.sample.ratings
    names = case.sample.names
    alike = _look_alike(case)
    for k, name in enumerate(names):
        column = ratings[:, k]
        here = np.isfinite(column)
        constant = here.sum() >= FEW and np.ptp(column[here]) == 0
        if constant and (case.log.reward is None or np.ptp(reward[here]) > 0):
            idle.append(f"{name} rates every row {column[here][0]:g}")
            numbers[f"constant_{name}"] = float(column[here][0])
        elif (share := _equal(column, reward, case.unit)) >= 0.99:
            idle.append(f"{name} repeats the reward exactly in {percent(share)} of its rows")
            numbers[f"repeats_reward_{name}"] = share
        else:
            for j in alike[k]:
                if (share := _equal(column, ratings[:, j], case.unit)) >= 0.99:
                    idle.append(f"{name} equals {names[j]} in {percent(share)} of their rows")
                    numbers[f"{name}_repeats_{names[j]}"] = share
                    break
    if not idle:
        return None
    return Finding(
        "idle-raters",
        "warning",
        f"{listed(idle)}.",
        "Such a rater adds no information. Copies lower sigma_h, so they turn doubt into trust; a copy of the reward "
        "confirms every lie in it.",
        "Leave these columns out (--ratings), and find out whether the people rated alone or saw the reward.",
        numbers,
    )


def _equal(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " n"], unit: float) -> float:
    """Return in which share of the rows that have both they are equal; 0 if these are few, or b is constant there."""
    both = np.isfinite(a) & np.isfinite(b)
    a, b = a[both], b[both]
    return float((np.abs(a - b) <= ROUNDING * unit).mean()) if a.size >= FEW and np.ptp(b) > 0 else 0.0


def _look_alike(case: Case) -> list[list[int]]:
    """Return for each rater up to five earlier ones that are nearly always equal, the most alike first.

    Values are rounded to a hundred times what counts as equal, so that at most one equal pair in a hundred falls apart,
    and compared as whole numbers, in as many rows as ``COMPARISONS`` allows (at least 100).
    """
    ratings = case.sample.ratings
    n, raters = ratings.shape
    rows = np.unique(np.linspace(0, n - 1, min(n, max(100, 2 * COMPARISONS // max(raters, 1) ** 2)), dtype=int))
    values = ratings[rows].T
    here = np.isfinite(values)
    rounded = np.round(np.where(here, values, 0.0) / (100 * ROUNDING * case.unit))
    code = np.unique(rounded, return_inverse=True)[1].reshape(values.shape).astype(np.int32)
    code = np.where(here, code, -1 - np.arange(raters, dtype=np.int32)[:, None])  # a missing one equals none
    both = here.astype(np.float32) @ here.astype(np.float32).T
    found: list[list[int]] = []
    for k in range(raters):
        share = (code[:k] == code[k]).sum(1) / np.maximum(both[k, :k], 1.0)
        near = np.flatnonzero(share >= 0.96)
        found.append(near[np.argsort(-share[near], kind="stable")][:5].tolist())
    return found


class _Sentinel(NamedTuple):
    """A value that says something else than how good the row is.

    Attributes:
        rater: Number of the rater in the log.
        value: The value.
        others: Mean rating of the other raters in its rows.
        line: What they say where this rater means what the value says, by the rater's other rows.
    """

    rater: int
    value: float
    others: float
    line: float


def sentinel_value(case: Case) -> Finding | None:
    """A value that one rater gives to rows that the others find as good as any: a failure written down as a number."""
    sample = case.sample
    found = [s for k in range(sample.raters.size) for s in _sentinels(case, k)]
    if not found:
        return None
    without = case.ratings.copy()
    numbers: dict[str, float] = {}
    parts: list[str] = []
    for s in found:
        name, value = case.log.raters[s.rater], f"{s.value:g}"
        at = case.ratings[:, s.rater] == s.value
        without[at, s.rater] = np.nan
        numbers |= {f"rows_{name}_{value}": float(at.sum()), f"others_{name}_{value}": s.others}
        parts.append(
            f"{name} is exactly {value} in {row_count(int(at.sum()))} of {int(np.isfinite(case.ratings[:, s.rater]).sum())}, "
            f"first in {case.place(int(np.argmax(at)))}, where the others average {s.others:.3g} (by its other rows that "
            f"would mean {s.line:.3g})"
        )
    alphas = krippendorff_alpha(case.ratings), krippendorff_alpha(without)
    numbers |= {n: a for n, a in zip(("alpha", "alpha_without"), alphas, strict=True) if a is not None}
    change = f" Alpha is {alphas[0]:.2f} with them and {alphas[1]:.2f} without." if None not in alphas else ""
    values = ", ".join(dict.fromkeys(f"--missing {s.value:g}" for s in found))
    return Finding(
        "sentinel-value",
        "danger",
        f"{listed(parts)}.{change}",
        "An answer that failed is read as a verdict: where it is low, good rows are doubted and drawn towards it; where it "
        "is high, bad ones are praised; and disagreement is seen where there was no answer.",
        f"Leave these cells empty, or {values} if that is no rating; and let what writes the log tell failures from scores.",
        numbers,
    )


def _sentinels(case: Case, k: int) -> list[_Sentinel]:
    """Return the sentinel values of a rater of the sample.

    Of the rater's most frequent values, each in turn: a line of the others' mean rating on the rater's, fitted to the
    rows with other values, says what the others would say if the value were meant. It is not meant if they are nearer to
    what they say on average (by six tenths of the way at least), by more than noise, and hardly ever give it themselves;
    and if they find its rows better than those of the next higher values, or worse than those of the next lower ones:
    without that, a bend of the line would do.
    """
    x, m = case.sample.ratings[:, k], case.sample.others[:, k]
    both = np.isfinite(x) & np.isfinite(m)
    rows, x, m = np.flatnonzero(both), x[both], m[both]
    values, counts = np.unique(x, return_counts=True)
    often = np.argsort(-counts, kind="stable")[:10]
    often = often[counts[often] >= max(3, 0.002 * x.size)]
    found: list[_Sentinel] = []
    for value in values[often]:
        at = x == value
        a, b = x[~at], m[~at]
        if a.size < 10 or np.ptp(a) == 0 or np.ptp(b) == 0:
            continue
        r = float(np.corrcoef(a, b)[0, 1])
        if r < 0.3 or r * np.sqrt(a.size) < TELLING:
            continue
        slope, c = r * b.std() / a.std(), int(at.sum())
        line, there, usual = b.mean() + slope * (value - a.mean()), float(m[at].mean()), float(b.mean())
        noise = float((b - b.mean() - slope * (a - a.mean())).std()) * np.sqrt(a.size / (a.size - 2))
        error = noise * np.sqrt(1.0 / c + 1.0 / a.size + (value - a.mean()) ** 2 / (a.size * a.var()))
        missed = (there - line) * np.sign(usual - line)
        if missed < 0.6 * abs(usual - line) or missed < max(5.0 * error, noise):
            continue
        if not _out_of_order(value, there, c, a, b, noise):
            continue
        beside = np.delete(case.sample.ratings[rows[at]], k, 1)
        if (beside == value).sum() <= 0.25 * np.isfinite(beside).sum():
            found.append(_Sentinel(int(case.sample.raters[k]), float(value), there, float(line)))
    return found


def _out_of_order(
    value: float, there: float, count: int, x: Float[np.ndarray, " n"], others: Float[np.ndarray, " n"], noise: float
) -> bool:
    """Return whether others find the rows of a value better than its next higher rows, or worse than its next lower ones.

    Args:
        value: The value.
        there: What others say of its rows on average.
        count: How many these are.
        x: This rater's other ratings.
        others: What others say of them.
        noise: Standard deviation of ``others`` about their line.
    """
    for sign in (1.0, -1.0):
        beyond = sign * (x - value)
        near = np.sort(beyond[beyond > 0])[: max(5, x.size // 10)]
        if near.size:
            rows = (beyond > 0) & (beyond <= near[-1])
            error = noise * np.sqrt(1.0 / count + 1.0 / rows.sum())
            if sign * (there - others[rows].mean()) > 3.0 * error:
                return True
    return False


def straight_lines(case: Case) -> Finding | None:
    """Raters who give one value to row after row, though the rows differ. This one depends on the order of the rows."""
    parts: list[str] = []
    numbers: dict[str, float] = {}
    for k, name in enumerate(case.log.raters):
        rows = np.flatnonzero(np.isfinite(case.ratings[:, k]))
        start, length = _improbable_run(case, k, rows)
        if length:
            first = int(rows[start])
            parts.append(
                f"{name} gives {case.ratings[first, k]:g} to {length} rows running, from {case.place(first)} on"
            )
            numbers[f"run_{name}"] = float(length)
    if not parts:
        return None
    return Finding(
        "straight-lining",
        "warning",
        f"{listed(parts)}, while reward and other raters vary there as much as elsewhere.",
        "These answers were given without looking. Where they are near the reward they confirm it, lie or not.",
        "Leave these cells empty and ask again; show rows in an order of their own to each rater.",
        numbers,
    )


def _improbable_run(case: Case, k: int, rows: Integer[np.ndarray, " n"]) -> tuple[int, int]:
    """Return start and length of the longest run of one value that neither chance nor the rows explain; length 0 if none.

    Chance: in random order, fewer than ``RARE`` runs as long would be expected of a value as frequent. The rows: within the
    run the reward, and the mean of the other raters, have at least two fifths of their variance over all rows, and
    half of their median distance from the median.
    """
    x = case.ratings[rows, k]
    ends = np.flatnonzero(np.diff(x, append=np.nan) != 0)
    starts = np.r_[0, ends[:-1] + 1]
    lengths = ends + 1 - starts
    if not (lengths >= LONG).any():
        return 0, 0
    code = np.unique(x, return_inverse=True)[1]
    frequency = np.bincount(code)[code[starts]] / x.size
    chance = np.log(x.size * len(case.log.raters)) + lengths * np.log(frequency)
    rare = np.flatnonzero((lengths >= LONG) & (chance < np.log(RARE)) & (frequency < 1))
    others = np.delete(case.ratings[rows], k, 1) if case.ratings.shape[1] <= 20 else case.ratings[rows][:, :20]
    count = np.isfinite(others).sum(1)
    mean = np.where(count > 0, np.nansum(others, 1) / np.maximum(count, 1), np.nan)
    for i in rare[np.argsort(-lengths[rare], kind="stable")][:5]:
        run = slice(starts[i], ends[i] + 1)
        if all(_varies(y[run], y) for y in (case.reward[rows], mean)):
            return int(starts[i]), int(lengths[i])
    return 0, 0


def _varies(part: Float[np.ndarray, " m"], whole: Float[np.ndarray, " n"]) -> bool:
    """Return whether a part has at least two fifths of the variance of the whole; yes if the whole has none or is not known."""
    part, whole = part[np.isfinite(part)], whole[np.isfinite(whole)]
    if not whole.size or np.ptp(whole) == 0:
        return True
    if part.size < LONG or part.var() < 0.4 * whole.var():
        return False
    return _typical(part) >= 0.5 * _typical(whole)  # a few rewards that lie have most of the variance


def _typical(x: Float[np.ndarray, " n"]) -> float:
    """Return the median distance from the median."""
    return float(np.median(np.abs(x - np.median(x))))


def too_constant(case: Case) -> Finding | None:
    """Raters whose answers vary far less than what the others agree on."""
    sample, both = case.sample, case.pairs_of_raters
    if sample.raters.size < 3:
        return None
    # What all raters see is in the covariance of any two, and no rater of the same scale can vary by less.
    told = (both.rows >= FEW) & (both.correlation * np.sqrt(both.rows) > TELLING)
    np.fill_diagonal(told, False)
    covariance = np.where(told, both.correlation * both.sd * both.sd.T, 0.0)
    total, pairs = covariance.sum() - 2 * covariance.sum(1), told.sum() - 2 * told.sum(1)
    reward = case.pairs_with_reward.sd[-1]
    seen = np.minimum(1.0, reward[:-1] / max(float(reward[-1]), 1e-100)) ** 2  # of all that varies, in the rater's rows
    signal = seen * np.where(pairs > 0, total / np.maximum(pairs, 1), 0.0)
    own = np.array([np.nanvar(x) if np.isfinite(x).sum() >= FEW else np.inf for x in sample.ratings.T])
    unit = units(case)
    alone = np.full(own.size, True) if unit is None else unit < 0
    flat = np.flatnonzero((own > 0) & (own * FLAT**2 < signal) & alone & (both.rows.diagonal() >= FEW))
    if not flat.size:
        return None
    names = [sample.names[k] for k in flat]
    spread = [(float(np.sqrt(own[k])), float(np.sqrt(signal[k]))) for k in flat]
    return Finding(
        "too-constant",
        "warning",
        listed(
            f"{n} varies by {a:.3g} (standard deviation), what the others agree on by {b:.3g}"
            for n, (a, b) in zip(names, spread, strict=True)
        )
        + ".",
        "Either this rater does not look, and agrees with the rest where most rows are ordinary; or this one is right and the "
        "others, or the reward, repeat one mistake. Disagreement is then large just where the others see a difference.",
        "Compare a few of the rows with the largest gap by hand; leave the rater out if the answers do not depend on the row.",
        {f"spread_{n}": a for n, (a, _) in zip(names, spread, strict=True)},
    )


def copied_ratings(case: Case) -> Finding | None:
    """Two raters whose errors go together far more than those of the others.

    What a reward leaves unexplained of two raters' ratings has a covariance: of what both see and the reward does not. In
    units of how far each follows the reward it is the same for every pair of honest raters, however noisy each is. A pair
    copies if its covariance is above every other that either has, not by chance, and if what is above is over six tenths
    of what the others leave unexplained of it. Rows whose ratings are over a unit from the reward are left out, and so
    are raters who hardly follow it. Between three raters two who see a truth that neither the reward nor the third sees
    look the same.
    """
    sample = case.sample
    if sample.raters.size < 3:
        return None
    rows = ~case.far()[sample.rows]
    known = sample.reward[:, None] if case.true is None else np.column_stack([sample.reward, case.true[sample.rows]])
    both = shared(residuals(np.where(rows[:, None], sample.ratings, np.nan), known))
    with_reward = case.pairs_with_reward
    follows = with_reward.correlation[:-1, -1]
    slope = follows * with_reward.sd[:-1, -1] / max(float(with_reward.sd[-1, :-1].max()), 1e-100)
    usable = (follows >= 0.2) & (slope > 0)
    scale = np.where(usable, slope, 1.0)
    sd = both.sd / scale[:, None]
    spread = sd * sd.T
    told = (both.rows >= FEW) & usable & usable[:, None] & ~np.eye(len(sd), dtype=bool)
    covariance = np.where(told, both.correlation * spread, -np.inf)
    error = spread / np.sqrt(np.maximum(both.rows, 1.0))
    z = 1.5 + np.sqrt(2.0 * np.log(max(told.sum() / 2, 2)))
    parts: list[str] = []
    numbers: dict[str, float] = {}
    for i, j in zip(*np.nonzero(np.triu(told & (both.correlation > 0.5) & (covariance > z * error))), strict=True):
        own, others = covariance[i, j], covariance[[i, j]].copy()
        others[:, [i, j]] = -np.inf
        if not np.isfinite(others).any() or len(parts) >= MOST_PAIRS:
            continue
        beside = max(float(others.max()), 0.0)
        if (
            own - beside < 0.6 * (spread[i, j] - beside)
            or (own - others < z * np.hypot(error[i, j], error[[i, j]])).any()
        ):
            continue
        if _equal(sample.ratings[:, i], sample.ratings[:, j], case.unit) >= 0.99:
            continue  # named by idle_raters
        a, b = sample.names[int(i)], sample.names[int(j)]
        numbers[f"correlation_{a}_{b}"] = float(both.correlation[i, j])
        parts.append(
            f"{a} and {b} ({both.correlation[i, j]:.2f}, by the other raters at most {beside / spread[i, j]:.2f})"
        )
    if not parts:
        return None
    return Finding(
        "copied-ratings",
        "warning",
        f"Given the reward, the errors of {listed(parts)} go together (partial correlation).",
        "Two raters who share their errors count as two and are one: where both are wrong, sigma_h is small and the mean is "
        "theirs. Judges of one family, or people who see each other's answers, look like this.",
        "Find out whether they rated alone; keep one of the two, or ask a rater of another kind.",
        numbers,
    )
