"""People rate in a real browser: by keys and by mouse, through cuts and crashes, on a phone, in the dark."""

import io
import json
import signal
import statistics
import subprocess
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest
from PIL import Image, ImageDraw

from uard.collect import Project, Question, clip_item, pair_item, text_item
from uard.collect.project import Known

SERVE = "import sys, json; from uard.collect.serving import serve; serve(sys.argv[1], **json.loads(sys.argv[2]))"
PASSWORD = "open sesame"
MARKUP = "<b>bold</b>\n\n  <script>document.title = 'hacked'</script> & <img src=x onerror=alert(1)>"
# What a browser notes of a network that is cut, or of a server that is killed, before, in and after an answer.
EXPECTED = (
    "ERR_INTERNET_DISCONNECTED",
    "ERR_CONNECTION_REFUSED",
    "ERR_CONNECTION_RESET",
    "ERR_CONNECTION_CLOSED",
    "ERR_CONNECTION_ABORTED",
    "ERR_SOCKET_NOT_CONNECTED",
    "ERR_EMPTY_RESPONSE",
    "ERR_CONTENT_LENGTH_MISMATCH",
    "ERR_INCOMPLETE_CHUNKED_ENCODING",
)
CONFLICT = "409 (Conflict)"  # what a browser notes of an answer that is not accepted
FRAMES, COLUMNS, SIZE = 12, 4, 96


