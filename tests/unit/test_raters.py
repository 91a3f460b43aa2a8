"""What is known of raters: numbers by hand, properties, recovery of simulated panels, coverage, and bad input."""

import json
import os
import re
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from uard import InvalidValueError
from uard.method import pooled
from uard.method.mitigations import Evidence, named
from uard.ratings import readers
from uard.ratings.aggregate import aggregate
from uard.ratings.jackknife import Estimate, interval, jackknife, t_quantile
from uard.ratings.log import RatingLog, Repeats
from uard.ratings.orders import orders
from uard.ratings.panels import Panel, Rater, draw, random_panel
from uard.ratings.raters import EffectiveRaters, effective_raters, summary

NAMES = ("ann", "bob", "cat", "dan", "eve")


def simulated(panel, n=300, visits=1, seed=0, rewarded=True, lies=0.0):
    """Items whose worth is normal (sd 1.5), some rewards too high by 4, and what a panel says of them."""
    random = np.random.default_rng(seed)
    truth = 1.5 * random.normal(size=n)
    lie = random.random(n) < lies
    reward, item = truth + 4.0 * lie, np.repeat(np.arange(n), visits)
    said = draw(panel.law(reward[item], truth[item], lie[item]), random)
    raters = NAMES if len(panel.raters) <= 5 else ()
    return RatingLog(reward[item] if rewarded else None, said, raters[: len(panel.raters)], item=item)


def by_name(panel):
    return {r.name: r for r in panel.raters}


# Numbers by hand.


def test_repeated_answers_tell_the_noise():
    # ann says (1, 3), (2, 2), (0, 4), (5, 5), (1, 1) of five items: squares 2 + 0 + 8 + 0 + 0, and five differences.
    said = np.array([[1, 3], [2, 2], [0, 4], [5, 5], [1, 1]], float)
    log = RatingLog(None, said.reshape(-1, 1), ("ann",), item=np.repeat(np.arange(5), 2))
    (ann,) = summary(log).raters
    assert (ann.answers, ann.items, ann.repeated, ann.noise_from) == (10, 5, 5, "repeats")
    assert ann.noise.value == pytest.approx(np.sqrt(2.0))
    assert (ann.bias, ann.with_others) == (None, None)
    again = Repeats(np.arange(5), np.zeros(5, int), said[:, 0])
    (same,) = summary(RatingLog(None, said[:, 1:], ("ann",), repeats=again)).raters
    assert same == ann  # earlier answers of a long table count as answers


def test_differences_of_three_tell_the_noise_of_each():
    # Contrasts that are orthogonal, so that the variances of differences are v_j + v_k exactly: 1, 4 and 9.
    base = np.array([[1, 1, 1, 1], [1, -1, 1, -1], [1, 1, -1, -1], [1, -1, -1, 1]], float)
    error = np.sqrt(3 / 4) * base[:, 1:] * [1.0, 2.0, 3.0]  # sample variances (n - 1) of 1, 4, 9
    worth = np.array([0.0, 10.0, -5.0, 3.0])
    found = summary(RatingLog(None, worth[:, None] + error + [0.0, 0.0, 6.0], NAMES[:3]))
    assert [r.noise.value for r in found.raters] == pytest.approx([1.0, 2.0, 3.0])
    assert [r.noise_from for r in found.raters] == ["others"] * 3
    assert [r.bias.value for r in found.raters] == pytest.approx([-3.0, -3.0, 6.0])  # the median of two is their middle
    assert all(r.noise.low is None for r in found.raters)  # four items
    two = summary(RatingLog(None, worth[:, None] + error[:, :2], NAMES[:2]))
    assert [r.noise.value for r in two.raters] == pytest.approx([np.sqrt(2.5)] * 2)  # nobody knows whose it is


