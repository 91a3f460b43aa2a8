"""What is known of a panel over all distinct state-actions that it has rated."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from uard.method import uncertainty
from uard.method.arrays import Array, namespace
from uard.method.feedback import Feedback
from uard.method.uncertainty import masked_mean

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


class PanelStatistics(NamedTuple):
    """Statistics over the distinct state-actions rated so far, in reward units.

    Attributes:
        disagreement: Location and mean absolute deviation of sigma_h.
        scale: Standard deviation of the observed reward, the unit in which sigmas are measured; 1 before any rating
            and while all observed rewards are equal.
        lowest: Mean of the lowest ratings: what a step is worth at least; 0 before any rating. A model of ratings has
            a number for each step.
    """

    disagreement: uncertainty.Location
    scale: Float[Array, ""] | float
    lowest: Float[Array, "*batch"] | float


def fit(feedback: Feedback, rated: Bool[Array, "*batch"], proxy_is_rater: bool) -> PanelStatistics:
    """Measure them.

    Examples:
        >>> import numpy as np
        >>> from uard.ratings.aggregate import aggregate
        >>> feedback = aggregate(np.array([[-1.0, 1.0], [2.0, 4.0]]), np.array([0.0, 4.0]))
        >>> statistics = fit(feedback, feedback.count > 0, proxy_is_rater=False)
        >>> float(statistics.disagreement.location), float(statistics.scale), float(statistics.lowest)
        (1.0, 2.0, 0.5)

    Args:
        feedback: Of every state-action.
        rated: Which of them were rated.
        proxy_is_rater: Whether the observed reward counts as one more rater in sigma_h.
    """
    xp, proxy = namespace(feedback.mean), feedback.proxy
    sigma = feedback.sd
    if proxy_is_rater:
        sigma = uncertainty.with_proxy(feedback.mean, sigma, proxy, feedback.raters)
    gap = proxy - masked_mean(proxy, rated)
    scale = xp.sqrt(masked_mean(gap * gap, rated))
    rated_proxy = xp.where(rated, proxy, xp.zeros_like(proxy))
    # Rounding alone must not make a scale where all observed rewards are equal.
    size = xp.sum(xp.ones_like(rated_proxy))
    rounding = xp.finfo(scale.dtype).eps * size * xp.max(xp.abs(rated_proxy))
    scale = xp.where(scale > rounding, scale, xp.ones_like(scale))
    lowest = masked_mean(feedback.lowest, rated)
    return PanelStatistics(uncertainty.location_and_mad(sigma, rated), scale, lowest)
