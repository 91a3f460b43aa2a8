"""The page's routes, without a browser: who may ask what, and what is stored of it."""

import json
import os
import subprocess
import sys
import threading
import time
import uuid
from typing import ClassVar

import pytest
from starlette.testclient import TestClient

from uard._checks import InvalidValueError
from uard.collect import Project, Question, Request, SQLiteStore, asking, clip_item, pair_item, text_item
from uard.collect.app import create_app, security
from uard.collect.app.security import MOST_BYTES
from uard.collect.project import Known
from uard.collect.serving import invite, serve
from uard.collect.store import LEASE_SECONDS, StoreError
from uard.ratings import export

HERE = "http://127.0.0.1:8321"
TEXTS = [
    text_item("What is 2 + 2?", f"{i} <script>alert(1)</script>", reward=i / 10, stratum="model") for i in range(6)
]


class Browser(TestClient):
    """A browser; what its page sends names the page's rater and question, as a page does."""

    page: ClassVar = {}

    def post(self, url, *, json=None, **more):
        if str(url).startswith("/api") and isinstance(json, dict):
            json = self.page | json
        return super().post(url, json=json, **more)


class Site:
    """A project that is served, with its raters' browsers."""

    def __init__(self, folder, question=None, items=TEXTS, asked=None, clock=time.time, **settings):
        self.now = clock
        Project.create(folder)
        self.project = Project(folder, question or Question())
        self.store = SQLiteStore(folder / "answers.sqlite", clock=lambda: self.now())
        self.store.add_items(items)
        for name in ("ann", "bob"):
            self.store.invite(name)
        self.store.ask([Request(i.id) for i in (items if asked is None else asked) for _ in range(2)])
        self.settings = {"owner_password": "open sesame"} | settings
        self.start()

    def start(self):
        """Start the server, again: it has forgotten what it had in memory."""
        self.app = create_app(self.project, self.store, **self.settings)

    def browser(self, base=HERE, **headers):
        return Browser(self.app, base_url=base, headers={"Origin": base} | headers, follow_redirects=False)

    def opened(self, browser, name):
        """Open the page of a rater in a browser."""
        browser.page = {"rater": name, "question": self.project.question.identity}
        return browser

    def rater(self, name):
        browser = self.opened(self.browser(), name)
        assert browser.post("/enter", data={"token": self.store.invite(name)}).status_code == 303
        return browser

    def owner(self):
        browser = self.browser()
        assert browser.post("/owner/login", data={"password": "open sesame"}).status_code == 303
        return browser

    def rows(self):
        return self.store.answers()[0].rows


@pytest.fixture
def site(tmp_path):
    made = Site(tmp_path / "project")
    yield made
    made.store.close()


@pytest.fixture
def made(tmp_path):
    """Make a site of one's own."""
    sites = []

    def make(**settings):
        sites.append(Site(tmp_path / f"project{len(sites)}", **settings))
        return sites[-1]

    yield make
    for one in sites:
        one.store.close()


def tasks(browser, count=2):
    return browser.post("/api/next", json={"count": count}).json()["tasks"]


def answer_to(task, value=0.5, **more):
    values = None if "choice" in more else {"": value}
    return {"id": uuid.uuid4().hex, "lease": task["lease"], "values": values, "seconds": 3.0} | more


def test_from_a_link_to_a_stored_answer(site):
    browser, secret = site.browser(), site.store.invite("ann")
    shown = browser.get(f"/enter/{secret}")
    assert shown.status_code == 200
    assert secret in shown.text
    assert "Set-Cookie" not in shown.headers, "whoever only looks at a link does not use it up"
    entered = browser.post("/enter", data={"token": secret})
    assert (entered.status_code, entered.headers["location"]) == (303, "/rate")
    cookie = entered.headers["set-cookie"]
    for word in (f"uard_rater_{site.store.identity}=", "HttpOnly", "SameSite=strict", "Path=/"):
        assert word in cookie
    assert "Secure" not in cookie
    page = site.opened(browser, "ann").get("/rate")
    assert "How much reward does this deserve?" in page.text
    (task, other) = tasks(browser)
    body = answer_to(task, comment="")
    reply = browser.post("/api/answers", json=body)
    assert reply.json() == {"stored": body["id"], "feedback": None, "note": None}
    (row,) = site.rows()
    assert (row.id, row.item, row.rater, row.value) == (body["id"], task["item"]["id"], "ann", 0.5)
    assert (row.scale, row.source, row.kind) == ("slider -1..1", "page", "rating")
    assert row.given_at - row.shown_at == pytest.approx(3.0, abs=1e-3)
    assert abs(row.given_at - time.time()) < 60, "the server's clock"
    following = browser.post("/api/next", json={"count": 2}).json()
    assert following["tasks"][0]["lease"] == other["lease"]
    assert following["progress"] == {"answered": 1, "open": 5}


def test_what_a_rater_is_told_of_an_item(site, made):
    """Neither the reward nor which policy acted, which would tell what is expected."""
    (task,) = tasks(site.rater("ann"), 1)
    assert set(task) == {"lease", "kind", "item"}
    assert set(task["item"]) == {"id", "kind", "prompt", "completion"}
    shown = made(question=Question(show_reward=True))
    assert tasks(shown.rater("ann"), 1)[0]["item"]["reward"] == 0.0


