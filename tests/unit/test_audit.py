import json
import math
import re
import string
from dataclasses import replace

import numpy as np
import pytest

from uard._checks import InvalidValueError, UnknownNameError
from uard.envs.grids.trapgrid import TrapGrid, paper_grid
from uard.replication import audit, ledger, paper
from uard.replication.audit.checks import Check, all_words, filled
from uard.replication.audit.consistency import largest_equal
from uard.replication.audit.episodes import episode_moments, hacker_policy, most_visits, visits_of_the_best
from uard.replication.audit.negative_values import HAZARDS
from uard.replication.audit.raters import RaterSpread
from uard.replication.audit.rivals import fewest_events
from uard.replication.audit.solutions import SIZES
from uard.replication.verdicts import FAILS, HOLDS, IN_PART, Opinion, Part


@pytest.fixture(scope="module")
def checks():
    found = audit.run()
    by_id = {c.id: c for c in found}
    assert len(by_id) == len(found)
    return by_id


def close(checks, check, **expected):
    """Compare recomputed values; names are written with _ for anything but letters and digits."""
    values = {re.sub(r"\W+", "_", k).strip("_"): v for k, v in checks[check].recomputed.items()}
    for name, (value, tolerance) in expected.items():
        assert values[name] == pytest.approx(value, abs=tolerance), name


def test_every_check_is_well_formed(checks):
    for check in checks.values():
        assert check.question.endswith(("?", ")")), check.id
        assert check.recomputed, check.id
        assert check.verdict, check.id
        assert check.concerns, check.id
        for name in check.concerns:
            assert re.fullmatch(r"[A-K]\d+", name)
            assert not name.startswith("J") or name in ledger.CLAIMS
        for value in (*check.paper.values(), *check.recomputed.values()):
            assert value is None or isinstance(value, str) or math.isfinite(value)
        json.dumps({**check.paper, **check.recomputed})


def test_sections_are_told_by_their_ids():
    for section in ("a2", "c", "g"):
        assert all(c.id.startswith(section + ".") for c in audit.SECTIONS[section]())


def test_what_holds_and_what_does_not(checks):
    verdicts = {c.id: c.judgement.verdict for c in checks.values() if c.judgement}
    assert {name for name, verdict in verdicts.items() if verdict == HOLDS} == {
        *("a.percent", "a2.percent", "c.true-return", "c.baselines", "f.contraction", "h.percent")
    }
    assert {name for name, verdict in verdicts.items() if verdict == IN_PART} == {
        *("0.main", "a.random", "a.optimum", "b.percent", "c.visits", "e.order"),
        *("f.critical-lambda", "f.sigma-m", "h.variance", "h.gradients"),
    }
    assert {c.holds for c in checks.values() if verdicts.get(c.id) in (IN_PART, FAILS)} == {False}
    assert {c.id for c in checks.values() if c.holds is None} == set(checks) - set(verdicts)
    counts = {name: checks[name].judgement.count for name in ("0.main", "0.appendix", "c.visits", "e.hazard")}
    assert counts == {"0.main": "1 of 3", "0.appendix": "0 of 3", "c.visits": "2 of 3", "e.hazard": "0 of 5"}


def test_every_sentence_is_the_one_written_for_its_outcome(checks):
    assert set(all_words()) == set(checks)
    for check in checks.values():
        assert [o.name for o in check.found if not o.holds] == [], check.id
        (sentence,) = all_words()[check.id].verdict.values()
        assert check.verdict == filled(sentence, check.numbers), check.id


NAMES_WITH_DIGITS = re.compile(
    r"\bL\d+\b|\bTables? \d\b|\b\d+x\d+\b|Theorem 1\b|\{\{-1, 2, 1\}\}|1/\(M-1\)|1/M|\(0, 1\]|mu [<>] 0|w > 0"
)


