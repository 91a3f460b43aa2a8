"""Best-of-n: the closed form against brute force, the problem, and what the report says of it."""

import itertools
import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uard import InvalidValueError
from uard.lab.studies import best_of_n
from uard.lab.studies.best_of_n import METHODS, PANELS, Problem, divergence, draw, expected_best, filtered
from uard.lab.views import best_of_n as views
from uard.lab.views import published
from uard.method.mitigations import Raw, named

SMALL = Problem(pool=10_000, models=3, pairs=60, width=8)


@pytest.fixture(scope="module")
def small():
    return best_of_n.run(range(3), SMALL)


def brute(value, score, n):
    """Average over all subsets of n; where several have the best score each is taken as often."""
    worth = []
    for subset in itertools.combinations(range(len(score)), n):
        best = max(score[i] for i in subset)
        worth.append(np.mean([value[i] for i in subset if score[i] == best]))
    return np.mean(worth)


@given(
    st.lists(st.tuples(st.floats(-5, 5), st.integers(0, 6)), min_size=1, max_size=8),
    st.data(),
)
@settings(max_examples=60, deadline=None)
def test_the_closed_form_is_the_mean_over_all_subsets(pairs, data):
    value, score = np.array(pairs, float).T
    n = data.draw(st.integers(1, len(pairs)))
    assert expected_best(value, score, n) == pytest.approx(brute(value, score, n))


def test_by_hand():
    # Of three the pairs are {1, 2}, {1, 3}, {2, 3}: the best is the second once and the third twice.
    value, score = np.array([5.0, 2.0, 8.0]), np.array([1.0, 2.0, 3.0])
    assert [expected_best(value, score, n) for n in (1, 2, 3)] == pytest.approx([5.0, (2 + 2 * 8) / 3, 8.0])
    # Two equal scores: either is the best of both.
    assert expected_best(np.array([0.0, 4.0]), np.array([1.0, 1.0]), 2) == pytest.approx(2.0)
    assert divergence(1) == 0.0
    assert divergence(10) == pytest.approx(math.log(10) - 0.9)


