"""Whatever is handed in: it is computed with, to finite numbers, or refused by an ``InvalidValueError``."""

from __future__ import annotations

import math
from contextlib import suppress
from decimal import Decimal
from typing import Any

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from uard import InvalidValueError
from uard.adapters.gymnasium import ReliabilityWrapper
from uard.adapters.steps import rows_of
from uard.method.mitigations import named
from uard.ratings.aggregate import aggregate
from uard.ratings.stream import Filtered, RewardStream

NAN = math.nan
QUICK = settings(max_examples=60, deadline=None)

atoms = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.integers(min_value=10**300),
    st.floats(),
    st.complex_numbers(),
    st.text(max_size=3),
    st.binary(max_size=3),
    st.decimals(places=2, min_value=-9, max_value=9).map(Decimal),
)
every_dtype = st.one_of(
    arrays.floating_dtypes(),
    arrays.integer_dtypes(),
    arrays.boolean_dtypes(),
    arrays.complex_number_dtypes(),
    arrays.unicode_string_dtypes(max_len=3),
    arrays.datetime64_dtypes(),
)
any_array = arrays.arrays(every_dtype, arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3))
anything = st.recursive(
    atoms | any_array,
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.tuples(inner, inner),
        st.dictionaries(st.integers() | st.text(max_size=2), inner, max_size=2),
        st.sets(st.integers(), max_size=3),
        st.lists(inner, max_size=2).map(iter),
    ),
    max_leaves=6,
)
numbers = st.floats(-1e100, 1e100)
MITIGATIONS = ["uard-0.1", "lcb", "mean-of-annotations", "worst-of-annotations", "uard-operator", "raw"]


def finite(out: Filtered) -> None:
    for name, column in out._asdict().items():
        assert column.shape == out.reward.shape, name
        assert not np.isnan(column).any(), name
    assert np.isfinite(out.reward).all()
    assert (out.weight >= 0).all()
    assert (out.weight <= 1).all()


@QUICK
@given(anything | st.lists(numbers, max_size=3), anything, anything, anything)
def test_a_stream_computes_or_names_what_it_cannot(reward, ratings, sigma_m, keys):
    for given_keys in (None, keys):
        with suppress(InvalidValueError):
            finite(RewardStream()(reward, ratings, sigma_m, given_keys))


@QUICK
@given(any_array, any_array, st.none() | any_array, st.integers(-1, 3) | st.floats())
def test_aggregate_computes_or_names_what_it_cannot(ratings, proxy, mask, ddof):
    try:
        feedback = aggregate(ratings, proxy, mask, ddof)
    except InvalidValueError:
        return
    for part in (*feedback[:6], *feedback.by_rater):
        assert np.isfinite(part).all()


@QUICK
@given(st.dictionaries(st.integers(0, 2), anything, max_size=3))
def test_rows_are_of_numbers_or_named(entries):
    try:
        rows = rows_of(entries, 3)
    except InvalidValueError:
        return
    assert rows is None or (rows.dtype == float and rows.shape[0] == 3 and not np.isinf(rows).any())


class Gives(gymnasium.Env[Any, Any]):
    """Gives the same reward and ratings at every step."""

    observation_space = action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, reward: Any, ratings: Any):
        self.reward, self.ratings = reward, ratings

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        return 1, self.reward, False, False, {"ratings": self.ratings}


@QUICK
@given(numbers | anything, anything)
def test_an_adapter_gives_a_finite_reward_or_names_what_it_cannot(reward, ratings):
    env = ReliabilityWrapper(Gives(reward, ratings))
    env.reset()
    with suppress(InvalidValueError):
        for _ in range(2):
            assert math.isfinite(env.step(1)[1])


# --- rows do not influence each other, whatever their size ----------------------------------------------------------


@st.composite
def steps_of_any_size(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    rows, raters = draw(st.integers(1, 6)), draw(st.integers(1, 5))
    reward = draw(st.lists(numbers, min_size=rows, max_size=rows))
    cells = draw(st.lists(numbers | st.just(NAN), min_size=rows * raters, max_size=rows * raters))
    return np.array(reward), np.array(cells).reshape(rows, raters)


@QUICK
@given(steps_of_any_size(), st.sampled_from(MITIGATIONS), st.integers(0, 20), st.booleans(), st.randoms())
def test_sigma_h_of_a_row_is_its_own_and_everything_is_finite(steps, name, padding, keyed, chance):
    """In another order, beside other rows, and among raters who never answer."""
    reward, ratings = steps
    order = chance.sample(range(len(reward)), len(reward))

    def out(rows: list[int], width: int) -> Filtered:
        padded = np.pad(ratings[rows], ((0, 0), (0, width)), constant_values=NAN)
        found = RewardStream(named(name))(reward[rows], padded, keys=rows if keyed else None)
        finite(found)
        return found

    together = out(list(range(len(reward))), 0).sigma_h
    scale = np.abs(np.column_stack([reward, np.nan_to_num(ratings)])).max(1)
    limit = 1e-12 * scale + 1e-300
    assert (np.abs(out(order, padding).sigma_h - together[order]) <= limit[order]).all()
    for i in range(len(reward)):
        assert abs(out([i], padding).sigma_h[0] - together[i]) <= limit[i]


@given(st.lists(st.lists(st.integers(-8, 8) | st.none(), min_size=1, max_size=6), min_size=1, max_size=5))
def test_rows_of_different_widths_are_what_each_is_alone(entries):
    together = rows_of(dict(enumerate(entries)), len(entries))
    assert together.shape == (len(entries), max(map(len, entries)))
    feedback = aggregate(together, np.zeros(len(entries)))
    for i, entry in enumerate(entries):
        alone = aggregate(rows_of({0: entry}, 1), np.zeros(1))
        for mine, theirs in zip(feedback.map(lambda x, i=i: x[i])[:6], alone[:6], strict=True):
            assert mine == pytest.approx(theirs[0], rel=1e-12, abs=1e-12)
