"""A panel of judges: fitted once, it gives each completion one reward, whatever stands beside it."""

import json
import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uard import InvalidValueError
from uard._checks import UnknownNameError
from uard.judges import RULES, FittedJudge, JudgePanel, ScoreLog, fit, read_scores, rule
from uard.method.mitigations import Evidence, named
from uard.ratings.aggregate import aggregate

NAMES = ("a", "b", "c")


def simulated(seed=0, prompts=60, siblings=6):
    """Three judges of one quality; b scores about 50, and c gives one completion in ten 3 for nothing."""
    random = np.random.default_rng(seed)
    n = prompts * siblings
    quality = random.normal(size=n)
    own = random.normal(size=(n, 3))
    scores = np.stack([quality, 50 + 10 * quality, quality], 1) + own * [0.4, 4.0, 0.4]
    scores[random.random(n) < 0.1, 2] += 3.0
    return ScoreLog(NAMES, scores, [f"p{i // siblings}" for i in range(n)], quality)


LOG = simulated()
FITTED = fit(LOG)
PANEL = FITTED.panel


# What a fit finds


def test_scales_are_those_of_the_judges():
    a, b, c = PANEL.judges
    assert (a.location, a.scale) == (pytest.approx(0.0, abs=0.2), pytest.approx(1.08, abs=0.15))
    assert (b.location, b.scale) == (pytest.approx(50.0, abs=2.0), pytest.approx(10.8, abs=1.5))
    assert c.location == pytest.approx(0.3, abs=0.2)
    assert all(judge.counts and judge.heard and judge.tells_apart for judge in PANEL.judges)
    assert FITTED.redundant == ()


def test_one_absurd_score_moves_no_scale():
    scores = LOG.scores.copy()
    scores[7, 0] = 1e9
    judge = fit(ScoreLog(NAMES, scores)).panel.judges[0]
    assert judge.scale == pytest.approx(PANEL.judges[0].scale, rel=0.25)


def test_who_cannot_tell_siblings_apart_is_left_out_and_named():
    of_prompt = np.repeat(np.random.default_rng(1).normal(size=60), 6)
    log = ScoreLog((*NAMES, "prompt"), np.column_stack([LOG.scores, of_prompt]), LOG.prompts)
    fitted = fit(log)
    assert [judge.tells_apart for judge in fitted.panel.judges] == [True, True, True, False]
    assert "judge 'prompt' is left out: it tells no completions apart" in fitted.warnings()
    assert "never tells the completions of one prompt apart" in " ".join(str(fitted).split())
    with_it, without = fitted.panel.combine(log.scores), PANEL.combine(LOG.scores)
    assert with_it.reward == pytest.approx(without.reward)
    assert fit(ScoreLog(log.judges, log.scores)).panel.judges[3].tells_apart is None  # prompts are not known


def test_failures_written_as_a_score_are_found_or_declared():
    scores = LOG.scores.copy()
    scores[::9, 1] = 0.0
    fitted = fit(ScoreLog(NAMES, scores, LOG.prompts))
    assert fitted.panel.judges[1].sentinels == (0.0,)
    assert fitted.panel.judges[1].missing == pytest.approx(1 / 9, abs=0.01)
    assert "0 (40 times) is a failure, no score" in " ".join(str(fitted).split())
    combined = fitted.panel.combine(scores[:10])
    assert np.isnan(combined.ratings[[0, 9], 1]).all()
    declared = fit(ScoreLog(NAMES, scores, LOG.prompts), failures={"b": [0.0]}).panel
    assert declared == fitted.panel
    assert fit(ScoreLog(NAMES, scores, LOG.prompts), failures={"a": [-9.0]}).panel.judges[1].sentinels == (0.0,)
    of_all = fit(ScoreLog(NAMES, scores, LOG.prompts, missing=(-1.0,))).panel
    assert [judge.sentinels for judge in of_all.judges] == [(-1.0,), (-1.0, 0.0), (-1.0,)]
    with pytest.raises(UnknownNameError, match="name of a judge in failures = 'd'"):
        fit(LOG, failures={"d": [0.0]})


