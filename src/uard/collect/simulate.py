"""A simulated panel that answers at the page: through the same HTTP interface as the browsers of people.

So the whole loop can be tried, and measured, without anybody: links, sessions, leases, answers that are sent again.
"""

from __future__ import annotations

import hashlib
import http.client
import json
import socket
import threading
import time
import urllib.parse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np

from uard import _checks
from uard.collect.project import Project, Question
from uard.collect.store import AnswerStore
from uard.ratings.panels import Panel, RatingLaw, draw

Content = Mapping[str, Any]
LawOf = Callable[[Content], RatingLaw]
"""Content of an item -> how each of the panel's raters answers it."""

PATIENCE = 60.0  # seconds to wait for a server that does not answer
AGAIN = (500, 503, 507)  # what a server says that may be able to do it later
NEAR = 1e-9  # between two items of a pair: a tie


class RefusedError(RuntimeError):
    """The server has refused a request; the message says why."""


def law_by_reward(panel: Panel) -> LawOf:
    """Return the law of a panel for items of which nothing but the observed reward is known: it is taken for true.

    Examples:
        >>> from uard.ratings.panels import PANELS
        >>> law_by_reward(PANELS["single"])({"reward": 0.5}).centre.tolist()
        [0.5]
    """

    def law(content: Content) -> RatingLaw:
        reward = np.float64(content.get("reward") or 0.0)
        return panel.law(reward, reward, np.bool_(False))

    return law


