"""Several judges as one reward: the arithmetic by hand, bad judges, and real training with TRL's trainers."""

import asyncio
import copy
import functools
import importlib.util
import logging
import os
import pickle
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from datasets import Dataset
from transformers import Qwen2Config, Qwen2ForSequenceClassification, TrainerControl, TrainerState, set_seed
from trl import GRPOConfig, GRPOTrainer, RLOOConfig, RLOOTrainer

from uard import InvalidValueError, UnknownNameError
from uard.adapters.trl import (
    AbsurdScoreWarning,
    DiscountCancelledWarning,
    FailedJudgeWarning,
    ForgottenWarning,
    JudgeError,
    LateJudgeWarning,
    ReliabilityCallback,
    RewardModel,
    UncertaintyDiscountedReward,
    UnscoredWarning,
    UselessJudgeWarning,
    advantage_change,
    groups_of,
    keeps_factor,
)
from uard.judges import FittedJudge, Judge, JudgePanel, ScoreLog, fit
from uard.judges.doubts import whys
from uard.method.mitigations import named, uard_0_1

EXAMPLE = Path(__file__).parents[2] / "examples" / "grpo_three_judges.py"


def load(name: str, path: Path):
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # so that its functions can be pickled
    spec.loader.exec_module(module)
    return module


example = load("grpo_three_judges", EXAMPLE)

pytestmark = [
    pytest.mark.filterwarnings("ignore:`(is_)?gradient_checkpointing:FutureWarning"),  # TRL 1.16 with transformers 5.23
]


def says(*scores, name="judge"):
    """A judge that gives one fixed list after the other."""
    left = list(scores)

    def judge(completions, **kwargs):
        return left.pop(0) if len(left) > 1 else left[0]

    judge.__name__ = name
    return judge


def panel(*columns):
    return {f"judge {i}": says(column) for i, column in enumerate(columns)}


by_the_old_rule = functools.partial(UncertaintyDiscountedReward, mitigation=named("uard-0.1"))  # of numbers by hand


def ask(reward, size, prompts=None, **kwargs):
    return reward(prompts=prompts or ["p"] * size, completions=["c"] * size, **kwargs)


AS_THEY_ARE = [(0.0, 1.0)] * 3


# A panel that was fitted


def scores_of_three(size, seed=0):
    quality = np.random.default_rng(seed).normal(size=(size, 1))
    return quality + 0.4 * np.random.default_rng(seed + 1).normal(size=(size, 3))


FITTED = fit(ScoreLog(("a", "b", "c"), scores_of_three(300))).panel


def with_a_panel(scores, **changes):
    """A reward of judges that know what they say of each completion."""
    judges = {
        name: lambda completions, k=k, **_: [scores[int(text), k] for text in completions]
        for k, name in enumerate(("a", "b", "c"))
    }
    return UncertaintyDiscountedReward(judges, panel=FITTED, **changes)


def test_with_a_panel_no_batch_matters(tmp_path):
    scores = scores_of_three(64, seed=5)
    scores[::7, 2] += 4.0
    expected = FITTED.combine(scores).reward
    reward = with_a_panel(scores)
    texts = [str(i) for i in range(64)]
    assert reward(["p"] * 64, texts) == pytest.approx(expected, abs=0)
    with reward.paused():
        reward(["p"] * 64, texts[::-1])
    parts = [reward(["p"], [text])[0] for text in texts]
    assert parts == pytest.approx(expected, abs=0)
    FITTED.save(tmp_path / "panel.json")
    judges = {name: reward.judges[name] for name in ("c", "a", "b")}  # the file knows their names
    other = UncertaintyDiscountedReward(judges, panel=tmp_path / "panel.json")
    assert other(["p"] * 64, texts) == pytest.approx(expected)
    assert other.last.weight[7] < 0.5 < other.last.weight[8]


def test_with_a_panel_why_is_logged():
    columns, means = {}, {}
    reward = with_a_panel(scores_of_three(32))
    reward(["p"] * 32, [str(i) for i in range(32)], log_extra=columns.__setitem__, log_metric=means.__setitem__)
    assert columns["uard/why"][0].startswith(("agreed (", "contested ("))
    assert 1 <= means["uard/judges_at_least"] <= 3
    assert means["uard/a/failed"] == 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"weights": [1, 1, 1]}, "weights = .*: must be left out where a panel is given"),
        ({"proxy": "a"}, "proxy = 'a': must be left out where a panel is given"),
        ({"mitigation": named("raw")}, "mitigation = Raw"),
        ({"clip": 3.0}, "clip = 3.0"),
        ({"rule": "lcb"}, "rule = 'lcb': must be left out"),
        ({"scales": [None] * 3}, "scales = "),
        ({"judges": {"a": says([1]), "d": says([1])}}, "fit it again without 'b', 'c' and with 'd'"),
        ({"panel": "nowhere.json"}, "panel = 'nowhere.json'"),
    ],
)
def test_a_panel_stands_for_itself(changes, message):
    given = {"judges": {name: says([1]) for name in "abc"}, "panel": FITTED} | changes
    with pytest.raises(InvalidValueError, match=message):
        UncertaintyDiscountedReward(given.pop("judges"), **given)


def reads(completions, **question):
    return [float(text) for text in completions]


def test_a_judge_that_dies_half_way_loses_nothing():
    calls = []

    def dies(completions, **question):
        calls.append(1)
        if len(calls) > 2:
            raise ConnectionError("gone")
        return [float(text) for text in completions]

    reward = UncertaintyDiscountedReward({"dies": dies, "lives": reads, "too": reads})
    paid = [reward(["p"] * 3, ["1", "2", "3"]) for _ in range(2)]
    with pytest.warns(FailedJudgeWarning, match="judge 'dies' raised on 3 completions: ConnectionError: gone"):
        paid.append(reward(["p"] * 3, ["1", "2", "3"]))
    assert np.isfinite(paid).all()
    assert (reward.tally.missing["dies"], reward.tally.failed["dies"], reward.tally.unscored) == (3, 1, 0)


def test_what_is_late_within_a_batch_is_named():
    async def hangs(prompt, completion, **question):
        if completion == "2":
            await asyncio.sleep(60)
        return float(completion)

    slow = Judge(hangs, per_sample=True, timeout=0.3)
    reward = UncertaintyDiscountedReward(
        {"slow": slow, "quick": lambda completions, **_: [float(x) for x in completions]}
    )
    with pytest.warns(LateJudgeWarning, match="judge 'slow' did not answer in time: its scores are missing for 1 of 3"):
        reward(["p"] * 3, ["1", "2", "3"])
    assert reward.tally.late["slow"] == 1
    assert np.isnan(reward.last.scores[:, 0]).tolist() == [False, True, False]


# The arithmetic


def test_an_outlier_is_drawn_to_the_lowest_judge():
    # Three completions on which all judges say 1, one on which they say 0, 0, 3: its mean is 1 too. sigma_h^2 over
    # ratings and mean = (1 + 1 + 4 + 0) / 4 = 1.5; sigma_h is s, 0, 0, 0: mean s/4, mean deviation 3/8 s, so z = 2 and
    # lambda = 0.2 (1 + 50) = 10.2. The mean never varies, so its unit is 1: w = 1 / (1 + 10.2 * 0.5 * s); b = 0.
    reward = by_the_old_rule(panel([1, 1, 1, 0], [1, 1, 1, 0], [1, 1, 1, 3]), scales=AS_THEY_ARE)
    weight = 1 / (1 + 5.1 * 1.5**0.5)
    assert ask(reward, 4) == pytest.approx([1, 1, 1, weight])
    assert reward.last.sigma_h == pytest.approx([0, 0, 0, 1.5**0.5])
    assert reward.last.lam == pytest.approx([0.2, 0.2, 0.2, 10.2])
    assert reward.last.weight == pytest.approx([1, 1, 1, weight])
    assert reward.tally.weight == pytest.approx(3 + weight)
    assert reward.tally.widest == pytest.approx(1.5**0.5)


