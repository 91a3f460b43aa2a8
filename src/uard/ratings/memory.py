"""What a stream keeps of ratings: a table of state-actions that come again, or a uniform sample of steps that do not."""

from __future__ import annotations

import numpy as np

from uard.method.feedback import ByRater, Feedback
from uard.ratings.aggregate import aggregate, empty_rows, from_rows, merged, to_rows


class FeedbackTable:
    """Feedback of state-actions by number. Changed in place; grows in rows and in raters."""

    def __init__(self) -> None:
        """Start with no state-action."""
        self._rows, self._raters, self._filled = empty_rows((0,), 1), 1, 0

    def observe(self, slots: np.ndarray, visit: Feedback, size: int) -> None:
        """Take in visits, one after the other.

        Args:
            slots: (B,), numbers of the visited state-actions; one may come several times.
            visit: (B,) arrays, as ``aggregate`` gives them.
            size: State-actions so far: all numbers are below it.
        """
        assert visit.by_rater is not None
        self._grow(size, max(visit.by_rater.count.shape[1], self._raters))
        new, left = to_rows(_widened(visit, self._raters)), np.flatnonzero(visit.count)
        while left.size:  # a state-action that was visited twice takes two rounds
            now = left if left.size == 1 else left[np.sort(np.unique(slots[left], return_index=True)[1])]
            self._rows[slots[now]] = merged(self._rows[slots[now]], new[now], visit.count[now])
            left = np.setdiff1d(left, now) if now.size < left.size else left[:0]

    def __getitem__(self, slots: np.ndarray) -> Feedback:
        """Return what is known of some state-actions, (B,) arrays."""
        return from_rows(self._rows[slots])

    def every(self) -> Feedback:
        """Return what is known of all state-actions so far."""
        return from_rows(self._rows[: self._filled])

    def _grow(self, size: int, raters: int) -> None:
        self._filled = max(self._filled, size)
        if raters > self._raters:
            self._rows = to_rows(_widened(from_rows(self._rows), raters))
            self._raters = raters
        room = len(self._rows)
        if size > room:
            extra = empty_rows((max(size, 2 * room, 64) - room,), raters)
            self._rows = np.concatenate([self._rows, extra])


def _widened(feedback: Feedback, raters: int) -> Feedback:
    """Return feedback (B,) with columns for more raters, who have said nothing."""
    each = feedback.by_rater
    assert each is not None
    more = raters - each.count.shape[1]
    return feedback._replace(by_rater=ByRater(*(np.pad(x, ((0, 0), (0, more))) for x in each))) if more else feedback


class RatingSample:
    """A uniform sample of rated steps [Vitter 1985, algorithm R]. Changed in place."""

    def __init__(self, capacity: int, seed: int):
        """Start with none; ``capacity`` is how many are kept."""
        self._capacity, self._random = capacity, np.random.default_rng(seed)
        self._ratings, self._proxy = np.zeros((0, 1)), np.zeros(0)
        self._filled, self._seen = 0, 0

    def put(self, ratings: np.ndarray, proxy: np.ndarray) -> None:
        """Show it rated steps: ratings (B, K) with NaN where one is missing, observed rewards (B,)."""
        free = min(len(proxy), self._capacity - self._filled)
        self._grow(self._filled + free, ratings.shape[1])
        places = np.arange(self._filled, self._filled + len(proxy))
        if free < len(proxy):
            places[free:] = self._random.integers(0, self._seen + np.arange(free, len(proxy)) + 1)
        for i in np.flatnonzero(places < self._capacity):  # in order: a later one may take an earlier one's place
            self._ratings[places[i]] = np.nan
            self._ratings[places[i], : ratings.shape[1]] = ratings[i]
            self._proxy[places[i]] = proxy[i]
        self._filled += free
        self._seen += len(proxy)

    def feedback(self, ddof: int) -> Feedback:
        """Return what was said of the steps that were kept, (n,) arrays."""
        return aggregate(self._ratings[: self._filled], self._proxy[: self._filled], ddof=ddof)

    def _grow(self, rows: int, raters: int) -> None:
        have, columns = self._ratings.shape
        more = max(rows, 2 * have, 64) - have if rows > have else 0
        if more or raters > columns:
            width = ((0, more), (0, max(0, raters - columns)))
            self._ratings = np.pad(self._ratings, width, constant_values=np.nan)
            self._proxy = np.pad(self._proxy, width[0])
