"""Checks for raters who repeat the reward or each other: each returns a finding, or None."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uard.diagnosis.case import FEW, ROUNDING, Case
from uard.diagnosis.finding import Finding, listed, percent
from uard.ratings.pairs import equal_share, residuals, shared

if TYPE_CHECKING:
    pass

COMPARISONS = 500_000_000  # of two numbers each, when all pairs of raters are compared for equality
MOST_PAIRS = 20  # that are named as copies


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
        elif (share := equal_share(column, reward, ROUNDING * case.unit)) >= 0.99:
            idle.append(f"{name} repeats the reward exactly in {percent(share)} of its rows")
            numbers[f"repeats_reward_{name}"] = share
        else:
            for j in alike[k]:
                if (share := equal_share(column, ratings[:, j], ROUNDING * case.unit)) >= 0.99:
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
        if equal_share(sample.ratings[:, i], sample.ratings[:, j], ROUNDING * case.unit) >= 0.99:
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