def test_scores_come_to_one_scale():
    # 1, 3 have mean 2 and deviation 1; with 5 they have mean 3 and variance 8/3. The second judge says the same
    # hundredfold and shifted.
    reward = by_the_old_rule({"a": says([1, 3], [5]), "b": says([107, 307], [507])})
    assert ask(reward, 2) == pytest.approx([-1, 1])
    assert ask(reward, 1) == pytest.approx([2 / (8 / 3) ** 0.5])
    np.testing.assert_allclose(reward.last.ratings, [[1.5**0.5, 1.5**0.5]])
    assert reward.deviations == pytest.approx({"a": (8 / 3) ** 0.5, "b": 100 * (8 / 3) ** 0.5})


def test_a_given_scale_stays():
    reward = UncertaintyDiscountedReward(panel([1, 3], [1, 3]), scales=[(1, 4), None])
    ask(reward, 2)
    np.testing.assert_allclose(reward.last.ratings, [[0, -1], [0.5, 1]])


def test_ratings_are_cut_off():
    reward = UncertaintyDiscountedReward(panel([-9, 9], [1, 2]), scales=[(0, 1), (0, 1)], clip=4)
    ask(reward, 2)
    np.testing.assert_array_equal(reward.last.ratings, [[-4, 1], [4, 2]])


def test_weights_and_a_named_proxy():
    columns = panel([0, 1], [4, 1])
    weighted = UncertaintyDiscountedReward(columns, weights=[3, 1], scales=AS_THEY_ARE[:2])
    ask(weighted, 2)
    assert weighted.last.raw == pytest.approx([1, 1])
    by_one = UncertaintyDiscountedReward(panel([0, 1], [None, 1]), proxy="judge 1", scales=AS_THEY_ARE[:2])
    ask(by_one, 2)
    assert by_one.last.raw == pytest.approx([0, 1])  # the mean of the others where the proxy is missing


def test_any_mitigation_of_rewards():
    columns = panel([1, 0], [1, 2], [1, 4])
    assert ask(UncertaintyDiscountedReward(columns, scales=AS_THEY_ARE, mitigation=named("raw")), 2) == [1, 2]
    lowest = UncertaintyDiscountedReward(columns, scales=AS_THEY_ARE, mitigation=named("worst-of-annotations"))
    assert ask(lowest, 2) == [1, 0]


def test_doubt_of_an_ensemble():
    # The judges agree, so only sigma_m counts: w = 1 / (1 + 0.2 * 0.5 * sigma_m / unit), unit = deviation of 1, 3.
    given = by_the_old_rule(panel([1, 3], [1, 3]), sigma_m=says([0, 20]), scales=AS_THEY_ARE[:2])
    ask(given, 2)
    assert given.last.weight == pytest.approx([1, 1 / 3])
    # Members say 0, 0 and 0, 4: deviation of all four sqrt(3), of the last two sqrt(8).
    heads = by_the_old_rule(panel([1, 3], [1, 3]), sigma_m=says([[0, 0], [0, 4]]))
    ask(heads, 2)
    assert heads.last.sigma_m == pytest.approx([0, (8 / 3) ** 0.5])


# What is missing


def test_missing_scores_are_counted_and_change_nothing_for_the_others():
    logged = {}
    scores = ([0, 2, None, None], [0.0, 2.0, float("nan"), 7.0], np.array([0.0, 2.0, np.nan, np.nan]))
    reward = by_the_old_rule(panel(*scores), scales=AS_THEY_ARE)
    with pytest.warns(UnscoredWarning, match="no judge scored completion 2 \\(1 of 4"):
        rewards = ask(reward, 4, log_metric=logged.__setitem__)
    assert rewards[:3] == [0, 2, None]
    assert rewards[3] is not None
    assert reward.tally.missing == {"judge 0": 2, "judge 1": 1, "judge 2": 2}
    assert (reward.tally.unscored, reward.tally.unchecked, reward.tally.completions) == (1, 1, 4)
    assert logged["uard/judge 0/missing"] == 0.5
    assert logged["uard/unscored"] == 0.25
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # said once
        ask(reward, 4)
    assert reward.tally.unscored == 2


def test_a_batch_without_any_score():
    reward = UncertaintyDiscountedReward(panel([None, None], [None, None]))
    with pytest.warns(UnscoredWarning, match="2 of 2"):
        assert ask(reward, 2, log_extra=lambda *_: None, log_metric=lambda *_: None) == [None, None]
    assert reward.tally.unscored == 2


def test_a_score_that_nobody_checks_is_believed_as_little_as_an_unrated_step():
    reward = by_the_old_rule(panel([0, 2, 4], [0, 2, None]), scales=AS_THEY_ARE[:2])
    # 0.1 is the mitigation's weight of what is unrated; what a completion is worth at least is 1 on average.
    assert ask(reward, 3) == pytest.approx([0, 2, 1 + 0.1 * (4 - 1)])


def test_a_judge_that_never_varies_is_no_rating():
    reward = by_the_old_rule(panel([0, 2], [0, 2], [7, 7]))
    assert ask(reward, 2) == pytest.approx([-1, 1])
    assert np.isnan(reward.last.ratings[:, 2]).all()
    assert ask(by_the_old_rule(panel([1, 1], [7, 7])), 2) == [0, 0]


# What the logs hold


def test_logs_of_completions_and_of_batches():
    columns, means = {}, {}
    reward = by_the_old_rule(panel([0, 2], [0, 2], [0, None]), scales=AS_THEY_ARE, name="mine")
    ask(reward, 2, log_extra=columns.__setitem__, log_metric=means.__setitem__)
    assert reward.__name__ == "mine"
    assert columns["mine/judge 2"] == [0, None]
    assert columns["mine/weight"] == [1, 1]
    assert columns["mine/sigma_h"] == [0, 0]
    assert means["mine/judge 0/mean"] == 1
    assert means["mine/judge 2/mean"] == 0
    assert means["mine/weight"] == 1
    assert means["mine/advantage_change"] == 0
    assert all(isinstance(value, float) for value in means.values())


def test_why_is_said_of_many_as_of_one():
    ratings = np.random.default_rng(0).normal(size=(300, 4)).round(1) * 3
    ratings[np.random.default_rng(1).random(ratings.shape) < 0.4] = np.nan
    ratings[0] = 0.0, -0.0, 1e6, 1e6
    panel = JudgePanel.plain(["a", "b", "c", "per cent %s"], clip=1e6)
    combined = panel.of_ratings(ratings)
    assert whys(combined) == [combined.why(row) for row in range(300)]
    assert {text.split(" (")[0].split(" ")[-1] for text in whys(combined)} == {"agreed", "contested", "it", "with"}
    assert whys(panel.of_ratings(ratings[:0])) == []


