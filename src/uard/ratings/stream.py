"""The filter for somebody else's training: rewards and ratings go in step by step, rewards to learn from come out.

A ``RewardStream`` is all that the adapters share. Where state-actions come again (``keys``) it remembers the ratings of
each; where none comes twice, a step's own ratings are all that is known of it, and a uniform sample of all rated steps
stands for the others.
"""

from __future__ import annotations

import warnings
from collections.abc import Hashable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from uard import _checks
from uard.method.abstention import Abstention
from uard.method.feedback import Feedback
from uard.method.mitigations import Evidence, Mitigation, uard
from uard.ratings.aggregate import aggregate, nothing
from uard.ratings.memory import FeedbackTable, RatingSample

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

PATIENCE = 1000  # steps without any rating before we say so


class NeverRatedWarning(UserWarning):
    """Nobody has rated anything, so nothing is known and every reward is believed equally little."""


class Filtered(NamedTuple):
    """The rewards of B steps, filtered, and why; in reward units.

    Attributes:
        reward: What to learn from.
        raw: What was observed.
        weight: How far it was believed, in [0, 1]; 1 for a mitigation that has no weight.
        sigma_h: Disagreement of the raters (and of the proxy with them); 0 where nobody has rated.
        sigma_m: Disagreement of the ensemble.
        lam: lambda_t; 0 for a mitigation that has none.
        abstained: Whether the rule for abstention would not have acted on this.
        rated: Whether this step was rated itself.
    """

    reward: Float[np.ndarray, " B"]
    raw: Float[np.ndarray, " B"]
    weight: Float[np.ndarray, " B"]
    sigma_h: Float[np.ndarray, " B"]
    sigma_m: Float[np.ndarray, " B"]
    lam: Float[np.ndarray, " B"]
    abstained: Bool[np.ndarray, " B"]
    rated: Bool[np.ndarray, " B"]


class Observed(NamedTuple):
    """What ``RewardStream.observe`` has taken in of B steps.

    Attributes:
        visit: The ratings of the steps themselves.
        slots: Where each step's state-action is kept; None without keys.
    """

    visit: Feedback
    slots: Int[np.ndarray, " B"] | None


