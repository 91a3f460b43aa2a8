"""Findings about raters: found in simulated faults, and hardly ever in honest panels, over many seeds."""

import json
import os
from collections import Counter

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from uard import InvalidValueError, RatingLog, doctor
from uard.diagnosis import agreement_checks, copy_checks, rater_checks, sentinel_checks
from uard.diagnosis.case import as_filter, case_of

PANELS = int(os.environ.get("UARD_PANELS", "150"))  # of each kind; docs/guides/doctor.md says what 1000 give
CHECKS = (
    sentinel_checks.sentinel_value,
    rater_checks.straight_lines,
    rater_checks.too_constant,
    copy_checks.copied_ratings,
    agreement_checks.mixed_units,
)
OF_RATERS = ("sentinel-value", "straight-lining", "too-constant", "copied-ratings", "mixed-units")
CASE = """4.1 4 4 4;3.2 3 0 3;4.6 5 5 4;2.2 2 2 2;3.8 4 0 4;4.9 5 5 5;1.4 1 1 2;4.4 4 0 5;3.0 3 3 3;2.7 3 3 2;4.8 5 0 5
3.5 4 3 4;1.9 2 2 2;4.2 4 4 4;3.9 4 0 4;2.5 3 2 3;4.7 5 5 5;3.3 3 3 3"""


def finding(diagnosis, code):
    (found,) = [f for f in diagnosis.findings if f.code == code]
    return found


def codes(log):
    """Return what the checks of raters find, without all else that the doctor does."""
    case = case_of(log, "uard-0.1", as_filter("uard-0.1"))
    return {found.code for check in CHECKS if (found := check(case)) is not None}


