import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from uard.lab.views import sections, templates
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


@pytest.fixture
def page(made, browser):
    """The report, opened from its file; whatever goes wrong in it or leaves the machine fails the test."""
    opened, wrong = browser.new_page(viewport={"width": 1280, "height": 900}), []
    opened.on("pageerror", lambda error: wrong.append(str(error)))
    opened.on("console", lambda message: wrong.append(message.text) if message.type in ("error", "warning") else None)
    opened.on("request", lambda r: None if r.url.startswith(("file:", "data:")) else wrong.append(r.url))
    opened.goto(made.page.as_uri())
    yield opened
    opened.close()
    assert wrong == []


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


def test_the_page_needs_nothing_but_itself(made):
    text = made.page.read_text(encoding="utf-8")
    assert not re.search(r"https?://", text)
    assert not re.search(r"<(script|link|img|iframe)[^>]*\b(src|href)=[\"'](?!data:)", text)
    assert sorted(p.name for p in made.page.parent.iterdir()) == ["index.html", "leaderboard.html", "ledger.json"]
    shown = re.sub(r"<script.*?</script>|data:[^\"]*", "", text, flags=re.DOTALL)
    assert not NOT_A_NUMBER.search(shown)
    assert len(text) < 10e6


def test_the_command_line_gives_the_same_ledger(made):
    command = [UARD, "ledger", "J5", "F3", "--seeds", "2", "--store", made.store, "--json", "-"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    answer = json.loads(done.stdout)
    assert answer == made.ledger | {"entries": [e for e in made.ledger["entries"] if e["claim"] in ("F3", "J5")]}


def test_what_a_reader_sees_first(page):
    assert "Uncertainty-Aware Reward Discounting" in page.title()
    assert page.locator("#headline").is_visible()
    rows = page.locator("#headline tbody tr").all_inner_texts()
    assert [r.split("\t")[0] for r in rows] == [
        "baseline",
        "random walk",
        *(
            f"{a}, {p} panel"
            for a in ("uard-paper", "uard-consistent", "uard-0.1", "uard")
            for p in ("main", "appendix")
        ),
    ]
    assert "2 seeds per cell" in page.locator(".meta").first.inner_text()


def test_every_link_leads_somewhere_and_every_image_is_there(page):
    targets = page.eval_on_selector_all("a", "links => links.map(a => a.getAttribute('href'))")
    assert len(targets) > 5
    places = {t for t in targets if t.startswith("#")}
    assert [t for t in places if page.locator(t).count() != 1] == []
    assert set(targets) - places == {"leaderboard.html"}
    images = page.eval_on_selector_all("img", "all => all.map(i => [i.alt, i.complete, i.naturalWidth])")
    assert len(images) >= 12, "the deep figures come with their published results"
    assert [i for i in images if not (i[0] and i[1] and i[2] > 0)] == []


def test_the_navigation_names_every_section_in_order(page):
    places = page.eval_on_selector_all("nav a", "links => links.map(a => a.getAttribute('href'))")
    sections = page.eval_on_selector_all("h2", "heads => heads.map(h => '#' + h.id)")
    assert [p for p in places if p.startswith("#")] == sections
    assert [p for p in places if not p.startswith("#")] == ["leaderboard.html"]
    assert sections.index("#short") < sections.index("#losses") < sections.index("#ours") < sections.index("#made")
    losses = page.locator("#losses + ul li").all_inner_texts()
    assert len(losses) > 12
    for says in ("Colluding raters", "Deep agents on 10x10", "Reward-gaming gridworlds", "MuJoCo", "Best-of-n"):
        assert any(loss.startswith(says) for loss in losses), says


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
        page.locator(f"#filter button[data-v='{verdict}']").click()
        shown = page.locator("#ledger-table tbody tr:visible td.v").all_inner_texts()
        assert shown == [v for v in verdicts if verdict in ("", v)]
        pressed = page.locator("#filter button[aria-pressed='true']").all_inner_texts()
        assert pressed == [verdict or "all"]
    for verdict in VERDICTS:
        assert f"{verdicts.count(verdict)} {verdict}" in page.locator("#short ~ p").nth(1).inner_text()


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
        "mine", "<b>T</b>", 1, HOSTILE, css="h2 { color: rgb(1, 2, 3) }", js="window.ours = 'ä < 1'"
    )
    other = sections.Section("other", "Other", 2, "", js="window.more = window.ours + '!'")
    programs = [f"{{\n{s.js}\n}}" for s in (mine, other)]
    values = {"version": "1", "seeds": 2, "window": 100, "links": [], "programs": programs}
    text = templates.render(templates.HERE, "page.html.j2", sections=[mine, other], **values)
    (tmp_path / "page.html").write_text(text, encoding="utf-8")
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


def test_nothing_sticks_out_on_a_telephone(page):
    page.set_viewport_size({"width": 390, "height": 800})
    assert page.evaluate("document.scrollingElement.scrollWidth") <= 390
