"""Who tells the truth: the reference, numbers derived by hand, and what the model is said to do and not to do."""

import tracemalloc

import numpy as np
import pytest
from scipy.special import ndtr

from uard import Evidence, InvalidValueError
from uard.method import rater_statistics, witness
from uard.method.feedback import ByRater
from uard.method.mitigations import Witness, named
from uard.ratings.aggregate import aggregate

from . import pooled_reference
from . import witness_reference as reference


def contested(seed: int) -> tuple[np.ndarray, ByRater, np.ndarray]:
    """Eighty rewards of which six lie, up to seven raters of whom fewer than half repeat the lies."""
    random = np.random.default_rng(seed)
    rows, raters = 80, int(random.integers(1, 8))
    truth = -0.1 + 0.3 * random.normal(size=rows) * (seed % 2)
    truth[:3], reward = 10.0, truth.copy()
    reward[3:9], truth[3:9] = 4.0, -1.0
    count, sd = random.integers(0, 6, (rows, raters)).astype(float), random.uniform(0.1, 2.0, raters)
    meant = np.repeat(truth[:, None], raters, 1) + 0.4 * random.normal(size=raters)
    meant[3:9, raters // 2 + 1 :] = 4.0
    mean = meant + sd / np.sqrt(np.maximum(count, 1)) * random.normal(size=count.shape)
    m2 = np.where(count > 1, sd**2 * random.chisquare(np.maximum(count - 1, 1e-9)), 0.0)
    return reward, ByRater(count, np.where(count > 0, mean, 0.0), m2), count.sum(1) > 0


@pytest.mark.parametrize("seed", range(40))
def test_the_reference_gives_the_same(seed):
    reward, each, some = contested(seed)
    rated = [x[some] for x in each]
    usual = reference.fit(*rated, reward[some], pooled_reference.fit(*rated, reward[some]))
    learned, weight, anchor, deviation = reference.reward(*each, reward, usual)
    panel = witness.fit(reward, each, some)
    pairs = [("pi", "lies"), ("phi", "over"), ("g2", "attention"), ("lo", "lowest"), ("hi", "highest"), ("b0", "usual")]
    for ours, theirs in pairs:
        np.testing.assert_allclose(getattr(panel, theirs), usual[ours], rtol=1e-4, atol=1e-5, err_msg=theirs)
    belief = witness.believe(reward, witness.hypotheses(reward, each, panel), panel)
    heard = ((each.count > 0) & usual["witness"]).any(1)
    for ours, theirs in zip(belief, (weight, anchor, deviation, learned), strict=True):
        np.testing.assert_allclose(ours[heard], theirs[heard], rtol=1e-3, atol=1e-3)


def test_by_hand_of_one_rater():
    """The rater says 0 with a variance of 0.01, the reward is 2, the range 3 and a scale of 1: all sums written out."""
    one = np.ones(())
    raters = rater_statistics.RaterStatistics(
        *(np.array([x]) for x in (0.04, 0.0, 0.0, 1.0)), 0.0 * one, 2.0 * one, 5.0 * one, one
    )
    panel = witness.WitnessStatistics(raters, np.ones(1), 0.0 * one, 3.0 * one, 0.2 * one, 0.9 * one, 0.0 * one)
    each = ByRater(np.array([[4.0]]), np.array([[0.0]]), np.array([[0.12]]))
    seen = witness.hypotheses(np.array([2.0]), each, panel, witness.Prior(slack=0.0))
    v = (4 * 0.04 + 0.12) / 7 / 4  # = 0.01
    density = 1 / np.sqrt(2 * np.pi * v)
    assert seen.honest[0] == pytest.approx(np.log(0.9999 * density * np.exp(-(2.0**2) / 2 / v) + 1e-4 / 4.0))
    errs = 0.5 * (ndtr(2.0 / v**0.5) - 0.5) / 2.0 + 0.5 * density * np.exp(-(2.0**2) / 2 / v)
    truth = (0.7 - 1e-4) * density + 0.3 * errs + 1e-4 / 4.0
    share = (0.7 - 1e-4) * density / truth
    assert seen.variance[0, 0] == pytest.approx(v / share)
    prior = 1 / (2.0 + 1.0)  # over the range below the reward, and a scale more
    assert seen.lie[0, 0] == pytest.approx(np.log(truth * prior * np.sqrt(2 * np.pi * v / share)))
    belief = witness.believe(np.array([2.0]), seen, panel)
    odds = 0.2 * 0.9 / 0.8 * np.exp(seen.lie[0, 0] - seen.honest[0])
    assert belief.weight[0] == pytest.approx(1 / (1 + odds))
    assert belief.anchor[0] == 0.0


def test_probabilities_keep_their_digits_in_the_tails():
    x = np.linspace(-12.0, 12.0, 241)
    np.testing.assert_allclose(witness._below(x), ndtr(x), rtol=1.5e-7)


def test_shares_are_learned_from_the_lies_that_are_seen():
    """Twenty of a hundred rewards lie, and three exact raters say so: (2 * 0.2 + 20) / 102 of them, nearly all over."""
    reward = np.where(np.arange(100) < 20, 4.0, np.linspace(-1.0, 1.0, 100))
    said = np.where(np.arange(100) < 20, -1.0, reward)[:, None] + 0.01 * np.random.default_rng(0).normal(size=(100, 3))
    panel = witness.fit(reward, ByRater(np.ones((100, 3)), said, np.zeros((100, 3))), np.ones(100, bool))
    assert panel.lies == pytest.approx(20.4 / 102, abs=0.03)
    assert panel.over == pytest.approx(24.5 / 25, abs=0.03)


def test_many_raters_do_not_underflow_and_tables_stay_bounded():
    """The product of 64 densities is less than any float32; 64 hypotheses of 64 raters come some at a time."""
    reward = np.zeros(512, np.float32)
    reward[0] = 8.0
    said = np.random.default_rng(0).normal(size=(512, 64)).astype(np.float32)
    each = ByRater(np.ones_like(said), said, np.zeros_like(said))
    tracemalloc.start()
    panel = witness.fit(reward, each, np.ones(512, bool))
    assert tracemalloc.get_traced_memory()[1] < 20 * witness.TABLE * 4
    tracemalloc.stop()
    belief = witness.believe(reward, witness.hypotheses(reward, each, panel), panel)
    assert belief.weight[0] < 1e-3
    assert belief.weight[1:].mean() > 0.9
    assert abs(float(belief.learned[0])) < 1.0


def test_it_is_made_by_name_and_checked():
    assert named("witness", errs=0.2) == Witness(errs=0.2)
    bad = [("lies", 1.0), ("over", 0.0), ("errs", 1.0), ("stray", 0.8), ("risk", -1.0), ("slack", float("nan"))]
    for field, value in bad:
        with pytest.raises(InvalidValueError, match=field):
            Witness(**{field: value})


def test_more_stray_ratings_are_allowed_and_one_dissenter_counts_less():
    """One of five says -3 of a goal that pays 10: with the default a fifth of it is not learned."""
    reward = np.array([10.0] + 40 * [-0.1])
    said = np.tile(reward[:, None], (1, 5)) + 0.05 * np.random.default_rng(0).normal(size=(41, 5))
    said[0, 4] = -3.0
    feedback = aggregate(said, reward)
    learned = []
    for mitigation in (Witness(), Witness(stray=0.2)):
        statistics = mitigation.fit(feedback, feedback.count > 0)
        learned.append(mitigation.signal(Evidence(reward, 0.0 * reward, feedback), statistics).reward[0])
    assert learned[0] < 8.0
    assert learned[1] > 9.5
