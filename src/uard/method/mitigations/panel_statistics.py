"""What is known of a panel over all distinct state-actions that it has rated."""

from __future__ import annotations

from typing import NamedTuple

from uard.method import uncertainty
from uard.method.arrays import Array, namespace
from uard.method.feedback import Feedback


class PanelStatistics(NamedTuple):
    """Statistics over the distinct state-actions rated so far.

    Attributes:
        disagreement: Location and mean absolute deviation of sigma_h.
        scale: Standard deviation of the observed reward, the unit in which sigmas are measured; 1 before any rating
            and while all observed rewards are equal.
        lowest: Mean of the lowest ratings: what a step is worth at least; 0 before any rating.
    """

    disagreement: uncertainty.Location
    scale: Array
    lowest: Array


def fit(feedback: Feedback, rated: Array, proxy_is_rater: bool) -> PanelStatistics:
    """Measure them.

    Args:
        feedback: Of every state-action.
        rated: Which of them were rated (bool).
        proxy_is_rater: Whether the observed reward counts as one more rater in sigma_h.
    """
    xp = namespace(feedback.mean)
    sigma = feedback.sd
    if proxy_is_rater:
        sigma = uncertainty.with_proxy(feedback.mean, sigma, feedback.proxy, feedback.raters)
    centre = uncertainty.location_and_mad(feedback.proxy, rated).location
    variance = uncertainty.location_and_mad((feedback.proxy - centre) * (feedback.proxy - centre), rated).location
    scale = xp.sqrt(variance)
    rated_proxy = xp.where(rated, feedback.proxy, xp.zeros_like(feedback.proxy))
    # Rounding alone must not make a scale where all observed rewards are equal.
    rounding = xp.finfo(scale.dtype).eps * xp.sum(xp.ones_like(rated_proxy)) * xp.max(xp.abs(rated_proxy))
    scale = xp.where(scale > rounding, scale, xp.ones_like(scale))
    lowest = uncertainty.location_and_mad(feedback.lowest, rated).location
    return PanelStatistics(uncertainty.location_and_mad(sigma, rated), scale, lowest)