def test_numbers_in_words_are_named_and_never_typed(checks):
    for name, words in all_words().items():
        for template in (words.question, *words.verdict.values()):
            fields = [field for _, field, _, _ in string.Formatter().parse(template) if field is not None]
            assert set(fields) <= set(checks[name].numbers), name
            prose = re.sub(r"(?<!\{)\{[^{}]+\}(?!\})", "", template)
            assert not re.search(r"\d", NAMES_WITH_DIGITS.sub("", prose)), (name, template)


def other_values(numbers):
    """Values that a number could have instead: some far, some beside it, those of other numbers and beside them."""
    yield from (0.0, 0.5, 1.0, 1e9, -1e9, None)
    for value in numbers.values():
        if isinstance(value, int | float):
            yield from (value, value + 0.02, value - 0.02, -value, round(value))


def turned(check, part):
    """Return the check with one other number, so that the part turns; None if no number does it."""
    for where in ("printed", "recomputed", "others"):
        values = getattr(check, where)
        for name, value in ((n, v) for n in values for v in other_values(check.numbers)):
            try:
                if part.holds({**check.numbers, name: value}) != part.holds(check.numbers):
                    return replace(check, **{where: {**values, name: value}})
            except TypeError:  # not every part can do without this number
                continue
    return None


def parts(checks, kind):
    return [(c, p) for c in checks.values() for p in getattr(c, kind) if isinstance(p, Part)]


def test_a_number_turns_every_part_of_a_claim_and_moves_the_judgement(checks):
    for check, part in parts(checks, "claims"):
        moved = turned(check, part)
        assert moved is not None, f"{check.id}: nothing turns: {part.name}"
        before, after = ({o.name: o.holds for o in c.parts} for c in (check, moved))
        assert after[part.name] is (not before[part.name])
        assert moved.judgement != check.judgement
        assert f"{part.name}: {'yes' if after[part.name] else 'no'}" in moved.verdict, check.id


def test_a_number_turns_every_finding_and_the_sentence_goes(checks):
    for check, part in parts(checks, "findings"):
        moved = turned(check, part)
        assert moved is not None, f"{check.id}: nothing turns: {part.name}"
        assert f"{part.name}: no" in moved.verdict, check.id


def test_parts_read_nothing_but_the_named_numbers(checks):
    allowed = {"abs", "round", "math", "floor"}
    for check in checks.values():
        names = [p.name for p in (*check.claims, *check.findings)]
        assert len(set(names)) == len(names), check.id
        for part in (*check.claims, *check.findings):
            if isinstance(part, Part):
                assert set(part.holds.__code__.co_names) <= allowed, (check.id, part.name)


def test_a_check_whose_outcome_has_no_sentence_says_its_parts_one_by_one():
    halves = (Part("more than one", lambda n: n["x"] > 1), Opinion("well said", False))
    check = Check("a.percent", recomputed={"x": 2.0}, claims=halves)
    assert (check.holds, check.judgement.verdict) == (False, IN_PART)
    assert check.verdict == "more than one: yes; well said: no (our reading)"
    assert Check("a.percent", recomputed={"x": 2.0}, claims=halves[:1]).verdict == "yes"
    doubted = Check("a.percent", recomputed={"x": 2.0}, claims=halves[:1], findings=halves[1:])
    assert (doubted.holds, doubted.verdict) == (True, "more than one: yes; well said: no (our reading)")
    silent = Check("a.percent", recomputed={"x": 2.0})
    assert (silent.holds, silent.judgement, silent.parts) == (None, None, ())


def test_names_stand_for_one_number_and_words_must_be_there():
    with pytest.raises(InvalidValueError, match="'x': must be a name that stands for one number only"):
        Check("a.percent", printed={"x": 1.0}, recomputed={"x": 2.0})
    with pytest.raises(UnknownNameError, match=r"did you mean 'a\.percent'"):
        Check("a.percents")
    assert filled("{a.b [c]:.1f} of {d}", {"a.b [c]": 0.25, "d": None}) == "0.2 of None"
    assert filled("{x:.0%} of {{1}}", {"x": 0.123}) == "12 % of {1}"
    with pytest.raises(UnknownNameError, match="number = 'visit'"):
        filled("{visit}", {"visits": 1.0})