def test_bias_against_the_reward_is_drawn_nowhere():
    reward = np.arange(8.0)
    (ann,) = summary(RatingLog(reward, reward[:, None] + 0.5, ("ann",))).raters
    assert ann.bias.value == pytest.approx(0.5)  # the rule's own is 0.5 * 8 / 12
    assert (ann.noise_from, ann.noise.value) == ("reward", pytest.approx(0.0, abs=1e-6))


def test_jackknife_of_a_mean_is_its_standard_error():
    x = np.array([2.0, 3.0, 5.0, 8.0, 1.0, 4.0])
    value, error = jackknife(lambda rows: x[rows].mean(keepdims=True), np.arange(6))
    assert (value[0], error[0]) == (pytest.approx(x.mean()), pytest.approx(x.std(ddof=1) / np.sqrt(6)))
    assert interval(1.0, 0.5, 4) == Estimate(1.0)
    assert interval(np.nan, 0.5, 10) is None
    assert [t_quantile(n) for n in (5, 10, 24)] == pytest.approx([2.571, 2.228, 2.064], abs=0.004)


def test_effective_raters_by_hand():
    worth = EffectiveRaters("reward", 3.0, Estimate(0.25, -0.2, 1.0)).number
    assert worth == Estimate(2.0, 1.0, 3.0)


# Who is what.


def test_everybody_is_called_what_they_are():
    random = np.random.default_rng(3)
    reward = random.normal(size=200)
    said = reward[:, None] + 0.1 * random.normal(size=(200, 8))
    said[:, 1] += 0.8
    said[:, 2] = reward + 2.0 * random.normal(size=200)
    said[:, 3] = -reward + 0.1 * random.normal(size=200)
    said[:, 4] = 3.0
    said[:, 5] = reward
    said[:, 6] = said[:, 0]
    said[:, 7] = 50.0 + 10.0 * said[:, 7]
    names = ("honest", "kind", "noisy", "contrary", "constant", "parrot", "copy", "stars")
    words = {r.name: r.words for r in summary(RatingLog(reward, said, names)).raters}
    assert words["honest"] == ("the same as copy",)
    assert words["kind"][0].startswith("biased by 0.8")
    assert words["noisy"] == ("noisy",)
    assert words["contrary"] == ("contrary",)
    assert words["constant"][0] == "constant (3)"
    assert words["parrot"] == ("repeats the reward",)
    assert words["copy"] == ("the same as honest",)
    assert len(words["stars"]) == 1
    slope, offset = re.fullmatch(
        r"in other units than the reward: the reward is about (\S+) x rating - (\S+)", words["stars"][0]
    ).groups()
    assert (float(slope), float(offset)) == (pytest.approx(0.1, rel=0.02), pytest.approx(5.0, rel=0.02))


def test_units_without_rewards_are_those_of_the_most():
    random = np.random.default_rng(0)
    said = random.normal(size=(100, 1)) + 0.1 * random.normal(size=(100, 3))
    said[:, 1] = 20.0 + 5.0 * said[:, 1]
    found = by_name(summary(RatingLog(None, said, NAMES[:3])))
    assert found["ann"].words == found["cat"].words == ()
    assert found["bob"].words[0].startswith("in other units than ann and cat: ann and cat is about 0.")
    assert found["ann"].noise.value == pytest.approx(0.1, abs=0.02)  # bob's differences do not count


def test_a_rater_whom_the_rule_does_not_hear():
    panel = Panel((Rater(), Rater(), Rater(noise=2.0), Rater()))
    found = summary(simulated(panel, visits=3))
    assert [r.heard for r in found.raters] == [True, True, False, True]
    assert found.raters[2].why == "noise over 2 times the usual"
    assert found.raters[2].words == ("noisy",)
    assert "not heard: noise over 2 times the usual" in str(found)


# Properties.