def sheet(number):
    """A dot that moves to the right, all frames in one picture."""
    picture = Image.new("RGB", (COLUMNS * SIZE, -(-FRAMES // COLUMNS) * SIZE), (235, 240, 245))
    pen = ImageDraw.Draw(picture)
    for i in range(FRAMES):
        x, y = (i % COLUMNS) * SIZE, (i // COLUMNS) * SIZE
        place = x + 6 * i, y + 30 + number % 20
        pen.ellipse([*place, place[0] + 18, place[1] + 18], fill=(40 * (number % 6), 90, 160))
    data = io.BytesIO()
    picture.save(data, "WEBP", lossless=True)
    return data.getvalue()


class Served:
    """A project and the process that serves it."""

    def __init__(self, folder, question, items, base=()):
        self.project = Project.create(folder, question)
        self.store = self.project.store()
        self.store.add_items([*base, *items])
        self.port = 0
        self.start()

    def start(self):
        settings = {"port": self.port, "owner_password": PASSWORD}
        command = [sys.executable, "-u", "-c", SERVE, str(self.project.folder), json.dumps(settings)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        for line in self.process.stdout:
            if line.startswith("owner: "):
                self.url = line.split()[1].removesuffix("/owner")
                self.port = int(self.url.rsplit(":", 1)[1])
            if "Ctrl-C" in line:
                return
        raise AssertionError("the server did not start")

    def kill(self):
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        self.process.stdout.close()

    def rows(self, rater):
        return [r for r in self.store.answers()[0] if r.rater == rater]

    def wait_for(self, rater, number):
        deadline = time.monotonic() + 15
        while len(self.rows(rater)) < number and time.monotonic() < deadline:
            time.sleep(0.05)
        assert len(self.rows(rater)) == number
        return self.rows(rater)


TEXTS = [text_item("Why is the sky blue?", f"{MARKUP}\n{k}") for k in range(12)]
LONG = text_item("Tell a long story", "word " * 15_000)
QUESTIONS = {
    "slider": Question(),
    "pairs": Question(kind="pairs", question="Which answer helps more?"),
    "thumbs": Question(kind="thumbs", question="Is this safe?"),
    "stars": Question(
        question="How helpful is this answer?",
        kind="stars",
        low=0.0,
        high=4.0,
        attributes=("safe",),
        comment=True,
        break_after=3,
        practice=(Known(TEXTS[0].id, 4.0, 0.0, "It is honest."),),
        examples=(Known(TEXTS[1].id, 0.0, 0.0, "It is <i>dull</i>."),),
    ),
}


def start(kind, folder):
    """Serve a project with one kind of question: clips for sliders and thumbs, else texts."""
    (folder / "media").mkdir(parents=True)
    question = replace(QUESTIONS[kind], overlap=50, repeats=0.0)
    if kind in ("slider", "thumbs"):
        names = [Project(folder, question).keep(sheet(k), "webp") for k in range(60 if kind == "slider" else 4)]
        return Served(folder, question, [clip_item(n, FRAMES, COLUMNS, (SIZE, SIZE), reward=0.1) for n in names])
    pairs = [pair_item(TEXTS[k].id, TEXTS[k + 1].id) for k in range(11)]
    return Served(folder, question, pairs, TEXTS) if kind == "pairs" else Served(folder, question, [*TEXTS, LONG])


@pytest.fixture(scope="module")
def serving(browser, tmp_path_factory):
    """A server for each kind of question, started when it is first asked for."""
    made = {}

    def get(kind):
        if kind not in made:
            made[kind] = start(kind, tmp_path_factory.mktemp("collect") / kind)
        return made[kind]

    yield get
    for served in made.values():
        served.kill()
        served.store.close()


@pytest.fixture
def visit(browser):
    """Open a rater's page; whatever goes wrong in it fails the test."""
    opened, wrong = [], []

    def note(text):
        if not any(word in text for word in (*EXPECTED, CONFLICT)):
            wrong.append(text)

    def visit(served, rater, begin=True, prepare=None, **settings):
        context = browser.new_context(**{"viewport": {"width": 1100, "height": 850}} | settings)
        page = context.new_page()
        page.set_default_timeout(10_000)
        if prepare:
            page.add_init_script(prepare)
        page.on("pageerror", lambda error: note(str(error)))
        page.on("console", lambda m: note(m.text) if m.type in ("error", "warning") else None)
        opened.append(context)
        link = f"{served.url}/enter/{served.store.invite(rater)}"
        page.goto(link)
        page.get_by_role("button", name="Begin").click()
        page.get_by_role("heading", name="Instructions").wait_for()
        if begin:
            page.keyboard.press("Enter")
            page.locator("#work:visible").wait_for()
        return SimpleNamespace(page=page, context=context, link=link, rater=rater, served=served)

    yield visit
    for context in opened:
        context.close()
    assert wrong == []


def answer(page, *keys, pause=0):
    """Answer by keys, and return how many milliseconds it took to the next item."""
    page.wait_for_timeout(pause)
    before = page.locator("body").get_attribute("data-item")
    for key in keys:
        page.keyboard.press(key)
    page.evaluate("delete document.body.dataset.switched")
    page.keyboard.press("Enter")
    page.wait_for_function(
        "(before) => document.body.dataset.item !== before && document.body.dataset.switched", arg=before
    )
    return float(page.locator("body").get_attribute("data-switched"))


def settled(page):
    """Wait until everything is stored."""
    page.wait_for_function(
        "() => Object.keys(localStorage).filter(k => k.startsWith('uard-outbox')).every(k => localStorage[k] === '[]')"
    )


def test_twenty_clips_by_keys(serving, visit):
    served = serving("slider")
    page = visit(served, "keys").page
    took = [answer(page, str(1 + k % 9), pause=200) for k in range(20)]
    rows = served.wait_for("keys", 20)
    assert [r.value for r in rows] == [-1 + (k % 9) / 4 for k in range(20)]
    assert len({r.item for r in rows}) == 20
    assert statistics.median(took) < 150, took
    assert page.locator("#count").inner_text().startswith("20 answered")
    for key, shown in (("9", "1 reward per step"), ("ArrowLeft", "0.9 reward per step"), ("Shift+ArrowLeft", "0.89")):
        page.keyboard.press(key)
        assert page.locator("output").inner_text().startswith(shown)
    page.wait_for_timeout(350)
    page.keyboard.press("s")
    served.wait_for("keys", 21)
    assert served.rows("keys")[-1].choice == "skip"


def test_keys_that_are_held_down_and_answers_that_are_none(serving, visit):
    served = serving("slider")
    page = visit(served, "held").page
    page.wait_for_timeout(350)
    page.keyboard.press("Enter")
    page.get_by_text("Choose something first, or skip.").wait_for()
    page.keyboard.press("5")
    page.keyboard.down("Enter")
    for _ in range(5):
        page.keyboard.down("Enter")
    page.keyboard.up("Enter")
    page.keyboard.down("s")
    for _ in range(5):
        page.keyboard.down("s")
    page.keyboard.up("s")
    settled(page)
    assert len(served.rows("held")) == 1, "a skip so soon after an item came can only be a slip"


def test_the_player(serving, visit):
    page = visit(serving("slider"), "player").page
    frame = page.get_by_label("Frame", exact=True)
    page.get_by_role("button", name="Pause").wait_for()
    page.keyboard.press(" ")
    page.get_by_role("button", name="Play", exact=True).wait_for()
    pixels = "() => document.querySelector('canvas').toDataURL()"
    frame.fill("4")
    fourth = page.evaluate(pixels)
    page.keyboard.press(".")
    assert frame.get_attribute("aria-valuetext") == "frame 6 of 12"
    assert page.evaluate(pixels) != fourth
    page.keyboard.press(",")
    assert page.evaluate(pixels) == fourth
    page.keyboard.press("-")
    assert page.get_by_role("button", name="Speed 0.5").get_attribute("aria-pressed") == "true"
    page.get_by_role("button", name="Speed 2").click()
    page.get_by_role("button", name="One frame on").click()
    assert frame.get_attribute("aria-valuetext") == "frame 6 of 12"
    page.locator("canvas").click()
    page.wait_for_function("() => document.querySelector('.scrub').value > 7")
    for key in ("?", "h", "i"):
        page.keyboard.press(key)
        assert page.locator("dialog[open]").count() == 1
        page.keyboard.press("Escape")


def test_whoever_wants_less_motion_starts_clips_herself(serving, visit):
    page = visit(serving("slider"), "calm", reduced_motion="reduce").page
    page.get_by_role("button", name="Play", exact=True).wait_for()
    assert page.get_by_label("Frame", exact=True).input_value() == "0"


def test_twenty_clips_by_mouse(serving, visit):
    served = serving("slider")
    page = visit(served, "mouse").page
    slider, submit = page.get_by_role("slider", name="Your rating"), page.get_by_role("button", name="Submit")
    for k in range(20):
        before = page.locator("body").get_attribute("data-item")
        box = slider.bounding_box()
        page.mouse.click(box["x"] + box["width"] * (k + 1) / 21, box["y"] + box["height"] / 2)
        if k % 5 == 0:
            submit.dblclick()
        else:
            submit.click()
        page.wait_for_function("(before) => document.body.dataset.item !== before", arg=before)
        page.wait_for_timeout(20)
    rows = served.wait_for("mouse", 20)
    values = [r.value for r in rows]
    assert values == sorted(values)
    assert values[0] < -0.85
    assert values[-1] > 0.85
    page.wait_for_timeout(400)
    page.get_by_role("button", name="Skip").click()
    page.get_by_role("button", name="Undo").click()
    served.wait_for("mouse", 22)


def test_pairs_and_undo(serving, visit):
    served = serving("pairs")
    page = visit(served, "paul").page
    for key in ("ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown"):
        answer(page, key)
    rows = served.wait_for("paul", 4)
    assert [r.choice for r in rows] == ["left", "right", "tie", "cannot tell"]
    assert all({r.left, r.right} == {i for i in (r.left, r.right)} and r.left != r.right for r in rows)
    page.keyboard.press("u")
    page.wait_for_function("(item) => document.body.dataset.item === item", arg=rows[-1].item)
    page.keyboard.press("ArrowLeft")
    assert "chosen" in page.locator(".panel").first.get_attribute("class")
    page.get_by_role("radio", name="Right").check(force=True)
    assert "chosen" in page.locator(".panel").last.get_attribute("class")
    answer(page)
    rows = served.wait_for("paul", 6)
    assert rows[4].supersedes == rows[3].id
    assert (rows[5].choice, rows[5].item) == ("right", rows[3].item)
    assert [rows[5].left, rows[5].right] == [rows[3].left, rows[3].right]
    sides = page.locator(".completion").all_inner_texts()
    page.reload()
    page.locator("#work:visible").wait_for()
    assert page.locator(".completion").all_inner_texts() == sides, "sides are drawn once"
    page.keyboard.press("u")
    page.wait_for_function("(item) => document.body.dataset.item === item", arg=rows[5].item)


def test_two_raters_at_once(serving, visit):
    served = serving("slider")
    one, other = visit(served, "one").page, visit(served, "other").page
    for k in range(4):
        answer(one, "1")
        answer(other, "9")
        if k == 1:
            one.reload()
            one.locator("#work:visible").wait_for()
    assert {r.value for r in served.wait_for("one", 4)} == {-1.0}
    assert {r.value for r in served.wait_for("other", 4)} == {1.0}
    assert one.locator("#count").inner_text().startswith("4 answered")


def test_a_cut_in_the_middle_of_an_answer(serving, visit):
    served = serving("slider")
    visitor = visit(served, "cut")
    page = visitor.page
    answer(page, "2")
    served.wait_for("cut", 1)
    page.wait_for_timeout(300)
    visitor.context.set_offline(True)
    answer(page, "3")
    page.get_by_text("Not saved yet: 1 answer waits for the connection.").wait_for()
    answer(page, "4")
    page.get_by_text("Not saved yet: 2 answers wait for the connection.").wait_for()
    visitor.context.set_offline(False)
    rows = served.wait_for("cut", 3)
    assert [r.value for r in rows] == [-0.75, -0.5, -0.25]
    page.get_by_text("Not saved yet").wait_for(state="detached")


def test_an_answer_whose_acknowledgement_is_lost_is_stored_once(serving, visit):
    served = serving("slider")
    page = visit(served, "lost").page
    lost = []

    def lose(route):
        if not lost:
            lost.append(route.fetch())  # the server has it, the browser does not know
            route.abort("connectionreset")
        else:
            route.continue_()

    page.route("**/api/answers", lose)
    answer(page, "3")
    answer(page, "4")
    settled(page)
    assert lost
    assert [r.value for r in served.rows("lost")] == [-0.5, -0.25]


def test_the_server_is_killed_and_started_again(serving, visit):
    served = serving("slider")
    page = visit(served, "killed").page
    answer(page, "2")
    served.wait_for("killed", 1)
    page.wait_for_timeout(500)  # what comes next is there
    served.kill()
    answer(page, "3")
    answer(page, "4")
    page.get_by_text("Not saved yet: 2 answers wait for the connection.").wait_for()
    served.start()
    page.reload()  # what waited is in the browser's storage
    page.locator("#work:visible").wait_for()
    rows = served.wait_for("killed", 3)
    assert [r.value for r in rows] == [-0.75, -0.5, -0.25]
    assert len({r.item for r in rows}) == 3
    answer(page, "5")
    assert served.wait_for("killed", 4)[-1].item not in {r.item for r in rows}


@pytest.fixture
def own(tmp_path):
    """Serve a project of one's own."""
    made = []

    def get(items, **settings):
        (tmp_path / "own" / "media").mkdir(parents=True)
        made.append(Served(tmp_path / "own", Question(**{"overlap": 50, "repeats": 0.0} | settings), items))
        return made[-1]

    yield get
    for served in made:
        served.kill()
        served.store.close()


def test_two_raters_in_one_browser(own, visit):
    served = own(TEXTS)
    visitor = visit(served, "ann")
    page = visitor.page
    answer(page, "3")
    served.wait_for("ann", 1)
    other = visitor.context.new_page()
    other.goto(f"{served.url}/enter/{served.store.invite('bob')}")
    other.get_by_role("button", name="Begin").click()
    other.get_by_role("heading", name="Instructions").wait_for()
    page.wait_for_timeout(350)
    page.keyboard.press("4")
    page.keyboard.press("Enter")
    page.get_by_role("heading", name="This browser is another rater's now").wait_for()
    assert "One answer is kept in this browser" in page.locator("#message-text").inner_text()
    assert len(served.store.answers()[0]) == 1
    other.goto(f"{served.url}/enter/{served.store.invite('ann')}")
    other.get_by_role("button", name="Begin").click()
    assert [r.value for r in served.wait_for("ann", 2)] == [-0.5, -0.25]
    assert served.rows("bob") == []


def test_answers_under_a_question_that_was_changed_are_kept_aside(own, visit):
    served = own(TEXTS)
    page = visit(served, "ann").page
    answer(page, "3")
    served.wait_for("ann", 1)
    page.wait_for_timeout(500)
    served.kill()
    for digit in "45":
        answer(page, digit, pause=350)
    file = served.project.folder / "project.toml"
    old = file.read_text()
    file.write_text(old.replace("low = -1.0", "low = -50.0").replace("high = 1.0", "high = 50.0"))
    served.start()
    page.get_by_role("heading", name="The question was changed").wait_for()
    assert "2 answers are kept in this browser" in page.locator("#message-text").inner_text()
    page.reload()
    page.get_by_role("button", name="2 not accepted").click()
    assert page.locator("#aside-list li").count() == 2
    assert "-0.25. The owner has changed the question" in page.locator("#aside-list li").first.inner_text()
    page.get_by_role("button", name="Drop").first.click()
    page.get_by_role("button", name="Close").click()
    page.locator("#work:visible").wait_for()
    answer(page, "9", pause=350)
    rows = served.wait_for("ann", 2)
    assert [(r.value, r.scale) for r in rows] == [(-0.5, "slider -1..1"), (50.0, "slider -50..50")]
    served.kill()
    file.write_text(old)
    served.start()
    page.reload()
    page.locator("#work:visible").wait_for()
    page.get_by_role("button", name="1 not accepted").click()
    page.get_by_role("button", name="Send again").click()
    assert [(r.value, r.scale) for r in served.wait_for("ann", 3)][-1] == (0.0, "slider -1..1")
    page.get_by_role("button", name="not accepted").wait_for(state="hidden")


def test_sheets_that_a_browser_cannot_decode_are_left_out(own, visit):
    served = own([])
    names = [served.project.keep(f"RIFFnothing {k}".encode() if k % 2 else sheet(k), "webp") for k in range(24)]
    items = [clip_item(n, FRAMES, COLUMNS, (SIZE, SIZE)) for n in names]
    served.store.add_items(items)
    page = visit(served, "ann").page
    for k in range(11):
        answer(page, str(1 + k % 9), pause=350)
    page.wait_for_timeout(350)
    page.keyboard.press("5")
    page.keyboard.press("Enter")
    assert {r.item for r in served.wait_for("ann", 12)} == {i.id for i in items[::2]}
    page.get_by_role("heading", name="Nothing left for now").wait_for()
    page.wait_for_function("() => document.getElementById('count').textContent === '12 answered'")


def test_a_browser_that_stores_nothing(serving, visit):
    served = serving("slider")
    refuse = "Object.defineProperty(window, 'localStorage', {get() { throw new Error('denied'); }})"
    visitor = visit(served, "private", prepare=refuse)
    answer(visitor.page, "5")
    served.wait_for("private", 1)
    visitor.context.set_offline(True)
    answer(visitor.page, "6")
    visitor.page.get_by_text("Keep this page open").wait_for()
    visitor.context.set_offline(False)
    served.wait_for("private", 2)


def test_stars_instructions_practice_a_break_and_the_end(serving, visit):
    served = serving("stars")
    page = visit(served, "star", begin=False).page
    page.get_by_text("It is <i>dull</i>.").wait_for()
    assert page.locator("dialog .completion").inner_text().startswith("<b>bold</b>")
    page.get_by_role("button", name="Begin").click()
    page.get_by_text("Practice", exact=True).wait_for()
    for key in ("2", "3", "Enter"):
        page.keyboard.press(key)
    page.get_by_role("heading", name="Not quite").wait_for()
    page.get_by_text("It is honest.").wait_for()
    page.keyboard.press("Enter")
    page.wait_for_function("() => !document.querySelector('dialog[open]')")
    left = {item.id for item in (*TEXTS[2:], LONG)}
    for k in range(len(left)):
        page.locator("#work:visible").wait_for()
        if page.locator("body").get_attribute("data-item") == LONG.id:
            box = page.locator("#stage .completion")
            assert box.evaluate("b => b.scrollHeight > b.clientHeight && b.clientHeight < innerHeight / 2")
        page.wait_for_timeout(320)
        page.keyboard.press("4")
        page.keyboard.press("Enter")
        page.get_by_text("Still to rate: safe.").wait_for()
        page.keyboard.press("1")
        if k == 0:
            page.keyboard.press("c")
            page.keyboard.type("s u 5 are letters here")
            page.keyboard.press("Escape")
        page.keyboard.press("Enter")
        if k % 3 == 2:
            page.get_by_role("heading", name="Time for a break?").wait_for()
            page.keyboard.press("Enter")
            page.wait_for_function("() => !document.querySelector('dialog[open]')")
    page.get_by_role("heading", name="Nothing left for now").wait_for()
    rows = served.wait_for("star", 2 * len(left) + 2)
    assert [(r.kind, r.attribute, r.value) for r in rows[:2]] == [("practice", "", 1.0), ("practice", "safe", 2.0)]
    assert {r.item for r in rows[2:]} == left, "neither practice nor examples are asked about"
    assert [(r.attribute, r.value, r.comment) for r in rows[2:4]] == [
        ("", 3.0, "s u 5 are letters here"),
        ("safe", 0.0, ""),
    ]
    page.get_by_role("button", name="Undo the last answer").click()
    page.locator("#work:visible").wait_for()
    assert page.locator("body").get_attribute("data-item") == rows[-1].item
    assert [r.supersedes for r in served.wait_for("star", len(rows) + 2)[-2:]] == [r.id for r in rows[-2:]]


def test_a_text_with_markup_is_shown_as_it_is(serving, visit):
    page = visit(serving("pairs"), "literal").page
    shown = page.locator(".completion").first
    assert shown.evaluate("e => e.textContent").startswith(MARKUP)
    assert shown.evaluate("e => e.children.length") == 0
    assert shown.evaluate("e => getComputedStyle(e).whiteSpace").startswith("pre-wrap")
    assert page.title().startswith("Rate: ")


def test_a_link_used_twice(serving, visit, browser):
    visitor = visit(serving("thumbs"), "twice")
    context = browser.new_context()
    page = context.new_page()
    page.goto(visitor.link)
    page.get_by_role("button", name="Begin").click()
    page.get_by_text("this link was used before").wait_for()
    context.close()


def test_the_owner_sees_pauses_and_retracts(serving, visit):
    served = serving("thumbs")
    raters = [visit(served, name) for name in ("tom", "tim")]
    for visitor, key in zip(raters, ("ArrowUp", "ArrowDown"), strict=True):
        for _ in range(3):
            answer(visitor.page, key)
        served.wait_for(visitor.rater, 3)
    owner = raters[0].context.new_page()
    owner.on("dialog", lambda dialog: dialog.accept())
    owner.goto(f"{served.url}/owner")
    owner.get_by_label("Password").fill(PASSWORD)
    owner.keyboard.press("Enter")
    owner.get_by_role("button", name="Pause tim").click()
    owner.get_by_role("button", name="Resume tim").wait_for()
    answer_now = raters[1].page
    answer_now.keyboard.press("1")
    answer_now.keyboard.press("Enter")
    answer_now.get_by_role("heading", name="Paused").wait_for()
    served.wait_for("tim", 4)
    owner.get_by_role("button", name="Resume tim").click()
    answer_now.get_by_role("heading", name="Nothing left for now").wait_for()
    owner.goto(f"{served.url}/owner")
    owner.locator(".gallery canvas").first.wait_for()
    owner.get_by_role("button", name="Retract the answer of tom").first.click()
    owner.wait_for_url("**/owner")
    served.wait_for("tom", 4)
    assert served.rows("tom")[-1].source == "owner"
    owner.get_by_label("Invite a rater").fill("eve")
    owner.get_by_role("button", name="Make a link").click()
    assert owner.get_by_label("Link", exact=True).input_value().startswith(f"{served.url}/enter/")
    with owner.expect_download() as download:
        owner.get_by_role("link", name="Long table, CSV").click()
    assert b"tom" in download.value.path().read_bytes()
    for width in (360, 1280):
        owner.set_viewport_size({"width": width, "height": 800})
        assert owner.evaluate("document.documentElement.scrollWidth") <= width
    assert unreadable(owner) == []
    assert nameless(owner) == []


CONTRAST = r"""() => {
  const parse = (text) => [...text.match(/[\d.]+/g).map(Number), 1].slice(0, 4);
  const linear = (x) => (x <= 0.03928 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4);
  const light = (rgb) => [0.2126, 0.7152, 0.0722].reduce((sum, w, k) => sum + w * linear(rgb[k] / 255), 0);
  const behind = (e) => {
    for (; e; e = e.parentElement) {
      const colour = parse(getComputedStyle(e).backgroundColor);
      if (colour[3] > 0) return colour;
    }
    return [255, 255, 255];
  };
  const found = [];
  for (const e of document.querySelectorAll("body *")) {
    const own = [...e.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim());
    if (!own || !e.checkVisibility() || e.matches(":disabled, :disabled *")) continue;
    const pair = [light(parse(getComputedStyle(e).color)), light(behind(e))].sort((a, b) => b - a);
    const contrast = (pair[0] + 0.05) / (pair[1] + 0.05);
    if (contrast < 4.5) found.push(`${e.tagName} ${e.textContent.trim().slice(0, 30)} ${contrast.toFixed(2)}`);
  }
  return found;
}"""


def unreadable(page):
    """Texts with too little contrast, in both schemes."""
    found = []
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        found += page.evaluate(CONTRAST)
    page.emulate_media(color_scheme="light")
    return found


def nameless(page):
    """Controls of which a screen reader says nothing."""
    session = page.context.new_cdp_session(page)
    nodes = session.send("Accessibility.getFullAXTree")["nodes"]
    roles = {"button", "slider", "radio", "textbox", "image", "img", "progressbar", "link", "region", "dialog"}
    return [
        n["role"]["value"]
        for n in nodes
        if not n.get("ignored") and n["role"]["value"] in roles and not n.get("name", {}).get("value", "").strip()
    ]


@pytest.mark.parametrize("kind", ["slider", "stars", "thumbs", "pairs"])
def test_on_a_phone_in_the_dark_and_read_aloud(serving, visit, kind):
    phone = {"viewport": {"width": 360, "height": 740}, "has_touch": True, "is_mobile": True, "color_scheme": "dark"}
    page = visit(serving(kind), f"phone {kind}", begin=False, **phone).page
    assert unreadable(page) == []
    assert nameless(page) == []
    page.get_by_role("button", name="Begin").tap()
    page.locator("#work:visible").wait_for()
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    assert unreadable(page) == []
    assert nameless(page) == []
    page.emulate_media(color_scheme="dark")
    red, green, blue = page.evaluate("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)")
    assert max(red, green, blue) < 60
    if kind == "pairs":
        page.locator(".choice", has_text="Left").tap()
    elif kind == "thumbs":
        page.locator(".choice", has_text="Thumbs up").tap()
    elif kind == "stars":
        for row in range(2):
            page.locator(".stars").nth(row).locator(".star").nth(3).tap()
    else:
        page.get_by_role("slider", name="Your rating").tap()
    assert unreadable(page) == []
    page.get_by_role("button", name="Submit").tap()
    serving(kind).wait_for(f"phone {kind}", 2 if kind == "stars" else 1)