def test_means_in_logs_are_those_of_what_is_known():
    means = {}
    judges = {"a": says([1.7e308, 1.7e308, None]), "b": says([None] * 3), "c": says([1.0, 2.0, 4.5])}
    UncertaintyDiscountedReward(judges)(["p"] * 3, ["a", "b", "c"], log_metric=means.__setitem__)
    assert (means["uard/a/mean"], means["uard/c/mean"]) == (1.7e308, pytest.approx(2.5))
    assert "uard/b/mean" not in means
    assert (means["uard/a/missing"], means["uard/b/missing"]) == (pytest.approx(1 / 3), 1)


@pytest.mark.parametrize("far", [1e200, 1.7e308, -1.7e308])
def test_an_absurd_score_of_a_given_scale_is_named(far):
    reward = UncertaintyDiscountedReward(panel([1, 2, far], [1, 2, None]), scales=[(1e308, 0.1), (0, 1)])
    with pytest.warns(AbsurdScoreWarning, match="judge 'judge 0'"):
        ask(reward, 3)
    assert reward.tally.absurd == {"judge 0": 3, "judge 1": 0}


def test_judges_see_what_trl_passes():
    seen = {}

    def curious(**kwargs):
        seen.update(kwargs)
        return [1.0, 2.0]

    reward = UncertaintyDiscountedReward([curious, says([1, 2])])
    reward(prompts=["p", "p"], completions=["a", "b"], completion_ids=[[1], [2]], answer=["x", "y"], trainer_state=3)
    assert seen["answer"] == ["x", "y"]
    assert seen["completion_ids"] == [[1], [2]]
    assert set(seen) == {
        "prompts",
        "completions",
        "completion_ids",
        "answer",
        "trainer_state",
        "log_extra",
        "log_metric",
    }


def test_async_judges_run_together_on_one_loop():
    loops, meeting = [], threading.Barrier(2)

    async def waits(completions, **kwargs):
        loops.append(asyncio.get_running_loop())
        await asyncio.to_thread(meeting.wait, 30)  # passes only if both are here at the same time
        return [1.0 * len(text) for text in completions]

    reward = by_the_old_rule({"one": waits, "two": waits, "three": says([1, 2])})
    for _ in range(2):
        assert reward(prompts=["p", "p"], completions=["a", "bb"]) == pytest.approx([-1, 1])
    assert len(set(loops)) == 1


async def hangs(completions, **kwargs):
    await asyncio.sleep(3600)


def test_a_late_judge_is_missing_named_counted_and_warned_of_once():
    means = {}
    reward = by_the_old_rule({"a": says([1, 3]), "b": says([1, 3]), "slow": hangs}, timeout={"slow": 0.2})
    with pytest.warns(LateJudgeWarning, match="judge 'slow' did not answer within 0.2 s: its scores are missing"):
        assert ask(reward, 2, log_metric=means.__setitem__) == pytest.approx([-1, 1])
    assert ask(reward, 2) == pytest.approx([-1, 1])  # warnings are errors
    assert reward.tally.late == {"a": 0, "b": 0, "slow": 2, "sigma_m": 0}
    assert reward.tally.missing == {"a": 0, "b": 0, "slow": 4}
    assert means["uard/slow/missing"] == 1
    assert 0.2 <= means["uard/slow/seconds"] < 10
    assert means["uard/a/seconds"] >= 0


def test_one_limit_is_that_of_every_judge():
    reward = by_the_old_rule(panel([1, 3], [1, 3]), sigma_m=hangs, timeout=1)
    with pytest.warns(LateJudgeWarning, match="'sigma_m' did not answer within 1 s"):
        assert ask(reward, 2) == pytest.approx([-1, 1])


def test_a_late_ensemble_counts_as_none():
    reward = by_the_old_rule(panel([1, 3], [1, 3]), sigma_m=hangs, timeout={"sigma_m": 0.2})
    with pytest.warns(LateJudgeWarning, match="'sigma_m' did not answer within 0.2 s: its disagreement counts as 0"):
        assert ask(reward, 2) == pytest.approx([-1, 1])
    assert reward.last.sigma_m.tolist() == [0, 0]


# What a judge may not do to the others


def scores_of_prompt(prompts, **kwargs):
    return [{"easy": 2.0, "hard": -8.0}[prompt] for prompt in prompts]


def test_a_judge_that_scores_the_prompt_is_left_out_and_named():
    prompts = ["easy"] * 4 + ["hard"] * 4
    clarity, style = [0.8, 0.7, 0.9, 0.7] * 2, [1, 0, 0, 1] * 2
    judges = {"clarity": says(clarity), "style": says(style)}
    alone = UncertaintyDiscountedReward(judges)
    reward = UncertaintyDiscountedReward({"difficulty": scores_of_prompt, **judges})
    for _ in range(7):
        assert ask(reward, 8, prompts) == ask(alone, 8, prompts)
    with pytest.warns(UselessJudgeWarning, match="judge 'difficulty' has scored 16 groups and told the completions of"):
        assert ask(reward, 8, prompts) == ask(alone, 8, prompts)
    assert ask(reward, 8, prompts) == ask(alone, 8, prompts)  # said once
    assert reward.deviations["difficulty"] == pytest.approx(5)
    assert reward.last.sigma_h == pytest.approx(alone.last.sigma_h)


@pytest.mark.parametrize(
    ("tells_apart", "counts", "message"),
    [
        (False, False, "No advantage depends on it: the panel, which does not change, leaves it out"),
        (None, True, "counts it, for the log that it was fitted to had no prompts, or too few"),
        (True, True, "counts it, for the log that it was fitted to has it tell completions apart"),
    ],
)
def test_a_panel_does_with_a_judge_of_prompts_what_it_says(tells_apart, counts, message):
    known = [FittedJudge("difficulty", tells_apart=tells_apart), FittedJudge("a"), FittedJudge("b")]
    judges = {"difficulty": scores_of_prompt, "a": says([0, 1, 2, 3] * 2), "b": says([0, 1, 2, 3] * 2)}
    reward = UncertaintyDiscountedReward(judges, panel=JudgePanel(tuple(known)))
    for _ in range(7):
        ask(reward, 8, ["easy"] * 4 + ["hard"] * 4)
    with pytest.warns(UselessJudgeWarning, match=message) as seen:
        ask(reward, 8, ["easy"] * 4 + ["hard"] * 4)
    assert "until it does" not in str(seen[0].message)
    assert (~np.isnan(reward.last.ratings[:, 0])).all() == counts


def test_a_judge_of_texts_is_told_of_messages():
    judges = {
        "says": says([1, 2]),
        "texts": lambda completions, **_: [float(text.upper() == text) for text in completions],
    }
    with pytest.warns(FailedJudgeWarning, match=r"completion\[-1\]\['content'\] is the text of the last one"):
        UncertaintyDiscountedReward(judges)(["p"] * 2, [[{"role": "assistant", "content": text}] for text in "ab"])


def test_a_judge_counts_from_the_first_difference_within_a_group_on():
    reward = UncertaintyDiscountedReward({"a": says([1, 1, 2, 2], [1, 1, 1, 2]), "b": says([1, 2, 1, 2])})
    prompts = ["p", "p", "q", "q"]
    ask(reward, 4, prompts)
    assert np.isnan(reward.last.ratings[:, 0]).all()
    for _ in range(2):
        ask(reward, 4, prompts)
        assert not np.isnan(reward.last.ratings).any()
    assert reward.tally.compared == {"a": 6, "b": 6}
    assert reward.tally.told_apart == {"a": 2, "b": 6}


