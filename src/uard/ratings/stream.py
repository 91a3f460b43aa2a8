"""The filter for somebody else's training: rewards and ratings go in step by step, rewards to learn from come out.

A ``RewardStream`` is all that the adapters share. Where state-actions come again (``keys``) it remembers the ratings of
each; where none comes twice, a step's own ratings are all that is known of it, and a uniform sample of all rated steps
stands for the others.

What a row depends on: its own reward, sigma_m and ratings, the ratings of its own key, and the panel's statistics; no
other row, no other width and no order of raters makes a difference. The sigma_h of ``uard`` is tau, which reads these
statistics; that of other mitigations is of the row's ratings alone. The statistics, over all
state-actions in memory (with keys) or over the sample (without), are those of the mitigation's ``fit``: for most the
location and deviation of sigma_h, the scale of the reward, and the mean of the lowest ratings. They are measured when
1, 2, 4, ... 1024, then every 1024 further steps have been rated (``refresh``), no more often than after an eighth as
many steps as there are keys. A call first takes in the ratings of all its rows, then measures if that is due, and then
filters all its rows by the same numbers. So a batch is not the same as its rows one by one while the statistics still
move; what is known of a key is.

What is kept: 8 (5 + 3 K) bytes, K being the widest panel so far, for each of at most ``capacity`` steps without keys
and of at most ``max_keys`` keys; of more keys, those whose steps came longest ago are forgotten.
"""

from __future__ import annotations

import warnings
from collections import OrderedDict
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from uard import _checks
from uard.method.abstention import Abstention
from uard.method.feedback import Feedback
from uard.method.mitigations import Evidence, Explanation, LearningSignal, Mitigation, uard
from uard.ratings import state
from uard.ratings.aggregate import aggregate, nothing
from uard.ratings.memory import FeedbackTable, RatingSample

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

PATIENCE = 1000  # steps without any rating before we say so
MAX_RATERS = 1000  # what is kept of a step grows with the widest panel
MAX_KEYS = 100_000  # of a stream that is told nothing else
SHARE = 8  # statistics over n keys are measured after n / SHARE rated steps at the earliest: a step costs the same


class NeverRatedWarning(UserWarning):
    """Nobody has rated anything, so nothing is known and every reward is believed equally little."""


