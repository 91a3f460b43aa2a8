"""Asking judges: who is asked beside whom, what belongs to each, and what is no failure but an error at once."""

import asyncio
import functools
import threading
from typing import NamedTuple

import numpy as np
import pytest

from uard import InvalidValueError
from uard.judges import Judge, JudgeError, JudgePanel, PanelReward, ask
from uard.judges.asking import copies_of

QUESTION = {"prompts": ["p"] * 2, "completions": ["a", "bb"]}


def length(completions, **question):
    return [float(len(text)) for text in completions]


# Beside each other


@pytest.mark.parametrize("wrapped", [False, True])
@pytest.mark.parametrize("limits", [{}, {"plain": 60, "later": 60}])
def test_async_judges_are_at_work_while_others_are_whatever_their_order(wrapped, limits):
    done = threading.Event()

    def plain(completions, **question):
        return [float(done.wait(60))] * len(completions)  # ends once the other has

    async def later(completions, **question):
        done.set()
        return [1.0] * len(completions)

    judges = {"plain": plain, "later": Judge(later) if wrapped else later}
    answers = ask(judges, QUESTION, limits)
    assert [(name, answer.given) for name, answer in answers.items()] == [("plain", [1, 1]), ("later", [1, 1])]
    assert answers["plain"].seconds < 50


def test_who_is_late_is_so_though_others_take_longer():
    ended = threading.Event()

    async def late(completions, **question):
        await asyncio.sleep(0.3)
        ended.set()
        return [1.0] * len(completions)

    def slow(completions, **question):
        return [float(ended.wait(60))] * len(completions)

    answers = ask({"slow": slow, "late": late}, QUESTION, {"late": 0.1})
    assert (answers["late"].given, answers["late"].late, answers["slow"].given) == (None, True, [1, 1])


# Lists of their own


class Pair(NamedTuple):
    texts: list
    name: str


def test_nobody_sees_what_a_judge_does_to_nested_columns():
    given = {
        "prompts": [([{"role": "user"}],)] * 2,
        "completions": ["a", "bb"],
        "messages": [[1, [2]], [3]],
        "meta": {"tags": ["x"], "of": Pair(["y"], "z")},
    }
    before = repr(given)

    def vandal(prompts, completions, messages, meta):
        prompts[0][0].clear()
        messages[0][1].append(9)
        meta["tags"].clear()
        meta["of"].texts.clear()
        return [0.0, 0.0]

    def sees(**question):
        return repr(question)

    assert ask({"vandal": vandal, "sees": sees}, given)["sees"].given == before
    assert repr(given) == before


def test_what_has_no_parts_is_not_copied():
    array, texts, inner = np.zeros(3), ("a", "b"), object()
    copy = copies_of({"array": array, "texts": texts, "inner": [inner, array]})()
    assert copy["array"] is array
    assert copy["texts"] is texts
    assert copy["inner"][0] is inner
    assert copy["inner"][1] is array


# What is an error at once


def gives(answer, asynchronous):
    async def later(**question):
        return answer

    return later if asynchronous else lambda **question: answer


@pytest.mark.parametrize("asynchronous", [False, True])
@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ([1.0], "number of scores of judge 'bad' = 1: must be 2, one per completion"),
        ([1.0, float("inf")], "score 1 of judge 'bad' = inf: must be a finite number"),
        (["seven", 1.0], "score 0 of judge 'bad' = 'seven': must be a finite number"),
        ({"a": 1.0}, "answer of judge 'bad' = .*must be a list of 2 numbers"),
    ],
)
def test_what_is_no_list_of_scores_is_an_error_whoever_asks(answer, message, asynchronous):
    function = gives(answer, asynchronous)
    for judge in (function, Judge(function), Judge(function, timeout=60), Judge(function, retries=1, cache=9)):
        reward = PanelReward({"bad": judge, "good": length}, JudgePanel.plain(["bad", "good"]))
        with pytest.raises(InvalidValueError, match=message):
            reward(**QUESTION)


