"""Checks of raters against each other and against the reward: each returns a finding, or None."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uard.diagnosis.case import FEW, PRINTED, Case, mostly, share_kept
from uard.diagnosis.finding import Finding, Severity, Stratum, listed, percent, row_count
from uard.ratings.pairs import line_between, units_of

if TYPE_CHECKING:
    from jaxtyping import Bool, Integer


def one_rater(case: Case) -> Finding | None:
    """No row has more than one rating."""
    if not case.rated.any() or case.together.any():
        return None
    far = np.abs(case.gap()) > case.unit
    kept = {o.name: share_kept(case, o, far) for o in (case.chosen, case.printed)}
    numbers = {"rated_rows": float(case.rated.sum()), "contradicted_rows": float(far.sum())}
    evidence = f"No row has more than one rating, so sigma_h = 0 in all {int(case.rated.sum())} rated rows."
    blind = False
    if far.any():
        numbers |= {f"kept_{name}": share for name, share in kept.items()}
        blind = kept[case.chosen.name] >= 0.5
        evidence += (
            f" In {row_count(int(far.sum()))} the rating is more than one unit ({case.unit:.3g}) from the reward; there "
            + " and ".join(f"{name} still believes {percent(share)} of the difference" for name, share in kept.items())
            + "."
        )
    return Finding(
        "one-rater",
        "danger" if blind else "warning",
        evidence,
        "One person never disagrees with itself: sigma_h = 0 is read as certainty, which means blind trust in the reward.",
        "Have a second person rate a sample. Until then use uard, which compares the ratings with the reward; what one rater is noisy by can hide a lie.",
        numbers,
        how="named('uard'), or named('uard-0.1', proxy_is_rater=True)",
    )


def contradicted(case: Case) -> Finding | None:
    """Raters agree with each other but not with the reward; or ratings and rewards are not in one unit."""
    gap, far = case.gap(), case.far()
    if mostly(far, case.rated):
        return _other_units(case, far)
    agreed = far & case.agreed(gap)
    if not agreed.any():
        return None
    outcomes = (case.chosen, case.printed, case.recommended)
    chosen, printed, recommended = (share_kept(case, o, agreed) for o in outcomes)
    worst = int(np.argmax(np.where(agreed, np.abs(gap), 0.0)))
    severity: Severity = "danger" if chosen >= 0.5 else "warning" if chosen >= 0.1 else "note"
    above = int((agreed & (gap > 0)).sum())
    kept = {case.chosen.name: chosen, PRINTED: printed}
    return Finding(
        "reward-contradicted",
        severity,
        f"In {row_count(int(agreed.sum()))} ({above} of them paid too much) raters agree with each other and the reward is more "
        f"than a unit ({case.unit:.3g}) away; most of all in {case.place(worst)}: reward {case.reward[worst]:.3g}, ratings "
        f"{case.feedback.mean[worst]:.3g} ± {case.feedback.sd[worst]:.2g}. Of the difference "
        f"{' and '.join(f'{name} still believes {percent(share)}' for name, share in kept.items())}.",
        "Agreement makes sigma_h small, so a filter that looks at the raters alone trusts the reward most where they "
        "all contradict it, and the agent learns to go there.",
        f"Use a filter that asks whether raters are centred at the reward, as uard does: it believes {percent(recommended)} of it here.",
        {
            "rows": float(agreed.sum()),
            "largest": float(gap[worst]),
            "kept": chosen,
            "kept_printed": printed,
            "kept_uard": recommended,
        },
    )


def _other_units(case: Case, far: Bool[np.ndarray, " n"]) -> Finding:
    reward, mean = case.reward[case.rated], case.feedback.mean[case.rated]
    together = 0.0
    if np.ptp(mean) > 0 and np.ptp(reward) > 0:
        together = float(np.corrcoef(reward, mean)[0, 1])
    numbers = {
        "far_share": float(far.sum() / case.rated.sum()),
        "mean_reward": float(reward.mean()),
        "mean_rating": float(mean.mean()),
        "correlation": together,
    }
    return Finding(
        "other-units",
        "danger",
        f"In {percent(numbers['far_share'])} of the rated rows the ratings are more than a unit ({case.unit:.3g}) from the reward "
        f"(means {numbers['mean_rating']:.3g} and {numbers['mean_reward']:.3g}; correlation {together:.2f}).",
        "The filter compares ratings with rewards: their distance is doubt, the lowest rating is the anchor. If they are "
        "in other units (stars against points) every reward is doubted or replaced by a number that means something else.",
        "Bring the ratings into the reward's unit first, on rows that can be trusted. If they are in it already, the reward is wrong nearly everywhere: learn from the ratings instead.",
        numbers,
        how="named('worst-of-annotations'), or named('lcb')",
    )


def units(case: Case) -> Integer[np.ndarray, " m"] | None:
    """Return the number of each rater's unit, see ``uard.ratings.pairs.units_of``."""
    return units_of(case.pairs_of_raters)


