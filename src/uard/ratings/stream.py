"""The filter for somebody else's training: rewards and ratings go in step by step, rewards to learn from come out.

A ``RewardStream`` is all that the adapters share. It remembers what was said of which state-action (``keys``), or,
where no state-action comes twice, takes each step's own ratings as what is known of it and a uniform sample of all
rated steps as what is usual.
"""

from __future__ import annotations

import warnings
from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np

from uard import _checks
from uard.method.abstention import Abstention
from uard.method.mitigations import Evidence, Feedback, Mitigation, RewardDiscounting, uard
from uard.method.weights import discount

SURE = 1e6  # visits that a step's own ratings are worth where nothing else can tell of it
PATIENCE = 1000  # steps without any rating before we say so


class NeverRatedWarning(UserWarning):
    """Nobody has rated anything, so nothing is known and every reward is believed equally little."""


class Filtered(NamedTuple):
    """Rewards to learn from, and why; arrays (B,) of float64 in reward units.

    Attributes:
        reward: What to learn from.
        raw: What was observed.
        weight: How far it was believed, in [0, 1]; 1 for a mitigation that has no weight.
        sigma_h: Disagreement of the raters (and of the proxy with them); 0 where nobody has rated.
        sigma_m: Disagreement of the ensemble.
        lam: lambda_t; 0 for a mitigation that has none.
        abstained: Whether the rule for abstention would not have acted on this (bool).
        rated: Whether this step was rated itself (bool).
    """

    reward: np.ndarray
    raw: np.ndarray
    weight: np.ndarray
    sigma_h: np.ndarray
    sigma_m: np.ndarray
    lam: np.ndarray
    abstained: np.ndarray
    rated: np.ndarray