def test_an_answer_that_is_sent_again_is_stored_once_even_after_a_restart(site):
    browser = site.rater("ann")
    body = answer_to(tasks(browser)[0])
    first = browser.post("/api/answers", json=body)
    assert browser.post("/api/answers", json=body).json() == first.json()
    cookies = dict(browser.cookies)
    site.start()
    again = site.opened(site.browser(), "ann")
    again.cookies.update(cookies)
    assert again.post("/api/answers", json=body).json() == first.json()
    assert len(site.rows()) == 1
    differs = again.post("/api/answers", json=body | {"values": {"": -0.5}})
    assert differs.status_code == 409
    assert "another answer is stored" in differs.json()["error"]


def test_an_answer_to_a_lease_that_was_given_before_the_server_was_started_again(site):
    browser = site.rater("ann")
    first, second = tasks(browser)
    site.start()
    again = site.opened(site.browser(), "ann")
    again.cookies.update(dict(browser.cookies))
    stored = again.post("/api/answers", json=answer_to(first))
    assert stored.status_code == 200
    assert tasks(again)[0]["lease"] == second["lease"], "the request was answered, not asked again"
    assert again.post("/api/answers", json=answer_to(first, -0.5)).status_code == 200
    assert [(r.value, r.kind) for r in site.store.answers()[0].standing()] == [(-0.5, "rating")], "no repeat"
    invented = answer_to({"lease": "f" * 32}, item=TEXTS[5].id)
    assert again.post("/api/answers", json=invented).status_code == 404, "nobody has shown her that"
    assert len(site.rows()) == 2


def test_an_answer_after_its_lease_has_ended_and_another_rater_has_answered(tmp_path):
    now = [1e9]
    site = Site(tmp_path / "p", clock=lambda: now[0], asked=[])
    site.store.ask([Request(TEXTS[0].id)])
    ann, bob = site.rater("ann"), site.rater("bob")
    (task,) = tasks(ann)
    assert tasks(bob) == []
    now[0] += LEASE_SECONDS + 1
    (other,) = tasks(bob)
    assert bob.post("/api/answers", json=answer_to(other, -1.0)).status_code == 200
    assert ann.post("/api/answers", json=answer_to(task, 1.0)).status_code == 200
    assert [(r.rater, r.value) for r in site.rows()] == [("bob", -1.0), ("ann", 1.0)]
    site.store.close()


def test_nobody_answers_or_takes_back_for_another(site):
    ann, bob = site.rater("ann"), site.rater("bob")
    (task, *_), (own, *_) = tasks(ann), tasks(bob)
    stolen = bob.post("/api/answers", json=answer_to(task, item=task["item"]["id"]))
    assert stolen.status_code == 403
    assert site.rows() == ()
    body = answer_to(task)
    ann.post("/api/answers", json=body)
    undone = bob.post("/api/undo", json={"id": uuid.uuid4().hex, "answer": body["id"]})
    assert undone.status_code == 404
    taken = bob.post("/api/answers", json=answer_to(own) | {"id": body["id"]})
    assert taken.status_code == 409
    assert len(site.rows()) == 1


def test_undo_hands_the_item_out_again(site):
    browser = site.rater("ann")
    task, _ = tasks(browser)
    body = answer_to(task)
    browser.post("/api/answers", json=body)
    undo = {"id": uuid.uuid4().hex, "answer": body["id"]}
    first = browser.post("/api/undo", json=undo)
    assert first.json()["task"] == task
    assert browser.post("/api/undo", json=undo).status_code == 200, "sent again"
    assert browser.post("/api/answers", json=answer_to(task, -1.0)).status_code == 200
    assert [r.value for r in site.store.answers()[0].standing()] == [-1.0]
    assert len(site.rows()) == 3
    twice = browser.post("/api/undo", json={"id": uuid.uuid4().hex, "answer": body["id"]})
    assert twice.status_code == 409


def test_the_last_of_two_answers_to_one_lease_stands(site):
    """Two tabs of one browser show the same item."""
    browser = site.rater("ann")
    task, _ = tasks(browser)
    bodies = answer_to(task, 1.0), answer_to(task, 0.0)
    for body in (*bodies, *bodies):
        assert browser.post("/api/answers", json=body).status_code == 200
    assert [r.value for r in site.store.answers()[0].standing()] == [0.0]
    assert len(site.rows()) == 2


def test_attributes_are_stored_in_one_go_and_taken_back_together(made):
    site = made(question=Question(kind="stars", low=0.0, high=1.0, stars=3, attributes=("safe", "fast")))
    browser = site.rater("ann")
    task, _ = tasks(browser)
    body = answer_to(task, values={"": 0.5, "safe": 1, "fast": 0.0})
    assert browser.post("/api/answers", json=body).status_code == 200
    assert [(r.attribute, r.value) for r in site.rows()] == [("", 0.5), ("safe", 1.0), ("fast", 0.0)]
    assert [r.id for r in site.rows()] == [body["id"], f"{body['id']}.1", f"{body['id']}.2"]
    assert browser.post("/api/answers", json=answer_to(task, choice="skip")).status_code == 200
    assert [(r.attribute, r.said) for r in site.store.answers()[0].standing()] == [("", "skip")]
    for wrong in ({"": 0.5}, {"": 0.5, "safe": 0.3, "fast": 0.0}, {"": 0.5, "safe": 1, "fast": 0, "x": 0}, None):
        assert browser.post("/api/answers", json=answer_to(task, values=wrong)).status_code == 400


