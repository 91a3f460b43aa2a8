"""One judge and how it is asked: again when it fails, within limits, not twice the same."""

import asyncio
import contextlib
import importlib
import pickle
import re
import threading
import time

import numpy as np
import pytest

from uard import InvalidValueError
from uard.judges import Judge, ask
from uard.judges.judge import HANGING


def scores_of(judge, completions, **columns):
    """Ask as a trainer does, an async judge too."""
    answer = ask({"judge": judge}, {"prompts": ["p"] * len(completions), "completions": completions, **columns})[
        "judge"
    ]
    if answer.error is not None:
        raise answer.error
    return answer.given


def length(prompt, completion, **question):
    return None if completion == "?" else len(completion)


async def length_later(prompt, completion, **question):
    await asyncio.sleep(0.01)
    return length(prompt, completion)


def lengths(prompts, completions, **question):
    return [length("p", text) for text in completions]


async def lengths_later(prompts, completions, **question):
    await asyncio.sleep(0.01)
    return lengths(prompts, completions)


EVERY = {length: True, length_later: True, lengths: False, lengths_later: False}


@pytest.mark.parametrize("options", [{}, {"cache": 10}, {"concurrent": 2}, {"retries": 1}, {"timeout": 20}])
@pytest.mark.parametrize("function", EVERY)
def test_all_kinds_give_the_same(function, options):
    judge = Judge(function, per_sample=EVERY[function], **options)
    for _ in range(2):
        assert scores_of(judge, ["a", "?", "bcd"]) == pytest.approx([1, np.nan, 3], nan_ok=True)
    assert judge.__name__ == function.__name__


def test_columns_go_with_their_rows():
    asked = []

    def sees(prompt, completion, solution, step, **question):
        asked.append((prompt, completion, solution, step))
        return 1

    judge = Judge(sees, per_sample=True, cache=10)
    judge(["p", "q", "p"], ["a", "b", "a"], solution=[1, 2, 1], step=7)
    assert asked == [("p", "a", 1, 7), ("q", "b", 2, 7)]

    def batch(prompts, completions, solution, **question):
        asked.append((prompts, completions, solution))
        return [0.0] * len(completions)

    asked.clear()
    judge = Judge(batch, cache=10)
    judge(["p", "q", "p"], ["a", "b", "a"], solution=[1, 2, 1])
    judge(["q", "r"], ["b", "c"], solution=[2, 3])
    assert asked == [(["p", "q"], ["a", "b"], [1, 2]), (["r"], ["c"], [3])]


def test_a_cache_keeps_scores_not_failures_and_forgets():
    asked = []

    def counts(prompt, completion, **question):
        asked.append(completion)
        return None if completion == "?" else -1 if completion == "x" else 1

    judge = Judge(counts, per_sample=True, cache=2, failures=[-1])
    for _ in range(2):
        scores_of(judge, ["a", "?", "x"])
    assert asked == ["a", "?", "x", "?", "x"]
    scores_of(judge, ["b", "c"])
    scores_of(judge, ["a"])  # was forgotten
    assert asked[-3:] == ["b", "c", "a"]


def test_failures_are_missing_never_zero():
    assert np.isnan(scores_of(Judge(lambda completions, **_: [0.0, 1.0], failures=[0]), ["a", "b"])[0])


@pytest.mark.parametrize("asynchronous", [False, True])
def test_it_is_asked_again(asynchronous):
    times = []

    def flaky(completions, **question):
        times.append(time.monotonic())
        if len(times) < 3:
            raise OSError("no route")
        return [1.0] * len(completions)

    async def later(completions, **question):
        return flaky(completions)

    judge = Judge(later if asynchronous else flaky, retries=2, backoff=0.05)
    assert scores_of(judge, ["a"]) == [1.0]
    assert times[1] - times[0] >= 0.05
    assert times[2] - times[1] >= 0.1
    times.clear()
    with pytest.raises(Exception, match="no route"):
        scores_of(Judge(later if asynchronous else flaky, retries=1, backoff=0.0), ["a"])