def test_without_groups_nobody_is_left_out():
    reward = by_the_old_rule(panel([1, 2], [5, 7]))
    assert ask(reward, 2, ["p", "q"]) == pytest.approx([-1, 1])


def test_an_absurd_score_is_named_and_does_not_silence_its_judge():
    rng = np.random.default_rng(0)
    glitch = []
    reward = UncertaintyDiscountedReward(
        {"a": lambda **_: [*rng.normal(size=7), *(glitch or [0.5])], "b": lambda **_: rng.normal(size=8)}
    )
    for _ in range(50):
        ask(reward, 8)
    before = reward.deviations["a"]
    glitch.append(1e200)
    with pytest.warns(AbsurdScoreWarning, match=r"judge 'a' gave the score 1e\+200, more than 100 of its standard"):
        assert np.isfinite(ask(reward, 8)).all()
    assert reward.last.ratings[-1, 0] == 5
    glitch.clear()
    for _ in range(100):
        ask(reward, 8)
    assert reward.deviations["a"] == pytest.approx(before, rel=0.1)
    assert reward.tally.absurd == {"a": 1, "b": 0}


def test_each_thread_gets_its_own_rewards():
    def slowly(completions, **kwargs):
        time.sleep(0.001)
        return [float(text) for text in completions]

    reward = UncertaintyDiscountedReward({"a": example_floats, "b": slowly}, scales=AS_THEY_ARE[:2], clip=1e6)
    wrong = []

    def work(sign):
        for _ in range(60):
            rewards = reward(["p"] * 4, [str(sign * (j + 1)) for j in range(4)])
            wrong.extend(x for x in rewards if np.sign(x) != sign)

    threads = [threading.Thread(target=work, args=(sign,)) for sign in (1, -1, 1, -1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
    assert reward.tally.completions == 4 * 60 * 4
    assert reward.tally.told_apart == {"a": 240, "b": 240}


def example_floats(completions, **kwargs):
    return [float(text) for text in completions]


# Looked at, not learned from


def test_a_pause_changes_nothing_that_is_paid_later(tmp_path):
    def fresh():
        reward, rng = UncertaintyDiscountedReward(panel_of_texts()), np.random.default_rng(0)
        for _ in range(20):
            reward(["p"] * 8, ["".join(rng.choice(list("abcdeio"), rng.integers(1, 9))) for _ in range(8)])
        return reward

    plain, evaluated = fresh(), fresh()
    long = {"prompts": ["q"] * 200, "completions": ["z" * 400] * 199 + ["a" * 400]}
    with warnings.catch_warnings(), evaluated.paused():
        warnings.simplefilter("ignore", AbsurdScoreWarning)
        for _ in range(3):
            assert np.isfinite(evaluated(**long)).all()
    assert evaluated.tally == plain.tally
    batch = {"prompts": ["p"] * 4, "completions": ["abc", "eee", "dddddd", "i"]}
    assert evaluated(**batch) == plain(**batch)


def panel_of_texts():
    return {
        "length": lambda completions, **_: [float(len(text)) for text in completions],
        "vowels": lambda completions, **_: [float(sum(x in "aeiou" for x in text)) for text in completions],
    }


def test_a_reward_that_knows_nothing_yet_can_be_looked_at():
    reward = by_the_old_rule(panel([1, 3], [1, 3]))
    with reward.paused():
        assert ask(reward, 2) == pytest.approx([-1, 1])
    assert reward.tally.completions == 0
    assert reward.deviations == {"judge 0": 0, "judge 1": 0}


# Odd questions


def test_an_empty_batch():
    assert UncertaintyDiscountedReward(panel([], []))([], []) == []


@pytest.mark.parametrize(
    ("prompts", "completions", "message"),
    [
        (["p"], ["a", "b"], "number of prompts = 1: must be 2, one per completion"),
        (["p", "q", "r"], ["a", "b"], "number of prompts = 3"),
        (["p", "q"], "ab", "completions = 'ab': must be a list with one entry per completion"),
        ({"p": 1, "q": 2}, ["a", "b"], "prompts = "),
        (None, ["a", "b"], "prompts = None"),
    ],
)
def test_questions_that_fit_no_completions(prompts, completions, message):
    reward = UncertaintyDiscountedReward(panel([1, 2], [1, 2]))
    with pytest.raises(InvalidValueError, match=message):
        reward(prompts, completions)
    assert reward.tally.completions == 0


# Bad judges


def broken(completions, **kwargs):
    raise ZeroDivisionError("no tokens")


async def broken_later(completions, **kwargs):
    raise ZeroDivisionError("no tokens")


@pytest.mark.parametrize("judge", [broken, broken_later])
def test_a_judge_that_raises_is_missing_named_and_counted(judge):
    reward = UncertaintyDiscountedReward({"strict": judge, "kind": says([1])})
    said = "judge 'strict' raised on 1 completions: ZeroDivisionError: no tokens: its scores are missing for 1 of 1"
    with pytest.warns(FailedJudgeWarning, match=said):
        ask(reward, 1)
    assert np.isnan(reward.last.scores[0, 0])
    ask(reward, 1)  # warned of once
    assert reward.tally.failed == {"strict": 2, "kind": 0, "sigma_m": 0}


def test_if_all_judges_raise_from_the_first_on_it_is_no_outage():
    reward = UncertaintyDiscountedReward({"strict": broken, "later": broken_later})
    with pytest.raises(
        JudgeError, match="judge 'strict' raised on 1 completions: ZeroDivisionError: no tokens"
    ) as info:
        ask(reward, 1)
    assert isinstance(info.value.__cause__, ZeroDivisionError)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ([1.0], "number of scores of judge 'bad' = 1: must be 2, one per completion"),
        (None, "answer of judge 'bad' = None: must be a list of 2 numbers"),
        (np.float64(3), "number of scores of judge 'bad' = 3.0: must be 2"),
        ([1.0, "good"], "score 1 of judge 'bad' = 'good': must be a finite number, or None or NaN"),
        ([1.0, [2.0]], r"score 1 of judge 'bad' = \[2.0\]"),
        ([float("inf"), 1.0], "score 0 of judge 'bad' = inf"),
        (torch.tensor([1.0, -torch.inf]), "score 1 of judge 'bad' = -inf"),
    ],
)
def test_bad_answers_name_judge_and_place(answer, message):
    reward = UncertaintyDiscountedReward({"good": says([1, 2]), "bad": says(answer)})
    with pytest.raises(InvalidValueError, match=message):
        ask(reward, 2)
    assert reward.tally.completions == 0
    assert reward.deviations["good"] == 0  # nothing was learned from half a batch


@pytest.mark.parametrize(
    "answer", [[True, False], torch.tensor([1, 0]), (np.float32(1), torch.tensor(0.0)), range(1, -1, -1)]
)
def test_numbers_of_all_kinds(answer):
    reward = by_the_old_rule({"a": says(answer), "b": says([1, 0])})
    assert ask(reward, 2) == pytest.approx([1, -1])


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ([-1.0, 1.0], r"sigma_m\[0\] = -1.0: must be finite and >= 0"),
        ([[0.0, 1.0], [0.0, np.nan]], r"sigma_m\[1, 1\] = nan"),
        ([[1.0], [1.0]], r"shape of the answer of sigma_m = \(2, 1\): must be \(2,\) or \(2, N\) with N >= 2"),
        (None, "sigma_m"),
    ],
)
def test_bad_ensembles(answer, message):
    reward = UncertaintyDiscountedReward(panel([1, 2], [1, 2]), sigma_m=says(answer))
    with pytest.raises(InvalidValueError, match=message):
        ask(reward, 2)