class KeysForgottenWarning(UserWarning):
    """There are more keys than are kept: the ratings of some state-actions are forgotten."""


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
    """Filters rewards as they come. Changed in place; ``save`` and ``load`` keep all that it knows.

    Examples:
        >>> stream = RewardStream()
        >>> reward = [4.0] + 9 * [-0.1]  # raters contest the first and agree on the others
        >>> ratings = [[-1.0, 2.0, 1.0]] + 9 * [[-0.1, -0.1, -0.1]]
        >>> for _ in range(30):
        ...     out = stream(reward, ratings, keys=range(10))
        >>> out.weight[:2].round(2).tolist(), out.reward[:2].round(2).tolist()
        ([0.0, 1.0], [-1.25, -0.1])

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
        refresh: int = 1024,
        max_keys: int = MAX_KEYS,
        seed: int = 0,
    ):
        """Start without any rating.

        Args:
            mitigation: What to do with a reward; ``uard()`` if left out. It must change rewards only.
            abstention: See the attribute.
            ddof: Of sigma_h.
            capacity: Rated steps kept where steps have no keys, >= 2.
            refresh: Rated steps after which the panel's statistics are measured again, >= 1 (more often at first).
            max_keys: Keys of which the ratings are kept, >= 1.
            seed: Of the sample of steps that are kept, >= 0.

        Raises:
            InvalidValueError: for a mitigation that needs more than rewards.
        """
        mitigation = uard() if mitigation is None else mitigation
        allowed = "a Mitigation, not its class or its name (see uard.method.mitigations.named)"
        self.mitigation = _checks.instance("mitigation", mitigation, Mitigation, allowed)
        if self.mitigation.acts_on != "reward":
            raise _checks.InvalidValueError(
                "mitigation.acts_on", self.mitigation.acts_on, "'reward': actions are not chosen here"
            )
        if self.mitigation.reads_truth:
            raise _checks.InvalidValueError(
                "mitigation", mitigation, "one that reads no true reward: it is not known here"
            )
        _checks.whole("ddof", ddof, high=1)
        _checks.whole("capacity", capacity, low=2)
        _checks.whole("refresh", refresh, low=1)
        _checks.whole("max_keys", max_keys, low=1)
        _checks.whole("seed", seed)
        if abstention is not None:
            _checks.instance("abstention", abstention, Abstention, "an Abstention")
        # What will never be rated again is known as well as it will ever be.
        self._of_single_visits = self.mitigation.without_prior()
        self.abstention = abstention
        self.rated = 0
        self.ddof, self._capacity, self._refresh, self._max_keys = ddof, capacity, refresh, max_keys
        self._table = FeedbackTable()
        self._sample = RatingSample(capacity, seed)
        self._slots: OrderedDict[Hashable, int] = OrderedDict()  # that came longest ago first
        self._steps, self._warned, self._forgets = 0, False, False
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
        sigma_m = self._sigma_m(sigma_m, len(checked))  # before anything is remembered
        visit, slots = self._observe(checked, ratings, keys)
        known = visit if slots is None else self.known(slots)
        return self._filter(checked, known, sigma_m, slots is not None, visit.count > 0)

    def observe(self, reward: Any, ratings: Any = None, keys: Sequence[Hashable] | None = None) -> Observed:
        """Remember the ratings of some steps; arguments and errors are those of ``__call__``."""
        return self._observe(_column("reward", reward), ratings, keys)

    def _observe(self, reward: Float[np.ndarray, " B"], ratings: Any, keys: Sequence[Hashable] | None) -> Observed:
        ratings = np.full((len(reward), 1), np.nan) if ratings is None else _checks.as_numpy("ratings", ratings)
        if ratings.ndim and ratings.shape[-1] > MAX_RATERS:
            allowed = f"({len(reward)}, K) with K <= {MAX_RATERS} raters"
            raise _checks.InvalidValueError("ratings.shape", ratings.shape, allowed)
        visit = aggregate(ratings, reward, ddof=self.ddof)
        slots = None if keys is None else self._places(keys, len(reward))
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
        if slots is None:
            self._sample.put(visit if len(rated) == len(reward) else visit.map(lambda x: x[rated]))
        else:
            self._table.observe(slots, visit, len(self._slots))
        return Observed(visit, slots)

    def _places(self, keys: Sequence[Hashable], count: int) -> Int[np.ndarray, " B"]:
        """Return where ``count`` state-actions are kept; those that came longest ago make room for new ones."""
        if isinstance(keys, str | bytes | Mapping) or not np.iterable(keys) or not hasattr(keys, "__len__"):
            raise _checks.InvalidValueError("keys", keys, "a list of keys, one per reward")
        if len(keys) != count:
            raise _checks.InvalidValueError("len(keys)", len(keys), f"{count}, one per reward")
        if count > self._max_keys:
            raise _checks.InvalidValueError("len(keys)", count, f"at most max_keys = {self._max_keys}")
        known = self._slots
        places: list[int] = []
        for i, key in enumerate(keys):
            try:
                place = known.get(key)
            except TypeError:
                raise _checks.InvalidValueError(f"keys[{i}]", key, "hashable, such as a number or a tuple") from None
            if place is None:
                known[key] = place = self._room()
            else:
                known.move_to_end(key)
            places.append(place)
        return np.array(places, np.int64)

    def _room(self) -> int:
        """Return a place for one more key."""
        if len(self._slots) < self._max_keys:
            return len(self._slots)
        if not self._forgets:
            self._forgets = True
            warnings.warn(
                f"more than max_keys = {self._max_keys} keys: from now on the ratings of those that came longest ago "
                "are forgotten. Are they keys that come again? Without keys a step is judged by its own ratings",
                KeysForgottenWarning,
                stacklevel=5,
            )
        _, place = self._slots.popitem(last=False)
        self._table.forget(place)
        return place

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
        reward = _column("reward", reward)
        _checks.same_shape("known.count", known.count, "reward", reward)
        return self._filter(reward, known, self._sigma_m(sigma_m, len(reward)), keyed, known.count > 0)

    def reads_sigma_m(self, known: Feedback, *, keyed: bool) -> Bool[np.ndarray, " B"]:
        """Return of which steps the filtered reward depends on sigma_m; arguments are those of ``filter``."""
        mitigation = self.mitigation if keyed else self._of_single_visits
        return mitigation.reads_sigma_m(known, self._measured(keyed))

    def _filter(
        self,
        reward: Float[np.ndarray, " B"],
        known: Feedback,
        sigma_m: Float[np.ndarray, " B"],
        keyed: bool,
        rated: Bool[np.ndarray, " B"],
    ) -> Filtered:
        zeros = np.zeros(len(reward))
        mitigation = self.mitigation if keyed else self._of_single_visits
        with np.errstate(over="ignore"):  # a weight may be one over infinity; what is learned is checked
            why = mitigation.explain(Evidence(reward, sigma_m, known), self._measured(keyed))
            out, weight, sigma_h, lam = _explained(mitigation, why, zeros)
        abstained = zeros > 0 if self.abstention is None else self.abstention.abstains(why.doubt, reward)
        return Filtered(out, reward, weight, sigma_h, sigma_m, lam, abstained, rated)

    def _sigma_m(self, values: Any, count: int) -> Float[np.ndarray, " B"]:
        if values is None:
            return np.zeros(count)
        values = _column("sigma_m", values, nonnegative=True)
        if len(values) != count:
            raise _checks.InvalidValueError("len(sigma_m)", len(values), f"{count}, one per reward")
        return values

    def known(self, slots: Int[np.ndarray, " B"]) -> Feedback:
        """Return what is known of state-actions at places that ``observe`` gave, (B,) arrays."""
        return self._table[slots]

    def visits(self, key: Hashable) -> float:
        """Return how many rated visits are known of a key; 0 of one that never came, or was forgotten."""
        place = self._slots.get(key)
        return 0.0 if place is None else self._table.visits(place)

    def counts(self, slots: Int[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
        """Return how many rated visits are known of state-actions at places that ``observe`` gave."""
        return self._table.counts(slots)

    def measurement(self, keyed: bool) -> int:
        """Return the number of the panel's statistics that rewards are filtered by now; they are measured if due.

        As long as it is the same, and nothing new is known of a state-action, its reward is filtered alike.

        Args:
            keyed: As for ``filter``.
        """
        self._measured(keyed)
        return self._measurement

    _measurement = 0  # of the class, for streams that were pickled before there was one

    def _measured(self, keyed: bool) -> Any:
        """Return the panel's statistics, measured again when enough has been rated since."""
        if self.rated >= self._due:
            self._forget_statistics()
            self._due = self.rated + max(1, min(self.rated, self._refresh), len(self._slots) // SHARE)
        if keyed not in self._statistics:
            every = self._table.every() if keyed else self._sample.feedback()
            if not len(every.count):
                every = nothing((1,), 1)
            self._statistics[keyed] = self.mitigation.fit(every, every.count > 0)
        return self._statistics[keyed]

    def _forget_statistics(self) -> None:
        self._statistics.clear()
        self._measurement += 1

    def save(self, path: str | Path) -> None:
        """Write all that it knows to a file of arrays and JSON, for ``load``; the old file stays whole until then.

        Raises:
            InvalidValueError: as for ``state``.
            OSError: the file cannot be written.
        """
        state.write(path, self.state())

    def state(self) -> state.State:
        """Return all that it knows as data, for ``restore``.

        The statistics are not in it: they are measured anew, here and there, so that both go on alike.

        Raises:
            InvalidValueError: a key is not made of numbers, text, bytes, truth values, None and tuples of such.
        """
        rows = {"table": self._table.rows(len(self._slots)), "sample": self._sample.rows()}
        plain = {name: getattr(self, f"_{name}") for name in (*OPTIONS, *COUNTERS)}
        plain |= {"ddof": self.ddof, "rated": self.rated, "chance": self._sample.chance}
        plain["mitigation"] = state.described(self.mitigation)
        plain["abstention"] = None if self.abstention is None else state.described(self.abstention)["fields"]
        plain["keys"] = [state.plain_key(key) for key in self._slots]
        slots = np.fromiter(self._slots.values(), np.int64, len(self._slots))
        self._forget_statistics()
        return state.State(plain, {**rows, "slots": slots})

    @classmethod
    def load(cls, path: str | Path, mitigation: Mitigation | None = None) -> RewardStream:
        """Return the stream that ``save`` wrote. Nothing in the file is executed or imported.

        Examples:
            >>> import tempfile
            >>> stream = RewardStream()
            >>> _ = stream([4.0], [[-1.0, 2.0, 1.0]])
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     stream.save(folder + "/stream.npz")
            ...     RewardStream.load(folder + "/stream.npz").rated
            1

        Args:
            path: The file.
            mitigation: Instead of the one in the file; needed for one that is not uard's own.

        Raises:
            InvalidValueError: the file is no such file, truncated or changed, or its mitigation must be given.
        """
        allowed = "a file that save wrote (pickles of version 0.1 are not read)"
        try:
            plain, arrays = state.read(path)
            kept = state.mitigation_of(plain["mitigation"])
            kind = str(plain["mitigation"]["kind"])
        except state.BROKEN as error:
            why = "" if "allow_pickle" in str(error) else f": {error}"  # do not say how to execute it
            raise _checks.InvalidValueError("path", str(path), f"{allowed}{why}") from None
        if mitigation is None and kept is None:
            raise _checks.InvalidValueError("mitigation", None, f"given: the file's, {kind}, is not one of uard's own")
        mitigation = kept if mitigation is None else mitigation
        try:
            rule = None if plain["abstention"] is None else Abstention(**plain["abstention"])
            options = {name: plain[name] for name in OPTIONS}
            stream = cls(mitigation, abstention=rule, ddof=plain["ddof"], **options)
            stream.restore(state.State(plain, arrays))
        except state.BROKEN as error:
            raise _checks.InvalidValueError("path", str(path), f"{allowed}: {error}") from None
        return stream

    def restore(self, kept: state.State) -> None:
        """Go on where the stream was whose ``state`` this is; it must have been built alike.

        Raises:
            InvalidValueError and others of ``uard.ratings.state.BROKEN``: it is no such state. The stream is then of no
                use any more.
        """
        plain, arrays = kept
        for name in ("rated", "steps", "due"):
            _checks.whole(name, plain[name])
        for name in ("warned", "forgets"):
            _checks.truth(name, plain[name])
        keys, slots = [state.key_of(key) for key in plain["keys"]], arrays["slots"]
        self._slots = OrderedDict(zip(keys, slots.tolist(), strict=True))
        self._table = FeedbackTable(arrays["table"])
        size = len(arrays["table"])
        if len(self._slots) != size or size > self._max_keys or sorted(self._slots.values()) != list(range(size)):
            raise _checks.InvalidValueError("keys", keys, f"{size} different ones, each with a row")
        self._sample.restore(arrays["sample"], plain["chance"])
        self.rated = plain["rated"]
        self._forget_statistics()
        for name in COUNTERS:
            setattr(self, f"_{name}", plain[name])


OPTIONS = ("capacity", "refresh", "max_keys")
COUNTERS = ("steps", "due", "warned", "forgets")


def _explained(mitigation: Mitigation, why: Any, zeros: Float[np.ndarray, " B"]) -> list[Float[np.ndarray, " B"]]:
    """Return reward, weight, sigma_h and lambda_t of what a mitigation, which may be anybody's, gave.

    Raises:
        InvalidValueError: it gave something else than finite numbers, one per step, or leaves steps out of learning.
    """
    name = type(mitigation).__name__
    _checks.instance(f"{name}.explain(...)", why, Explanation, "an Explanation")
    signal = _checks.instance(f"{name}.signal(...)", why.signal, LearningSignal, "a LearningSignal")
    if not _is_one(signal.sample_weight):
        raise _checks.InvalidValueError(
            "mitigation", mitigation, "one that changes rewards; this one leaves steps out of learning"
        )
    out = _checks.as_numpy(f"{name}.signal(...).reward", signal.reward)
    if out.shape != zeros.shape:
        raise _checks.InvalidValueError(f"{name}.signal(...).reward.shape", out.shape, f"{zeros.shape}, one per step")
    _checks.finite("filtered reward", out)
    columns = [out]
    for field in ("weight", "sigma_h", "lam"):
        values = _checks.as_numpy(f"{name}.explain(...).{field}", getattr(why, field))
        if values.shape not in (zeros.shape, ()):
            allowed = f"{zeros.shape}, one per step"
            raise _checks.InvalidValueError(f"{name}.explain(...).{field}.shape", values.shape, allowed)
        columns.append(values + zeros)
    if np.isnan(np.add.reduce(columns[1] + columns[2] + columns[3])):
        _checks.finite(f"{name}.explain(...)", np.stack(columns[1:]))
    return columns


def _is_one(sample_weight: Any) -> bool:
    return sample_weight == 1.0 if isinstance(sample_weight, float) else bool(np.all(sample_weight == 1.0))


def _column(field: str, values: Any, nonnegative: bool = False) -> Float[np.ndarray, " B"]:
    values = _checks.as_numpy(field, values)
    if values.ndim != 1:
        raise _checks.InvalidValueError(f"{field}.shape", values.shape, "(B,), one number per step")
    if nonnegative:
        _checks.nonnegative(field, values)
    _checks.moderate(field, values)
    return values
