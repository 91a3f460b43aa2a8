"""The owner's routes: numbers, disputed items, raters' links and pauses, answers that do not count, files."""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response
from starlette.routing import Route

from uard.collect.app.overview import Disputed, Overview, overview
from uard.collect.app.pages import page, wants_json
from uard.collect.app.security import OWNER_SECONDS
from uard.collect.app.site import Site, body_of
from uard.collect.store import taken_back
from uard.ratings import export

AGE = 5.0  # seconds for which the numbers may be old while answers come in
FILES = {  # form -> ending, what the page calls it, content type
    "csv": ("csv", "Long table, CSV", "text/csv; charset=utf-8"),
    "jsonl": ("jsonl", "Long table, JSON Lines", "application/jsonl"),
    "parquet": ("parquet", "Long table, Parquet", "application/vnd.apache.parquet"),
    "trl": ("trl.jsonl", "Preference rows for TRL", "application/jsonl"),
    "label-studio": ("label-studio.json", "Label Studio", "application/json"),
    "record": ("record.jsonl", "Whole record, with what was taken back", "application/jsonl"),
}


class OwnerRoutes:
    """The routes of the owner."""

    def __init__(self, site: Site):
        """Make them for a site."""
        self._site = site
        self._lock = threading.Lock()
        self._seen: tuple[int, float, object, Overview] | None = None

    def routes(self) -> list[Route]:
        """Return them."""
        return [
            Route("/owner", self.page),
            Route("/owner/login", self.login, methods=["POST"]),
            Route("/owner/logout", self.logout, methods=["POST"]),
            Route("/owner/overview", self.numbers),
            Route("/owner/disputed", self.disputed),
            Route("/owner/invite", self.invite, methods=["POST"]),
            Route("/owner/end", self.end, methods=["POST"]),
            Route("/owner/pause", self.pause, methods=["POST"]),
            Route("/owner/retract", self.retract, methods=["POST"]),
            Route("/owner/export/{name}", self.export),
        ]

    def page(self, request: Request) -> Response:
        """Show the numbers; the form to log in to whoever has not."""
        if not request.scope["uard.owner"]:
            return page("login.html.j2", project=self._site.name, wrong=False)
        return self._page()

    def _page(self, link: tuple[str, str] | None = None) -> Response:
        site, seen = self._site, self._overview()
        states = {r.name: r for r in site.store.raters()}
        files = {f"{site.name}.{FILES[form][0]}": FILES[form][1] for form in export.FORMS if form in FILES}
        return page(
            "owner.html.j2",
            project=site.name,
            question=site.question,
            seen=seen,
            states=states,
            aside=site.items.wrong(),
            reported=site.items.reported(),
            files=files,
            disputed=[self._told(d) for d in seen.disputed],
            link=link,
            when=_when,
            said=_said,
        )

    def _overview(self) -> Overview:
        """Return the numbers; those of a moment ago, if they are being asked for all the time."""
        site = self._site
        with self._lock:
            answers, raters, now = site.book.all(), site.store.raters(), time.monotonic()
            aside = site.items.wrong()
            others = raters, aside
            if self._seen is not None:
                number, at, who, seen = self._seen
                if who == others and (number == len(answers) or now - at < AGE):
                    return seen
            names = [r.name for r in raters]
            seen = overview(answers, site.items.all(), site.question, names, without=aside)
            self._seen = len(answers), time.monotonic(), others, seen
            return seen

    async def login(self, request: Request) -> Response:
        """Exchange the password for a cookie."""
        cookie = await self._site.owner.enter_in_turn(str(body_of(request).get("password", "")))
        if cookie is None:
            if wants_json(request.scope):
                raise HTTPException(403, "This is not the owner's password.")
            return page("login.html.j2", 403, project=self._site.name, wrong=True)
        response = RedirectResponse("/owner", 303)
        self._site.set_cookie(response, self._site.cookies.owner, cookie, OWNER_SECONDS)
        return response

    def logout(self, request: Request) -> Response:
        """Forget the owner's cookie."""
        name = self._site.cookies.owner
        self._site.owner.leave(request.cookies.get(name))
        response = RedirectResponse("/owner", 303)
        response.delete_cookie(name, path="/")
        return response

    def numbers(self, request: Request) -> Response:
        """Send the numbers as JSON."""
        _only_the_owner(request)
        data = asdict(self._overview())
        data.pop("disputed")
        return JSONResponse(_plain(data))

    def disputed(self, request: Request) -> Response:
        """Send the disputed items as JSON."""
        _only_the_owner(request)
        return JSONResponse({"disputed": [self._told(d) for d in self._overview().disputed]})

    def _told(self, disputed: Disputed) -> dict[str, Any]:
        fields = ("id", "rater", "value", "choice", "comment")
        said = [{name: getattr(answer, name) for name in fields} for answer in disputed.said]
        first = disputed.item.content.get("left")
        for row, answer in zip(said, disputed.said, strict=True):  # as they stand on this page
            if answer.choice in ("left", "right"):
                preferred = answer.left if answer.choice == "left" else answer.right
                row["choice"] = "left" if preferred == first else "right"
        item = self._site.whole(disputed.item)
        more = {"stratum": disputed.item.stratum, "reward": disputed.item.reward}
        return {"item": item, "spread": disputed.spread, "said": said} | more

    def invite(self, request: Request) -> Response:
        """Make a rater's link, which is shown once."""
        _only_the_owner(request)
        return self._invited(request, str(body_of(request).get("rater", "")).strip(), end_sessions=False)

    def end(self, request: Request) -> Response:
        """Forget all browsers of a rater, and make her a new link."""
        _only_the_owner(request)
        rater = str(body_of(request).get("rater", ""))
        if rater not in {r.name for r in self._site.store.raters()}:
            raise HTTPException(404, "There is no such rater.")
        return self._invited(request, rater, end_sessions=True)

    def _invited(self, request: Request, rater: str, end_sessions: bool) -> Response:
        site = self._site
        link = f"{self._origin(request)}/enter/{site.store.invite(rater, end_sessions=end_sessions)}"
        site.sessions.forget()
        if wants_json(request.scope):
            return JSONResponse({"rater": rater, "link": link})
        return self._page((rater, link))

    def _origin(self, request: Request) -> str:
        return self._site.public_url or f"http://{request.headers['host']}"

    def pause(self, request: Request) -> Response:
        """Show a rater nothing more, or go on."""
        _only_the_owner(request)
        body = body_of(request)
        paused = body.get("paused")
        self._site.store.pause(str(body.get("rater", "")), paused is True or paused == "yes")
        self._site.sessions.forget()
        return self._done(request)

    def retract(self, request: Request) -> Response:
        """Let an answer count no more; it stays in the record."""
        _only_the_owner(request)
        site = self._site
        before = site.book.given(str(body_of(request).get("answer", "")))
        if not before:
            raise HTTPException(404, "There is no such answer.")
        site.store.put(taken_back(before, secrets.token_hex(16), source="owner", now=site.clock()))
        self._seen = None
        return self._done(request)

    @staticmethod
    def _done(request: Request) -> Response:
        return JSONResponse({}) if wants_json(request.scope) else RedirectResponse("/owner", 303)

    def export(self, request: Request) -> Response:
        """Send the answers as a file."""
        _only_the_owner(request)
        name = str(request.path_params["name"]).removeprefix(f"{self._site.name}.")
        forms = {ending: form for form, (ending, _, _) in FILES.items() if form in export.FORMS}
        form = forms.get(name, name)
        if form not in FILES:
            raise HTTPException(404, f"There is no such file; there are {', '.join(forms)}.")
        contents = {item.id: item.content for item in self._site.items.all().values()}
        data = export.write(self._site.book.all(), contents, form)
        ending, _, kind = FILES[form]
        return Response(data, media_type=kind, headers=_as_file(f"{self._site.name}.{ending}"))


def _as_file(name: str) -> dict[str, str]:
    plain = "".join(x if x.isascii() and (x.isalnum() or x in "-_.") else "_" for x in name)
    return {"Content-Disposition": f'attachment; filename="{plain}"'}


def _only_the_owner(request: Request) -> None:
    if not request.scope["uard.owner"]:
        raise HTTPException(401, "Only the owner may do this; log in at /owner.")


def _when(seconds: float | None) -> str:
    return "" if seconds is None else f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M} UTC"


def _said(answer: Mapping[str, Any]) -> str:
    return str(answer["choice"]) if answer["choice"] is not None else f"{answer['value']:.3g}"


def _plain(value: Any) -> Any:
    """Return numbers that JSON knows: NaN is None."""
    if isinstance(value, dict):
        return {name: _plain(x) for name, x in value.items()}  # pyright: ignore[reportUnknownVariableType]
    if isinstance(value, list | tuple):
        return [_plain(x) for x in value]  # pyright: ignore[reportUnknownVariableType]
    return None if isinstance(value, float) and value != value else value
