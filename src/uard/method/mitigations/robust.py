"""Simple rules that know who said what: the median of the raters, and rewards that are capped by what raters say."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from uard import _checks
from uard.method import pooled, rater_statistics
from uard.method.arrays import Array, namespace, where
from uard.method.feedback import ByRater, Feedback
from uard.method.mitigations.protocol import Evidence, LearningSignal, Mitigation
from uard.method.rater_statistics import RaterStatistics, masked_median
from uard.method.uncertainty import root

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


@dataclass(frozen=True)
class RaterCap(Mitigation):
    """Learn from a middle of what the raters say, or from the reward where that is lower; unrated, from the reward.

    Examples:
        >>> from uard.ratings.stream import RewardStream
        >>> for cap in (RaterCap("median"), RaterCap("median", cap=False)):
        ...     print(RewardStream(cap)([4.0, 0.0], [[-1.0, 2.0, 1.0], [1.0, 0.5, 0.5]]).reward.tolist())
        [1.0, 0.0]
        [1.0, 0.5]

    Attributes:
        statistic: ``mean`` or ``median`` over the raters' own running means.
        cap: Whether the reward is only capped by it: min(reward, statistic).
    """

    statistic: Literal["mean", "median"] = "median"
    cap: bool = True

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.choose("statistic", self.statistic, ("mean", "median"))
        _checks.instance("cap", self.cap, bool, "true or false")

    def signal(self, evidence: Evidence, statistics: Any) -> LearningSignal:
        """Return the statistic or the reward, whichever is lower if it is a cap."""
        each, r = each_rater(evidence.feedback), evidence.reward
        here = each.count > 0
        middle = masked_median(each.mean, here, axis=-1) if self.statistic == "median" else _mean(each.mean, here)
        rated = namespace(r).minimum(r, middle) if self.cap else middle
        return LearningSignal(where(evidence.feedback.count > 0, rated, r), 1.0)


@dataclass(frozen=True)
class MeanLessVariance(Mitigation):
    """Learn from the raters' mean less k times their variance: UWO of Coste et al. (2024, arXiv 2310.02743).

    Unrated, learn from the reward. A variance has another unit than a mean: ratings are meant to be standardised.

    Examples:
        >>> from uard.ratings.stream import RewardStream
        >>> RewardStream(MeanLessVariance())([4.0], [[-1.0, 3.0]]).reward.tolist()
        [-1.0]

    Attributes:
        k: Times the population variance, >= 0.
    """

    k: float = 0.5

    def __post_init__(self) -> None:
        """Check the parameter.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.number("k", self.k, low=0)

    def signal(self, evidence: Evidence, statistics: Any) -> LearningSignal:
        """Return it."""
        each = each_rater(evidence.feedback)
        here = each.count > 0
        mean = _mean(each.mean, here)
        gap = each.mean - mean[..., None]
        return LearningSignal(
            where(evidence.feedback.count > 0, mean - self.k * _mean(gap * gap, here), evidence.reward), 1.0
        )


