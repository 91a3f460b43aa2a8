"""Judges: their names, how long they may take, what counts as an answer, and scales that one number cannot spoil."""

import asyncio
import contextlib
import subprocess
import sys
import threading
import time
from decimal import Decimal

import numpy as np
import pytest

from uard import InvalidValueError
from uard.judges import Answer, JudgeError, Moments, Scale, as_scores, ask, asking, by_name

QUESTION = {"prompts": ["p"] * 2, "completions": ["a", "bb"]}


def length(completions, **question):
    return [len(text) for text in completions]


async def hangs(**question):
    await asyncio.sleep(3600)


async def swallows(**question):
    while True:
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.sleep(3600)


# Time limits


@pytest.mark.parametrize("judge", [hangs, swallows, lambda **_: threading.Event().wait(60)])
def test_who_does_not_answer_in_time_is_late_and_the_others_are_not(judge):
    began = time.monotonic()
    answers = ask({"slow": judge, "length": length}, QUESTION, {"slow": 0.2, "length": 20})
    assert 0.2 <= time.monotonic() - began < 10
    assert answers["slow"].late
    assert answers["slow"].given is None
    assert answers["slow"].seconds >= 0.2
    assert answers["length"][0:4:2] == ([1, 2], False)


def test_who_is_still_at_work_is_not_asked_again():
    go, asked = threading.Event(), []

    def waits(**question):
        asked.append(1)
        go.wait(60)
        return [1, 2]

    busy = {}
    for _ in range(3):
        answer = ask({"waits": waits}, QUESTION, {"waits": 0.1}, busy)["waits"]
        assert (answer.given, answer.late, answer.error) == (None, True, None)
    assert len(asked) == 1
    go.set()
    while busy["waits"]():
        time.sleep(0.01)
    assert ask({"waits": waits}, QUESTION, {"waits": 20}, busy)["waits"].given == [1, 2]


def test_a_cancelled_judge_is_asked_again():
    busy, cancelled = {}, []

    async def counts(**question):
        try:
            await asyncio.sleep(3600)
        finally:
            cancelled.append(1)

    for times in (1, 2):
        assert ask({"counts": counts}, QUESTION, {"counts": 0.1}, busy)["counts"].late
        while busy["counts"]():
            time.sleep(0.01)
        assert len(cancelled) == times


def test_a_judge_that_times_out_by_itself_has_raised():
    def gives_up(**question):
        raise TimeoutError("no route")

    answer = ask({"gives_up": gives_up}, QUESTION, {"gives_up": 20})["gives_up"]
    assert not answer.late
    assert "'gives_up' raised on 2 completions: TimeoutError: no route" in str(answer.error)


def test_seconds_are_those_of_the_judge():
    async def naps(**question):
        await asyncio.sleep(0.1)

    def works(**question):
        time.sleep(1)

    answers = ask({"naps": naps, "works": works}, QUESTION)
    assert 0.1 <= answers["naps"].seconds < 0.9  # it was over before the other
    assert answers["works"].seconds >= 1


