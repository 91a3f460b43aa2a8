"""A rater's routes: the link, the page, what comes next, answers, what is taken back, and what cannot be shown."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from typing import Any

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, RedirectResponse, Response
from starlette.routing import Route

from uard.collect.app.overview import QUICK, worth
from uard.collect.app.pages import page
from uard.collect.app.said import client_id, comment_of, said, seconds_of, sides, source_of
from uard.collect.app.site import PageError, Site, body_of, from_page, rater_of
from uard.collect.items import Item
from uard.collect.project import Known
from uard.collect.store import Lease, LinkUsedError, part_name, taken_back
from uard.ratings.table import Answer

MOST_TASKS = 20  # at once
COOKIE_SECONDS = 90 * 86_400.0
_SHEET = re.compile(r"[0-9a-f]{64}\.webp")


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
            Route("/api/broken", self.broken, methods=["POST"]),
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
        self._site.set_cookie(response, self._site.cookies.rater, cookie, COOKIE_SECONDS)
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
        told_before = hashlib.sha256(f"{question.question} {question.instructions}".encode()).hexdigest()[:12]
        config |= {"rater": rater, "project": site.store.identity, "question": question.identity}
        config |= {"instructions": told_before}
        return page("rate.html.j2", question=question, config=config, examples=examples, project=site.name, rater=rater)

    def next(self, request: Request) -> Response:
        """Hand out what the rater should see next; first what she was handed before."""
        site, (rater, body) = self._site, from_page(request)
        self._same_question(body)
        count = body.get("count", 2)
        if not isinstance(count, int) or isinstance(count, bool) or not 1 <= count <= MOST_TASKS:
            raise HTTPException(400, f"count = {count!r}: must be a whole number in [1, {MOST_TASKS}].")
        paused = site.sessions.paused(rater)
        leases: tuple[Lease, ...] = () if paused else self._lease(rater, count)
        site.book.refresh()
        still = self._open(rater)
        if not paused and len(leases) < count:  # that is all there is, whatever others still hold
            still = sum(lease.kind != "practice" for lease in leases)
        progress = {"answered": site.book.answered(rater), "open": still}
        return JSONResponse({"tasks": [self._task(x) for x in leases], "progress": progress, "paused": paused})

    def _lease(self, rater: str, count: int) -> tuple[Lease, ...]:
        site = self._site
        site.items.refresh()
        without = site.items.aside(rater)
        leases = site.store.lease(rater, count, without)
        if len(leases) < count and site.top_up is not None:
            site.top_up(rater, count - len(leases), without)
            site.items.refresh()  # pairs are made when they are asked for
            leases = site.store.lease(rater, count, site.items.aside(rater))
        return leases

    def _same_question(self, body: Mapping[str, Any]) -> None:
        """Refuse a page that asks what is not asked any more: what is chosen there would mean something else here."""
        if not isinstance(body.get("question"), str):
            raise HTTPException(400, "The request must name the question that its page asks.")
        if body["question"] != self._site.question.identity:
            raise PageError(
                "question", "The owner has changed the question since this page was opened. Nothing was stored."
            )

    def _open(self, rater: str) -> int:
        """Return about how many items the rater may still be asked: those that too few have rated, and not she."""
        site = self._site
        done, aside = site.book.rated(rater), site.items.aside(rater)
        gold = {known.item for known in site.question.gold} - done - aside
        return len(site.items.earnest() - site.book.full(site.question.overlap) - done - aside) + len(gold)

    def _task(self, lease: Lease) -> dict[str, Any]:
        site, item = self._site, lease.item
        task: dict[str, Any] = {"lease": lease.id, "kind": "practice" if lease.kind == "practice" else "rating"}
        task["item"] = site.shown(item)
        if item.kind == "pair":
            task["sides"] = names = sides(item, lease.left)
            for side, name in zip(("left", "right"), names, strict=True):
                part = site.items.find(name)
                task[side] = None if part is None else site.shown(part)
        return task

    def answer(self, request: Request) -> Response:
        """Store what the rater said; the same again has the same reply."""
        site, (rater, body) = self._site, from_page(request)
        name, lease = client_id(body.get("id")), self._leased(rater, body)
        if body.get("question") != site.question.identity:
            before = site.book.given(name)  # perhaps it was stored before the question was changed, and not heard
            if before and (before[0].rater, before[0].item) == (rater, lease.item.id):
                return JSONResponse({"stored": name} | self._reply(before[0], lease.item))
        self._same_question(body)
        now, seconds = site.clock(), seconds_of(body.get("seconds"))
        left, right = sides(lease.item, lease.left) if lease.item.kind == "pair" else (None, None)
        rows = [
            Answer(
                part_name(name, k),
                lease.item.id,
                rater,
                value,
                choice,
                attribute=attribute,
                scale=site.question.scale,
                left=left,
                right=right,
                shown_at=max(now - seconds, 0.0),
                given_at=now,
                source=source_of(body),
                kind=lease.kind,
                comment="" if attribute else comment_of(site.question, body),
            )
            for k, (attribute, value, choice) in enumerate(said(site.question, body, lease.item))
        ]
        stored = site.store.put(rows, lease.id)
        return JSONResponse({"stored": name} | self._reply(stored[0], lease.item))

    def _leased(self, rater: str, body: Mapping[str, Any]) -> Lease:
        """Return what the rater was shown, however long ago."""
        lease = self._site.store.leased(str(body.get("lease")))
        if lease is None:
            raise HTTPException(404, "This answers nothing that was shown to anybody here.")
        if lease.rater != rater:
            raise HTTPException(403, "This was shown to another rater.")
        return lease

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
        site, (rater, body) = self._site, from_page(request)
        name, of = client_id(body.get("id")), client_id(body.get("answer"))
        before = site.book.given(of)
        if not before or before[0].rater != rater:
            raise HTTPException(404, "You have given no such answer.")
        site.store.put(taken_back(before, name, source="page", now=site.clock()))
        others = site.items.all().keys() - {before[0].item}
        leases = () if site.sessions.paused(rater) else site.store.lease(rater, 1, others)
        return JSONResponse({"stored": name, "task": self._task(leases[0]) if leases else None})

    def broken(self, request: Request) -> Response:
        """Hear that a browser cannot show an item, or one of a pair, and show it no more to its rater."""
        site, (rater, body) = self._site, from_page(request)
        item = self._leased(rater, body).item
        parts = [item.id, *(sides(item, None) if item.kind == "pair" else [])]
        name = body.get("item", item.id)
        if name not in parts:
            raise HTTPException(404, "This item was not shown under this lease.")
        site.items.report(str(name), rater)
        return JSONResponse({})

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