def test_table_3_was_run_with_another_horizon(checks):
    for value in checks["a.horizon"].recomputed.values():
        assert value == pytest.approx(100, abs=0.06)
    close(
        checks,
        "a.horizon-inclusive",
        DQN=(57.1, 0.05),
        CQL=(56.3, 0.05),
        CPO=(56.9, 0.05),
        TRPO=(56.4, 0.05),
        UARD=(97.3, 0.05),
    )
    close(checks, "a.identity", largest_residual=(0.0049, 1e-4))
    close(
        checks, "a.sd", DQN=(2.229, 1e-3), CQL=(0.985, 1e-3), CPO=(1.540, 1e-3), TRPO=(0.800, 1e-3), UARD=(0.69, 1e-3)
    )
    close(checks, "a.ceiling", **{"6x6_T_40": (18, 0), "8x8_T_60": (28, 0), "10x10_T_80": (38, 0)})
    close(checks, "a.ceiling", **{"10x10_T_100": (48, 0)})


def test_two_baselines_are_tabular_hackers_and_a_random_walker_beats_uard(checks):
    close(
        checks,
        "a.hacker",
        visits_in_100_episodes=(4366, 1),
        visits_first_of_tied_actions=(4362.5, 0.1),
        SD=(21.0, 0.1),
        z_of_CQL=(0.05, 0.1),
        z_of_TRPO=(-1.1, 0.1),
        z_of_CPO=(-9.8, 0.1),
        z_of_DQN=(-11.6, 0.1),
    )
    close(checks, "a.random", visits=(2.463, 1e-3), reduction=(94.26, 0.01), reward=(0.914, 1e-3), goal=(6.45, 0.01))
    close(checks, "a.cost-limit", times_the_limit=(86.0, 0.05))
    close(checks, "a.epsilon", DQN=(0.124, 2e-3), CPO=(0.121, 2e-3))


def test_percentages(checks):
    close(checks, "a2.percent", **{"8": (87.39, 0.01), "10": (92.91, 0.01)})
    close(checks, "a2.same-grid", baseline_Table_3_Table_2=(30.4, 0.05), UARD_Table_3_Table_2=(27.4, 0.05))
    close(checks, "b.percent", from_the_printed_gap=(95.88, 0.01), from_the_printed_returns=(83.12, 0.01))
    close(checks, "h.percent", rise=(277.42, 0.01), lower=(98.29, 0.01))
    close(checks, "f.93.7", Table_3_10x10=(93.61, 0.01), one_crossing_in_16=(93.75, 1e-9))


def test_table_4_mixes_two_agents(checks):
    close(checks, "b.path", shortest_way_to_the_goal=(9.1, 1e-6), never_arriving_in_40_steps=(-4.0, 1e-6))
    close(checks, "b.gap", least_possible=(13.1, 1e-9))
    close(
        checks,
        "b.trap-worth",
        Baseline_means=(-1.075, 1e-3),
        Multi_Head_means=(-1.734, 1e-3),
        Baseline_gap_per_visit=(-0.79, 1e-3),
        Multi_Head_gap_per_visit=(-0.814, 1e-3),
        Baseline_lowest_of_the_curve_at_most=(-2.58, 3e-3),
        Multi_Head_lowest_of_the_curve_at_most=(-2.73, 4e-3),
    )
    close(checks, "b.multi-head", variance_ratio=(5.29, 0.01), p=(0.0104, 1e-4))