@pytest.mark.parametrize(
    ("field", "value", "told"),
    [
        ("values", {"": 2.0}, "in [-1, 1]"),
        ("values", {"": True}, "in [-1, 1]"),
        ("values", {"": None}, "in [-1, 1]"),
        ("values", {}, "values for"),
        ("values", [0.5], "values for"),
        ("choice", "left", "must be one of skip"),
        ("id", "x", "an id of its own"),
        ("id", "a.1" * 9, "an id of its own"),
        ("comment", "I like it", "no comments"),
        ("source", "elsewhere", "page, simulated"),
    ],
)
def test_an_answer_that_is_none(site, field, value, told):
    browser = site.rater("ann")
    reply = browser.post("/api/answers", json=answer_to(tasks(browser)[0]) | {field: value})
    assert reply.status_code == 400
    assert told in reply.json()["error"]
    assert site.rows() == ()


@pytest.mark.parametrize("body", [b"", b"{", b"[]", b'{"id": NaN}', b"\xff", b"[" * 40_000, b"null"])
def test_a_request_that_is_no_json(site, body):
    browser = site.rater("ann")
    for path in ("/api/next", "/api/answers", "/api/undo"):
        reply = browser.post(path, content=body, headers={"Content-Type": "application/json"})
        assert reply.status_code == 400
        assert reply.json()["error"]


@pytest.mark.parametrize("count", [0, 21, -1, 1.5, "2", True, None])
def test_a_count_that_is_none(site, count):
    assert site.rater("ann").post("/api/next", json={"count": count}).status_code == 400


def test_a_clock_that_jumps(site):
    browser = site.rater("ann")
    for task, seconds in zip(tasks(browser, 5), (-1e9, 1e300, "a while", None, 0.05), strict=True):
        assert browser.post("/api/answers", json=answer_to(task, seconds=seconds)).status_code == 200
    took = [r.given_at - r.shown_at for r in site.rows()]
    assert took == pytest.approx([0.0, 86_400.0, 0.0, 0.0, 0.05], abs=1e-3)


def test_a_very_fast_answer_gets_a_note(site):
    browser = site.rater("ann")
    reply = browser.post("/api/answers", json=answer_to(tasks(browser)[0], seconds=0.05))
    assert "Undo (u) takes it back" in reply.json()["note"]


def test_pairs(made):
    pair = pair_item(TEXTS[0].id, TEXTS[1].id)
    practice = pair_item(TEXTS[2].id, TEXTS[3].id)
    question = Question(kind="pairs", practice=(Known(practice.id, 1.0, why="It is shorter."),))
    site = made(question=question, items=[*TEXTS, pair, practice], asked=[pair])
    site.store.ask([Request(practice.id, "ann", "practice")])
    ann, bob = site.rater("ann"), site.rater("bob")
    first, second = tasks(ann)
    assert (first["kind"], second["kind"]) == ("practice", "rating")
    sides = first["sides"]
    assert (first["left"]["id"], first["right"]["id"]) == tuple(sides)
    better = "left" if sides[0] == practice.content["left"] else "right"
    told = ann.post("/api/answers", json=answer_to(first, choice=better)).json()["feedback"]
    assert told == {"right": True, "value": 1.0, "choice": better, "why": "It is shorter."}
    assert ann.post("/api/answers", json=answer_to(second, choice="up")).status_code == 400
    assert ann.post("/api/answers", json=answer_to(second, choice="cannot tell")).status_code == 200
    row = site.rows()[-1]
    assert [row.left, row.right] == second["sides"]
    (other,) = tasks(bob)
    site.start()
    bob = site.rater("bob")
    assert bob.post("/api/answers", json=answer_to(other, choice="left")).status_code == 200
    assert [site.rows()[-1].left, site.rows()[-1].right] == other["sides"], "as it stood on the screen"


def test_thumbs_and_practice(made):
    question = Question(kind="thumbs", practice=(Known(TEXTS[0].id, 0.0, why="It is wrong."),))
    site = made(question=question)
    site.store.ask([Request(TEXTS[0].id, "ann", "practice")])
    browser = site.rater("ann")
    reply = browser.post("/api/answers", json=answer_to(tasks(browser)[0], choice="up")).json()
    assert reply["feedback"] == {"right": False, "value": 0.0, "choice": "down", "why": "It is wrong."}
    assert browser.post("/api/answers", json=answer_to(tasks(browser)[0], 0.5)).status_code == 400


def test_a_pause_acts_at_once_and_answers_still_count(site):
    ann, owner = site.rater("ann"), site.owner()
    task, _ = tasks(ann)
    owner.post("/owner/pause", data={"rater": "ann", "paused": "yes"})
    reply = ann.post("/api/next", json={"count": 2}).json()
    assert (reply["tasks"], reply["paused"]) == ([], True)
    assert ann.post("/api/answers", json=answer_to(task)).status_code == 200
    owner.post("/owner/pause", json={"rater": "ann", "paused": False})
    assert len(tasks(ann)) == 2
    assert owner.post("/owner/pause", json={"rater": "eve", "paused": True}).status_code == 400


def test_more_is_asked_for_when_there_is_too_little(made):
    calls = []
    site = made(asked=TEXTS[:1])

    def more(rater, count, without):
        assert without == set()
        calls.append((rater, count))
        site.store.ask([Request(i.id, rater) for i in TEXTS[1:3]])

    site.settings["top_up"] = more
    site.start()
    assert len(tasks(site.rater("ann"), 3)) == 3
    assert calls == [("ann", 2)]