@dataclass(frozen=True)
class LogMeanExp(Mitigation):
    """Learn from a soft minimum of what raters say, -log(mean(exp(-k y))) / k; unrated, from the reward.

    Between the mean (k to 0) and the lowest (k to infinity). In standardised ratings, as judges have them.

    Examples:
        >>> from uard.ratings.stream import RewardStream
        >>> RewardStream(LogMeanExp())([4.0], [[-1.0, 3.0]]).reward.round(3).tolist()
        [-0.325]

    Attributes:
        k: How near to the lowest, per unit of a rating, > 0.
    """

    k: float = 1.0

    def __post_init__(self) -> None:
        """Check the parameter.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.number("k", self.k, low=0, open_low=True)

    def signal(self, evidence: Evidence, statistics: Any) -> LearningSignal:
        """Return it."""
        each = each_rater(evidence.feedback)
        here, xp = each.count > 0, namespace(each.mean)
        rated = evidence.feedback.count > 0
        said = where(here, each.mean, 0.0)
        lowest = xp.min(where(here, each.mean, float("inf")), axis=-1)
        lowest = where(rated, lowest, 0.0)
        # About the lowest, so that no exponential overflows.
        share = _mean(xp.exp(-self.k * (said - lowest[..., None])), here)
        soft = lowest - xp.log(where(rated, share, 1.0)) / self.k
        return LearningSignal(where(rated, soft, evidence.reward), 1.0)


@dataclass(frozen=True)
class ExcessDisagreement(Mitigation):
    """Cap the reward by the pooled mean less what raters differ by beyond their own noise: min(r, m - k tau).

    Examples:
        >>> from uard.ratings.stream import RewardStream
        >>> stream = RewardStream(ExcessDisagreement())
        >>> rewards, ratings = [4.0] + 9 * [-0.1], [[-1.0, 2.0, 1.0]] + 9 * [[-0.1] * 3]
        >>> for _ in range(9):
        ...     out = stream(rewards, ratings, keys=range(10))
        >>> bool(out.reward[0] < -0.8), out.reward[1:3].round(1).tolist()
        (True, [-0.1, -0.1])

    Attributes:
        k: How many tau are taken off, >= 0.
    """

    refits_early: ClassVar[bool] = True

    k: float = 1.5

    def __post_init__(self) -> None:
        """Check the parameter.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.number("k", self.k, low=0)

    def fit(self, feedback: Feedback, rated: Bool[Array, "*batch"]) -> RaterStatistics:
        """Measure the raters."""
        return fit_raters(feedback, rated)

    def signal(self, evidence: Evidence, statistics: RaterStatistics) -> LearningSignal:
        """Return the capped reward; unrated, the reward as far as it is usual."""
        each, r = each_rater(evidence.feedback), evidence.reward
        statistics = rater_statistics.of_raters(statistics, each.count.shape[-1])
        here = (each.count > 0) & (statistics.heard > 0)
        variance = pooled.errors(r, each, statistics, slack=0.0)
        said, xp = each.mean - statistics.bias, namespace(r)
        tau = root(pooled.variance_between(said, here, variance))
        cap = xp.where(
            xp.any(here, axis=-1), pooled.precise_mean(said, here, variance) - self.k * tau, statistics.typical
        )
        return LearningSignal(xp.minimum(r, cap), 1.0)


def _mean(values: Float[Array, "*batch K"], here: Bool[Array, "*batch K"]) -> Float[Array, "*batch"]:
    """Return the mean over those who are here, 0 where nobody is."""
    xp = namespace(values)
    raters = xp.sum(xp.astype(here, values.dtype), axis=-1)
    return xp.sum(where(here, values, 0.0), axis=-1) / xp.maximum(raters, xp.ones_like(raters))


def each_rater(feedback: Feedback) -> ByRater:
    """Return what each rater has said.

    Examples:
        >>> import numpy as np
        >>> from uard.ratings.aggregate import aggregate
        >>> each_rater(aggregate(np.array([[1.0, 3.0]]), np.zeros(1))).mean.tolist()
        [[1.0, 3.0]]

    Raises:
        InvalidValueError: only what all raters say together is known.
    """
    if feedback.by_rater is None:
        raise _checks.InvalidValueError("feedback.by_rater", None, "each rater's ratings: this rule asks who said what")
    return feedback.by_rater


def fit_raters(feedback: Feedback, rated: Bool[Array, "*batch"]) -> RaterStatistics:
    """Return the statistics of all raters over state-actions of any shape.

    Examples:
        >>> import numpy as np
        >>> from uard.ratings.aggregate import aggregate
        >>> feedback = aggregate(np.array([[1.0, 3.0], [0.0, 2.0]]), np.array([1.0, 0.0]))
        >>> fit_raters(feedback, feedback.count > 0).heard.tolist()
        [1.0, 1.0]

    Args:
        feedback: Of every state-action.
        rated: Which of them were rated.
    """
    return rater_statistics.fit(*flattened(feedback, rated))


def flattened(
    feedback: Feedback, rated: Bool[Array, "*batch"]
) -> tuple[Float[Array, " n"], ByRater, Bool[Array, " n"]]:
    """Return rewards, what each rater has said, and what was rated, of state-actions in one row.

    Examples:
        >>> import numpy as np
        >>> from uard.ratings.aggregate import aggregate
        >>> feedback = aggregate(np.zeros((3, 4, 2)), np.zeros((3, 4)))
        >>> [x.shape for x in flattened(feedback, feedback.count > 0)[1]]
        [(12, 2), (12, 2), (12, 2)]

    Args:
        feedback: Of state-actions in any shape.
        rated: Which of them were rated.
    """
    xp = namespace(feedback.mean)
    by_rater = ByRater._make(xp.reshape(x, (-1, x.shape[-1])) for x in each_rater(feedback))
    return xp.reshape(feedback.proxy, (-1,)), by_rater, xp.reshape(rated, (-1,))
