"""Uncertainty-Aware Reward Discounting by the panel as a whole: as printed, and as recommended in version 0.1."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from uard import _checks
from uard._support import fields
from uard.method import adaptation, uncertainty
from uard.method.arrays import Array, Numbers, namespace, where
from uard.method.feedback import Feedback
from uard.method.mitigations import panel_statistics
from uard.method.mitigations.panel_statistics import PanelStatistics
from uard.method.mitigations.protocol import ActsOn, Backup, Evidence, Explanation, LearningSignal, Mitigation
from uard.method.weights import Form, ReliabilityFilter, discount, total_uncertainty

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_MAD_FLOOR = 0.01  # of the reward's scale: raters who agree to within this are never unusual


@dataclass(frozen=True)
class RewardDiscounting(Mitigation):
    """Discounting by how far the panel as a whole disagrees; ``uard_0_1`` and ``uard_paper`` name two forms.

    Examples:
        >>> from uard.ratings.stream import RewardStream
        >>> as_printed = RewardDiscounting(anchor="zero", kappa=0.0, proxy_is_rater=False, standardise=False)
        >>> step = RewardStream(as_printed)([4.0], [[-1.0, 2.0, 1.0]])
        >>> step.weight.round(3).tolist(), step.reward.round(3).tolist()
        ([0.445], [1.78])

    Attributes:
        filter: Weights and parameters of the Reliability Filter.
        acts_on: ``reward``: learn from b + w (r - b) (T_lambda, A21); ``score``: learn from the raw reward and act
            on J (A19, A38); ``both``.
        anchor: ``zero`` as printed, or ``lowest``: the running mean of the lowest rating for rewards, the
            worst action's value for scores, and where there is only one action, the ensemble's lower bound
            mu - sigma_m.
        kappa: Gain of the adaptive lambda_t (A44) >= 0; 0 keeps lambda constant.
        proxy_is_rater: Count the observed reward as one more rater in sigma_h.
        standardise: Measure sigmas in units of the running scale of the observed reward.
        unrated_weight: How far a reward is believed that nobody has rated yet, in [0, 1], on top of the ensemble's
            doubt.
        prior_count: Pseudo-count >= 0 with which anchor and trust of few ratings are drawn towards those of an
            unrated step (the mean of all lowest ratings, ``unrated_weight``).
        backup: See ``Mitigation``.
    """

    discounts: ClassVar[bool] = True

    filter: ReliabilityFilter = field(default_factory=ReliabilityFilter)
    acts_on: ActsOn = "reward"
    anchor: Literal["zero", "lowest"] = "lowest"
    kappa: float = 50.0
    proxy_is_rater: bool = True
    standardise: bool = True
    unrated_weight: float = 0.1
    prior_count: float = 2.0
    backup: Backup = "greedy"

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        fields.check(self)
        _checks.choose("acts_on", self.acts_on, ("reward", "score", "both"))
        _checks.choose("anchor", self.anchor, ("zero", "lowest"))
        _checks.choose("backup", self.backup, ("greedy", "consistent"))
        _checks.number("kappa", self.kappa, low=0)
        _checks.number("unrated_weight", self.unrated_weight, low=0, high=1)
        _checks.number("prior_count", self.prior_count, low=0)

    def fit(self, feedback: Feedback, rated: Bool[Array, "*batch"]) -> PanelStatistics:
        """Measure ``PanelStatistics``."""
        return panel_statistics.fit(feedback, rated, self.proxy_is_rater)

    def disagreement(self, proxy: Numbers, feedback: Feedback) -> Array:
        """Return sigma_h >= 0, in reward units, of steps with observed reward ``proxy``; 0 where nobody has rated."""
        sigma_h = feedback.sd
        if self.proxy_is_rater:
            sigma_h = uncertainty.with_proxy(feedback.mean, sigma_h, proxy, feedback.raters)
        return where(feedback.count > 0, sigma_h, 0.0)

    def coefficient(self, sigma_h: Numbers, statistics: PanelStatistics) -> Array:
        """Return lambda_t >= 0 (A44), which rises with how unusual sigma_h is among all state-actions."""
        z = adaptation.z_score(sigma_h, *statistics.disagreement, floor=_MAD_FLOOR * statistics.scale)
        return adaptation.adaptive_lambda(z, self.filter.lam, self.kappa)

    def weight(
        self, mu: Numbers, proxy: Numbers, sigma_m: Numbers, feedback: Feedback, statistics: PanelStatistics
    ) -> Array:
        """Return w in [0, 1].

        Args:
            mu: What is discounted, a reward or a value, measured from its anchor.
            proxy: The observed reward of the same state-actions.
            sigma_m: Disagreement of the ensemble, >= 0.
            feedback: What is known of their ratings.
            statistics: What ``fit`` returned.

        Raises:
            InvalidValueError: for a disagreement that is negative or not finite.
        """
        return self._weigh(mu, proxy, sigma_m, feedback, statistics)[0]

    def _weigh(
        self, mu: Numbers, proxy: Numbers, sigma_m: Numbers, feedback: Feedback, statistics: PanelStatistics
    ) -> tuple[Array, Array, Array]:
        """Return w, sigma_h and lambda_t."""
        sigma_h = self.disagreement(proxy, feedback)
        lam = self.coefficient(sigma_h, statistics)
        unit = statistics.scale if self.standardise else 1.0
        size = (mu if self.anchor == "zero" else abs(mu)) / unit if self.filter.needs_mu else None
        u = total_uncertainty(sigma_m / unit, sigma_h / unit, self.filter.alpha, self.filter.beta)
        weight = self.filter.weight_of(u, size, lam)
        # A factor, not a mixture: where nobody has rated, the ensemble's doubt still counts.
        weight = weight * uncertainty.shrink(1.0, feedback.count, self.unrated_weight, self.prior_count)
        return weight, sigma_h, lam

    def reward_anchor(
        self, reward: Float[Array, "*batch"], feedback: Feedback, statistics: PanelStatistics
    ) -> Float[Array, "*batch"]:
        """Return b, what a reward is drawn towards, in reward units."""
        if self.anchor == "zero":
            return 0.0 * reward
        return uncertainty.shrink(feedback.lowest, feedback.count, statistics.lowest, self.prior_count)

    def explain(self, evidence: Evidence, statistics: PanelStatistics) -> Explanation:
        """Return weight and anchor of a reward, what they were made from, and what is learned."""
        f, r = evidence.feedback, evidence.reward
        anchor = self.reward_anchor(r, f, statistics)
        weight, sigma_h, lam = self._weigh(r - anchor, r, evidence.sigma_m, f, statistics)
        doubt = self.filter.alpha * evidence.sigma_m + self.filter.beta * sigma_h
        learned = r if self.acts_on == "score" else discount(r, weight, anchor)
        return Explanation(LearningSignal(learned, 1.0), sigma_h, lam, weight, anchor, doubt)

    def signal(self, evidence: Evidence, statistics: PanelStatistics) -> LearningSignal:
        """Return b + w (r - b), or the observed reward if only scores are discounted."""
        if self.acts_on == "score":
            return LearningSignal(evidence.reward, 1.0)
        return self.explain(evidence, statistics).signal

    def score(
        self,
        mu: Float[Array, "*batch A"],
        sigma_m: Float[Array, "*batch A"],
        feedback: Feedback,
        statistics: PanelStatistics,
        *,
        one_action: bool = False,
    ) -> Float[Array, "*batch A"]:
        """Return J, or ``mu`` if only rewards are discounted."""
        if self.acts_on == "reward":
            return mu
        xp = namespace(mu)
        if self.anchor == "zero":
            anchor = xp.zeros_like(mu)
        else:
            anchor = mu - sigma_m if one_action else xp.min(mu, axis=-1, keepdims=True)
        return discount(mu, self.weight(mu - anchor, feedback.proxy, sigma_m, feedback, statistics), anchor)

    def without_prior(self) -> RewardDiscounting:
        """Return the same filter with a pseudo-count of 0."""
        return replace(self, prior_count=0.0)


def uard_0_1(lam: float = 0.2, alpha: float = 0.5, beta: float = 0.5, **changes: Any) -> RewardDiscounting:
    """What version 0.1 recommended: anchored reward, adaptive lambda, the proxy as one more rater; no scores.

    The base lambda is a tenth of the paper's and the gain kappa makes up for it where disagreement stands out: noise
    that all ratings share is then no reason for doubt.

    Examples:
        >>> uard_0_1().anchor, uard_0_1(kappa=0.0).filter.lam
        ('lowest', 0.2)

    Args:
        lam: lambda of the filter, >= 0.
        alpha: Weight of the ensemble's disagreement, in [0, 1].
        beta: Weight of the raters' disagreement, in [0, 1].
        changes: Other parameters of ``RewardDiscounting``.

    Raises:
        InvalidValueError: naming the parameter, the value and what is allowed.
    """
    return RewardDiscounting(filter=ReliabilityFilter(lam, alpha, beta), **changes)


def uard_paper(
    lam: float = 2.0, alpha: float = 0.5, beta: float = 0.5, form: Form = "reciprocal", **changes: Any
) -> RewardDiscounting:
    """As printed: raw reward, act on J, ordinary backup (A19, A38).

    Examples:
        >>> uard_paper().acts_on, uard_paper(acts_on="reward").acts_on
        ('score', 'reward')

    Args:
        lam: lambda of the filter, >= 0.
        alpha: Weight of the ensemble's disagreement, in [0, 1].
        beta: Weight of the raters' disagreement, in [0, 1].
        form: The filter's form, a name in ``uard.method.weights.FORMS``.
        changes: Other parameters of ``RewardDiscounting``.

    Raises:
        InvalidValueError: naming the parameter, the value and what is allowed.
    """
    printed: dict[str, Any] = {
        "acts_on": "score",
        "anchor": "zero",
        "kappa": 0.0,
        "proxy_is_rater": False,
        "standardise": False,
        "unrated_weight": 1.0,
        "prior_count": 0.0,
    }
    return RewardDiscounting(filter=ReliabilityFilter(lam, alpha, beta, form), **(printed | changes))