def test_copies_are_redundant():
    log = ScoreLog((*NAMES, "copy"), np.column_stack([LOG.scores, 3.0 * LOG.scores[:, 0] - 7.0]), LOG.prompts)
    fitted = fit(log)
    assert [pair[:2] for pair in fitted.redundant] == [("a", "copy")]
    assert "the same as copy" in " ".join(str(fitted).split())
    assert "judges 'a' and 'copy' say the same (correlation 1.00): leave one out, or it counts twice" in " ".join(
        str(fitted).split()
    )
    random = np.random.default_rng(1)
    nearly = np.column_stack([LOG.scores, LOG.scores[:, 0] + 0.1 * random.normal(size=len(LOG.scores))])
    assert "redundant beside copy" in str(fit(ScoreLog((*NAMES, "copy"), nearly, LOG.prompts)))


def test_a_judge_who_says_the_opposite_is_named_and_hides_no_copies():
    log = ScoreLog((*NAMES, "minus"), np.column_stack([LOG.scores, -LOG.scores[:, 0]]), LOG.prompts)
    fitted = fit(log)
    assert "judge 'minus' says the opposite of the others: is its score the wrong way round?" in fitted.warnings()
    assert fitted.effective is None
    assert fitted.as_data()["effective"] is None
    assert "independent judges: not known (not while judges contradict each other" in " ".join(str(fitted).split())
    assert fit(LOG).effective is not None


def test_nine_judges_that_err_together_are_few_and_it_says_so():
    random = np.random.default_rng(2)
    truth, shared, own = random.normal(size=(400, 1)), random.normal(size=(400, 1)), random.normal(size=(400, 9))
    names = tuple("abcdefghi")
    fitted = fit(ScoreLog(names, truth + shared + 0.5 * own, truth=truth[:, 0]))
    worth = fitted.summary.effective.number
    assert worth.low < 9 / (1 + 8 * 0.8) < worth.high
    assert any("they err together" in warning for warning in fitted.warnings())
    independent = fit(ScoreLog(names, truth + own, truth=truth[:, 0]))
    assert [warning[:10] for warning in independent.warnings()] == ["no prompts"]


def test_a_judge_with_too_few_scores_is_an_error():
    scores = LOG.scores.copy()
    scores[9:, 2] = np.nan
    with pytest.raises(InvalidValueError, match="scores of judge 'c' = 9: must be at least 10"):
        fit(ScoreLog(NAMES, scores, LOG.prompts))


def test_a_constant_judge_is_left_out():
    fitted = fit(ScoreLog((*NAMES, "one"), np.column_stack([LOG.scores, np.ones(len(LOG.scores))])))
    assert fitted.panel.judges[3].scale == 0
    assert "always the same score: left out" in " ".join(str(fitted).split())
    assert np.isnan(fitted.panel.combine(np.ones((2, 4))).ratings[:, 3]).all()
    assert not fitted.panel.judges[3].heard


def test_what_nobody_confirms_is_said():
    random = np.random.default_rng(99)
    alone = np.column_stack([LOG.scores, random.normal(size=len(LOG.scores))])
    fitted = fit(ScoreLog((*NAMES, "noise"), alone, LOG.prompts))
    assert any(w.startswith("judge 'noise' has nothing in common with the others") for w in fitted.warnings())
    nothing = fit(ScoreLog(NAMES, random.normal(size=(300, 3)), LOG.prompts[:300]))
    assert "these judges have nothing in common: no score is confirmed by another one" in nothing.warnings()
    assert nothing.effective is None