@pytest.mark.parametrize("asynchronous", [False, True])
def test_what_fails_for_some_completions_is_missing_for_these(asynchronous):
    def strict(prompt, completion, **question):
        if not completion:
            raise ValueError("nothing there")
        return 1.0

    async def later(**question):
        return strict(**question)

    judge = Judge(later if asynchronous else strict, per_sample=True)
    given = scores_of(judge, ["a", "", "b", ""])
    assert given == pytest.approx([1, np.nan, 1, np.nan], nan_ok=True)
    assert (given.failed, given.late, str(given.error)) == (2, 0, "nothing there")
    with pytest.raises(Exception, match="nothing there"):
        scores_of(judge, ["", ""])


@pytest.mark.parametrize("options", [{}, {"concurrent": 4}])
@pytest.mark.parametrize("asynchronous", [False, True])
def test_what_hangs_is_missing_and_holds_up_nobody(asynchronous, options):
    release = threading.Event()

    def hangs(prompt, completion, **question):
        if completion == "hang":
            release.wait(60)
        return 1.0

    async def later(prompt, completion, **question):
        if completion == "hang":
            await asyncio.sleep(60)
        return 1.0

    judge = Judge(later if asynchronous else hangs, per_sample=True, timeout=2, **options)
    began = time.monotonic()
    given = scores_of(judge, ["a", "hang", "b", "hang", *"cdefgh"])
    release.set()
    assert time.monotonic() - began < 20
    assert np.isnan(given).tolist() == [False, True, False, True] + 6 * [False]
    assert (given.late, given.failed) == (2, 0)


@pytest.mark.parametrize("asynchronous", [False, True])
def test_no_more_than_allowed_are_under_way_from_all_threads(asynchronous):
    now, most, lock = [0], [0], threading.Lock()

    def enter(change):
        with lock:
            now[0] += change
            most[0] = max(most[0], now[0])

    def busy(**question):
        enter(1)
        time.sleep(0.005)
        enter(-1)
        return 1.0

    async def later(**question):
        enter(1)
        await asyncio.sleep(0.005)
        enter(-1)
        return 1.0

    judge = Judge(later if asynchronous else busy, per_sample=True, concurrent=3)
    threads = [threading.Thread(target=scores_of, args=(judge, list("abcdefgh"))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert now[0] == 0
    assert 1 < most[0] <= 3


def test_pickles_ask_alike():
    judge = pickle.loads(pickle.dumps(Judge(length, "how long", per_sample=True, concurrent=2, cache=5)))
    assert (judge.__name__, repr(judge)) == ("how long", "Judge('how long')")
    assert scores_of(judge, ["abc"]) == [3.0]


def test_two_hundred_threads_mix_nothing():
    judge = Judge(length, per_sample=True, cache=1000)

    def works(number):
        texts = ["x" * (1 + (number + i) % 50) for i in range(20)]
        for _ in range(5):
            assert scores_of(judge, texts) == [len(text) for text in texts]
        done.append(number)

    done = []
    threads = [threading.Thread(target=works, args=(number,)) for number in range(200)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(done) == list(range(200))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"function": 3}, "function = 3"),
        ({"timeout": 0}, "timeout = 0"),
        ({"retries": -1}, "retries = -1"),
        ({"backoff": float("nan")}, "backoff = nan"),
        ({"concurrent": 0}, "concurrent = 0"),
        ({"cache": 1.5}, "cache = 1.5"),
        ({"failures": ["x"]}, "failures = 'x'"),
        ({"failures": -1}, "failures = -1: must be a list of numbers"),
        ({"failures": "-1"}, "failures = '-1': must be a list of numbers"),
        ({"failures": None}, "failures = None: must be a list of numbers"),
        ({"failures": np.array(-1)}, r"failures = array\(-1\): must be a list of numbers"),
        ({"per_sample": 1}, "per_sample = 1"),
        ({"name": "a[b]"}, "name of a judge"),
    ],
)
def test_bad_manners(options, message):
    with pytest.raises(InvalidValueError, match=message.replace("[", r"\[")):
        Judge(**{"function": length} | options)


def test_a_wrong_number_of_scores_is_an_error_with_a_cache_too():
    judge = Judge(lambda completions, **_: [1.0, 2.0], cache=10)
    with pytest.raises(Exception, match="number of scores of judge 'judge' = 2: must be 1"):
        scores_of(judge, ["a", "a"])


# Columns


