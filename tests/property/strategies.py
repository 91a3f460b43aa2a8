"""What the filter may meet: rewards, disagreements, parameters, and tables of what raters said."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from uard import Feedback, ReliabilityFilter, RewardDiscounting
from uard.method.weights import FORMS
from uard.ratings.aggregate import aggregate

fractions = st.floats(0.0, 1.0)
sigmas = st.floats(0.0, 100.0)
values = st.floats(-1e3, 1e3)
positive = st.floats(1e-3, 1e3)
shifts = st.integers(-64, 64).map(float)
scales = st.sampled_from([2.0**-7, 0.125, 0.3, 3.0, 10.0, 1024.0])


def filters(form: str | None = None, least: float = 0.0) -> st.SearchStrategy[ReliabilityFilter]:
    forms = st.sampled_from(FORMS) if form is None else st.just(form)
    share = st.floats(least, 1.0)
    return st.builds(ReliabilityFilter, lam=st.floats(least, 10.0), alpha=share, beta=share, form=forms)


def mitigations(**fixed: object) -> st.SearchStrategy[RewardDiscounting]:
    options = {
        "filter": filters(),
        "kappa": st.floats(0.0, 50.0),
        "unrated_weight": fractions,
        "prior_count": st.just(0.0) | st.floats(1e-3, 5.0),
        "proxy_is_rater": st.booleans(),
        "standardise": st.booleans(),
    }
    return st.builds(RewardDiscounting, **{k: v for k, v in options.items() if k not in fixed}, **_just(fixed))


def _just(fixed: dict[str, object]) -> dict[str, st.SearchStrategy[object]]:
    return {k: st.just(v) for k, v in fixed.items()}


@st.composite
def tables(draw: st.DrawFn) -> Feedback:
    """Feedback on a few state-actions, from ratings in eighths so that shifts are exact; some are unrated."""
    cells, raters = draw(st.integers(2, 6)), draw(st.integers(1, 4))
    eighths = st.integers(-80, 80).map(lambda i: i / 8)
    numbers = np.array(draw(st.lists(eighths, min_size=cells * (raters + 1), max_size=cells * (raters + 1))))
    ratings, proxy = numbers[cells:].reshape(cells, raters), numbers[:cells]
    count = np.array(draw(st.lists(st.integers(0, 20), min_size=cells, max_size=cells)), float)
    return aggregate(ratings, proxy)._replace(count=count)