def test_one_absurd_score_a_copy_and_noise_hide_no_failures_of_another_judge():
    random = np.random.default_rng(3)
    quality = random.normal(size=300)
    scores = 5 + 2 * quality[:, None] + random.normal(size=(300, 3)) * [0.8, 0.8, 0.8]
    failing = random.random(300) < 0.05
    scores[failing, 0] = -1.0
    prompts = [i // 6 for i in range(300)]
    for change in ("nothing", "absurd", "copy", "noise", "opposite"):
        names, said = ("a", "b", "c"), scores.copy()
        if change == "absurd":
            said[7, 2] = 1e9
        elif change in ("copy", "noise"):
            more = said[:, 0] if change == "copy" else random.normal(size=300)
            names, said = (*names, "d"), np.column_stack([said, more])
        elif change == "opposite":
            said[:, 2] *= -1
        assert fit(ScoreLog(names, said, prompts)).panel.judges[0].sentinels == (-1.0,), change


def test_declared_failures_replace_the_search_and_one_that_never_occurs_is_named():
    scores = LOG.scores.copy()
    scores[::9, 1] = 0.0
    log = ScoreLog(NAMES, scores, LOG.prompts)
    found = fit(log)
    assert "judge 'b': 0 (40 times) is taken for a failure; if it is a score: --failures b=" in found.warnings()
    assert fit(log, failures={"b": []}).panel.judges[1].sentinels == ()
    wrong = fit(log, failures={"b": [-2.0]})
    assert wrong.panel.judges[1].sentinels == (-2.0,)
    assert "judge 'b' never says -2 in this log, which was declared a failure" in wrong.warnings()
    with pytest.raises(InvalidValueError, match="failures of judge 'b' = -2: must be a list"):
        fit(log, failures={"b": -2})


def test_judges_who_never_score_the_same_are_an_error_and_few_completions_are_said():
    scores = np.where(np.arange(90)[:, None] % 3 == np.arange(3), LOG.scores[:90], np.nan)
    with pytest.raises(InvalidValueError, match="judge 'a' and another one have both scored = 0: must be at least 10"):
        fit(ScoreLog(NAMES, scores, LOG.prompts[:90]))
    assert fit(ScoreLog(NAMES, LOG.scores[:60], LOG.prompts[:60])).warnings()[0].startswith("only 60 completions")
    with pytest.raises(InvalidValueError, match=r"log = 'scores.jsonl': must be a ScoreLog"):
        fit("scores.jsonl")


def test_a_panel_of_numbers_of_numpy_is_saved(tmp_path):
    judges = (FittedJudge("a", np.float32(1), np.float32(2), heard=np.bool_(True)), FittedJudge("b"))
    panel = JudgePanel(judges, weights=np.array([1, 2]), clip=np.float32(4))
    panel.save(tmp_path / "panel.json")
    assert JudgePanel.load(tmp_path / "panel.json") == panel
    with pytest.raises(InvalidValueError, match="sentinels of judge 'a' = -1: must be a tuple"):
        FittedJudge("a", sentinels=-1)
    with pytest.raises(InvalidValueError, match=r"judges = .*must be FittedJudge"):
        JudgePanel(("a", "b"))


# What a panel makes of scores


def test_it_is_the_mitigation_on_standardised_scores():
    ratings = np.stack([j.standardised(x) for j, x in zip(PANEL.judges, LOG.scores.T, strict=True)], 1).clip(-5, 5)
    proxy = ratings.mean(1)
    feedback, uard = aggregate(ratings, proxy), named("uard")
    why = uard.explain(Evidence(proxy, 0 * proxy, feedback), uard.fit(feedback, feedback.count > 0))
    combined = PANEL.combine(LOG.scores)
    assert combined.reward == pytest.approx(why.signal.reward, abs=1e-9)
    assert combined.weight == pytest.approx(why.weight, abs=1e-9)
    assert combined.tau == pytest.approx(why.sigma_h, abs=1e-9)


def test_what_a_judge_hacks_is_doubted():
    honest, hacked = PANEL.combine({"a": [1.0, 0.0], "b": [60.0, 50.0], "c": [1.0, 4.5]}).weight
    assert honest > 0.9
    assert hacked < 0.5


@pytest.mark.parametrize("name", RULES)
def test_no_row_depends_on_another(name):
    panel = fit(LOG, rule=name).panel
    scores = LOG.scores[:40].copy()
    scores[::3, 0] = np.nan
    scores[5] = np.nan
    whole = panel.combine(scores)
    order = np.random.default_rng(3).permutation(40)
    single = [panel.combine(scores[[i]]) for i in range(40)]
    for field in ("reward", "weight", "tau", "proxy"):
        values = getattr(whole, field)
        assert np.array_equal(values, [getattr(one, field)[0] for one in single], equal_nan=True)
        assert np.array_equal(values[order], getattr(panel.combine(scores[order]), field), equal_nan=True)
    assert np.isnan(whole.reward[5])
    assert np.isfinite(np.delete(whole.reward, 5)).all()


HAND = {  # three judges say 1, 2 and 6 standard deviations
    "mean": 3.0,
    "median": 2.0,
    "lowest": 1.0,
    "uwo": 3.0 - 0.5 * 14 / 3,
    "log-mean-exp": -np.log((np.exp(-1) + np.exp(-2) + np.exp(-6)) / 3),
    "lcb": 3.0 - np.sqrt(14 / 4),  # the proxy, their mean, is one more
}


@pytest.mark.parametrize("name", HAND)
def test_rules_by_hand(name):
    panel = JudgePanel(tuple(map(FittedJudge, NAMES)), rule=name, clip=10.0)
    assert panel.combine(np.array([[1.0, 2.0, 6.0]])).reward[0] == pytest.approx(HAND[name])


def test_proxies():
    scores = np.array([[1.0, 2.0, 4.5], [1.0, np.nan, 2.0]])
    judges = tuple(map(FittedJudge, NAMES))
    assert JudgePanel(judges).combine(scores).proxy.tolist() == [2.5, 1.5]
    assert JudgePanel(judges, proxy="median").combine(scores).proxy.tolist() == [2.0, 1.5]
    assert JudgePanel(judges, proxy="b").combine(scores).proxy.tolist() == [2.0, 1.5]
    weighted = JudgePanel(judges, weights=(3.0, 1.0, 1.0))
    assert weighted.combine(scores).proxy.tolist() == pytest.approx([(3 + 2 + 4.5) / 5, (3 + 2) / 4])


def test_why():
    combined = PANEL.combine({"a": [1.0, 0.0, None, None], "b": [60.0, 50.0, 40.0, None], "c": [1.0, 4.5, None, None]})
    assert combined.why(0).startswith("agreed (")
    assert combined.why(1).startswith("contested (c +3")
    assert (
        combined.why(2)
        == f"b {(40 - PANEL.judges[1].location) / PANEL.judges[1].scale:+.1f} alone: nobody to compare with"
    )
    assert combined.why(3) == "no judge scored it"
    assert combined.weight[2] == pytest.approx(0.05)  # as what nobody has rated
    assert combined.tau[2] == 0


@given(st.lists(st.lists(st.none() | st.floats(-1e12, 1e12), min_size=3, max_size=3), min_size=1, max_size=8))
def test_no_nan_but_where_nobody_scored(rows):
    scores = np.array([[np.nan if x is None else x for x in row] for row in rows])
    combined = PANEL.combine(scores)
    nobody = np.isnan(scores).all(1)
    assert np.array_equal(np.isnan(combined.reward), nobody)
    assert np.isfinite(combined.tau).all()
    assert ((combined.weight >= 0) & (combined.weight <= 1))[~nobody].all()


def test_threads_and_pickles_give_the_same():
    scores = LOG.scores[:64]
    expected = PANEL.combine(scores).reward
    copy = pickle.loads(pickle.dumps(PANEL))
    with ThreadPoolExecutor(32) as pool:
        for reward in pool.map(lambda _: copy.combine(scores).reward, range(200)):
            assert np.array_equal(reward, expected)


# Its file


def test_a_file_holds_all_of_it(tmp_path):
    PANEL.save(tmp_path / "panel.json")
    assert JudgePanel.load(tmp_path / "panel.json", ["c", "b", "a"]) == PANEL
    changed = fit(LOG, rule=rule("uwo", k=2.0), proxy="median").panel
    changed.save(tmp_path / "panel.json")
    assert JudgePanel.load(tmp_path / "panel.json") == changed


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda kept: kept | {"version": 2}, "version = 2: must be 1: fit again"),
        (lambda kept: kept | {"format": "x"}, "format = 'x'"),
        (lambda kept: kept | {"usual": 9.0}, "was the file changed by hand"),
        (lambda kept: kept["judges"], "format = None"),
        (lambda kept: {}, "format = None"),
    ],
)
def test_other_files_are_refused(tmp_path, change, message):
    file = tmp_path / "panel.json"
    PANEL.save(file)
    file.write_text(json.dumps(change(json.loads(file.read_text()))))
    with pytest.raises(InvalidValueError, match=message) as info:
        JudgePanel.load(file)
    assert str(file) in str(info.value)


