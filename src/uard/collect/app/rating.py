"""A rater's routes: the link, the page, what comes next, answers, and what is taken back."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, RedirectResponse, Response
from starlette.routing import Route

from uard.collect.app.memory import part_name
from uard.collect.app.overview import QUICK, worth
from uard.collect.app.pages import page
from uard.collect.app.security import RATER
from uard.collect.app.site import Site, body_of, rater_of
from uard.collect.items import Item
from uard.collect.project import Known
from uard.collect.store import Lease, LinkUsedError
from uard.ratings.table import LONGEST_COMMENT, Answer

MOST_TASKS = 20  # at once
LONGEST_SECONDS = 86_400.0
COOKIE_SECONDS = 90 * 86_400.0
SOURCES = ("page", "simulated")
_CLIENT_ID = re.compile(r"[0-9A-Za-z-]{8,64}")
_SHEET = re.compile(r"[0-9a-f]{64}\.webp")
_CHOICES = {"pairs": ("left", "right", "tie", "cannot tell", "skip"), "thumbs": ("up", "down", "skip")}


@dataclass(frozen=True)
class _Place:
    """What an answer is about."""

    item: Item
    kind: str
    left: str | None
    lease: str | None  # that the store knows
    earlier: tuple[Answer, ...] = ()  # that it takes the place of
    stored: tuple[Answer, ...] = ()  # what is there already under its name


class RaterRoutes:
    """The routes of raters."""

    def __init__(self, site: Site):
        """Make them for a site."""
        self._site = site

    def routes(self) -> list[Route]:
        """Return them."""
        return [
            Route("/", self.home),
            Route("/enter/{token}", self.entrance),
            Route("/enter", self.enter, methods=["POST"]),
            Route("/rate", self.page),
            Route("/api/next", self.next, methods=["POST"]),
            Route("/api/answers", self.answer, methods=["POST"]),
            Route("/api/undo", self.undo, methods=["POST"]),
            Route("/media/{name}", self.media),
        ]

    def home(self, request: Request) -> Response:
        """Lead to the page."""
        return RedirectResponse("/rate", 303)

    def entrance(self, request: Request) -> Response:
        """Show a page with a button: whoever only looks at a link (a mail program's preview) must not use it up."""
        return page("enter.html.j2", token=request.path_params["token"], project=self._site.name)

    def enter(self, request: Request) -> Response:
        """Exchange a link's secret for a cookie."""
        token = body_of(request).get("token")
        if not isinstance(token, str):
            raise HTTPException(400, "The link is not whole.")
        response = RedirectResponse("/rate", 303)
        try:
            _, cookie = self._site.store.enter(token)
        except LinkUsedError:
            if request.scope["uard.rater"] is not None:  # by this very browser, most likely
                return response
            raise
        self._site.sessions.forget()
        self._site.set_cookie(response, RATER, cookie, COOKIE_SECONDS)
        return response

    def page(self, request: Request) -> Response:
        """Show the page."""
        site, question, rater = self._site, self._site.question, rater_of(request)
        examples: list[dict[str, Any]] = []
        for known in question.examples:
            item = site.items.find(known.item)
            if item is not None and item.id not in site.items.aside():
                examples.append({"item": site.whole(item), "value": known.value, "why": known.why})
        told = ("kind", "low", "high", "stars", "levels", "unit", "attributes", "break_after", "show_reward")
        config: dict[str, Any] = {name: getattr(question, name) for name in told}
        project = hashlib.sha256(str(site.project.folder.resolve()).encode()).hexdigest()[:12]
        told_before = hashlib.sha256(f"{question.question} {question.instructions}".encode()).hexdigest()[:12]
        config |= {"rater": rater, "project": project, "instructions": told_before}
        return page("rate.html.j2", question=question, config=config, examples=examples, project=site.name, rater=rater)

    def next(self, request: Request) -> Response:
        """Hand out what the rater should see next; first what she was handed before."""
        site, rater = self._site, rater_of(request)
        count = body_of(request).get("count", 2)
        if not isinstance(count, int) or isinstance(count, bool) or not 1 <= count <= MOST_TASKS:
            raise HTTPException(400, f"count = {count!r}: must be a whole number in [1, {MOST_TASKS}].")
        paused = site.sessions.paused(rater)
        leases: tuple[Lease, ...] = ()
        if not paused:
            site.items.refresh()
            leases = site.store.lease(rater, count, site.items.aside())
            if len(leases) < count and site.top_up is not None:
                site.top_up(rater, count - len(leases))
                site.items.refresh()  # pairs are made when they are asked for
                leases = site.store.lease(rater, count, site.items.aside())
        site.leases.keep(leases)
        site.book.refresh()
        progress = {"answered": site.book.answered(rater), "open": self._open(rater)}
        return JSONResponse({"tasks": [self._task(x) for x in leases], "progress": progress, "paused": paused})

    def _open(self, rater: str) -> int:
        """Return of how many items the rater may still be asked: those that too few have rated, and not she."""
        done = self._site.book.full(self._site.question.overlap) | self._site.book.rated(rater)
        return max(self._site.items.number(self._site.question.kind == "pairs") - len(done), 0)

    def _task(self, lease: Lease) -> dict[str, Any]:
        site, item = self._site, lease.item
        task: dict[str, Any] = {"lease": lease.id, "kind": "practice" if lease.kind == "practice" else "rating"}
        task["item"] = site.shown(item)
        if item.kind == "pair":
            task["sides"] = sides = _sides(item, lease.left)
            for side, name in zip(("left", "right"), sides, strict=True):
                part = site.items.find(name)
                task[side] = None if part is None else site.shown(part)
        return task

    def answer(self, request: Request) -> Response:
        """Store what the rater said; the same again has the same reply."""
        site, rater, body = self._site, rater_of(request), body_of(request)
        name = _client_id(body.get("id"))
        place = self._place(rater, body, name)
        said = self._said(body, place.item)
        now, seconds = site.clock(), _seconds(body.get("seconds"))
        source = body.get("source", SOURCES[0])
        if source not in SOURCES:
            raise HTTPException(400, f"source = {source!r}: must be one of {', '.join(SOURCES)}.")
        left, right = _sides(place.item, place.left) if place.item.kind == "pair" else (None, None)
        earlier = {a.attribute: a.id for a in place.earlier}
        rows = [
            Answer(
                part_name(name, k),
                place.item.id,
                rater,
                value,
                choice,
                attribute=attribute,
                scale=site.question.scale,
                left=left,
                right=right,
                shown_at=max(now - seconds, 0.0),
                given_at=now,
                source=source,
                kind=place.kind,
                supersedes=earlier.get(attribute),
                comment="" if attribute else self._comment(body),
            )
            for k, (attribute, value, choice) in enumerate(said)
        ]
        rows += _left_over(rows, place.earlier)
        stored = site.store.put(rows, place.lease)
        held = site.leases.find(str(place.lease))
        if held is not None:
            held.answer = name
        return JSONResponse({"stored": name} | self._reply(stored[0], place.item))

    def _place(self, rater: str, body: Mapping[str, Any], name: str) -> _Place:
        """Return what an answer is about, by its lease, or else by the item that it names."""
        site, lease = self._site, str(body.get("lease"))
        held = site.leases.find(lease)
        if held is not None and held.rater != rater:
            raise HTTPException(403, "This was shown to another rater.")
        if held is not None and held.answer is None:
            return _Place(self._item(held.item), held.kind, held.left, lease)
        site.book.refresh()
        stored = site.book.given(name)
        if stored:  # sent again: it is told as it was told before, or the store says that it differs
            first = stored[0]
            if first.rater != rater:
                raise HTTPException(409, "There is another answer of this name.")
            before = tuple(a for row in stored if row.supersedes for a in site.book.given(row.supersedes)[:1])
            known = lease if held is not None else None
            return _Place(self._item(first.item), first.kind, first.left, known, before, stored)
        if held is not None:  # in another tab of the same browser, say: what was said last stands
            before = tuple(a for a in site.book.given(str(held.answer)) if site.book.stands(a.id))
            return _Place(self._item(held.item), held.kind, held.left, lease, before)
        return self._place_without_lease(rater, body)

    def _place_without_lease(self, rater: str, body: Mapping[str, Any]) -> _Place:
        """Return what an answer is about whose lease nobody remembers: nothing that was said is lost for that."""
        site = self._site
        item = self._item(body.get("item"))
        others = site.items.all().keys() - {item.id}
        for lease in site.store.lease(rater, 1, others):  # what she holds, or what is still open for her
            site.leases.keep([lease])
            left = lease.left
            if lease.id != body.get("lease") and item.kind == "pair":
                left = self._left(item, body)
            return _Place(item, lease.kind, left, lease.id)
        left = self._left(item, body) if item.kind == "pair" else None
        site.book.refresh()
        if item.id in site.book.rated(rater):
            return _Place(item, "repeat", left, None)
        kinds = [kind for kind in ("gold", "practice") if site.question.known(item.id, kind) is not None]
        return _Place(item, kinds[0] if kinds else "rating", left, None)

    def _item(self, name: object) -> Item:
        item = self._site.items.find(str(name))
        if item is None:
            raise HTTPException(404, "This answer names neither a lease of yours nor an item that is known here.")
        return item

    @staticmethod
    def _left(item: Item, body: Mapping[str, Any]) -> str:
        sides = (body.get("left"), body.get("right"))
        for one in (item.content["left"], item.content["right"]):
            if sides == tuple(_sides(item, one)):
                return str(one)
        raise HTTPException(400, "left and right must name the two items as they stood on the screen.")

    def _said(self, body: Mapping[str, Any], item: Item) -> list[tuple[str, float | None, str | None]]:
        """Return attribute, value and choice of each thing that was answered."""
        question, values, choice = self._site.question, body.get("values"), body.get("choice")
        allowed = _CHOICES.get(question.kind, ("skip",))
        if choice is not None:
            if choice not in allowed or values is not None:
                raise HTTPException(400, f"choice = {choice!r}: must be one of {', '.join(allowed)}, without values.")
            if (item.kind == "pair") != (question.kind == "pairs"):
                raise HTTPException(400, f"This question is not asked about a {item.kind}.")
            thumbs = {"up": question.high, "down": question.low} if question.kind == "thumbs" else {}
            return [("", thumbs.get(str(choice)), str(choice))]
        names = ("", *question.attributes)
        if question.kind in _CHOICES or not isinstance(values, dict) or set(cast("Any", values)) != set(names):
            wanted = "a choice" if question.kind in _CHOICES else f"values for {', '.join(map(repr, names))}"
            raise HTTPException(400, f"The answer must hold {wanted}, or the choice to skip.")
        return [(name, self._value(name, cast("Any", values)[name]), None) for name in names]

    def _value(self, name: str, value: object) -> float:
        question = self._site.question
        if isinstance(value, int | float) and not isinstance(value, bool):
            if question.kind == "stars":
                nearest = min(question.levels, key=lambda level: abs(level - value))
                if abs(nearest - value) <= 1e-9 * (question.high - question.low):
                    return nearest
            elif question.low <= value <= question.high:
                return float(value)
        allowed = f"in [{question.low:g}, {question.high:g}]"
        if question.kind == "stars":
            allowed = f"one of {', '.join(f'{level:g}' for level in question.levels)}"
        raise HTTPException(400, f"values[{name!r}] = {value!r}: must be {allowed}.")

    def _comment(self, body: Mapping[str, Any]) -> str:
        comment = body.get("comment") or ""
        if not isinstance(comment, str) or len(comment) > LONGEST_COMMENT:
            raise HTTPException(400, f"A comment may have {LONGEST_COMMENT} characters.")
        comment = comment.encode("utf-8", "replace").decode().strip()  # half a surrogate pair cannot be stored
        if comment and not self._site.question.comment:
            raise HTTPException(400, "This project asks for no comments.")
        return comment

    def _reply(self, answer: Answer, item: Item) -> dict[str, Any]:
        """Return what the rater is told, a function of the stored answer alone."""
        seconds = answer.given_at - answer.shown_at
        note = None
        if seconds < QUICK and answer.choice != "skip":
            note = f"That took {seconds:.1f} seconds. If it was a slip, Undo (u) takes it back."
        known = self._site.question.known(item.id, "practice") if answer.kind == "practice" else None
        value = worth(answer, item)
        feedback = None if known is None or value is None else self._feedback(known, value, answer)
        return {"feedback": feedback, "note": note}

    def _feedback(self, known: Known, value: float, answer: Answer) -> dict[str, Any]:
        right = abs(value - known.value) <= known.tolerance + 1e-9
        expected = None
        if self._site.question.kind == "thumbs":
            expected = "up" if known.value > 0.5 else "down"
        elif self._site.question.kind == "pairs":
            first_is_left = answer.left is not None and answer.right is not None and answer.left < answer.right
            expected = "tie" if known.value == 0.5 else "left" if (known.value > 0.5) == first_is_left else "right"
        return {"right": right, "value": known.value, "choice": expected, "why": known.why}

    def undo(self, request: Request) -> Response:
        """Take an answer back, and hand out its item again."""
        site, rater, body = self._site, rater_of(request), body_of(request)
        name, of = _client_id(body.get("id")), _client_id(body.get("answer"))
        before = site.book.given(of)
        if not before or before[0].rater != rater:
            raise HTTPException(404, "You have given no such answer.")
        site.store.put(taken_back(before, name, source="page", now=site.clock()))
        others = site.items.all().keys() - {before[0].item}
        leases = () if site.sessions.paused(rater) else site.store.lease(rater, 1, others)
        site.leases.keep(leases)
        return JSONResponse({"stored": name, "task": self._task(leases[0]) if leases else None})

    def media(self, request: Request) -> Response:
        """Send a clip's sheet; its name is made of its content, so that a browser may keep it for ever."""
        site, name = self._site, str(request.path_params["name"])
        if request.scope["uard.rater"] is None and not request.scope["uard.owner"]:
            raise HTTPException(401, "Clips are shown to raters only. Open your personal link.")
        if not _SHEET.fullmatch(name):
            raise HTTPException(404, "There is no such clip.")
        path = site.project.media(name)
        if not path.is_file():
            site.items.missing(name)
            raise HTTPException(404, "The file of this clip is missing.")
        return FileResponse(path, headers={"Cache-Control": "private, max-age=31536000, immutable"})


def taken_back(before: Sequence[Answer], name: str, *, source: str, now: float) -> list[Answer]:
    """Return the answers that take back all that was said in one go.

    Examples:
        >>> [a.supersedes for a in taken_back([Answer("a1", "x", "ann", 1.0)], "b1", source="owner", now=0.0)]
        ['a1']

    Args:
        before: What was said.
        name: Of the first new answer.
        source: Where it is taken back.
        now: Seconds since 1970.
    """
    times = {"shown_at": now, "given_at": now}
    empty = {"value": None, "choice": None, "comment": "", "source": source} | times
    return [replace(a, id=part_name(name, k), supersedes=a.id, **empty) for k, a in enumerate(before)]


def _left_over(rows: Sequence[Answer], earlier: Sequence[Answer]) -> list[Answer]:
    """Return answers that take back what was said earlier of things of which nothing is said now."""
    first, told = rows[0], {row.attribute for row in rows}
    silent = [a for a in earlier if a.attribute not in told and a.said is not None]
    again = taken_back(silent, first.id, source=first.source, now=first.given_at)
    return [replace(a, id=part_name(first.id, len(rows) + k)) for k, a in enumerate(again)]


def _sides(item: Item, left: str | None) -> list[str]:
    """Return the names of a pair's items as they stand on the screen."""
    one, other = str(item.content["left"]), str(item.content["right"])
    return [other, one] if left == other else [one, other]


def _client_id(value: object) -> str:
    if not isinstance(value, str) or not _CLIENT_ID.fullmatch(value):
        raise HTTPException(400, "Every answer needs an id of its own, 8 to 64 letters and digits.")
    return value


def _seconds(value: object) -> float:
    """Return how long it took; a clock that jumps, or nonsense, makes no answer void."""
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        return 0.0
    return min(max(float(value), 0.0), LONGEST_SECONDS)