class RewardStream:
    """Filters rewards as they come. Changed in place; pickling keeps all that it knows.

    Attributes:
        mitigation: What is done with a reward.
        abstention: A rule by which steps are marked as such that an agent should not act on; none marks none.
        seen: Steps rated so far.
    """

    def __init__(
        self,
        mitigation: Mitigation | None = None,
        *,
        abstention: Abstention | None = None,
        ddof: int = 0,
        capacity: int = 4096,
        refresh: int = 256,
        seed: int = 0,
    ):
        """Start knowing nothing.

        Args:
            mitigation: What to do with a reward; ``uard()`` if left out. It must change rewards only.
            abstention: See the attribute.
            ddof: Of sigma_h.
            capacity: Rated steps kept where steps have no keys, >= 2.
            refresh: Rated steps after which what is usual is measured anew, >= 1 (more often at the beginning).
            seed: Of the sample of steps that are kept.

        Raises:
            InvalidValueError: for a mitigation that needs more than rewards.
        """
        self.mitigation = uard() if mitigation is None else mitigation
        if not isinstance(self.mitigation, Mitigation):
            raise _checks.InvalidValueError(
                "mitigation", mitigation, "a Mitigation (see uard.method.mitigations.named)"
            )
        if isinstance(self.mitigation, RewardDiscounting) and self.mitigation.acts_on != "reward":
            raise _checks.InvalidValueError(
                "mitigation.acts_on", self.mitigation.acts_on, "'reward': actions are not chosen here"
            )
        _checks.whole("ddof", ddof, high=1)
        _checks.whole("capacity", capacity, low=2)
        _checks.whole("refresh", refresh, low=1)
        self.abstention = abstention
        self.seen = 0
        self._ddof, self._capacity, self._refresh = ddof, capacity, refresh
        self._random = np.random.default_rng(seed)
        self._rows = np.zeros((64, 5))  # count, mean, lowest, spread, proxy
        self._filled = 0
        self._slots: dict[Hashable, int] = {}
        self._raters = 1.0
        self._steps = 0
        self._due = 0
        self._usual: Any = ()  # as the mitigation measures it

    def __call__(
        self,
        reward: Any,
        ratings: Any = None,
        sigma_m: Any = None,
        keys: Sequence[Hashable] | None = None,
    ) -> Filtered:
        """Hear what was said of some steps, and return their rewards, filtered.

        Args:
            reward: Observed rewards (B,), finite.
            ratings: (B, K) in reward units; NaN where a rating is missing; None if none was given.
            sigma_m: (B,), the ensemble's disagreement in reward units, >= 0; 0 if left out.
            keys: What tells state-actions apart, B of them; left out where none comes twice.

        Raises:
            InvalidValueError: naming field, place, value and what is allowed.
        """
        slots, own = self.hear(reward, ratings, keys)
        return self.filter(reward, own if slots is None else self._rows[slots], sigma_m, own[:, 0] > 0)

    def hear(
        self, reward: Any, ratings: Any = None, keys: Sequence[Hashable] | None = None
    ) -> tuple[np.ndarray | None, np.ndarray]:
        """Remember what was said of some steps; see ``__call__``.

        Returns:
            Where each key's row is (B,), or None without keys; and what was said of the steps themselves, (B, 5):
            count (0 where nobody rated), mean, lowest, sigma_h, observed reward.
        """
        reward = _column("reward", reward)
        said = self._said(reward, ratings)
        rated = np.flatnonzero(said[:, 0])
        self._steps += len(reward)
        if self.seen == 0 and len(rated) == 0 and self._steps >= PATIENCE and self.mitigation.reads_feedback:
            self._steps = -(2**62)  # once
            warnings.warn(
                f"{PATIENCE} steps and no rating of any: nothing is known of the reward, and it is believed equally "
                "little everywhere. Give ratings, or leave the filter out",
                NeverRatedWarning,
                stacklevel=3,
            )
        slots = None
        if keys is not None:
            if len(keys) != len(reward):
                raise _checks.InvalidValueError("len(keys)", len(keys), f"{len(reward)}, one per reward")
            slots = np.array([self._slot(key) for key in keys], np.int64)
            for i in rated:
                row = self._rows[slots[i]]
                row[0] += 1
                row[1:] += (said[i, 1:] - row[1:]) / row[0]
        else:
            said[:, 0] *= SURE
            self._keep(said[rated])
        self.seen += len(rated)
        return slots, said

    def filter(self, reward: Any, rows: np.ndarray, sigma_m: Any = None, rated: np.ndarray | None = None) -> Filtered:
        """Filter rewards by rows as ``hear`` gives them; nothing is remembered.

        Args:
            reward: (B,).
            rows: (B, 5).
            sigma_m: (B,) or None.
            rated: (B,) of bool, which steps were rated themselves; those with a count if left out.
        """
        reward = _column("reward", reward)
        sigma_m = np.zeros(len(reward)) if sigma_m is None else _column("sigma_m", sigma_m, nonnegative=True)
        if len(sigma_m) != len(reward):
            raise _checks.InvalidValueError("len(sigma_m)", len(sigma_m), f"{len(reward)}, one per reward")
        raters = np.float64(self._raters)
        feedback = _feedback(rows, raters)
        if self.seen >= self._due:
            self._measure(raters)
        evidence = Evidence(reward, sigma_m, feedback)
        ones, zeros = np.ones(len(reward)), np.zeros(len(reward))
        if isinstance(self.mitigation, RewardDiscounting):
            why = self.mitigation.explain(evidence, self._usual)
            out, weight, sigma_h, lam = discount(reward, why.weight, why.anchor), why.weight, why.sigma_h, why.lam
            doubt = self.mitigation.filter.alpha * sigma_m + self.mitigation.filter.beta * sigma_h
        else:
            signal = self.mitigation.signal(evidence, self._usual)
            if np.any(np.asarray(signal.sample_weight) != 1.0):
                raise _checks.InvalidValueError(
                    "mitigation", self.mitigation, "one that changes rewards; this one leaves steps out of learning"
                )
            out, weight, lam = np.asarray(signal.reward, np.float64), ones, zeros
            sigma_h = np.where(feedback.count > 0, feedback.spread, 0.0)
            doubt = sigma_m + sigma_h
        _checks.finite("filtered reward", out)
        abstained = zeros.astype(bool) if self.abstention is None else self.abstention.abstains(doubt, reward)
        rated = rows[:, 0] > 0 if rated is None else rated
        return Filtered(out, reward, weight + zeros, sigma_h, sigma_m, lam + zeros, abstained, rated)

    def rows(self, slots: np.ndarray) -> np.ndarray:
        """Return what is known at places that ``hear`` gave, (B, 5)."""
        return self._rows[slots]

    def _said(self, reward: np.ndarray, ratings: Any) -> np.ndarray:
        said = np.zeros((len(reward), 5))
        if ratings is None:
            return said
        ratings = _checks.as_numpy("ratings", ratings)
        if ratings.ndim != 2 or len(ratings) != len(reward) or ratings.shape[1] == 0:
            raise _checks.InvalidValueError(
                "ratings.shape", ratings.shape, f"({len(reward)}, K): one row per reward and one column per rater"
            )
        here = ~np.isnan(ratings)
        number = np.add.reduce(here, 1)
        if not number.any():
            return said
        self._raters = max(self._raters, float(ratings.shape[1]))
        held = np.where(here, ratings, 0.0)
        _checks.finite("ratings", held)
        at_least = np.maximum(number, 1)
        mean = np.add.reduce(held, 1) / at_least
        square = np.where(here, (ratings - mean[:, None]) ** 2, 0.0)
        said[:, 0] = number > 0
        said[:, 1] = mean
        said[:, 2] = np.where(number > 0, np.minimum.reduce(np.where(here, ratings, np.inf), 1), 0.0)
        said[:, 3] = np.sqrt(np.add.reduce(square, 1) / np.maximum(number - self._ddof, 1))  # uncertainty.sigma_human
        said[:, 4] = reward
        return said

    def _slot(self, key: Hashable) -> int:
        slot = self._slots.get(key)
        if slot is None:
            slot = self._slots[key] = self._filled
            self._grow(self._filled + 1)
            self._filled += 1
        return slot

    def _grow(self, size: int) -> None:
        if size > len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros((max(size, 2 * len(self._rows)) - len(self._rows), 5))])

    def _keep(self, said: np.ndarray) -> None:
        """Put rated steps into the sample [Vitter 1985, algorithm R]."""
        free = min(len(said), self._capacity - self._filled)
        self._grow(self._filled + free)
        self._rows[self._filled : self._filled + free] = said[:free]
        self._filled += free
        later = np.arange(free, len(said))
        places = self._random.integers(0, self.seen + later + 1) if len(later) else later
        for i, place in zip(later, places, strict=True):
            if place < self._capacity:
                self._rows[place] = said[i]

    def _measure(self, raters: np.float64) -> None:
        known = self._rows[: max(self._filled, 1)]
        self._usual = self.mitigation.usual(_feedback(known, raters), known[:, 0] > 0)
        self._due = self.seen + max(1, min(self.seen, self._refresh))


def _feedback(rows: np.ndarray, raters: np.float64) -> Feedback:
    return Feedback._make([*np.ascontiguousarray(rows.T), raters])


def _column(field: str, values: Any, nonnegative: bool = False) -> np.ndarray:
    values = _checks.as_numpy(field, values)
    if values.ndim != 1:
        raise _checks.InvalidValueError(f"{field}.shape", values.shape, "(B,), one number per step")
    (_checks.nonnegative if nonnegative else _checks.finite)(field, values)
    return values
