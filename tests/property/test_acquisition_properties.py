"""Who is asked what, whatever is known: nobody twice, no more raters than the overlap, the idle first."""

import dataclasses

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from uard.collect.acquisition import RULES, Acquisition, Known


@st.composite
def situations(draw):
    """Return something that may be known."""
    n, raters = draw(st.integers(0, 12)), draw(st.integers(0, 6))
    random = np.random.default_rng(draw(st.integers(0, 10_000)))
    count = random.choice(3, (n, raters), p=[0.6, 0.3, 0.1])
    skipped = random.random((n, raters)) < 0.2
    values = np.round(random.normal(size=(n, raters)), 1)
    names = tuple(f"item {i}" for i in range(n)), tuple(f"rater {k}" for k in range(raters))
    known = Known.nothing(*names, np.where(random.random(n) < 0.3, np.nan, random.normal(size=n)))
    paired = draw(st.booleans())
    return dataclasses.replace(
        known,
        ratings=np.where((count > 0) & ~skipped, np.abs(np.sign(values)) if paired else values, np.nan),
        count=count,
        asked=(random.random((n, raters)) < 0.15) & (count < 2),
        anybody=random.choice(2, n, p=[0.9, 0.1]),
        paused=random.random(raters) < 0.2,
        pairs=np.stack([np.arange(n), np.arange(n) + 1], 1) if paired else None,
        worth=np.where(random.random(n + 1) < 0.5, np.nan, random.normal(size=n + 1)) if paired else None,
        strata=random.integers(0, 3, n) if draw(st.booleans()) else None,
    )


ACQUISITIONS = st.builds(
    Acquisition,
    rule=st.sampled_from(sorted(RULES))
    | st.dictionaries(st.sampled_from(sorted(RULES)), st.floats(0.1, 5), min_size=1),
    overlap=st.integers(1, 5),
    repeats=st.sampled_from([0.0, 0.1, 0.9]),
)


@given(situations(), ACQUISITIONS, st.integers(0, 60), st.integers(0, 1000))
@settings(max_examples=300, deadline=None)
def test_nobody_is_asked_too_much(known, acquisition, budget, seed):
    asked = acquisition.choose(known, budget, np.random.default_rng(seed))
    assert len(asked) <= budget
    row = {name: i for i, name in enumerate(known.items)}
    column = {name: k for k, name in enumerate(known.raters)}
    new = np.zeros(known.count.shape, int)
    for request in asked:
        place = row[request.item], column[request.rater]
        assert not known.paused[place[1]]
        if request.kind == "repeat":
            assert known.count[place] == 1
            assert not np.isnan(known.ratings[place])
        else:
            assert request.kind == "rating"
            assert known.count[place] == 0
            new[place] += 1
        assert not known.asked[place]
    assert len(set(asked)) == len(asked)
    heard = known.heard + new.sum(1)
    assert (heard <= np.maximum(acquisition.overlap, known.heard)).all()
    repeats = np.zeros(len(known.raters))
    for request in asked:
        repeats[column[request.rater]] += request.kind == "repeat"
    made = np.maximum(known.count - 1, 0).sum(0) + (known.asked & (known.count > 0)).sum(0)
    load = known.count.sum(0) + known.asked.sum(0) + new.sum(0) + repeats
    assert (made + repeats <= np.maximum(acquisition.repeats * load, made)).all()


@given(situations(), ACQUISITIONS, st.integers(0, 1000))
@settings(max_examples=200, deadline=None)
def test_all_that_can_be_asked_is_asked_if_there_is_time(known, acquisition, seed):
    asked = acquisition.choose(known, 1000, np.random.default_rng(seed))
    count, open_now = known.count.copy(), known.asked.copy()
    for request in asked:
        place = known.items.index(request.item), known.raters.index(request.rater)
        open_now[place] = True
    heard = ((count > 0) | open_now).sum(1) + known.anybody
    free = ~((count > 0) | open_now | known.paused)
    assert not (free.any(1) & (heard < acquisition.overlap)).any()


@given(situations(), ACQUISITIONS, st.integers(0, 1000))
@settings(max_examples=200, deadline=None)
def test_the_first_question_goes_to_whoever_answered_least_of_those_who_can_be_asked(known, acquisition, seed):
    for request in acquisition.choose(known, 1, np.random.default_rng(seed)):
        if request.kind == "repeat":
            continue
        item, rater = known.items.index(request.item), known.raters.index(request.rater)
        free = ~((known.count[item] > 0) | known.asked[item] | known.paused)
        load = known.count.sum(0) + known.asked.sum(0)
        assert load[rater] == load[free].min()


@given(situations(), ACQUISITIONS, st.integers(0, 20), st.integers(0, 1000))
@settings(max_examples=100, deadline=None)
def test_the_same_seed_chooses_the_same(known, acquisition, budget, seed):
    one, other = (acquisition.choose(known, budget, np.random.default_rng(seed)) for _ in range(2))
    assert one == other


@given(st.integers(2, 30), st.integers(0, 10_000))
@settings(max_examples=50, deadline=None)
def test_ties_are_broken_at_random_and_not_by_order(n, seed):
    known = Known.nothing(tuple(f"item {i}" for i in range(n)), ("ann", "bob"), np.ones(n))
    random = np.random.default_rng(seed)
    for rule in sorted(RULES):
        seen = {(r.item, r.rater) for _ in range(60) for r in Acquisition(rule).choose(known, 1, random)}
        assert len({item for item, _ in seen}) > 1
        assert {rater for _, rater in seen} == {"ann", "bob"}