def nothing(**kwargs):
    return []


@pytest.mark.parametrize(
    ("judges", "settings", "message"),
    [
        ([broken], {}, r"judges = \['broken'\]: must be at least two: one never disagrees with itself"),
        ([broken, broken], {}, r"names of the judges = \['broken', 'broken'\]: must be different names"),
        ([functools.partial(broken), broken], {}, "must be different names"),
        ({"weight": broken, "b": broken}, {}, "must be others than weight"),
        ([broken, 3], {}, "judge 'int' = 3: must be a reward function or a RewardModel"),
        ({"why": broken, "b": broken}, {}, "why"),
        ([broken, nothing], {"rule": "best"}, r"rule = 'best'"),
        ([broken, nothing], {"weights": [1]}, r"len\(weights\) = 1: must be 2, one per judge"),
        ([broken, nothing], {"weights": [1, 0]}, "weight of judge 'nothing' = 0: must be a finite number > 0"),
        ([broken, nothing], {"scales": [(0, 1)]}, r"len\(scales\) = 1: must be 2"),
        ([broken, nothing], {"scales": [(0, 1), (0, 0)]}, r"scales\[1\]\[1\] = 0"),
        ([broken, nothing], {"scales": [(np.nan, 1), None]}, r"scales\[0\]\[0\] = nan"),
        ([broken, nothing], {"clip": 0}, "clip = 0"),
        ([broken, nothing], {"clip": 1e7}, r"clip = .*in \(0, 1e\+06\]"),
        ([broken, nothing], {"weights": "ab"}, "weights = 'ab': must be a list of 2, one per judge"),
        ([broken, nothing], {"weights": {1, 2}}, "weights = "),
        ([broken, nothing], {"weights": [1e308, 1e-308]}, "weights = .*none vanishes beside another"),
        ([broken, nothing], {"weights": [1, "2"]}, "weight of judge 'nothing' = '2'"),
        ([broken, nothing], {"scales": [(0, 1), 3]}, r"scales\[1\] = 3: must be \(location, deviation\), or None"),
        ([broken, nothing], {"scales": [(0, 1), (0, None)]}, r"scales\[1\]\[1\] = None"),
        ([broken, nothing], {"scales": 1.0}, "scales = 1.0: must be a list of 2"),
        ([broken, nothing], {"timeout": 0}, "timeout of judge 'broken' = 0: must be a finite number"),
        ([broken, nothing], {"timeout": 1e300}, "timeout of judge 'broken' = 1e\\+300"),
        ([broken, nothing], {"timeout": {"nothing": True}}, "timeout of judge 'nothing' = True"),
        ([broken, nothing], {"timeout": {"nothin": 1}}, "did you mean 'nothing'"),
        ([broken, nothing], {"timeout": {"sigma_m": 1}}, "name of a judge in timeout = 'sigma_m'"),
        ([broken, nothing], {"name": "[b]"}, r"name = '\[b\]': must be a text of 1 to 100 printable"),
        ([broken, nothing], {"mitigation": uard_0_1}, "mitigation = "),
        ([broken, nothing], {"sigma_m": 0.3}, "sigma_m = 0.3: must be a function"),
        ([broken, nothing], {"mitigation": named("uard-paper")}, "mitigation.acts_on = 'score'"),
    ],
)
def test_bad_settings(judges, settings, message):
    with pytest.raises(InvalidValueError, match=message):
        UncertaintyDiscountedReward(judges, **settings)


def test_an_unknown_proxy_gets_a_suggestion():
    with pytest.raises(UnknownNameError, match="did you mean 'nothing'"):
        UncertaintyDiscountedReward([broken, nothing], proxy="nothin")


# What normalisation leaves


@pytest.mark.parametrize(
    ("raw", "reward", "divided", "centred"),
    [
        ([0, 1], [0, 0.5], 0, 0.5),  # a factor
        ([0, 1], [-1, 0], 0, 0),  # a shift
        ([0, 1], [1, 0], 2, 2),  # another order
        ([0, 1], [3, 3], 1, 1),  # nothing left
        ([2, 2], [3, 3], np.nan, np.nan),
        ([0, 1, np.nan], [0, 0.5, np.nan], 0, 0.5),
        ([0, 0, 3], [0, 0, 0.3], 0, 0.9),
    ],
)
def test_how_much_the_advantages_change(raw, reward, divided, centred):
    # A second group whose advantages do not change stands beside it.
    both = np.array([5.0, 7.0, *raw]), np.array([5.0, 7.0, *reward])
    groups = np.array([0, 0, *[1] * len(raw)])
    np.testing.assert_allclose(advantage_change(*both, groups), [0, divided], atol=1e-12)
    np.testing.assert_allclose(advantage_change(*both, groups, divided=False), [0, centred], atol=1e-12)


def test_advantages_change_as_their_correlation_says():
    rng = np.random.default_rng(0)
    raw, reward = rng.normal(size=(2, 50))
    rho = np.corrcoef(raw, reward)[0, 1]
    assert advantage_change(raw, reward, np.zeros(50, int)) == pytest.approx([(2 - 2 * rho) ** 0.5])


def test_groups_are_neighbours_with_the_same_prompt():
    assert groups_of(["a", "a", "b", "a"]).tolist() == [0, 0, 1, 2]
    chat = [[{"role": "user", "content": text}] for text in "xxy"]
    assert groups_of(chat).tolist() == [0, 0, 1]
    assert groups_of([]).tolist() == []


@pytest.mark.parametrize(
    ("config", "changes", "kept"),
    [
        (GRPOConfig, {}, False),
        (GRPOConfig, {"scale_rewards": True}, False),
        (GRPOConfig, {"scale_rewards": "none"}, True),
        (GRPOConfig, {"scale_rewards": "batch"}, True),
        (GRPOConfig, {"scale_rewards": "none", "multi_objective_aggregation": "normalize_then_sum"}, False),
        (RLOOConfig, {}, True),
    ],
)
def test_which_configurations_keep_a_factor(config, changes, kept, tmp_path):
    assert keeps_factor(config(output_dir=str(tmp_path), use_cpu=True, bf16=False, **changes)) is kept


