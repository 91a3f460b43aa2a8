"""What a mitigation knows of the ratings of some state-actions: each rater's, and the panel's together."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from uard.method.arrays import Array

if TYPE_CHECKING:
    from jaxtyping import Float


class ByRater(NamedTuple):
    """The ratings of each of K raters, one by one.

    Attributes:
        count: Number of ratings of this rater; 0 where they never rated, and there the other two mean nothing.
        mean: Their mean rating, in reward units.
        m2: Sum of squared deviations from it (Welford), in squared reward units.
    """

    count: Float[Array, "*batch K"]
    mean: Float[Array, "*batch K"]
    m2: Float[Array, "*batch K"]


class Feedback(NamedTuple):
    """What is known of the ratings of some state-actions, in reward units.

    ``uard.ratings.aggregate`` makes it from ratings. No entry depends on any other state-action.

    Attributes:
        count: Visits on which somebody rated; 0 where nobody ever did, and there the other fields mean nothing.
        mean: Mean over rated visits of the mean rating.
        lowest: Mean over rated visits of the lowest rating.
        sd: Mean over rated visits of the raters' standard deviation: sigma_h.
        proxy: Mean observed reward of the rated visits.
        raters: Number of raters who have rated here.
        by_rater: The ratings of each rater; None where a model has predicted the panel's ratings together.
    """

    count: Float[Array, "*batch"]
    mean: Float[Array, "*batch"]
    lowest: Float[Array, "*batch"]
    sd: Float[Array, "*batch"]
    proxy: Float[Array, "*batch"]
    raters: Float[Array, "*batch"]
    by_rater: ByRater | None = None

    def map(self, function: Callable[[Array], Array]) -> Feedback:
        """Return the feedback with a function applied to every array, to pick rows or to change their shape.

        Examples:
            >>> import numpy as np
            >>> from uard.ratings.aggregate import aggregate
            >>> feedback = aggregate(np.array([[1.0, 3.0], [0.0, 0.0]]), np.array([2.0, 0.0]))
            >>> feedback.map(lambda x: x[:1]).mean.tolist()
            [2.0]

        Args:
            function: It is given arrays (...) and, from ``by_rater``, (..., K).
        """
        by_rater = None if self.by_rater is None else ByRater._make(map(function, self.by_rater))
        return Feedback._make([*map(function, self[:6]), by_rater])
