"""Who is asked what: rules by hand, the choice of items and raters, and topping a rater up from a store."""

import dataclasses
import threading
import time
from collections import Counter

import numpy as np
import pytest

from uard import InvalidValueError
from uard.collect import Project, Question, Request, pair_item, text_item
from uard.collect.acquisition import RULES, Acquisition, Known
from uard.collect.asking import top_up
from uard.collect.project import Known as Expected
from uard.collect.sqlite import SQLiteStore
from uard.collect.store import LEASE_SECONDS
from uard.ratings import bradley_terry
from uard.ratings.table import Answer

NAN = np.nan


def known_of(ratings, reward=None, **more):
    """Return what is known where each rating was given once."""
    ratings = np.array(ratings, float)
    n, raters = ratings.shape
    names = tuple(f"item {i}" for i in range(n)), tuple(f"rater {k}" for k in range(raters))
    first = Known.nothing(*names, None if reward is None else np.array(reward, float))
    return dataclasses.replace(first, ratings=ratings, count=(~np.isnan(ratings)).astype(int), **more)


def items_of(acquisition, known, budget, seed=0):
    return [r.item for r in acquisition.choose(known, budget, np.random.default_rng(seed))]


def test_most_disputed_first_by_hand():
    known = known_of([[0.0, 1.0, NAN], [0.0, 4.0, NAN], [2.0, 2.0, NAN]])
    assert RULES["disputed"](known) == pytest.approx([np.sqrt(0.5), np.sqrt(8.0), 0.0])
    asked = Acquisition("disputed").choose(known, 3, np.random.default_rng(0))
    assert [(r.item, r.rater) for r in asked] == [(f"item {i}", "rater 2") for i in (1, 0, 2)]


def test_what_a_rule_knows_nothing_of_stands_at_a_random_place():
    known = known_of([[0.0, 4.0, NAN], [0.0, 1.0, NAN], [NAN, NAN, NAN]])
    first = [items_of(Acquisition("disputed"), known, 1, seed)[0] for seed in range(200)]
    assert set(first) == {"item 0", "item 2"}  # the unknown one is as high as the first, or as the second
    assert 20 < first.count("item 2") < 90  # and then comes first in half of the cases: one in four


def test_fewest_answers_first_then_the_stratum_with_the_fewest():
    asked = np.zeros((4, 2), bool)
    asked[3, 0] = True
    known = known_of([[1.0, NAN], [NAN, NAN], [NAN, NAN], [NAN, NAN]], strata=np.array([0, 0, 1, 1]), asked=asked)
    score = RULES["least-known"](known)
    assert score[1] == score[2] > max(score[0], score[3])
    known = dataclasses.replace(known, asked=np.zeros((4, 2), bool))
    score = RULES["least-known"](known)
    assert score[2] == score[3] > score[1] > score[0]


def test_highest_reward_is_random_where_no_reward_is_known():
    rewarded = known_of(np.full((3, 1), NAN), [0.0, 9.0, 4.0])
    assert items_of(Acquisition("highest-reward"), rewarded, 3) == ["item 1", "item 2", "item 0"]
    unknown = known_of(np.full((3, 1), NAN))
    first = {items_of(Acquisition("highest-reward"), unknown, 1, seed)[0] for seed in range(50)}
    assert len(first) == 3


def test_near_ties_by_ratings_and_by_comparisons():
    pairs = np.array([[0, 1], [0, 2], [1, 2]])
    unjudged = known_of(np.full((3, 1), NAN), pairs=pairs, worth=np.array([0.0, 1.0, 1.25]))
    assert RULES["near-ties"](unjudged) == pytest.approx([-1.0, -1.25, -0.25])
    # The first beats the second again and again and ties with the third: then they are judged by that alone.
    judged = known_of([[1.0, 1.0, 1.0], [0.5, 0.5, 0.5], [NAN, NAN, NAN]], pairs=pairs, worth=np.full(3, NAN))
    score = RULES["near-ties"](judged)
    assert score[1] > max(score[0], score[2])
    nothing_yet = known_of(np.full((3, 1), NAN), pairs=pairs, worth=np.full(3, NAN))
    assert np.isnan(RULES["near-ties"](nothing_yet)).all()
    assert np.isnan(RULES["near-ties"](known_of([[1.0]]))).all()


