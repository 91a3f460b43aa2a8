"""The store of items, raters, requests and answers: nothing acknowledged is lost, nothing is there twice."""

import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from uard._checks import InvalidValueError, UnknownNameError
from uard.collect.items import clip_item, item_of, pair_item, text_item
from uard.collect.sqlite import SQLiteStore
from uard.collect.store import LEASE_SECONDS, ConflictError, LinkUsedError, Request, StoreError, hashed, taken_back
from uard.ratings.table import LATEST, Answer

ITEMS = [text_item("2 + 2?", str(i)) for i in range(6)]
X, Y, *_ = (item.id for item in ITEMS)


class Clock:
    """Time that a test sets."""

    def __init__(self):
        self.now = 1e9

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def store(tmp_path, clock):
    with SQLiteStore(tmp_path / "answers.sqlite", clock=clock) as opened:
        opened.add_items(ITEMS)
        for name in ("ann", "bob"):
            opened.invite(name)
        yield opened


def said(name, item=X, rater="ann", value=1.0, **more):
    return Answer(name, item, rater, value, **more)


def test_items_are_named_by_their_content(store):
    assert store.add_items([text_item("2 + 2?", "0"), text_item("2 + 2?", "new")]) == 1
    found, last = store.items()
    assert [i.id for i in found[:6]] == [i.id for i in ITEMS]
    assert store.items(last) == ((), last)
    assert item_of(ITEMS[0].as_json) == ITEMS[0]


def test_a_link_works_once_and_only_hashes_are_stored(store):
    secret = store.invite("ann")
    name, session = store.enter(secret)
    assert name == "ann"
    assert [r.sessions for r in store.raters()] == [frozenset({hashed(session)}), frozenset()]
    for used in (secret, "never given out"):
        with pytest.raises(LinkUsedError, match="ask for a new one"):
            store.enter(used)
    for file in store.path.parent.iterdir():
        assert secret.encode() not in file.read_bytes()
        assert session.encode() not in file.read_bytes()


def test_a_new_link_makes_the_old_one_void_and_keeps_sessions(store):
    first, second = store.invite("ann"), store.invite("ann")
    with pytest.raises(LinkUsedError):
        store.enter(first)
    store.enter(second)
    store.enter(store.invite("ann"))
    assert len(store.raters()[0].sessions) == 2


def test_what_is_asked_is_leased_to_one_rater_at_a_time(store, clock):
    store.ask([Request(X), Request(X), Request(Y)])
    (first,) = store.lease("ann")
    assert (first.item.id, first.rater) == (X, "ann")
    assert store.lease("ann") == (first,)  # a page that is loaded again shows the same
    two = store.lease("ann", 3)
    assert [x.item.id for x in two] == [X, Y]  # not the other request for the same item
    assert [x.item.id for x in store.lease("bob", 3)] == [X]
    clock.now += LEASE_SECONDS + 1
    assert [x.item.id for x in store.lease("bob", 3)] == [X, Y]


def test_a_clock_that_jumps_back_holds_nothing_for_ever(store, clock):
    store.ask([Request(X)])
    assert store.lease("ann")
    clock.now -= 1e6
    assert [x.item.id for x in store.lease("bob")] == [X]


def test_practice_comes_first_and_requests_to_a_name_before_others(store):
    store.ask(
        [Request(ITEMS[0].id, priority=9.0), Request(ITEMS[1].id, "ann"), Request(ITEMS[2].id, "ann", "practice", 99.0)]
    )
    assert [x.item.id for x in store.lease("ann", 3)] == [ITEMS[i].id for i in (2, 1, 0)]


def test_what_she_has_rated_is_shown_again_as_a_repeat_only(store):
    store.ask([Request(X), Request(X)])
    (lease,) = store.lease("ann")
    store.put([said("a1")], lease.id)
    assert store.lease("ann") == ()
    store.ask([Request(X, "ann", "repeat")])
    assert [x.kind for x in store.lease("ann")] == ["repeat"]


