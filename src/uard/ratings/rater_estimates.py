"""How noisy and how biased raters are, from what they said of the same items; ``uard.ratings.raters`` puts it in words.

A rater k says m_i + b_k + e_ik of item i: what the item is worth, a bias, an error of variance v_k. Two raters of
common items tell b_j - b_k (their mean difference) and v_j + v_k (the variance of their difference), whatever the items
are worth; over all pairs these are two systems of least squares [Grubbs 1948]. Answers of one rater about one item tell
the noise alone, and a reward the bias alone.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from uard.method.feedback import ByRater
from uard.method.rater_statistics import (
    RaterStatistics,
    fit,
    leave_one_out_medians,
    masked_median,
    own_variance,
)
from uard.ratings.log import RatingLog, bad_cell
from uard.ratings.pairs import Shared, shared, units_of

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Integer, Shaped

CELLS = 100_000  # of items and raters that estimates are taken over, at least 1000 items
TOGETHER = 3  # items that two raters must have in common to be compared
REPEATS = 5  # answers beyond the first about an item, from which on they tell a rater's noise
LARGEST = 1e100  # no rating is as large, and the squares of larger numbers overflow


@dataclass(frozen=True, eq=False)
class Answers:
    """A log by item: one row per distinct thing that was rated.

    Attributes:
        count: Answers of each rater.
        mean: Their mean; NaN where there are none.
        m2: Sums of squared deviations from it.
        reward: Mean observed reward, NaN where unknown; None if the log holds none.
        truth: What the items are really worth, likewise.
        part: Name of the part of the log that each belongs to, or None.
    """

    count: Float[np.ndarray, "n K"]
    mean: Float[np.ndarray, "n K"]
    m2: Float[np.ndarray, "n K"]
    reward: Float[np.ndarray, " n"] | None
    truth: Float[np.ndarray, " n"] | None
    part: Shaped[np.ndarray, " n"] | None

    def at(self, rows: Integer[np.ndarray, " m"] | Bool[np.ndarray, " n"]) -> Answers:
        """Return some of the items."""
        columns: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(self, **{name: x[rows] for name, x in columns.items() if x is not None})

    def of(self, raters: Integer[np.ndarray, " k"]) -> Answers:
        """Return the answers of some of the raters."""
        return replace(self, count=self.count[:, raters], mean=self.mean[:, raters], m2=self.m2[:, raters])


def answers_of(log: RatingLog) -> Answers:
    """Return what every rater has said of every distinct item, repeated answers and visits together.

    Examples:
        >>> log = RatingLog(np.array([0.0, 2.0]), np.array([[1.0], [3.0]]), item=np.array(["a", "a"]))
        >>> answers = answers_of(log)
        >>> answers.count.tolist(), answers.mean.tolist(), answers.m2.tolist(), answers.reward.tolist()
        ([[2.0]], [[2.0]], [[2.0]], [1.0])

    Raises:
        InvalidValueError: a rating or a reward is infinite or beyond 1e100 (the message names row and column).
    """
    for column, name in zip(log.ratings.T, log.raters, strict=True):
        _moderate(log.source, column, name)
    n, raters = log.ratings.shape
    item = _numbered(np.arange(n) if log.item is None else log.item)
    items = int(item.max()) + 1
    row, rater = np.nonzero(~np.isnan(log.ratings))
    rating = log.ratings[row, rater]
    if log.repeats is not None:
        before = log.repeats
        _moderate(log.source, before.rating, "earlier answers")
        row, rater = np.concatenate([row, before.row]), np.concatenate([rater, before.rater])
        rating = np.concatenate([rating, before.rating])
    cell = item[row] * raters + rater
    count = np.bincount(cell, minlength=items * raters).astype(float)
    total = np.bincount(cell, rating, items * raters).astype(float)  # of nothing it counts in whole numbers
    mean = np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)
    m2 = np.bincount(cell, (rating - mean[cell]) ** 2, items * raters).astype(float)

    def of_items(column: Float[np.ndarray, " n"] | None, name: str) -> Float[np.ndarray, " items"] | None:
        if column is None:
            return None
        _moderate(log.source, column, name)
        known = ~np.isnan(column)
        number = np.bincount(item[known], minlength=items)
        total = np.bincount(item[known], column[known], items).astype(float)
        return np.divide(total, number, out=np.full(items, np.nan), where=number > 0)

    first = np.zeros(items, int)
    first[item[::-1]] = np.arange(n)[::-1]
    shape = (items, raters)
    return Answers(
        count.reshape(shape),
        mean.reshape(shape),
        m2.reshape(shape),
        of_items(log.reward, "reward"),
        of_items(log.true_reward, "true_reward"),
        None if log.by is None else log.by[first],
    )


def _numbered(item: Any) -> Integer[np.ndarray, " n"]:
    return np.unique(item, return_inverse=True)[1]


def _moderate(source: str, column: Float[np.ndarray, " n"], name: str) -> None:
    bad = np.abs(column) >= LARGEST  # which NaN is not
    if bad.any():
        row = int(np.argmax(bad))
        raise bad_cell(source, row, name, float(column[row]), "a number below 1e100, or nothing where it is missing")


def sample_of_items(answers: Answers) -> Answers:
    """Return items at even distances, all of them in a small log; those that nobody has rated are left out.

    Examples:
        >>> answers = answers_of(RatingLog(None, np.array([[1.0], [np.nan], [2.0]])))
        >>> sample_of_items(answers).mean.tolist()
        [[1.0], [2.0]]
    """
    rated = np.flatnonzero(answers.count.any(1))
    most = max(1000, CELLS // max(answers.count.shape[1], 1))
    if rated.size > most:
        rated = rated[np.linspace(0, rated.size - 1, most, dtype=int)]
    return answers.at(rated)


@dataclass(frozen=True)
class PanelEstimates:
    """Estimates of a panel from a log by item.

    Examples:
        >>> said = np.arange(20.0)[:, None] + [0.0, 0.0, 5.0]
        >>> panel = PanelEstimates(answers_of(RatingLog(None, said)))
        >>> panel.bias(np.arange(20)).round(6).tolist(), panel.variance(np.arange(20)).round(6).tolist()
        ([-2.5, -2.5, 5.0], [0.0, 0.0, 0.0])

    Attributes:
        answers: A sample of the items; every rater has answered.
    """

    answers: Answers

    @cached_property
    def here(self) -> Bool[np.ndarray, "n K"]:
        """Who has rated what."""
        return self.answers.count > 0

    @cached_property
    def known(self) -> Bool[np.ndarray, " n"]:
        """Of which items the reward is known."""
        reward = self.answers.reward
        return np.zeros(len(self.here), bool) if reward is None else np.isfinite(reward)

    @property
    def rewarded(self) -> bool:
        """Whether bias is measured against the reward: where one is known for any item."""
        return bool(self.known.any())

    @cached_property
    def with_reward(self) -> Shared:
        """What the raters, and the reward as one more if there is one, have in common."""
        a = self.answers
        return shared(a.mean if not self.rewarded or a.reward is None else np.column_stack([a.mean, a.reward]))

    @cached_property
    def units(self) -> Integer[np.ndarray, " K_or_more"] | None:
        """The number of each one's unit, the reward's last; see ``uard.ratings.pairs.units_of``."""
        return units_of(self.with_reward)

    @cached_property
    def main_unit(self) -> int:
        """The reward's unit, or that of the most raters (of several such, the narrowest); -1 where all are in one."""
        if self.units is None:
            return -1
        if self.rewarded and self.units[-1] >= 0:
            return int(self.units[-1])
        number, spread = np.bincount(self.units[self.units >= 0]), self.with_reward.sd.diagonal()
        return min(range(len(number)), key=lambda u: (-number[u], spread[self.units == u].min()))

    @cached_property
    def comparable(self) -> Bool[np.ndarray, "K K"]:
        """Which raters are in one unit; one whose unit is not known counts as in the main one."""
        raters = self.here.shape[1]
        same = np.ones((raters, raters), bool)
        if self.units is not None:
            unit = np.where(self.units < 0, self.main_unit, self.units)[:raters]
            same = unit[:, None] == unit
        return same & ~np.eye(raters, dtype=bool)

    @cached_property
    def statistics(self) -> RaterStatistics:
        """The pooled rule's own; without rewards each item's median, without biases, takes the reward's place."""
        a, rated = self.answers, self.known
        reward = np.where(rated, 0.0 if a.reward is None else a.reward, 0.0)
        if not self.rewarded:
            reward, rated = self.centre, self.here.any(1)
        return fit(reward, ByRater(a.count, np.where(self.here, a.mean, 0.0), a.m2), rated)

    @cached_property
    def centre(self) -> Float[np.ndarray, " n"]:
        """Median of what raters say of each item, without what they say beyond each other."""
        unbiased = self.answers.mean - _differences(self.answers.mean, self.comparable)[0]
        return masked_median(unbiased, self.here, axis=1)

    def bias(self, rows: Integer[np.ndarray, " m"]) -> Float[np.ndarray, " K"]:
        """Return what each rater says beyond the reward, or beyond the other raters where no reward is known.

        Beyond the reward: the mean of the gaps that lie within three spreads of their median; what lies beyond may be
        the reward's lies. Beyond the others: above the median of the other raters' biases. NaN where nothing is in
        common.
        """
        a = self.answers.at(rows)
        if not self.rewarded or a.reward is None:
            return _beyond_others(*_differences(a.mean, self.comparable))
        here = self.here[rows] & self.known[rows][:, None]
        gap = np.where(here, a.mean - np.where(self.known[rows], a.reward, 0.0)[:, None], 0.0)
        return _main_mode(gap, here)

    @cached_property
    def odd(self) -> Float[np.ndarray, " K"]:
        """How far each rater's bias is from the middle one of all, of which it may be one itself.

        Of three raters one who is odd moves the median of the others for the other two; this one it does not move.
        """
        bias, others = _differences(self.answers.mean, self.comparable)
        return np.abs(
            bias - masked_median(np.broadcast_to(bias, others.shape), others | np.eye(len(bias), dtype=bool), 1)
        )

    def repeated_variance(self, rows: Integer[np.ndarray, " m"]) -> Float[np.ndarray, " K"]:
        """Return the variance of answers of one rater about one item; NaN without repeated answers."""
        a = self.answers.at(rows)
        freedom = np.maximum(a.count - 1.0, 0.0).sum(0)
        return np.divide(a.m2.sum(0), freedom, out=np.full_like(freedom, np.nan), where=freedom > 0)

    def variance(self, rows: Integer[np.ndarray, " m"]) -> Float[np.ndarray, " K"]:
        """Return the variance of each rater's mean about what the item is worth and the rater's bias.

        From the variances of pairs' differences; who can be compared with one other rater only has half of theirs, and
        who can be compared with nobody has the robust variance about the reward (``own_variance``). NaN where nothing
        is in common, or the reward is in another unit. It can come out below 0: by chance where the variance is small,
        or because the others' errors are not independent, as beside one who says the contrary.
        """
        a = self.answers.at(rows)
        both = shared(a.mean)
        weight = np.where(self.comparable & (both.rows >= TOGETHER), both.rows, 0.0)
        spread = both.sd**2 + both.sd.T**2 - 2.0 * both.correlation * both.sd * both.sd.T
        spread *= both.rows / np.maximum(both.rows - 1.0, 1.0)
        total = weight.sum(1)
        found = _least_squares(np.diag(total) + weight, (weight * spread).sum(1))
        rounding = 1e-9 * np.nanmax(both.sd, initial=0.0) ** 2  # of squares that cancel
        found = np.where(total > 0, np.where(np.abs(found) <= rounding, 0.0, found), np.nan)
        alone = np.flatnonzero(np.isnan(found)) if self.rewarded else ()
        known, reward = self.known[rows], a.reward
        for k in alone:
            mine = known & (a.count[:, k] > 0)
            same_unit = self.units is None or self.units[k] in (-1, self.main_unit)
            if reward is not None and same_unit and mine.sum() >= TOGETHER:
                gap = a.mean[mine, k] - reward[mine]
                one = np.ones((len(gap), 1))
                said = a.mean[mine, k] - np.median(gap)
                found[k] = own_variance(one, said[:, None], reward[mine], np.zeros(1), 0.0)[0]
        return found

    @cached_property
    def compared(self) -> Bool[np.ndarray, " K"]:
        """Who has enough items in common with another rater for ``variance``."""
        several = self.comparable & (shared(self.answers.mean).rows >= TOGETHER)
        return np.logical_or.reduce(several, axis=1)

    @cached_property
    def _standard(self) -> tuple[Float[np.ndarray, "n K"], Float[np.ndarray, "n K"]]:
        """Every rater's ratings and what the others say, each in standard deviations; see ``with_others``."""
        own = _standardised(self.answers.mean)
        held = np.where(self.here, own, 0.0)
        if self.rewarded and self.answers.reward is not None:
            reward = _standardised(self.answers.reward[:, None])[:, 0]
            others = leave_one_out_medians(held, self.here, np.where(self.known, reward, 0.0))
            return own, np.where(self.here & self.known[:, None], others, np.nan)
        beside = self.here.sum(1)[:, None] - self.here
        return own, np.where(beside > 0, (held.sum(1)[:, None] - held) / np.maximum(beside, 1), np.nan)

    def with_others(self, rows: Integer[np.ndarray, " m"]) -> Float[np.ndarray, " K"]:
        """Return the correlation of each rater with the others; NaN below three items, or where one is constant.

        The others are the median of reward and other raters, or the other raters' mean where no reward is known, each
        in standard deviations of their own.
        """
        own, others = (x[rows] for x in self._standard)
        here = np.isfinite(own) & np.isfinite(others)
        number = np.maximum(here.sum(0), 1)
        x, y = (np.where(here, z, 0.0) for z in (own, others))
        x, y = (np.where(here, z - z.sum(0) / number, 0.0) for z in (x, y))
        spread = np.sqrt((x * x).sum(0) * (y * y).sum(0))
        defined = (here.sum(0) >= TOGETHER) & (spread > 1e-12 * number)
        return np.where(defined, (x * y).sum(0) / np.where(defined, spread, 1.0), np.nan)


