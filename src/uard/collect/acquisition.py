"""Who is asked what: rules that say which items come next, and the choice of items and raters within a budget.

A rule is a pure function of what is known: a score per item, and the highest comes first. Where a rule knows nothing of
an item (NaN), the item takes a place at random among the others, so that no rule is blind to what it has not seen yet.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, cast

import numpy as np

from uard import _checks
from uard.collect.store import Request
from uard.ratings import bradley_terry

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Integer

HASTE = 2.0  # times its share, with which a repeat that is due is asked: it must not come as soon as it is due


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of n items and K raters when it is decided what is asked next.

    Examples:
        >>> known = Known.nothing(items=("x", "y"), raters=("ann", "bob"), reward=np.array([1.0, np.nan]))
        >>> known.heard.tolist()
        [0, 0]

    Attributes:
        items: Names of the items that may be asked about.
        raters: Names of the raters.
        reward: (n,) observed reward, NaN where there is none.
        ratings: (n, K) latest rating, NaN where there is none. Of pairs: 1 where the first was preferred, 0 where the
            second was, 0.5 for a tie.
        count: (n, K) answers that were given, repeats and skips among them.
        asked: (n, K) whether a request to this rater is open.
        anybody: (n,) open requests to nobody in particular.
        paused: (K,) who is asked nothing now.
        pairs: (n, 2) of items that are pairs, the numbers of the two in ``worth``; None if they are no pairs.
        worth: (m,) mean rating of each thing that stands in pairs, NaN where it was not rated by itself.
        strata: (n,) which part each item belongs to; None if they have no parts.
    """

    items: tuple[str, ...]
    raters: tuple[str, ...]
    reward: Float[np.ndarray, " n"]
    ratings: Float[np.ndarray, "n K"]
    count: Integer[np.ndarray, "n K"]
    asked: Bool[np.ndarray, "n K"]
    anybody: Integer[np.ndarray, " n"]
    paused: Bool[np.ndarray, " K"]
    pairs: Integer[np.ndarray, "n 2"] | None = None
    worth: Float[np.ndarray, " m"] | None = None
    strata: Integer[np.ndarray, " n"] | None = None

    def __post_init__(self) -> None:
        """Check that the shapes fit.

        Raises:
            InvalidValueError: naming the field, its shape and what is allowed.
        """
        n, raters = len(self.items), len(self.raters)
        shapes = {"reward": (n,), "ratings": (n, raters), "count": (n, raters), "asked": (n, raters), "anybody": (n,)}
        for name, shape in (shapes | {"paused": (raters,), "pairs": (n, 2), "strata": (n,)}).items():
            value = getattr(self, name)
            if value is not None and np.shape(value) != shape:
                raise _checks.InvalidValueError(f"{name}.shape", np.shape(value), f"{shape}")
        if self.pairs is not None and self.worth is None:
            raise _checks.InvalidValueError("worth", None, "given where items are pairs; NaN where nothing is known")

    @staticmethod
    def nothing(
        items: tuple[str, ...],
        raters: tuple[str, ...],
        reward: Float[np.ndarray, " n"] | None = None,
        pairs: Integer[np.ndarray, "n 2"] | None = None,
    ) -> Known:
        """Return what is known before the first answer.

        Args:
            items: Their names.
            raters: Their names.
            reward: Observed; unknown if left out.
            pairs: See the attribute.
        """
        n, shape = len(items), (len(items), len(raters))
        return Known(
            items,
            raters,
            np.full(n, np.nan) if reward is None else reward,
            np.full(shape, np.nan),
            np.zeros(shape, int),
            np.zeros(shape, bool),
            np.zeros(n, int),
            np.zeros(len(raters), bool),
            pairs,
            None if pairs is None else np.full(int(pairs.max(initial=-1)) + 1, np.nan),
        )

    @cached_property
    def heard(self) -> Integer[np.ndarray, " n"]:
        """How many raters have answered about each item or are asked about it now."""
        return ((self.count > 0) | self.asked).sum(1) + self.anybody


Rule = Callable[[Known], "Float[np.ndarray, ' n']"]


def at_random(known: Known) -> Float[np.ndarray, " n"]:
    """Return the same score for all items.

    Examples:
        >>> at_random(Known.nothing(("x", "y"), ("ann",))).tolist()
        [0.0, 0.0]
    """
    return np.zeros(len(known.items))