def test_a_link_works_once(site):
    secret, first, second = site.store.invite("ann"), site.browser(), site.browser()
    assert first.post("/enter", data={"token": secret}).status_code == 303
    refused = second.post("/enter", data={"token": secret})
    assert refused.status_code == 403
    assert "was used before" in refused.text
    assert "<html" in refused.text
    assert first.post("/enter", data={"token": secret}).status_code == 303, "who is in already just goes on"
    assert second.get("/rate").status_code == 401
    assert "personal link" in second.get("/rate").text


def test_without_a_link_there_is_nothing_to_see(site):
    browser = site.browser()
    for path in ("/api/next", "/api/answers", "/api/undo"):
        assert browser.post(path, json={}).status_code == 401
    for path in ("/owner/pause", "/owner/retract", "/owner/invite"):
        assert browser.post(path, json={}).status_code == 401
    rater = site.rater("ann")
    for path in ("/owner/overview", "/owner/disputed", "/owner/export/csv"):
        assert browser.get(path).status_code == rater.get(path).status_code == 401
    assert 'type="password"' in rater.get("/owner").text
    assert browser.get("/media/" + "0" * 64 + ".webp").status_code == 401


def test_what_every_answer_of_the_server_says_to_browsers(site):
    browser = site.rater("ann")
    for path in ("/rate", "/owner", "/nothing", "/static/style.css", "/enter/x"):
        headers = browser.get(path).headers
        assert headers["content-security-policy"].startswith("default-src 'self'; frame-ancestors 'none'")
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] in ("no-referrer", "same-origin")
        assert headers["cache-control"] == "no-store"
    api = browser.post("/api/next", json={"count": 1}).headers
    assert (api["cache-control"], api["referrer-policy"]) == ("no-store", "no-referrer")


def test_only_our_own_names_are_answered_to(site):
    for host in ("127.0.0.1:8321", "localhost", "[::1]:99", "127.0.0.1"):
        assert site.browser(f"http://{host}").get("/owner").status_code == 200
    for host in ("evil.example", "127.0.0.1.evil.example", "10.0.0.1", "localhost.evil:80", "", "[::", "@localhost"):
        reply = site.browser().get("/owner", headers={"Host": host})
        assert reply.status_code == (200 if host == "@localhost" else 400), host


def test_only_our_own_pages_may_post(site):
    browser = site.rater("ann")
    for origin in ("http://evil.example", "null", "http://127.0.0.1:9999", "https://127.0.0.1:8321", ""):
        assert browser.post("/api/next", json={"count": 1}, headers={"Origin": origin}).status_code == 403
    without = TestClient(site.app, base_url=HERE, cookies=dict(browser.cookies))
    assert without.post("/api/next", json={"count": 1}).status_code == 403


def test_behind_a_server_with_tls(made):
    site = made(public_url="https://rate.example.org")
    browser = site.browser("https://rate.example.org")
    entered = browser.post("/enter", data={"token": site.store.invite("ann")})
    assert "Secure" in entered.headers["set-cookie"]
    assert len(tasks(site.opened(browser, "ann"))) == 2
    inner = site.browser("http://127.0.0.1:8321", Origin="https://rate.example.org")
    assert inner.post("/owner/login", data={"password": "open sesame"}).status_code == 303, "the name was changed"
    link = browser.post("/owner/login", data={"password": "open sesame"})
    assert link.status_code == 303
    assert browser.post("/owner/invite", json={"rater": "eve"}).json()["link"].startswith("https://rate.example.org/en")
    for wrong in (
        "rate.example.org",
        "ftp://x",
        "https://x/path",
        "https://me:secret@x",
        "https://x:port",
        "https://a b",
    ):
        with pytest.raises(InvalidValueError, match="public_url"):
            create_app(site.project, site.store, owner_password="x", public_url=wrong)


def test_too_large_a_request(site):
    browser = site.rater("ann")
    reply = browser.post("/api/answers", content=b"x" * (MOST_BYTES + 1), headers={"Content-Type": "application/json"})
    assert reply.status_code == 413

    def parts():
        yield from [b"x" * 1024] * 65

    assert browser.post("/api/answers", content=parts()).status_code == 413


def test_too_many_requests(site, monkeypatch):
    browser = site.rater("ann")
    monkeypatch.setattr(security, "PER_SESSION", (0.01, 5.0))
    replies = [browser.post("/api/undo", content=b"") for _ in range(7)]
    assert [r.status_code for r in replies] == [400] * 5 + [429] * 2
    assert replies[-1].json() == {"error": "Too many requests; wait a moment."}
    assert 90 < int(replies[-1].headers["retry-after"]) <= 101
    other = site.rater("bob")
    assert len(tasks(other)) == 2, "each session has its own limit"


def test_guesses_are_slow_and_the_right_password_is_always_heard(site, monkeypatch):
    monkeypatch.setattr(security, "SLOW", 0.2)
    browser, owner = site.browser(), site.browser()
    replies = [browser.post("/owner/login", data={"password": f"{i}"}) for i in range(10)]
    assert [r.status_code for r in replies] == [403] * 10
    for login, status in ((browser, 403), (owner, 303)):
        before = time.monotonic()
        password = "open sesame" if login is owner else "again"
        assert login.post("/owner/login", data={"password": password}).status_code == status
        assert time.monotonic() - before >= 0.2
    assert owner.get("/owner/overview").status_code == 200


