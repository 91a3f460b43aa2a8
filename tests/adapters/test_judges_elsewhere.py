"""Judges in verifiers (really run), and in OpenRLHF, ms-swift and verl (called as their sources call a reward)."""

import asyncio
import importlib.util
import math
import pickle
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import verifiers.v1 as vf

from uard import InvalidValueError
from uard.adapters.openrlhf import reward_function
from uard.adapters.swift import judged_orm
from uard.adapters.verifiers import judged_reward
from uard.adapters.verl import batch_score_function, score_function
from uard.judges import FittedJudge, Judge, JudgeError, JudgePanel, PanelReward
from uard.judges.doubts import FailedJudgeWarning, LateJudgeWarning, UnscoredWarning


def length(completions, **question):
    return [float(len(text)) for text in completions]


def words(completions, **question):
    return [float(len(text.split())) for text in completions]


def shy(completions, **question):
    return [None if text == "?" else 1.0 for text in completions]


JUDGES = [length, words, shy]
PANEL = JudgePanel.plain(["length", "words", "shy"])
LOGGED = ["uard/raw", "uard/weight", "uard/sigma_h", "uard/length", "uard/words", "uard/shy"]


def expected(completions):
    return PANEL.combine({judge.__name__: judge(completions) for judge in JUDGES})


@pytest.fixture
def panel_file(tmp_path):
    PANEL.save(tmp_path / "panel.json")
    return tmp_path / "panel.json"


# The reward that all of them are made of


def test_a_failure_that_the_panel_knows_is_missing_and_counted():
    judges = (FittedJudge("length", sentinels=(-1.0,)), FittedJudge("words"))
    reward = PanelReward({"length": lambda **_: [-1.0, 2.0], "words": words}, JudgePanel(judges))
    judged = reward(["p"] * 2, ["one", "two"])
    assert math.isnan(judged.log_of(0)["uard/length"])
    assert judged.log_of(1)["uard/length"] == 2
    assert reward.counts.missing == {"length": 1, "words": 0}


@pytest.mark.parametrize("asynchronous", [False, True])
def test_waiting_for_a_place_is_not_being_late(asynchronous):
    def slow(completions, **question):
        time.sleep(0.2)
        return [1.0] * len(completions)

    async def later(completions, **question):
        await asyncio.sleep(0.2)
        return [1.0] * len(completions)

    judge = Judge(later if asynchronous else slow, timeout=20, concurrent=1)
    reward = PanelReward({"slow": judge, "words": words}, JudgePanel.plain(["slow", "words"]))
    with ThreadPoolExecutor(6) as pool:
        found = [*pool.map(lambda text: reward(["p"], [text]).log_of(0)["uard/slow"], "abcdef")]
    assert found == [1.0] * 6


def test_one_call_that_hangs_silences_no_judge_that_may_have_several():
    gate = threading.Event()

    def waits(completions, **question):
        if completions[0] == "hang":
            gate.wait()
        return [1.0]

    reward = PanelReward({"w": Judge(waits, timeout=3, concurrent=8), "words": words}, JudgePanel.plain(["w", "words"]))
    try:
        with pytest.warns(LateJudgeWarning):
            assert math.isnan(reward(["p"], ["hang"]).log_of(0)["uard/w"])
        assert [reward(["p"], [str(i)]).log_of(0)["uard/w"] for i in range(3)] == [1.0] * 3
    finally:
        gate.set()


def test_no_batch_and_what_is_no_list():
    reward = PanelReward(JUDGES, PANEL)
    assert reward([], []).rewards() == []
    with pytest.raises(InvalidValueError, match="prompts = 'p': must be a list"):
        reward("p", ["c"])
    with pytest.raises(InvalidValueError, match="panel = None: must be a JudgePanel, or the file of one"):
        PanelReward(JUDGES, None)