def test_significance(checks):
    close(
        checks,
        "c.visits",
        t=(22.03, 0.01),
        t_SDs_with_1_n=(20.89, 0.01),
        largest_t_other_SD_0=(24.39, 0.01),
        and_with_rounding_in_its_favour=(25.07, 0.01),
        n_that_gives_29_15=(17.5, 0.05),
    )
    close(checks, "c.true-return", Welch_t=(4.84, 0.01), Welch_p=(9e-4, 1e-5), variance_ratio=(294.7, 0.01))
    close(checks, "c.worse-than-dqn", t_CQL=(4.10, 0.01), p_CQL=(0.0014, 1e-4), t_TRPO=(3.81, 0.01), p_CPO=(0.59, 0.01))
    close(checks, "c.ablation", p_Ablation_I=(0.265, 1e-3), p_Ablation_II=(0.026, 1e-3))


def test_annotators(checks):
    close(
        checks,
        "d.triples",
        integer_triples_in_10_10_population_SD=(36, 0),
        integer_triples_sample_SD=(0, 0),
        halves_sample_SD=(0, 0),
        tenths_sample_SD=(0, 0),
        **{"1_2_1_sample_SD": (1.5275, 1e-4)},
    )
    close(
        checks,
        "d.appendix",
        mean_at_traps_ddof_0=(0.4118, 1e-4),
        mean_at_traps_ddof_1=(0.5044, 1e-4),
        mean_elsewhere_ddof_0=(0.1537, 1e-4),
        mean_elsewhere_ddof_1=(0.1883, 1e-4),
        P_at_least_1_247_ddof_0=(0.0094, 1e-4),
        P_at_least_1_247_ddof_1=(0.0345, 1e-4),
        third_rater_s_SD_for_a_mean_of_1_247_ddof_0=(3.273, 1e-3),
        third_rater_s_SD_for_a_mean_of_1_247_ddof_1=(2.658, 1e-3),
    )
    close(checks, "d.frozen", P=(0.1723, 1e-4))


def test_quadrature_agrees_with_sampling():
    draws = 400_000
    rng = np.random.default_rng(5)
    traps, others = (
        (rng.normal(size=(draws, 3)) * paper.APPENDIX_RATER_SD[place]).std(1) for place in ("trap", "elsewhere")
    )
    trap, other = (RaterSpread(paper.APPENDIX_RATER_SD[place], 0) for place in ("trap", "elsewhere"))
    for exact, sample in (
        (trap.mean(), traps),
        (other.mean(), others),
        (trap.exceeds(1.247), traps >= 1.247),
        (trap.below(other), traps < others),
        (trap.mean_weight(2.0), 1 / (1 + traps)),
        (other.mean_weight(500.0), 1 / (1 + 250 * others)),
    ):
        assert exact == pytest.approx(sample.mean(), abs=5 * sample.std() / math.sqrt(draws))


def test_negative_values(checks):
    close(checks, "e.order", mu_1_U_0_1=(-0.833, 1e-3), mu_1_5_U_1_5=(-0.375, 1e-9))
    assert checks["e.order"].recomputed["mean U chosen, negative values (indifference: 0.75)"] > 1.0
    assert checks["e.order"].recomputed["mean U chosen, positive values (indifference: 0.75)"] < 0.5
    entered = [checks["e.hazard"].recomputed[f"hazard {h:g} entered from lambda"] for h in HAZARDS]
    assert entered == [2.0, 2.0, 2.0, 5.0, 10.0]
    close(
        checks,
        "e.hazard",
        cells_entered_with_sign_aware_weights=(0, 0),
        cells_entered_with_an_anchor_one_sigma_h_below_the_reward=(0, 0),
    )
    close(checks, "e.kappa", U_0_3=(1.10, 0.01), U_0_9=(5.26, 0.01), U_1_0001=(-5000, 1), U_1_1=(-4.76, 0.01))
    close(checks, "e.scale", as_is_chosen=(1, 0), all_x_0_1_chosen=(0, 0), rewards_10_chosen=(0, 0))


MAIN = {4: (5.11, 6.05, 8.05), 8: (11.82, 13.70, 17.71)}
SAMPLE = {4: (4.17, 4.94, 6.57), 8: (9.65, 11.18, 14.46)}


