"""Every trap has a log that is in it, with numbers derived by hand, and a clean log is in none."""

from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import uard.envs  # noqa: F401  (registers ids)
from uard import InvalidValueError, RatingLog, doctor
from uard.diagnosis import CODES, PRINTED, filtered
from uard.method.mitigations import named
from uard.ratings.rollout import rollout

N = 200


def clean(**changes):
    """Honest rewards in [0, 1] and two people who say the same to a thousandth."""
    random = np.random.default_rng(0)
    reward = np.linspace(0.0, 1.0, N)
    log = RatingLog(reward, reward[:, None] + random.normal(0.0, 0.001, (N, 2)), true_reward=reward)
    return replace(log, **changes)


def two_kinds(often, rarely, share=0.1):
    """A log of 100 rows of two kinds (reward, ratings); a share of the rows is of the second."""
    rare = round(100 * share)
    rows = [often] * (100 - rare) + [rarely] * rare
    return RatingLog(np.array([r for r, _ in rows], float), np.array([x for _, x in rows], float))


def finding(diagnosis, code):
    (found,) = [f for f in diagnosis.findings if f.code == code]
    return found


def severities(diagnosis):
    return {f.code: f.severity for f in diagnosis.findings}


@pytest.mark.parametrize("mitigation", ["uard", PRINTED, "uard-paper", "uard-exponential", "human-only"])
def test_a_clean_log_has_nothing(mitigation):
    found = doctor(clean(sigma_m=np.linspace(0.01, 0.1, N)), mitigation)
    assert found.findings == ()
    assert (found.rows, found.raters, found.rated) == (N, ("rating_1", "rating_2"), 1.0)
    assert found.agreement > 0.999
    assert str(found).endswith("findings: none")


def test_numbers_that_are_none():
    log = clean()
    log.reward[[3, 7]] = np.nan, np.inf
    log.ratings[5, 1], log.ratings[6, 1] = -np.inf, 1e300
    log = replace(log, true_reward=None, sigma_m=np.r_[np.nan, np.linspace(0.1, 1, N - 1)])
    found = finding(doctor(log), "not-finite")
    assert found.severity == "danger"
    assert found.numbers == {"reward": 2, "rating_2": 2, "sigma_m": 1}
    assert "reward in 2 rows, first nan in row 4;" in found.evidence
    assert "rating_2 in 2 rows, first -inf in row 6;" in found.evidence


