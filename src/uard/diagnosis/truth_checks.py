"""Checks against the true reward, where a log has it: each returns a finding, or None."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from uard.diagnosis.case import Case, mostly
from uard.diagnosis.finding import Finding, percent, row_count
from uard.method import calibration, uncertainty
from uard.ratings.raters import EffectiveRaters

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Integer


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


def shared_errors(worth: EffectiveRaters | None) -> Finding | None:
    """Raters err together: they are surely worth less than half their number."""
    if worth is None or worth.against != "true_reward":
        return None
    most = worth.number.high
    if most is None or most >= worth.raters / 2:
        return None
    return Finding(
        "shared-errors",
        "warning",
        f"A row's {worth.raters:.3g} raters are worth {worth.number:.2g} independent ones: their errors correlate, by "
        f"{worth.correlation:.2f}.",
        "They agree in what is wrong, so that their agreement says less than their number promises; sigma_h does not see it.",
        "Ask fewer of the same kind and others of another kind: people beside models, models of other makers.",
        {"raters": worth.raters, "effective": worth.number.value, "correlation": worth.correlation.value},
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
    quality = _quality(np.round(1.0 - case.chosen.weight, 1), truth)  # less than a twentieth of doubt prevents nothing
    if quality["auroc"] >= 0.75:
        return None
    lies = int(truth.lie.sum())
    return Finding(
        "blind-sigma",
        "danger" if quality["auroc"] < 0.6 else "warning",
        f"Of a row whose reward lies by more than a unit (there are {lies}) and one whose does not, {case.chosen.name} doubts "
        f"the lie more in {percent(quality['auroc'])} of cases (AUROC of 1 - w in tenths; 50 % is chance). Spearman of 1 - w with "
        f"|reward - true|: {quality['spearman']:.2f}.",
        "The method assumes that the error grows with sigma. Here it does not: honest rewards are discounted as much as "
        "lies, which slows learning and prevents nothing.",
        "See which source of doubt is blind (the lines on calibration): count the reward as one more rater, ask other "
        "raters, or use a richer ensemble. If none sees the lies, do not filter; learn from the ratings or repair the reward.",
        {**quality, "lies": float(lies)},
    )