def test_the_operator_still_hacks(checks):
    close(checks, "f.lambda-2", settings_that_hack=(24, 0), settings=(24, 0))
    table = checks["f.critical-lambda"].recomputed
    for name, expected in (("main, population SD", MAIN), ("main, sample SD", SAMPLE)):
        for reward, row in expected.items():
            assert [table[f"{name}, +{reward}, {n}"] for n in SIZES] == pytest.approx(row, abs=0.006)
    for ddof in (0, 1):
        assert {table[f"appendix, ddof {ddof}, +{r}, {n}"] for r in (4, 8) for n in SIZES} == {None}
    close(checks, "f.critical-lambda", settings_that_arrive_at_lambda_5=(2, 0))
    ratios = checks["f.critical-ratio"].recomputed
    assert [ratios[f"+4, {n}"] for n in SIZES] == pytest.approx([0.239, 0.210, 0.166], abs=5e-4)
    assert [ratios[f"+8, {n}"] for n in SIZES] == pytest.approx([0.1195, 0.105, 0.083], abs=5e-4)
    assert ratios["appendix, lambda to infinity, mean w of fresh draws"] == pytest.approx(0.431, abs=1e-3)
    fresh = checks["f.fresh-ratings"].recomputed
    for name, row in (
        ("main at traps, appendix elsewhere; fresh", (9.35, 12.25, 20.68)),
        ("main at traps, appendix elsewhere; mean sigma_h", (10.55, 14.68, 31.22)),
        ("appendix at traps, agreement elsewhere; fresh", (22.6, 27.3, 37.6)),
        ("appendix at traps, agreement elsewhere; mean sigma_h", (15.5, 18.3, 24.4)),
    ):
        assert [fresh[f"{name}, +4, {n}"] for n in SIZES] == pytest.approx(row, rel=5e-3)


def test_readings_of_where_the_filter_acts(checks):
    main, appendix = checks["0.main"].recomputed, checks["0.appendix"].recomputed
    for size, visits in ((6, 18), (8, 28), (10, 38)):
        for table in (main, appendix):
            assert table[f"{size}, raw"] == table[f"{size}, T_lambda"] == f"{visits} visits, no goal"
            assert table[f"{size}, acts on J"] == "0 visits, no goal"
            assert table[f"{size}, acts on J: true return"] == -paper.HORIZON[size] / 10
        assert main[f"{size}, backs up J's action"] == "0 visits, goal"
        assert "no goal" in str(appendix[f"{size}, backs up J's action"])


def test_what_else_follows_for_the_operator(checks):
    assert checks["f.positivity"].recomputed == {
        "6": "1 visits, goal",
        "8": "2 visits, goal",
        "10": "2 visits, goal",
    }
    close(checks, "f.contraction", largest_ratio=(0.95, 1e-9))
    close(checks, "f.live", trap_4=(5.33, 2e-3), trap_10=(11.90, 5e-3))
    close(checks, "f.sigma-m", after_600_sweeps=(0, 1e-9), distance_from_raw_Q=(0, 1e-9), UARD_lite_visits=(18, 0))
    close(checks, "f.anchor", goal_4_6=(2.5, 0.01), goal_4_10=(3.21, 0.01), goal_without_a_visit_4_6=(7.31, 0.01))
    close(checks, "f.undiscounted", lambda_4=(62.6, 0.1), lambda_8=(126.7, 0.1))
    within = [v for k, v in checks["f.undiscounted"].recomputed.items() if k.startswith("visits")]
    assert within == [1.0, 16.0]
    noise = checks["f.noise"].recomputed
    assert noise["noise 0.3, fresh ratings: lambda that arrives"] == pytest.approx(13.5, abs=0.1)
    assert noise["noise 0.3, mean sigma_h: lambda that arrives"] == pytest.approx(18.1, abs=0.1)
    assert noise["noise 1.2, fresh ratings: lambda that arrives"] is None
    mean_rating = checks["f.mean-rating"].recomputed
    assert [str(v).endswith("no goal") for v in mean_rating.values()] == [False, False, True, False, False, False]