def test_what_is_left_is_diagnosed_as_if_the_rest_were_not_there():
    log = clean()
    log.reward[N // 2 :] = np.nan
    half = doctor(clean(reward=log.reward[: N // 2], ratings=log.ratings[: N // 2], true_reward=log.reward[: N // 2]))
    assert severities(doctor(log)) == severities(half) | {"not-finite": "danger"}
    with pytest.raises(InvalidValueError, match="column of rewards = 'no number'"):
        doctor(RatingLog(np.array([np.nan, np.inf]), np.ones((2, 2))))


@pytest.mark.parametrize("ratings", [np.zeros((N, 0)), np.full((N, 2), np.nan)])
def test_nobody_rates(ratings):
    assert severities(doctor(clean(ratings=ratings, raters=()))) == {"no-ratings": "danger"}


def test_few_ratings():
    log = clean()
    log.ratings[np.arange(N) % 20 != 0] = np.nan
    found = doctor(log)
    assert finding(found, "few-ratings").numbers == {"rated_rows": 10, "rated_share": 0.05}
    assert found.rated == 0.05
    assert finding(found, "missing-ratings").numbers["missing"] == pytest.approx(0.95)


def test_missing_ratings_name_the_rater():
    log = clean()
    log.ratings[::2, 1] = np.nan  # half of the second rater's
    log.ratings[-2:, :] = np.nan  # the two highest rewards: nobody
    found = finding(doctor(log), "missing-ratings")
    assert found.severity == "warning"
    assert found.numbers["missing_rating_1"] == pytest.approx(2 / N)
    assert found.numbers["missing_rating_2"] == pytest.approx(101 / N)
    assert found.numbers["missing"] == pytest.approx(103 / (2 * N))
    assert found.numbers["unrated_rows"] == 2
    assert found.numbers["mean_reward_unrated"] == pytest.approx((198 / 199 + 1) / 2)
    assert "most of rating_2 (50.5 %)" in found.evidence


def test_one_missing_rating_is_a_note():
    log = clean()
    log.ratings[0, 0] = np.nan
    assert severities(doctor(log)) == {"missing-ratings": "note"}


def test_raters_with_nothing_of_their_own():
    log = clean()
    copies = np.stack([log.ratings[:, 0], log.reward, log.ratings[:, 0], np.full(N, 0.5)], axis=1)
    found = finding(doctor(replace(log, ratings=copies, raters=("ann", "bob", "cat", "dan"))), "idle-raters")
    assert found.numbers == {"repeats_reward_bob": 1.0, "cat_repeats_ann": 1.0, "constant_dan": 0.5}
    assert found.severity == "warning"


def test_a_few_equal_ratings_are_no_copy():
    log = clean()
    log.ratings[: N // 2, 0] = log.ratings[: N // 2, 1]
    assert doctor(log).findings == ()


def test_one_rater_is_blind_trust_for_the_printed_filter():
    # Scale 4 sqrt(0.1 0.9) = 1.2. sigma_h with the reward counted is 4/2 = 2 in a tenth of the rows: location 0.2,
    # deviation 0.36, z = 5, lambda_t = 0.2 (1 + 50 * 4) = 40.2, U = 0.5 * 2 / 1.2 and w = 1 / (1 + 33.5).
    log = two_kinds((0.0, [0.0]), (4.0, [0.0]))
    printed, old, ours = (finding(doctor(log, m), "one-rater") for m in (PRINTED, "uard-0.1", "uard"))
    assert (printed.severity, old.severity, ours.severity) == ("danger", "warning", "warning")
    assert printed.numbers[f"kept_{PRINTED}"] == 1.0
    assert old.numbers["kept_uard-0.1"] == pytest.approx(1 / 34.5)
    assert ours.numbers["kept_uard"] == 0.0  # the one rater is believed, and a little less than that
    assert ours.numbers["contradicted_rows"] == 10


def test_two_columns_with_one_rating_a_row_are_one_rater():
    log = clean()
    log.ratings[::2, 0] = log.ratings[1::2, 1] = np.nan
    assert severities(doctor(log)) == {"missing-ratings": "warning", "one-rater": "warning"}


def test_raters_who_agree_against_the_reward():
    # sigma_h = 0.1, so the printed filter has w = 1 / (1 + 2 * 0.5 * 0.1) and pays 4 / 1.1 where raters say 0.
    log = two_kinds((0.0, [-0.1, 0.1]), (4.0, [-0.1, 0.1]))
    printed, ours = (doctor(log, m) for m in (PRINTED, "uard"))
    found = finding(printed, "reward-contradicted")
    assert found.severity == "danger"
    assert found.numbers["kept"] == pytest.approx(1 / 1.1)
    assert found.numbers["largest"] == pytest.approx(4.0)
    assert found.numbers["rows"] == 10
    assert finding(ours, "reward-contradicted").severity == "note"
    assert finding(ours, "reward-contradicted").numbers["kept"] < 0.05


def test_noise_of_raters_is_no_contradiction():
    random = np.random.default_rng(1)
    reward = random.choice([0.0, 1.0], 3000)
    log = RatingLog(reward, reward[:, None] + random.normal(0.0, 1.2, (3000, 3)))
    assert "reward-contradicted" not in severities(doctor(log))


def test_stars_are_no_rewards():
    log = clean()
    stars = finding(doctor(replace(log, ratings=3.0 + 2.0 * log.ratings)), "other-units")
    assert stars.severity == "danger"
    assert stars.numbers["far_share"] == 1.0
    assert stars.numbers["correlation"] > 0.999
    assert stars.numbers["mean_rating"] == pytest.approx(4.0, abs=0.01)


def test_raters_who_repeat_a_lie():
    log = replace(two_kinds((0.0, [-0.1, 0.1]), (4.0, [3.9, 4.1])), true_reward=np.r_[np.zeros(90), np.full(10, -1.0)])
    diagnosis = doctor(log)
    found = finding(diagnosis, "colluding-raters")
    assert found.severity == "danger"
    assert (found.numbers["rows"], found.numbers["share"]) == (10, 0.1)
    assert found.numbers["largest"] == pytest.approx(5.0)
    assert "true -1" in found.evidence
    assert finding(diagnosis, "blind-sigma").severity == "danger"
    assert doctor(replace(log, true_reward=None)).findings == ()  # nobody could know


@pytest.mark.parametrize("sigma_m", [0.0, 0.7, 1e-5])
def test_a_dead_ensemble(sigma_m):
    dead = np.full(N, sigma_m) if sigma_m != 1e-5 else np.linspace(0, 1e-5, N)
    assert severities(doctor(clean(sigma_m=dead))) == {"dead-ensemble": "warning"}


def test_sigma_that_does_not_see_the_lie():
    # Raters quarrel about every honest step and agree, halfway, about the lie: sigma_h is the larger on honest steps.
    log = two_kinds((0.0, [-1.0, 1.0]), (4.0, [3.1, 3.1]))
    found = doctor(replace(log, true_reward=np.zeros(100)), PRINTED)
    assert finding(found, "blind-sigma").numbers["auroc"] == 0.0
    assert found.calibration["sigma_h"] == {"auroc": 0.0, "spearman": pytest.approx(-1.0)}
    assert finding(found, "blind-sigma").severity == "danger"


def test_calibration_of_a_good_sigma():
    log = two_kinds((0.0, [0.0, 0.0]), (4.0, [-1.0, 2.0]))
    found = doctor(replace(log, true_reward=np.zeros(100), sigma_m=np.linspace(0, 1, 100)))
    assert found.calibration["sigma_h"] == {"auroc": 1.0, "spearman": pytest.approx(1.0)}
    assert found.calibration["sigma_m"]["auroc"] == 1.0
    assert "blind-sigma" not in severities(found)
    assert doctor(log).calibration is None


def test_a_penalty_that_becomes_smaller():
    # sigma_h = 1 at the hazard: w = 1/2 and -2 becomes -1, above the honest -1.5 that everybody calls better.
    log = two_kinds((-1.5, [-1.5, -1.5]), (-2.0, [-3.0, -1.0]), share=0.5)
    found = finding(doctor(log, PRINTED), "smaller-penalties")
    assert found.severity == "danger"
    assert found.numbers == {"penalties": 50, "largest_gain": pytest.approx(1.0), "turned": 1.0}
    assert "On this log uard avoids it" in found.remedy
    assert finding(doctor(log), "smaller-penalties").severity == "note"


def test_origin_and_unit():
    # Believed: 2 / (1 + 1) = 1 < 1.5. Less 10: -8 / 2 = -4 > -8.5. Times 0.1: 0.2 / 1.1 > 0.15. Both turn every pair.
    log = two_kinds((1.5, [1.5, 1.5]), (2.0, [1.0, 3.0]), share=0.5)
    found = finding(doctor(log, PRINTED), "origin-and-unit")
    assert found.severity == "danger"
    assert found.numbers == {"shift": 1.0, "scale": 1.0}
    assert finding(doctor(log), "origin-and-unit").severity == "note"


def test_a_lie_that_still_pays():
    # The paper's trap: sd of {-1, 2, 1} is 1.247, so 4 becomes 4 / 2.247 = 1.78, 1.11 above the mean rating 2/3.
    log = two_kinds((0.0, [0.0, 0.0, 0.0]), (4.0, [-1.0, 2.0, 1.0]))
    found = finding(doctor(log, PRINTED), "lie-still-pays")
    paid = 4 / (1 + np.std([-1, 2, 1]))
    assert found.numbers["overpaid"] == pytest.approx(paid - 2 / 3)
    assert found.numbers["kept"] == pytest.approx((paid - 2 / 3) / (4 - 2 / 3))
    assert found.severity == "warning"
    assert severities(doctor(log)) == {"lie-still-pays": "note"}


@pytest.mark.parametrize(("unit", "severity"), [(1000.0, "danger"), (0.001, "warning")])
def test_saturated_weights(unit, severity):
    random = np.random.default_rng(0)
    reward = unit * random.normal(size=N)
    log = RatingLog(reward, reward[:, None] + unit * np.array([-1.0, 1.0]) * random.uniform(0.2, 1.0, (N, 1)))
    found = finding(doctor(log, PRINTED), "saturated-weights")
    assert found.severity == severity
    if severity == "danger":  # sigma_h >= 200, so w <= 1 / 201
        assert found.numbers["q95"] <= 1 / 201
    else:
        assert found.numbers["q05"] >= 1 / 1.001


def test_every_code_has_a_test():
    text = "".join(p.read_text(encoding="utf-8") for p in Path(__file__).parent.glob("test_*.py"))
    assert [code for code in CODES if f'"{code}"' not in text] == []


@pytest.mark.parametrize(
    ("panel", "expected"),
    [
        ("main", {"lie-still-pays": "note"}),
        ("appendix", {"reward-contradicted": "note"}),
        ("colluding", {"colluding-raters": "danger", "blind-sigma": "danger", "idle-raters": "warning"}),
        ("single", {"one-rater": "warning"}),
    ],
)
def test_panels_of_the_paper(panel, expected):
    with gymnasium.make("uard/TrapGrid6-v0", panel=panel) as env:
        assert severities(doctor(rollout(env, 1000))) == expected


def test_items_are_averaged_before_they_are_compared():
    # Each of two raters comes to one visit of an item only: alone they never disagree, together they do.
    reward = np.tile([0.0, 4.0], 50)
    ratings = np.where(np.arange(100)[:, None] // 2 % 2 == np.arange(2), reward[:, None] * 0.0, np.nan)
    rows = RatingLog(reward, ratings, true_reward=0 * reward)
    found = doctor(replace(rows, item=np.tile(["a", "b"], 50)), PRINTED)
    assert found.rated == 1.0
    assert finding(found, "one-rater").numbers["kept_uard-operator"] == 1.0
    log = replace(rows, ratings=np.where(np.arange(100)[:, None] < 4, np.zeros((100, 2)), np.nan))
    assert doctor(log).rated == 0.04
    assert doctor(replace(log, item=np.tile(["a", "b"], 50))).rated == 1.0


def test_rows_are_named_by_episode_and_step():
    log = two_kinds((0.0, [-0.1, 0.1]), (4.0, [-0.1, 0.1]), share=0.01)
    log = replace(log, episode=np.arange(100) // 10, step=np.arange(100) % 10)
    assert "row 100 (episode 9, step 9)" in finding(doctor(log), "reward-contradicted").evidence


def test_the_order_of_rows_does_not_matter():
    with gymnasium.make("uard/TrapGrid6-v0", panel="main") as env:
        log = rollout(env, 300)
    order = np.random.default_rng(0).permutation(300)
    columns = ("reward", "ratings", "true_reward", "item")
    mixed = RatingLog(**{c: getattr(log, c)[order] for c in columns})
    assert severities(doctor(mixed, PRINTED)) == severities(doctor(log, PRINTED))
    assert doctor(mixed).agreement == pytest.approx(doctor(log).agreement)


def test_data_and_text_say_the_same():
    found = doctor(two_kinds((0.0, [0.0, 0.0, 0.0]), (4.0, [-1.0, 2.0, 1.0])), PRINTED)
    data = found.as_data()
    assert data["findings"][0]["code"] == "lie-still-pays"
    assert data["raters"] == ["rating_1", "rating_2", "rating_3"]
    text = " ".join(str(found).split())
    for f in found.findings:
        for part in (f.evidence, f.consequence, f.remedy):
            assert " ".join(part.split()) in text
    assert found.count("warning") == len(found.findings) == 1


@pytest.mark.parametrize("mitigation", ["raw", "lcb", named("screening"), 3])
def test_what_is_no_filter_is_refused(mitigation):
    with pytest.raises(InvalidValueError, match=r"mitigation = .*must be"):
        doctor(clean(), mitigation)
    with pytest.raises(InvalidValueError, match="did you mean 'uard'"):
        doctor(clean(), "urad")


def test_one_row_and_rewards_that_never_change():
    assert severities(doctor({"reward": [1.0], "rating": [1.0]})) == {"few-ratings": "warning", "one-rater": "warning"}
    same = RatingLog(np.full(50, 0.1), np.full((50, 2), 0.1) + np.array([0.0, 0.01]))
    assert doctor(same).findings == ()


def test_extremes_make_no_nan():
    random = np.random.default_rng(0)
    for size in (1e-90, 1e90):
        log = RatingLog(size * random.normal(size=50), size * random.normal(size=(50, 2)), sigma_m=np.full(50, size))
        for m in ("uard", PRINTED, "uard-wiener"):
            assert "nan" not in str(doctor(log, m))


def test_filtered_rewards_are_what_the_doctor_looks_at():
    # The printed filter pays 4 / (1 + sd of {-1, 2, 1}) at the trap; see above for what uard makes of one rater.
    log = two_kinds((0.0, [0.0, 0.0, 0.0]), (4.0, [-1.0, 2.0, 1.0]))
    assert filtered(log, PRINTED)[[0, -1]] == pytest.approx([0.0, 4 / (1 + np.std([-1, 2, 1]))])
    assert filtered(two_kinds((0.0, [0.0]), (4.0, [0.0])), "uard-0.1")[[0, -1]] == pytest.approx([0.0, 4 / 34.5])
    half = clean()
    half.ratings[::2] = np.nan
    assert np.isfinite(filtered(half)).all()


@pytest.mark.parametrize(("column", "value"), [("reward", np.nan), ("ratings", np.inf), ("sigma_m", np.nan)])
def test_no_nan_is_filtered_silently(column, value):
    log = clean(sigma_m=np.full(N, 0.1))
    getattr(log, column)[3] = value
    with pytest.raises(InvalidValueError, match=rf"{column}\[3"):
        filtered(log)


def test_rules_that_ask_who_said_what_are_diagnosed_too():
    random = np.random.default_rng(0)
    true = np.repeat([0.0, 1.0, 4.0], 30)
    ratings = true[:, None] + 0.1 * random.normal(size=(90, 3))
    reward = np.where(true == 4.0, 8.0, true)
    log = RatingLog(reward, ratings)
    found = doctor(log, "uard")
    assert "lie-still-pays" not in [f.code for f in found.findings]
    assert filtered(log, "uard")[-1] < 5.0  # as the doctor shows it, with the premium