def test_items_whose_files_are_missing_are_not_shown(store):
    store.ask([Request(X), Request(Y)])
    assert [x.item.id for x in store.lease("ann", without=[X])] == [Y]
    assert [x.item.id for x in store.lease("bob", 2)] == [X]


def test_the_sides_of_a_pair_are_drawn_and_remembered(store):
    pairs = [pair_item(ITEMS[i].id, ITEMS[j].id) for i in range(6) for j in range(i)]
    store.add_items(pairs)
    store.ask([Request(pair.id) for pair in pairs])
    leases = store.lease("ann", len(pairs))
    flipped = [lease.left != lease.item.content["left"] for lease in leases]
    assert 0 < sum(flipped) < len(pairs)  # all alike once in 16 384 times
    assert store.lease("ann", len(pairs)) == leases


def test_an_answer_sent_twice_is_stored_once(store, clock):
    store.ask([Request(X)])
    (lease,) = store.lease("ann")
    first = store.put([said("a1", given_at=1.0)], lease.id)
    again = store.put([said("a1", given_at=2.0)], lease.id)
    assert first == again
    assert len(store.answers()[0]) == 1
    with pytest.raises(ConflictError, match="another answer is stored as 'a1'"):
        store.put([said("a1", value=0.5)])
    assert len(store.answers()[0]) == 1


def test_all_or_nothing_of_what_is_given_in_one_go(store):
    with pytest.raises(ConflictError, match="no item 'unknown'"):
        store.put([said("a1"), said("a2", item="unknown")])
    assert len(store.answers()[0]) == 0
    with pytest.raises(ConflictError, match="no rater 'eve'"):
        store.put([said("a1", rater="eve")])
    with pytest.raises(InvalidValueError, match="at least one"):
        store.put([])


def test_an_answer_that_is_taken_back_stays_and_its_item_comes_again(store):
    store.ask([Request(X), Request(Y)])
    lease, _ = store.lease("ann", 2)
    store.put([said("a1"), said("a1.1", attribute="safe")], lease.id)
    store.put([Answer("u1", X, "ann", supersedes="a1"), Answer("u1.1", X, "ann", attribute="safe", supersedes="a1.1")])
    answers, _ = store.answers()
    assert (len(answers), answers.standing()) == (4, ())
    assert store.lease("ann") == (lease,)
    with pytest.raises(ConflictError, match="taken back before"):
        store.put([Answer("u2", X, "ann", supersedes="a1")])
    with pytest.raises(ConflictError, match="has given no answer"):
        store.put([Answer("u3", X, "bob", supersedes="u1")])