def test_a_page_of_another_rater_in_the_same_browser_speaks_for_nobody(site):
    browser = site.rater("ann")
    task, _ = tasks(browser)
    browser.post("/enter", data={"token": site.store.invite("bob")})
    body = answer_to(task)
    for path, sent in (("next", {"count": 2}), ("answers", body), ("undo", body), ("broken", body)):
        reply = browser.post(f"/api/{path}", json=sent)
        assert (reply.status_code, reply.json()["why"]) == (409, "rater")
        assert "This page is ann's, and this browser is now bob's." in reply.json()["error"]
        assert browser.post(f"/api/{path}", json=sent | {"rater": None}).status_code == 400
    assert site.rows() == ()
    browser.post("/enter", data={"token": site.store.invite("ann")})
    assert browser.post("/api/answers", json=body).status_code == 200
    assert [r.rater for r in site.rows()] == ["ann"]


@pytest.mark.parametrize(
    "changed",
    [
        {"low": -50.0, "high": 50.0},
        {"kind": "thumbs"},
        {"kind": "stars"},
        {"attributes": ("safe",)},
        {"comment": True},
    ],
)
def test_a_page_that_asks_what_is_not_asked_any_more(site, changed):
    browser = site.rater("ann")
    first, second, _ = tasks(browser, 3)
    kept, late = answer_to(first), answer_to(second)
    assert browser.post("/api/answers", json=kept).status_code == 200
    site.project = Project(site.project.folder, Question(**changed))
    site.start()
    after = site.browser()
    after.page, after.cookies = browser.page, browser.cookies
    for path, body in (("answers", late), ("next", {"count": 1})):
        reply = after.post(f"/api/{path}", json=body)
        assert (reply.status_code, reply.json()["why"]) == (409, "question")
        assert after.post(f"/api/{path}", json=body | {"question": None}).status_code == 400
    assert after.post("/api/answers", json=kept).json()["stored"] == kept["id"], "it was stored under its own scale"
    assert [(r.value, r.scale) for r in site.rows()] == [(0.5, "slider -1..1")]
    assert tasks(site.opened(after, "ann"))[0]["lease"] == second["lease"]


def test_words_that_change_no_scale_leave_open_pages_alone():
    plain = Question()
    for same in (Question(question="Again?"), Question(stars=7), Question(overlap=9), Question(instructions="x")):
        assert same.identity == plain.identity
    stars = {Question(kind="stars", stars=n).identity for n in (3, 4)}
    assert len(stars | {plain.identity, Question(high=2).identity}) == 4


