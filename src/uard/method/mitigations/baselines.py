"""Mitigations to compare with: the raw reward, a statistic of the ratings, leaving out what is disputed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from uard import _checks
from uard.method import uncertainty
from uard.method.arrays import Array, namespace, where
from uard.method.feedback import Feedback
from uard.method.mitigations import panel_statistics
from uard.method.mitigations.panel_statistics import PanelStatistics
from uard.method.mitigations.protocol import Evidence, LearningSignal, Mitigation
from uard.method.weights import discount

if TYPE_CHECKING:
    from jaxtyping import Bool


@dataclass(frozen=True)
class Raw(Mitigation):
    """Learn from the observed reward: no mitigation.

    Examples:
        >>> from uard.ratings.stream import RewardStream
        >>> RewardStream(Raw())([4.0], [[-1.0, 2.0, 1.0]]).reward.tolist()
        [4.0]
    """

    reads_feedback: ClassVar[bool] = False

    def signal(self, evidence: Evidence, statistics: Any) -> LearningSignal:
        """Return the observed reward."""
        return LearningSignal(evidence.reward, 1.0)


@dataclass(frozen=True)
class TrueReward(Mitigation):
    """Learn from the true reward: the oracle, of which regret is measured. Tabular training only.

    Examples:
        >>> from uard.envs.grids.trapgrid import TrapGrid
        >>> from uard.lab.cell import Cell
        >>> Cell(TrapGrid(), TrueReward()).mitigation.reads_truth
        True
    """

    reads_feedback: ClassVar[bool] = False
    reads_truth: ClassVar[bool] = True

    def signal(self, evidence: Evidence, statistics: Any) -> LearningSignal:
        """Return the reward, which a trainer has replaced by the true one."""
        return LearningSignal(evidence.reward, 1.0)


Statistic = Literal["mean", "lowest", "bound"]


@dataclass(frozen=True)
class RatedReward(Mitigation):
    """Learn from a statistic of the ratings (its running mean) instead of the observed reward.

    Examples:
        >>> from uard.ratings.stream import RewardStream
        >>> RewardStream(RatedReward("lowest"))([4.0], [[-1.0, 2.0, 1.0]]).reward.tolist()
        [-1.0]

    Attributes:
        statistic: ``mean`` or ``lowest`` of the ratings, or ``bound``: mean - k sigma over the ratings and the
            observed reward.
        k: Deviations below the mean for ``bound``, >= 0.
        unrated_weight: How far the observed reward is believed where nobody has rated it yet, in [0, 1]; 1 takes it
            as it is.
    """

    statistic: Statistic = "mean"
    k: float = 1.0
    unrated_weight: float = 1.0

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.choose("statistic", self.statistic, ("mean", "lowest", "bound"))
        _checks.number("k", self.k, low=0)
        _checks.number("unrated_weight", self.unrated_weight, low=0, high=1)

    def fit(self, feedback: Feedback, rated: Bool[Array, "*batch"]) -> PanelStatistics:
        """Measure ``PanelStatistics``."""
        return panel_statistics.fit(feedback, rated, proxy_is_rater=False)

    def signal(self, evidence: Evidence, statistics: PanelStatistics) -> LearningSignal:
        """Return the statistic; where nobody has rated, the reward shrunk towards the mean of the lowest ratings."""
        f, r = evidence.feedback, evidence.reward
        if self.statistic == "mean":
            rated = f.mean
        elif self.statistic == "lowest":
            rated = f.lowest
        else:
            mean = (f.raters * f.mean + r) / (f.raters + 1.0)
            rated = mean - self.k * uncertainty.with_proxy(f.mean, f.sd, r, f.raters)
        unrated = discount(r, self.unrated_weight, statistics.lowest)
        return LearningSignal(where(f.count > 0, rated, unrated), 1.0)


@dataclass(frozen=True)
class Screening(Mitigation):
    """Leave out of learning every step on which the raters disagree more than a threshold.

    The hard form of the filter: w in {0, 1}, and a step with w = 0 is skipped.

    Examples:
        >>> import numpy as np
        >>> from uard.ratings.aggregate import aggregate
        >>> reward = np.array([4.0, 0.0])
        >>> feedback = aggregate(np.array([[-1.0, 1.0], [0.0, 0.0]]), reward)
        >>> mitigation = Screening(limit=0.5)
        >>> statistics = mitigation.fit(feedback, feedback.count > 0)
        >>> mitigation.signal(Evidence(reward, np.zeros(2), feedback), statistics).sample_weight.tolist()
        [0.0, 1.0]

    Attributes:
        limit: Largest sigma_h (proxy counted as a rater) that is still learned from, in units of the reward's
            running scale, > 0.
    """

    limit: float = 0.5

    def __post_init__(self) -> None:
        """Check the parameter.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.number("limit", self.limit, low=0, open_low=True)

    def fit(self, feedback: Feedback, rated: Bool[Array, "*batch"]) -> PanelStatistics:
        """Measure the reward's scale."""
        return panel_statistics.fit(feedback, rated, proxy_is_rater=True)

    def signal(self, evidence: Evidence, statistics: PanelStatistics) -> LearningSignal:
        """Return the observed reward, and sample weight 0 where it is screened out."""
        f, r = evidence.feedback, evidence.reward
        sigma = uncertainty.with_proxy(f.mean, f.sd, r, f.raters)
        out = (f.count > 0) & (sigma > self.limit * statistics.scale)
        one = namespace(sigma).ones_like(sigma)
        return LearningSignal(r, where(out, 0.0 * one, one))
