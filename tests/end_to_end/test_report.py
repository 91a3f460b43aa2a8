import json
import os
import re
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from uard.lab import studies
from uard.lab.statistics import interval
from uard.lab.views import published, sections, templates
from uard.replication.ledger import VERDICTS

pytestmark = pytest.mark.slow

UARD = Path(sys.executable).parent / "uard"
CLAIMS = [*(f"F{i}" for i in range(2, 6)), *(f"I{i}" for i in range(1, 4)), *(f"J{i}" for i in range(1, 46))]
CLAIMS += ["A30", "L975", "L1945", "L1985"]  # by their lines in the paper
NOT_A_NUMBER = re.compile(r"\b(nan|inf)\b", re.IGNORECASE)


@pytest.fixture(scope="session")
def made(shared):
    """The real thing with two seeds: about two minutes. UARD_TEST_STORE names a finished store to make it from."""
    with shared("report") as folder:
        page, store = folder / "out" / "index.html", os.environ.get("UARD_TEST_STORE", folder / "store.sqlite")
        if not page.exists():
            command = [UARD, "reproduce", "--seeds", "2", "--store", store, "--report", page.parent]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            assert done.returncode == 0, done.stderr
            assert "warning" not in done.stderr, "nothing that joins the page is broken"
        return SimpleNamespace(page=page, store=store, ledger=json.loads((page.parent / "ledger.json").read_text()))


PAGES = ("index.html", "paper.html", "numbers.html", "leaderboard.html")


@pytest.fixture
def opened(made, browser):
    """Opens a page from its file; whatever goes wrong in it or leaves the machine fails the test."""
    pages, wrong = [], []

    def open_(name, **options):
        page = browser.new_page(**({"viewport": {"width": 1280, "height": 900}} | options))
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("console", lambda m: wrong.append(m.text) if m.type in ("error", "warning") else None)
        page.on("request", lambda r: None if r.url.startswith(("file:", "data:")) else wrong.append(r.url))
        page.goto(made.page.with_name(name).as_uri())
        pages.append(page)
        return page

    yield open_
    for page in pages:
        page.close()
    assert wrong == []


@pytest.fixture
def first(opened):
    return opened("index.html")


@pytest.fixture
def page(opened):
    return opened("paper.html")


def counters(page):
    return {a: page.locator(f".count[data-agent='{a}']").inner_text() for a in ("baseline", "uard-paper", "uard")}


def test_the_ledger_answers_every_claim_once(made):
    entries = made.ledger["entries"]
    assert [e["claim"] for e in entries] == CLAIMS
    assert made.ledger["seeds"] == [0, 1]
    for e in entries:
        assert e["verdict"] in VERDICTS
        assert len(e["why"]) > 10
        assert e["parts"]
        assert bool(e["count"]) == (e["verdict"] != "cannot be tested")
        assert len(e["statement"]) > 10
        assert e["source"]
        assert e["ours"]
        assert not NOT_A_NUMBER.search(e["ours"]), e
        assert (e["ours"] == "-") <= (e["verdict"] == "cannot be tested"), e
    assert len({e["verdict"] for e in entries}) == 4


@pytest.mark.parametrize("name", PAGES)
def test_the_page_needs_nothing_but_itself(made, name):
    file = made.page.with_name(name)
    text = file.read_text(encoding="utf-8")
    assert not re.search(r"https?://", text)
    assert not re.search(r"<(script|link|img|iframe)[^>]*\b(src|href)=[\"'](?!data:)", text)
    shown = re.sub(r"<script.*?</script>|data:[^\"]*", "", text, flags=re.DOTALL)
    assert not NOT_A_NUMBER.search(shown)
    assert file.stat().st_size <= 3e6


def test_beside_the_pages_stand_data_only(made):
    others = {p.name for p in made.page.parent.iterdir()} - {*PAGES, "ledger.json"}
    assert "regret-by-panel.csv" in others
    assert {Path(name).suffix for name in others} == {".csv"}