def kinds_of_column():
    values = [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]
    yield "list", values
    yield "tuple", tuple(values)
    yield "array", np.array(values)
    yield "objects", np.array([*map(str, values)], object)
    for library, make in (("torch", lambda m: m.tensor(values)), ("jax.numpy", lambda m: m.asarray(values))):
        with contextlib.suppress(ImportError):
            yield library, make(importlib.import_module(library))
    with contextlib.suppress(ImportError):
        pandas = importlib.import_module("pandas")
        yield "series", pandas.Series([str(x) for x in values], index=[2, 0, 1])


def seen(part):
    return str(np.asarray(part).tolist()) if not isinstance(part, str) else part


@pytest.mark.parametrize("kind", dict(kinds_of_column()))
def test_whatever_has_a_row_for_each_completion_is_a_column(kind):
    column, asked = dict(kinds_of_column())[kind], []

    def one(prompt, completion, column, **question):
        asked.append((completion, seen(column)))
        return 1.0

    def batch(prompts, completions, column, **question):
        asked.extend(zip(completions, map(seen, column), strict=True))
        return [1.0] * len(completions)

    whole = [("a", "[1.0, 2.0]"), ("b", "[3.0, 4.0]"), ("c", "[5.0, 6.0]")]
    for judge in (Judge(one, per_sample=True), Judge(one, per_sample=True, cache=9), Judge(batch, cache=9)):
        asked.clear()
        judge(["p"] * 3, ["a", "b", "c"], column=column)
        assert asked == whole
    asked.clear()
    judge = Judge(batch, cache=9)
    judge(["p"], ["b"], column=["[3.0, 4.0]"])
    judge(["p"] * 3, ["a", "b", "c"], column=column)
    assert asked == [whole[1], whole[0], whole[2]]


@pytest.mark.parametrize(
    "column", ["abc", b"abc", {"a": 1, "b": 2, "c": 3}, {1, 2, 3}, 3, None, np.array(1.0), np.zeros((2, 3)), object()]
)
def test_what_has_no_rows_is_no_column(column):
    asked = []

    def one(prompt, completion, column, **question):
        asked.append(column)
        return 1.0

    Judge(one, per_sample=True)(["p"] * 3, ["a", "b", "c"], column=column)
    assert [str(x) for x in asked] == [str(column)] * 3


def test_there_is_a_prompt_for_each_completion():
    for options in ({}, {"per_sample": True}, {"cache": 3}):
        with pytest.raises(InvalidValueError, match="number of prompts = 1: must be 2, one per completion"):
            Judge(length, **options)(["p"], ["a", "b"])


def test_no_attempt_sees_what_another_did_to_its_question():
    asked = []

    def changes(prompts, completions, meta, **question):
        asked.append((prompts[0][0]["content"], meta["k"]))
        prompts[0][0]["content"], meta["k"] = "", [0]
        if len(asked) < 3:
            raise OSError
        return [1.0]

    prompts = [[{"content": "why?"}]]
    Judge(changes, retries=2, backoff=0)(prompts, ["a"], meta={"k": [1]})
    assert asked == [("why?", [1])] * 3
    assert prompts == [[{"content": "why?"}]]


# What is kept, and what is an error


def later_if(asynchronous, function):
    async def later(**question):
        return function(**question)

    return later if asynchronous else function


@pytest.mark.parametrize("asynchronous", [False, True])
@pytest.mark.parametrize("options", [{}, {"concurrent": 3}, {"timeout": 60}])
@pytest.mark.parametrize("bad", ["seven", float("inf"), [1.0]])
def test_one_bad_score_names_its_completion_and_the_others_are_kept(asynchronous, options, bad):
    asked = []

    def says(prompt, completion, **question):
        asked.append(completion)
        return bad if completion == "c" else 1.0

    judge = Judge(later_if(asynchronous, says), per_sample=True, cache=9, retries=1, backoff=0, **options)
    found = scores_of(judge, ["a", "b", "a", "c", "d"])
    assert found == pytest.approx([1, 1, 1, np.nan, 1], nan_ok=True)
    assert (found.failed, found.late) == (1, 0)
    assert re.search(r"score 3 of judge '.*' = .*must be a finite number", str(found.error))
    assert asked.count("c") == 2  # it may have answered otherwise
    asked.clear()
    assert scores_of(judge, ["a", "b", "d"]) == [1, 1, 1]
    assert asked == []


