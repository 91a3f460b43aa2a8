"""A log as the checks see it: what is known of its items, and what the filters make of its rows."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from uard import _checks
from uard.method.feedback import Feedback
from uard.method.mitigations import Evidence, Mitigation, named
from uard.method.weights import discount
from uard.ratings.aggregate import aggregate, by_item
from uard.ratings.log import RatingLog

PRINTED = "uard-operator"
PAIRS = 200_000  # of rows that are compared
LARGEST = 1e100  # what is larger is no reward, and its square no number
ROUNDING = 1e-6  # of a unit: logs are often written in single precision
FEW = 30  # rated rows below which no statistic means much


class FilterOutcome(NamedTuple):
    """What a filter makes of each row."""

    name: str
    method: Mitigation
    weight: np.ndarray
    believed: np.ndarray


class Case(NamedTuple):
    """A log of which only usable numbers are left, and what the filters make of it.

    Attributes:
        log: The whole log.
        rows: Numbers of the rows that are left.
        reward: Their rewards.
        ratings: Their ratings, NaN where one is missing.
        sigma_m: The ensemble's disagreement, or None.
        true: What they were really worth, NaN where unknown, or None.
        feedback: What is known of each row's item.
        distinct: What is known of every distinct item.
        rated: Whether that is anything.
        together: Whether two or more raters were ever asked of one row of it at the same time.
        unit: Standard deviation of the rewards.
        noise: How far the mean of a row's ratings may be from what raters mean: so many of its usual standard errors
            that of all rows hardly one gets there by chance.
        mine: The filter that is going to be used.
        printed: The filter as printed.
        advised: The filter that we recommend.
    """

    log: RatingLog
    rows: np.ndarray
    reward: np.ndarray
    ratings: np.ndarray
    sigma_m: np.ndarray | None
    true: np.ndarray | None
    feedback: Feedback
    distinct: Feedback
    rated: np.ndarray
    together: np.ndarray
    unit: float
    noise: float
    mine: FilterOutcome
    printed: FilterOutcome
    advised: FilterOutcome

    def place(self, row: int) -> str:
        """Return where a row is, in words."""
        return self.log.place(int(self.rows[row]))

    def gap(self) -> np.ndarray:
        """Return the reward minus the mean rating; 0 where nobody rated."""
        return np.where(self.rated, self.reward - self.feedback.mean, 0.0)

    def far(self) -> np.ndarray:
        """Return where the mean rating is more than a unit from the reward, and that is no noise."""
        return np.abs(self.gap()) > max(self.unit, self.noise)

    def agreed(self, distance: np.ndarray) -> np.ndarray:
        """Return where raters are nearer to each other than to what is at that distance from their mean."""
        return self.together & (3.0 * self.feedback.sd < np.abs(distance))


def usable(x: np.ndarray) -> np.ndarray:
    """Return which numbers can be a reward or a rating (bool)."""
    return np.abs(x) < LARGEST


def case_of(log: RatingLog, name: str, method: Mitigation) -> Case:
    """Leave out what no number can be taken from, and put the rest through the filters.

    Raises:
        InvalidValueError: no reward is a number.
    """
    rows = np.flatnonzero(usable(log.reward))
    if not rows.size:
        raise _checks.InvalidValueError(f"{log.source}: column of rewards", "no number", "finite numbers")
    reward, ratings = log.reward[rows], np.where(usable(log.ratings[rows]), log.ratings[rows], np.nan)
    sigma_m = None if log.sigma_m is None else np.where(usable(log.sigma_m), log.sigma_m, 0.0)[rows]
    true = None if log.true_reward is None else np.where(usable(log.true_reward), log.true_reward, np.nan)[rows]
    item = None if log.item is None else numbered(log.item[rows])
    known, distinct = feedback_of(reward, ratings, item)
    together = np.isfinite(ratings).sum(1) >= 2
    if item is not None:
        together = (np.bincount(item, together) > 0)[item]
    error = known.sd[together] / np.sqrt(np.maximum(known.raters[together] - 1.0, 1.0))
    deviation = float(reward.std())

    def outcome(name: str, method: Mitigation) -> FilterOutcome:
        return FilterOutcome(name, method, *filtered_rows(method, reward, sigma_m, known, distinct))

    return Case(
        log,
        rows,
        reward,
        ratings,
        sigma_m,
        true,
        known,
        distinct,
        known.count > 0,
        together,
        deviation if deviation > 1e-12 * np.abs(reward).max() else 1.0,
        1.5 * math.sqrt(2.0 * math.log(error.size)) * float(np.median(error)) if error.size else 0.0,
        outcome(name, method),
        outcome(PRINTED, as_filter(PRINTED)),
        outcome("uard", as_filter("uard")),
    )


def as_filter(mitigation: str | Mitigation) -> Mitigation:
    """Return a filter, by name or itself.

    Raises:
        InvalidValueError: it is no form of the filter.
    """
    method = named(mitigation) if isinstance(mitigation, str) else mitigation
    if not isinstance(method, Mitigation) or not method.discounts:
        raise _checks.InvalidValueError("mitigation", mitigation, "a form of the filter (uard, uard-operator, ...)")
    return method


def numbered(item: np.ndarray | None) -> np.ndarray | None:
    """Return the items as numbers 0..M-1."""
    return None if item is None else np.unique(item, return_inverse=True)[1]


def feedback_of(reward: np.ndarray, ratings: np.ndarray, item: np.ndarray | None) -> tuple[Feedback, Feedback]:
    """Return what is known of every row's item, and of every distinct item."""
    here = np.isfinite(ratings)
    if ratings.shape[1] == 0:
        ratings, here = np.zeros((len(reward), 1)), np.zeros((len(reward), 1), bool)
    visits = aggregate(ratings, reward, here)
    if item is None:
        return visits, visits
    distinct = by_item(visits, item)
    return distinct.map(lambda x: x[item]), distinct


