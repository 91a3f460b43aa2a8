"""Checks of what a filter does to a log: each returns a finding, or None."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from uard.diagnosis.case import Case, FilterOutcome, mostly, pairs, rescaled, share_kept
from uard.diagnosis.finding import Finding, percent, row_count


def by_setting(case: Case, check: Callable[[Case, FilterOutcome], Finding | None]) -> Finding | None:
    """Check the filter that is going to be used; a trap that only the printed one is in is a note.

    Args:
        case: The log.
        check: One of the checks below.
    """
    found = check(case, case.chosen)
    if found is not None:
        if case.chosen.name == case.recommended.name:
            return found
        verdict = "avoids" if check(case, case.recommended) is None else "does not avoid"
        return replace(found, remedy=f"{found.remedy} On this log uard {verdict} it.")
    found = check(case, case.printed)
    if found is None:
        return None
    return replace(
        found,
        severity="note",
        consequence=f"With the filter as printed: {found.consequence}",
        remedy=f"Nothing to do: {case.chosen.name} avoids it on this log. {found.remedy}",
    )


def smaller_penalties(case: Case, outcome: FilterOutcome) -> Finding | None:
    """Penalties are learned as smaller than reward and ratings."""
    r, mean, learned = case.reward, case.feedback.mean, outcome.learned
    gain = np.where(case.rated & (r < 0), learned - np.maximum(r, mean), 0.0)
    lost = (gain > 0.05 * case.unit) & (gain > 0.1 * np.abs(r))
    if not lost.any():
        return None
    i, j = pairs(np.flatnonzero(lost), np.flatnonzero(case.rated))
    worse = (r[i] < r[j]) & (mean[i] < mean[j])
    turned = worse & (learned[i] > learned[j])
    share = float(turned.sum() / max(int(worse.sum()), 1))
    worst = int(np.argmax(np.where(lost, gain, 0.0)))
    return Finding(
        "smaller-penalties",
        "danger" if turned.any() else "warning",
        f"{outcome.name} makes {int(lost.sum())} of {int((case.rated & (r < 0)).sum())} rated penalties smaller than both reward and "
        f"mean rating; most of all in {case.place(worst)}: {r[worst]:.3g} becomes {learned[worst]:.3g}. In {percent(share)} of their "
        "pairs with a step that has a higher reward and a higher mean rating, the penalty is paid more.",
        "w < 1 draws a negative reward up to an anchor above it, which is zero as printed: the agent is let off exactly "
        "where people disagree about how bad the step was, and enters a hazard that it would avoid without a filter.",
        "Draw rewards towards the lowest rating, not towards zero. uard has no such anchor: look whether raters copy each other, for it takes their agreement for knowledge.",
        {"penalties": float(lost.sum()), "largest_gain": float(gain[worst]), "turned": share},
        how="--mitigation uard-0.1, or anchor='lowest'",
    )


def origin_and_unit(case: Case, outcome: FilterOutcome) -> Finding | None:
    """What is learned depends on where zero is, or on the unit."""
    rated = np.flatnonzero(case.rated)
    i, j = pairs(rated, rated)
    apart = np.abs(case.reward[i] - case.reward[j]) > 0.1 * case.unit
    i, j = i[apart], j[apart]
    if not i.size:
        return None
    before = outcome.learned[i] - outcome.learned[j]
    flips: dict[str, float] = {}
    for name, shift, factor in (("shift", -10.0, 1.0), ("scale", 0.0, 0.1)):
        moved = rescaled(case, outcome.method, shift, factor)
        after = (moved[i] - moved[j]) / factor
        tiny = 1e-9 * case.unit
        flips[name] = float(((before * after < 0) & (np.abs(before) > tiny) & (np.abs(after) > tiny)).mean())
    if max(flips.values()) < 0.01:
        return None
    return Finding(
        "origin-and-unit",
        "danger" if max(flips.values()) >= 0.1 else "warning",
        f"If 10 is subtracted from all rewards and ratings, {outcome.name} reverses the order of {percent(flips['shift'])} of pairs "
        f"of rows; if all are multiplied by 0.1, of {percent(flips['scale'])} ({i.size} pairs that differ by over a tenth of a unit).",
        "What the agent prefers then depends on where zero is and on the unit, which carry no meaning: reward "
        "normalisation, another bonus or a rescaled model changes what it learns.",
        "Draw rewards towards the lowest rating, which moves along with a shift, and measure doubt in units of the reward.",
        flips,
        how="anchor='lowest', standardise=True",
    )


def lie_still_pays(case: Case, outcome: FilterOutcome) -> Finding | None:
    """A reward that raters contest is still paid far above its mean rating."""
    gap, far = case.gap(), case.far()
    contested = far & (gap > 0) & ~case.agreed(gap) & case.together
    if not contested.any() or mostly(far, case.rated):
        return None
    extra = (outcome.learned - case.feedback.mean)[contested]
    if extra.mean() < 0.25 * case.unit:
        return None
    worst = int(np.argmax(np.where(contested, outcome.learned - case.feedback.mean, -np.inf)))
    kept = share_kept(case, outcome, contested)
    return Finding(
        "lie-still-pays",
        "danger" if extra.mean() > case.unit else "warning",
        f"In {row_count(int(contested.sum()))} raters disagree about a reward that is more than a unit ({case.unit:.3g}) above their mean. "
        f"{outcome.name} still pays {extra.mean():+.3g} more than the mean rating there ({percent(kept)} of the difference); most of "
        f"all in {case.place(worst)}: reward {case.reward[worst]:.3g}, ratings {case.feedback.mean[worst]:.3g} ± "
        f"{case.feedback.sd[worst]:.2g}, paid {outcome.learned[worst]:.3g}.",
        "The discount is too small to change which action is best: the agent still goes where the reward lies.",
        "Let the discount grow where disagreement stands out, and draw rewards towards the lowest rating.",
        {"rows": float(contested.sum()), "overpaid": float(extra.mean()), "kept": kept},
        how="kappa > 0, anchor='lowest'",
    )


def saturated(case: Case, outcome: FilterOutcome) -> Finding | None:
    """Hardly any reward is believed, or all are although raters disagree."""
    if case.rated.sum() < 10:
        return None
    low, middle, high = np.quantile(outcome.weight[case.rated], [0.05, 0.5, 0.95])
    disagreement = float(np.quantile(case.feedback.sd[case.rated], 0.95) / case.unit)
    numbers = {"q05": float(low), "median": float(middle), "q95": float(high), "sigma_h_q95_in_units": disagreement}
    weights = f"{outcome.name}: weights of rated rows {low:.3g} (5 %), {middle:.3g} (median), {high:.3g} (95 %)"
    if high < 0.1:
        return Finding(
            "saturated-weights",
            "danger",
            f"{weights}: nothing is believed.",
            "The agent learns from the anchor alone; honest steps are discounted like lies, and with an anchor of zero "
            "there is nothing left to learn.",
            "Measure doubt in units of the reward, or doubt less. Of uard, which has no unit of its own, lower the prior share of lies.",
            numbers,
            how="standardise=True, or a lower lam; of uard a lower lies",
        )
    if low > 0.9 and disagreement > 0.5:
        return Finding(
            "saturated-weights",
            "warning",
            f"{weights}: everything is believed, though raters disagree by up to {disagreement:.2g} units (95 % of rows).",
            "The filter does nothing: it costs ratings and protects no more than the raw reward.",
            "Measure doubt in units of the reward, or doubt more. uard has no such setting: it takes what raters differ by for their noise, which is right if they are noisy. If raters disagree about all rows alike, no filter can tell the rows apart: give the raters clearer instructions.",
            numbers,
            how="standardise=True, or a higher lam",
        )
    return None