def disputed(known: Known) -> Float[np.ndarray, " n"]:
    """Return the standard deviation between the raters of an item; NaN below two ratings.

    Examples:
        >>> import dataclasses
        >>> known = Known.nothing(("x", "y"), ("ann", "bob"))
        >>> disputed(dataclasses.replace(known, ratings=np.array([[1.0, 3.0], [1.0, np.nan]]))).round(3).tolist()
        [1.414, nan]
    """
    here = ~np.isnan(known.ratings)
    number = here.sum(1)
    held = np.where(here, known.ratings, 0.0)
    mean = held.sum(1) / np.maximum(number, 1)
    square = np.where(here, known.ratings - mean[:, None], 0.0) ** 2
    return np.where(number > 1, np.sqrt(square.sum(1) / np.maximum(number - 1, 1)), np.nan)


def least_known(known: Known) -> Float[np.ndarray, " n"]:
    """Return a score that is highest for the items that fewest raters were asked about.

    Of equals those come first whose stratum has the fewest answers per item.

    Examples:
        >>> import dataclasses
        >>> known = Known.nothing(("x", "y"), ("ann", "bob"))
        >>> least_known(dataclasses.replace(known, asked=np.array([[True, False], [False, False]]))).tolist()
        [-1.0, 0.0]
    """
    score = 0.0 - known.heard
    if known.strata is None or not len(score):
        return score
    _, stratum = np.unique(known.strata, return_inverse=True)
    mean = np.bincount(stratum, score) / np.bincount(stratum)
    return score + 0.5 * mean[stratum] / (1.0 - mean.min())


def highest_reward(known: Known) -> Float[np.ndarray, " n"]:
    """Return the observed reward: where it is highest an agent will go, and there hacks are.

    Examples:
        >>> highest_reward(Known.nothing(("x", "y"), ("ann",), np.array([4.0, np.nan]))).tolist()
        [4.0, nan]
    """
    return known.reward


def near_ties(known: Known) -> Float[np.ndarray, " n"]:
    """Return of pairs how near the two are to each other by present estimates; NaN of what is no pair.

    Estimates are Bradley and Terry's worth if any pair was judged, and mean ratings of the two if none was.

    Examples:
        >>> import dataclasses
        >>> known = Known.nothing(("xy", "xz"), ("ann",), pairs=np.array([[0, 1], [0, 2]]))
        >>> near_ties(dataclasses.replace(known, worth=np.array([1.0, 0.5, -1.0]))).tolist()
        [-0.5, -2.0]
    """
    if known.pairs is None or known.worth is None:
        return np.full(len(known.items), np.nan)
    first, second = known.pairs.T
    here = ~np.isnan(known.ratings)
    cases = here.sum(1).astype(float)
    estimate = known.worth
    if cases.any():
        wins = np.where(here, known.ratings, 0.0).sum(1)
        estimate = bradley_terry.worth(first, second, wins, cases, len(known.worth))
        compared = np.bincount(first, cases, len(estimate)) + np.bincount(second, cases, len(estimate))
        estimate = np.where(compared > 0, estimate, np.nan)
    return -np.abs(estimate[first] - estimate[second])


RULES: dict[str, Rule] = {
    "random": at_random,
    "disputed": disputed,
    "least-known": least_known,
    "highest-reward": highest_reward,
    "near-ties": near_ties,
}
"""Rules by name."""


