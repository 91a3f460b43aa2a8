"""The control study of who is asked what: exact returns by hand, the same answers for all, and what the report says."""

import json
from pathlib import Path

import numpy as np
import pytest

from uard.cli.app import main
from uard.envs.grids.trapgrid import TrapGrid
from uard.lab.studies import acquisition
from uard.lab.studies.acquisition import (
    ANSWERS,
    CLIPS,
    GRIDS,
    PAIRS,
    RULES,
    TRAPS,
    answering,
    best_policy,
    grid_case,
    value,
)
from uard.lab.views import acquisition as views
from uard.lab.views import page, published
from uard.ratings.panels import is_for_development, random_panel

GRID = TrapGrid(6)


def test_exact_returns_by_hand():
    true, observed = (np.asarray(x.reward, float) for x in (GRID.truth(), GRID.task()))
    honest, gaming = best_policy(GRID, true), best_policy(GRID, observed)
    assert value(GRID, honest, true) == pytest.approx(10.0 - 9 * 0.1)
    # The trap is entered at steps 6, 8, ... 36, and the goal at step 40; the 23 others pay -0.1.
    assert value(GRID, gaming, observed) == pytest.approx(16 * 4.0 + 10.0 - 23 * 0.1)
    assert value(GRID, gaming, true) == pytest.approx(-16 * 1.0 + 10.0 - 23 * 0.1)


def test_a_random_walk_by_simulation():
    true, random = np.asarray(GRID.truth().reward, float), np.random.default_rng(0)
    task = GRID.task()
    totals = []
    for _ in range(4000):
        state, total = int(task.start), 0.0
        for _ in range(GRID.horizon):
            action = random.integers(4)
            total += true[state, action]
            if task.terminal[state, action]:
                break
            state = task.next_state[state, action]
        totals.append(total)
    error = np.std(totals) / np.sqrt(len(totals))
    assert value(GRID, None, true) == pytest.approx(np.mean(totals), abs=4 * error)


def test_truthful_ratings_of_everything_leave_no_regret():
    case = grid_case(GRID, seed=0)
    assert case.regret(np.full(case.answers.shape, np.nan)) > 1.0
    seen = acquisition.visited(GRID, np.random.default_rng([0, 11]))
    true = np.asarray(GRID.truth().reward, float)[np.nonzero(seen)]
    assert case.regret(np.tile(true[:, None], case.answers.shape[1])) == pytest.approx(0.0)
    legitimate = grid_case(TrapGrid(6, legitimate=True), seed=0)
    assert legitimate.regret(np.full(legitimate.answers.shape, np.nan)) < 0.1


def test_items_are_visited_steps_with_their_observed_reward():
    case = grid_case(GRID, seed=0)
    seen = acquisition.visited(GRID, np.random.default_rng([0, 11]))
    assert len(case.known.items) == seen.sum()
    assert case.known.reward == pytest.approx(np.asarray(GRID.task().reward, float)[np.nonzero(seen)])


def test_the_panel_is_the_random_one_of_the_seed_but_who_is_asked_answers():
    case = grid_case(GRID, seed=2)
    assert not np.isnan(case.answers).any()
    assert case.answers.shape[1] == len(random_panel(2).raters) == len(answering(2).raters)
    assert [r.noise for r in answering(2).raters] == [r.noise for r in random_panel(2).raters]


def test_all_rules_end_where_everybody_has_rated_everything():
    case = grid_case(TrapGrid(4, traps=((1, 1),)), seed=4)
    assert case.answers.size < ANSWERS[-1]
    ends = {acquisition.follow(case, rule, 4)[-1] for rule in RULES.values() if rule != "near-ties"}
    assert ends == {case.regret(case.answers)}


def test_the_same_seed_gives_the_same_to_the_bit():
    one, other = (acquisition.run([0], [TRAPS]).as_data() for _ in range(2))
    assert one == other


def test_hopper_clips_and_pairs():
    pytest.importorskip("mujoco")
    made = acquisition.clips(0)
    assert (made.true <= made.observed + 1e-12).all()
    assert made.contested.any()
    assert acquisition._missed(made.true, made.true) == 0
    assert acquisition._missed(np.zeros(len(made.true)), made.true) == pytest.approx(1.0)
    result = acquisition.run([0], [PAIRS])
    assert set(result.regret) == {(PAIRS, rule) for rule in acquisition.rules(PAIRS)}
    assert "near-ties" in acquisition.rules(PAIRS)
    assert "highest-reward" not in acquisition.rules(PAIRS)


def made_up(differences, seeds=10):
    """Return data of one setting: random has a regret of 1, each rule so much more, a little different by seed."""
    rules = [{"rule": "random", "regret": np.ones((seeds, 3)).tolist()}]
    wobble = np.linspace(-0.1, 0.1, seeds)[:, None] * np.ones(3)
    rules += [{"rule": rule, "regret": (1 + more + wobble).tolist()} for rule, more in differences.items()]
    setting = {"setting": "grids", "items": [4], "raters": [2], "everything": [0.0] * seeds, "rules": rules}
    numbers = {"answers": [0, 10, 20], "budgets": [10], "target": 0.5, "round": 10, "overlap": 3}
    return {"command": "uard acquisition", "seeds": list(range(1001, 1001 + seeds)), **numbers, "settings": [setting]}