def mixed_units(case: Case) -> Finding | None:
    """Raters who rate one thing in different units: stars, per cent, logits."""
    unit = units(case)
    if unit is None:
        return None
    both, names = case.pairs_of_raters, case.sample.names
    middle, spread = np.nanmedian(case.sample.ratings[:, unit >= 0], 0), np.diag(both.sd)[unit >= 0]
    of = dict(zip(np.flatnonzero(unit >= 0), zip(middle, spread, strict=True), strict=True))
    numbers = {f"median_{names[k]}": float(m) for k, (m, _) in of.items()}
    numbers |= {f"spread_{names[k]}": float(s) for k, (_, s) in of.items()}
    groups = [np.flatnonzero(unit == u) for u in range(unit.max() + 1)]
    usual = float(np.median(case.reward))
    groups.sort(key=lambda g: (-len(g), abs(float(np.median([of[k][0] for k in g])) - usual)))
    parts: list[str] = []
    maps: list[str] = []
    for number, group in enumerate(groups):
        parts.append(listed(f"{names[k]} (median {of[k][0]:.3g}, spread {of[k][1]:.3g})" for k in group))
        for k in group if number else ():
            line = line_between(both, int(k), groups[0])
            if line is None:
                continue
            slope, offset = line
            numbers |= {f"slope_{names[k]}": slope, f"offset_{names[k]}": offset}
            maps.append(f"{slope:.3g} {names[k]} {offset:+.3g}")
    return Finding(
        "mixed-units",
        "danger",
        f"Raters who agree on which rows are better rate in {len(groups)} units: {'; against '.join(parts)}.",
        "Their mean, their lowest and their disagreement are of the unit with the largest numbers: sigma_h is large "
        "where nobody disagrees, and one rater decides.",
        f"Bring them into one unit first, that of {listed(names[k] for k in groups[0])}"
        + (f": on the rows that both rated, {listed(maps)} has its mean and spread." if maps else "."),
        numbers,
    )


def uneven_agreement(strata: tuple[Stratum, ...], overall: float | None) -> Finding | None:
    """Raters agree far less within a part of the rows than over all.

    Args:
        strata: The parts.
        overall: Alpha over all rows.
    """
    if overall is None:
        return None
    low = [
        s
        for s in strata
        if s.agreement is not None
        and s.rows >= FEW
        and s.high is not None
        and s.high < overall
        and s.agreement < min(overall - 0.2, 0.667)
    ]
    if not low:
        return None
    return Finding(
        "uneven-agreement",
        "warning",
        f"Over all rows alpha is {overall:.2f}, but "
        + listed(
            f"{s.agreement:.2f} in {s.name} ({row_count(s.rows)}; at most {s.high:.2f}; raters differ by {s.within:.3g} about "
            f"a row, their means by {s.between:.3g} between rows)"
            for s in low
        )
        + ".",
        "Raters agree about which part a row belongs to, not about what is better within it: there the ratings order "
        "rows hardly better than chance, though the number over all looks reliable.",
        "Judge the ratings by the alpha of the rows that the policy will be trained on. Give clearer instructions or more "
        "raters there; if the rows are truly alike, do not learn from the differences.",
        {f"alpha_{s.name}": float(s.agreement) for s in low if s.agreement is not None} | {"alpha": overall},
    )