def test_of_several_answers_to_one_lease_the_last_stands_alone(store):
    store.ask([Request(X), Request(Y, "ann", "gold")])
    one, other = store.lease("ann", 2)
    lease = one if one.item.id == X else other
    wrong = []

    def tell(k):
        try:
            with SQLiteStore(store.path) as own:
                own.put([said(f"a{k}", value=float(k), kind="repeat"), said(f"a{k}.1", attribute="safe")], lease.id)
        except Exception as error:
            wrong.append(error)

    threads = [threading.Thread(target=tell, args=(k,)) for k in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []
    answers, _ = store.answers()
    assert [(a.attribute, a.kind) for a in answers.standing()] == [("", "rating"), ("safe", "rating")]
    assert len({a.supersedes for a in answers}) == 11, "each takes the place of the one before it"
    store.put([Answer("s1", X, "ann", choice="skip")], lease.id)
    answers, _ = store.answers()
    assert [a.id for a in answers.standing()] == ["s1"], "nothing is said any more of what was rated beside it"
    again = store.put([Answer("s1", X, "ann", choice="skip")], lease.id)
    assert again[0].supersedes is not None
    assert store.answers()[0] == answers
    store.put([Answer("u1", X, "ann", supersedes="s1")])
    assert lease.id in [x.id for x in store.lease("ann", 2)], "what is taken back comes again, whichever tab said it"
    store.put([said("b1")], lease.id)
    assert [a.id for a in store.answers()[0].standing()] == ["b1"]


def test_a_lease_is_known_for_ever_and_to_its_rater_only(store, clock):
    pair = pair_item(X, Y)
    store.add_items([pair])
    store.ask([Request(pair.id)])
    (first,) = store.lease("ann")
    clock.now += 2 * LEASE_SECONDS
    (second,) = store.lease("bob")
    with SQLiteStore(store.path) as opened:
        found = opened.leased(first.id)
        assert (found.rater, found.item, found.left, found.kind) == ("ann", pair, first.left, "rating")
        assert opened.leased(second.id) == second
        assert opened.leased("never") is None
    for name, lease in (("ann", second.id), ("ann", "never")):
        with pytest.raises(ConflictError, match="was not shown this item"):
            store.put([Answer("p1", pair.id, name, choice="cannot tell")], lease)
    with pytest.raises(ConflictError, match="was not shown this item"):
        store.put([said("p1")], first.id)
    assert len(store.answers()[0]) == 0


def test_a_store_has_an_identity_that_a_copy_keeps(store, tmp_path):
    with SQLiteStore(tmp_path / "other.sqlite") as other, SQLiteStore(store.path) as again:
        assert store.identity == again.identity != other.identity
    store.close()
    (tmp_path / "copy.sqlite").write_bytes(store.path.read_bytes())
    with SQLiteStore(tmp_path / "copy.sqlite") as copy:
        assert copy.identity == store.identity


def test_sessions_end_when_the_owner_says_so(store):
    store.enter(store.invite("ann"))
    store.enter(store.invite("bob"))
    store.enter(store.invite("ann", end_sessions=True))
    assert [len(r.sessions) for r in store.raters()] == [1, 1]


@pytest.mark.skipif(sys.platform == "win32", reason="no such modes")
def test_the_file_is_for_its_owner_only(store):
    store.put([said("a1")])
    for file in store.path.parent.iterdir():
        assert file.stat().st_mode & 0o077 == 0, file


@pytest.mark.parametrize("content", ["{", "[]", "null", '{"kind": "picture"}', "[" * 100_000])
def test_an_item_that_is_none_is_named(store, content):
    with sqlite3.connect(store.path) as db:
        db.execute("UPDATE items SET content = ? WHERE seq = 2", (content,))
    db.close()
    with pytest.raises(StoreError, match="is damaged: what stands there as item 2 is none"):
        store.items()
    store.ask([Request(Y)])
    with pytest.raises(StoreError, match="is damaged"):
        store.lease("ann")


def test_what_the_owner_takes_back_is_not_asked_again(store):
    store.ask([Request(X)])
    (lease,) = store.lease("ann")
    store.put([said("a1")], lease.id)
    store.put([Answer("o1", X, "ann", supersedes="a1", source="owner")])
    assert store.lease("ann") == ()


def test_a_time_that_no_calendar_has_stops_nobody(store):
    store.put([said("a1")])
    with sqlite3.connect(store.path) as db:
        db.execute("UPDATE answers SET given_at = 1e12")
    (answer,), _ = store.answers()
    assert answer.given_at == LATEST


def test_a_late_answer_counts(store, clock):
    store.ask([Request(X)])
    (late,) = store.lease("ann")
    clock.now += 2 * LEASE_SECONDS
    (taken,) = store.lease("bob")
    store.put([said("b1", rater="bob")], taken.id)
    store.put([said("a1")], late.id)
    assert [a.rater for a in store.answers()[0]] == ["bob", "ann"]


def test_a_late_answer_to_what_was_passed_on_can_be_corrected(store, clock):
    store.ask([Request(X, "ann")])
    (lease,) = store.lease("ann")
    assert store.pass_on("bob", 1) == 0
    clock.now += LEASE_SECONDS + 1
    assert store.pass_on("bob", 1, without={X}) == 0
    assert store.pass_on("bob", 1) == 1
    assert store.lease("ann") == ()
    (answer,) = store.put([said("a1", given_at=clock.now)], lease.id)
    assert store.pass_on("ann", 1) == 0
    store.put(taken_back([answer], "b1", source="page", now=clock.now))
    (again,) = store.lease("ann")
    assert (again.item.id, again.id == lease.id) == (X, False)
    store.put([said("a2", value=0.5)], again.id)
    assert [lease.item.id for lease in store.lease("bob")] == [X]
    assert store.lease("ann") == ()


def test_requests_name_what_is_there(store):
    with pytest.raises(ConflictError, match="no item"):
        store.ask([Request(X), Request("nothing")])
    with pytest.raises(ConflictError, match="no rater"):
        store.ask([Request(X, "eve")])
    assert store.lease("ann") == ()
    with pytest.raises(InvalidValueError, match="a rater's name"):
        Request(X, kind="repeat")


def test_raters_pause(store):
    store.pause("ann", True)
    assert [r.paused for r in store.raters()] == [True, False]
    with pytest.raises(UnknownNameError, match="did you mean 'bob'"):
        store.pause("bop", True)


@pytest.mark.parametrize("name", ["", " ann", "a\tb", "x" * 201, "\u202e"])
def test_names_that_cannot_be_shown_are_refused(store, name):
    with pytest.raises(InvalidValueError, match="rater"):
        store.invite(name)


def test_a_store_of_another_version_is_left_as_it_is(tmp_path):
    file = tmp_path / "answers.sqlite"
    SQLiteStore(file).close()
    for version, age in ((0, "an older"), (99, "a newer")):
        with sqlite3.connect(file) as db:
            db.execute(f"PRAGMA user_version = {version}")
        db.close()
        with pytest.raises(StoreError, match=f"of version {version}, made by {age} uard"):
            SQLiteStore(file)
    other = tmp_path / "other.sqlite"
    with sqlite3.connect(other) as db:
        db.execute("CREATE TABLE letters (a)")
    db.close()
    with pytest.raises(StoreError, match="something else"):
        SQLiteStore(other)
    (tmp_path / "no.sqlite").write_text("not a database " * 100)
    with pytest.raises(StoreError, match="not a database"):
        SQLiteStore(tmp_path / "no.sqlite")
    with pytest.raises(StoreError, match="unable to open"):
        SQLiteStore(tmp_path / "nowhere" / "answers.sqlite")


def test_a_full_disk_loses_nothing_that_was_acknowledged(store):
    connection = store._connection()
    pages = connection.execute("PRAGMA page_count").fetchone()[0]
    connection.execute(f"PRAGMA max_page_count = {pages + 4}")
    stored = []

    def fill():
        for i in range(10_000):
            stored.extend(store.put([said(f"a{i}", comment="x" * 500)]))

    with pytest.raises(StoreError, match="full"):
        fill()
    assert store.answers()[0].rows == tuple(stored)
    connection.execute("PRAGMA max_page_count = 1000000")
    store.put([said("later")])  # it goes on when there is room again
    assert len(store.answers()[0]) == len(stored) + 1


def test_threads_share_a_store(store):
    store.ask([Request(item.id) for item in ITEMS for _ in range(4)])
    names = [f"r{i}" for i in range(4)]
    for name in names:
        store.invite(name)
    errors = []

    def work(name):
        try:
            while leases := store.lease(name):
                for lease in leases:
                    store.put([said(f"{name}-{lease.item.id}", lease.item.id, name)], lease.id)
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=work, args=(name,)) for name in names]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert errors == []
    answers, _ = store.answers()
    assert {(a.rater, a.item) for a in answers} == {(n, i.id) for n in names for i in ITEMS}
    assert len(answers) == 24


