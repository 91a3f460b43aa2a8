"""Checks of what is in a log: each returns a finding, or None."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from uard.diagnosis.case import FEW, LARGEST, PRINTED, ROUNDING, Case, mostly, share_kept, usable
from uard.diagnosis.finding import Finding, Severity, percent, row_count
from uard.method import calibration, uncertainty
from uard.ratings.log import NUMBERS, RatingLog

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Integer


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
        "Drop these rows, or mark missing ratings as missing (sigma_human(ratings, mask=...)); find out what wrote them.",
        numbers,
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
        "Name the column of rewards (--reward), or add one: a row of the export then says what was observed for its item.",
    )


def few_ratings(case: Case) -> Finding | None:
    """No row is rated, or too few are."""
    rated, share = int(case.rated.sum()), float(case.rated.mean())
    if rated == 0:
        return Finding(
            "no-ratings",
            "danger",
            f"None of {len(case.reward)} rows has a rating.",
            "Without ratings uard only scales the reward, and protects from nothing; sigma_m alone hardly sees a lie.",
            "Have at least two people rate a sample of steps, those with the highest rewards first.",
            {"rated_rows": 0.0},
        )
    if rated >= FEW and share >= 0.1:
        return None
    return Finding(
        "few-ratings",
        "warning",
        f"{rated} of {len(case.reward)} rows are rated ({percent(share)}).",
        "A reward that nobody has rated is believed in part (uard: a tenth) or wholly (the filter as printed), however high "
        f"it is; and with fewer than {FEW} rated rows the numbers here mean little.",
        "Rate more, the highest rewards first; with few ratings of one noisy rater named('lcb') does better than uard.",
        {"rated_rows": float(rated), "rated_share": share},
    )


def missing_ratings(case: Case) -> Finding | None:
    """Some ratings are missing."""
    here = np.isfinite(case.ratings)
    if here.all() or not case.rated.any():
        return None
    per_rater = 1.0 - here.mean(0)
    worst = int(per_rater.argmax())
    missing, none = float(1.0 - here.mean()), int((here.sum(1) == 0).sum())
    evidence = (
        f"{percent(missing)} of ratings are missing; most of {case.log.raters[worst]} ({percent(per_rater[worst])}). "
        f"{row_count(none)} have none at all"
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
        "A NaN that is averaged makes sigma_h and the anchor NaN; with fewer raters on a row sigma_h is smaller, so gaps look "
        "like agreement; and a lie that nobody rated is hardly doubted.",
        "Pass a mask: sigma_human(ratings, mask=np.isfinite(ratings), empty=...); ask the missing rater again.",
        numbers,
    )


def idle_raters(case: Case) -> Finding | None:
    """Raters who add nothing: they repeat the reward or another rater, or give every row the same rating."""
    idle: list[str] = []
    numbers: dict[str, float] = {}
    sample = np.unique(np.linspace(0, len(case.reward) - 1, 100_000).astype(int))
    reward, ratings, names = case.reward[sample], case.ratings[sample], case.log.raters

    def repeats(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " n"]) -> float:
        both = np.isfinite(a) & np.isfinite(b)
        a, b = a[both], b[both]
        same = np.abs(a - b) <= ROUNDING * case.unit
        return float(same.mean()) if a.size >= FEW and np.ptp(b) > 0 else 0.0

    for k, name in enumerate(names):
        column = ratings[:, k]
        here = np.isfinite(column)
        if here.sum() >= FEW and np.ptp(column[here]) == 0 and np.ptp(reward[here]) > 0:
            idle.append(f"{name} rates every row {column[here][0]:g}")
            numbers[f"constant_{name}"] = float(column[here][0])
        elif (share := repeats(column, reward)) >= 0.99:
            idle.append(f"{name} repeats the reward exactly in {percent(share)} of its rows")
            numbers[f"repeats_reward_{name}"] = share
        else:
            for j in range(k):
                if (share := repeats(column, ratings[:, j])) >= 0.99:
                    idle.append(f"{name} equals {names[j]} in {percent(share)} of their rows")
                    numbers[f"{name}_repeats_{names[j]}"] = share
                    break
    if not idle:
        return None
    return Finding(
        "idle-raters",
        "warning",
        "; ".join(idle) + ".",
        "Such a rater adds no information. Copies lower sigma_h, so they turn doubt into trust; a copy of the reward "
        "confirms every lie in it.",
        "Leave these columns out (--ratings), and find out whether the people rated alone or saw the reward.",
        numbers,
    )


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
        "Count the reward as one more rater (proxy_is_rater=True, as uard does; it then lives on the distance between "
        "rating and reward, which noise can hide), or have a second person rate a sample.",
        numbers,
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
        f"Count the reward as one more rater (proxy_is_rater=True): named('uard') believes {percent(recommended)} of it here.",
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
        "Bring the ratings into the reward's unit first, on rows that can be trusted. If they are in it already, the reward is "
        "wrong nearly everywhere: learn from the ratings, named('worst-of-annotations') or named('lcb').",
        numbers,
    )


def colluding(case: Case) -> Finding | None:
    """Raters agree with each other but not with the truth."""
    if case.true is None:
        return None
    known = case.rated & np.isfinite(case.true)
    true = np.where(known, case.true, 0.0)
    error = np.where(known, case.feedback.mean - true, 0.0)
    wrong = case.agreed(error) & (np.abs(error) > max(case.unit, case.noise))
    if not wrong.any() or mostly(case.far(), case.rated):
        return None
    worst = int(np.argmax(np.where(wrong, np.abs(error), 0.0)))
    paid = float((case.chosen.learned - true)[wrong].mean())
    share = float(wrong.sum() / max(int(known.sum()), 1))
    return Finding(
        "colluding-raters",
        "danger",
        f"In {row_count(int(wrong.sum()))} ({percent(share)} of those whose true reward is known) raters agree with each other and are "
        f"more than a unit ({case.unit:.3g}) from the true reward; most of all in {case.place(worst)}: ratings "
        f"{case.feedback.mean[worst]:.3g} ± {case.feedback.sd[worst]:.2g}, true {true[worst]:.3g}. There "
        f"{case.chosen.name} would pay {paid:+.3g} more than the truth on average.",
        "Agreement is taken for truth. No method that relies on these raters can help; the agent learns what they repeat.",
        "No setting avoids it. Ask people who do not see the reward or each other, and check a sample against the truth.",
        {"rows": float(wrong.sum()), "share": share, "largest": float(error[worst]), "overpaid": paid},
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


class _Truth(NamedTuple):
    """The rated rows whose true reward is known.

    Attributes:
        rows: Their numbers.
        error: |reward - true reward|, in reward units.
        lie: Whether that is more than a unit.
    """

    rows: Integer[np.ndarray, " m"]
    error: Float[np.ndarray, " m"]
    lie: Bool[np.ndarray, " m"]

    def both_kinds(self) -> bool:
        """Return whether there are enough lies and enough honest rewards to tell them apart."""
        return min(self.lie.sum(), (~self.lie).sum()) >= 5


def _truth(case: Case) -> _Truth | None:
    if case.true is None:
        return None
    rows = np.flatnonzero(case.rated & np.isfinite(case.true))
    error = np.abs(case.reward - case.true)[rows]
    return _Truth(rows, error, error > case.unit) if rows.size >= 2 else None


def _quality(sigma: Float[np.ndarray, " n"], truth: _Truth) -> dict[str, float]:
    known = np.round(sigma[truth.rows], 6)
    quality = {"spearman": calibration.spearman(known, truth.error)}
    return quality | ({"auroc": calibration.auroc(known, truth.lie)} if truth.both_kinds() else {})


def calibration_of(case: Case) -> dict[str, dict[str, float]] | None:
    """Return how well each sigma predicts |reward - true reward|, by its name; None without a true reward."""
    truth, f = _truth(case), case.feedback
    if truth is None:
        return None
    with_proxy = uncertainty.with_proxy(f.mean, f.sd, case.reward, f.raters)
    sources = {"sigma_h": f.sd, "sigma_h_with_proxy": with_proxy}
    sources |= {} if case.sigma_m is None else {"sigma_m": case.sigma_m}
    return {name: _quality(sigma / case.unit, truth) for name, sigma in sources.items()}


def blind_sigma(case: Case) -> Finding | None:
    """The weight does not distinguish lies from honest rewards."""
    truth = _truth(case)
    if truth is None or not truth.both_kinds():
        return None
    quality = _quality(1.0 - case.chosen.weight, truth)
    if quality["auroc"] >= 0.75:
        return None
    lies = int(truth.lie.sum())
    return Finding(
        "blind-sigma",
        "danger" if quality["auroc"] < 0.6 else "warning",
        f"Of a row whose reward lies by more than a unit (there are {lies}) and one whose does not, {case.chosen.name} doubts "
        f"the lie more in {percent(quality['auroc'])} of cases (AUROC of 1 - w; 50 % is chance). Spearman of 1 - w with "
        f"|reward - true|: {quality['spearman']:.2f}.",
        "The method assumes that the error grows with sigma. Here it does not: honest rewards are discounted as much as "
        "lies, which slows learning and prevents nothing.",
        "See which source of doubt is blind (the lines on calibration): count the reward as one more rater, ask other "
        "raters, or use a richer ensemble. If none sees the lies, do not filter; learn from the ratings or repair the reward.",
        {**quality, "lies": float(lies)},
    )