def test_rewards_are_the_panels(panel_file):
    reward = PanelReward(JUDGES, panel_file)
    judged = reward(["p", "q"], ["one two", "?"])
    assert judged.rewards() == expected(["one two", "?"]).reward.tolist()
    assert [*judged.log_of(0)] == [*judged.log_of(1)] == LOGGED
    assert math.isnan(judged.log_of(1)["uard/shy"])
    assert asyncio.run(reward.later(["p"], ["one"])).rewards() == expected(["one"]).reward.tolist()


def test_who_is_late_or_fails_is_missing_and_named_once():
    def fails(completions, **question):
        raise OSError("no route")

    def hangs(completions, **question):
        release.wait(60)
        return [1.0] * len(completions)

    release = threading.Event()
    judges = {"length": length, "words": words, "fails": fails, "hangs": Judge(hangs, timeout=0.2)}
    reward = PanelReward(judges, JudgePanel.plain(list(judges)))
    with pytest.warns(FailedJudgeWarning, match="'fails' raised"), pytest.warns(LateJudgeWarning, match="'hangs'"):
        judged = reward(["p"], ["one two"])
    assert judged.rewards() == reward(["p"], ["one two"]).rewards()  # warned of once
    release.set()
    assert np.isnan(judged.scores[0]).tolist() == [False, False, True, True]
    counts = reward.counts
    assert counts.missing == {"length": 0, "words": 0, "fails": 2, "hangs": 2}
    assert counts.failed == {"length": 0, "words": 0, "fails": 2, "hangs": 0}
    assert counts.late == {"length": 0, "words": 0, "fails": 0, "hangs": 2}
    assert (counts.completions, counts.unscored) == (2, 0)


def test_nobody_works_at_all():
    def fails(**question):
        raise OSError("no route")

    reward = PanelReward({"a": fails, "b": fails}, JudgePanel.plain(["a", "b"]))
    with pytest.raises(JudgeError, match="judge 'a' raised on 1 completions: OSError: no route"):
        reward(["p"], ["one"])


def test_other_judges_are_refused(panel_file):
    with pytest.raises(InvalidValueError, match="fit it again without 'shy'"):
        PanelReward([length, words], panel_file)
    with pytest.raises(InvalidValueError, match="number of prompts = 1"):
        PanelReward(JUDGES, PANEL)(["p"], ["a", "b"])


