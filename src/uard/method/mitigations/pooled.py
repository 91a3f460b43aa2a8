"""Reward discounting that knows who said what: the pooled rule of ``uard.method.pooled``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from uard import _checks
from uard.method import pooled, rater_statistics
from uard.method.arrays import Array, all_true, namespace, within
from uard.method.feedback import ByRater, Feedback
from uard.method.mitigations.protocol import Evidence, Explanation, LearningSignal, Mitigation
from uard.method.mitigations.robust import each_rater, flattened
from uard.method.rater_statistics import RaterStatistics, masked_median

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


class Believed(NamedTuple):
    """Statistics of a panel, and the median of what is learned with them.

    Attributes:
        raters: See ``RaterStatistics``.
        usual: Median reward that is learned over rated state-actions, in reward units; 0 before any rating.
    """

    raters: RaterStatistics
    usual: Float[Array, ""]


@dataclass(frozen=True)
class PooledDiscounting(Mitigation):
    """Believe a reward as far as it is likelier that all raters are centred at it than that they are not.

    What is learned is b + w (r - b) - risk sqrt(w (1 - w)) |r - b|, with b = pooled mean - contest tau, but not
    below the lowest that anybody says, - caution standard errors. Where nobody has rated: min(r, u + unrated_weight
    (r - u)) - risk sigma_m, with u the usual reward.

    Examples:
        >>> import numpy as np
        >>> from uard.ratings.aggregate import aggregate
        >>> reward = np.array([4.0] + 9 * [-0.1])
        >>> ratings = np.array([[-1.0, 2.0, 1.0]] + 9 * [[-0.1, -0.1, -0.1]])
        >>> feedback, mitigation = aggregate(ratings, reward), PooledDiscounting()
        >>> statistics = mitigation.fit(feedback, feedback.count > 0)
        >>> why = mitigation.explain(Evidence(reward, np.zeros(10), feedback), statistics)
        >>> why.weight[:2].round(2).tolist()
        [0.0, 1.0]

    Attributes:
        lies: Prior share of rewards that lie, in (0, 1).
        slack: By which share of an unusual reward a rater may be off without a reason, >= 0.
        contest: How many tau the anchor lies below the pooled mean, >= 0; but not below the lowest that anybody says.
        caution: How many standard errors of the pooled mean it lies below that, >= 0.
        risk: Premium >= 0 for not knowing which hypothesis holds, in posterior standard deviations.
        unrated_weight: How far an extraordinary reward is believed that nobody has rated, in [0, 1]. A higher one
            explores more: better on random problems whose raters answer seldom (development regret .09 at 0.05, .05
            at 1), but with 0.4 an agent on the paper's 10x10 grid no longer reaches the goal at 1 % rated steps.
        vetoes: How many lone low dissenters may be overruled, see ``uard.method.pooled.overruled``; >= 0.
    """

    discounts: ClassVar[bool] = True
    refits_early: ClassVar[bool] = True

    lies: float = 0.2
    slack: float = 0.1
    contest: float = 1.0
    caution: float = 0.5
    risk: float = 1.0
    unrated_weight: float = 0.05
    vetoes: int = 0

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.number("lies", self.lies, low=0, high=1, open_low=True)
        if self.lies == 1:
            raise _checks.InvalidValueError("lies", self.lies, "less than 1: a reward that always lies teaches nothing")
        for name in ("slack", "contest", "caution", "risk"):
            _checks.number(name, getattr(self, name), low=0, high=1000)
        _checks.number("unrated_weight", self.unrated_weight, low=0, high=1)
        _checks.whole("vetoes", self.vetoes, high=30)

    def fit(self, feedback: Feedback, rated: Bool[Array, "*batch"]) -> Believed:
        """Measure the raters, and what is usual."""
        r, each, rated = rater_statistics.thinned(*flattened(feedback, rated))
        raters = rater_statistics.fit(r, each, rated)
        learned = self._learned(r, each, 0.0 * r, Believed(raters, 0.0 * raters.scale))[0]
        return Believed(raters, masked_median(learned, rated))

    def signal(self, evidence: Evidence, statistics: Believed) -> LearningSignal:
        """Return what is learned."""
        return LearningSignal(
            self._learned(evidence.reward, each_rater(evidence.feedback), evidence.sigma_m, statistics)[0], 1.0
        )

    def reads_sigma_m(self, feedback: Feedback, statistics: Believed) -> Bool[Array, "*batch"]:
        """Return where nobody is heard: only there does an ensemble's doubt count."""
        each = each_rater(feedback)
        raters = rater_statistics.of_raters(statistics.raters, each.count.shape[-1])
        return ~((each.count > 0) & (raters.heard > 0)).any(-1)

    def explain(self, evidence: Evidence, statistics: Believed) -> Explanation:
        """Return what is learned, and why; sigma_h is tau."""
        r = evidence.reward
        learned, weight, anchor, tau = self._learned(r, each_rater(evidence.feedback), evidence.sigma_m, statistics)
        return Explanation(LearningSignal(learned, 1.0), tau, 0.0 * r, weight, anchor, evidence.sigma_m + tau)

    def _learned(
        self, r: Float[Array, "*batch"], each: ByRater, doubt: Float[Array, "*batch"], statistics: Believed
    ) -> tuple[Array, Array, Array, Array]:
        """Return what is learned, the weight, the anchor and tau."""
        xp, raters = namespace(each.mean), rater_statistics.of_raters(statistics.raters, each.count.shape[-1])
        here = (each.count > 0) & (raters.heard > 0)
        said, variance = each.mean - raters.bias, pooled.errors(r, each, raters, self.slack)
        if self.vetoes:
            here = pooled.overruled(said, here, variance, raters.noise, self.vetoes)
        p = pooled.pool(r, said, here, variance, raters.span)
        prior = self.lies / (1.0 - self.lies)
        odds = prior * xp.exp(within(p.log_odds, pooled.LARGEST_ODDS))
        w = 1.0 / (1.0 + odds)
        deviation = xp.sqrt(odds) * w  # sqrt(w (1 - w)), with a finite gradient
        b = xp.maximum(p.centre - self.contest * p.tau, p.lowest) - self.caution * p.error
        learned = b + w * (r - b) - self.risk * deviation * abs(r - b)
        rated = p.heard > 0
        if all_true(rated):
            return learned, w, b, p.tau
        u = statistics.usual
        unrated = xp.minimum(r, u + self.unrated_weight * (r - u)) - self.risk * doubt
        return (
            xp.where(rated, learned, unrated),
            xp.where(rated, w, 0.0 * w + self.unrated_weight),
            xp.where(rated, b, u + 0.0 * b),
            p.tau,
        )


def uard(**changes: Any) -> PooledDiscounting:
    """What we recommend: the pooled rule, a pure reward transform that knows who said what.

    Examples:
        >>> uard().vetoes, uard(vetoes=1).vetoes
        (0, 1)

    Args:
        changes: Parameters of ``PooledDiscounting`` that are not the recommended ones.

    Raises:
        InvalidValueError: naming the parameter, the value and what is allowed.
    """
    return PooledDiscounting(**changes)
