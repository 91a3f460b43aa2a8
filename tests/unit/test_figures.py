"""Figures: what is drawn is in their CSV, a dark page has its own colours, nothing is read from elsewhere."""

import base64
import csv
import io
import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest

from uard import InvalidValueError
from uard.lab import studies
from uard.lab.views import acquisition, best_of_n, figures, grpo, published
from uard.lab.views.figures import COLUMNS, Chart, apart, files, moving_average
from uard.lab.views.palette import BACK, DARK, LIGHT, UNREAD, contrast, look
from uard.lab.views.templates import HERE
from uard.lab.views.templates import picture as as_html


def chart():
    made = Chart(["left", "right"], "episode", ["return", "visits"])
    made.line(0, [1, 2, 3], [0.0, np.nan, 2.0], "uard", low=[0.0, np.nan, 1.0], high=[0.5, np.nan, 3.0])
    made.line(0, [1, 2, 3], [2.0, 2.0, 2.0], "raw")
    made.bars(1, [0.0, 1.0], [3.0, 4.0], "lcb", [2.5, 3.0], [3.5, 5.0], 0.3)
    made.dots(1, [5.0], [6.0], "excess", hollow=True)
    made.reference(1, 1.247, "1.247 in the paper")
    made.shade(0, [(1.5, 2.5)])
    return made


def picture():
    return chart().picture("by-hand", "By hand", "See that it rises.", "uard reproduce scale")


def svg_of(made):
    return base64.b64decode(made.image.partition(",")[2]).decode()


def test_the_csv_has_exactly_what_is_drawn():
    made = picture()
    rows = list(csv.DictReader(io.StringIO(made.csv)))
    assert tuple(rows[0]) == COLUMNS
    left, right = made.figure.axes
    for axis in (left, right):
        for line in (x for x in axis.lines if not x.get_label().startswith("_")):
            drawn = [(x, y) for x, y in line.get_xydata() if np.isfinite(y)]
            told = [(float(r["x"]), float(r["y"])) for r in rows if r["series"] == line.get_label()]
            assert drawn == told, line.get_label()
    heights = [bar.get_height() for bar in right.patches]
    assert heights == [float(r["y"]) for r in rows if r["series"] == "lcb"] == [3.0, 4.0]
    (band, *_) = (r for r in rows if r["series"] == "uard" and r["x"] == "3")
    assert (band["low"], band["high"], band["panel"], band["y axis"]) == ("1", "3", "left", "return")
    assert [r["y"] for r in rows if r["series"] == "1.247 in the paper"] == ["1.247"]
    assert [(r["low"], r["high"]) for r in rows if r["series"] == "shaded"] == [("1.5", "2.5")]
    assert files([made]) == {"figure-by-hand.csv": made.csv}


def test_every_line_is_named_at_its_end():
    assert {"uard", "raw"} <= {text.get_text() for text in picture().figure.axes[0].texts}


def test_the_names_stand_in_the_order_of_the_ends():
    made = Chart([""], "x", "y")
    for name, end in (("dqn", 100.0), ("cql", 1.0), ("ppo", 99.0), ("sac", 50.0)):
        made.line(0, [0, 1], [0.0, end], name)
    (axis,) = made.picture("order", "T", "See.", "none").figure.axes
    place = {text.get_text(): text.xy[1] for text in axis.texts}
    assert sorted(place, key=place.get) == ["cql", "sac", "ppo", "dqn"]
    assert place["sac"] == pytest.approx((50 - axis.get_ylim()[0]) / np.ptp(axis.get_ylim()))


def test_an_svg_refers_to_nothing_and_runs_nothing():
    text = svg_of(picture())
    ET.fromstring(text)
    assert text.startswith("<svg")
    assert not re.search(r"<script|<image|<foreignObject|\bon\w+=|<!DOCTYPE|@import", text)
    assert set(re.findall(r"https?://[^\"]+", text)) == {"http://www.w3.org/1999/xlink", "http://www.w3.org/2000/svg"}
    assert all(target.startswith("#") for target in re.findall(r"(?:href=\"|url\()([^\")]+)", text))
    assert "1.247 in the paper" in text, "no digit of a text is cut"


def test_every_colour_of_an_svg_has_one_for_a_dark_page():
    text = svg_of(picture())
    head, _, body = text.partition("</style>")
    used = set(re.findall(r"#[0-9a-f]{6}", body))
    assert used <= set(LIGHT.values())
    for name in LIGHT:
        assert f'[style*="stroke: {LIGHT[name]}"] {{ stroke: {DARK[name]} !important }}' in head
    for element in re.findall(r"<text[^>]*>", body):
        assert "fill: #" in element, "black on a dark page cannot be read"