def test_all_threads_share_one_loop(monkeypatch):
    """A loop of its own for each thread that came first would count calls, and keep clients, apart."""
    new, made, got, together = asyncio.new_event_loop, [], [], threading.Barrier(8)

    def slow():
        time.sleep(0.05)  # so that all of them find that there is no loop yet
        made.append(new())
        return made[-1]

    def first():
        together.wait(60)
        got.append(asking._event_loop(-1))

    monkeypatch.setattr(asking, "_loops", {})
    monkeypatch.setattr(asyncio, "new_event_loop", slow)
    threads = [threading.Thread(target=first) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(got) == 8
    assert len({id(loop) for loop in got}) == 1
    assert [loop.is_closed() for loop in made].count(False) == 1
    got[0].call_soon_threadsafe(got[0].stop)
    while got[0].is_running():
        time.sleep(0.01)
    got[0].close()


def test_the_process_ends_though_judges_hang():
    code = (
        "import asyncio, time\n"
        "from uard.judges import ask\n"
        "async def in_pool(**_): await asyncio.to_thread(time.sleep, 600)\n"
        "def sync(**_): time.sleep(600)\n"
        "print([a.late for a in ask({'a': in_pool, 'b': sync}, {'completions': ['']}, {'a': .5, 'b': .5}).values()])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, "[True, True]", "")


# What judges raise


def raises(error, asynchronous):
    def judge(**question):
        raise error

    async def later(**question):
        await asyncio.sleep(0)
        raise error

    return later if asynchronous else judge


@pytest.mark.parametrize("limits", [{}, {"bad": 20}])
@pytest.mark.parametrize("asynchronous", [False, True])
def test_exceptions_are_named_and_the_rest_passes(asynchronous, limits):
    for error in (StopIteration("empty"), ZeroDivisionError("none"), asyncio.InvalidStateError("odd"), SystemExit(0)):
        answers = ask({"bad": raises(error, asynchronous), "good": raises_not}, QUESTION, limits)
        assert "judge 'bad' raised on 2 completions" in str(answers["bad"].error)
        assert isinstance(answers["bad"].error, JudgeError)
        assert answers["good"].given == [1, 2]
    for error in (KeyboardInterrupt(), GeneratorExit()):
        with pytest.raises(type(error)):
            ask({"bad": raises(error, asynchronous)}, QUESTION, limits)
    assert ask({"good": raises_not}, QUESTION)["good"].given == [1, 2]  # the loop has survived


async def raises_not(**question):
    return [1, 2]


def test_a_generator_is_read_where_its_errors_have_a_name():
    def broken(completions, **question):
        return (1 / (len(text) - 2) for text in completions)

    error = ask({"broken": broken}, QUESTION)["broken"].error
    assert "'broken' raised on 2 completions: ZeroDivisionError" in str(error)
    endless = ask({"endless": lambda **_: iter(int, 1)}, QUESTION)["endless"]
    assert endless.given == [0, 0, 0]  # one too many, which as_scores refuses


def test_nobody_sees_what_a_judge_does_to_its_lists():
    chat = [[{"role": "user", "content": "why?"}], [{"role": "user", "content": "how?"}]]
    question = {"prompts": chat, "completions": ["a", "bb"], "answer": ["x", "y"]}

    def vandal(prompts, completions, answer, **question):
        prompts[0][0]["content"] = ""
        completions.clear()
        answer.reverse()
        return [1, 2]

    def sees(prompts, completions, answer, **question):
        return [prompts[0][0]["content"], completions, answer]

    assert ask({"vandal": vandal, "sees": sees}, question)["sees"].given == ["why?", ["a", "bb"], ["x", "y"]]
    assert question == {"prompts": chat, "completions": ["a", "bb"], "answer": ["x", "y"]}
    assert chat[0][0]["content"] == "why?"


# Names and answers


@pytest.mark.parametrize("name", ["", "a\nb", "\x1b[31mred", "[/red]", "x" * 101, 3, None])
def test_names_that_a_terminal_would_take_for_instructions(name):
    with pytest.raises(InvalidValueError, match=r"name of a judge = .*must be a text of 1 to 100 printable"):
        by_name({"good": length, name: length})


@pytest.mark.parametrize("judges", [{length, hangs}, "ab", None, iter([length, hangs])])
def test_judges_have_an_order(judges):
    with pytest.raises(InvalidValueError, match=r"judges = .*must be a list of reward functions, or a dictionary"):
        by_name(judges)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ({0: 1.0, 1: 2.0}, "answer of judge 'bad' = .*must be a list of 2 numbers"),
        ({1.0, 2.0}, "answer of judge 'bad' = "),
        ("12", "answer of judge 'bad' = '12'"),
        (b"12", "answer of judge 'bad' = b'12'"),
        (["1", 2], "score 0 of judge 'bad' = '1': must be a finite number"),
        ([1, 10**400], "score 1 of judge 'bad' = 1000.*: must be a finite number"),
        ([Decimal(1), 2], r"score 0 of judge 'bad' = Decimal\('1'\)"),
        ([1j, 2], "score 0 of judge 'bad' = 1j"),
        (np.ones((2, 1)), r"score 0 of judge 'bad' = \[1.0\]"),
        (np.array(1.0), "number of scores of judge 'bad' = 1.0: must be 2"),
        ([np.inf, 1], "score 0 of judge 'bad' = inf"),
    ],
)
def test_what_is_no_list_of_scores(answer, message):
    with pytest.raises(InvalidValueError, match=message):
        as_scores("bad", answer, 2)


def test_what_is_one():
    assert as_scores("a", [np.array(1.0), np.float32(2), np.int64(3), True, None], 5).tolist()[:4] == [1, 2, 3, 1]
    assert as_scores("a", np.ma.masked_array([1.0, 5.0], [False, True]), 2).tolist()[0] == 1
    assert np.isnan(as_scores("a", np.ma.masked_array([1.0, 5.0], [False, True]), 2)[1])


def test_torch_scores():
    torch = pytest.importorskip("torch")
    assert as_scores("a", torch.tensor([1.0, 2.0], requires_grad=True) * 1, 2).tolist() == [1, 2]
    assert as_scores("a", torch.tensor([1.0, 2.0], dtype=torch.bfloat16), 2).tolist() == [1, 2]
    assert as_scores("a", [torch.tensor(1.0, requires_grad=True), torch.tensor(2)], 2).tolist() == [1, 2]


def test_an_answer_is_on_time_unless_it_says_otherwise():
    assert not Answer([1], 0.5).late


# Scales