def test_no_file_and_no_json(tmp_path):
    with pytest.raises(InvalidValueError, match="No such file"):
        JudgePanel.load(tmp_path / "none.json")
    (tmp_path / "text.json").write_text("NaN")
    with pytest.raises(InvalidValueError, match="panel = "):
        JudgePanel.load(tmp_path / "text.json")


def test_judges_that_changed_are_named_with_what_to_do():
    message = r"fit it again without 'c' and with 'd'. One who was renamed: panel.renamed\(\{'old': 'new'\}\)"
    with pytest.raises(InvalidValueError, match=message):
        PANEL.combine({"a": [1.0], "b": [1.0], "d": [1.0]})
    renamed = PANEL.renamed({"c": "d"})
    assert (
        renamed.combine({"d": [1.0], "a": [1.0], "b": [60.0]}).reward
        == PANEL.combine(np.array([[1.0, 60.0, 1.0]])).reward
    )
    with pytest.raises(UnknownNameError, match="name of a judge = 'e'"):
        PANEL.renamed({"e": "f"})
    with pytest.raises(InvalidValueError, match=r"scores.shape = \(1, 2\)"):
        PANEL.combine(np.ones((1, 2)))
    with pytest.raises(InvalidValueError, match="number of scores of judge 'b' = 1"):
        PANEL.combine({"a": [1.0, 2.0], "b": [1.0], "c": [1.0, 2.0]})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"judges": (FittedJudge("a"),)}, "at least two judges"),
        ({"judges": (FittedJudge("a"), FittedJudge("a"))}, "different names"),
        ({"judges": (FittedJudge("a"), FittedJudge("mean"))}, "others than mean"),
        ({"rule": "mode"}, "rule = 'mode'"),
        ({"rule": named("raw")}, "rule = Raw"),
        ({"proxy": "d"}, "proxy = 'd'"),
        ({"weights": (1.0,)}, r"len\(weights\) = 1"),
        ({"weights": 5}, "weights = 5: must be a number > 0 per judge"),
        ({"spread": 1e308}, r"spread = 1e\+308"),
        ({"usual": -1e308}, r"usual = -1e\+308"),
        ({"weights": (1.0, 0.0, 1.0)}, "weight of judge 'b' = 0"),
        ({"clip": 0}, "clip = 0"),
        ({"spread": float("nan")}, "spread = nan"),
    ],
)
def test_panels_that_cannot_be(changes, message):
    with pytest.raises(InvalidValueError, match=message):
        JudgePanel(**{"judges": tuple(map(FittedJudge, NAMES))} | changes)
    with pytest.raises(InvalidValueError, match="scale of judge 'a' = -1"):
        FittedJudge("a", scale=-1.0)
    with pytest.raises(InvalidValueError, match=r"bias of judge 'a' = 1e\+308"):
        FittedJudge("a", bias=1e308)