WRITER = """
import sys
from uard.collect.sqlite import SQLiteStore
from uard.ratings.table import LATEST, Answer
file, rater, item = sys.argv[1:]
store = SQLiteStore(file)
for i in range(100_000):
    (kept,) = store.put([Answer(f"{rater}-{i}", item, rater, float(i))])
    print(kept.id, flush=True)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_two_processes_killed_at_any_moment_lose_no_acknowledged_answer(store):
    acknowledged = set()
    for name in ("ann", "bob", "ann-again", "bob-again"):
        store.invite(name)
    for names in (("ann", "bob"), ("ann-again", "bob-again")):
        command = [sys.executable, "-c", WRITER, str(store.path)]
        writers = [subprocess.Popen([*command, name, X], stdout=subprocess.PIPE, text=True) for name in names]
        for writer in writers:
            acknowledged.add(writer.stdout.readline().strip())
        time.sleep(0.3)
        for writer in writers:
            os.kill(writer.pid, signal.SIGKILL)
        for writer in writers:
            out, _ = writer.communicate()
            acknowledged.update(out.rpartition("\n")[0].split())
    kept = [a.id for a in store.answers()[0]]
    assert len(acknowledged) > 20
    assert len(kept) == len(set(kept))
    assert acknowledged <= set(kept)
    assert len(set(kept) - acknowledged) <= 4  # stored when the process was killed, and not yet said
    with sqlite3.connect(store.path) as db:
        assert db.execute("PRAGMA integrity_check").fetchone()[0] == "ok"
    db.close()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: text_item("p", " "), "completion"),
        (lambda: text_item("p", "x" * 100_001), "len\\(completion\\) = 100001"),
        (lambda: text_item("p", "x", reward=float("nan")), "reward = nan"),
        (lambda: text_item("p", "x", stratum="\ud800"), "stratum"),
        (lambda: text_item("p", "x", stratum="x" * 201), "stratum"),
        (lambda: pair_item(X, X), "another item"),
        (lambda: pair_item("x", "y"), "32 hexadecimal digits"),
        (lambda: clip_item("../../secret.webp", 1, 1, (8, 8)), "sheet"),
        (lambda: clip_item("0" * 64 + ".webp", 0, 1, (8, 8)), "frames = 0"),
        (lambda: clip_item("0" * 64 + ".webp", 1, 1, (8, 8), fps=0.0), "fps"),
    ],
)
def test_bad_items_are_refused_by_name(make, message):
    with pytest.raises(InvalidValueError, match=message):
        make()


def test_nothing_is_read_before_a_file_is_there(tmp_path):
    assert not Path(tmp_path / "answers.sqlite").exists()
    with SQLiteStore(tmp_path / "answers.sqlite") as store:
        assert store.items() == ((), 0)
        assert store.answers()[1] == 0


@pytest.mark.parametrize("killed", [False, True])
def test_an_archive_is_read_and_never_changed(tmp_path, monkeypatch, killed):
    home, archive = tmp_path / "home #1?", tmp_path / "archive #1?"  # which mean something in an address
    home.mkdir()
    with SQLiteStore(home / "answers.sqlite") as store:
        store.add_items(ITEMS)
        store.invite("ann")
        store.put([said("a1")])
        if killed:  # its last answers are in the log beside the database
            shutil.copytree(home, archive)
    if not killed:
        shutil.copytree(home, archive)
    before = {path.name: path.read_bytes() for path in archive.iterdir() if not path.name.endswith("-shm")}
    assert ("answers.sqlite-wal" in before) == killed
    monkeypatch.setattr("uard.collect.schema.os.access", lambda path, mode: mode != os.W_OK)
    with SQLiteStore(archive / "answers.sqlite") as store:
        assert store.read_only
        assert [a.id for a in store.answers()[0]] == ["a1"]
        assert len(store.items()[0]) == len(ITEMS)
        for change in (lambda: store.invite("bob"), lambda: store.put([said("a2", Y)]), lambda: store.lease("ann")):
            with pytest.raises(StoreError, match=r"cannot be changed: .* write-protected\. Copy"):
                change()
    assert {path.name: path.read_bytes() for path in archive.iterdir() if not path.name.endswith("-shm")} == before
