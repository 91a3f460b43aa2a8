"""Groups of completions: those of one prompt, which trainers compare with each other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from uard.judges.contents import content_of
from uard.ratings.pairs import shared

if TYPE_CHECKING:
    from jaxtyping import Float, Integer

EQUAL = 1e-9  # relative difference at which the scores of a group, or the length of its rewards, count as equal
TOGETHER = 16  # completions that two judges must both have scored


def groups_of(prompts: Sequence[Any]) -> Integer[np.ndarray, " B"]:
    """Number the groups of a batch from 0: neighbours with the same prompt, as TRL's samplers lay them out.

    Examples:
        >>> groups_of(["why?", "why?", "how?"]).tolist()
        [0, 0, 1]
    """
    keys = [content_of(prompt) for prompt in prompts]
    return np.cumsum([i > 0 and key != keys[i - 1] for i, key in enumerate(keys)], dtype=int)


def group_means(
    values: Float[np.ndarray, "B ..."], groups: Integer[np.ndarray, " B"]
) -> Float[np.ndarray, "groups ..."]:
    """Mean of each group's values, column by column, without the missing ones; NaN where all are missing.

    Examples:
        >>> group_means(np.array([1.0, 3.0, np.nan]), np.array([0, 0, 1])).tolist()
        [2.0, nan]
    """
    columns = values.reshape(len(values), -1)
    place = (groups[:, None] * columns.shape[1] + np.arange(columns.shape[1])).ravel()
    here = ~np.isnan(columns).ravel()
    total, known = np.bincount(place, np.where(here, columns.ravel(), 0.0)), np.bincount(place, here)
    return (total / np.where(known > 0, known, np.nan)).reshape(-1, *values.shape[1:])


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
    if not groups.size:
        return told_apart(np.full((1, scores.shape[1]), np.nan), np.zeros(1, dtype=int))
    if (groups[1:] < groups[:-1]).any():  # a prompt came again later
        order = np.argsort(groups, kind="stable")
        scores, groups = scores[order], groups[order]
    first = np.flatnonzero(np.concatenate([[True], groups[1:] != groups[:-1]]))
    here = ~np.isnan(scores)
    known: np.ndarray = np.add.reduceat(here, first, dtype=int)
    lowest: np.ndarray = np.minimum.reduceat(np.where(here, scores, np.inf), first)
    highest: np.ndarray = np.maximum.reduceat(np.where(here, scores, -np.inf), first)
    with np.errstate(over="ignore", invalid="ignore"):
        differ = highest - lowest > EQUAL * np.maximum(abs(highest), abs(lowest))
    compared = known >= 2
    return np.sum(compared, 0), np.sum(compared & differ, 0)


def judges_at_least(ratings: Float[np.ndarray, "B K"], groups: Integer[np.ndarray, " B"]) -> float:
    """Return how many independent judges they are worth at least, in [1, K]: if all that they share were error.

    K / (1 + (K - 1) rho) with the mean correlation of two judges' scores within groups (Kish; Kohli 2026, arXiv
    2605.29800). What they share is the truth, too, so that they are worth more unless they err together. Which of it is
    error cannot be told from scores alone.

    Examples:
        >>> own, groups = np.random.default_rng(0).normal(size=(400, 3)), np.arange(400) // 8
        >>> [round(judges_at_least(scores, groups), 1) for scores in (own, own[:, [0, 0]])]
        [2.9, 1.0]

    Args:
        ratings: Standardised scores, NaN where one is missing.
        groups: The number of each completion's group, from 0.

    Returns:
        NaN where no two judges can be compared.
    """
    within = ratings - group_means(ratings, groups)[groups]
    both = shared(within)
    told = (both.rows >= TOGETHER) & (both.sd > 0) & (both.sd.T > 0) & ~np.eye(len(both.rows), dtype=bool)
    if not told.any():
        return math.nan
    raters = float(told.any(1).sum())
    return raters / (1.0 + (raters - 1.0) * max(0.0, float(both.correlation[told].mean())))