def test_answers_to_one_lease_at_once_are_one_answer(site):
    browser = site.rater("ann")
    task, _ = tasks(browser)
    replies = []

    def tell(value):
        own = site.opened(site.browser(), "ann")
        own.cookies.update(dict(browser.cookies))
        replies.append(own.post("/api/answers", json=answer_to(task, value)).status_code)

    threads = [threading.Thread(target=tell, args=(k / 8,)) for k in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert replies == [200] * 8
    (row,) = site.store.answers()[0].standing()
    assert row.kind == "rating"
    undone = browser.post("/api/undo", json={"id": uuid.uuid4().hex, "answer": row.id}).json()
    assert undone["task"] == task, "whichever tab has said it last"


def test_two_projects_of_one_host_do_not_log_each_other_out(made):
    one, other = made(), made()
    jars = [browser.cookies for s in (one, other) for browser in (s.rater("ann"), s.owner())]
    cookies = {name: value for jar in jars for name, value in jar.items()}
    assert len(cookies) == 4
    for site in (one, other):
        browser = site.opened(site.browser(), "ann")
        browser.cookies.update(cookies)
        assert len(tasks(browser)) == 2
        assert browser.get("/owner/overview").status_code == 200
        assert site.store.identity in browser.get("/rate").text


def test_what_a_browser_cannot_show_is_left_out_for_its_rater_and_then_for_all(made):
    site = made(question=Question(overlap=2), asked=[])

    def more(*rest):
        asking.top_up(site.project, site.store, *rest)

    site.settings["top_up"] = more
    site.start()
    ann, bob = site.rater("ann"), site.rater("bob")
    wrong = {TEXTS[k].id for k in range(3)}
    done = set()
    for _ in range(20):
        for task in tasks(ann, 4):
            path = "broken" if task["item"]["id"] in wrong else "answers"
            assert ann.post(f"/api/{path}", json=answer_to(task)).status_code == 200
            done |= {task["item"]["id"]} if path == "answers" else set()
    assert done == {t.id for t in TEXTS} - wrong, "she goes on with all others"
    assert ann.post("/api/next", json={"count": 2}).json()["progress"] == {"answered": 3, "open": 0}
    owner = site.owner()
    assert "3 items set aside for a rater" in owner.get("/owner").text
    shown = tasks(bob, 20)
    assert wrong <= {t["item"]["id"] for t in shown}, "others are asked until it is seen not to be hers alone"
    (task,) = [t for t in shown if t["item"]["id"] == TEXTS[0].id]
    assert bob.post("/api/broken", json={"lease": task["lease"], "item": TEXTS[5].id}).status_code == 404
    assert ann.post("/api/broken", json={"lease": task["lease"]}).status_code == 403
    assert bob.post("/api/broken", json={"lease": task["lease"]}).status_code == 200
    page = owner.get("/owner").text
    assert "1 item set aside" in page
    assert "the browsers of ann, bob cannot show it" in page
    assert owner.get("/owner/overview").json()["items"] == 5


def test_progress_is_about_the_same_things_on_both_pages(made):
    question = Question(
        overlap=2,
        practice=(Known(TEXTS[0].id, 0.5),),
        examples=(Known(TEXTS[1].id, 0.5),),
        gold=(Known(TEXTS[2].id, 0.5),),
    )
    site = made(question=question, asked=TEXTS[3:])
    kinds = [Request(TEXTS[0].id, "ann", "practice"), Request(TEXTS[2].id, "ann", "gold")]
    site.store.ask(kinds)
    ann, owner = site.rater("ann"), site.owner()
    assert ann.post("/api/next", json={"count": 1}).json()["progress"] == {"answered": 0, "open": 4}
    while shown := tasks(ann, 1):
        skip = {"choice": "skip"} if shown[0]["item"]["id"] == TEXTS[5].id else {}
        ann.post("/api/answers", json=answer_to(shown[0], **skip))
    site.store.ask([Request(TEXTS[3].id, "ann", "repeat")])
    ann.post("/api/answers", json=answer_to(tasks(ann, 1)[0]))
    reply = ann.post("/api/next", json={"count": 1}).json()
    assert reply["progress"] == {"answered": 5, "open": 0}, "three items, a repeat and gold"
    names = ("items", "rated", "complete", "answers", "wanted")
    assert [owner.get("/owner/overview").json()[n] for n in names] == [3, 3, 0, 3, 6]
    bob = site.rater("bob")
    for task in tasks(bob, 20):
        bob.post("/api/answers", json=answer_to(task))
    assert [owner.get("/owner/overview").json()[n] for n in names] == [3, 3, 3, 6, 6]


def test_a_rater_who_is_given_nothing_is_told_of_nothing(made):
    site = made(asked=[])
    reply = site.rater("ann").post("/api/next", json={"count": 2}).json()
    assert (reply["tasks"], reply["progress"]) == ([], {"answered": 0, "open": 0})


HALF = "\ud800"


@pytest.mark.parametrize(
    "wrong",
    [
        *({name: HALF} for name in ("id", "lease", "choice", "source", "rater", "question")),
        {"values": {HALF: 1.0}},
        {"values": {"": [HALF]}},
        {HALF: 1},
    ],
)
def test_half_a_character_is_refused_anywhere(site, wrong):
    browser, owner = site.rater("ann"), site.owner()
    body = answer_to(tasks(browser)[0]) | browser.page
    for path in ("next", "answers", "undo", "broken"):
        assert_refused(browser, f"/api/{path}", json.dumps(body | wrong))
    for path in ("login", "invite", "end", "pause", "retract"):
        sent = {"password": HALF, "rater": HALF, "answer": HALF}
        assert_refused(owner, f"/owner/{path}", json.dumps(sent))
    assert_refused(browser, "/enter", json.dumps({"token": HALF}))


@pytest.mark.parametrize("number", ["1e400", "-1e400", "9" * 400, "9" * 5000, "NaN", "Infinity"])
@pytest.mark.parametrize("field", ["seconds", "count", "values"])
def test_numbers_that_nobody_can_store(site, field, number):
    browser = site.rater("ann")
    body = json.dumps(answer_to(tasks(browser)[0]) | browser.page | {field: "here"})
    for path in ("next", "answers"):
        assert_refused(browser, f"/api/{path}", body.replace('"here"', number))
    assert site.rows() == ()


def assert_refused(browser, path, content):
    reply = browser.post(path, content=content, headers={"Content-Type": "application/json"})
    assert reply.status_code == 400, (path, reply.text)
    assert reply.json()["error"]


def test_half_a_character_in_a_comment_loses_no_answer(made):
    site = made(question=Question(comment=True))
    browser = site.rater("ann")
    content = json.dumps(answer_to(tasks(browser)[0], comment=f"fine {HALF}") | browser.page)
    assert browser.post("/api/answers", content=content, headers={"Content-Type": "application/json"}).is_success
    assert site.rows()[0].comment == "fine ?"


def test_the_owner_ends_the_sessions_of_a_rater(site):
    ann, owner = site.rater("ann"), site.owner()
    assert "End the sessions of ann" in owner.get("/owner").text
    assert owner.post("/owner/end", json={"rater": "eve"}).status_code == 404
    link = owner.post("/owner/end", json={"rater": "ann"}).json()["link"]
    assert ann.post("/api/next", json={"count": 1}).status_code == 401
    assert ann.post("/enter", data={"token": link.rsplit("/", 1)[1]}).status_code == 303
    assert len(tasks(ann)) == 2


@pytest.mark.parametrize(
    ("given", "origin", "host"),
    [
        ("https://rate.example.org:443/", "https://rate.example.org", "rate.example.org"),
        ("https://Rate.Example.org", "https://rate.example.org", "rate.example.org:443"),
        ("http://bücher.example:8080", "http://xn--bcher-kva.example:8080", "xn--bcher-kva.example:8080"),
    ],
)
def test_a_public_address_in_another_spelling(made, given, origin, host):
    site = made(public_url=given)
    browser = site.browser(origin)
    login = browser.post("/owner/login", data={"password": "open sesame"}, headers={"Host": host})
    assert login.status_code == 303
    assert browser.post("/owner/invite", json={"rater": "eve"}).json()["link"].startswith(f"{origin}/enter/")


@pytest.mark.parametrize(("error", "status"), [("database or disk is full", 507), ("disk I/O error", 503)])
def test_a_store_that_cannot_write(site, monkeypatch, error, status):
    browser = site.rater("ann")
    body = answer_to(tasks(browser)[0])

    def broken(*_):
        raise StoreError(error)

    with monkeypatch.context() as patch:
        patch.setattr(SQLiteStore, "put", broken)
        reply = browser.post("/api/answers", json=body)
        assert reply.status_code == status
        assert "Nothing is lost" in reply.json()["error"]
    assert browser.post("/api/answers", json=body).status_code == 200


def test_a_mistake_of_ours_tells_nothing_of_the_inside(site, monkeypatch, caplog):
    browser = site.rater("ann")
    monkeypatch.setattr(SQLiteStore, "lease", lambda *_: 1 / 0)
    reply = browser.post("/api/next", json={"count": 1})
    assert reply.status_code == 500
    assert "division" not in reply.text
    assert reply.headers["x-content-type-options"] == "nosniff"
    assert "ZeroDivisionError" in caplog.text


def test_clips_and_what_happens_when_one_is_missing(made):
    site = made(asked=[])
    names = [site.project.keep(f"picture {i}".encode(), "webp") for i in range(3)]
    clips = [clip_item(name, 4, 2, (8, 8)) for name in names]
    site.project.media(names[0]).write_bytes(b"changed")
    site.store.add_items(clips)
    site.store.ask([Request(i.id) for i in clips])
    browser = site.rater("ann")
    shown = tasks(browser)
    assert [t["item"]["sheet"] for t in shown] == names[1:], "what was changed is set aside"
    sheet = browser.get(f"/media/{names[1]}")
    assert sheet.content == b"picture 1"
    assert "immutable" in sheet.headers["cache-control"]
    site.project.media(names[1]).unlink()
    assert browser.get(f"/media/{names[1]}").status_code == 404
    assert [t["item"]["sheet"] for t in tasks(browser)] == names[2:]
    for wrong in ("x.webp", "..%2fproject.toml", names[0].replace("webp", "npz"), "0" * 64 + ".webp"):
        assert browser.get(f"/media/{wrong}").status_code == 404
    page = site.owner().get("/owner").text
    assert "2 items set aside" in page


def test_the_owners_page(site):
    raters = {name: site.rater(name) for name in ("ann", "bob")}
    given = {}
    for name, browser in raters.items():
        for k, task in enumerate(tasks(browser, 6)):
            body = answer_to(task, 1.0 if name == "ann" else k / 5, seconds=0.5 if name == "bob" else 4.0)
            given[name, task["item"]["id"]] = body["id"]
            assert browser.post("/api/answers", json=body).status_code == 200
    owner = site.owner()
    numbers = owner.get("/owner/overview").json()
    assert (numbers["answers"], numbers["items"], numbers["rated"]) == (12, 6, 6)
    ann, bob = numbers["raters"]
    assert (ann["name"], ann["coverage"], ann["seconds"], ann["quick"]) == ("ann", 1.0, pytest.approx(4.0), 0.0)
    assert (bob["quick"], bob["seconds"]) == (1.0, pytest.approx(0.5))
    assert [s["name"] for s in numbers["strata"]] == ["all"]
    disputed = owner.get("/owner/disputed").json()["disputed"]
    assert len(disputed) == 5
    assert disputed[0]["spread"] == max(d["spread"] for d in disputed)
    page = owner.get("/owner").text
    assert "&lt;script&gt;" in page or "\\u003cscript" in page
    assert "<script>alert" not in page
    answer = disputed[0]["said"][0]["id"]
    assert owner.post("/owner/retract", data={"answer": answer}).status_code == 303
    assert owner.get("/owner/overview").json()["answers"] == 11
    assert site.rows()[-1].source == "owner"
    assert owner.post("/owner/retract", json={"answer": answer}).status_code == 409
    assert owner.post("/owner/retract", json={"answer": "nothing"}).status_code == 404
    assert answer not in [t["lease"] for t in tasks(raters["ann"])]
    owner.post("/owner/logout")
    assert owner.get("/owner/overview").status_code == 401


def test_an_invitation_is_shown_once_and_works(site):
    owner = site.owner()
    page = owner.post("/owner/invite", data={"rater": "Eve <b>"})
    assert "Eve &lt;b&gt;" in page.text
    link = owner.post("/owner/invite", json={"rater": "eve"}).json()["link"]
    assert link.startswith(HERE)
    assert link.rsplit("/", 1)[1] not in owner.get("/owner").text
    browser = site.browser()
    assert browser.post("/enter", data={"token": link.rsplit("/", 1)[1]}).status_code == 303
    assert owner.post("/owner/invite", json={"rater": " "}).status_code == 400


def test_what_is_exported_is_what_was_answered(site):
    browser = site.rater("ann")
    for task in tasks(browser):
        browser.post("/api/answers", json=answer_to(task, 0.1))
    owner = site.owner()
    answers = site.store.answers()[0]
    contents = {i.id: i.content for i in TEXTS}
    for form, ending in (("csv", "csv"), ("jsonl", "jsonl"), ("label-studio", "label-studio.json")):
        reply = owner.get(f"/owner/export/project.{ending}")
        assert reply.content == export.write(answers, contents, form)
        assert reply.headers["content-disposition"] == f'attachment; filename="project.{ending}"'
    assert owner.get("/owner/export/parquet").content[:4] == b"PAR1"
    assert owner.get("/owner/export/nothing").status_code == 404
    assert owner.get("/owner/export/trl").status_code == 400, "there are no comparisons"


def test_every_page_and_error_is_whole(site):
    browser = site.browser()
    assert browser.get("/").headers["location"] == "/rate"
    missing = browser.get("/nothing")
    assert missing.status_code == 404
    assert "There is no such page." in missing.text
    assert browser.put("/api/next").status_code == 405
    assert browser.get("/api/next").json() == {"error": "Method Not Allowed"}


# --- serving ---------------------------------------------------------------------------------------------------------


def serving(folder, *raters, **settings):
    code = "import sys, json; from uard.collect.serving import serve; folder, *rest = sys.argv[1:]\n"
    code += "serve(folder, json.loads(rest[0]), **json.loads(rest[1]))"
    command = [sys.executable, "-u", "-c", code, str(folder), json.dumps(raters), json.dumps(settings)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def lines_until(process, word):
    lines = []
    for line in process.stdout:
        lines.append(line.strip())
        if word in line:
            return lines
    raise AssertionError((lines, process.stderr.read()))


def test_two_servers_a_port_in_use_and_a_clean_end(tmp_path):
    project = Project.create(tmp_path / "walk")
    with project.store() as store:
        store.add_items([*TEXTS, clip_item("0" * 64 + ".webp", 4, 2, (8, 8))])
    with serving(project.folder, "ann", "bob", port=0, owner_password="x") as first:
        try:
            lines = lines_until(first, "Ctrl-C")
            address = next(line.split(" ")[1] for line in lines if line.startswith("owner:")).removesuffix("/owner")
            assert sum("/enter/" in line for line in lines) == 2
            assert any("1 item is set aside" in line for line in lines)
            with pytest.raises(InvalidValueError, match=f"{address}, process {first.pid}"):
                serve(project.folder)
            port = int(address.rsplit(":", 1)[1])
            other = Project.create(tmp_path / "other")
            with pytest.raises(InvalidValueError, match="another program listens there"):
                serve(other.folder, port=port)
            first.send_signal(2)
            assert first.wait(20) == 0
            assert first.stderr.read() == ""
        finally:
            first.kill()


def test_another_host_needs_tls(tmp_path):
    project = Project.create(tmp_path / "walk")
    with pytest.raises(InvalidValueError, match=r"docs/guides/people\.md"):
        serve(project.folder, host="0.0.0.0")
    with pytest.raises(InvalidValueError, match="public_url"):
        serve(project.folder, host="0.0.0.0", public_url="rate.example.org")


@pytest.mark.skipif(sys.platform == "win32" or os.geteuid() == 0, reason="nothing is forbidden to this user")
def test_a_folder_that_cannot_be_written_to(tmp_path):
    project = Project.create(tmp_path / "walk")
    project.folder.chmod(0o500)
    try:
        with pytest.raises(InvalidValueError, match="in a folder that can be written to"):
            serve(project.folder, port=0)
    finally:
        project.folder.chmod(0o700)


def test_a_lock_that_cannot_be_opened_and_media_that_are_no_folder(tmp_path):
    project = Project.create(tmp_path / "walk")
    (project.folder / "serving.lock").mkdir()
    with pytest.raises(InvalidValueError, match="in a folder that can be written to"):
        serve(project.folder, port=0)
    (project.folder / "media").rmdir()
    (project.folder / "media").write_bytes(b"")
    with pytest.raises(InvalidValueError, match="must be a folder"):
        serve(project.folder, port=0)


def test_a_new_start_leaves_links_that_were_given_out_as_they_are(tmp_path):
    with Project.create(tmp_path / "walk").store() as store:
        first = dict(invite(store, ["ann", "bob"]))
        assert list(dict(invite(store, ["ann", "cat"]))) == ["cat"]
        assert store.enter(first["ann"])[0] == "ann"
        assert list(dict(invite(store, [], new_links=True))) == ["ann", "bob", "cat"]


def test_many_raters_at_once(made):
    site = made(items=[text_item("2 + 2?", str(i)) for i in range(60)])
    site.store.ask([Request(i.id) for i in site.store.items()[0] for _ in range(6)])
    browsers = []
    for k in range(8):
        site.store.invite(f"rater {k}")
        browsers.append(site.rater(f"rater {k}"))
    acknowledged, wrong = [], []

    def rate(browser):
        try:
            while shown := tasks(browser, 3):
                for task in shown:
                    body = answer_to(task, 0.0)
                    acknowledged.append(browser.post("/api/answers", json=body).json()["stored"])
        except Exception as error:
            wrong.append(error)

    threads = [threading.Thread(target=rate, args=(b,)) for b in browsers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []
    assert sorted(acknowledged) == sorted(r.id for r in site.rows())
    assert len(acknowledged) == len(set(acknowledged)) == 480
    assert len({(r.item, r.rater) for r in site.rows()}) == 480, "nobody was asked twice"