def filtered_rows(
    method: Mitigation, reward: np.ndarray, sigma_m: np.ndarray | None, known: Feedback, distinct: Feedback
) -> tuple[np.ndarray, np.ndarray]:
    """Return every row's weight and the reward that would be learned from."""
    method = method.without_prior()
    sigma_m = np.zeros_like(reward) if sigma_m is None else sigma_m
    why = method.explain(Evidence(reward, sigma_m, known), method.fit(distinct, distinct.count > 0))
    return np.asarray(why.weight), np.asarray(discount(reward, why.weight, why.anchor))


def rescaled(case: Case, method: Mitigation, shift: float, factor: float) -> np.ndarray:
    """Return what would be learned from if all rewards and ratings were multiplied, then shifted."""

    def of(f: Feedback) -> Feedback:
        mean, lowest, proxy = (factor * x + shift for x in (f.mean, f.lowest, f.proxy))
        return Feedback(f.count, mean, lowest, factor * f.sd, proxy, f.raters)

    sigma_m = None if case.sigma_m is None else factor * case.sigma_m
    return filtered_rows(method, factor * case.reward + shift, sigma_m, of(case.feedback), of(case.distinct))[1]


def pairs(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all pairs of two lists of rows, or as many drawn at random as can be looked at."""
    if first.size * second.size <= PAIRS:
        return np.repeat(first, second.size), np.tile(second, first.size)
    random = np.random.default_rng(0)
    return random.choice(first, PAIRS), random.choice(second, PAIRS)


def share_kept(case: Case, outcome: FilterOutcome, where: np.ndarray) -> float:
    """Return how much of the difference between reward and mean rating is still believed; 1 is all."""
    if not where.any():
        return 0.0
    mean = case.feedback.mean[where]
    share = (outcome.believed[where] - mean) / (case.reward[where] - mean)
    return float(np.clip(share, 0.0, 1.0).mean())


def mostly(part: np.ndarray, whole: np.ndarray) -> bool:
    """Whether a part is more than half of the whole."""
    return bool(part.sum() > 0.5 * whole.sum())