def test_an_invalid_value_of_the_judges_own_is_what_it_raised():
    def own(**question):
        raise InvalidValueError("temperature", 3, "less")

    for judge in (own, Judge(own)):
        assert "InvalidValueError: temperature = 3" in str(ask({"own": judge}, QUESTION)["own"].error)


class Asked:
    def __call__(self, prompts, completions):
        return [0.0] * len(completions)


async def asked_later(prompts, completions):
    return [0.0] * len(completions)


def scores(prompts, completions):
    return [0.0] * len(completions)


def needs(completions, answer, **question):
    return [0.0] * len(completions)


@pytest.mark.parametrize("limits", [{}, {"bad": 60}])
@pytest.mark.parametrize("judge", [scores, asked_later, Asked(), Asked().__call__, functools.partial(scores), needs])
def test_a_signature_that_does_not_take_the_question_is_an_error_at_once(judge, limits):
    message = r"judge 'bad' = '\(.*\)': must be a function that can be called with the keywords prompts, completions, "
    advice = r"answer is not in the question" if judge is needs else r"add \*\*question"
    message += rf"solution \((got an unexpected|missing a required).*\): {advice}"
    for bad in (judge, Judge(judge, retries=3, backoff=60)):
        with pytest.raises(InvalidValueError, match=message):
            ask({"bad": bad, "good": length}, {**QUESTION, "solution": [1, 2]}, limits)


def test_a_type_error_from_within_is_what_it_raised():
    def adds(**question):
        return "a" + 1

    @functools.wraps(scores)
    def passes_on(*arguments, **question):
        return adds()

    for judge in (adds, passes_on, Judge(adds), functools.partial(max, 1)):
        error = ask({"bad": judge}, {**QUESTION, "solution": [1, 2]})["bad"].error
        assert "judge 'bad' raised on 2 completions: TypeError" in str(error)


def test_an_exception_that_cannot_say_what_it_is():
    class MuteError(Exception):
        def __str__(self):
            raise RuntimeError

    def judge(**question):
        raise MuteError

    error = ask({"bad": judge}, QUESTION)["bad"].error
    assert isinstance(error, JudgeError)
    assert str(error) == "judge 'bad' raised on 2 completions: MuteError"


def test_who_is_asked_beside_others_is_left_alone_when_one_is_unfit():
    begun, cancelled = threading.Event(), threading.Event()

    async def works(**question):
        begun.set()
        try:
            await asyncio.sleep(3600)
        finally:
            cancelled.set()

    def unfit(prompts, completions):
        raise AssertionError

    def waits(**question):
        begun.wait(60)
        return [0.0, 0.0]

    with pytest.raises(InvalidValueError, match="judge 'unfit'"):
        ask({"works": works, "waits": waits, "unfit": unfit}, {**QUESTION, "solution": [1, 2]})
    assert cancelled.wait(60)


async def counts_letters(completions, **question):
    return [float(len(text)) for text in completions]


@functools.wraps(counts_letters)
def waits_for_it(*arguments, **question):
    return asyncio.run(counts_letters(*arguments, **question))


class Client:
    async def __call__(self, completions, **question):
        return await counts_letters(completions)


@pytest.mark.parametrize(
    "judge",
    [waits_for_it, lambda **question: counts_letters(**question), functools.partial(Client()), Client().__call__],
)
def test_functions_around_async_ones_work_bare_and_in_a_judge(judge):
    for asked in (judge, Judge(judge), Judge(judge, timeout=60)):
        answers = ask({"judge": asked, "good": length}, QUESTION)
        assert answers["judge"].error is None
        assert list(answers["judge"].given) == [float(len(text)) for text in QUESTION["completions"]]


def test_a_function_of_one_completion_is_told_how_it_is_asked():
    with pytest.raises(InvalidValueError, match=r"is Judge\(function, per_sample=True\)"):
        ask({"bad": lambda prompt, completion: 1.0, "good": length}, QUESTION)


def test_a_page_of_text_is_not_a_message():
    def raises(**question):
        raise OSError("\x1b[31m" + "x" * 10**6)

    text = str(ask({"bad": raises, "good": length}, QUESTION)["bad"].error)
    assert len(text) < 1000
    assert text.isprintable()
