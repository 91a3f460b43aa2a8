"""Checks for raters who do not look: each returns a finding, or None."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uard.diagnosis.agreement_checks import units
from uard.diagnosis.case import FEW, Case
from uard.diagnosis.finding import Finding, listed
from uard.ratings.pairs import TELLING

if TYPE_CHECKING:
    from jaxtyping import Float, Integer

LONG = 10  # rows of a run of one value
FLAT = 4.0  # times the standard deviation, what the others agree on has: too constant
RARE = 1e-4  # how many such runs there would be by chance, in any rater's answers


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
