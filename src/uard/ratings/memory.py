"""What a stream keeps of ratings: a table of state-actions that come again, or a sample of steps that do not."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from uard import _checks
from uard.method.feedback import ByRater, Feedback
from uard.ratings.aggregate import empty_rows, from_rows, merged, to_rows

if TYPE_CHECKING:
    from jaxtyping import Float, Integer


WAIT = 1024  # rated steps that a sample is shown before it takes them in


class _Rows:
    """Feedback by number, as rows (see ``uard.ratings.aggregate.to_rows``); grows in rows and in raters.

    Attributes:
        values: The rows, some of them not used yet. A column's numbers are neighbours in memory, because statistics
            are taken over columns.
        filled: How many are used.
        raters: K, for which there are columns.
    """

    def __init__(self, values: Float[np.ndarray, "n width"] | None = None) -> None:
        rows = empty_rows((0,), 1) if values is None else _checked(values)
        self.values: Float[np.ndarray, "n width"] = np.asfortranarray(rows)
        self.filled, self.raters = len(rows), (rows.shape[1] - 5) // 3

    def feedback(self) -> Feedback:
        """Return all of it, (n,) arrays."""
        return from_rows(self.values[: self.filled])

    def grow(self, size: int) -> None:
        """Make room for so many rows."""
        self.filled = max(self.filled, size)
        room = len(self.values)
        if size > room:
            more = np.zeros((max(size, 2 * room, 64) - room, self.values.shape[1]), order="F")
            self.values = np.concatenate([self.values, more])

    def fitted(self, visit: Float[np.ndarray, "B any"]) -> Float[np.ndarray, "B width"]:
        """Return the rows of visits with this width; raters who have not been met before get columns."""
        raters = (visit.shape[1] - 5) // 3
        if raters == self.raters:
            return visit
        if raters < self.raters:
            return _widened(visit, self.raters)
        self.values, self.raters = np.asfortranarray(_widened(self.values, raters)), raters
        return visit


def _checked(rows: Float[np.ndarray, "n width"]) -> Float[np.ndarray, "n width"]:
    """Return rows that come from a file.

    Raises:
        InvalidValueError: they are not what a stream may hold.
    """
    if rows.ndim != 2 or rows.dtype != np.float64 or rows.shape[1] < 8 or rows.shape[1] % 3 != 2:
        raise _checks.InvalidValueError("rows.shape", rows.shape, "(n, 5 + 3 K), of doubles")
    _checks.finite("rows", rows)
    known = from_rows(rows)
    assert known.by_rater is not None
    for name, values in (("count", known.count), ("sd", known.sd), *known.by_rater._asdict().items()):
        if name != "mean":
            _checks.nonnegative(name, values)
    return rows


def _widened(rows: Float[np.ndarray, "B any"], raters: int) -> Float[np.ndarray, "B width"]:
    """Return rows with columns for more raters, who have rated nothing."""
    feedback = from_rows(rows)
    each = feedback.by_rater
    assert each is not None
    more = ((0, 0), (0, raters - each.count.shape[1]))
    return to_rows(feedback._replace(by_rater=ByRater._make(np.pad(x, more) for x in each)))


class FeedbackTable:
    """Feedback of state-actions by number. Changed in place; grows in rows and in raters.

    Examples:
        >>> from uard.ratings.aggregate import aggregate
        >>> table = FeedbackTable()
        >>> table.observe(np.array([0, 0]), aggregate(np.array([[1.0], [3.0]]), np.zeros(2)), size=1)
        >>> table[np.array([0])].mean.tolist()
        [2.0]
    """

    def __init__(self, rows: Float[np.ndarray, "n width"] | None = None) -> None:
        """Start with no state-action, or with the ``rows`` of another table.

        Raises:
            InvalidValueError: the rows are not what a table may hold.
        """
        self._rows = _Rows(rows)

    def rows(self, size: int) -> Float[np.ndarray, "n width"]:
        """Return the rows of that many state-actions."""
        self._rows.grow(size)
        return self._rows.values[:size]

    def forget(self, slot: int) -> None:
        """Make a state-action one that nobody has rated."""
        self._rows.values[slot] = 0.0

    def observe(self, slots: Integer[np.ndarray, " B"], visit: Feedback, size: int) -> None:
        """Take in visits, one after the other.

        Args:
            slots: Numbers of the visited state-actions; one may come several times.
            visit: (B,) arrays, as ``aggregate`` gives them.
            size: State-actions so far: all numbers are below it.
        """
        rows = self._rows
        rows.grow(size)
        new, left = rows.fitted(to_rows(visit)), visit.count.nonzero()[0]
        if len(left) == 1:  # without copies of the others
            place, now = int(slots[left[0]]), slice(int(left[0]), int(left[0]) + 1)
            known = rows.values[place : place + 1]
            known[...] = merged(known, new[now], visit.count[now])
            return
        while left.size:  # a state-action that was visited twice takes two rounds
            places, now = slots[left], left
            if len(set(places.tolist())) < left.size:
                now = left[np.sort(np.unique(places, return_index=True)[1])]
                places = slots[now]
            rows.values[places] = merged(rows.values[places], new[now], visit.count[now])
            left = np.setdiff1d(left, now) if now.size < left.size else left[:0]

    def visits(self, slot: int) -> float:
        """Return how often a state-action was visited and rated."""
        return float(self._rows.values[slot, 0])

    def counts(self, slots: Integer[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
        """Return how often some state-actions were visited and rated."""
        return self._rows.values[:, 0][slots]

    def __getitem__(self, slots: Integer[np.ndarray, " B"]) -> Feedback:
        """Return what is known of some state-actions, (B,) arrays."""
        return from_rows(self._rows.values[slots])

    def every(self) -> Feedback:
        """Return what is known of all state-actions so far."""
        return self._rows.feedback()


class RatingSample:
    """A uniform sample of rated steps [Vitter 1985, algorithm R]. Changed in place.

    Examples:
        >>> from uard.ratings.aggregate import aggregate
        >>> sample = RatingSample(capacity=2, seed=0)
        >>> sample.put(aggregate(np.ones((9, 1)), np.zeros(9)))
        >>> sample.feedback().mean.tolist()
        [1.0, 1.0]
    """

    def __init__(self, capacity: int, seed: int):
        """Start with none; ``capacity`` is how many are kept."""
        self._capacity, self._random = capacity, np.random.default_rng(seed)
        self._rows, self._seen = _Rows(), 0
        self._waiting: list[np.ndarray] = []  # rows that were shown but not taken in: many at once cost what one does
        self._wait = 0  # how many

    def rows(self) -> Float[np.ndarray, "n width"]:
        """Return the rows that were kept."""
        self._take_in()
        return self._rows.values[: self._rows.filled]

    @property
    def chance(self) -> dict[str, Any]:
        """How many steps it was shown, and the state of its random numbers."""
        self._take_in()
        return {"seen": self._seen, "random": self._random.bit_generator.state}

    def __setstate__(self, kept: dict[str, Any]) -> None:
        """Take what was pickled, also before steps waited."""
        self._waiting, self._wait = [], 0
        self.__dict__.update(kept)

    def restore(self, rows: Float[np.ndarray, "n width"], chance: dict[str, Any]) -> None:
        """Go on where another with these ``rows`` and this ``chance`` was.

        Raises:
            InvalidValueError: the rows, or how many were shown, are not what a sample may hold.
            KeyError, TypeError, ValueError: the random numbers' state is none.
        """
        _checks.whole("seen", chance["seen"])
        if len(rows) != min(chance["seen"], self._capacity):
            raise _checks.InvalidValueError("number of rows", len(rows), "as many as were seen, or can be kept")
        self._rows, self._seen = _Rows(rows), chance["seen"]
        self._waiting, self._wait = [], 0
        self._random.bit_generator.state = chance["random"]

    def put(self, visit: Feedback) -> None:
        """Show it rated steps, (B,) arrays as ``aggregate`` gives them."""
        new = to_rows(visit)  # a copy: what the visit holds is its owner's
        if self._waiting and self._waiting[0].shape[1] != new.shape[1]:
            self._take_in()
        self._waiting.append(new)
        self._wait += len(new)
        if self._wait >= WAIT:
            self._take_in()

    def _take_in(self) -> None:
        """Give the steps that wait a place, or none."""
        if not self._waiting:
            return
        new = self._waiting[0] if len(self._waiting) == 1 else np.concatenate(self._waiting)
        self._waiting, self._wait = [], 0
        rows, size = self._rows, len(new)
        places = np.arange(rows.filled, rows.filled + size)
        free = min(size, self._capacity - rows.filled)
        if free < size:
            places[free:] = self._random.integers(0, self._seen + np.arange(free, size) + 1)
        rows.grow(rows.filled + free)
        kept = places < self._capacity
        new = rows.fitted(new)  # before the table is written to: it may get columns
        rows.values[places[kept]] = new[kept]  # where two take one place, NumPy leaves the later
        self._seen += size

    def feedback(self) -> Feedback:
        """Return what is known of the steps that were kept, (n,) arrays."""
        self._take_in()
        return self._rows.feedback()
