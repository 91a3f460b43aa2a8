import json
import re
import sqlite3
from contextlib import closing
from dataclasses import dataclass
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from uard import InvalidValueError
from uard.agents.tabular import QLearning
from uard.cli import app as cli
from uard.envs.grids.trapgrid import TrapGrid
from uard.lab import statistics
from uard.lab.cell import Cell
from uard.lab.execution import runner
from uard.lab.execution.store import Store
from uard.lab.views import leaderboard
from uard.lab.views.leaderboard import Estimate, Line, lines, standings
from uard.method.mitigations import Raw, named
from uard.ratings.panels import PANELS, as_panel

GRID = TrapGrid(size=4, traps=((1, 2),), horizon=12)
HEADS = [
    *[
        "mitigation",
        "environment",
        "hack_rate",
        "true_return",
        "panel",
        "noise",
        "rated",
        "agent",
        "trained",
        "seeds",
        "failed",
    ]
]
FAILURES = """
create table if not exists failures (
    key text not null, seed integer not null, error text not null, traceback text not null, version text not null,
    token text not null, created real not null, primary key (key, seed)
)"""


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    """A store of small cells, one of which failed and one of which has a single seed, and its page."""
    folder = tmp_path_factory.mktemp("board")
    store = Store(folder / "s.sqlite")
    settings = [("main", 0.0), ("appendix", 0.5), ("colluding", 0.0)]
    cells = [
        Cell(where, named(name), panel=as_panel(panel), noise=noise, episodes=150)
        for where in (GRID, TrapGrid(size=4, traps=((1, 2),), horizon=12, legitimate=True), TrapGrid(6))
        for panel, noise in (settings[:2] if where is not GRID else settings)
        for name in ("raw", "uard", "uard-paper", "lcb")
    ]
    other = Cell(GRID, named("uard", risk=3.0), QLearning(heads=2), episodes=150)
    runner.run([*((c, seed) for c in cells for seed in range(3)), (other, 0)], store, workers=1)
    failed = Cell(GRID, named("lcb", k=7.0), episodes=150)
    with sqlite3.connect(store.path) as db:
        db.execute(FAILURES)
        db.execute("insert into cells values (?, ?)", (failed.key, json.dumps(failed.config())))
        for seed in (0, 1):
            db.execute("insert into failures values (?, ?, 'RuntimeError', '', '', '', 0)", (failed.key, seed))
    page = leaderboard.write(folder / "deep" / "board.html", store)
    yield SimpleNamespace(store=store, cells=cells, page=page, lines=lines(store))
    store.close()


@pytest.fixture
def opened(board, browser):
    """The page as a reader opens it from its file; whatever goes wrong in it or leaves the machine fails the test."""
    pages, wrong = [], []

    def open_(**options):
        page = browser.new_page(**options)
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("console", lambda m: wrong.append(m.text) if m.type in ("error", "warning") else None)
        page.on("request", lambda r: None if r.url.startswith(("file:", "data:")) else wrong.append(r.url))
        page.goto(board.page.as_uri())
        pages.append(page)
        return page

    yield open_
    for page in pages:
        page.close()
    assert wrong == []


@dataclass(frozen=True)
class Noted(Raw):
    note: str = ""


def test_text_of_others_is_shown_and_never_obeyed(browser, tmp_path):
    hostile = "<img src=x onerror='window.hacked=1'><script>window.hacked=1</script>"
    with closing(Store(tmp_path / "s.sqlite")) as store:
        runner.run([(Cell(GRID, Noted(note), episodes=5), 0) for note in (hostile, "plain")], store, workers=1)
        leaderboard.write(tmp_path / "page.html", store)
    page = browser.new_page()
    page.goto((tmp_path / "page.html").as_uri())
    assert any("<script>window.hacked=1</script>" in text for text in column(page, "mitigation"))
    assert page.locator("img").count() == 0
    assert page.evaluate("window.hacked ?? null") is None
    assert "default-src 'none'" in page.locator("meta[http-equiv='Content-Security-Policy']").get_attribute("content")
    page.close()


def column(page, name, table="table.lines"):
    cells = page.locator(table).first.locator(f"tbody tr:visible > :nth-child({HEADS.index(name) + 1})")
    return cells.all_inner_texts()


