import copy
import functools
import json
import string

import pytest

from uard.lab import statistics
from uard.lab.statistics import Summary
from uard.lab.studies import every
from uard.lab.views import published
from uard.replication import command, ledger
from uard.replication.ledger import words
from uard.replication.ledger.entries import CONDITIONS, entry
from uard.replication.paper import Stat
from uard.replication.verdicts import FAILS, HOLDS, IN_PART, UNTESTABLE, Opinion, Part, each, judged, rule

from . import ledger_numbers

STORED = json.loads(ledger_numbers.FILE.read_text(encoding="utf-8"))
NUMBERS = {claim: ledger_numbers.decode(stored["numbers"]) for claim, stored in STORED.items()}
CLAIMS = [*(f"F{i}" for i in range(2, 6)), *(f"I{i}" for i in range(1, 4)), *(f"J{i}" for i in range(1, 46))]
CLAIMS += ["A30", "L975", "L1945", "L1985"]  # that have no number of their own in the inventory's list of claims
PUBLISHED = [claim for claim, said in words.read().items() if said.missing]
TESTED = [(claim, part.name) for claim in CLAIMS for part in CONDITIONS[claim].parts if isinstance(part, Part)]


# --- the rule ---


@pytest.mark.parametrize(
    ("holds", "verdict"),
    [
        ([True], HOLDS),
        ([True, True], HOLDS),
        ([True, False], IN_PART),
        ([False, False], FAILS),
        ([True, None], IN_PART),
        ([False, None], FAILS),
        ([None, None], UNTESTABLE),
        ([], UNTESTABLE),
    ],
)
def test_the_verdict_follows_from_the_parts(holds, verdict):
    assert rule(holds) == verdict


def test_parts_are_counted_and_opinions_marked():
    parts = (
        *each("{} is small", ("a", "b"), lambda n, s: n[s] < 1),
        Part("ratio above 2", lambda n: n["b"] / n["a"] > 2 if n["a"] > 0 else None),
        Opinion("the text says so", True),
    )
    found = judged(parts, {"a": 0.0, "b": 3.0})
    assert [(p.name, p.holds, p.opinion) for p in found.parts] == [
        ("a is small", True, False),
        ("b is small", False, False),
        ("ratio above 2", None, False),
        ("the text says so", True, True),
    ]
    assert (found.verdict, found.count) == (IN_PART, "2 of 3")
    without = judged(parts, None)
    assert [p.holds for p in without.parts] == [None, None, None, True]
    assert without.count == "1 of 1"
    assert judged(parts[:1], None).count == ""


# --- words ---


def test_every_claim_has_words_conditions_and_stored_numbers():
    assert list(ledger.CLAIMS) == CLAIMS
    assert set(CONDITIONS) == set(CLAIMS) == set(STORED)
    for said in words.read().values():
        assert said.line > 0
        assert len(said.statement) > 10


class Reading(dict):
    """A dictionary that remembers what was looked up."""

    def __init__(self, items):
        super().__init__(items)
        self.read = set()

    def __getitem__(self, name):
        self.read.add(name)
        return super().__getitem__(name)


@pytest.mark.parametrize("claim", CLAIMS)
def test_words_and_conditions_name_all_numbers_and_no_others(claim):
    said, numbers = words.read()[claim], Reading(NUMBERS[claim])
    fields = [f for text in (said.ours, said.why) for _, f, _, _ in string.Formatter().parse(text) if f]
    named = {f.split("[")[0] for f in fields} - {"count"}
    assert named <= numbers.keys()
    judged(CONDITIONS[claim].parts, numbers)
    assert named | numbers.read == numbers.keys(), "a number that nobody needs"


@pytest.mark.parametrize("claim", CLAIMS)
def test_templates_are_filled(claim):
    made = entry(claim, NUMBERS[claim])
    assert len(made.why) > 10
    for text in (made.ours, made.why):
        assert "{" not in text
        assert "Summary(" not in text


def test_formats():
    s = statistics.summarise([1.0, 1.0, 1.0])
    fill = words.Template().format
    assert (
        fill("{:full} | {:ci} | {:brief}", s, s, Stat(57.8, 8.4))
        == "1.00 ± 0 [1.00, 1.00] | 1.00 [1.00, 1.00] | 57.8 ± 8.40"
    )
    assert fill("{:percent}, {:p}, {:p}", 0.9361, 0.0123, 1e-7) == "93.6 %, p = 0.012, p < 1e-6"
    assert fill("{x[6x6 main]}, {x:.0f}", x={"6x6 main": 0.5, "8x8": None}) == "0.500, 6x6 main: 0; 8x8: none"
    assert fill("{} {} {:+.2f}", 1234.5, True, -0.021) == "1234 yes -0.02"


# --- verdicts ---


