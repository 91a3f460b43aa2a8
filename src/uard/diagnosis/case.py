"""A log as the checks see it: what is known of its items, and what the filters make of its rows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from uard import _checks
from uard.method.feedback import ByRater, Feedback
from uard.method.mitigations import Evidence, Mitigation, named
from uard.method.weights import discount
from uard.ratings.aggregate import aggregate, by_item
from uard.ratings.log import RatingLog
from uard.ratings.pairs import Shared, sample_of_raters, sample_of_rows, shared
from uard.ratings.sentinels import others_of

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Integer, Shaped

PRINTED = "uard-operator"
PAIRS = 200_000  # most pairs of rows that are compared
LARGEST = 1e100  # no reward is as large, and the squares of larger numbers overflow
SMALLEST = 1e-100  # smaller numbers are taken for 0: their squares vanish
ROUNDING = 1e-6  # of a unit: logs are often written in single precision
FEW = 30  # with fewer rated rows no statistic means much


class FilterOutcome(NamedTuple):
    """What a filter makes of each row.

    Attributes:
        name: What messages call the filter.
        method: The filter.
        weight: How far each reward is believed, in [0, 1].
        learned: The reward that would be learned from, in reward units.
    """

    name: str
    method: Mitigation
    weight: Float[np.ndarray, " n"]
    learned: Float[np.ndarray, " n"]


class Sample(NamedTuple):
    """Part of a log, small enough that all pairs of its raters can be compared; the whole of a small log.

    Attributes:
        rows: Numbers of its rows among those of the case.
        raters: Numbers of its m raters.
        names: Their names.
        reward: Rewards of its rows.
        ratings: Ratings of its rows, NaN where one is missing.
        others: Mean rating of all other raters of the log; NaN where nobody else rated.
    """

    rows: Integer[np.ndarray, " n"]
    raters: Integer[np.ndarray, " m"]
    names: tuple[str, ...]
    reward: Float[np.ndarray, " n"]
    ratings: Float[np.ndarray, "n m"]
    others: Float[np.ndarray, "n m"]


@dataclass(frozen=True)
class Case:
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
        rated: Whether anybody has rated the row's item.
        together: Whether at least two raters have rated one row of the item, so that they can be compared.
        unit: Standard deviation of the rewards, or of the ratings if the log holds no rewards; 1 if all are equal.
        noise: How far the mean of a row's ratings may be from what raters mean: so many of its median standard errors
            that among all rows hardly one gets there by chance.
        chosen: The filter that is going to be used.
        printed: The filter as printed.
        recommended: The filter that we recommend.
    """

    log: RatingLog
    rows: Integer[np.ndarray, " n"]
    reward: Float[np.ndarray, " n"]
    ratings: Float[np.ndarray, "n K"]
    sigma_m: Float[np.ndarray, " n"] | None
    true: Float[np.ndarray, " n"] | None
    feedback: Feedback
    distinct: Feedback
    rated: Bool[np.ndarray, " n"]
    together: Bool[np.ndarray, " n"]
    unit: float
    noise: float
    chosen: FilterOutcome
    printed: FilterOutcome
    recommended: FilterOutcome

    def place(self, row: int) -> str:
        """Return where a row is, in words."""
        return self.log.place(int(self.rows[row]))

    @cached_property
    def sample(self) -> Sample:
        """What the checks of raters look at."""
        raters = sample_of_raters(self.ratings.shape[1])
        rows = sample_of_rows(len(self.reward), raters.size)
        others = others_of(self.ratings[rows])[:, raters]
        ratings = self.ratings[np.ix_(rows, raters)]
        names = tuple(self.log.raters[int(k)] for k in raters)
        return Sample(rows, raters, names, self.reward[rows], ratings, others)

    @cached_property
    def pairs_with_reward(self) -> Shared:
        """What the raters of the sample, and the reward as one more, have in common."""
        return shared(np.column_stack([self.sample.ratings, self.sample.reward]))

    @property
    def pairs_of_raters(self) -> Shared:
        """What the raters of the sample have in common."""
        return Shared._make(x[:-1, :-1] for x in self.pairs_with_reward)

    def gap(self) -> Float[np.ndarray, " n"]:
        """Return the reward minus the mean rating; 0 where nobody rated."""
        return np.where(self.rated, self.reward - self.feedback.mean, 0.0)

    def far(self) -> Bool[np.ndarray, " n"]:
        """Return where the mean rating is more than a unit from the reward, and not by noise alone."""
        return np.abs(self.gap()) > max(self.unit, self.noise)

    def agreed(self, distance: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Return where raters are nearer to each other than to what is at that distance from their mean."""
        return self.together & (3.0 * self.feedback.sd < np.abs(distance))


def usable(x: Float[np.ndarray, "*any"]) -> Bool[np.ndarray, "*any"]:
    """Return which numbers can be a reward or a rating."""
    return np.abs(x) < LARGEST


def _usable(x: Float[np.ndarray, "*any"], otherwise: float) -> Float[np.ndarray, "*any"]:
    """Return the usable numbers, something else in the place of the others, and 0 for what is too small."""
    return np.where(usable(x), np.where(np.abs(x) < SMALLEST, 0.0, x), otherwise)


def case_of(log: RatingLog, name: str, method: Mitigation) -> Case:
    """Leave out the rows and cells that hold no usable number, and put the rest through the filters.

    Args:
        log: The log.
        name: What to call the filter that is going to be used.
        method: That filter.

    Raises:
        InvalidValueError: no reward is a number.
    """
    if log.reward is None:
        return _without_reward(log, name, method)
    rows = np.flatnonzero(usable(log.reward))
    if not rows.size:
        raise _checks.InvalidValueError(f"{log.source}: column of rewards", "no number", "finite numbers below 1e100")
    reward, ratings = _usable(log.reward[rows], np.nan), _usable(log.ratings[rows], np.nan)
    sigma_m = None if log.sigma_m is None else _usable(log.sigma_m, 0.0)[rows]
    true = None if log.true_reward is None else _usable(log.true_reward, np.nan)[rows]
    item = None if log.item is None else numbered(log.item[rows])
    known, distinct = feedback_of(reward, ratings, item)
    together = np.isfinite(ratings).sum(1) >= 2
    if item is not None:
        together = (np.bincount(item, together) > 0)[item]

    def outcome(name: str, method: Mitigation) -> FilterOutcome:
        return FilterOutcome(name, method, *filtered_rows(method, reward, sigma_m, known, distinct))

    chosen = outcome(name, method)
    deviation = float(reward.std())
    return Case(
        log=log,
        rows=rows,
        reward=reward,
        ratings=ratings,
        sigma_m=sigma_m,
        true=true,
        feedback=known,
        distinct=distinct,
        rated=known.count > 0,
        together=together,
        unit=deviation if deviation > 1e-12 * np.abs(reward).max() else 1.0,
        noise=_noise(known.sd[together], known.raters[together]),
        chosen=chosen,
        printed=outcome(PRINTED, as_filter(PRINTED)),
        recommended=chosen if name == "uard" else outcome("uard", as_filter("uard")),
    )


def _without_reward(log: RatingLog, name: str, method: Mitigation) -> Case:
    """Return the case of a log that holds no rewards: they are NaN, and so is all that filters make of them."""
    unknown = np.full(len(log), np.nan)
    ratings = _usable(log.ratings, np.nan)
    known, distinct = feedback_of(unknown, ratings, None)
    here = np.isfinite(ratings)
    outcomes = [FilterOutcome(n, m, unknown, unknown) for n, m in ((name, method), (PRINTED, as_filter(PRINTED)))]
    deviation = float(ratings[here].std()) if here.any() else 0.0
    return Case(
        log=log,
        rows=np.arange(len(log)),
        reward=unknown,
        ratings=ratings,
        sigma_m=None,
        true=None,
        feedback=known,
        distinct=distinct,
        rated=known.count > 0,
        together=here.sum(1) >= 2,
        unit=deviation or 1.0,
        noise=0.0,
        chosen=outcomes[0],
        printed=outcomes[1],
        recommended=outcomes[0],
    )


def _noise(sd: Float[np.ndarray, " m"], raters: Float[np.ndarray, " m"]) -> float:
    """Return one and a half times what the largest of m normal errors is about; see ``Case.noise``."""
    if not sd.size:
        return 0.0
    error = sd / np.sqrt(np.maximum(raters - 1.0, 1.0))
    return 1.5 * math.sqrt(2.0 * math.log(sd.size)) * float(np.median(error))


def as_filter(mitigation: str | Mitigation) -> Mitigation:
    """Return a filter, by name or itself.

    Raises:
        InvalidValueError: it is no form of the filter.
    """
    allowed = "a form of the filter (uard, uard-operator, ...)"
    method = named(mitigation) if isinstance(mitigation, str) else mitigation
    if not _checks.instance("mitigation", method, Mitigation, allowed).discounts:
        raise _checks.InvalidValueError("mitigation", mitigation, allowed)
    return method


def numbered(item: Shaped[np.ndarray, " n"] | None) -> Integer[np.ndarray, " n"] | None:
    """Return the items as numbers 0..M-1."""
    return None if item is None else np.unique(item, return_inverse=True)[1]


def feedback_of(
    reward: Float[np.ndarray, " n"], ratings: Float[np.ndarray, "n K"], item: Integer[np.ndarray, " n"] | None
) -> tuple[Feedback, Feedback]:
    """Return what is known of every row's item, and of every distinct item.

    Args:
        reward: Of every row.
        ratings: Of every row, NaN where one is missing; K may be 0.
        item: The number of every row's item; None if no two rows have the same.
    """
    here = np.isfinite(ratings)
    if ratings.shape[1] == 0:
        ratings, here = np.zeros((len(reward), 1)), np.zeros((len(reward), 1), bool)
    visits = aggregate(ratings, np.where(np.isnan(reward), 0.0, reward), here)._replace(proxy=reward)
    if item is None:
        return visits, visits
    distinct = by_item(visits, item)
    return distinct.map(lambda x: x[item]), distinct


def filtered_rows(
    method: Mitigation,
    reward: Float[np.ndarray, " n"],
    sigma_m: Float[np.ndarray, " n"] | None,
    known: Feedback,
    distinct: Feedback,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return every row's weight and the reward that would be learned from.

    Args:
        method: A filter.
        reward: Of every row.
        sigma_m: The ensemble's disagreement, 0 if None.
        known: Of every row's item.
        distinct: Of every distinct item.
    """
    method = method.without_prior()
    sigma_m = np.zeros_like(reward) if sigma_m is None else sigma_m
    why = method.explain(Evidence(reward, sigma_m, known), method.fit(distinct, distinct.count > 0))
    # What a rule that acts on scores would make of a reward is not what it learns from.
    learned = discount(reward, why.weight, why.anchor) if method.acts_on == "score" else why.signal.reward
    return np.asarray(why.weight), np.asarray(learned)


def rescaled(case: Case, method: Mitigation, shift: float, factor: float) -> Float[np.ndarray, " n"]:
    """Return what would be learned from if all rewards and ratings were multiplied, then shifted."""

    def of(f: Feedback) -> Feedback:
        mean, lowest, proxy = (factor * x + shift for x in (f.mean, f.lowest, f.proxy))
        each = f.by_rater and ByRater(f.by_rater.count, factor * f.by_rater.mean + shift, factor**2 * f.by_rater.m2)
        return Feedback(f.count, mean, lowest, factor * f.sd, proxy, f.raters, each)

    sigma_m = None if case.sigma_m is None else factor * case.sigma_m
    return filtered_rows(method, factor * case.reward + shift, sigma_m, of(case.feedback), of(case.distinct))[1]


def pairs(
    first: Integer[np.ndarray, " p"], second: Integer[np.ndarray, " q"]
) -> tuple[Integer[np.ndarray, " pairs"], Integer[np.ndarray, " pairs"]]:
    """Return all pairs of two lists of rows, or ``PAIRS`` of them drawn at random."""
    if first.size * second.size <= PAIRS:
        return np.repeat(first, second.size), np.tile(second, first.size)
    random = np.random.default_rng(0)
    return random.choice(first, PAIRS), random.choice(second, PAIRS)


def share_kept(case: Case, outcome: FilterOutcome, where: Bool[np.ndarray, " n"]) -> float:
    """Return which share of the difference between reward and mean rating is still learned, in [0, 1]."""
    if not where.any():
        return 0.0
    mean = case.feedback.mean[where]
    share = (outcome.learned[where] - mean) / (case.reward[where] - mean)
    return float(np.clip(share, 0.0, 1.0).mean())


def mostly(part: Bool[np.ndarray, " n"], whole: Bool[np.ndarray, " n"]) -> bool:
    """Return whether more than half of the whole are in the part."""
    return bool(part.sum() > 0.5 * whole.sum())