def test_verdicts_follow_from_the_numbers():
    same, worse = views.losses(made_up({"disputed": 0.0, "least-known": 0.5, "highest-reward": -0.6}))
    assert (same.kind, same.what, same.p) == ("no better", "asking by disputed: as at random", 1.0)
    assert same.where == "grids, at most 3 raters an item"
    assert (worse.kind, worse.what) == ("beaten", "asking by least-known is worse than at random")
    assert (worse.ours.mean, worse.theirs.mean) == (pytest.approx(1.5), pytest.approx(1.0))
    assert views.losses(made_up({"highest-reward": -0.6})) == []
    found = {c.rule: c for c in views.compare(made_up({"disputed": 0.0, "highest-reward": -0.6}), views.over_all)}
    assert found["highest-reward"].corrected == pytest.approx(2 * 2 / 2**10)  # Holm: twice the smaller of two
    assert found["highest-reward"].told_apart
    assert not found["disputed"].told_apart


def test_answers_needed_are_counted_from_the_last_time_regret_was_too_high():
    data = made_up({"highest-reward": -0.6})
    assert views.needed(data, np.array([[1.0, 0.4, 0.6], [1.0, 0.4, 0.5], [0.2, 0.2, 0.2]])).tolist() == [20, 10, 0]
    first, _, fixed = views.tables(data)
    assert [row[1] for row in first.rows] == ["random", "highest-reward"]
    assert first.rows[0][-1] == "0 of 10"
    assert first.rows[1][-1] == "10 of 10"
    assert fixed.columns[-2:] == ("10 answers", "all that all can say")


@pytest.mark.parametrize(
    ("name", "seeds", "overlap"),
    [("acquisition.json", 10, 7), ("acquisition-again.json", 30, 7), ("acquisition-overlap.json", 30, 3)],
)
def test_what_is_published_is_of_held_out_seeds(name, seeds, overlap):
    data = published.packaged_json(name)
    assert data["overlap"] == overlap
    assert len(set(data["seeds"])) == seeds
    assert not any(map(is_for_development, data["seeds"]))
    assert data["answers"] == list(ANSWERS)
    for setting in data["settings"]:
        assert tuple(r["rule"] for r in setting["rules"]) == acquisition.rules(setting["setting"])
        assert all(np.array(r["regret"]).shape == (seeds, len(ANSWERS)) for r in setting["rules"])


def test_the_second_run_has_seeds_of_its_own():
    first, again = (set(published.packaged_json(f"acquisition{x}.json")["seeds"]) for x in ("", "-again"))
    assert not first & again


def test_what_is_published_stands_in_the_report():
    (section,) = page._acquisition()
    files = ("acquisition-again.json", "acquisition-overlap.json")
    assert section.losses == tuple(loss for name in files for loss in views.losses(published.packaged_json(name)))
    assert {loss.against for loss in section.losses} == {"random"}
    for text in ("at most 0.25", "--seeds 10 --first-seed 1000", "--seeds 30 --first-seed 1010 --overlap 3", "<img"):
        assert text in section.html


def test_what_is_published_is_what_the_command_gives():
    data = published.packaged_json("acquisition.json")
    seed = data["seeds"][0]
    again = acquisition.run([seed], [TRAPS]).as_data()["settings"][0]
    before = next(s for s in data["settings"] if s["setting"] == TRAPS)
    for one, other in zip(again["rules"], before["rules"], strict=True):
        assert one["rule"] == other["rule"]
        assert one["regret"][0] == pytest.approx(other["regret"][0], abs=1e-4)


def test_the_command(tmp_path, capsys, monkeypatch):
    run = acquisition.run
    monkeypatch.setattr(acquisition, "run", lambda seeds, overlap: run(seeds, [TRAPS], overlap))
    options = ["--seeds", "2", "--first-seed", "0", "--overlap", "2"]
    main(["acquisition", *options, "--extract", str(tmp_path / "out.json"), "--json", "-"])
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((tmp_path / "out.json").read_text())
    assert printed["command"] == "uard acquisition --seeds 2 --first-seed 0 --overlap 2"
    main(["acquisition", "--seeds", "2", "--first-seed", "0"])
    shown = capsys.readouterr().out
    assert "mean regret" in shown
    assert "as at random" in shown


def test_the_guide_says_what_was_published():
    data = published.packaged_json("acquisition-again.json")
    guide = (Path(__file__).parents[2] / "docs" / "guides" / "acquisition.md").read_text()
    lines = [[cell.strip().strip("`") for cell in line.split("|")[1:-1]] for line in guide.splitlines()]
    shown = [row for row in lines if len(row) == 6 and row[0] in acquisition.settings()]
    needed, mean, _ = views.tables(data)
    expected = [[*b[:5], a[2]] for a, b in zip(needed.texts(), mean.texts(), strict=True)]
    fewer = published.packaged_json("acquisition-overlap.json")
    needed, mean, _ = views.tables(fewer)
    chosen = ("random", "highest-reward", "half random, half highest-reward")
    expected += [
        [*b[:5], a[2]] for a, b in zip(needed.texts(), mean.texts(), strict=True) if a[0] != PAIRS and a[1] in chosen
    ]
    assert shown == expected
    told = {
        (c.setting, c.rule) for m in (views.needed, views.over_all) for c in views.compare(fewer, m) if c.told_apart
    }
    assert told == {(TRAPS, "half random, half highest-reward")}
    found = views.compare(data, views.over_all)
    better = {(c.setting, c.rule) for c in found if c.told_apart and c.gap.mean < 0}
    rules = ("highest-reward", "half random, half highest-reward")
    expected = {(s, rule) for s in (TRAPS, GRIDS, CLIPS) for rule in rules} | {(CLIPS, "least-known")}
    assert better == expected
    assert not [c for c in found if c.told_apart and c.gap.mean > 0]
    first = published.packaged_json("acquisition.json")
    assert not [c for measure in (views.needed, views.over_all) for c in views.compare(first, measure) if c.told_apart]