@pytest.mark.parametrize("asynchronous", [False, True])
@pytest.mark.parametrize("per_sample", [False, True])
def test_what_is_known_does_not_get_lost_when_the_rest_fails(asynchronous, per_sample):
    broken = []

    def one(prompt, completion, **question):
        if broken:
            raise OSError("no route")
        return 1.0

    def batch(prompts, completions, **question):
        return [one("p", text) for text in completions]

    judge = Judge(later_if(asynchronous, one if per_sample else batch), per_sample=per_sample, cache=9)
    scores_of(judge, ["a", "b"])
    broken.append(1)
    given = scores_of(judge, ["a", "x", "b", "x"])
    assert np.isnan(given).tolist() == [False, True, False, True]
    assert (given.failed, given.late, str(given.error)) == (2, 0, "no route")
    with pytest.raises(Exception, match="no route"):
        scores_of(judge, ["x", "y"])


def test_scores_are_kept_though_the_batch_is_given_up():
    asked = []

    async def slow(prompt, completion, **question):
        asked.append(completion)
        if completion == "slow":
            await asyncio.sleep(3600)
        return 1.0

    judge = Judge(slow, per_sample=True, cache=9)

    async def gives_up():
        batch = asyncio.ensure_future(judge(["p"] * 3, ["a", "slow", "b"]))
        while len(asked) < 3:
            await asyncio.sleep(0)
        batch.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await batch

    asyncio.run(gives_up())
    asked.clear()
    assert scores_of(judge, ["a", "b"]) == [1, 1]
    assert asked == []


def test_a_function_that_times_out_by_itself_has_failed():
    def gives_up(prompt, completion, **question):
        if completion == "b":
            raise TimeoutError("no route")
        return 1.0

    given = scores_of(Judge(gives_up, per_sample=True, timeout=60), ["a", "b"])
    assert (given.failed, given.late, str(given.error)) == (1, 0, "no route")


def test_an_answer_may_be_a_generator():
    judge = Judge(lambda completions, **_: (1 / len(text) for text in completions), retries=1, backoff=0)
    assert scores_of(judge, ["a", "bb"]) == [1, 0.5]
    with pytest.raises(Exception, match="ZeroDivisionError"):
        scores_of(judge, ["a", ""])


# What hangs


@contextlib.contextmanager
def hanging():
    """Give a function that hangs, and the threads that are left in the end."""
    go, before = threading.Event(), set(threading.enumerate())

    def hangs(**question):
        go.wait(120)
        return 1.0

    def left():
        return [thread for thread in threading.enumerate() if thread not in before and thread.name == "uard-judge"]

    try:
        yield hangs, left
    finally:
        go.set()
        for thread in left():
            thread.join()


@pytest.mark.parametrize("concurrent", [None, 1, 3])
def test_no_more_threads_hang_than_are_allowed_however_often_it_is_asked(concurrent):
    with hanging() as (hangs, left):
        judge = Judge(hangs, per_sample=True, timeout=0.02, concurrent=concurrent)
        for _ in range(4):
            given = judge(["p"] * 20, [*"abcdefghijklmnopqrst"])
            assert (given.late, given.failed) == (20, 0)
        while len(left()) > (concurrent or HANGING):  # who was refused is about to end
            time.sleep(0.01)
        began = time.monotonic()
        slow = Judge(hangs, per_sample=True, timeout=30, concurrent=concurrent)
        slow._places = judge._places  # where all hang already
        assert slow(["p"] * 20, [*"abcdefghijklmnopqrst"]).late == 20
        assert time.monotonic() - began < 20  # at once


def test_who_no_longer_hangs_is_asked_again():
    go = threading.Event()

    def waits(prompt, completion, **question):
        go.wait(120)
        return 1.0

    judge = Judge(waits, per_sample=True, timeout=0.05, concurrent=1)
    assert judge(["p"], ["a"]).late == 1
    go.set()
    while (given := judge(["p"], ["b"])).late:
        time.sleep(0.01)
    assert given == [1]