def _standardised(values: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
    """Return values in standard deviations of their columns; 0 in a constant column, NaN where they are missing."""
    here = np.isfinite(values)
    held = np.where(here, values, 0.0)
    number = np.maximum(here.sum(0), 1)
    centred = np.where(here, held - held.sum(0) / number, 0.0)
    sd = np.sqrt((centred * centred).sum(0) / number)
    some = sd > 1e-12 * np.abs(held).max(0, initial=0.0)
    scaled = np.where(some, centred / np.where(some, sd, 1.0), 0.0)
    return np.where(here, scaled, np.nan)


def _main_mode(gap: Float[np.ndarray, "n K"], here: Bool[np.ndarray, "n K"]) -> Float[np.ndarray, " K"]:
    """Return the mean of each rater's gaps within three spreads of their centre; NaN where there are none.

    The spread is 1.48 median absolute deviations, measured again without what lies beyond; where more than half of the
    gaps are equal it is 0, and all count.
    """
    centre, near, number = masked_median(gap, here, axis=0), here, here.sum(0)
    for _ in range(5):
        mad = 1.4826 * masked_median(np.abs(gap - centre), near, axis=0)
        near = here & (np.abs(gap - centre) <= 3.0 * np.where(mad > 0, mad, np.inf))
        number = near.sum(0)
        centre = np.where(near, gap, 0.0).sum(0) / np.maximum(number, 1)
    return np.where(number > 0, centre, np.nan)


def _differences(
    said: Float[np.ndarray, "n K"], comparable: Bool[np.ndarray, "K K"]
) -> tuple[Float[np.ndarray, " K"], Bool[np.ndarray, "K K"]]:
    """Return each rater's bias, their sum 0 among raters who can be compared, and who can be compared with whom."""
    both = shared(said)
    weight = np.where(comparable & (both.rows >= TOGETHER), both.rows, 0.0)
    difference = np.where(weight > 0, both.mean - both.mean.T, 0.0)
    bias = _least_squares(np.diag(weight.sum(1)) - weight, (weight * difference).sum(1))
    reach = weight > 0
    while ((wider := reach | ((reach.astype(np.float32) @ reach.astype(np.float32)) > 0)) != reach).any():
        reach = wider
    return bias, reach & ~np.eye(len(reach), dtype=bool)


def _beyond_others(bias: Float[np.ndarray, " K"], others: Bool[np.ndarray, "K K"]) -> Float[np.ndarray, " K"]:
    middle = masked_median(np.broadcast_to(bias, others.shape), others, axis=1)
    return np.where(others.any(1), bias - middle, np.nan)


def _least_squares(matrix: Float[np.ndarray, "K K"], right: Float[np.ndarray, " K"]) -> Float[np.ndarray, " K"]:
    """Return the shortest of the solutions."""
    scale = max(float(np.abs(right).max(initial=0.0)), 1e-300)
    solution = cast("np.ndarray", np.linalg.lstsq(matrix, right / scale, rcond=1e-10)[0])  # untyped
    return np.multiply(solution, scale)
