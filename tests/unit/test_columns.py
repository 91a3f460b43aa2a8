"""Tables and paragraphs as plain text."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uard._support.columns import decimals, encodable, fill, lay_out, shorten, text, width_of

WORDS = st.text("abc-_/é雨", min_size=1, max_size=12)
TEXTS = st.lists(WORDS, min_size=1, max_size=8).map(" ".join)
NUMBERS = st.floats(-1e4, 1e4).map(lambda x: f"{x:.2f} [{x - 1:.2f}, {x + 1:.2f}]")


@given(st.lists(st.tuples(TEXTS, NUMBERS, TEXTS, NUMBERS), max_size=6), st.integers(30, 120))
def test_nothing_is_lost_broken_or_too_wide(rows, width):
    lines = lay_out(("name", "first number", "what is said of it", "second number"), rows, width)
    words = [w for row in rows for cell in row for w in cell.split()]
    longest = max(map(width_of, words), default=0)
    assert all(width_of(line.text) <= max(width, longest + 4) for line in lines)
    for number, row in enumerate(rows):
        shown = " ".join(line.text for line in lines if line.row == number).split()
        assert set(" ".join(row).split()) <= {x for w in shown for x in (w, w.removesuffix(":"))}


def test_numbers_stand_below_each_other():
    made = text(
        ("who", "return"), [("a", "8.02 [7.98, 8.05]"), ("b", "-12.50 [-13.00, -12.00]"), ("c", "–")]
    ).splitlines()
    assert made[2].index("8.02") + 4 == made[3].index("-12.50") + 6
    assert made[2].index("[") == made[3].index("[")


def test_heads_are_broken_first_then_texts_and_names_stand_alone():
    head, row = ("name", "number of answers", "remark"), ("ann", "12", "says what nobody else says")
    assert len(lay_out(head, [row], 60)) == 3
    assert [line.text for line in lay_out(head, [row], 44)][:2] == [
        "       number of",
        "name     answers  remark",
    ]
    long = "a-very-long-name-of-a-study-that-nobody-can-break"
    lines = [line.text for line in lay_out(("study", "cells", "seeds"), [(long, "12", "3"), ("b", "1", "2")], 40)]
    assert long in lines
    assert lines[lines.index(long) + 1].split() == ["12", "3"]


def test_too_many_numbers_are_several_tables_with_the_names_in_each():
    columns = ("name", *(f"column {i}" for i in range(9)))
    lines = [line.text for line in lay_out(columns, [("ann", *["1000000000.5"] * 9)], 60)]
    assert max(map(len, lines)) <= 60
    assert sum(line.startswith("ann") for line in lines) == 3
    assert " ".join(lines).split().count("1000000000.5") == 9


@pytest.mark.parametrize("rows", [[], [("", "", "")], [("a", "", "?")]])
def test_little_is_a_table_too(rows):
    lines = lay_out(("name", "n", "more"), rows, 80)
    assert lines[0].text.split() == ["name", "n", "more"]
    assert len({line.row for line in lines} - {None}) == len(rows)


@given(st.lists(WORDS, max_size=30).map(" ".join), st.integers(1, 40))
def test_paragraphs_keep_their_words(said, width):
    made = fill(said, width, "  - ")
    assert made.split() == ["-", *said.split()]
    for line in made.splitlines():
        assert len(line) <= width or len(line.split()) <= 2


def test_a_percent_sign_stays_with_its_number():
    assert fill("about the first 100 % of it", 19) == "about the first\n100 % of it"


@given(st.lists(WORDS, max_size=12).map(" ".join), st.integers(2, 40))
def test_what_is_shortened_fits(said, width):
    assert width_of(shorten(said, width)) <= width


def test_precision_follows_intervals():
    assert decimals([0.12345], [0.001]) == 3
    assert decimals([1234.5], [0.1]) == 0
    assert decimals([float("nan")]) == 0
    assert decimals([1.0, 2.0]) == 0


def test_an_encoding_without_a_sign_has_another():
    assert encodable("─│… σ 雨", "ascii") == "-|~ s \\u96e8"
    assert encodable("é ±", "latin-1") == "é ±"