@dataclass(frozen=True)
class Acquisition:
    """Chooses what is asked next, and whom.

    Nobody is asked twice about an item but for hidden repeats, an item is put to no more than ``overlap`` raters, those
    who have answered the fewest come first, and ties are broken at random.

    Examples:
        >>> known = Known.nothing(("x", "y"), ("ann", "bob"), np.array([4.0, -0.1]))
        >>> chosen = Acquisition("highest-reward", overlap=1).choose(known, budget=1, random=np.random.default_rng(0))
        >>> chosen[0].item
        'x'
        >>> Acquisition({"random": 1.0, "disputed": 3.0}).weights
        {'random': 0.25, 'disputed': 0.75}

    Attributes:
        rule: A name in ``RULES``; or names with weights, by which it is drawn for each question which rule decides.
        overlap: Raters per item, >= 1; who skipped counts.
        repeats: Share of a rater's questions that ask again what she has answered, in [0, 0.9].
    """

    rule: str | Mapping[str, float] = "random"
    overlap: int = 3
    repeats: float = 0.0

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        rules = self._rules()
        for name, weight in rules.items():
            _checks.choose("rule", name, RULES)
            _checks.number(f"rule[{name}]", weight, low=0, high=1e9)
        if not sum(rules.values()) > 0:
            raise _checks.InvalidValueError("rule", self.rule, "names with weights, not all of them 0")
        _checks.whole("overlap", self.overlap, low=1)
        _checks.number("repeats", self.repeats, low=0, high=0.9)

    def _rules(self) -> Mapping[str, float]:
        if isinstance(self.rule, str):
            return {self.rule: 1.0}
        kind = cast("type[Mapping[str, float]]", Mapping)
        return _checks.instance("rule", self.rule, kind, "a rule's name, or names with weights")

    @property
    def weights(self) -> dict[str, float]:
        """By which it is drawn which rule decides; they sum to 1."""
        rules = self._rules()
        total = sum(rules.values())
        return {name: weight / total for name, weight in rules.items() if weight > 0}

    def choose(self, known: Known, budget: int, random: np.random.Generator) -> tuple[Request, ...]:
        """Return what should be asked, in that order, at most ``budget`` requests; fewer if there is no more to ask.

        Args:
            known: What is known now.
            budget: Answers that can be had, >= 0.
            random: Source of chance.

        Raises:
            InvalidValueError: for a budget below 0.
        """
        _checks.whole("budget", budget)
        weights = list(self.weights.values())
        orders = [_order(RULES[name](known), random) for name in self.weights]
        plan = _Plan(known, self, random)
        chosen: list[Request] = []
        for _ in range(budget):
            order = orders[0] if len(orders) == 1 else orders[int(random.choice(len(orders), p=weights))]
            request = plan.repeat() or plan.rating(order)
            if request is None:
                break
            chosen.append(request)
        return tuple(chosen)


def _order(score: Float[np.ndarray, " n"], random: np.random.Generator) -> Integer[np.ndarray, " n"]:
    """Return the items' numbers, the highest score first; ties, and what has no score, at random."""
    unknown = np.isnan(score)
    if unknown.all():
        return random.permutation(len(score))
    if unknown.any():
        score = score.copy()
        score[unknown] = random.choice(score[~unknown], int(unknown.sum()))
    shuffled = random.permutation(len(score))
    return shuffled[np.argsort(-score[shuffled], kind="stable")]


class _Plan:
    """What can still be asked while requests are chosen one by one. Changed in place."""

    def __init__(self, known: Known, acquisition: Acquisition, random: np.random.Generator):
        self._random, self._share = random, acquisition.repeats
        there = np.flatnonzero(~known.paused)  # often one of many
        self._items, self._raters = known.items, [known.raters[k] for k in there]
        count, asked = known.count[:, there], known.asked[:, there]
        answered = count > 0
        self._free = ~(answered | asked)  # who can be asked about which item
        self._room = acquisition.overlap - known.heard
        self._fresh = np.ones(len(known.items), bool)  # not chosen yet in this round: one question an item and round
        self._load = count.sum(0) + asked.sum(0)
        self._again = (count == 1) & ~np.isnan(known.ratings[:, there]) & ~asked
        self._repeated = np.maximum(count - 1, 0).sum(0) + (asked & answered).sum(0)

    def rating(self, order: Integer[np.ndarray, " n"]) -> Request | None:
        """Choose the first item of an order that somebody can be asked about, and whom; None if there is none."""
        possible = (self._room > 0) & self._free.any(1)
        if not possible.any():
            return None
        if not (possible & self._fresh).any():
            self._fresh[:] = True
        item = int(order[np.argmax((possible & self._fresh)[order])])
        raters = np.flatnonzero(self._free[item])
        rater = self._of(raters[self._load[raters] == self._load[raters].min()])
        self._room[item] -= 1
        self._fresh[item] = self._free[item, rater] = False
        self._load[rater] += 1
        return Request(self._items[item], self._raters[rater])

    def repeat(self) -> Request | None:
        """Choose a repeat if one is due, by chance and not at once; None otherwise."""
        if self._share == 0 or self._random.random() >= HASTE * self._share:
            return None
        due = np.flatnonzero((self._repeated + 1 <= self._share * self._load) & self._again.any(0))
        if not due.size:
            return None
        rater = self._of(due)
        item = self._of(np.flatnonzero(self._again[:, rater]))
        self._again[item, rater] = False
        self._repeated[rater] += 1
        self._load[rater] += 1
        return Request(self._items[item], self._raters[rater], "repeat")

    def _of(self, numbers: Integer[np.ndarray, " m"]) -> int:
        return int(numbers[self._random.integers(len(numbers))])
