"""Reward discounting by a model of who tells the truth (experimental): ``uard.method.witness``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from uard import _checks
from uard.method import witness
from uard.method.arrays import Array, namespace
from uard.method.feedback import Feedback
from uard.method.mitigations.protocol import Evidence, Explanation, LearningSignal, Mitigation
from uard.method.mitigations.robust import each_rater, flattened
from uard.method.witness import Belief, Prior, WitnessStatistics

if TYPE_CHECKING:
    from jaxtyping import Bool


@dataclass(frozen=True)
class Witness(Mitigation):
    """Ask which rater tells the truth where the reward lies (experimental), and learn what is then to be expected.

    What is learned is b + w (r - b) - risk s: w the posterior probability that the reward is honest, b the posterior
    mean of the truth if it is not, s the posterior standard deviation. Where nobody has rated:
    min(r, u + unrated_weight (r - u)) - risk sigma_m, with u the usual reward.

    Examples:
        >>> import numpy as np
        >>> from uard.ratings.aggregate import aggregate
        >>> reward = np.array([4.0] + 9 * [-0.1])
        >>> ratings = np.array([[-1.0, 2.0, 1.0]] + 9 * [[-0.1, -0.1, -0.1]])
        >>> feedback, mitigation = aggregate(ratings, reward), Witness()
        >>> statistics = mitigation.fit(feedback, feedback.count > 0)
        >>> why = mitigation.explain(Evidence(reward, np.zeros(10), feedback), statistics)
        >>> why.weight[:2].round(2).tolist()
        [0.0, 1.0]

    Attributes:
        lies: Prior share of rewards that lie, in (0, 1).
        over: Prior share of these that say too much, in (0, 1).
        errs: Chance that a rater errs where the reward lies, in (0, 1).
        stray: Chance that a rater is simply wrong, in (0, 1 - errs). The larger, the less one dissenter counts.
        slack: By which share of an unusual truth a rater may be off without a reason, >= 0.
        risk: Premium >= 0 in posterior standard deviations.
        unrated_weight: How far an extraordinary reward is believed that nobody has rated, in [0, 1].
    """

    discounts: ClassVar[bool] = True
    refits_early: ClassVar[bool] = True
    needs_rater_identity: ClassVar[bool] = True

    lies: float = 0.2
    over: float = 0.9
    errs: float = 0.3
    stray: float = 1e-4
    slack: float = 0.1
    risk: float = 0.5
    unrated_weight: float = 0.05

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        for name in ("lies", "over", "errs", "stray"):
            _checks.number(name, value := getattr(self, name), low=0, high=1, open_low=True)
            if value == 1:
                raise _checks.InvalidValueError(name, value, "less than 1")
        if self.errs + self.stray >= 1:
            raise _checks.InvalidValueError("stray", self.stray, f"less than 1 - errs = {1 - self.errs:g}")
        for name in ("slack", "risk"):
            _checks.number(name, getattr(self, name), low=0, high=1000)
        _checks.number("unrated_weight", self.unrated_weight, low=0, high=1)

    @property
    def prior(self) -> Prior:
        """What is believed of any panel before it is met."""
        return Prior(self.lies, self.over, self.errs, self.stray, self.slack, self.risk)

    def fit(self, feedback: Feedback, rated: Bool[Array, "*batch"]) -> WitnessStatistics:
        """Measure the raters, and learn how often the reward lies."""
        return witness.fit(*flattened(feedback, rated), self.prior)

    def signal(self, evidence: Evidence, statistics: WitnessStatistics) -> LearningSignal:
        """Return what is learned."""
        return LearningSignal(self._believed(evidence, statistics).learned, 1.0)

    def explain(self, evidence: Evidence, statistics: WitnessStatistics) -> Explanation:
        """Return what is learned, and why; sigma_h is the posterior standard deviation, 0 where nobody has rated."""
        b = self._believed(evidence, statistics)
        signal, doubt = LearningSignal(b.learned, 1.0), evidence.sigma_m + b.deviation
        return Explanation(signal, b.deviation, 0.0 * evidence.reward, b.weight, b.anchor, doubt)

    def _believed(self, evidence: Evidence, statistics: WitnessStatistics) -> Belief:
        """Return what is believed; unrated, a reward as far as it is usual."""
        r, each = evidence.reward, each_rater(evidence.feedback)
        panel = witness.of_raters(statistics, each.count.shape[-1])
        xp = namespace(each.mean)
        b = witness.believe(r, witness.hypotheses(r, each, panel, self.prior), panel, self.risk)
        u, nothing = panel.usual, 0.0 * r
        unrated = xp.minimum(r, u + self.unrated_weight * (r - u)) - self.risk * evidence.sigma_m
        rest = Belief(nothing + self.unrated_weight, nothing + u, nothing, unrated)
        rated = xp.any((each.count > 0) & (panel.raters.heard > 0), axis=-1)
        return Belief._make(xp.where(rated, x, y) for x, y in zip(b, rest, strict=True))
