"""The filter for somebody else's training: rewards and ratings go in step by step, rewards to learn from come out.

A ``RewardStream`` is all that the adapters share. Where state-actions come again (``keys``) it remembers what was said
of each; where none comes twice, a step's own ratings are all that is known of it, and a uniform sample of all rated steps
stands for the others.
"""

from __future__ import annotations

import warnings
from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np

from uard import _checks
from uard.method.abstention import Abstention
from uard.method.feedback import Feedback
from uard.method.mitigations import Evidence, Mitigation, uard
from uard.ratings.aggregate import aggregate, nothing
from uard.ratings.memory import FeedbackTable, RatingSample

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


class Observed(NamedTuple):
    """What ``RewardStream.observe`` has taken in of (B,) steps.

    Attributes:
        visit: What was said of the steps themselves.
        slots: Where each step's state-action is kept, (B,); None without keys.
    """

    visit: Feedback
    slots: np.ndarray | None


class RewardStream:
    """Filters rewards as they come. Changed in place; pickling keeps all that it knows.

    Attributes:
        mitigation: What is done with a reward.
        abstention: A rule by which steps are marked as such that an agent should not act on; none marks none.
        ddof: Of sigma_h.
        rated: Steps rated so far.
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
            refresh: Rated steps after which the panel's statistics are measured anew, >= 1 (more often at first).
            seed: Of the sample of steps that are kept.

        Raises:
            InvalidValueError: for a mitigation that needs more than rewards.
        """
        self.mitigation = uard() if mitigation is None else mitigation
        if not isinstance(self.mitigation, Mitigation):
            raise _checks.InvalidValueError(
                "mitigation", mitigation, "a Mitigation (see uard.method.mitigations.named)"
            )
        if self.mitigation.acts_on != "reward":
            raise _checks.InvalidValueError(
                "mitigation.acts_on", self.mitigation.acts_on, "'reward': actions are not chosen here"
            )
        _checks.whole("ddof", ddof, high=1)
        _checks.whole("capacity", capacity, low=2)
        _checks.whole("refresh", refresh, low=1)
        # What will never be rated again is known as well as it will ever be.
        self._of_single_visits = self.mitigation.without_prior()
        self.abstention = abstention
        self.rated = 0
        self.ddof, self._refresh = ddof, refresh
        self._table = FeedbackTable()
        self._sample = RatingSample(capacity, seed)
        self._slots: dict[Hashable, int] = {}
        self._steps, self._warned = 0, False
        self._due = 0
        self._statistics: dict[bool, Any] = {}  # by whether state-actions have keys

    def __call__(
        self,
        reward: Any,
        ratings: Any = None,
        sigma_m: Any = None,
        keys: Sequence[Hashable] | None = None,
    ) -> Filtered:
        """Observe what was said of some steps, and return their rewards, filtered.

        Args:
            reward: Observed rewards (B,), finite.
            ratings: (B, K) in reward units; NaN where a rating is missing; None if none was given.
            sigma_m: (B,), the ensemble's disagreement in reward units, >= 0; 0 if left out.
            keys: What tells state-actions apart, B of them; left out where none comes twice.

        Raises:
            InvalidValueError: naming field, place, value and what is allowed.
        """
        visit, slots = self.observe(reward, ratings, keys)
        known = visit if slots is None else self.known(slots)
        return self.filter(reward, known, sigma_m, keyed=slots is not None, rated=visit.count > 0)

    def observe(self, reward: Any, ratings: Any = None, keys: Sequence[Hashable] | None = None) -> Observed:
        """Remember what was said of some steps; see ``__call__``."""
        reward = _column("reward", reward)
        ratings = np.full((len(reward), 1), np.nan) if ratings is None else _checks.as_numpy("ratings", ratings)
        visit = aggregate(ratings, reward, ddof=self.ddof)
        rated = np.flatnonzero(visit.count)
        self._steps += len(reward)
        self.rated += len(rated)
        if self.rated == 0 and self._steps >= PATIENCE and not self._warned and self.mitigation.reads_feedback:
            self._warned = True
            warnings.warn(
                f"{PATIENCE} steps and no rating of any: nothing is known of the reward, and it is believed equally "
                "little everywhere. Give ratings, or leave the filter out",
                NeverRatedWarning,
                stacklevel=3,
            )
        if keys is None:
            self._sample.put(ratings[rated], reward[rated])
            return Observed(visit, None)
        if len(keys) != len(reward):
            raise _checks.InvalidValueError("len(keys)", len(keys), f"{len(reward)}, one per reward")
        slots = np.array([self._slots.setdefault(key, len(self._slots)) for key in keys], np.int64)
        self._table.observe(slots, visit, len(self._slots))
        return Observed(visit, slots)

    def filter(
        self,
        reward: Any,
        known: Feedback,
        sigma_m: Any = None,
        *,
        keyed: bool,
        rated: np.ndarray | None = None,
    ) -> Filtered:
        """Filter rewards by what is known; nothing is remembered.

        Args:
            reward: (B,).
            known: Of the steps' state-actions, (B,) arrays: the visit itself, or ``known(slots)``.
            sigma_m: (B,) or None.
            keyed: Whether that comes from a table of state-actions that come again.
            rated: (B,) of bool, which steps were rated themselves; those with a count if left out.
        """
        reward = _column("reward", reward)
        sigma_m = np.zeros(len(reward)) if sigma_m is None else _column("sigma_m", sigma_m, nonnegative=True)
        if len(sigma_m) != len(reward):
            raise _checks.InvalidValueError("len(sigma_m)", len(sigma_m), f"{len(reward)}, one per reward")
        mitigation = self.mitigation if keyed else self._of_single_visits
        why = mitigation.explain(Evidence(reward, sigma_m, known), self._measured(keyed))
        if np.any(np.asarray(why.signal.sample_weight) != 1.0):
            raise _checks.InvalidValueError(
                "mitigation", self.mitigation, "one that changes rewards; this one leaves steps out of learning"
            )
        zeros = np.zeros(len(reward))
        out = np.asarray(why.signal.reward, np.float64) + zeros
        _checks.finite("filtered reward", out)
        abstained = zeros.astype(bool) if self.abstention is None else self.abstention.abstains(why.doubt, reward)
        rated = known.count > 0 if rated is None else rated
        return Filtered(out, reward, why.weight + zeros, why.sigma_h, sigma_m, why.lam + zeros, abstained, rated)

    def known(self, slots: np.ndarray) -> Feedback:
        """Return what is known of state-actions at places that ``observe`` gave, (B,) arrays."""
        return self._table[slots]

    def _measured(self, keyed: bool) -> Any:
        """Return the panel's statistics, measured anew when enough has been rated since."""
        if self.rated >= self._due:
            self._statistics.clear()
            self._due = self.rated + max(1, min(self.rated, self._refresh))
        if keyed not in self._statistics:
            every = self._table.every() if keyed else self._sample.feedback(self.ddof)
            if not len(every.count):
                every = nothing((1,), 1)
            self._statistics[keyed] = self.mitigation.fit(every, every.count > 0)
        return self._statistics[keyed]


def _column(field: str, values: Any, nonnegative: bool = False) -> np.ndarray:
    values = _checks.as_numpy(field, values)
    if values.ndim != 1:
        raise _checks.InvalidValueError(f"{field}.shape", values.shape, "(B,), one number per step")
    (_checks.nonnegative if nonnegative else _checks.finite)(field, values)
    return values