def watched(reward, tmp_path, batches=20, size=8, patience=10**6, **changes):
    """Let a callback see some batches of two prompts; return it."""
    args = GRPOConfig(output_dir=str(tmp_path), use_cpu=True, bf16=False, **changes)
    callback = ReliabilityCallback(reward, patience)
    for _ in range(batches):
        ask(reward, size, prompts=["p"] * (size // 2) + ["q"] * (size // 2))
        callback.on_step_end(args, TrainerState(), TrainerControl())
    return callback


def test_a_factor_is_lost_where_groups_are_divided_and_only_there(tmp_path):
    def doubted():
        ensemble = says([20.0] * 4 + [0.0] * 4)  # the first prompt is doubted, not its completions
        scores = list(range(8))
        mitigation = uard_0_1(anchor="zero", prior_count=0.0)
        return UncertaintyDiscountedReward(panel(scores, scores), sigma_m=ensemble, mitigation=mitigation)

    with pytest.warns(DiscountCancelledWarning, match="scale_rewards='batch' or 'none'") as caught:
        callback = watched(doubted(), tmp_path)
    assert sum(warning.category is DiscountCancelledWarning for warning in caught) == 1
    assert callback.reward.tally.discounted == callback.reward.tally.cancelled == 20
    assert callback.reward.tally.shifted == 0
    watched(doubted(), tmp_path, scale_rewards="none")  # warnings are errors


@pytest.mark.parametrize("scale_rewards", ["group", "none"])
def test_a_shift_is_always_lost(scale_rewards, tmp_path):
    quality = np.tile(np.arange(4.0), 2)
    dispute = np.repeat([6.0, 0.0], 4)  # about the first prompt, by the same amount for all its completions
    reward = UncertaintyDiscountedReward(panel(quality + dispute, quality - dispute), scales=AS_THEY_ARE[:2], clip=99)
    with pytest.warns(DiscountCancelledWarning, match="disagree about prompts, not about completions"):
        watched(reward, tmp_path, scale_rewards=scale_rewards)
    assert reward.tally.shifted == reward.tally.discounted == 20


def test_a_discount_within_groups_survives(tmp_path):
    scores = [0, 1, 2, 3] * 2
    reward = UncertaintyDiscountedReward(panel(scores, scores, [0, 1, 2, -30] * 2), scales=AS_THEY_ARE, clip=99)
    watched(reward, tmp_path)  # warnings are errors
    assert reward.tally.discounted == 40
    assert reward.tally.cancelled == 0


# What else the callback sees


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ([[0, 1], [0, 3], [4, 4]], "judge 'judge 2' gives every completion the same score"),
        ([[0, 1], [1, 0], [None, None]], "judge 'judge 2' has not scored any completion"),
        ([[0, 1], [0, 2], [1, 3]], "the judges have never disagreed"),
    ],
)
def test_useless_judges(columns, message, tmp_path):
    reward = UncertaintyDiscountedReward(panel(*columns))
    with pytest.warns(UselessJudgeWarning) as caught:
        watched(reward, tmp_path, size=2, patience=8)
    assert sum(message in str(warning.message) for warning in caught) == 1


def test_a_reward_that_is_not_called(tmp_path):
    with pytest.warns(UselessJudgeWarning, match="has not been called"):
        ReliabilityCallback(UncertaintyDiscountedReward(panel([1], [2]))).on_step_end(
            GRPOConfig(output_dir=str(tmp_path), use_cpu=True, bf16=False), TrainerState(), TrainerControl()
        )


def test_the_callback_takes_no_other_reward():
    with pytest.raises(InvalidValueError, match=r"reward = .*must be an UncertaintyDiscountedReward"):
        ReliabilityCallback(broken)  # pyright: ignore[reportArgumentType]


def test_the_report(tmp_path):
    text = watched(by_the_old_rule(panel([0, 1], [0, None])), tmp_path, batches=2, size=2).report()
    assert text.startswith("4 completions, 0 without any score, 4 that could not be checked; mean weight 0.10")
    assert "judge judge 1: deviation 0, 2 scores missing" in text


# Importing and pickling


def test_the_reward_needs_neither_trl_nor_torch():
    code = (
        "import sys\n"
        "from uard.adapters.trl import UncertaintyDiscountedReward\n"
        "f = UncertaintyDiscountedReward({'a': lambda **k: [1, 2], 'b': lambda **k: [2, 1]})\n"
        "f(prompts=['p', 'p'], completions=['x', 'y'])\n"
        "print([m for m in ('trl', 'transformers', 'torch', 'jax', 'gymnasium') if m in sys.modules])\n"
        "sys.modules['transformers'] = None\n"
        "try:\n    from uard.adapters.trl import ReliabilityCallback\n"
        "except ImportError as error:\n    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    loaded, message = done.stdout.splitlines()
    assert loaded == "[]"
    assert message.startswith("ReliabilityCallback needs transformers: pip install 'uard[trl]'")


def test_other_names_do_not_resolve():
    import uard.adapters.trl

    with pytest.raises(AttributeError, match="has no attribute 'nonsense'"):
        uard.adapters.trl.nonsense  # noqa: B018


def test_pickling_keeps_all_that_is_known():
    prompts, texts = ["p"] * 4, ["sun rain", "wow wow wow", "um so", "storm wind sun"]
    reward = UncertaintyDiscountedReward(example.JUDGES)
    reward(prompts=prompts, completions=texts)
    twin = pickle.loads(pickle.dumps(reward))
    more = ["snow", "wow", "like like", "sun sun"]
    assert twin(prompts=prompts, completions=more) == reward(prompts=prompts, completions=more)
    assert twin.tally == reward.tally


# The file that keeps it


def learned(tmp_path, judges=3):
    """A reward that has seen a batch, and the file that it has written."""
    reward = UncertaintyDiscountedReward(example.JUDGES[:judges])
    reward(prompts=["p"] * 4, completions=["sun rain", "wow wow wow", "um so", "storm wind sun"])
    reward.save(tmp_path / "reward.json")
    return reward, tmp_path / "reward.json"


def test_a_file_keeps_all_that_is_known(tmp_path):
    reward, file = learned(tmp_path)
    twin = UncertaintyDiscountedReward(example.JUDGES)
    twin.load(file)
    for _ in range(3):
        question = {"prompts": ["p"] * 4, "completions": ["snow", "wow", "like like", "sun sun"]}
        assert twin(**question) == reward(**question)
    assert twin.tally == reward.tally
    assert twin.deviations == reward.deviations


@pytest.mark.parametrize("seen", [[[0, 0, 9], [1, 2, 3]], [[None] * 3, [5, 5, 5]], None])
def test_a_lone_score_and_an_empty_memory_are_kept(seen, tmp_path):
    later = [1, 2, 3], [3, 2, 1]
    reward = UncertaintyDiscountedReward({f"judge {k}": says(*([seen[k]] if seen else []), later[k]) for k in (0, 1)})
    if seen:
        ask(reward, 3)
    reward.save(tmp_path / "reward.json")
    twin = UncertaintyDiscountedReward(panel(*later))
    twin.load(tmp_path / "reward.json")
    assert ask(twin, 3) == ask(reward, 3)


def test_given_scales_stay_when_a_file_is_read(tmp_path):
    _, file = learned(tmp_path, judges=2)
    reward = UncertaintyDiscountedReward(example.JUDGES[:2], scales=[(0.0, 3.0), None])
    reward.load(file)
    assert reward.deviations["relevance"] == 3
    assert 0 < reward.deviations["clarity"] != 3


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b'"version": 1', b'"version": 2'),
        (b'"relevance", ', b""),
        (b'"mean": ', b'"mean": NaN, "x": '),
        (b'"sd": ', b'"sd": -'),
        (b'"completions": 4', b'"completions": -4'),
        (b'"completions": 4', b'"completions": true'),
        (b'"completions": 4', b'"completions": "4"'),
        (b'"completions": 4, ', b""),
        (b'"late"', b'"early"'),
        (b'"data": [', b'"data": [1.0, '),
        (b'"shape": [4, ', b'"shape": [2, 2, '),
        (b"[1.0, ", b"[1e999, "),
        (b'"seen": 4', b'"seen": 5'),
        (b'"PCG64"', b'"MT19937"'),
        (b"{", b"[" * 10**5),
        (b"}", b""),
        (b'{"format"', b"\x80\x05cos\nsystem\n"),
    ],
)
def test_a_file_that_is_damaged_or_of_others_is_refused_and_changes_nothing(old, new, tmp_path):
    _, file = learned(tmp_path)
    content = file.read_bytes()
    assert old in content
    file.write_bytes(content.replace(old, new))
    (tmp_path / "other").mkdir()
    reward, _ = learned(tmp_path / "other")
    before, deviations = copy.deepcopy(reward.tally), reward.deviations
    with pytest.raises(InvalidValueError, match=r"file of a reward = .*reward\.json.*: must be one that a reward of"):
        reward.load(file)
    assert (reward.tally, reward.deviations) == (before, deviations)