@pytest.mark.parametrize("size", [1e9, -1e9])
def test_no_number_that_is_allowed_makes_nan(size):
    judges = tuple(FittedJudge(name, bias=size, idiosyncrasy=1e18, noise=1e18) for name in "abc")
    panel = JudgePanel(judges, usual=size, typical=size, spread=1e9, span=1e9, clip=1e6)
    small = replace(panel, spread=1e-9, span=1e-9, judges=tuple(FittedJudge(name, noise=0.0) for name in "abc"))
    for one in (panel, small):
        combined = one.combine(np.array([[1e300, -1e300, 0.0], [1.0, 1.0, np.nan]]))
        assert np.isfinite(combined.reward).all()
        assert np.isfinite(combined.weight).all()


@pytest.mark.parametrize("judges", range(2, 10))
def test_one_completion_alone_has_its_reward_to_the_last_bit(judges):
    random = np.random.default_rng(judges)
    names = [f"judge {k}" for k in range(judges)]
    panel = JudgePanel.plain(names, weights=tuple(random.uniform(0.5, 2, judges)))
    scores = random.normal(size=(64, judges))
    for layout in (scores, np.asfortranarray(scores)):
        together = panel.combine(layout)
        alone = [panel.combine(layout[row : row + 1]) for row in range(64)]
        for name in ("proxy", "reward", "weight", "tau"):
            assert np.array_equal(getattr(together, name), [getattr(one, name)[0] for one in alone])