def test_consistency(checks):
    close(
        checks,
        "g.radius",
        raw_rewards_perturbed_common_w=(1, 1e-9),
        filtered_advantage_perturbed=(0.445, 1e-3),
        the_uncertain_rival_inflated=(2.247, 1e-3),
    )
    close(
        checks,
        "h.exceeds",
        largest_value_that_1_can_all_reach=(47.0, 0.05),
        largest_value_that_2_can_all_reach=(39.1, 0.1),
        seeds_that_can_rounding_in_their_favour=(1, 0),
    )
    close(checks, "h.variance", variance_ratio=(1.37, 0.01), p=(0.32, 0.01))
    close(checks, "h.gradients", lambda_U=(2.513, 1e-3), exponential_slope_at_1_247=(0.287, 1e-3))
    close(checks, "i.counts", EDAC_at_least=(25, 0), UARD_then=(2, 0))
    close(checks, "i.sunrise", UARD_s_reward_if_SUNRISE_s_is_1_4=(-0.2, 1e-9))


def test_the_chain_agrees_with_a_simulation():
    grid, episodes = TrapGrid(size=4, traps=((1, 1), (2, 3)), horizon=15), 40_000
    task, hack = grid.task(), grid.truth().hack
    policy = np.zeros((16, 4))
    policy[np.arange(16), np.arange(16) % 4] = 1.0
    exact = episode_moments(grid, policy, [0.3, 1.0])
    rng = np.random.default_rng(2)
    for i, eps in enumerate((0.3, 1.0)):
        state, alive = np.zeros(episodes, int), np.ones(episodes, bool)
        visits, total = np.zeros(episodes), np.zeros(episodes)
        for _ in range(15):
            action = np.where(rng.random(episodes) < eps, rng.integers(0, 4, episodes), state % 4)
            visits += alive & hack[state, action]
            total += np.where(alive, task.reward[state, action], 0.0)
            state, alive = task.next_state[state, action], alive & ~task.terminal[state, action]
        for value, sample in (
            (exact.visits, visits),
            (exact.visits_variance, (visits - visits.mean()) ** 2),
            (exact.success_rate, 1.0 - alive),
            (exact.observed_return, total),
        ):
            assert value[i] == pytest.approx(sample.mean(), abs=5 * sample.std() / math.sqrt(episodes) + 1e-9)


def test_helpers_by_hand():
    assert most_visits(TrapGrid(size=3, traps=((1, 1),), horizon=5)) == 2
    assert most_visits(TrapGrid(size=2, traps=((0, 1),), horizon=5)) == 5  # bumping into a wall re-enters
    assert visits_of_the_best(TrapGrid(size=2, traps=((0, 1),), horizon=5), 1.0) == 4  # 4 x 4 and the goal, 10
    assert visits_of_the_best(TrapGrid(size=2, traps=((0, 1),), horizon=5), -1.0) == 0  # by the other way
    assert fewest_events(50.0) == (1, 2)
    assert fewest_events(0.0) == (1, 1)
    assert largest_equal(paper.Stat(2.0, math.sqrt(2)), 1, n=2) == pytest.approx(3.0)  # 1 and 3
    assert hacker_policy(paper_grid(6)).sum(1).tolist() == pytest.approx([1.0] * 36)


def test_the_papers_numbers_are_complete():
    assert list(paper.FIGURES) == [f"G{i}" for i in range(1, 17)]
    assert list(paper.TESTS) == ["I1", "I2", "I3"]
    assert len(paper.BASELINES) == 9
    assert {r.method for r in paper.TABLE_3} - {"UARD"} <= set(paper.BASELINES)
    lines = [r.line for t in (paper.TABLE_2, paper.TABLE_3, paper.TABLE_4, paper.TABLE_5) for r in t]
    assert len(set(lines)) == len(lines)
    assert {q.value for q in paper.PERCENT.values()} == {93.6, 93.7, 87.4, 92.9, 95.9, 91.7, 277.0, 98.3, 92.0}