def test_bradley_terry_by_hand():
    # Two things, one of which won 3 of 4, and half a win each against one of strength 1: the likelihood's maximum.
    found = bradley_terry.worth(np.array([0]), np.array([1]), np.array([3.0]), np.array([4.0]), 2)
    p = np.exp(found)
    won, against = np.array([3.5, 1.5]), 4 / p.sum() + 1 / (p + 1)
    assert p == pytest.approx(won / against, rel=1e-3)
    strong, weak = bradley_terry.worth(np.array([0]), np.array([1]), np.array([40.0]), np.array([40.0]), 2)
    assert np.isfinite([strong, weak]).all()
    assert strong > 1 > -1 > weak


def test_raters_with_the_fewest_answers_come_first_and_the_paused_never():
    ratings = np.full((6, 3), NAN)
    ratings[:3, 0] = ratings[0, 1] = 1.0
    known = known_of(ratings, paused=np.array([False, False, True]))
    asked = Acquisition(overlap=2).choose(known, 4, np.random.default_rng(0))
    assert [r.rater for r in asked][:2] == ["rater 1", "rater 1"]
    assert "rater 2" not in {r.rater for r in asked}


def test_overlap_counts_those_who_were_heard_those_who_are_asked_and_whoever_comes():
    asked = np.zeros((3, 3), bool)
    asked[1, 1] = True
    known = known_of([[1.0, NAN, NAN], [1.0, NAN, NAN], [NAN, NAN, NAN]], asked=asked, anybody=np.array([0, 0, 1]))
    assert sorted(items_of(Acquisition(overlap=2), known, 99)) == ["item 0", "item 2"]
    assert items_of(Acquisition(overlap=1), known, 99) == []


def test_a_mixture_draws_its_rules_by_weight():
    reward = np.arange(400.0)
    known = known_of(np.full((400, 1), NAN), reward)
    top = [
        items_of(Acquisition({"random": 1, "highest-reward": 3}), known, 1, seed)[0] == "item 399"
        for seed in range(400)
    ]
    assert 260 < sum(top) < 340
    assert items_of(Acquisition({"random": 0, "highest-reward": 2}), known, 1) == ["item 399"]


def test_repeats_are_of_what_the_rater_answered_and_no_more_than_their_share():
    known = known_of(np.zeros((200, 1)))
    asked = Acquisition(repeats=0.1, overlap=1).choose(known, 50, np.random.default_rng(0))
    assert asked == ()  # nothing but repeats could be asked, and that goes on for ever
    known = known_of(np.concatenate([np.zeros((100, 1)), np.full((900, 1), NAN)]))
    asked = Acquisition(repeats=0.1).choose(known, 900, np.random.default_rng(0))
    repeated = [r for r in asked if r.kind == "repeat"]
    assert 80 <= len(repeated) <= 100
    assert {int(r.item.split()[1]) for r in repeated} <= set(range(100))
    assert len({r.item for r in repeated}) == len(repeated)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rule": "dispute"}, "rule = 'dispute': must be one of .* \\(did you mean 'disputed'\\?\\)"),
        ({"rule": {"random": -1.0}}, "rule\\[random\\] = -1.0: must be a finite number in \\[0, "),
        ({"rule": {"random": 0.0}}, "not all of them 0"),
        ({"rule": {}}, "not all of them 0"),
        ({"rule": 3}, "rule = 3: must be a rule's name, or names with weights"),
        ({"overlap": 0}, "overlap = 0: must be a whole number >= 1"),
        ({"repeats": 0.95}, "repeats = 0.95: must be a finite number in \\[0, 0.9\\]"),
    ],
)
def test_bad_settings(arguments, message):
    with pytest.raises(InvalidValueError, match=message):
        Acquisition(**arguments)


