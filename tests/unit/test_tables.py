"""Numbers of a column have equal precision, which follows from their intervals; all forms of a table say the same."""

import re

import pytest

from uard import InvalidValueError
from uard.lab.statistics import Summary, summarise
from uard.lab.views.tables import Number, Table, decimal, p_value, precision
from uard.lab.views.templates import table as as_html


def known(mean, low, high):
    """A number with an interval."""
    return Number(mean, (low, high), sd=0.5, runs=10)


def column(*cells):
    return [text for (text,) in Table("By hand", ("x",), tuple((c,) for c in cells), 0).texts()]


@pytest.mark.parametrize(
    ("cells", "texts"),
    [
        # A fifth of the width .07 is .014: two decimals.
        ([known(8.0211, 7.98, 8.05), known(-3.5, -3.54, -3.47)], ["8.02 [7.98, 8.05]", "-3.50 [-3.54, -3.47]"]),
        # Of the widths .2 and 300 the narrower counts, but five digits are one too many.
        ([known(0.3, 0.2, 0.4), known(1031.4, 880.0, 1180.0)], ["0 [0, 0]", "1031 [880, 1180]"]),
        ([known(0.3, 0.2, 0.4), known(99.94, 80.0, 120.0)], ["0.30 [0.20, 0.40]", "99.94 [80.00, 120.00]"]),
        ([known(1031.4, 880.0, 1180.0), None], ["1031 [880, 1180]", "–"]),
        # An interval without a width says nothing of precision; zero has no sign.
        ([known(0.0, 0.0, 0.0), known(-0.0004, -0.002, 0.001)], ["0.000 [0.000, 0.000]", "0.000 [-0.002, 0.001]"]),
        # One run has no interval; the middle of .5, 2 and 40 gets three digits.
        ([Number(0.5, runs=1), 2.004, 40.0], ["0.50 (one run)", "2.00", "40.00"]),
        ([3, 40.0], ["3", "40"]),
        ([float("nan"), 0.25], ["–", "0.250"]),
        # Four standard errors of .4 / 2 are .8, a fifth of it .16: one decimal.
        ([Number(5.05, sd=0.4, runs=4)], ["5.0 ± 0.4"]),
        ([Number(0.5, note="3 of 8", runs=1)], ["0.500 (3 of 8, one run)"]),
        ([Number(0.26, (-0.1, 0.6), signed=True)], ["+0.3 [-0.1, +0.6]"]),
        ([1234567.0, -20000.0], ["1 234 567", "-20 000"]),
        (["as printed", 2.0], ["as printed", "2"]),
        ([None, None], ["–", "–"]),
    ],
)
def test_a_column_by_hand(cells, texts):
    assert column(*cells) == texts


def test_a_column_has_one_number_of_decimals():
    numbers = [Number(m, (m - w, m + w)) for m, w in ((0.01, 0.004), (0.9, 0.05), (7.5, 0.3), (55.0, 1.0))]
    for text in column(*numbers):
        assert {len(x.partition(".")[2]) for x in re.findall(r"[\d.]+", text)} == {2}, text


def test_precision_is_of_three_intervals_in_four():
    """Widths .004, .1, .1, .1: one in four may be finer than is shown."""
    numbers = [Number(0.5, (0.5 - w, 0.5 + w)) for w in (0.05, 0.002, 0.05, 0.05)]
    assert precision(numbers) == 3
    assert precision([*numbers, *[Number(0.5, (0.45, 0.55))] * 1]) == 2


def test_decimals_have_no_negative_zero_and_no_exponent():
    assert [decimal(x, 2) for x in (-0.001, 0.0, 1e-9, 1e9)] == ["0.00", "0.00", "0.00", "1 000 000 000.00"]
    assert decimal(-0.001, 2, signed=True) == "0.00"


def test_p_values_are_told_apart_from_nothing():
    assert [p_value(x) for x in (0.0, 0.00099, 0.001, 0.5)] == ["< 0.001", "< 0.001", "0.001", "0.500"]


def test_a_summary_is_a_number_with_its_seeds():
    s = summarise([1.0, 2.0, 3.0])
    assert Number.of_summary(s) == Number(2.0, s.ci95, 1.0, 3)
    assert Number.of_summary(s, scale=100.0).ci95 == (100 * s.ci95[0], 100 * s.ci95[1])
    assert Number.of_summary(summarise([2.0])) == Number(2.0, None, None, 1)
    brief = Summary(2.0, 0.5, (1.0, 3.0), 2.0, None, ())
    assert Number.of_summary(brief).details(1) == "sd 0.50"
    assert Number.of_summary(s, of="scenarios").details(1) == "sd 1.00, 3 scenarios"
    assert Number.of_summary(summarise([2.0])).details(1) == ""


def test_text_markdown_and_html_say_the_same():
    made = Table("T", ("who", "return"), (("a|b", summarise([8.0, 8.1])), ("<c>", None)))
    (_, shown), (_, missing) = made.texts()
    assert made.markdown().splitlines() == [
        "| who | return |", "|---|---:|", f"| a\\|b | {shown} |", f"| <c> | {missing} |",
    ]  # fmt: skip
    html = re.sub(r"<[^>]+>", "", str(as_html(made)))
    assert shown in html
    assert "&lt;c&gt;" in html


def test_what_a_reader_of_a_page_gets_beside_the_number():
    html = str(as_html(Table("T", ("who", "return"), (("uard", summarise([8.0, 8.1])), ("raw", 1.0)))))
    assert 'title="sd 0.07, 2 seeds"' in html
    assert html.count('type="checkbox"') == 1, "one stop of the tab key shows all of them"
    assert html.count('scope="col"') == html.count('scope="row"') == 2
    assert '<tr class="us"><th scope="row" class="l">uard' in html
    assert 'type="checkbox"' not in str(as_html(Table("T", ("who",), (("uard",),))))
    assert "style=" not in html, "which the policy of the page forbids"


def test_only_what_does_not_fit_is_a_box_that_keys_can_reach():
    small = Table("T", ("who", "return"), (("uard", 1.0),))
    wide = Table("T", ("who", *("a word " * 3 for _ in range(12))), (("uard", *[known(8.0211, 7.98, 8.05)] * 12),))
    tall = Table("T", ("who",), (("uard",),) * 31)
    assert (small.wide(), wide.wide()) == (False, True)
    assert [str(as_html(t)).count('tabindex="0"') for t in (small, wide, tall)] == [0, 1, 1]


def test_long_texts_break_and_numbers_do_not():
    made = Table("T", ("who", "why", "p", "n"), (("a", "because " * 9, "< 0.001", 1.0),))
    assert made.long() == (False, True, False, False)
    assert made.numeric() == (False, False, True, True)


def test_a_row_must_have_all_columns():
    with pytest.raises(InvalidValueError, match=r"rows = .*as many cells as columns, 2"):
        Table("T", ("a", "b"), (("x",),))
    with pytest.raises(InvalidValueError, match="labels"):
        Table("T", ("a", "b"), (), labels=3)
