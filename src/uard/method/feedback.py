"""What a mitigation knows of the ratings of some state-actions: who said what, and what the panel said together."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from uard.method.arrays import Array


class ByRater(NamedTuple):
    """What each of K raters said; arrays (..., K).

    Attributes:
        count: Ratings of this rater; 0 where they never rated, and there the other two mean nothing.
        mean: Their mean rating, in reward units.
        m2: Sum of squared deviations from it (Welford), in squared reward units.
    """

    count: Array
    mean: Array
    m2: Array


class Feedback(NamedTuple):
    """What is known of the ratings of some state-actions; arrays (...), in reward units.

    ``uard.ratings.aggregate`` makes it from ratings. No entry depends on any other state-action.

    Attributes:
        count: Visits on which somebody rated; 0 where nobody ever did, and there the other fields mean nothing.
        mean: Mean over rated visits of the mean rating.
        lowest: Mean over rated visits of the lowest rating.
        sd: Mean over rated visits of the raters' standard deviation: sigma_h.
        proxy: Mean observed reward of the rated visits.
        raters: Number of raters heard here.
        by_rater: Who said what; None where a model has predicted what the panel says together.
    """

    count: Array
    mean: Array
    lowest: Array
    sd: Array
    proxy: Array
    raters: Array
    by_rater: ByRater | None = None

    def map(self, function: Callable[[Array], Array]) -> Feedback:
        """Return the feedback with a function applied to every array, to pick rows or to change their shape.

        The function sees arrays (...) and, from ``by_rater``, (..., K).
        """
        by_rater = None if self.by_rater is None else ByRater(*map(function, self.by_rater))
        return Feedback(*(function(x) for x in self[:6]), by_rater)