def test_every_cell_has_a_line_with_the_intervals_of_the_rest_of_the_report(board):
    assert len(board.lines) == len(set(board.cells)) + 2
    for cell in board.cells:
        results = board.store.get(cell, range(3)).values()
        (line,) = [x for x in board.lines if x.mitigation == _name(cell) and _where(x) == _where_of(cell)]
        for got, values in (
            (line.true, [r.metrics()["true_return"] for r in results]),
            (line.hacks, [r.metrics()["hacks"] / r.metrics()["episode_length"] for r in results]),
        ):
            want = statistics.summarise(values)
            np.testing.assert_allclose((got.mean, *got.ci95), (want.mean, *want.ci95), rtol=1e-9, atol=1e-12)


def _name(cell):
    return next(n for n in ("raw", "uard", "uard-paper", "lcb") if named(n) == cell.mitigation)


def _where(line):
    return line.environment, line.panel, line.noise


def _where_of(cell):
    env = cell.environment
    name = "TrapGrid6-Legitimate" if env.legitimate else "TrapGrid"
    name = "TrapGrid6" if env.size == 6 else f"{name}, goal [3,3], horizon 12, size 4, traps [[1,2]]"
    return (
        name,
        "–" if _name(cell) == "raw" else next(name for name, panel in PANELS.items() if panel == cell.panel),
        cell.noise,
    )


def test_intervals_of_many_samples_are_those_of_one(monkeypatch):
    values = np.random.default_rng(0).normal(size=(2100, 5))
    many = statistics.intervals(values)
    for i in (0, 999, 1000, 2099):
        np.testing.assert_allclose(many[i], statistics.summarise(values[i]).ci95, rtol=1e-9, atol=1e-12)


def test_controls_and_failures_are_told_apart(board):
    by = {
        c: [x for x in board.lines if x.control == c] for c in ("honest raters", "colluding raters", "legitimate twin")
    }
    assert {x.panel for x in by["colluding raters"]} == {"colluding"}
    assert {"Legitimate" in x.environment for x in by["legitimate twin"]} == {True}
    assert {"Legitimate" in x.environment for x in by["honest raters"]} == {False}
    (failed,) = [x for x in board.lines if x.failed]
    assert (failed.mitigation, failed.seeds, failed.failed, failed.true) == ("lcb, k 7", 0, 2, None)
    (single,) = [x for x in board.lines if x.seeds == 1]
    assert (single.mitigation, single.agent) == ("uard, risk 3", "q-learning, heads 2")


def test_lines_are_ranked_within_their_setting(board):
    for a, b in pairwise(board.lines):
        if a.setting == b.setting and a.true and b.true:
            assert a.true.mean >= b.true.mean


def line(mitigation, mean, half=0.02, hacks=0.5, panel="main", control="honest raters", seeds=3, place="grid"):
    order = (1, 0, -1) if mitigation == "b" else (-1, 0, 1)  # b's seeds do not go with those of the others

    def estimate(mean, half):
        values = {seed: mean + half * x for seed, x in enumerate(order[:seeds])}
        return Estimate(mean, None, values)

    hacks, true = estimate(hacks, 0.001), estimate(mean, half)
    return Line(place, "agent", mitigation, panel, 0.0, 1.0, "1", control, seeds, 0, hacks, true)


def test_standings_by_hand():
    these = [
        line("raw", 1.0, panel="–"),
        line("a", 2.0, hacks=0.1),
        line("b", 1.95, hacks=0.5),
        line("b", 0.5, panel="appendix"),
        line("alone", 9.0, place="elsewhere"),
        line("once", 50.0, seeds=1),
        line("a", 1.0, panel="colluding", control="colluding raters", hacks=0.2),
        line("raw", 3.0, panel="–", control="legitimate twin", place="twin"),
        line("a", 2.0, control="legitimate twin", place="twin"),
    ]
    a, b, *rest = standings(these)  # one of one is unbeaten more surely than one of two
    assert (a.mitigation, a.unbeaten, a.tamer, a.richer, a.poorer) == ("a", (1, 1), (1, 1), (1, 1), (0, 1))
    assert (a.colluding, a.cautious, a.settings) == ((1, 1), (1, 1), 1)
    assert (b.mitigation, b.unbeaten, b.tamer, b.richer, b.poorer) == ("b", (1, 2), (0, 2), (1, 2), (1, 2))
    none = {s.mitigation: (s.unbeaten, s.richer) for s in rest}
    assert none == {"alone": ((0, 0), (0, 0)), "once": ((0, 0), (0, 0)), "raw": ((0, 0), (0, 0))}