def quality(kind, random, n):
    return {
        "dense": lambda: random.normal(size=n),
        "sparse": lambda: np.where(random.random(n) < 0.05, random.normal(5.0, 2.0, n), -0.1),
        "binary": lambda: (random.random(n) < 0.1).astype(float),
        "sorted": lambda: np.sort(random.normal(size=n)),
        "blocks": lambda: np.repeat(random.normal(size=n // 20 + 1), 20)[:n],
    }[kind]()


def honest(kind, seed):
    """An honest panel: 2 to 7 raters, biases (sd 0.3), noise (0.1 to 2.5), outliers, stars, gaps; a reward."""
    random = np.random.default_rng(seed)
    n, raters = int(random.choice([20, 60, 200])), int(random.integers(2, 8))
    truth = quality(kind, random, n)
    noise = np.exp(random.uniform(np.log(0.1), np.log(2.5), raters))
    heavy = 1.0 + 5.0 * (random.random((n, raters)) < 0.05 * random.integers(0, 2))
    ratings = truth[:, None] + random.normal(0.0, 0.3, raters) + noise * heavy * random.normal(size=(n, raters))
    if random.random() < 0.4:
        ratings = np.clip(np.round(ratings), -2.0, 5.0)
    ratings[random.random((n, raters)) > random.choice([1.0, 1.0, 0.5, 0.2])] = np.nan
    lies = (random.random(n) < 0.1) * (1.0 + 3.0 * np.abs(random.normal(size=n)))
    return RatingLog(truth + (0.0, lies, random.normal(0.0, 0.5, n))[random.integers(3)], ratings)


@pytest.mark.parametrize("kind", ["dense", "sparse", "binary", "sorted", "blocks"])
def test_honest_raters_are_hardly_ever_accused(kind):
    alarms = Counter(code for seed in range(1000, 1000 + PANELS) for code in codes(honest(kind, seed)))
    print(f"{kind}: of {PANELS} honest panels accused: {dict(alarms)}")
    assert max(alarms.values(), default=0) <= 4 * PANELS / 150, alarms
    assert alarms.total() <= 6 * PANELS / 150, alarms


def share_found(code, make, seeds=30):
    return np.mean([code in codes(make(np.random.default_rng(seed))) for seed in range(seeds)])


def three(random, sd=0.5, n=200):
    """Three raters and a reward, each with noise of its own."""
    truth = random.normal(size=n)
    return truth + random.normal(0.0, 0.5, n), truth[:, None] + random.normal(0.0, sd, (n, 3))


def stars(x):
    return np.clip(np.round(3.0 + x), 1.0, 5.0)


def in_three_units(random, n=60):
    truth = random.normal(size=n)
    seen = truth[:, None] + random.normal(0.0, 0.4, (n, 3))
    per_cent = np.clip(50.0 + 20.0 * seen[:, 1], 0.0, 100.0)
    return RatingLog(truth, np.column_stack([stars(seen[:, 0]), per_cent, 1.5 * seen[:, 2]]))


def test_stars_and_per_cent_and_logits_are_three_units():
    assert share_found("mixed-units", in_three_units) == 1.0
    found = finding(doctor(in_three_units(np.random.default_rng(0), n=2000)), "mixed-units")
    assert found.severity == "danger"
    assert "in 3 units" in found.evidence
    # The logits are nearest to the reward: 50 + 20 z per cent is z = p / 20 - 2.5, and logits are 1.5 z.
    assert found.numbers["slope_rating_2"] == pytest.approx(1.5 / 20, rel=0.05)
    assert found.numbers["offset_rating_2"] == pytest.approx(-1.5 * 2.5, rel=0.05)
    assert "slope_rating_3" not in found.numbers
    assert found.numbers["median_rating_1"] == 3.0


def test_noise_and_bias_are_no_unit():
    random = np.random.default_rng(0)
    truth = random.normal(size=2000)
    noise = np.array([0.1, 4.0, 4.0])  # spreads differ by four, the slope of the wider on the narrower is 1
    ratings = truth[:, None] + np.array([0.8, -0.2, 0.0]) + noise * random.normal(size=(2000, 3))
    assert "mixed-units" not in codes(RatingLog(truth, ratings))


def case_11(**changes):
    columns = np.array([row.split() for row in CASE.replace("\n", ";").split(";")], float)
    raters = ("judge_a", "judge_b", "judge_c")
    return RatingLog(columns[:, 0], columns[:, 1:], raters=raters, **changes)


def test_a_parse_failure_is_no_zero():
    found = finding(doctor(case_11()), "sentinel-value")
    assert found.severity == "danger"
    assert found.numbers["rows_judge_b_0"] == 5
    assert found.numbers["others_judge_b_0"] == pytest.approx(4.1)  # of 3 3, 4 4, 4 5, 5 5, 4 4
    assert found.numbers["alpha"] == pytest.approx(0.24, abs=0.005)
    assert found.numbers["alpha_without"] == pytest.approx(0.91, abs=0.005)
    assert "judge_b is exactly 0 in 5 rows of 18, first in row 2" in found.evidence
    assert "--missing 0" in found.remedy


def test_sentinels_of_any_value_are_found():
    def failing(value, rate):
        def make(random):
            reward, ratings = three(random)
            ratings = stars(ratings)
            ratings[random.random(200) < rate, 1] = value
            return RatingLog(reward, ratings)

        return make

    assert share_found("sentinel-value", failing(0.0, 0.1)) >= 0.9
    assert share_found("sentinel-value", failing(-1.0, 0.05)) >= 0.8
    assert share_found("sentinel-value", failing(99.0, 0.1)) >= 0.9


def test_low_scores_and_zeros_that_are_meant_are_no_sentinel():
    def harsh(random):  # one gives the lowest of five stars to more than half, the others to hardly any
        reward, ratings = three(random)
        return RatingLog(reward, stars(ratings + np.array([0.0, -2.0, 0.5])))

    def sparse(random):
        success = (random.random(300) < 0.1).astype(float)
        answers = np.abs(success[:, None] - (random.random((300, 3)) < 0.05))
        return RatingLog(success, answers)

    assert share_found("sentinel-value", harsh, 100) <= 0.01
    assert share_found("sentinel-value", sparse, 100) <= 0.01


def test_a_run_of_one_answer():
    def bored(random):
        reward, ratings = three(random)
        ratings = stars(ratings)
        ratings[100:130, 1] = 3.0
        return RatingLog(reward, ratings)

    assert share_found("straight-lining", bored) >= 0.9
    found = finding(doctor(bored(np.random.default_rng(0))), "straight-lining")
    assert 30 <= found.numbers["run_rating_2"] <= 32  # a neighbour may be 3 by chance
    assert "rating_2 gives 3 to" in found.evidence


def test_a_run_that_the_rows_explain_is_none():
    def sorted_rows(random):
        reward, ratings = three(random, sd=0.3)
        order = np.argsort(reward)
        return RatingLog(reward[order], stars(ratings[order]))

    assert share_found("straight-lining", sorted_rows, 100) <= 0.01
    zeros = np.r_[np.zeros(190), np.ones(10)]  # nothing happens for 190 steps, and all say so
    assert "straight-lining" not in codes(RatingLog(zeros, np.tile(zeros[:, None], 3)))


def test_a_rater_who_hardly_varies():
    def flat(random):
        reward, ratings = three(random)
        ratings = stars(ratings)
        ratings[:, 1] = np.where(random.random(200) < 0.03, 4.0, 3.0)
        return RatingLog(reward, ratings)

    assert share_found("too-constant", flat) == 1.0
    found = finding(doctor(flat(np.random.default_rng(0))), "too-constant")
    assert found.numbers.keys() == {"spread_rating_2"}


def test_a_precise_rater_among_noisy_ones_is_not_too_constant():
    def precise(random):
        reward, ratings = three(random, sd=np.array([0.05, 4.0, 4.0]))
        return RatingLog(reward, ratings)

    assert share_found("too-constant", precise, 100) <= 0.01


def test_a_rater_who_copies_most_answers():
    def copied(random):
        reward, ratings = three(random)
        taken = random.random(200) < 0.9
        ratings[taken, 1] = ratings[taken, 0] + random.normal(0.0, 0.05, taken.sum())
        return RatingLog(reward, ratings)

    assert share_found("copied-ratings", copied) >= 0.95
    found = finding(doctor(copied(np.random.default_rng(0))), "copied-ratings")
    assert found.numbers.keys() == {"correlation_rating_1_rating_2"}


def test_two_precise_raters_and_a_noisy_one_are_no_copies():
    def precise(random):  # both see the truth that the reward misses: their errors given the reward are nearly equal
        reward, ratings = three(random, sd=np.array([0.1, 0.1, 1.0]))
        return RatingLog(reward, ratings)

    assert share_found("copied-ratings", precise, 100) <= 0.02


def test_copies_among_two_thousand_raters_are_found():
    random = np.random.default_rng(0)
    truth = random.normal(size=100)
    ratings = truth[:, None] + random.normal(0.0, 0.5, (100, 2000))
    ratings[:, 1999] = ratings[:, 3]
    found = copy_checks.idle_raters(case_of(RatingLog(truth, ratings), "uard-0.1", as_filter("uard-0.1")))
    assert found is not None
    assert found.numbers == {"rating_2000_repeats_rating_4": 1.0}


def parts(random, n=120):
    """Raters agree which half a row is of, and on nothing within the second half."""
    machine = np.arange(n) % 2
    truth = random.normal(size=n)
    ratings = np.where(machine, 0.0, 5.0)[:, None] + np.where(machine, 0.0, truth)[:, None]
    return ratings + random.normal(0.0, 0.5, (n, 3)), np.where(machine, "machine", "human")


def test_agreement_within_a_part():
    ratings, by = parts(np.random.default_rng(0))
    diagnosis = doctor(RatingLog(ratings.mean(1), ratings, by=by))
    human, machine = diagnosis.strata
    assert (human.name, human.rows, machine.name, machine.rows) == ("human", 60, "machine", 60)
    assert diagnosis.agreement_interval[0] < diagnosis.agreement < diagnosis.agreement_interval[1]
    assert diagnosis.agreement > 0.9
    assert human.agreement > 0.7
    assert machine.low < 0.0 < machine.high < 0.3  # there is nothing to agree on
    assert machine.within == pytest.approx(0.5, rel=0.1)
    found = finding(diagnosis, "uneven-agreement")
    assert found.numbers.keys() == {"alpha", "alpha_machine"}
    assert "within machine: " in str(diagnosis)
    assert json.loads(json.dumps(diagnosis.as_data()))["strata"][1]["name"] == "machine"


def test_parts_are_a_column_of_a_file_or_a_frame(tmp_path):
    ratings, by = parts(np.random.default_rng(0))
    columns = {"reward": ratings.mean(1), "system": by} | {f"rating_{k}": ratings[:, k] for k in range(3)}
    assert [s.name for s in doctor(columns, by="system").strata] == ["human", "machine"]
    lines = [",".join(columns), *(",".join(map(str, row)) for row in zip(*columns.values(), strict=True))]
    (tmp_path / "log.csv").write_text("\n".join(lines))
    assert doctor(tmp_path / "log.csv", by="system").strata == doctor(columns, by="system").strata
    with pytest.raises(InvalidValueError, match=r"column = 'sistem'.*did you mean 'system'"):
        doctor(columns, by="sistem")
    with pytest.raises(InvalidValueError, match="by = 'a column of 120 different values': must be one of at most 50"):
        doctor(columns | {"row": range(120)}, by="row")
    for number in ("reward", "rating_0"):
        with pytest.raises(InvalidValueError, match=f"by = '{number}': must be a column that is neither"):
            doctor(columns, by=number)
    with pytest.raises(InvalidValueError, match="by = 'system': must be left out"):
        doctor(RatingLog(ratings.mean(1), ratings), by="system")


def test_parts_of_one_row_have_no_agreement():
    one, other = doctor(
        RatingLog(np.arange(3.0), np.ones((3, 2)) * [[0], [1], [2]], by=np.array(["a", "b", "b"]))
    ).strata
    assert (one.rows, one.agreement, one.low) == (1, None, None)
    assert (other.rows, other.agreement, other.low) == (2, 1.0, None)  # too few items for an interval


def test_effective_number_of_raters():
    random = np.random.default_rng(0)
    truth, mistake = random.normal(size=(2, 20_000))
    shared = RatingLog(truth, (truth + mistake)[:, None] + random.normal(size=(20_000, 4)), true_reward=truth)
    told = doctor(shared)
    found = told.independence  # errors correlate by 1/2: 4 / (1 + 3/2)
    assert found.against == "true_reward"
    assert found.correlation.low < 0.5 < found.correlation.high < found.correlation.low + 0.04
    assert found.number.value == pytest.approx(1.6, abs=0.05)
    assert told.as_data()["independence"]["number"]["value"] == found.number.value
    assert f"4 are worth {found.number:.3g} independent ones" in str(told)
    assert "shared-errors" in {finding.code for finding in told.findings}
    blind = doctor(RatingLog(truth + mistake, shared.ratings))  # the reward makes the same mistake, and nobody can know
    assert blind.independence.number.value == pytest.approx(4.0, abs=0.1)
    own = RatingLog(truth, truth[:, None] + random.normal(size=(20_000, 4)), true_reward=truth)
    assert "shared-errors" not in {finding.code for told in (blind, doctor(own)) for finding in told.findings}
    assert doctor(RatingLog(truth, shared.ratings[:, :1])).independence is None


NUMBERS = st.one_of(
    st.sampled_from(
        [0.0, 1.0, 2.0, np.nan, np.inf, -np.inf, 5e-324, 1e-310, -1e-200, 1e308, -1.7e308, 9e99, 1e-99, 1e16]
    ),
    st.floats(width=64),
)


@st.composite
def any_log(draw):
    n, raters = draw(st.sampled_from([1, 2, 3, 12, 40])), draw(st.integers(0, 5))
    pool = np.array(draw(st.lists(NUMBERS, min_size=1, max_size=6)))
    random = np.random.default_rng(draw(st.integers(0, 999)))
    columns = {"true_reward": random.choice(pool, n), "sigma_m": np.abs(random.choice(pool, n))}
    columns |= {"item": random.integers(0, 4, n), "by": random.integers(0, 2, n)}
    kept = draw(st.sets(st.sampled_from(sorted(columns))))
    ratings = random.choice(pool, (n, raters))
    return RatingLog(random.choice(pool, n), ratings, **{name: columns[name] for name in sorted(kept)})


@given(any_log(), st.sampled_from(["uard-0.1", "uard-operator"]))
@settings(max_examples=100, deadline=None)
def test_any_numbers_end_in_a_diagnosis_that_json_can_hold(log, mitigation):
    if not (np.abs(log.reward) < 1e100).any():
        with pytest.raises(InvalidValueError, match="column of rewards = 'no number'"):
            doctor(log, mitigation)
        return
    diagnosis = doctor(log, mitigation)
    json.dumps(diagnosis.as_data(), allow_nan=False)
    assert str(diagnosis)


@given(st.integers(0, 10_000), st.sampled_from(["dense", "sparse", "binary"]), st.booleans())
@example(2237, "dense", False)  # items that differ in no more than the rounding of their sums
@settings(max_examples=25, deadline=None)
def test_the_order_of_rows_and_raters_changes_no_number(seed, kind, in_units):
    log = in_three_units(np.random.default_rng(seed)) if in_units else honest(kind, seed)
    random = np.random.default_rng(seed)
    rows, raters = random.permutation(len(log)), random.permutation(len(log.raters))
    by = np.arange(len(log)) % 2
    mixed = RatingLog(
        log.reward[rows], log.ratings[np.ix_(rows, raters)], tuple(log.raters[k] for k in raters), by=by[rows]
    )
    a, b = (doctor(x) for x in (RatingLog(log.reward, log.ratings, log.raters, by=by), mixed))
    assert a.agreement_interval == pytest.approx(b.agreement_interval)
    if a.independence is not b.independence:  # of rows that hold the same ratings, the interval depends on their order
        one, other = (x.independence.correlation for x in (a, b))
        assert one.value == pytest.approx(other.value)
        assert one == pytest.approx(other, abs=0.1)
    assert [s.agreement for s in a.strata] == pytest.approx([s.agreement for s in b.strata])
    numbers = [
        {f.code: dict(f.numbers) for f in x.findings if f.code in OF_RATERS and f.code != "straight-lining"}
        for x in (a, b)
    ]
    assert numbers[0].keys() == numbers[1].keys()
    for code, values in numbers[0].items():
        assert values == pytest.approx(numbers[1][code]), code