class RewardStream:
    """Filters rewards as they come. Changed in place; pickling keeps all that it knows.

    Examples:
        >>> stream = RewardStream()
        >>> reward = [4.0] + 9 * [-0.1]  # raters contest the first and agree on the others
        >>> ratings = [[-1.0, 2.0, 1.0]] + 9 * [[-0.1, -0.1, -0.1]]
        >>> for _ in range(30):
        ...     out = stream(reward, ratings, keys=range(10))
        >>> out.weight[:2].round(2).tolist(), out.reward[:2].round(2).tolist()
        ([0.03, 0.94], [-0.8, -0.1])

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
        """Start without any rating.

        Args:
            mitigation: What to do with a reward; ``uard()`` if left out. It must change rewards only.
            abstention: See the attribute.
            ddof: Of sigma_h.
            capacity: Rated steps kept where steps have no keys, >= 2.
            refresh: Rated steps after which the panel's statistics are measured again, >= 1 (more often at first).
            seed: Of the sample of steps that are kept.

        Raises:
            InvalidValueError: for a mitigation that needs more than rewards.
        """
        mitigation = uard() if mitigation is None else mitigation
        allowed = "a Mitigation (see uard.method.mitigations.named)"
        self.mitigation = _checks.instance("mitigation", mitigation, Mitigation, allowed)
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
        """Observe the ratings of some steps, and return their rewards, filtered.

        Args:
            reward: Observed rewards (B,), finite.
            ratings: (B, K) in reward units; NaN where a rating is missing; None if none was given.
            sigma_m: (B,), the ensemble's disagreement in reward units, >= 0; 0 if left out.
            keys: What tells state-actions apart, B of them; left out where none comes twice.

        Raises:
            InvalidValueError: naming field, place, value and what is allowed.
        """
        checked = _column("reward", reward)
        visit, slots = self._observe(checked, ratings, keys)
        known = visit if slots is None else self.known(slots)
        return self._filter(checked, known, sigma_m, slots is not None, visit.count > 0)

    def observe(self, reward: Any, ratings: Any = None, keys: Sequence[Hashable] | None = None) -> Observed:
        """Remember the ratings of some steps; arguments and errors are those of ``__call__``."""
        return self._observe(_column("reward", reward), ratings, keys)

    def _observe(self, reward: Float[np.ndarray, " B"], ratings: Any, keys: Sequence[Hashable] | None) -> Observed:
        ratings = np.full((len(reward), 1), np.nan) if ratings is None else _checks.as_numpy("ratings", ratings)
        visit = aggregate(ratings, reward, ddof=self.ddof)
        rated = visit.count.nonzero()[0]
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
            self._sample.put(visit if len(rated) == len(reward) else visit.map(lambda x: x[rated]))
            return Observed(visit, None)
        if len(keys) != len(reward):
            raise _checks.InvalidValueError("len(keys)", len(keys), f"{len(reward)}, one per reward")
        slots = np.array([self._slots.setdefault(key, len(self._slots)) for key in keys], np.int64)
        self._table.observe(slots, visit, len(self._slots))
        return Observed(visit, slots)

    def filter(self, reward: Any, known: Feedback, sigma_m: Any = None, *, keyed: bool) -> Filtered:
        """Filter rewards by what is known; nothing is remembered.

        Args:
            reward: (B,).
            known: Of the steps' state-actions, (B,) arrays: the visit itself, or ``known(slots)``.
            sigma_m: (B,) or None.
            keyed: Whether that comes from a table of state-actions that come again.

        Returns:
            ``rated`` is true where anything is known.

        Raises:
            InvalidValueError: naming field, place, value and what is allowed.
        """
        return self._filter(_column("reward", reward), known, sigma_m, keyed, known.count > 0)

    def _filter(
        self,
        reward: Float[np.ndarray, " B"],
        known: Feedback,
        sigma_m: Any,
        keyed: bool,
        rated: Bool[np.ndarray, " B"],
    ) -> Filtered:
        zeros = np.zeros(len(reward))
        sigma_m = zeros if sigma_m is None else _column("sigma_m", sigma_m, nonnegative=True)
        if len(sigma_m) != len(reward):
            raise _checks.InvalidValueError("len(sigma_m)", len(sigma_m), f"{len(reward)}, one per reward")
        mitigation = self.mitigation if keyed else self._of_single_visits
        why = mitigation.explain(Evidence(reward, sigma_m, known), self._measured(keyed))
        if not _is_one(why.signal.sample_weight):
            raise _checks.InvalidValueError(
                "mitigation", self.mitigation, "one that changes rewards; this one leaves steps out of learning"
            )
        out = np.asarray(why.signal.reward, np.float64) + zeros
        _checks.finite("filtered reward", out)
        abstained = zeros > 0 if self.abstention is None else self.abstention.abstains(why.doubt, reward)
        return Filtered(out, reward, why.weight + zeros, why.sigma_h, sigma_m, why.lam + zeros, abstained, rated)

    def known(self, slots: Int[np.ndarray, " B"]) -> Feedback:
        """Return what is known of state-actions at places that ``observe`` gave, (B,) arrays."""
        return self._table[slots]

    def _measured(self, keyed: bool) -> Any:
        """Return the panel's statistics, measured again when enough has been rated since."""
        if self.rated >= self._due:
            self._statistics.clear()
            self._due = self.rated + max(1, min(self.rated, self._refresh))
        if keyed not in self._statistics:
            every = self._table.every() if keyed else self._sample.feedback()
            if not len(every.count):
                every = nothing((1,), 1)
            self._statistics[keyed] = self.mitigation.fit(every, every.count > 0)
        return self._statistics[keyed]


def _is_one(sample_weight: Any) -> bool:
    return sample_weight == 1.0 if isinstance(sample_weight, float) else bool(np.all(sample_weight == 1.0))


def _column(field: str, values: Any, nonnegative: bool = False) -> Float[np.ndarray, " B"]:
    values = _checks.as_numpy(field, values)
    if values.ndim != 1:
        raise _checks.InvalidValueError(f"{field}.shape", values.shape, "(B,), one number per step")
    (_checks.nonnegative if nonnegative else _checks.finite)(field, values)
    return values