@pytest.mark.parametrize("share", [0, 0.3, 0.9, 0.999])
def test_a_truncated_file_is_refused(share, tmp_path):
    _, file = learned(tmp_path)
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    with pytest.raises(InvalidValueError, match="file of a reward"):
        UncertaintyDiscountedReward(example.JUDGES).load(file)
    with pytest.raises(InvalidValueError, match="No such file"):
        UncertaintyDiscountedReward(example.JUDGES).load(tmp_path / "none.json")


def test_a_file_of_other_judges_is_refused(tmp_path):
    _, file = learned(tmp_path)
    with pytest.raises(InvalidValueError, match=r"must be \['relevance', 'clarity'\], those of this reward"):
        UncertaintyDiscountedReward(example.JUDGES[:2]).load(file)


def test_saving_that_fails_leaves_the_old_file(tmp_path, monkeypatch):
    reward, file = learned(tmp_path)
    before = file.read_bytes()
    monkeypatch.setattr(os, "fsync", lambda descriptor: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        reward.save(file)
    assert file.read_bytes() == before
    assert list(tmp_path.iterdir()) == [file]


class Trap:
    """What executes something when it is unpickled."""

    def __reduce__(self):
        return os.mkdir, ("executed",)


def test_a_pickle_of_an_old_checkpoint_is_not_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "checkpoint-2"
    folder.mkdir()
    (folder / "uard_reward_0.pkl").write_bytes(pickle.dumps(Trap()))
    args = GRPOConfig(output_dir=str(tmp_path), use_cpu=True, bf16=False)
    callback = ReliabilityCallback(UncertaintyDiscountedReward(example.JUDGES))
    with pytest.raises(InvalidValueError, match=r"uard_reward_0\.pkl.*must be uard_reward_0\.json; a pickle executes"):
        callback.on_train_begin(args, TrainerState(global_step=2), TrainerControl())
    assert not (tmp_path / "executed").exists()


# Reward models


def classifier(labels):
    set_seed(labels)
    config = Qwen2Config(
        vocab_size=len(example.WORDS),
        hidden_size=16,
        intermediate_size=32,
        num_hidden_layers=1,
        num_attention_heads=2,
        num_key_value_heads=2,
        num_labels=labels,
    )
    return Qwen2ForSequenceClassification(config)


def test_a_reward_model_reads_prompt_and_completion():
    model, tokenizer = classifier(1), example.tokenizer()
    judge = RewardModel(model, tokenizer, batch_size=2)
    prompts, completions = ["describe ", "describe ", "weather "], ["sun", "sun rain wind", "wow"]
    expected = []
    for text in ("describe sun", "describe sun rain wind", "weather wow"):
        ids = torch.tensor([[example.WORDS.index(word) for word in text.split()]])
        expected.append(float(model(input_ids=ids).logits[0, 0].detach()))
    assert judge(prompts=prompts, completions=completions) == pytest.approx(expected, abs=1e-5)
    assert judge.__name__ == "reward_model"


def test_a_reward_model_reads_conversations():
    tokenizer = example.tokenizer()
    tokenizer.chat_template = "{% for m in messages %}{{ m['content'] }} {% endfor %}"
    judge = RewardModel(classifier(1), tokenizer)
    chat = judge(
        prompts=[[{"role": "user", "content": "sun"}]], completions=[[{"role": "assistant", "content": "rain"}]]
    )
    assert chat == pytest.approx(judge(prompts=["sun "], completions=["rain"]), abs=1e-6)


def test_a_model_with_heads_is_an_ensemble():
    heads = RewardModel(classifier(3), example.tokenizer())
    reward = UncertaintyDiscountedReward([example.relevance, example.clarity], sigma_m=heads)
    reward(prompts=["describe "] * 2, completions=["sun rain", "wow wow"])
    assert (reward.last.sigma_m > 0).all()
    with pytest.raises(InvalidValueError, match="score 0 of judge 'reward_model'"):
        UncertaintyDiscountedReward([heads, example.clarity])(prompts=["describe "], completions=["sun"])


def test_texts_that_a_reward_model_cannot_read_have_no_score():
    model, tokenizer = classifier(1), example.tokenizer()
    model.config.max_position_embeddings = 4
    judge = RewardModel(model, tokenizer, batch_size=3)
    prompts = ["", "describe ", "describe ", "describe ", ""]
    scores = judge(prompts=prompts, completions=["", "sun", "sun sun sun sun", "sun sun sun", ""])
    assert [score is None for score in scores] == [True, False, True, False, True]
    assert scores[1] == pytest.approx(judge(prompts=["describe "], completions=["sun"])[0], abs=1e-6)
    assert judge(prompts=[], completions=[]) == []
    with pytest.raises(InvalidValueError, match="number of prompts = 1: must be 2"):
        judge(prompts=[""], completions=["sun", "rain"])


def test_a_reward_model_that_gives_nan_has_no_score():
    model = classifier(1)
    torch.nn.init.constant_(model.score.weight, torch.nan)
    reward = UncertaintyDiscountedReward([RewardModel(model, example.tokenizer()), *example.JUDGES])
    rewards = reward(prompts=["describe "] * 2, completions=["sun", "um wow"])
    assert np.isfinite(rewards).all()
    assert reward.tally.missing["reward_model"] == 2


def test_a_bare_model_is_refused_with_advice():
    with pytest.raises(InvalidValueError, match=r"must be a function: RewardModel\(model, tokenizer\)"):
        UncertaintyDiscountedReward([example.clarity, classifier(1)])


# Training


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_discount_keeps_grpo_from_the_hack(seed, tmp_path):
    reward = UncertaintyDiscountedReward(example.JUDGES)
    undiscounted = UncertaintyDiscountedReward(example.JUDGES, mitigation=named("raw"))
    added_up, _ = example.train(example.JUDGES, seed, tmp_path / "sum")
    one_scale, _ = example.train([undiscounted], seed, tmp_path / "raw")
    discounted, _ = example.train([reward], seed, tmp_path / "uard", callbacks=[ReliabilityCallback(reward)])
    end = slice(-5, None)
    assert np.mean(added_up.exploit[end]) > 0.9  # it says little else but "wow"
    assert np.mean(discounted.exploit[end]) < 0.3
    assert np.mean(discounted.gold[end]) > np.mean(added_up.gold[end]) + 4
    # One scale alone lets the hack grow first; the discount never does.
    assert max(one_scale.exploit) > 0.6
    assert max(discounted.exploit) < 0.4
    assert np.mean(discounted.gold) > np.mean(one_scale.gold) + 0.5
    assert reward.tally.completions == 30 * 32
    assert reward.tally.cancelled < 0.1 * reward.tally.discounted


def sometimes(completions, **kwargs):
    return [None if text.startswith("sun") else float(len(text)) for text in completions]


def relevant_if_there(completions, **kwargs):
    scores = example.relevance(completions)
    return [None if text.startswith("sun") else score for text, score in zip(completions, scores, strict=True)]


@pytest.fixture(params=[(GRPOTrainer, GRPOConfig), (RLOOTrainer, RLOOConfig)], ids=["grpo", "rloo"])
def with_gaps(request, tmp_path):
    """A short run of each trainer in which some completions get no score."""
    trainer_class, config = request.param
    reward = UncertaintyDiscountedReward([sometimes, relevant_if_there])
    set_seed(0)
    args = config(
        output_dir=str(tmp_path),
        per_device_train_batch_size=16,
        num_generations=4,
        max_completion_length=6,
        max_steps=3,
        beta=0.0,  # else TRL would load a reference model by its name
        report_to="none",
        save_strategy="no",
        logging_steps=1,
        log_completions=True,
        num_completions_to_print=1,
        disable_tqdm=True,
        use_cpu=True,
        bf16=False,
    )
    trainer = trainer_class(
        model=example.language_model(0),
        reward_funcs=reward,
        args=args,
        train_dataset=Dataset.from_dict({"prompt": example.PROMPTS * 4}),
        processing_class=example.tokenizer(),
        callbacks=[ReliabilityCallback(reward)],
    )
    with pytest.warns(UnscoredWarning):
        trainer.train()
    return reward, trainer


def test_training_with_missing_scores_stays_finite_and_says_so(with_gaps, tmp_path):
    reward, trainer = with_gaps
    steps = [entry for entry in trainer.state.log_history if "uard/weight" in entry]
    assert len(steps) == 3
    assert reward.tally.completions == 3 * 16
    assert 0 < reward.tally.unscored == reward.tally.missing["sometimes"]
    assert np.mean([entry["uard/unscored"] for entry in steps]) == pytest.approx(reward.tally.unscored / 48)
    assert all(np.isfinite([entry["loss"], entry["reward"], entry["grad_norm"]]).all() for entry in steps)
    if not isinstance(trainer, GRPOTrainer):
        return  # RLOO prints the table of completions, but does not write it
    table = pd.concat(pd.read_parquet(file) for file in sorted((tmp_path / "completions").glob("*.parquet")))
    assert len(table) == 48
    dropped, kept = table[table["uard"].isna()], table[table["uard"].notna()]
    assert len(dropped) == reward.tally.unscored
    assert dropped["completion"].str.startswith("sun").all()
    assert (dropped["advantage"] == 0).all()
    assert kept["uard/weight"].between(0, 1).all()
    assert (kept["uard/sometimes"] == kept["completion"].str.len()).all()


def test_resuming_goes_on_with_what_was_known(tmp_path, caplog):
    def run(folder, **changes):
        reward = UncertaintyDiscountedReward(example.JUDGES)
        _, trainer = example.train([reward], 0, folder, callbacks=[ReliabilityCallback(reward)], **changes)
        return reward, trainer

    saving = {"save_strategy": "steps", "save_steps": 2, "max_steps": 4}
    with caplog.at_level(logging.INFO, "uard.adapters"):
        whole, _ = run(tmp_path / "a", **saving)
    assert "128 completions" in caplog.text
    resumed, _ = run(tmp_path / "a", resume=str(tmp_path / "a" / "checkpoint-2"), **saving)
    assert resumed.tally == whole.tally
    assert resumed.deviations == whole.deviations
    (tmp_path / "a" / "checkpoint-2" / "uard_reward_0.json").unlink()
    with pytest.warns(ForgottenWarning, match="resumed at step 2"):
        forgetful, _ = run(tmp_path / "a", resume=str(tmp_path / "a" / "checkpoint-2"), **saving)
    assert forgetful.tally.completions == 64


@pytest.mark.parametrize(
    ("trainer_class", "config"), [(GRPOTrainer, GRPOConfig), (RLOOTrainer, RLOOConfig)], ids=["grpo", "rloo"]
)
def test_an_evaluation_teaches_the_reward_nothing(trainer_class, config, tmp_path):
    modes = []

    def run(folder, **changes):
        set_seed(0)
        reward = UncertaintyDiscountedReward(example.JUDGES)
        args = config(
            output_dir=str(tmp_path / folder),
            per_device_train_batch_size=8,
            per_device_eval_batch_size=8,
            num_generations=4,
            max_completion_length=6,
            max_steps=3,
            beta=0.0,
            report_to="none",
            save_strategy="no",
            logging_strategy="no",
            disable_tqdm=True,
            use_cpu=True,
            bf16=False,
            **changes,
        )

        def watch(completions, **kwargs):
            modes.append(trainer.model.training)
            return [0.0] * len(completions)

        trainer = trainer_class(
            model=example.language_model(0),
            reward_funcs=[reward, watch],
            args=args,
            train_dataset=Dataset.from_dict({"prompt": example.PROMPTS * 4}),
            eval_dataset=Dataset.from_dict({"prompt": example.PROMPTS}),
            processing_class=example.tokenizer(),
            callbacks=[ReliabilityCallback(reward)],
        )
        before = trainer.evaluate()  # before training, when nothing is known
        assert reward.tally.completions == 0
        trainer.train()
        known = copy.deepcopy(reward.tally), reward.deviations
        trainer.evaluate()
        assert (reward.tally, reward.deviations) == known
        assert np.isfinite(before["eval_reward"])
        return reward

    reward = run("a", eval_strategy="steps", eval_steps=1)
    assert modes.count(True) == 3
    assert modes.count(False) >= 5 * 2
    assert reward.tally.completions == 3 * 8


def test_whom_evaluation_warns_of_training_warns_of_too():
    """What is warned of in evaluation is not counted there, so that training must not keep silent about it."""
    broken = []

    def breaks(completions, **question):
        if broken:
            raise OSError("no route")
        return [float(len(text)) for text in completions]

    reward = UncertaintyDiscountedReward({"breaks": breaks, "b": lambda completions, **_: [1.0, 2.0]})
    reward(["p", "p"], ["one", "three"])
    broken.append(True)
    with reward.paused(), pytest.warns(FailedJudgeWarning):
        reward(["p", "p"], ["one", "three"])
    assert reward.tally.failed["breaks"] == 0
    with pytest.warns(FailedJudgeWarning):
        reward(["p", "p"], ["one", "three"])
    assert reward.tally.failed["breaks"] == 1


def test_a_failure_that_the_panel_knows_is_missing_in_the_logs():
    panel = JudgePanel((FittedJudge("a", sentinels=(-1.0,)), FittedJudge("b")))
    reward = UncertaintyDiscountedReward({"a": lambda **_: [-1.0, 2.0], "b": lambda **_: [1.0, 2.0]}, panel)
    columns, means = {}, {}
    reward(["p", "p"], ["x", "y"], log_extra=columns.__setitem__, log_metric=means.__setitem__)
    assert columns["uard/a"] == [None, 2.0]
    assert (means["uard/a/missing"], means["uard/a/mean"]) == (0.5, 2.0)
    assert reward.tally.missing == {"a": 1, "b": 0}


def test_running_scales_take_a_rule_by_its_name():
    judges = {"a": lambda **_: [1.0, 2.0, 4.0], "b": lambda **_: [1.0, 2.0, -9.0]}
    by_name = UncertaintyDiscountedReward(judges, rule="lowest")
    by_mitigation = UncertaintyDiscountedReward(judges, mitigation=named("worst-of-annotations"))
    batch = ["p"] * 3, ["x", "y", "z"]
    assert by_name(*batch) == by_mitigation(*batch)