def test_ten_thousand_completions_from_two_hundred_threads():
    reward = PanelReward(JUDGES, PANEL)
    texts = [["x" * (1 + (t + i) % 9) + " y" * (i % 3) for i in range(50)] for t in range(200)]
    out = {}
    threads = [threading.Thread(target=lambda t=t: out.update({t: reward(["p"] * 50, texts[t])})) for t in range(200)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(out[t].rewards() == expected(texts[t]).reward.tolist() for t in range(200))
    assert reward.counts.completions == 10_000


def test_who_waits_in_an_event_loop_does_not_wait_for_judges_that_hang():
    def hangs(completions, **question):
        if completions == ["hang"]:
            release.wait(60)
        return [1.0]

    async def one_of_many():
        stuck = [asyncio.create_task(reward.later(["p"], ["hang"])) for _ in range(50)]
        await asyncio.sleep(0)
        judged = await asyncio.wait_for(reward.later(["p"], ["one"]), 20)
        release.set()
        await asyncio.gather(*stuck)
        return judged

    release = threading.Event()
    reward = PanelReward({"hangs": hangs, "length": length}, JudgePanel.plain(["hangs", "length"]))
    assert asyncio.run(one_of_many()).scores.tolist() == [[1.0, 3.0]]


def test_a_pickled_reward_goes_on_elsewhere():
    reward = PanelReward(JUDGES, PANEL, timeout=30)
    reward(["p"], ["?"])
    twin = pickle.loads(pickle.dumps(reward))
    assert twin.counts == reward.counts
    assert twin(["p"], ["one two"]).rewards() == expected(["one two"]).reward.tolist()
    assert (twin.counts.completions, reward.counts.completions) == (2, 1)


def test_a_judge_that_takes_messages_for_texts_is_told():
    def upper(completions, **question):
        return [float(text.upper() == text) for text in completions]

    talk = [[{"role": "assistant", "content": "AHA"}]]
    judges = {
        "upper": upper,
        "last": lambda completions, **_: [float(len(c[-1]["content"])) for c in completions],
    }
    reward = PanelReward(judges, JudgePanel.plain(["upper", "last"]))
    with pytest.warns(FailedJudgeWarning, match=r"completion\[-1\]\['content'\] is the text"):
        assert reward(["why?"], talk).scores[0, 1] == 3.0
    with pytest.raises(JudgeError) as raised:
        PanelReward({"upper": upper, "b": upper}, JudgePanel.plain(["upper", "b"]))(["why?"], talk)
    assert "completion[-1]['content']" in raised.value.__notes__[0]


# verifiers


class Data(vf.TaskData):
    answer: str = ""


class Poem(vf.Task[Data]):
    judged = judged_reward(JUDGES, PANEL, weight=2.0)


class Lost(vf.Task[Data]):
    judged = judged_reward({"a": lambda **_: [None], "b": lambda **_: [None]}, JudgePanel.plain(["a", "b"]))


def rollout(kind, reply):
    """Return a task and what an agent replied, as verifiers' own agents leave them."""
    task = kind(Data(idx=0, prompt="write a poem"), vf.TaskConfig())
    agent = vf.AgentInfo(config=vf.AgentConfig(), runtime=None, name="agent", trainable=True)
    return task, vf.Trace(task=vf.TraceTask(type=kind.__name__, data=task.data), agent=agent, root_reply=reply)


def test_verifiers_scores_a_rollout():
    task, trace = rollout(Poem, "roses are red")
    asyncio.run(task.score(trace))
    wanted = expected(["roses are red"])
    assert trace.rewards["judged"].score == pytest.approx(wanted.reward[0])
    assert trace.reward == pytest.approx(2.0 * wanted.reward[0])
    assert trace.metrics["uard/weight"] == pytest.approx(wanted.weight[0])
    assert trace.metrics["uard/words"] == 3.0


def test_verifiers_records_no_score_that_is_missing():
    task, trace = rollout(Poem, "?")
    asyncio.run(task.score(trace))
    assert trace.metrics.keys() == {*LOGGED} - {"uard/shy"}


@pytest.mark.parametrize("weight", [math.nan, "x", None])
def test_verifiers_weights_are_numbers(weight):
    with pytest.raises(InvalidValueError, match="weight = "):
        judged_reward(JUDGES, PANEL, weight=weight)


def test_verifiers_scores_many_at_once():
    replies = [f"line {'x' * i}" for i in range(1, 31)]
    tasks = [rollout(Poem, reply) for reply in replies]

    async def score():
        await asyncio.gather(*(task.score(trace) for task, trace in tasks))

    asyncio.run(score())
    assert [trace.rewards["judged"].score for _, trace in tasks] == pytest.approx(expected(replies).reward.tolist())


def test_a_rollout_that_nobody_scored_is_an_error_not_zero():
    task, trace = rollout(Lost, "roses")
    with pytest.warns(UnscoredWarning), pytest.raises(vf.TaskError, match="no judge scored reply 0: 'roses'"):
        asyncio.run(task.score(trace))
    assert trace.rewards == {"judged": None}


# OpenRLHF 0.11.2: openrlhf/utils/agent.py loads reward_func from a file and calls it with one query in a thread.


def test_openrlhf_loads_and_calls_the_file(tmp_path, panel_file):
    file = tmp_path / "my_judges.py"
    file.write_text(
        "from uard.adapters.openrlhf import reward_function\n"
        "def long(completions, labels, **question): return [float(len(x)) for x in completions]\n"
        "def right(completions, labels, **question): return [float(a == b) for a, b in zip(completions, labels)]\n"
        "from uard.judges import JudgePanel\n"
        "reward_func = reward_function([long, right], JudgePanel.plain(['long', 'right']))\n"
    )
    spec = importlib.util.spec_from_file_location("reward_func", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)

    async def fetch():
        return await asyncio.gather(asyncio.to_thread(module.reward_func, ["2+2=4"], ["2+2="], ["4"]))

    (found,) = asyncio.run(fetch())
    assert isinstance(found["rewards"], float)
    assert found["scores"] == found["rewards"]
    assert (found["extra_logs"]["uard/long"], found["extra_logs"]["uard/right"]) == (1.0, 1.0)


def test_openrlhf_several_queries():
    found = reward_function(JUDGES, PANEL)(["p one two", "p ?"], ["p ", "p "], [None, None])
    assert found["rewards"] == expected(["one two", "?"]).reward.tolist()
    assert math.isnan(found["extra_logs"]["uard/shy"][1])


def test_openrlhf_logs_the_same_names_for_every_query():
    reward_func = reward_function(JUDGES, PANEL)
    logs = [reward_func([f"p {text}"], ["p "], ["-"])["extra_logs"] for text in ("one two", "?")]
    assert [*logs[0]] == [*logs[1]] == LOGGED  # OpenRLHF concatenates them by name


def test_openrlhf_gets_no_reward_that_would_spoil_its_group():
    reward_func = reward_function([shy, shy_too], JudgePanel.plain(["shy", "shy_too"]))
    with pytest.warns(UnscoredWarning), pytest.raises(JudgeError, match="no judge scored query 1: 'p \\?'"):
        reward_func(["p a", "p ?"], ["p ", "p "], ["-", "-"])


def test_openrlhf_labels_and_prompts():
    seen = []

    def sees(completions, **question):
        seen.append((completions, question.get("labels", "none")))
        return [1.0] * len(completions)

    reward_func = reward_function({"sees": sees, "length": length}, JudgePanel.plain(["sees", "length"]))
    reward_func(["<s>why? so"], ["why?"], None)
    assert seen == [([" so"], "none")]
    assert reward_func([], [], [])["rewards"] == []
    with pytest.raises(InvalidValueError, match="number of labels = 1: must be 2, one per query"):
        reward_func(["p a", "p b"], ["p ", "p "], ["-"])
    with pytest.raises(InvalidValueError, match="number of prompts = 1: must be 2, one per query"):
        reward_func(["p a", "p b"], ["p "], ["-", "-"])


# ms-swift 4.6.0: swift/rlhf_trainers builds orms[name](args=args) and calls it with completions and the data's columns.


def test_swift_builds_and_calls_the_class(panel_file):
    seen = []

    def sees(prompts, completions, solution, **question):
        seen.append((prompts, solution))
        return [1.0] * len(completions)

    orms = {"judges": judged_orm({"sees": sees, "length": length}, JudgePanel.plain(["sees", "length"]))}
    reward = orms["judges"](args=None)
    talk = [{"role": "user", "content": "why?"}, {"role": "assistant", "content": "so"}]
    out = reward(completions=["so", "then"], messages=[talk, talk], solution=["a", "b"], trainer_state=None)
    assert len(out) == 2
    assert seen == [([talk[:1], talk[:1]], ["a", "b"])]
    assert judged_orm(JUDGES, panel_file)()(completions=["one"]) == expected(["one"]).reward.tolist()


def test_swift_with_a_column_of_prompts():
    seen = []

    def sees(prompts, completions, **question):
        seen.append(prompts)
        return [1.0] * len(completions)

    orm = judged_orm({"sees": sees, "length": length}, JudgePanel.plain(["sees", "length"]))()
    orm(completions=["so"], messages=[[{"role": "user", "content": "why?"}]], prompts=["other"])
    orm(completions=["so"], prompts=["other"])
    orm(completions=["so"])
    assert seen == [[[{"role": "user", "content": "why?"}]], ["other"], [[]]]
    with pytest.raises(InvalidValueError, match=r"messages\[0\] = .*must be a list of messages"):
        orm(completions=["so"], messages=["why?"])


def test_swift_takes_none_for_what_nobody_scored():
    with pytest.warns(UnscoredWarning):
        assert judged_orm([shy, shy_too], JudgePanel.plain(["shy", "shy_too"]))()(completions=["?"]) == [None]


def shy_too(completions, **question):
    return shy(completions)


# verl 0.9.1: naive asks compute_score(data_source=, solution_str=, ground_truth=, extra_info=), batch about lists.


def test_verl_asks_about_one_and_about_many():
    one = score_function(JUDGES, PANEL)
    found = [
        one(data_source="d", solution_str=s, ground_truth="g", extra_info={"question": "q"}) for s in ("one", "a b")
    ]
    many = batch_score_function(JUDGES, PANEL)(
        data_sources=["d", "d"], solution_strs=["one", "a b"], ground_truths=["g", "g"], extra_infos=[{}, None]
    )
    assert [x["score"] for x in found] == [x["score"] for x in many] == expected(["one", "a b"]).reward.tolist()
    assert [*found[0]] == [*many[1]] == ["score", *LOGGED]


def test_verl_reads_its_own_score_whatever_judges_are_called():
    names = ["score", "acc", "uid", "tau", "proxy"]
    judges = {name: lambda completions, **_: [None] * len(completions) for name in names} | {"length": length}
    found = score_function(judges, JudgePanel.plain([*judges]))("d", "one", "g", {})
    assert math.isfinite(found["score"])
    assert found.keys() == {"score", *LOGGED[:3], *(f"uard/{name}" for name in judges)}


def test_verl_with_columns_of_the_same_names():
    def sees(prompts, data_sources, completions, **question):
        return [float(prompts == ["q"] and data_sources == ["d"])] * len(completions)

    judges = {"sees": sees, "length": length}
    score = score_function(judges, JudgePanel.plain(["sees", "length"]))
    more = {"prompts": ["other"], "completions": ["other"], "data_sources": ["other"], "reward_router_address": None}
    found = score("d", "one", "g", {"question": "q"}, **more)
    assert (found["uard/sees"], found["uard/length"]) == (1.0, 3.0)
    with pytest.raises(InvalidValueError, match="extra_info of solution 0 = 'abc'"):
        score("d", "one", "g", "abc")


def test_verl_rows_have_the_same_names_and_no_silent_zero():
    score = score_function(JUDGES, PANEL)
    assert math.isnan(score("d", "?", "g", {})["uard/shy"])
    with pytest.warns(UnscoredWarning), pytest.raises(JudgeError, match="no judge scored solution 0: '\\?'"):
        score_function([shy, shy_too], JudgePanel.plain(["shy", "shy_too"]))("d", "?", "g", None)


def test_verl_names_columns_of_another_length():
    score = batch_score_function(JUDGES, PANEL)
    good = {"data_sources": ["d"], "ground_truths": ["g"], "extra_infos": [{}]}
    for name, bad in (("data_sources", []), ("ground_truths", ["g", "h"]), ("extra_infos", None)):
        with pytest.raises(InvalidValueError, match=f"{name} = .*must be a list of 1"):
            score(solution_strs=["so"], **{**good, name: bad})


@pytest.mark.parametrize(("query", "prompt"), [("Why? so", "why?"), ("so why?", "why?"), ("so", None)])
def test_openrlhf_refuses_a_query_that_does_not_begin_with_its_prompt(query, prompt):
    with pytest.raises(InvalidValueError, match=r"query 0 = .*must be a text that begins with its prompt"):
        reward_function(JUDGES, PANEL)([query], [prompt])
    asked = []
    judges = {"asked": lambda completions, **_: asked.extend(completions) or [1.0], "words": words}
    reward_function(judges, JudgePanel.plain(["asked", "words"]))(["<s> why? because why? yes"], ["why?"])
    assert asked == [" because why? yes"]


def test_a_column_of_the_data_set_does_not_take_the_place_of_what_is_judged():
    asked = []

    def one(prompt, completion, **question):
        asked.append((prompt, completion))
        return 1.0

    reward = PanelReward({"one": Judge(one, per_sample=True), "words": words}, JudgePanel.plain(["one", "words"]))
    reward(["p"], ["the model's"], completion=["the data set's"], prompt=["another"])
    assert asked == [("p", "the model's")]