class Visitor:
    """One rater's browser, as far as the server can tell; not for several threads at once.

    Attributes:
        seconds: How long the server took for each answer that it acknowledged.
    """

    def __init__(self, url: str, patience: float = PATIENCE):
        """Point to a server, which need not be there yet.

        Args:
            url: Such as ``http://127.0.0.1:8321``.
            patience: Seconds to try again where there is no answer.

        Raises:
            InvalidValueError: it is no address of a server.
        """
        parts = urllib.parse.urlsplit(url)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise _checks.InvalidValueError("url", url, "an address such as http://127.0.0.1:8321")
        self._parts, self._patience = parts, patience
        self._cookie = ""
        self._connection: http.client.HTTPConnection | None = None
        self.seconds: list[float] = []

    def enter(self, token: str) -> None:
        """Use a rater's link.

        Raises:
            RefusedError: it was used before.
        """
        form = urllib.parse.urlencode({"token": token}).encode()
        status, headers, body = self._send("POST", "/enter", form, "application/x-www-form-urlencoded")
        cookie = headers.get("Set-Cookie", "")
        if status != 303 or not cookie:
            raise RefusedError(f"the link was refused ({status}): {body.decode(errors='replace')[:200]}")
        self._cookie = cookie.partition(";")[0]

    def ask(self, path: str, data: Mapping[str, Any]) -> dict[str, Any]:
        """Send JSON to the server, and again until it answers; return what it says.

        Raises:
            RefusedError: it refuses.
        """
        body = json.dumps(data).encode()
        deadline = time.monotonic() + self._patience
        while True:
            status, headers, answer = self._send("POST", path, body, "application/json")
            if status == 200:
                return cast("dict[str, Any]", json.loads(answer))
            if status not in (*AGAIN, 429) or time.monotonic() > deadline:
                raise RefusedError(f"{path}: {status} {answer.decode(errors='replace')[:300]}")
            time.sleep(float(headers.get("Retry-After", 0.2)))

    def answer(self, data: Mapping[str, Any]) -> dict[str, Any]:
        """Send an answer; see ``ask``."""
        began = time.perf_counter()
        said = self.ask("/api/answers", data)
        self.seconds.append(time.perf_counter() - began)
        return said

    def _send(self, method: str, path: str, body: bytes, kind: str) -> tuple[int, http.client.HTTPMessage, bytes]:
        origin = f"{self._parts.scheme}://{self._parts.netloc}"
        headers = {"Content-Type": kind, "Origin": origin, "Cookie": self._cookie}
        deadline = time.monotonic() + self._patience
        while True:
            try:
                if self._connection is None:
                    self._connection = self._connected()
                self._connection.request(method, path, body, headers)
                response = self._connection.getresponse()
                return response.status, response.headers, response.read()
            except (OSError, http.client.HTTPException):
                self.close()  # it was ended, or never was: the same request again is the same answer
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.05)

    def _connected(self) -> http.client.HTTPConnection:
        secure = self._parts.scheme == "https"
        kind = http.client.HTTPSConnection if secure else http.client.HTTPConnection
        made = kind(str(self._parts.hostname), self._parts.port, timeout=30)
        made.connect()
        made.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return made

    def close(self) -> None:
        """End the connection."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None


@dataclass
class Report:
    """What a simulated panel did.

    Attributes:
        acknowledged: Names of the answers that the server said it has, by rater.
        seconds: How long it took to acknowledge each.
        errors: What went wrong, by rater.
    """

    acknowledged: dict[str, list[str]] = field(default_factory=lambda: {})
    seconds: list[float] = field(default_factory=lambda: [])
    errors: dict[str, str] = field(default_factory=lambda: {})


@dataclass(frozen=True)
class Simulation:
    """A panel's raters as visitors of a page.

    Attributes:
        url: Of the server.
        links: Secret of each rater's link by her name, in the panel's order.
        project: What the page serves. Raters are not told what the environment paid; the panel's law reads it here.
        law_of: How the panel rates an item.
        seed: Of what raters draw.
        pause: Seconds between two answers of a rater.
        idle: Seconds without anything to rate after which a rater leaves.
        most: Answers after which she leaves; none if left out.
    """

    url: str
    links: Mapping[str, str]
    project: Project
    law_of: LawOf
    seed: int = 0
    pause: float = 0.0
    idle: float = 2.0
    most: int | None = None

    def run(self, stop: threading.Event | None = None) -> Report:
        """Let all raters answer, each in a thread, until nothing is left to rate.

        Args:
            stop: Set it to send them all home.
        """
        report, lock = Report(), threading.Lock()
        stop = stop or threading.Event()
        store = self.project.store()
        known = _Contents(store)

        def work(place: int, name: str) -> None:
            visitor = Visitor(self.url)
            done: list[str] = []
            try:
                visitor.enter(self.links[name])
                self._visit(visitor, known, place, name, done, stop)
            except Exception as error:  # one rater's trouble is reported, and does not end the others
                report.errors[name] = f"{type(error).__name__}: {error}"
            finally:
                visitor.close()
            with lock:
                report.acknowledged[name] = done
                report.seconds += visitor.seconds

        threads = [threading.Thread(target=work, args=(i, n), daemon=True) for i, n in enumerate(self.links)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        store.close()
        return report

    def _visit(
        self, visitor: Visitor, known: _Contents, place: int, name: str, done: list[str], stop: threading.Event
    ) -> None:
        page = {"rater": name, "question": self.project.question.identity}
        last = time.monotonic()
        while not stop.is_set() and (self.most is None or len(done) < self.most):
            tasks = visitor.ask("/api/next", page | {"count": 2})["tasks"]
            if not tasks:
                if time.monotonic() - last > self.idle:
                    return
                time.sleep(min(0.2, self.idle / 4 + 0.01))
                continue
            for task in tasks[: None if self.most is None else self.most - len(done)]:
                random = self._random(task, name)
                sides = task.get("sides") or [task["item"]["id"]]
                said = self.said([known[x] for x in sides], place, random)
                answer = page | {"id": self._id(task, name), "lease": task["lease"]} | said
                answer |= {"comment": "", "seconds": 1.0}
                done.append(visitor.answer(answer)["stored"])
                last = time.monotonic()
                if self.pause:
                    stop.wait(self.pause)

    def said(self, sides: Sequence[Content], place: int, random: np.random.Generator) -> dict[str, Any]:
        """Return what the panel's rater at a place says of an item, or of a pair.

        Args:
            sides: Content of the item, or of what stands on the left and on the right.
            place: Of the rater in the panel, from 0.
            random: What she draws from.
        """
        question = self.project.question
        values = [self._value(content, place, random) for content in sides]
        if any(value is None for value in values):
            return {"values": None, "choice": "cannot tell" if question.kind == "pairs" else "skip"}
        value, *other = cast("list[float]", values)
        if question.kind == "pairs":
            tie = abs(value - other[0]) <= NEAR
            return {"values": None, "choice": "tie" if tie else "left" if value > other[0] else "right"}
        if question.kind == "thumbs":
            return {"values": None, "choice": "up" if value > (question.low + question.high) / 2 else "down"}
        return {"values": {name: value for name in ("", *question.attributes)}, "choice": None}

    def _value(self, content: Content, place: int, random: np.random.Generator) -> float | None:
        drawn = draw(self.law_of(content), random)[place]
        if np.isnan(drawn):
            return None
        return nearest(float(drawn), self.project.question)

    def _random(self, task: Mapping[str, Any], name: str) -> np.random.Generator:
        return np.random.default_rng(list(hashlib.sha256(f"{self.seed} {name} {task['lease']}".encode()).digest()))

    def _id(self, task: Mapping[str, Any], name: str) -> str:
        return hashlib.sha256(f"{name} {task['lease']}".encode()).hexdigest()[:32]


class _Contents:
    """What is in items, read from a store as they come."""

    def __init__(self, store: AnswerStore):
        self._store, self._known, self._place = store, dict[str, Content](), 0
        self._lock = threading.Lock()

    def __getitem__(self, name: str) -> Content:
        with self._lock:
            if name not in self._known:
                items, self._place = self._store.items(self._place)
                self._known |= {item.id: item.content for item in items}
            return self._known[name]


def nearest(value: float, question: Question) -> float:
    """Return what comes nearest to a value of what can be answered.

    Examples:
        >>> nearest(0.7, Question(low=-1.0, high=1.0)), nearest(0.7, Question(kind="stars", low=0.0, high=2.0, stars=3))
        (0.7, 1.0)
    """
    if question.kind == "stars":
        return min(question.levels, key=lambda level: abs(level - value))
    return float(np.clip(value, question.low, question.high))
