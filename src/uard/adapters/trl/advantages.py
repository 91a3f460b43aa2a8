"""What is left of a discount when a trainer has normalised the rewards of a group of completions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float, Integer

EQUAL = 1e-9  # length of a group's centred rewards at which they count as equal


def groups_of(prompts: Sequence[Any]) -> Integer[np.ndarray, " B"]:
    """Number the groups of a batch from 0: neighbours with the same prompt, as TRL's samplers lay them out.

    Examples:
        >>> groups_of(["why?", "why?", "how?"]).tolist()
        [0, 0, 1]
    """
    texts = [repr(prompt) for prompt in prompts]
    return np.cumsum([i > 0 and text != texts[i - 1] for i, text in enumerate(texts)], dtype=int)


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
    centred = np.nan_to_num(values - group_means(values, groups)[groups])
    return np.where(np.bincount(groups, centred**2)[groups] > EQUAL**2, centred, 0.0)


def group_means(values: Float[np.ndarray, " B"], groups: Integer[np.ndarray, " B"]) -> Float[np.ndarray, " groups"]:
    """Mean of each group's values, without the missing ones; NaN where all are missing.

    Examples:
        >>> group_means(np.array([1.0, 3.0, np.nan]), np.array([0, 0, 1])).tolist()
        [2.0, nan]
    """
    total, known = np.bincount(groups, np.nan_to_num(values)), np.bincount(groups, ~np.isnan(values))
    return total / np.where(known > 0, known, np.nan)


def told_apart(
    scores: Float[np.ndarray, "B K"], groups: Integer[np.ndarray, " B"]
) -> tuple[Integer[np.ndarray, " K"], Integer[np.ndarray, " K"]]:
    """Count the groups of which each judge has scored two completions or more, and those in which its scores differ.

    Examples:
        >>> scores = np.array([[1.0, 5.0], [2.0, 5.0], [1.0, 7.0], [1.0, 7.0], [1.0, np.nan]])
        >>> [counts.tolist() for counts in told_apart(scores, np.array([0, 0, 1, 1, 2]))]
        [[2, 2], [1, 0]]

    Args:
        scores: NaN where one is missing.
        groups: The number of each completion's group, from 0.
    """
    here, number = ~np.isnan(scores), int(groups[-1]) + 1 if len(groups) else 0
    known, lowest = np.zeros((number, scores.shape[1]), int), np.full((number, scores.shape[1]), np.inf)
    highest = -lowest
    np.add.at(known, groups, here)
    np.minimum.at(lowest, groups, np.where(here, scores, np.inf))
    np.maximum.at(highest, groups, np.where(here, scores, -np.inf))
    with np.errstate(over="ignore", invalid="ignore"):
        differ = highest - lowest > EQUAL * np.maximum(abs(highest), abs(lowest))
    compared = known >= 2
    return compared.sum(0), (compared & differ).sum(0)
