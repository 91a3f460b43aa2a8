"""Does a pooled order of items agree with the raters' own, also with a rater who was left out of the pool?

A rule is asked for a value of every item, a rater for an order: the rater's ratings, or ranks that were given apart
from them. Of every two items that a rater tells apart, either the rule puts the same one first or it does not; a tie of
the rule counts one half. The share s of pairs that are ordered alike is 1/2 by chance, and 2 s - 1 is Kendall's tau on
these pairs. A rater's own answers are in the pool, so the honest number is that of the rule without this rater: it says
how well the others foresee an order that they do not know.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from uard import _checks
from uard._support.columns import WIDTH, fill
from uard._support.columns import text as columns_text
from uard.method import pooled
from uard.method.feedback import ByRater
from uard.method.mitigations.pooled import PooledDiscounting
from uard.method.rater_statistics import masked_median
from uard.ratings.jackknife import Estimate, interval, jackknife
from uard.ratings.log import RatingLog
from uard.ratings.rater_estimates import Answers, PanelEstimates, answers_of

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Integer, Shaped

PAIRS = 50_000  # of items that are compared; of more, so many are drawn
COMPARISONS = 2_000_000  # of a pair by a rater, at most
RULES = ("cautious", "pooled", "mean", "median", "reward")


@dataclass(frozen=True)
class OrderAgreement:
    """How a rule's order of items agrees with the raters'.

    Examples:
        >>> OrderAgreement("mean", "ann", 10, Estimate(0.9, 0.8, 1.0), 0.95).tau
        Estimate(value=0.8, low=0.6000000000000001, high=1.0)

    Attributes:
        rule: ``cautious``: the pooled rule's anchor b, which it learns where it does not believe the reward.
            ``pooled``: the pooled mean of what raters say without their biases. ``mean`` and ``median`` of the plain
            ratings. ``reward``: the observed one.
        rater: Whose order it is compared with; ``all`` for all raters' pairs together.
        pairs: How many pairs of items the rater tells apart (and are compared).
        alike: Share of pairs in the same order if this rater is left out of the pool, in [0, 1]; None where nobody else
            has rated.
        with_own: The same share if this rater is in it.
    """

    rule: str
    rater: str
    pairs: int
    alike: Estimate | None
    with_own: float | None

    @property
    def tau(self) -> Estimate | None:
        """Kendall's tau of the rule without the rater, in [-1, 1]."""
        if self.alike is None:
            return None
        value, low, high = (None if x is None else 2.0 * x - 1.0 for x in self.alike)
        return Estimate(value or 0.0, low, high)


@dataclass(frozen=True)
class Orders:
    """How several rules' orders agree with the raters'; ``str(orders)`` is a table.

    Examples:
        >>> said = np.arange(12.0)[:, None] + [0.0, 1.0, 0.5]
        >>> found = orders(RatingLog(None, said))
        >>> {row.rule: row.alike.value for row in found.rows if row.rater == "all"}
        {'cautious': 1.0, 'pooled': 1.0, 'mean': 1.0, 'median': 1.0}

    Attributes:
        own: What the raters' orders are: ``ratings``, or the name of what was given instead.
        within: The name of what divides the items into groups, of which only items of one are compared; or None.
        groups: How many groups have a pair.
        rows: First all raters together, then each; every rule. Empty where no rater tells two items apart.
    """

    own: str
    within: str | None
    groups: int
    rows: tuple[OrderAgreement, ...]

    def as_data(self) -> dict[str, Any]:
        """Return everything as plain data that JSON can hold."""

        def plain(row: OrderAgreement) -> dict[str, Any]:
            told = {name: getattr(row, name) for name in ("alike", "tau")}
            return asdict(row) | {name: None if x is None else x._asdict() for name, x in told.items()}

        return asdict(self) | {"rows": [plain(row) for row in self.rows]}

    def __str__(self) -> str:
        """Return a table, 80 columns wide."""
        return self.text()

    def text(self, width: int = WIDTH) -> str:
        """Return a table.

        Args:
            width: Of the longest line, unless a word is longer.
        """
        pairs = "pairs of items" if self.within is None else f"pairs of one {self.within}"
        title = f"share of {pairs} that a rule puts in the order of a rater's {self.own} (1/2 by chance)"
        if not self.rows:
            return fill(f"{title}: no pair that a rater tells apart", width, rest="  ")
        columns = {
            "rule": [r.rule for r in self.rows],
            "rater": [r.rater for r in self.rows],
            "pairs": [str(r.pairs) for r in self.rows],
            "without the rater [95 %]": ["?" if r.alike is None else f"{r.alike:.3f}" for r in self.rows],
            "tau": ["?" if r.tau is None else f"{r.tau.value:z.2f}" for r in self.rows],
            "with the rater": ["?" if r.with_own is None else f"{r.with_own:.3f}" for r in self.rows],
        }
        table = columns_text([*columns], zip(*columns.values(), strict=True), width, labels=2)
        return f"{fill(title, width, rest='  ')}\n{table}"


