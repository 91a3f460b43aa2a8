"""What is left of a discount when a trainer has normalised the rewards of a group of completions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from uard.judges.groups import EQUAL, group_means

if TYPE_CHECKING:
    from jaxtyping import Float, Integer


def advantage_change(
    raw: Float[np.ndarray, " B"],
    reward: Float[np.ndarray, " B"],
    groups: Integer[np.ndarray, " B"],
    *,
    divided: bool = True,
) -> Float[np.ndarray, " groups"]:
    """How much the discount changes the advantages of each group, relative to the longer of the two vectors.

    0 where normalisation cancels the discount; if the advantages with and without it correlate by rho, it is
    sqrt(2 - 2 rho) of divided ones; 1 if only one of them is flat.

    Examples:
        >>> raw, halved = np.array([0.0, 2.0, 0.0, 2.0]), np.array([0.0, 1.0, 0.0, 2.0])
        >>> groups = np.array([0, 0, 1, 1])
        >>> advantage_change(raw, halved, groups).tolist()
        [0.0, 0.0]
        >>> advantage_change(raw, halved, groups, divided=False).tolist()
        [0.5, 0.0]

    Args:
        raw: Rewards without the discount, NaN where there is none.
        reward: Rewards with it, NaN in the same places.
        groups: The number of each completion's group, from 0.
        divided: Whether a group's advantages are divided by their standard deviation, or only centred.

    Returns:
        One number in [0, 2] per group; NaN where all rewards of the group are equal, with and without.
    """
    before, after = _centred(raw, groups), _centred(reward, groups)
    lengths = np.sqrt([np.bincount(groups, before**2), np.bincount(groups, after**2)])
    if divided:
        before, after = (x / np.where(n > 0, n, 1.0)[groups] for x, n in zip((before, after), lengths, strict=True))
        lengths = np.sign(lengths)
    longer = lengths.max(0)
    return np.sqrt(np.bincount(groups, (after - before) ** 2)) / np.where(longer > 0, longer, np.nan)


def keeps_factor(config: Any) -> bool:
    """Whether a factor that all completions of a prompt share changes their advantages under this configuration.

    Examples:
        >>> from types import SimpleNamespace
        >>> keeps_factor(SimpleNamespace(scale_rewards="group")), keeps_factor(SimpleNamespace(scale_rewards="batch"))
        (False, True)

    Args:
        config: A GRPOConfig or RLOOConfig. GRPO divides by the group's deviation with ``scale_rewards="group"`` and
            with ``multi_objective_aggregation="normalize_then_sum"``; RLOO never does.
    """
    divides = getattr(config, "scale_rewards", "none") in ("group", True)
    return not divides and getattr(config, "multi_objective_aggregation", "") != "normalize_then_sum"


def _centred(values: Float[np.ndarray, " B"], groups: Integer[np.ndarray, " B"]) -> Float[np.ndarray, " B"]:
    """Subtract each group's mean; 0 where a value is missing or the group's are equal up to rounding."""
    centred = np.where(np.isnan(values), 0.0, values - group_means(values, groups)[groups])
    return np.where(np.bincount(groups, centred**2)[groups] > EQUAL**2, centred, 0.0)