def test_a_judge_that_was_not_asked_may_have_none():
    panel = JudgePanel.plain("ab")
    assert panel.combine({"a": None, "b": [1.0]}).reward == panel.combine({"a": [None], "b": [1.0]}).reward
    with pytest.raises(InvalidValueError, match="answer of judge 'a' = None"):
        JudgePanel.plain("ab").combine({"a": None, "b": None})


# Logs


def test_logs_of_all_kinds(tmp_path):
    (tmp_path / "a.jsonl").write_text(
        '{"prompt": "p", "scores": {"a": 1, "b": null}, "gold": 2}\n{"prompt": "p", "scores": {"b": 3.5}}\n'
    )
    (tmp_path / "a.csv").write_text("prompt,a,b,gold\np,1,,2\np,,3.5,\n")
    for file, judges in (("a.jsonl", None), ("a.jsonl", ["a", "b"]), ("a.csv", ["a", "b"])):
        log = read_scores(tmp_path / file, judges, truth="gold")
        assert log.judges == ("a", "b")
        assert log.prompts == ["p", "p"]
        assert np.array_equal(log.scores, [[1, np.nan], [np.nan, 3.5]], equal_nan=True)
        assert np.array_equal(log.truth, [2, np.nan], equal_nan=True)
    assert np.isnan(read_scores(tmp_path / "a.csv", ["a", "b"], missing=["1"]).scores[0]).all()


def test_truth_values_are_ones_and_zeros(tmp_path):
    (tmp_path / "a.jsonl").write_text('{"scores": {"a": true, "b": 2}}\n{"scores": {"a": false, "b": 1}}\n')
    assert read_scores(tmp_path / "a.jsonl").scores.tolist() == [[1, 2], [0, 1]]