def test_bad_shapes_and_budgets():
    with pytest.raises(InvalidValueError, match=r"reward.shape = \(2,\): must be \(1,\)"):
        dataclasses.replace(known_of([[1.0]]), reward=np.zeros(2))
    with pytest.raises(InvalidValueError, match="worth = None: must be given where items are pairs"):
        dataclasses.replace(known_of([[1.0]]), pairs=np.array([[0, 1]]))
    with pytest.raises(InvalidValueError, match="budget = -1"):
        Acquisition().choose(known_of([[1.0]]), -1, np.random.default_rng(0))
    assert Acquisition().choose(known_of(np.zeros((0, 0))), 3, np.random.default_rng(0)) == ()


# From a store


def project_of(folder, texts, raters, **question):
    project = Project.create(folder, Question(**question))
    with project.store() as store:
        store.add_items(texts)
        for rater in raters:
            store.invite(rater)
    return project


def texts(number, **more):
    return [text_item("2 + 2?", f"{i}", **more) for i in range(number)]


def answered(store, rater, count=1, value=1.0):
    """Answer what the rater is shown next; return what it was."""
    leases = store.lease(rater, count)
    for lease in leases:
        name = f"{rater} {lease.id}"
        store.put([Answer(name, lease.item.id, rater, value, kind=lease.kind)], lease.id)
    return leases


def test_topping_up_reaches_the_overlap_and_ends(tmp_path):
    raters = ["ann", "bob", "eve"]
    project = project_of(tmp_path, texts(20), raters, overlap=2, repeats=0.0)
    with project.store() as store:
        while sum(top_up(project, store, rater, 3) for rater in raters):
            for rater in raters:
                answered(store, rater, 3)
        said, _ = store.answers()
        assert len(said) == 40
        assert len({(a.item, a.rater) for a in said}) == 40
        by_rater = [sum(a.rater == rater for a in said) for rater in raters]
        assert max(by_rater) <= 20


def test_a_paused_rater_is_asked_nothing_and_her_questions_go_to_others(tmp_path):
    project = project_of(tmp_path, texts(4), ["ann", "bob"], overlap=1)
    with project.store() as store:
        assert top_up(project, store, "ann", 4) == 4
        assert top_up(project, store, "bob", 4) == 0
        store.pause("ann", True)
        assert top_up(project, store, "ann", 4) == 0
        assert top_up(project, store, "bob", 4) == 4


def test_nobody_is_asked_what_was_passed_on_when_a_pause_ends(tmp_path):
    project = project_of(tmp_path, texts(6), ["ann", "bob"], overlap=1, repeats=0.0)
    with project.store() as store:
        assert top_up(project, store, "ann", 4) == 4
        held = store.lease("ann", 4)
        store.pause("ann", True)
        assert [top_up(project, store, "bob", 9) for _ in range(3)] == [2, 4, 0]
        answered(store, "bob", 6)
        store.pause("ann", False)
        assert store.lease("ann", 9) == ()
        assert top_up(project, store, "ann", 9) == 0
        assert store.open_requests()[0] == ()
        store.put([Answer("late", held[0].item.id, "ann", 0.5)], held[0].id)  # her page still showed it