def test_the_same_numbers_give_the_same_svg():
    assert picture().image == picture().image


@pytest.mark.parametrize(("page", "colours"), [("light", LIGHT), ("dark", DARK)])
def test_the_palette_can_be_seen_on_its_pages(page, colours):
    for name, colour in colours.items():
        for back in BACK[page]:
            assert name in UNREAD or contrast(colour, back) >= (4.5 if name in ("ink", "soft") else 3.0), name


def test_pages_have_the_colours_that_the_palette_was_tested_on():
    light, dark = re.findall(r"--back: (#\w+); --tint: (#\w+)", (HERE / "style.css").read_text())[:2]
    assert tuple(c if len(c) == 7 else "#" + "".join(2 * x for x in c[1:]) for c in light) == BACK["light"]
    assert dark == BACK["dark"]


def test_lines_of_one_colour_differ_in_their_dashes():
    asked = published.packaged_json("acquisition-again.json")
    pictures = [
        best_of_n.picture_of(published.packaged_json("best-of-n.json")),
        acquisition.picture_of(asked),
        grpo.picture_of(grpo.published()),
    ]
    for axis in (axis for made in pictures for axis in made.figure.axes):
        lines = [line for line in axis.lines if not line.get_label().startswith("_")]
        assert len({(line.get_color(), str(line._dash_pattern)) for line in lines}) == len(lines) > 3
    (study,) = studies.find(("panels",))
    rules = {r["mitigation"] for r in study.rows} - {"random walk", "true-reward"}
    assert len({look(name)[:2] for name in rules}) == len(rules)
    (study,) = studies.find(("budgets",))
    rules = {r["mitigation"] for r in study.rows}
    assert len({figures._budget_look(name)[:2] for name in rules}) == len(rules)


def test_labels_are_pushed_apart_in_their_order():
    assert apart([0.9, 0.1, 0.5], 0.1) == [0.9, 0.1, 0.5]
    assert apart([0.5, 0.5, 0.5], 0.1) == pytest.approx([0.4, 0.5, 0.6])
    assert apart([1.0, 0.99], 0.2) == pytest.approx([1.0, 0.8])
    places = apart([0.02 * (i % 5) for i in range(20)], 0.1)
    gaps = np.diff(sorted(places))
    assert min(gaps) == pytest.approx(0.1)
    assert min(places) == 0.0, "where there is no room for all they begin at the bottom"


def test_a_moving_average_by_hand():
    x, y = moving_average(np.array([[1.0, 1.0, 4.0, 4.0], [0.0, 2.0, 0.0, 2.0]]), width=2, every=1)
    assert x.tolist() == [2, 3, 4]
    assert y.tolist() == [[1.0, 2.5, 4.0], [1.0, 1.0, 1.0]]


def test_a_picture_on_a_page_says_what_to_see_what_it_shows_and_what_made_it():
    made = replace(picture(), note="See <this>.")
    html = str(as_html(made))
    assert "See &lt;this&gt;." in html
    assert 'href="figure-by-hand.csv"' in html
    assert "<code>uard reproduce scale</code>" in html
    assert 'alt="By hand"' in html
    assert "style=" not in html.replace(made.image, "")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"id": "By hand"}, "id = 'By hand'"),
        ({"image": "https://example.org/a.svg"}, "image = "),
        ({"note": " "}, "note = ' '"),
        ({"rows": (("a",),)}, "as many cells as columns, 8"),
    ],
)
def test_a_picture_must_be_whole(change, message):
    with pytest.raises(InvalidValueError, match=re.escape(message)):
        replace(picture(), **change)


def test_a_published_picture_is_small_and_complete():
    data = published.packaged_json("best-of-n.json")
    made = best_of_n.picture_of(data)
    assert len(svg_of(made)) < 150_000
    gold = {(row[0], row[3]) for row in made.rows}
    assert len(gold) == len(data["curves"]) + len({c["panel"] for c in data["curves"]})
    assert made.command == data["command"]


def test_a_figure_of_published_files_names_the_command_that_made_them():
    assert figures.made_by([{"command": "uard reproduce mujoco-standard --seeds 8"}], "mujoco", "else") == "else"
    assert figures.made_by([{"command": "uard reproduce games --seeds 10"}], "games", "else").endswith("10")
