"""Checks of what is in a log: each returns a finding, or None."""

from __future__ import annotations

import numpy as np

from uard.diagnosis.case import FEW, LARGEST, ROUNDING, Case, usable
from uard.diagnosis.finding import Finding, percent, row_count
from uard.ratings.log import NUMBERS, RatingLog


def not_finite(log: RatingLog) -> Finding | None:
    """Rewards, ratings or sigmas that are NaN, infinite or absurdly large."""
    columns = {} if log.reward is None else {"reward": log.reward}
    columns |= {name: log.ratings[:, k] for k, name in enumerate(log.raters)}
    columns |= {name: column for name in NUMBERS if (column := getattr(log, name)) is not None}
    parts: list[str] = []
    numbers: dict[str, float] = {}
    for name, column in columns.items():
        bad = ~usable(column)
        if name in log.raters:
            bad &= ~np.isnan(column)  # a missing rating, which is another check's matter
        if bad.any():
            first = int(np.argmax(bad))
            parts.append(f"{name} in {row_count(int(bad.sum()))}, first {column[first]} in {log.place(first)}")
            numbers[name] = float(bad.sum())
    if not parts:
        return None
    return Finding(
        "not-finite",
        "danger",
        f"NaN, infinite or beyond {LARGEST:g}: {'; '.join(parts)}.",
        "One NaN reward makes every mean, target and gradient that it enters NaN, often without any message; an infinite "
        "rating makes sigma_h and the anchor infinite. These rows and cells are left out of everything below.",
        "Drop these rows, and leave cells without a rating empty; find out what wrote these numbers.",
        numbers,
        how="sigma_human(ratings, mask=np.isfinite(ratings))",
    )


def no_rewards(case: Case) -> Finding | None:
    """The log holds no rewards."""
    if case.log.reward is not None:
        return None
    return Finding(
        "no-rewards",
        "note",
        "The log has no column of rewards, so only what concerns the raters alone was checked.",
        "Whether raters contradict the reward, and what a filter would make of it, is not known.",
        "Name the column of rewards, or add one: a row of the export then says what was observed for its item.",
        how="--reward COLUMN",
    )


def few_ratings(case: Case) -> Finding | None:
    """No row is rated, or too few are."""
    rated, share = int(case.rated.sum()), float(case.rated.mean())
    if rated == 0:
        return Finding(
            "no-ratings",
            "danger",
            f"None of {len(case.reward)} rows has a rating.",
            "Without ratings uard only scales the reward, and protects from nothing; a model's own doubt hardly sees a lie.",
            "Have at least two people rate a sample of steps, those with the highest rewards first.",
            {"rated_rows": 0.0},
        )
    if rated >= FEW and share >= 0.1:
        return None
    return Finding(
        "few-ratings",
        "warning",
        f"{rated} of {len(case.reward)} rows are rated ({percent(share)}).",
        "A reward that nobody has rated is believed in part (uard: a twentieth) or wholly (the filter as printed), however high "
        f"it is; and with fewer than {FEW} rated rows the numbers here mean little.",
        "Rate more, the highest rewards first; with few ratings of one noisy rater the cautious mean of the ratings does better than uard.",
        {"rated_rows": float(rated), "rated_share": share},
        how="--mitigation lcb, or named('lcb')",
    )


def missing_ratings(case: Case) -> Finding | None:
    """Some ratings are missing."""
    here = np.isfinite(case.ratings)
    if here.all() or not case.rated.any():
        return None
    per_rater = 1.0 - here.mean(0)
    worst = int(per_rater.argmax())
    missing, none = float(1.0 - here.mean()), int((here.sum(1) == 0).sum())
    one = per_rater[worst] > 1.5 * missing  # where all miss alike, no rater is to blame
    whose = f"most of {case.log.raters[worst]} ({percent(per_rater[worst])})" if one else "no rater stands out"
    evidence = (
        f"{percent(missing)} of ratings are missing; {whose}. "
        f"{row_count(none)} {'has' if none == 1 else 'have'} none at all"
    )
    numbers = {"missing": missing, "unrated_rows": float(none)}
    numbers |= {f"missing_{name}": float(x) for name, x in zip(case.log.raters, per_rater, strict=True)}
    if none and case.log.reward is not None:
        empty = here.sum(1) == 0
        numbers["mean_reward_unrated"] = float(case.reward[empty].mean())
        numbers["mean_reward_rated"] = float(case.reward[~empty].mean())
        evidence += (
            f", with a mean reward of {numbers['mean_reward_unrated']:.3g} against "
            f"{numbers['mean_reward_rated']:.3g} of the others"
        )
    return Finding(
        "missing-ratings",
        "warning" if missing > 0.05 else "note",
        evidence + ".",
        "An average over a gap is no number, and neither is what is learned from it; with fewer raters on a row they seem to "
        "differ less, so gaps look like agreement; and a lie that nobody rated is hardly doubted.",
        "Ask for the missing ratings. In your own code, say which ratings are there instead of averaging over gaps; uard does so by itself.",
        numbers,
        how="sigma_human(ratings, mask=np.isfinite(ratings), empty=...)",
    )


def dead_ensemble(case: Case) -> Finding | None:
    """sigma_m is the same in all rows, or nearly 0 in all."""
    sigma = case.sigma_m
    if sigma is None or sigma.size < 2:
        return None
    constant = np.ptp(sigma) <= ROUNDING * sigma.max()
    if not constant and sigma.max() > 1e-3 * case.unit:
        return None
    kind = "the same" if constant else "nearly 0"
    return Finding(
        "dead-ensemble",
        "warning",
        f"sigma_m is {kind} in all {sigma.size} rows: {sigma.min():.3g} to {sigma.max():.3g}, the unit being {case.unit:.3g}.",
        "alpha sigma_m then does not show where the model is uncertain: it is a constant factor at best. Rewards that "
        "nobody has rated are believed as if their truth were known.",
        "Make the members differ: own initialisation and own data (bootstrap masks), or random priors; and check that "
        "sigma_m is taken over the members, not over one shared output.",
        {"smallest": float(sigma.min()), "largest": float(sigma.max())},
    )