def test_several_files_are_one_log(tmp_path):
    (tmp_path / "a.csv").write_text("prompt,a,b\np,1,2\n")
    (tmp_path / "b.csv").write_text("prompt,b,a\nq,4,3\n")
    log = read_scores([tmp_path / "a.csv", tmp_path / "b.csv"], ["a", "b"])
    assert log.scores.tolist() == [[1, 2], [3, 4]]
    assert log.prompts == ["p", "q"]
    assert log.source.endswith("a.csv and 1 more")
    (tmp_path / "c.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InvalidValueError, match=r"c.csv: judges = .*prompts in all files or in none"):
        read_scores([tmp_path / "a.csv", tmp_path / "c.csv"], ["a", "b"])


def test_scores_as_text_are_read_and_what_stands_behind_them_is_not(tmp_path):
    (tmp_path / "a.jsonl").write_text('{"scores": {"a": "1.5", "b": 2}}\n')
    assert read_scores(tmp_path / "a.jsonl").scores.tolist() == [[1.5, 2]]
    (tmp_path / "a.jsonl").write_text('{"scores": {"a": "7.0/10", "b": 2}}\n')
    with pytest.raises(InvalidValueError, match="a number alone, without what stands behind it"):
        read_scores(tmp_path / "a.jsonl")


def test_trls_log_of_completions(tmp_path):
    """Its columns have the name of the reward before those of judges, and more beside them."""
    (tmp_path / "a.csv").write_text(
        "step,prompt,uard,uard/a,uard/b,uard/raw,uard/weight,uard/sigma_h,uard/sigma_m,uard/why\n"
        "1,p,0,1,2,0,0,0,0,agreed\n"
    )
    assert read_scores(tmp_path / "a.csv").judges == ("a", "b")
    assert read_scores(tmp_path / "a.csv", ["uard/b", "a"]).judges == ("b", "a")


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("a,b\n1,2\n", {}, r"name the judges' columns with judges \(--judges\). Columns: a, b"),
        ("a,b\n1,2\n", {"judges": ["a", "c"]}, "judge = 'c': must be one of a, b"),
        ("a,b\n1,2\n", {"judges": ["a,b"]}, "names with spaces between them"),
        ("a,b\n1,good\n", {"judges": ["a", "b"]}, "good"),
        ("a,b\n1,inf\n", {"judges": ["a", "b"]}, "row 1, score of 'b' = inf"),
        ("a,b\n1,2\n", {"judges": ["a", "b"], "truth": "gold"}, "column = 'gold'"),
        ("a,b\n1,2\n", {"judges": ["a", "b"], "prompt": "question"}, "column = 'question'"),
        ("a,b\n", {"judges": ["a", "b"]}, "n >= 1|at least one row"),
    ],
)
def test_bad_logs(tmp_path, text, options, message):
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(InvalidValueError, match=message):
        read_scores(tmp_path / "log.csv", **options)


def test_a_prompt_may_come_again_anywhere_in_a_log():
    random = np.random.default_rng(0)
    scores = random.normal(size=(60, 3))
    sorted_prompts = [f"prompt {i // 6}" for i in range(60)]
    order = random.permutation(60)
    fitted = [
        fit(ScoreLog(("a", "b", "c"), scores[rows], prompts=[sorted_prompts[i] for i in rows]))
        for rows in (np.arange(60), order, np.append(order, order[:1])[:60][::-1])
    ]
    assert [[judge.tells_apart for judge in one.panel.judges] for one in fitted] == [[True] * 3] * 3


def test_the_same_completion_again_is_no_failure():
    random = np.random.default_rng(0)
    quality = random.normal(size=300)
    scores = quality[:, None] + 0.3 * random.normal(size=(300, 3))
    prompts = [f"prompt {i // 10}" for i in range(300)]
    scores[20:29] = scores[20]  # one answer, nine times, that the first judge likes more than the others do
    scores[20:29, 0] += 2.0
    log = ScoreLog(("a", "b", "c"), scores, prompts=prompts)
    assert [judge.sentinels for judge in fit(log).panel.judges] == [(), (), ()]
    scores[::10, 0] = -1.25
    assert fit(ScoreLog(("a", "b", "c"), scores, prompts=prompts)).panel.judges[0].sentinels == (-1.25,)