def test_sorting_by_a_column(opened):
    page = opened()
    table = page.locator("table.lines").first
    head = table.get_by_role("button", name="true return")
    for direction, sign in (("descending", -1), ("ascending", 1), ("descending", -1)):
        head.click()
        assert table.locator("th[aria-sort]").evaluate_all("all => all.map(h => h.ariaSort)") == [direction]
        texts = column(page, "true_return")
        assert texts[-1] == "–", "a cell without results comes last"
        values = [float(t.split()[0]) for t in texts[:-1]]
        assert values == sorted(values, key=lambda v: sign * v)
        assert len(set(values)) > 5
    table.get_by_role("button", name="mitigation").click()
    order = ["lcb", "lcb, k 7", "raw", "uard", "uard-paper", "uard, risk 3"]
    assert list(dict.fromkeys(column(page, "mitigation"))) == order
    table.get_by_role("button", name="mitigation").click()
    assert list(dict.fromkeys(column(page, "mitigation"))) == order[::-1]


def test_sorting_with_the_keyboard(opened):
    page = opened()
    head = page.locator("#standings").get_by_role("button", name="settings")
    head.focus()
    page.keyboard.press("Enter")
    counts = [int(t) for t in page.locator("#standings tbody td:nth-child(8)").all_inner_texts()]
    assert counts == sorted(counts, reverse=True)


def test_filters_hide_what_is_not_asked_for(opened, board):
    page = opened()
    page.get_by_label("mitigation").select_option("uard")
    assert set(column(page, "mitigation")) == {"uard"}
    page.get_by_label("panel").select_option("appendix")
    wanted = [x for x in board.lines if x.mitigation == "uard" and x.panel == "appendix"]
    assert page.locator("#shown").inner_text() == f"{len(wanted)} of {len(board.lines)} cells"
    assert page.locator("table.lines tbody tr:visible").count() == len(wanted)
    page.get_by_label("mitigation").select_option("all")
    page.get_by_label("panel").select_option("all")
    assert page.locator("table.lines tbody tr:visible").count() == len(board.lines)


def test_it_is_readable_without_javascript(opened, board):
    page = opened(java_script_enabled=False)
    assert page.locator("table.lines tbody tr:visible").count() == len(board.lines)
    assert not page.locator("#filters").is_visible()
    heads = page.locator("table.lines").first.locator("thead th").all_inner_texts()
    assert [h.replace(" ", "_") for h in heads] == HEADS
    assert page.locator("button:visible").count() == 0


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_can_be_read_by_day_and_by_night_on_any_screen(opened, scheme):
    page = opened(color_scheme=scheme, viewport={"width": 390, "height": 800})
    assert page.evaluate("document.scrollingElement.scrollWidth") <= 390
    contrast = """element => {
        const light = colour => colour.match(/[\\d.]+/g).slice(0, 3).map(v => v / 255)
            .map(v => v <= .03928 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4)
            .reduce((sum, v, i) => sum + v * [.2126, .7152, .0722][i], 0);
        let ground = element;
        while (getComputedStyle(ground).backgroundColor === "rgba(0, 0, 0, 0)") ground = ground.parentElement;
        const [a, b] = [getComputedStyle(element).color, getComputedStyle(ground).backgroundColor].map(light);
        return (Math.max(a, b) + .05) / (Math.min(a, b) + .05);
    }"""
    for place in ("h1", "p", "nav a", "tr.us td", "tr.us td small", "tbody td", "th button", "select", "summary"):
        assert page.locator(place).first.evaluate(contrast) >= 4.5, place
    dark = page.evaluate("getComputedStyle(document.body).backgroundColor") != "rgb(255, 255, 255)"
    assert dark == (scheme == "dark")


def test_the_page_needs_nothing_but_itself(board):
    text = board.page.read_text(encoding="utf-8")
    assert not re.search(r"https?://|<(link|img|iframe)|<script[^>]*src", text)
    assert not re.search(r"\b(nan|inf)\b", re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL), re.IGNORECASE)


def test_the_command_line(board, tmp_path, capsys):
    cli.main(["leaderboard", "--store", board.store.path, "--out", str(tmp_path / "b.html")])
    assert (tmp_path / "b.html").read_bytes() == board.page.read_bytes()
    for store in (str(tmp_path / "none.sqlite"), str(tmp_path)):
        with pytest.raises(SystemExit):
            cli.main(["leaderboard", "--store", store])
        assert "a file that is there" in capsys.readouterr().err
    assert not (tmp_path / "none.sqlite").exists()


def test_what_cannot_be_written_is_said(board, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InvalidValueError, match="a file that can be written"):
        leaderboard.write(tmp_path / "file" / "b.html", board.store)
    empty = Store(":memory:")
    with pytest.raises(InvalidValueError, match="one with finished cells"):
        leaderboard.write(tmp_path / "b.html", empty)
    empty.close()