def plus_and_minus_one(scale, times):
    for _ in range(times):
        scale.observe(np.array([-1.0, 1.0] * 4))


def test_a_far_number_enters_as_ten_deviations():
    scale = Scale()
    plus_and_minus_one(scale, 2)  # mean 0, deviation 1, of 16
    assert scale.observe(np.array([1e4])).tolist() == [1e4]
    # 16 of square 1 and one of 10: mean 10/17, mean square (16 + 100) / 17.
    assert scale.location == pytest.approx(10 / 17)
    assert scale.deviation == pytest.approx((116 / 17 - (10 / 17) ** 2) ** 0.5)


def test_what_is_not_far_enters_as_it_is():
    scale = Scale()
    plus_and_minus_one(scale, 2)
    assert scale.observe(np.array([9.0, -9.0])).size == 0
    assert scale.deviation == pytest.approx(((16 + 162) / 18) ** 0.5)


@pytest.mark.parametrize("glitch", [1e2, 1e4, 1e200, 1.7e308, -1.7e308])
@pytest.mark.parametrize("before", [0, 1, 5, 50])
def test_a_hundred_batches_after_a_glitch_ratings_vary_as_before(glitch, before):
    rng, scale = np.random.default_rng(before), Scale()
    for _ in range(before):
        scale.observe(rng.normal(size=8))
    found = scale.observe(np.append(rng.normal(size=7), glitch))
    for _ in range(100):
        scale.observe(rng.normal(size=8))
    assert found.tolist() == [glitch] or abs(glitch) == 1e2
    assert scale.deviation == pytest.approx(1, rel=0.1)
    assert scale.ratings(rng.normal(size=10**4)).std() == pytest.approx(1, rel=0.1)


def test_a_glitch_of_a_judge_that_has_always_said_the_same():
    scale, rng = Scale(), np.random.default_rng(0)
    scale.observe(np.zeros(64))
    scale.observe(np.append(np.zeros(7), 1e200))
    assert scale.ratings(np.array([0.0, 1e200])).tolist() == pytest.approx([-(71**-0.5), 71**0.5], rel=1e-6)
    for _ in range(200):
        scale.observe(rng.normal(size=8))
    assert scale.deviation == pytest.approx(1, rel=0.1)


def test_a_rare_success_is_no_glitch():
    scale = Scale()
    for _ in range(100):
        scale.observe(np.append(np.zeros(31), 1.0))
    assert scale.location == pytest.approx(1 / 32)
    assert scale.deviation == pytest.approx(31**0.5 / 32)


@pytest.mark.parametrize("ones", [1, 20, 31, 32, 33, 60, 500])
@pytest.mark.parametrize("size", ["one", "all"])
def test_a_judge_that_says_0_nearly_always_has_the_scale_that_it_has(ones, size):
    """A cut through equal ones left a few of them, whose deviation cut the others off at a third of theirs."""
    said = np.zeros(1000)
    said[:ones] = 1.0 if size == "one" else np.random.default_rng(ones).uniform(0.5, 1, ones)
    scale = Scale()
    scale.observe(said)
    if ones > 1:  # one alone is looked at again
        assert scale.deviation == pytest.approx(said.std(), rel=0.05)


def test_a_judge_that_changes_its_unit_gets_a_new_scale():
    scale, rng = Scale(), np.random.default_rng(0)
    for _ in range(1000):
        scale.observe(rng.normal(size=8))
    for _ in range(3):
        assert scale.deviation < 2
        scale.observe(1000 * rng.normal(size=8))
    assert scale.known.number == 8
    scale.observe(1000 * rng.normal(size=800))
    assert scale.deviation == pytest.approx(1000, rel=0.1)


def test_a_server_that_fails_for_some_batches_makes_no_new_scale():
    scale = Scale()
    plus_and_minus_one(scale, 100)
    for _ in range(5):
        assert scale.observe(np.full(8, -999.0)).size == 8
    assert scale.known.number == 840  # it has not started again
    assert scale.deviation < 6  # as they are, they would make it 213


@pytest.mark.parametrize("size", [1e-300, 1e-170, 1.0, 1e170, 1e299])
def test_moments_of_any_size(size):
    batches = np.random.default_rng(0).normal(size=(5, 8))
    moments = Moments()
    for batch in batches:
        moments = moments.including(size * batch)
    assert moments.number == 40
    assert moments.mean / size == pytest.approx(batches.mean())
    assert moments.sd / size == pytest.approx(batches.std())


def test_a_fixed_scale_stays_and_names_what_is_absurd():
    scale = Scale(Moments(mean=5.0), fixed=2.0)
    assert scale.observe(np.array([4.0, 206.0, -1.7e308])).tolist() == [206.0, -1.7e308]
    assert (scale.location, scale.deviation, scale.ratings(np.array([9.0])).tolist()) == (5, 2, [2])