def test_what_a_rater_left_behind_goes_to_others_once_her_lease_has_ended(tmp_path):
    project = project_of(tmp_path, texts(6), ["ann", "bob", "eve"], overlap=2, repeats=0.0)
    now = [1e9]
    with (
        SQLiteStore(project.folder / "answers.sqlite", clock=lambda: now[0]) as store,
        SQLiteStore(project.folder / "answers.sqlite", clock=lambda: now[0]) as other,
    ):
        assert top_up(project, store, "ann", 6) == 6
        left = {lease.item.id for lease in store.lease("ann", 4)}  # two of the six she was never shown
        assert top_up(project, store, "bob", 9) == 6
        answered(store, "bob", 6)
        assert top_up(project, other, "eve", 9) == 0
        now[0] += LEASE_SECONDS + 1
        assert top_up(project, store, "bob", 9) == 0  # who has rated them all
        back = store.lease("ann", 2)  # she is there again, and holds two
        gone = top_up(project, store, "eve", 3), top_up(project, other, "eve", 9)
        assert gone == (3, 1)
        assert {lease.item.id for lease in back} < left
        answered(store, "ann", 9)
        answered(other, "eve", 9)
        said, _ = store.answers()
        assert Counter(a.item for a in said) == Counter({item.id: 2 for item in texts(6)})
        assert (store.open_requests()[0], len(said)) == ((), 12)


def test_practice_once_and_first_gold_now_and_then_and_neither_among_the_rest(tmp_path):
    pool = texts(300)
    names = [item.id for item in pool]
    practice = tuple(Expected(name, 1.0) for name in names[:2])
    gold = tuple(Expected(name, 1.0) for name in names[2:12])
    project = project_of(
        tmp_path, pool, ["ann"], practice=practice, gold=gold, examples=(Expected(names[12], 0.0),), repeats=0.0
    )
    with project.store() as store:
        kinds = []
        while made := top_up(project, store, "ann", 1, random=np.random.default_rng(len(kinds))):
            kinds += [lease.kind for lease in answered(store, "ann", made)]
        assert kinds[:2] == ["practice", "practice"]
        assert kinds.count("practice") == 2
        assert 4 <= kinds.count("gold") <= 10
        said, _ = store.answers()
        assert len({a.item for a in said}) == len(said)  # nothing twice
        assert names[12] not in {a.item for a in said}
        assert {a.item for a in said if a.kind == "rating"} == set(names[13:])


def test_an_answer_that_is_taken_back_by_the_owner_is_asked_of_somebody_else(tmp_path):
    project = project_of(tmp_path, texts(1), ["ann", "bob"], overlap=1)
    with project.store() as store:
        assert top_up(project, store, "ann", 1) == 1
        (lease,) = answered(store, "ann")
        assert top_up(project, store, "bob", 1) == 0
        store.put([Answer("gone", lease.item.id, "ann", supersedes=f"ann {lease.id}", source="owner")])
        assert top_up(project, store, "bob", 1) == 1


def test_items_without_their_files_are_left_out(tmp_path):
    pool = texts(3)
    project = project_of(tmp_path, pool, ["ann"])
    with project.store() as store:
        assert top_up(project, store, "ann", 9, without={pool[0].id}) == 2
        assert pool[0].id not in {r.item for r in store.open_requests()[0]}


def test_the_most_disputed_text_is_asked_next(tmp_path):
    pool = texts(5)
    project = project_of(tmp_path, pool, ["ann", "bob", "eve"], acquisition="disputed", repeats=0.0)
    with project.store() as store:
        for i, item in enumerate(pool):
            store.put([Answer(f"a{i}", item.id, "ann", 0.0)])
            store.put([Answer(f"b{i}", item.id, "bob", float(i == 3))])
        assert top_up(project, store, "eve", 1) == 1
        (request,) = store.open_requests()[0]
        assert request.item == pool[3].id


def test_pairs_are_made_when_they_are_asked_for_within_one_prompt(tmp_path):
    pool = [*texts(4), *(text_item("3 + 3?", f"{i}") for i in range(3)), text_item("alone?", "yes")]
    project = project_of(tmp_path, pool, ["ann", "bob"], kind="pairs", acquisition="near-ties", repeats=0.0)
    with project.store() as store:
        asked = 0
        while made := top_up(project, store, "ann", 2):
            asked += made
        assert asked == 6 + 3  # all that there are
        pairs = [item for item in store.items()[0] if item.kind == "pair"]
        assert len(pairs) == 9
        contents = {item.id: item.content for item in pool}
        prompts = [{contents[x.content[side]]["prompt"] for side in ("left", "right")} for x in pairs]
        assert all(len(both) == 1 for both in prompts)
        lease = store.lease("ann")[0]
        left, right = lease.item.content["left"], lease.item.content["right"]
        store.put([Answer("a", lease.item.id, "ann", choice="left", left=right, right=left)], lease.id)
        assert top_up(project, store, "bob", 99) == 9