def orders(
    log: RatingLog,
    own: RatingLog | None = None,
    group: Shaped[np.ndarray, " n"] | None = None,
    within: str | None = None,
    name: str = "ranks",
) -> Orders:
    """Return how the pooled order, and those of simple rules, agree with the raters' own.

    Neither ``cautious`` nor ``pooled`` looks at the reward of the item itself: the first is the pooled mean less
    ``contest`` times what raters differ by and ``caution`` standard errors. Where the raters are measured and no reward
    is known, the median of an item's ratings, each without the rater's bias, stands in for it. Intervals are jackknives
    over groups, or over items without groups.

    Examples:
        >>> said = np.array([[1.0, 2.0, 1.0], [2.0, 3.0, 4.0], [3.0, 1.0, 5.0]])
        >>> found = orders(RatingLog(None, said))
        >>> [(r.rater, r.pairs, round(r.alike.value, 2)) for r in found.rows if r.rule == "mean"]
        [('all', 9, 0.56), ('rating_1', 3, 0.67), ('rating_2', 3, 0.33), ('rating_3', 3, 0.67)]

    Args:
        log: Ratings, and rewards if there are any.
        own: The raters' orders, by the same items in the same rows: of two, the one with the higher number comes first.
            The ratings themselves if left out. Raters are matched by name.
        group: What each row of the log belongs to; only items of one group are compared.
        within: What groups are called.
        name: What the orders in ``own`` are called.

    Raises:
        InvalidValueError: the rows of ``own`` are other items, or an item belongs to two groups.
    """
    answers = answers_of(log)
    theirs = answers.mean if own is None else _matched(log, own)
    groups = None if group is None else _of_items(log, group)
    first, second = _pairs(len(theirs), groups, min(PAIRS, COMPARISONS // max(len(log.raters), 1)))
    used, place = np.unique(np.concatenate([first, second]), return_inverse=True)
    first, second = np.split(place, 2)
    answers, theirs = answers.at(used), theirs[used]
    unit = np.arange(used.size) if groups is None else groups[used]
    difference = np.nan_to_num(np.sign(theirs[first] - theirs[second]))  # 0 where one is missing
    told = difference != 0
    if not told.any():
        return Orders("ratings" if own is None else name, within, 0, ())
    names = ("all", *log.raters)
    rows: dict[str, list[OrderAgreement]] = {n: [] for n in names}
    for rule, values, whole in _values(answers):
        alike = _alike(values, difference, first, second)
        value, error = jackknife(alike.shares, unit)
        whole = _alike(whole, difference, first, second)
        with_own, compared = whole.shares(np.arange(len(unit))), np.where(np.isfinite(value), alike.pairs, whole.pairs)
        for n, v, e, w, pairs in zip(names, value, error, with_own, compared, strict=True):
            share = _within(interval(float(v), float(e), np.unique(unit).size))
            rows[n].append(OrderAgreement(rule, n, int(pairs), share, float(w) if np.isfinite(w) else None))
    some = np.unique(unit[first[told.any(1)]]).size
    shown = tuple(row for n in names for row in rows[n])
    return Orders("ratings" if own is None else name, within, int(some), shown)


def _matched(log: RatingLog, own: RatingLog) -> Float[np.ndarray, "n K"]:
    """Return the raters' own orders in the places of the log's items and raters."""
    same = len(own) == len(log) and (
        log.item is None or (own.item is not None and bool(np.array_equal(log.item, own.item)))
    )
    if not same:
        raise _checks.InvalidValueError("own", f"{len(own)} rows", f"the {len(log)} rows of the log, of the same items")
    by_name = dict(zip(own.raters, answers_of(own).mean.T, strict=True))
    items = len(next(iter(by_name.values()), ()))
    return np.column_stack([by_name.get(name, np.full(items, np.nan)) for name in log.raters])


def _of_items(log: RatingLog, group: Shaped[np.ndarray, " n"]) -> Integer[np.ndarray, " items"]:
    """Return the number of every item's group."""
    number = np.unique(group, return_inverse=True)[1]
    if log.item is None:
        return number
    item = np.unique(log.item, return_inverse=True)[1]
    found = np.zeros(int(item.max()) + 1, int)
    found[item] = number
    if (found[item] != number).any():
        row = int(np.argmax(found[item] != number))
        raise _checks.InvalidValueError("group", str(group[row]), f"one group for {log.place(row)}")
    return found


def _pairs(
    items: int, group: Integer[np.ndarray, " n"] | None, most: int
) -> tuple[Integer[np.ndarray, " p"], Integer[np.ndarray, " p"]]:
    """Return all pairs of items of one group, or ``most`` of them at random."""
    if group is None:
        group = np.zeros(items, int)
    order = np.argsort(group, kind="stable")
    size = np.bincount(group)
    start = np.cumsum(size) - size
    before = np.arange(items) - start[group[order]]  # items of the group that come earlier: so many pairs end here
    total = int(before.sum())
    if total > most:
        ends = np.random.default_rng(0).choice(items, most, p=before / total)
        begins = np.random.default_rng(1).integers(0, before[ends])
    else:
        ends = np.repeat(np.arange(items), before)
        begins = np.arange(total) - np.repeat(np.cumsum(before) - before, before)
    return order[start[group[order[ends]]] + begins], order[ends]


def _values(answers: Answers) -> list[tuple[str, Float[np.ndarray, "n K"], Float[np.ndarray, "n K"]]]:
    """Return for every rule the value of each item without each rater, and with all; NaN where nobody has rated."""
    panel, rule = PanelEstimates(answers), PooledDiscounting()
    here, s = panel.here, panel.statistics
    held = np.where(here, answers.mean, 0.0)
    reward = panel.centre
    if panel.rewarded and answers.reward is not None:
        reward = np.where(panel.known, answers.reward, s.typical)
    variance = pooled.errors(reward, ByRater(answers.count, held, answers.m2), s, rule.slack if panel.rewarded else 0.0)

    def of(heard: Bool[np.ndarray, "n K"]) -> list[Float[np.ndarray, " n"]]:
        p = pooled.pool(reward, held - s.bias, heard & (s.heard > 0), variance, s.span)
        number = heard.sum(1)
        mean = np.where(heard, held, 0.0).sum(1) / np.maximum(number, 1)
        cautious = p.centre - rule.contest * p.tau - rule.caution * p.error
        found = [cautious, p.centre, mean, masked_median(held, heard, axis=1)]
        counts = [p.heard, p.heard, number, number]
        return [np.where(n > 0, x, np.nan) for x, n in zip(found, counts, strict=True)]

    raters = here.shape[1]
    others = ~np.eye(raters, dtype=bool)
    without = [of(np.logical_and(here, others[k])) for k in range(raters)]
    whole = of(here)
    wide = [np.repeat(x[:, None], raters, axis=1) for x in whole]
    found = [(RULES[i], np.column_stack([x[i] for x in without]), wide[i]) for i in range(4) if raters]
    if answers.reward is not None and panel.rewarded:
        of_reward = np.repeat(answers.reward[:, None], raters, axis=1)
        found.append(("reward", of_reward, of_reward))
    return found


@dataclass(frozen=True)
class _Alike:
    """Which pairs (first, second) of so many items each rater tells apart, and a rule orders the same (a tie: 1/2)."""

    same: Float[np.ndarray, "p K"]
    told: Float[np.ndarray, "p K"]
    first: Integer[np.ndarray, " p"]
    second: Integer[np.ndarray, " p"]
    items: int

    @property
    def pairs(self) -> Float[np.ndarray, " many"]:
        """How many pairs are compared, of all raters and of each."""
        return np.append(self.told.sum(), self.told.sum(0))

    def shares(self, rows: Integer[np.ndarray, " m"]) -> Float[np.ndarray, " many"]:
        """Return the shares among pairs of these items; NaN where there are none."""
        kept = np.zeros(self.items, bool)
        kept[rows] = True
        both = (kept[self.first] & kept[self.second]).astype(float)
        alike, pairs = (np.append(x.sum(), x) for x in (both @ self.same, both @ self.told))
        return np.divide(alike, pairs, out=np.full_like(alike, np.nan), where=pairs > 0)


def _alike(
    values: Float[np.ndarray, "n K"],
    difference: Float[np.ndarray, "p K"],
    first: Integer[np.ndarray, " p"],
    second: Integer[np.ndarray, " p"],
) -> _Alike:
    """Compare the values of a rule with the signs of the raters' own differences, 0 where they tell nothing apart."""
    gap = values[first] - values[second]
    near = np.abs(gap) <= 1e-12 * np.maximum(np.abs(values[first]), np.abs(values[second]))
    told = (difference != 0) & np.isfinite(gap)
    same = np.where(told, np.where(near, 0.5, np.sign(gap) == difference), 0.0)
    return _Alike(same, told.astype(float), first, second, len(values))


def _within(share: Estimate | None) -> Estimate | None:
    """Return a share with an interval in [0, 1]; where all pairs are alike the jackknife has none to give."""
    if share is None or share.low is None or share.high is None:
        return share
    if share.value in (0.0, 1.0):
        return Estimate(share.value)
    return Estimate(share.value, max(share.low, 0.0), min(share.high, 1.0))
