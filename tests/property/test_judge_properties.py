"""Whatever judges answer: a named error or finite rewards, and never a number that depends on the judges' order."""

import json
import warnings
from decimal import Decimal

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uard import InvalidValueError
from uard.adapters.trl import JudgeError, UncertaintyDiscountedReward
from uard.judges import Scale, as_scores

numbers = st.floats(allow_nan=True, allow_infinity=False) | st.integers(-(10**3), 10**3) | st.none() | st.booleans()
oddities = st.sampled_from(["1", b"1", [1.0], {}, 10**400, -(10**400), 1j, Decimal(1), np.inf, object(), np.array([1])])
answers = (
    st.lists(numbers | oddities, max_size=4)
    | st.lists(numbers, min_size=3, max_size=3)
    | hnp.arrays(
        st.sampled_from([float, np.float16, int, bool, object, "U2"]), hnp.array_shapes(max_dims=2, max_side=3)
    )
    | st.dictionaries(st.integers(0, 2), numbers)
    | st.sampled_from([None, "abc", b"abc", 3, 3.0, {1, 2, 3}, range(3), iter([1, 2, 3]), np.float64(1), ...])
)
ordinary = st.floats(-1e3, 1e3) | st.integers(-5, 5).map(float)
scores = ordinary | st.none() | st.sampled_from([1e9, -1e200, 1.7e308, -1.7e308, 5e-324, 0.0])


def says(answer):
    return lambda **question: answer


def reward_of(judges, **settings_):
    return UncertaintyDiscountedReward({f"judge {k}": judge for k, judge in enumerate(judges)}, **settings_)


@given(answers, st.integers(0, 4))
def test_an_answer_is_scores_or_a_named_error(answer, size):
    try:
        out = as_scores("any", answer, size)
    except InvalidValueError as error:
        if "judge 'any'" not in error.field:
            raise
    else:
        assert out.shape == (size,)
        assert not np.isinf(out).any()


@settings(deadline=None)
@given(st.lists(answers, min_size=2, max_size=4), answers | st.none())
def test_a_reward_is_finite_or_a_named_error(of_judges, of_ensemble):
    reward = reward_of(map(says, of_judges), sigma_m=None if of_ensemble is None else says(of_ensemble))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        try:
            rewards = reward(["p", "p", "q"], ["a", "b", "c"])
        except (InvalidValueError, JudgeError):
            return
    missing = np.isnan(reward.last.scores).all(1)
    assert [value is None for value in rewards] == missing.tolist()
    assert np.isfinite([value for value in rewards if value is not None]).all()


@st.composite
def batches(draw):
    """Some batches of scores of 2 to 4 judges for 6 completions of 2 prompts."""
    judges, number = draw(st.integers(2, 4)), draw(st.integers(1, 3))
    columns = st.lists(st.lists(scores, min_size=6, max_size=6), min_size=judges, max_size=judges)
    return [draw(columns) for _ in range(number)]


def rewards_of(columns, order, **settings_):
    """The rewards of each batch, with the judges in some order."""
    columns = [[batch[k] for k in order] for batch in columns]
    reward = reward_of([lambda k=k, **_: now[k] for k in range(len(order))], **settings_)
    out = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        for now in columns:  # noqa: B007
            out.append([np.nan if x is None else x for x in reward(["p"] * 3 + ["q"] * 3, ["c"] * 6)])
    return np.array(out), reward


@settings(deadline=None)
@given(batches(), st.randoms(use_true_random=False))
def test_rewards_are_finite_and_do_not_depend_on_the_order_of_the_judges(columns, random):
    order = list(range(len(columns[0])))
    out, reward = rewards_of(columns, order)
    unscored = np.array([[all(column[i] is None for column in batch) for i in range(6)] for batch in columns])
    np.testing.assert_array_equal(np.isnan(out), unscored)
    assert reward.tally.unscored == unscored.sum()
    random.shuffle(order)
    other, _ = rewards_of(columns, order)
    np.testing.assert_allclose(out, other, rtol=1e-6, atol=1e-6)


@given(st.lists(st.lists(scores.filter(lambda x: x is not None), max_size=9), max_size=6))
def test_a_scale_is_finite_and_does_not_depend_on_the_order_within_a_call(calls):
    scale, reverse = Scale(), Scale()
    for call in calls:
        found = scale.observe(np.array(call))
        again = reverse.observe(np.array(call[::-1]))
        assert sorted(found) == sorted(again)
    assert np.isfinite([scale.location, scale.deviation]).all()
    assert scale.deviation >= 0
    assert scale.location == pytest.approx(reverse.location, rel=1e-6, abs=1e-6 * scale.deviation)
    assert scale.deviation == pytest.approx(reverse.deviation, rel=1e-6)


plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
)


def places(content, path=()):
    """Every place in nested lists and dictionaries."""
    parts = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for name, part in parts:
        yield (*path, name)
        yield from places(part, (*path, name))


@settings(deadline=None)
@given(st.data())
def test_a_changed_file_is_refused_or_gives_finite_rewards(tmp_path_factory, data):
    file = tmp_path_factory.mktemp("files") / "reward.json"
    columns = [[1.0, 2.0, 4.0], [None, 2.0, 1.0]]
    reward = reward_of(map(says, columns))
    reward(["p"] * 3, ["c"] * 3)
    reward.save(file)
    content = json.loads(file.read_text())
    *way, last = data.draw(st.sampled_from(list(places(content))))
    where = content
    for name in way:
        where = where[name]
    where[last] = data.draw(plain)
    file.write_text(json.dumps(content))
    other = reward_of(map(says, columns))
    try:
        other.load(file)
    except InvalidValueError:
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        assert np.isfinite(other(["p"] * 3, ["c"] * 3)).all()
