"""One column has one role."""

from __future__ import annotations

from typing import Any

import pytest

from uard._checks import InvalidValueError
from uard.ratings.readers import from_columns
from uard.ratings.readers.columns import Wanted


@pytest.mark.parametrize(
    ("named", "field"),
    [
        ({"rater": "x", "item": "x"}, "item"),
        ({"item": "reward"}, "item"),
        ({"ratings": ("a", "a")}, "ratings"),
        ({"ratings": ("a", "reward")}, "ratings"),
        ({"ratings": ("a", "b"), "item": "b"}, "ratings"),
    ],
)
def test_a_column_named_for_two_roles_is_refused(named: dict[str, Any], field: str) -> None:
    with pytest.raises(InvalidValueError, match=f"^{field} = .*already named as"):
        Wanted("log", **named)


@pytest.mark.parametrize(
    ("named", "field"),
    [
        ({"reward": "score", "rating": "score"}, "rating"),
        ({"rating": "reward"}, "rating"),
        ({"rating": "worker"}, "rating"),
        ({"rater": "worker", "rating": "worker"}, "rating"),
        ({"item": "worker"}, "item"),
    ],
)
def test_a_column_of_answers_has_one_role(named: dict[str, Any], field: str) -> None:
    columns = {"task": ["a", "a"], "worker": ["ann", "bob"], "score": [1.0, 2.0], "reward": [1.0, 1.0]}
    with pytest.raises(InvalidValueError, match=f"^{field} = .*not already the"):
        from_columns(columns, **named)


def test_a_question_may_be_called_reward() -> None:
    columns = {"item": ["a", "a"], "annotator": ["ann", "bob"], "reward:::1": ["1", "1"]}
    assert from_columns(columns, rating="reward").ratings.tolist() == [[1.0, 1.0]]


def test_rows_may_be_divided_by_item_or_rater() -> None:
    assert Wanted("log", item="a", by="a").by == "a"
    assert Wanted("log", rater="a", by="a").by == "a"