@pytest.mark.parametrize("claim", CLAIMS)
def test_the_stored_verdict_follows_from_the_stored_numbers(claim):
    found = judged(CONDITIONS[claim].parts, NUMBERS[claim])
    assert (found.verdict, found.count) == (STORED[claim]["verdict"], STORED[claim]["count"])


@pytest.mark.parametrize(
    ("claim", "verdict", "count"),
    [
        ("I3", HOLDS, "10 of 10"),  # nine baselines and the tabular one, each on its own
        ("J6", HOLDS, "2 of 2"),  # live weights, too, lead to one fixed point
        ("J16", IN_PART, "5 of 6"),
        ("J22", IN_PART, "1 of 4"),  # on the grid, not on Hopper
        ("J23", FAILS, "0 of 3"),  # the ratio on the grid is to a negative number
        ("J25", IN_PART, "4 of 9"),
        ("J38", IN_PART, "2 of 7"),
        ("J39", IN_PART, "11 of 16"),  # the lowest rating is static and enough
        ("J45", IN_PART, "2 of 4"),  # above 40, with and without noise
    ],
)
def test_verdicts_that_were_once_wrong(claim, verdict, count):
    made = entry(claim, NUMBERS[claim])
    assert (made.verdict, made.count) == (verdict, count)


GENERIC = (-1e6, -1.0, 0.0, 0.5, 1.0, 2.0, 100.0, 1e6)


@functools.cache
def constant(x):
    return statistics.summarise([x, x])


@functools.cache
def scattered():
    return statistics.summarise([-1e6, 1e6])


def leaves(numbers, path=()):
    for name, value in numbers.items():
        if isinstance(value, dict):
            yield from leaves(value, (*path, name))
        else:
            yield (*path, name), value


def scalars(value):
    if isinstance(value, Summary | Stat):
        return (value.mean,)
    return () if value is None or isinstance(value, bool | str) else (value,)


def with_other(numbers, path, value):
    changed = copy.copy(numbers)
    inner = changed
    for name in path[:-1]:
        inner[name] = copy.copy(inner[name])
        inner = inner[name]
    inner[path[-1]] = value
    return changed


def others(value, pool):
    """Return what a number might have been instead: those of the same claim, and some far off."""
    if isinstance(value, bool):
        return (not value,)
    if isinstance(value, str):
        return ()
    if isinstance(value, Summary):
        return (*map(constant, pool), scattered())
    return tuple(Stat(x, value.sd) for x in pool) if isinstance(value, Stat) else pool


@pytest.mark.parametrize(("claim", "name"), TESTED, ids=[f"{c}, part {i}" for i, (c, _) in enumerate(TESTED)])
def test_every_part_can_be_broken_and_the_verdict_moves(claim, name):
    parts, numbers = CONDITIONS[claim].parts, NUMBERS[claim]
    (part,) = (p for p in parts if p.name == name)
    before, now = judged(parts, numbers), part.holds(numbers)
    pool = tuple(dict.fromkeys(GENERIC + tuple(x for _, value in leaves(numbers) for x in scalars(value))))
    for path, value in leaves(numbers):
        for other in others(value, pool):
            changed = with_other(numbers, path, other)
            if part.holds(changed) != now:
                after = judged(parts, changed)
                if (after.verdict, after.count) != (before.verdict, before.count):
                    return
    pytest.fail("no number changes what this part says: it is a constant")


# --- what is not there, and how it is shown ---


@pytest.mark.parametrize("claim", PUBLISHED)
def test_without_published_results_a_claim_cannot_be_tested(claim, monkeypatch):
    nothing = published.Published(every(), [])
    monkeypatch.setattr(published, "packaged", lambda: nothing)
    monkeypatch.setattr(published, "packaged_json", lambda name: None)
    numbers = CONDITIONS[claim].numbers(None)
    made = entry(claim, numbers)
    assert numbers is None
    assert (made.verdict, made.count, made.ours, made.why) == (UNTESTABLE, "", "-", words.read()[claim].missing)


def test_the_terminal_and_the_data_show_parts_counts_and_opinions(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    made = [entry(claim, NUMBERS[claim]) for claim in ("J12", "J35")]
    command.show(made)
    out = capsys.readouterr().out
    shown = " ".join(out.split())
    assert max(map(len, out.splitlines())) <= 80
    assert all(e.statement in shown and e.why in shown for e in made), "nothing is cut"
    assert "1 of 3" in shown
    assert "(opinion)" in shown
    data = json.loads(json.dumps(ledger.as_data(made, range(2)), allow_nan=False))
    first, second = data["entries"]
    assert (data["seeds"], first["count"], second["count"]) == ([0, 1], "1 of 3", "")
    assert [(p["holds"], p["opinion"]) for p in first["parts"]] == [(True, False), (False, True), (False, True)]
    assert second["parts"] == [{"name": CONDITIONS["J35"].parts[0].name, "holds": None, "opinion": True}]