def test_the_command_line_gives_the_same_ledger(made):
    command = [UARD, "ledger", "J5", "F3", "--seeds", "2", "--store", made.store, "--json", "-"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    answer = json.loads(done.stdout)
    assert answer == made.ledger | {"entries": [e for e in made.ledger["entries"] if e["claim"] in ("F3", "J5")]}


def by_hand():
    """Regrets of the published study, read from its file without the code under test: means over seeds, by scenario."""
    (study,) = studies.find(("panels",))
    found = published.packaged()
    returns = {}
    for r in study.rows:
        value = float(found.per_seed(r, "true_return").mean())
        returns.setdefault((r["tasks"], r["scenario"]), {})[r["mitigation"]] = value
    regrets = {}
    for (tasks, _), of in returns.items():
        if of["true-reward"] - of["random walk"] >= 1:
            for name, value in of.items():
                lost = (of["true-reward"] - value) / (of["true-reward"] - of["random walk"])
                regrets.setdefault((name, tasks), []).append(lost)
    return regrets


def test_every_number_of_the_first_screen_is_a_stored_result(first):
    regrets = by_hand()
    tasks = ["random grids", "random MDPs"]
    assert first.locator("#heat thead th[scope=colgroup]").count() == len(tasks)
    counts = [int(x) for x in first.locator("#heat thead th[scope=col] small").all_inner_texts()]
    half = len(counts) // 2
    rows = first.locator("#heat tbody tr").all_inner_texts()
    assert len(rows) == len(regrets) // 2 - 2, "all but the oracle and the random walk"
    for row in rows:
        name, *values = row.split("\t")
        for i, where in ((0, tasks[0]), (half, tasks[1])):
            here = np.array(regrets[name, where])
            assert counts[i] == here.size
            assert float(values[i]) == pytest.approx(here.mean(), abs=0.0051), (name, where)
            groups = np.array([float(x) for x in values[i + 1 : i + half]])
            weights = np.array(counts[i + 1 : i + half])
            assert (groups * weights).sum() / weights.sum() == pytest.approx(here.mean(), abs=0.0051)
            assert weights.sum() == here.size
    cards = [x.replace("\xa0", " ") for x in first.locator(".three b").all_inner_texts()]

    def card(name):
        ends = {t: interval(np.array(regrets[name, t])) for t in tasks}
        parts = (
            f"{t.removeprefix('random ')} {100 * np.mean(regrets[name, t]):.0f} % "
            f"[{100 * ends[t][0]:.0f}, {100 * ends[t][1]:.0f}]"
            for t in tasks
        )
        return ", ".join(parts)

    assert cards[0] == card("uard")
    rival = re.search(r"lost with ([\w-]+)", first.locator(".three li").nth(1).inner_text())[1]
    assert cards[1] == card(rival)
    lost = np.concatenate([regrets["uard", t] for t in tasks]) > 0.25
    assert cards[2] == f"{lost.sum()} of {lost.size}"
    raw = ", ".join(f"{t.removeprefix('random ')} {100 * np.mean(regrets['raw', t]):.0f} %" for t in tasks)
    assert f"with raw {raw}" in first.locator(".three li").nth(0).inner_text().replace("\xa0", " ")


def test_the_first_screen_is_a_screen(first):
    assert first.locator("h1").count() == 1
    assert first.locator(".verdict").inner_text().endswith(".")
    for place in (".verdict", "#heat", ".three b", ".leads a"):
        box = first.locator(place).first.bounding_box()
        assert box["y"] + box["height"] <= 900, place
    assert first.locator(".leads a").all_inner_texts() == [
        "When a simple rule is enough",
        "Where it fails",
        "The paper's claims",
        "Every number",
    ]


def test_a_number_says_more_when_it_is_pointed_at_or_reached_by_keyboard(first):
    said, first_cell = first.locator("#said"), first.locator("#heat tbody td").first
    first_cell.hover()
    assert re.search(r"regret 0\.\d+ \[.*\], sd .* scenarios, 2 seeds each", said.inner_text())
    first_cell.focus()
    first.keyboard.press("ArrowDown")
    first.keyboard.press("ArrowRight")
    second = first.locator("#heat tbody tr").nth(1)
    assert said.inner_text().startswith(second.locator("th").inner_text())
    assert first.locator("#heat td[tabindex='0']").count() == 1, "one stop for Tab"


def test_where_it_fails_can_be_sorted_and_filtered(first):
    rows = first.locator("#losses-table tbody tr:visible")
    count = first.locator(".filters .count")
    every = first.locator("#losses-table tbody tr").count()
    assert (rows.count(), every > 50) == (20, True)
    first.get_by_role("button", name="Show all").click()
    assert rows.count() == every
    assert count.inner_text() == f"{every} of {every} lines"
    studies = set(first.locator("#losses [data-key=study] option").all_inner_texts()) - {"all"}
    assert {"random grids", "grids", "robots", "deep agents", "games", "best-of-n", "asking", "GRPO"} <= studies
    first.locator("#losses [data-key=study]").select_option("games")
    assert {r.get_attribute("data-study") for r in rows.all()} == {"games"}
    first.locator("#losses [data-key=study]").select_option("")
    first.get_by_role("button", name="how bad").click()
    bad = [float(x) for x in first.eval_on_selector_all("#losses-table tbody td:nth-child(5)", VALUES) if x]
    assert bad == sorted(bad, reverse=True)
    texts = first.locator("#losses-table tbody tr th").all_inner_texts()
    assert max(len(line) for text in texts for line in text.splitlines()) < 200, "at most one line an entry"


VALUES = "cells => cells.map(cell => cell.dataset.v)"


def test_what_a_reader_of_the_paper_sees_first(page):
    assert page.locator("#headline").is_visible()
    rows = page.locator("#headline tbody tr").all_inner_texts()
    assert [r.split("\t")[:2] for r in rows] == [
        ["baseline", "–"],
        ["random walk", "–"],
        *([a, p] for a in ("uard-paper", "uard-consistent", "uard-0.1", "uard") for p in ("main", "appendix")),
    ]
    assert "2 seeds per cell" in page.locator(".meta").first.inner_text()


@pytest.mark.parametrize("name", PAGES)
def test_every_link_leads_somewhere_and_every_image_is_there(made, opened, name):
    page = opened(name)
    for target in set(page.eval_on_selector_all("a", "links => links.map(a => a.getAttribute('href'))")):
        file, _, place = target.partition("#")
        text = made.page.with_name(file or name).read_text(encoding="utf-8")
        assert not place or f'id="{place}"' in text, target
    images = page.eval_on_selector_all("img", "all => all.map(i => [i.alt, i.complete, i.naturalWidth])")
    assert [i for i in images if not (i[0] and i[1] and i[2] > 0)] == []


def test_a_report_of_panels_alone_links_what_is_there_and_keeps_its_losses(browser, tmp_path):
    files = Path(published.__file__).parents[1] / "published" / "panels.json"
    command = [UARD, "reproduce", "panels", "--published", files, "--report", tmp_path]
    subprocess.run(command, check=True, capture_output=True)
    page = browser.new_page()
    page.goto((tmp_path / "index.html").as_uri())
    links = set(page.eval_on_selector_all("a", "links => links.map(a => a.getAttribute('href'))"))
    assert links >= {"#losses", "#choose", "numbers.html"}
    for target in links:
        file, _, place = target.partition("#")
        assert not place or f'id="{place}"' in (tmp_path / (file or "index.html")).read_text(encoding="utf-8"), target
    assert page.locator("#losses-table tbody tr").count() > 0
    assert json.loads(files.read_text())["command"] in page.locator("#front").inner_text()
    page.close()


@pytest.mark.parametrize("name", PAGES)
def test_no_id_is_given_twice(opened, name):
    ids = opened(name).eval_on_selector_all("[id]", "all => all.map(e => e.id)")
    assert sorted(ids) == sorted(set(ids))


@pytest.mark.parametrize("name", PAGES[:3])
def test_the_navigation_names_every_section_in_order(opened, name):
    page = opened(name)
    pages = page.eval_on_selector_all("nav .pages a", "links => links.map(a => a.getAttribute('href'))")
    assert pages == [*PAGES]
    assert page.locator("nav [aria-current=page]").get_attribute("href") == name
    places = page.eval_on_selector_all("nav .sections a", "links => links.map(a => a.getAttribute('href'))")
    assert places == page.eval_on_selector_all("main > section", "all => all.map(s => '#' + s.id)")


CONTRAST = """() => {
    const light = colour => colour.match(/[\\d.]+/g).slice(0, 3).map(v => v / 255)
        .map(v => v <= .03928 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4)
        .reduce((sum, v, i) => sum + v * [.2126, .7152, .0722][i], 0);
    const found = {};
    for (const element of document.querySelectorAll("body *")) {
        if (![...element.childNodes].some(n => n.nodeType === 3 && n.textContent.trim())) continue;
        if (element.closest("script, style, noscript, svg") || !element.getClientRects().length) continue;
        let ground = element;
        while (ground && getComputedStyle(ground).backgroundColor === "rgba(0, 0, 0, 0)") ground = ground.parentElement;
        const [a, b] = [element, ground ?? document.documentElement].map((e, i) =>
            light(getComputedStyle(e)[i ? "backgroundColor" : "color"]));
        const ratio = (Math.max(a, b) + .05) / (Math.min(a, b) + .05);
        if (ratio < 4.5) found[element.tagName + "." + element.className] = ratio;
    }
    return found;
}"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", PAGES)
def test_it_can_be_read_by_day_and_by_night_on_any_screen(opened, name, scheme):
    page = opened(name, color_scheme=scheme)
    assert page.evaluate(CONTRAST) == {}
    dark = page.evaluate("getComputedStyle(document.body).backgroundColor") != "rgb(255, 255, 255)"
    assert dark == (scheme == "dark")
    for width in (400, 1000, 1600):
        page.set_viewport_size({"width": width, "height": 800})
        assert page.evaluate("document.scrollingElement.scrollWidth") <= width, width


@pytest.mark.parametrize("name", PAGES[:3])
def test_who_uses_a_keyboard_or_a_screen_reader_is_not_left_behind(opened, name):
    page = opened(name)
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.className") == "skip"
    assert page.locator("main section:not([aria-label], [aria-labelledby])").count() == 0
    assert page.locator("table").evaluate_all("all => all.filter(t => !t.querySelector('th[scope]')).length") == 0
    boxes = (
        "all => all.filter(b => b.scrollWidth > b.clientWidth && b.tabIndex < 0).map(b => b.textContent.slice(0, 60))"
    )
    assert page.locator(".scroll").evaluate_all(boxes) == [], "what scrolls can be reached"
    heads = page.eval_on_selector_all("h1, h2, h3", "all => all.map(h => +h.tagName[1])")
    assert heads[0] == 1
    assert all(b - a <= 1 for a, b in pairwise(heads))


@pytest.mark.parametrize("name", PAGES[:3])
def test_it_can_be_printed(opened, name, tmp_path):
    page = opened(name)
    page.pdf(path=tmp_path / "page.pdf", format="A4")
    assert (tmp_path / "page.pdf").read_bytes().startswith(b"%PDF")
    page.emulate_media(media="print")
    assert not page.locator("nav").is_visible()


def test_the_canvases_draw(page):
    colours = """all => all.map(c => {
        const p = new Uint32Array(c.getContext("2d").getImageData(0, 0, c.width, c.height).data.buffer);
        return new Set(p).size;
    })"""
    assert page.locator("canvas").count() == 3
    assert min(page.eval_on_selector_all("canvas", colours)) > 3


def test_the_slider_shows_who_hovers(page):
    assert {text.split(":")[0] for text in counters(page).values()} == {"step 0"}
    page.locator("#time").fill("60")
    texts = counters(page)
    assert texts["uard-paper"].startswith("step 60: ")
    assert "reached the goal" not in texts["uard-paper"] + texts["baseline"]
    assert re.fullmatch(r"step \d\d: 0 trap visits, observed [\d.]+, true [\d.]+ · reached the goal", texts["uard"])
    visits = int(re.search(r"(\d+) trap visits", texts["baseline"])[1])
    assert visits > 10
    page.locator("#time").fill("80")
    assert counters(page)["uard-paper"].endswith("time is over")


def test_every_grid_and_seed_can_be_played(page):
    for seed in page.locator("#seed option").all_inner_texts():
        for grid in page.locator("#grid option").all_inner_texts():
            page.locator("#grid").select_option(grid)
            page.locator("#seed").select_option(seed)
            assert page.locator("#time").input_value() == "0"
            page.locator("#time").fill(page.locator("#time").get_attribute("max"))
            assert counters(page)["uard"].endswith("reached the goal")
    assert page.locator("#seed option").count() == 2
    assert page.locator("#grid option").count() == 6


def until(page, condition):
    """Wait as ``wait_for_function`` does, which the page's policy forbids: it evaluates a text in the page."""
    deadline = time.monotonic() + 30
    while not page.evaluate(condition):
        assert time.monotonic() < deadline, condition
        page.wait_for_timeout(50)


def test_play_and_pause(page):
    play, position = page.locator("#play"), lambda: int(page.locator("#time").input_value())
    play.click()
    assert (play.inner_text(), play.get_attribute("aria-pressed")) == ("Pause", "true")
    until(page, "+document.getElementById('time').value >= 2")
    play.click()
    assert (play.inner_text(), play.get_attribute("aria-pressed")) == ("Play", "false")
    stopped = position()
    page.wait_for_timeout(400)
    assert position() == stopped
    assert counters(page)["baseline"].startswith(f"step {stopped}: ")
    page.locator("#time").fill("79")
    play.click()
    until(page, "document.getElementById('play').textContent === 'Play'")
    assert position() == 80
    play.click()
    until(page, "+document.getElementById('time').value < 10")


def test_the_ledger_can_be_filtered(page, made):
    rows, verdicts = page.locator("#ledger-table tbody tr"), [e["verdict"] for e in made.ledger["entries"]]
    assert rows.count() == len(CLAIMS)
    for verdict in (*VERDICTS, ""):
        page.locator("#ledger [data-key=verdict]").select_option(verdict)
        shown = page.locator("#ledger-table tbody tr:visible td.v").all_inner_texts()
        assert shown == [v for v in verdicts if verdict in ("", v)]
    for verdict in VERDICTS:
        assert f"{verdicts.count(verdict)}: {verdict}" in page.locator("#short").inner_text()


HOSTILE = """
<script>window.hacked = "script"</script>
<img id="picture" src="x" onerror="window.hacked = 'onerror'">
<a id="link" href="javascript:window.hacked = 'link'">link</a>
<button id="button" onclick="window.hacked = 'onclick'" style="position: fixed">button</button>
<style>h2 { color: red }</style>
<script src="data:text/javascript,window.hacked='source'"></script>
<iframe srcdoc="<script>parent.hacked = 'frame'</script>"></iframe>
<svg onload="window.hacked = 'svg'"></svg>
"""


def test_what_a_text_brings_onto_the_page_does_not_run_and_our_programs_do(browser, tmp_path):
    mine = sections.Section(
        "mine", "<b>T</b>", 1, HOSTILE, css="h2 {\r\ncolor: rgb(1, 2, 3) }", js="window.ours =\r 'ä < 1'"
    )
    other = sections.Section("other", "Other", 2, "", js="window.more = window.ours + '!'")
    programs = [f"{{\n{s.js}\n}}" for s in (mine, other)]
    values = {
        "version": "1",
        "here": "x.html",
        "title": "T",
        "meta": "",
        "pages": [],
        "leads": [],
        "styles": ["", mine.css],
        "programs": programs,
    }
    text = templates.render(templates.HERE, "page.html.j2", sections=[mine, other], **values)
    (tmp_path / "page.html").write_text(text, encoding="utf-8", newline="")
    page = browser.new_page()
    page.goto((tmp_path / "page.html").as_uri())
    for place in ("#link", "#button"):
        page.locator(place).click()
    page.wait_for_timeout(200)
    assert page.evaluate("[window.hacked ?? null, window.ours, window.more]") == [None, "ä < 1", "ä < 1!"]
    assert page.evaluate("getComputedStyle(document.querySelector('h2')).color") == "rgb(1, 2, 3)"
    assert page.evaluate("getComputedStyle(document.querySelector('#button')).position") == "static"
    assert page.locator("h2").first.inner_text() == "<b>T</b>"
    page.close()