def test_a_pair_is_preferred_by_its_content_and_not_by_its_side(tmp_path):
    from uard.collect.asking import _seen

    pool = texts(2)
    pair = pair_item(pool[0].id, pool[1].id)
    left, right = pair.content["left"], pair.content["right"]
    project = project_of(tmp_path, [*pool, pair], ["ann", "bob", "eve"], kind="pairs")
    with project.store() as store:
        store.put([Answer("a", pair.id, "ann", choice="left", left=left, right=right)])
        store.put([Answer("b", pair.id, "bob", choice="right", left=right, right=left)])
        store.put([Answer("c", pair.id, "eve", choice="cannot tell", left=right, right=left)])
        top_up(project, store, "ann", 0)
        seen = _seen(store)
        assert seen.ratings[seen.row[pair.id]].tolist() == pytest.approx([1.0, 1.0, NAN], nan_ok=True)
        assert seen.count[seen.row[pair.id]].tolist() == [1, 1, 1]


def test_two_servers_on_one_store_do_not_ask_one_rater_too_many(tmp_path):
    raters = [f"rater {k}" for k in range(8)]
    project = project_of(tmp_path, texts(40), raters, overlap=2)
    stores = [project.store() for _ in range(4)]
    errors = []

    def ask(store, mine):
        try:
            for _ in range(30):
                for rater in mine:
                    top_up(project, store, rater, 2)
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=ask, args=(s, raters[2 * i : 2 * i + 2])) for i, s in enumerate(stores)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors
    opened, _ = stores[0].open_requests()
    assert len({(r.item, r.rater) for r in opened}) == len(opened)
    by_item = [sum(r.item == item.id for r in opened) for item in texts(40)]
    assert by_item == [2] * 40
    for store in stores:
        store.close()


def test_what_was_asked_in_between_is_noticed(tmp_path):
    (item,) = texts(1)
    with SQLiteStore(tmp_path / "answers.sqlite") as store:
        store.add_items([item])
        store.invite("ann")
        opened, place = store.open_requests()
        assert (opened, place) == ((), 0)
        assert store.ask([Request(item.id)], place) == 1
        assert store.ask([Request(item.id, "ann")], place) == 0
        opened, place = store.open_requests()
        assert opened == (Request(item.id),)
        assert store.ask([Request(item.id, "ann")], place) == 1


def test_an_unknown_rater_and_rule(tmp_path):
    project = project_of(tmp_path, texts(1), ["ann"])
    with project.store() as store, pytest.raises(InvalidValueError, match=r"rater = 'anna'.*did you mean 'ann'"):
        top_up(project, store, "anna", 1)
    with pytest.raises(InvalidValueError, match="acquisition = 'any': must be one of"):
        dataclasses.replace(project.question, acquisition="any")


@pytest.mark.slow
def test_topping_up_is_quick(tmp_path):
    raters = [f"rater {k}" for k in range(50)]
    project = project_of(tmp_path, texts(2000, reward=1.0), raters, overlap=3, acquisition={"random": 1, "disputed": 1})
    with project.store() as store:
        for rater in raters:
            top_up(project, store, rater, 40)
            answered(store, rater, 40)
        took = []
        for rater in raters:
            begin = time.perf_counter()
            top_up(project, store, rater, 2)
            took.append(time.perf_counter() - begin)
        assert np.median(took) < 0.1  # 5 to 20 ms where nothing else runs