@given(st.integers(0, 1000), st.integers(2, 300), st.floats(0.1, 10), st.floats(-5, 5))
@settings(max_examples=50, deadline=None)
def test_more_is_never_worse_in_the_score_itself_and_units_do_not_matter(seed, pool, factor, shift):
    random = np.random.default_rng(seed)
    value, score = random.normal(size=(2, pool))
    sizes = sorted({1, 2, pool // 2 + 1, pool})
    curve = [expected_best(score, score, n) for n in sizes]
    assert (np.diff(curve) >= -1e-12).all()
    assert curve[0] == pytest.approx(score.mean())
    assert curve[-1] == pytest.approx(score.max())
    moved = expected_best(factor * value + shift, np.exp(score), sizes[1])
    assert moved == pytest.approx(factor * expected_best(value, score, sizes[1]) + shift)


def test_a_pool_of_thousands_gives_no_nan():
    score = np.linspace(0.0, 1.0, 20_000)
    # Order statistics: the best of n is at rank n (N + 1) / (n + 1) of N on average.
    for n in (1, 100, 10_000, 20_000):
        rank = n * 20_001 / (n + 1)
        assert expected_best(score, score, n) == pytest.approx((rank - 1) / 19_999)


@pytest.mark.parametrize(
    ("value", "score", "n", "message"),
    [
        ([1.0, 2.0], [1.0, 2.0], 0, "n = 0"),
        ([1.0, 2.0], [1.0, 2.0], 3, "n = 3"),
        ([1.0, np.nan], [1.0, 2.0], 1, "value"),
        ([1.0, 2.0], [1.0, np.inf], 1, "score"),
        ([1.0], [1.0, 2.0], 1, "value.shape"),
    ],
)
def test_nonsense_is_refused(value, score, n, message):
    with pytest.raises(InvalidValueError, match=message):
        expected_best(np.array(value), np.array(score), n)


def test_bad_problems():
    with pytest.raises(InvalidValueError, match="pool = 5"):
        Problem(pool=5)
    with pytest.raises(InvalidValueError, match="did you mean 'colluding'"):
        draw(SMALL, "coluding", 0)
    with pytest.raises(InvalidValueError, match="number of seeds = 0"):
        best_of_n.run([])


def test_seeds_decide_everything():
    a, b, c = (draw(SMALL, "contested", seed) for seed in (0, 0, 1))
    assert np.array_equal(a.scores, b.scores)
    assert np.array_equal(a.gold, b.gold)
    assert not np.array_equal(a.gold, c.gold)
    for column in (a.gold, *a.scores.T):
        assert (column.mean(), column.std()) == (pytest.approx(0.0, abs=1e-9), pytest.approx(1.0))


def test_reward_models_have_learned_and_flattery_misleads():
    def quality(panel):
        found = [draw(Problem(pool=10_000), panel, seed) for seed in range(3)]
        return np.mean([[np.corrcoef(d.gold, s)[0, 1] for s in d.scores.T] for d in found], axis=0)

    honest, contested, wrong = (quality(panel) for panel in PANELS)
    assert honest.min() > 0.75
    assert contested[2:].min() > 0.75
    assert contested[:2].max() < 0.65  # those two learned from people who like flattery
    assert wrong.max() < 0.65


def test_the_mitigation_is_the_librarys_own():
    scores = np.array([[1.0, 1.0, 1.0], [4.0, 0.0, 2.0]])
    assert filtered(scores, Raw()) == pytest.approx(scores.mean(1))
    # As printed: U = 0.5 sd, w = 1 / (1 + 2 * 0.5 sd) on the mean of 2.
    assert filtered(scores, named("uard-operator")) == pytest.approx([1.0, 2 / (1 + np.std([4, 0, 2]))])
    random = np.random.default_rng(0).normal(size=(500, 5))
    ours = METHODS["uard"](random)
    assert (ours <= random.mean(1) + 1e-12).all()
    assert (ours >= random.min(1) - 1e-12).all()


def test_golden(small):
    """Numbers of a small problem; they change only if the problem or a mitigation does."""
    for method, gold in (("mean", [0.0, 0.18, -0.92]), ("uard-0.1", [0.0, 0.34, -0.62]), ("uard", [0.0, 0.32, -1.8])):
        assert small.gold["contested", method][:, [0, 12, -1]].mean(0) == pytest.approx(gold, abs=0.01)


def test_curves_start_at_the_pools_mean(small):
    for key, gold in small.gold.items():
        assert gold[:, 0] == pytest.approx(0.0, abs=1e-9), key
        assert (np.diff(small.proxy[key], axis=1) >= -1e-9).all()


def test_losses_are_found_by_rule(small):
    data = json.loads(json.dumps(small.as_data() | {"command": "test"}, allow_nan=False))
    for c in data["curves"]:
        lift = 0.2 if (c["panel"], c["method"]) == ("contested", "mean") else -0.2
        c["over_uard"]["ci95"] = [[lift - 0.1, lift + 0.1]] * len(data["n"])
        c["over_uard"]["mean"] = [lift] * len(data["n"])
    (better,) = (x for x in views.losses(data) if x.kind == "beaten")
    assert better.where == "contested reward models, n = 10"
    assert better.what == "the answers that mean chooses are worth more, at n = 10, 100, 1000, 10000"
    ours, mean = (
        c for name in ("uard", "mean") for c in data["curves"] if (c["panel"], c["method"]) == ("contested", name)
    )
    i = data["n"].index(10)
    assert (better.ours.mean, better.theirs.mean) == (ours["gold"]["mean"][i], mean["gold"]["mean"][i])
    falls = [x.where.split()[0] for x in views.losses(data) if x.kind == "fails"]
    curves = {c["panel"]: c["gold"]["mean"] for c in data["curves"] if c["method"] == "uard"}
    assert falls == [panel for panel, gold in curves.items() if max(gold) > gold[-1]]
    assert len(views.table(data).rows) == len(PANELS) * len(METHODS)
    drawn = views.picture_of(data)
    assert len(drawn.figure.axes) == len(PANELS)
    assert {row[3] for row in drawn.rows} == {*METHODS, "uard: score"}


def test_what_is_published_was_made_by_this_problem():
    data = published.packaged_json("best-of-n.json")
    assert Problem(**data["problem"]) == Problem()
    assert data["n"] == list(best_of_n.SIZES)
    assert len(data["seeds"]) >= 20
    assert {(c["panel"], c["method"]) for c in data["curves"]} == set(itertools.product(PANELS, METHODS))


def test_what_is_published_comes_again():
    """Seed 0 of a published panel, redrawn, is where the published mean and deviation say that it may be."""
    data = published.packaged_json("best-of-n.json")
    again = best_of_n.run([0], panels=["independent"])
    for c in data["curves"]:
        if c["panel"] == "independent":
            distance = again.gold["independent", c["method"]][0] - c["gold"]["mean"]
            assert (np.abs(distance) <= 5 * np.array(c["gold"]["sd"]) + 1e-3).all()