@pytest.mark.parametrize("per_sample", [False, True])
@pytest.mark.parametrize("options", [{}, {"concurrent": 1}])
def test_who_ignores_being_cancelled_holds_up_nobody(per_sample, options):
    ended = []

    async def swallows(**question):
        for _ in range(2):
            with contextlib.suppress(asyncio.CancelledError):
                await asyncio.sleep(3600)
        ended.append(1)

    async def asks():
        judge = Judge(swallows, per_sample=per_sample, timeout=0.1, **options)
        for _ in range(2):
            given = await judge(["p"] * 3, ["a", "b", "c"])
            assert (given.late, given.failed) == (3, 0)
        assert not ended  # and asyncio.run cancels it for the second time

    began = time.monotonic()
    asyncio.run(asks())
    assert time.monotonic() - began < 60


@pytest.mark.parametrize("asynchronous", [False, True])
def test_a_time_limit_for_a_batch_holds_whoever_asks(asynchronous):
    with hanging() as (hangs, left):

        async def later(**question):
            await asyncio.sleep(3600)

        judge = Judge(later if asynchronous else hangs, timeout=0.1)
        began = time.monotonic()
        for _ in range(3):
            answer = judge(["p"] * 2, ["a", "b"])
            given = asyncio.run(later_of(answer)) if asynchronous else answer
            assert np.isnan(given).all()
            assert (given.late, given.failed) == (2, 0)
        assert time.monotonic() - began < 60
        while len(left()) > 1:
            time.sleep(0.01)


async def later_of(answer):
    return await answer


def test_a_limit_that_others_keep_is_not_kept_twice():
    """A panel's limit takes the place of the judge's own."""
    judge = Judge(lambda completions, **_: time.sleep(0.3) or [1.0] * len(completions), timeout=0.01)
    question = {"prompts": ["p"], "completions": ["a"]}
    assert ask({"judge": judge}, question, {"judge": 60})["judge"].given == [1]


def test_no_more_than_allowed_are_under_way_from_all_loops():
    now, most = [0], []

    async def busy(**question):
        with lock:
            now[0] += 1
            most.append(now[0])
        await asyncio.sleep(0.005)
        with lock:
            now[0] -= 1
        return 1.0

    lock, judge = threading.Lock(), Judge(busy, per_sample=True, concurrent=3)

    async def asks():
        assert await judge(["p"] * 8, [*"abcdefgh"]) == [1] * 8

    threads = [threading.Thread(target=asyncio.run, args=(asks(),)) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert now == [0]
    assert max(most) <= 3


def test_a_loop_that_gives_up_takes_no_places_with_it():
    async def slow(prompt, completion, **question):
        await asyncio.sleep(3600 if completion == "slow" else 0)
        return 1.0

    judge = Judge(slow, per_sample=True, concurrent=2)

    async def gives_up():
        async with asyncio.timeout(0.1):
            await judge(["p"] * 5, ["slow"] * 5)

    for _ in range(2):
        with pytest.raises(TimeoutError):
            asyncio.run(gives_up())
    assert asyncio.run(later_of(judge(["p"] * 3, ["a", "b", "c"]))) == [1, 1, 1]


def test_system_exit_of_one_call_ends_no_loop():
    async def leaves(prompt, completion, **question):
        raise SystemExit(0)

    for options in ({}, {"timeout": 60}):
        with pytest.raises(Exception, match="SystemExit"):
            scores_of(Judge(leaves, per_sample=True, **options), ["a", "b"])
        assert scores_of(Judge(length_later, per_sample=True), ["a"]) == [1]


def test_system_exit_of_a_worker_keeps_nobody_waiting():
    def leaves(prompt, completion, **question):
        raise SystemExit(0)

    with pytest.raises(Exception, match="SystemExit"):
        scores_of(Judge(leaves, per_sample=True, concurrent=2), ["a", "b", "c"])


def test_an_async_function_that_cancels_itself_fails_about_one_completion_only():
    async def sometimes(completion, **question):
        if completion == "?":
            raise asyncio.CancelledError
        return len(completion)

    found = scores_of(Judge(sometimes, per_sample=True), ["a", "?", "bcd"])
    assert found == pytest.approx([1, np.nan, 3], nan_ok=True)
    assert (found.failed, found.late) == (1, 0)
    assert "it cancelled itself" in str(found.error)