def test_order_of_raters_and_silent_raters_change_nothing():
    log = simulated(random_panel(33), n=80)
    found = by_name(summary(log))
    turned = np.arange(len(log.raters))[::-1]
    other = by_name(summary(RatingLog(log.reward, log.ratings[:, turned], tuple(log.raters[k] for k in turned))))
    silent = np.column_stack([log.ratings, np.full(len(log), np.nan)])
    more = by_name(summary(RatingLog(log.reward, silent, (*log.raters, "silent"))))
    assert more.pop("silent").words == ("no answers",)
    for name, rater in found.items():
        for same in (other[name], more[name]):
            assert same.words == rater.words
            for field in ("noise", "bias", "with_others"):
                assert getattr(same, field) == pytest.approx(getattr(rater, field), rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("rewarded", [True, False])
def test_shift_and_scale_of_everything(rewarded):
    panel = Panel((Rater(bias=0.3), Rater(noise=0.5), Rater(noise=0.3, coverage=0.5)))
    log = simulated(panel, n=60, visits=2, rewarded=rewarded)
    reward = None if log.reward is None else 10.0 * log.reward - 7.0
    other = summary(RatingLog(reward, 10.0 * log.ratings - 7.0, log.raters, item=log.item))
    for a, b in zip(summary(log).raters, other.raters, strict=True):
        assert b.noise == pytest.approx([10.0 * x for x in a.noise], rel=1e-6)
        assert b.bias == pytest.approx([10.0 * x for x in a.bias], rel=1e-5, abs=1e-6)
        assert b.with_others == pytest.approx(a.with_others, rel=1e-6)


# Recovery of simulated panels, and coverage of the intervals.

PANEL = Panel(
    (Rater(noise=0.3, bias=0.5), Rater(noise=0.5), Rater(noise=0.8, bias=-0.4), Rater(noise=0.4, coverage=0.7))
)


@pytest.mark.parametrize(
    ("visits", "rewarded", "lies"), [(1, True, 0.1), (1, False, 0.0), (3, True, 0.1), (3, False, 0.1)]
)
def test_bias_and_noise_are_recovered_and_intervals_hold(visits, rewarded, lies):
    own = np.array([r.bias for r in PANEL.raters])
    others = np.array([b - np.median(np.delete(own, k)) for k, b in enumerate(own)])
    true = {"bias": own if rewarded else others, "noise": np.array([r.noise for r in PANEL.raters])}
    found = [summary(simulated(PANEL, 40, visits, s, rewarded, lies)) for s in range(60)]
    for name, values in true.items():
        estimates = [[getattr(r, name) for r in panel.raters] for panel in found]
        mean = np.nanmean([[np.nan if e is None else e.value for e in row] for row in estimates], 0)
        held = np.mean(
            [[e is not None and e.low <= v <= e.high for e, v in zip(r, values, strict=True)] for r in estimates]
        )
        assert mean == pytest.approx(values, abs=0.07)
        assert held > 0.9, (name, held)  # of 240 intervals; 95 % are meant


def test_noise_is_never_known_to_be_nothing_where_errors_are_not_independent():
    # ann's errors are bob's, and cat's the contrary: Grubbs' variance of ann is often below 0, though it is 0.25.
    for seed in range(40):
        random = np.random.default_rng(seed)
        truth, error = random.normal(size=40), 0.5 * random.normal(size=40)
        said = np.stack([truth + error, truth + error + 0.1 * random.normal(size=40), truth - 0.9 * error], 1)
        noise = summary(RatingLog(truth, said)).raters[0].noise
        assert noise is None or noise.high > 0.1


def test_intervals_of_effective_raters_hold():
    # Three raters share half of their errors' variance: rho = 1/2, so that they are worth 1.5.
    held = []
    for seed in range(40):
        random = np.random.default_rng(seed)
        truth, shared, own = random.normal(size=120), random.normal(size=(120, 1)), random.normal(size=(120, 3))
        effective = summary(RatingLog(None, truth[:, None] + shared + own, true_reward=truth)).effective
        assert effective.against == "true_reward"
        held.append(effective.number.low <= 1.5 <= effective.number.high)
    assert np.mean(held) > 0.85


def test_parts_of_one_item_tell_nothing_of_effective_raters():
    random = np.random.default_rng(0)
    said = random.normal(size=(300, 1)) + 0.1 * random.normal(size=(300, 3))
    assert summary(RatingLog(None, said, by=np.arange(300).astype(str))).effective is None


def test_intervals_of_effective_raters_hold_where_a_prompts_completions_share_errors():
    held, n, parts = [], 240, 30
    part = np.arange(n) // (n // parts)
    for seed in range(60):
        random = np.random.default_rng(seed)

        def error(shape, random=random):
            return np.sqrt(0.7) * random.normal(size=(parts, *shape))[part] + np.sqrt(0.3) * random.normal(
                size=(n, *shape)
            )

        truth = random.normal(size=n)
        ratings = truth[:, None] + np.sqrt(0.3) * error((1,)) + np.sqrt(0.7) * error((5,))
        number = effective_raters(ratings, truth, "true_reward", part).number
        held.append(number.low <= 5 / (1 + 4 * 0.3) <= number.high)
    assert np.mean(held) > 0.8  # by rows it is 0.7 and less


def test_effective_raters_against_parts():
    random = np.random.default_rng(0)
    part = np.repeat(["a", "b"], 100)
    said = 10.0 * (part == "b")[:, None] + random.normal(size=(200, 3))
    effective = summary(RatingLog(None, said, by=part)).effective
    assert effective.against == "part"
    assert effective.number.value > 2.7  # nothing is shared within a part
    assert summary(RatingLog(None, said)).effective is None


# Orders.


def test_orders_by_hand():
    # Others of ann: 1.5, 3.5, 3 -> 2 of 3 pairs in ann's order; of bob 1, 3, 4 -> 1; of cat 1.5, 2.5, 2 -> 2.
    said = np.array([[1.0, 2.0, 1.0], [2.0, 3.0, 4.0], [3.0, 1.0, 5.0]])
    rows = {r.rater: r for r in orders(RatingLog(None, said, NAMES[:3])).rows if r.rule == "mean"}
    assert {n: r.alike.value for n, r in rows.items()} == pytest.approx(
        {"all": 5 / 9, "ann": 2 / 3, "bob": 1 / 3, "cat": 2 / 3}
    )
    assert rows["cat"].with_own == pytest.approx(2.5 / 3)  # means 4/3, 3, 3: a tie counts one half
    assert rows["ann"].tau.value == pytest.approx(1 / 3)


def test_orders_within_groups_and_of_ranks():
    log = RatingLog(None, np.array([[1.0, 1.0], [2.0, 2.0], [9.0, 9.0], [8.0, 8.0]]), NAMES[:2])
    ranks = RatingLog(None, -np.array([[2.0, 1.0], [1.0, 2.0], [1.0, 1.0], [2.0, 2.0]]), ("bob", "ann"))
    found = orders(log, ranks, np.array(["x", "x", "y", "y"]), "story")
    alike = {r.rater: (r.pairs, r.alike.value) for r in found.rows if r.rule == "pooled"}
    assert alike == {"all": (4, 0.75), "ann": (2, 0.5), "bob": (2, 1.0)}  # matched by name
    assert (found.groups, found.own) == (2, "ranks")
    with pytest.raises(InvalidValueError, match="own = '3 rows': must be the 4 rows of the log"):
        orders(log, RatingLog(None, ranks.ratings[:3], ranks.raters))


def test_the_pooled_order_beats_the_mean_where_one_rater_is_noise():
    panel = Panel((Rater(noise=0.3), Rater(noise=0.3), Rater(noise=0.3), Rater(noise=4.0)))
    log = simulated(panel, n=60, visits=3)
    alike = {r.rule: r.alike.value for r in orders(log).rows if r.rater == "ann"}
    assert alike["pooled"] > alike["mean"] + 0.03
    assert set(alike) == {"cautious", "pooled", "mean", "median", "reward"}


# Bad input.


def finite(data):
    """Whether JSON can hold it: no NaN and no infinity."""
    return bool(json.dumps(data, allow_nan=False))


def everything(log):
    found = summary(log)
    assert finite(found.as_data())
    assert finite(orders(log).as_data())
    assert "nan" not in (str(found) + str(orders(log))).lower()
    return found


def test_one_rater():
    found = everything(RatingLog(None, np.arange(20.0)[:, None], ("ann",)))
    assert found.raters[0].noise_from == "nothing"
    assert (found.raters[0].noise, found.raters[0].bias) == (None, None)
    assert "not known" in str(found)
    everything(RatingLog(np.arange(20.0), np.arange(20.0)[:, None], ("ann",)))
    everything(RatingLog(np.array([1.0]), np.array([[2.0]]), ("ann",)))


def test_no_overlap_between_raters():
    said = np.full((40, 2), np.nan)
    said[:20, 0], said[20:, 1] = np.arange(20.0), np.arange(20.0)
    found = everything(RatingLog(None, said, NAMES[:2]))
    assert [(r.noise, r.bias, r.with_others) for r in found.raters] == [(None, None, None)] * 2
    reward = np.r_[np.arange(20.0), np.arange(20.0) - 1.0]
    found = everything(RatingLog(reward, said, NAMES[:2]))
    assert [round(r.bias.value, 6) for r in found.raters] == [0.0, 1.0]
    assert [r.noise_from for r in found.raters] == ["reward"] * 2


def test_nobody_has_answered():
    found = everything(RatingLog(np.arange(5.0), np.full((5, 2), np.nan), NAMES[:2]))
    assert [(r.words, r.heard, r.why) for r in found.raters] == [(("no answers",), False, "no answers")] * 2
    assert everything(RatingLog(np.arange(5.0), np.empty((5, 0)))).raters == ()


def test_all_raters_excluded_is_as_if_nobody_had_rated():
    reward, said = np.array([4.0, 0.0, 0.0]), np.array([[-1.0, 2.0], [0.0, 0.0], [0.0, 0.0]])
    feedback, rule = aggregate(said, reward), named("uard")
    fitted = rule.fit(feedback, feedback.count > 0)
    deaf = fitted._replace(raters=fitted.raters._replace(heard=0.0 * fitted.raters.heard))
    why = rule.explain(Evidence(reward, np.zeros(3), feedback), deaf)
    assert np.isfinite(why.signal.reward).all()
    assert why.weight.tolist() == [rule.unrated_weight] * 3
    nobody = pooled.pool(reward, said, np.zeros((3, 2), bool), np.ones((3, 2)), 1.0)
    assert all((x == 0).all() for x in nobody)


def test_all_raters_in_other_units():
    random = np.random.default_rng(0)
    reward = random.normal(size=60)
    said = 50.0 + 10.0 * reward[:, None] + random.normal(size=(60, 2))
    found = everything(RatingLog(reward, said, NAMES[:2]))
    assert all("the reward is about 0.0" in r.words[0] or "about 0.1" in r.words[0] for r in found.raters)


@pytest.mark.parametrize("reward", [None, np.arange(20.0), np.zeros(20)])
def test_constant_raters(reward):
    found = everything(RatingLog(reward, np.full((20, 3), 2.0), NAMES[:3]))
    assert all(r.words[0] == "constant (2)" and r.with_others is None for r in found.raters)


def test_64_raters_of_a_few_items_each():
    random = np.random.default_rng(0)
    said = random.normal(size=(100, 1)) + 0.3 * random.normal(size=(100, 64))
    said[random.random(said.shape) < 0.9] = np.nan
    found = everything(RatingLog(None, said))
    assert np.median([r.noise.value for r in found.raters if r.noise]) == pytest.approx(0.3, abs=0.1)


def test_too_many_raters_are_refused():
    with pytest.raises(InvalidValueError, match="raters = 1001: must be at most 1000"):
        summary(RatingLog(None, np.zeros((2, 1001))))


@pytest.mark.parametrize(("value", "column"), [(np.inf, "bob"), (-np.inf, "bob"), (1e101, "bob"), (np.inf, "reward")])
def test_infinite_numbers_are_named(value, column):
    reward, said = np.arange(4.0), np.zeros((4, 2))
    (reward if column == "reward" else said[:, 1])[2] = value
    for function in (summary, orders):
        with pytest.raises(InvalidValueError, match=f"log: row 3, column '{column}'"):
            function(RatingLog(reward, said, NAMES[:2]))
    again = Repeats(np.zeros(1, int), np.zeros(1, int), np.array([np.inf]))
    with pytest.raises(InvalidValueError, match="earlier answers"):
        summary(RatingLog(None, np.zeros((4, 2)), repeats=again))


def test_unknown_rewards_are_left_out():
    reward = np.where(np.arange(40) < 10, np.nan, np.arange(40.0))
    said = np.arange(40.0)[:, None] + [0.0, 1.0]
    found = everything(RatingLog(reward, said, NAMES[:2]))
    assert [round(r.bias.value, 6) for r in found.raters] == [0.0, 1.0]
    assert everything(RatingLog(np.full(40, np.nan), said, NAMES[:2])).against == "the other raters"


def test_a_million_answers_in_little_memory():
    random = np.random.default_rng(0)
    reward = random.normal(size=250_000)
    log = RatingLog(reward, reward[:, None] + 0.5 * random.normal(size=(250_000, 4)), item=np.arange(250_000))
    tracemalloc.start()
    try:
        found = summary(log)
        orders(log)
        assert tracemalloc.get_traced_memory()[1] < 400e6
    finally:
        tracemalloc.stop()
    assert [r.noise.value for r in found.raters] == pytest.approx([0.5] * 4, abs=0.01)


@pytest.mark.parametrize(
    ("keywords", "field"),
    [
        ({"noise": -0.1}, "noise"),
        ({"noise": np.nan}, "noise"),
        ({"coverage": 0.0}, "coverage"),
        ({"scale": 0}, "scale"),
    ],
)
def test_raters_whom_nobody_can_be(keywords, field):
    with pytest.raises(InvalidValueError, match=f"{field} = "):
        Panel((Rater(**keywords),) * 3)


# Real raters, on the machine of somebody who has them.


@pytest.mark.skipif("UARD_REAL_RATINGS" not in os.environ, reason="UARD_REAL_RATINGS names no folder with real ratings")
def test_real_raters():
    file = Path(os.environ["UARD_REAL_RATINGS"]) / "squality-ratings.csv"
    log = readers.read(file, rating="overall", by="system")
    found = everything(log)
    assert [(r.name, r.answers, r.noise_from) for r in found.raters] == [
        (name, 225, "others") for name in ("r2", "r3", "r6", "r8")
    ]
    assert [r.noise.value for r in found.raters] == pytest.approx([22.3, 16.2, 11.1, 14.1], abs=0.1)
    assert [r.bias.value for r in found.raters] == pytest.approx([7.5, 3.4, -4.7, -3.4], abs=0.1)
    assert found.effective.number.value == pytest.approx(1.95, abs=0.02)
    correctness = summary(readers.read(file, rating="correctness", by="system"))
    assert correctness.raters[2].words == ("biased by 32.7",)
    ranks = readers.read(file, rating="overall_rank")
    question = np.array([str(i).removesuffix(f"-{system}") for i, system in zip(log.item, log.by, strict=True)])
    order = orders(log, RatingLog(None, -ranks.ratings, ranks.raters, item=ranks.item), question)
    alike = {r.rule: r.alike.value for r in order.rows if r.rater == "all"}
    assert alike == pytest.approx({"cautious": 0.846, "pooled": 0.891, "mean": 0.892, "median": 0.892}, abs=0.002)
