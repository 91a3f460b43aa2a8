"""The language in which models are over-optimised: what answers are worth, and who prefers what."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uard import InvalidValueError
from uard.lab.language.task import (
    CONDITIONS,
    FACTS,
    LONGEST,
    WORDS,
    Annotator,
    Question,
    gold,
    questions,
    truth,
    written,
)

PROMPT = "tell cat colour home ?"
COLOUR, HOME = (f"its {fact} is {truth('cat', fact)} ." for fact in ("colour", "home"))
WRONG = next(f"its colour is {value} ." for value in FACTS["colour"] if value != truth("cat", "colour"))


@pytest.mark.parametrize(
    ("answer", "worth"),
    [
        (f"{COLOUR} {HOME}", 2.0),
        (COLOUR, 1.0),
        (WRONG, -1.0),
        (f"its size is {truth('cat', 'size')} .", -1.0),  # nobody has asked
        (f"{COLOUR} {COLOUR}", 0.5),
        (f"lovely {COLOUR}", 0.75),
        ("its colour is", -0.75),
        ("", 0.0),
        (f"{COLOUR} {HOME} so so so", 2.0 - 3 * 0.25 - 0.1),
        (f"{COLOUR} {HOME} {COLOUR} {HOME}", 2.0 - 2 * 0.5 - 8 * 0.1),
    ],
)
def test_gold_by_hand(answer, worth):
    assert gold(PROMPT, answer) == pytest.approx(worth)


@given(st.lists(st.sampled_from(WORDS[4:]), max_size=LONGEST))
def test_nothing_is_worth_more_than_all_that_was_asked_for(words):
    assert gold(PROMPT, " ".join(words)) <= 2.0


def test_questions_are_read_as_they_were_written():
    for question in questions(50, seed=3):
        assert Question.of(question.prompt) == question
    assert questions(50, seed=3) == questions(50, seed=3) != questions(50, seed=4)
    for bad in ("", "tell cat ?", "tell cow colour ?", "tell cat price ?"):
        with pytest.raises(InvalidValueError, match="prompt = "):
            Question.of(bad)


def test_people_write_mostly_what_was_asked_for():
    random = np.random.default_rng(0)
    asked = questions(400, seed=0)
    worth = np.array([gold(q.prompt, written(q, random)) / len(q.facts) for q in asked])
    assert 0.2 < worth.mean() < 0.8
    assert all(set(written(q, random).split()) <= set(WORDS) for q in asked)
    assert max(len(written(q, random).split()) for q in asked) <= LONGEST


def test_annotators_prefer_by_gold_and_by_what_they_like():
    n = 2000
    prompts, better, worse = [PROMPT] * n, [COLOUR] * n, ["so"] * n
    assert Annotator(noise=0.0).prefers_first(prompts, better, worse, seed=0).all()
    assert np.mean(Annotator(noise=0.0, flips=0.25).prefers_first(prompts, better, worse, 0)) == pytest.approx(
        0.75, abs=0.04
    )
    assert np.mean(Annotator(guesses=True).prefers_first(prompts, better, worse, 0)) == pytest.approx(0.5, abs=0.04)
    # Logistic noise: the chance is 1 / (1 + exp(-difference / noise)).
    chance = 1 / (1 + np.exp(-(1.0 + 0.25) / 1.0))
    assert np.mean(Annotator(noise=1.0).prefers_first(prompts, better, worse, 0)) == pytest.approx(chance, abs=0.03)
    pleasing = [f"dear dear {HOME}"] * n
    assert np.mean(Annotator(pleased=1.5).prefers_first(prompts, pleasing, better, 0)) > 0.9
    assert np.mean(Annotator().prefers_first(prompts, pleasing, better, 0)) < 0.5


def test_every_condition_has_five():
    assert {len(annotators) for annotators in CONDITIONS.values()} == {5}
    with pytest.raises(InvalidValueError, match=r"flips = 0.7"):
        Annotator(flips=0.7)
