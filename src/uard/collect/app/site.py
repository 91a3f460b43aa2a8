"""What all routes share: the project, its store, what is kept in memory, and how a request is read."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import Any, cast
from urllib.parse import parse_qsl

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response

from uard.collect.app.memory import Book, Catalogue
from uard.collect.app.security import Cookies, OwnerDoor, Sessions
from uard.collect.items import Item
from uard.collect.project import Project, Question
from uard.collect.store import AnswerStore

LARGEST = 1e300  # of a number in a request
SHOWN = ("kind", "sheet", "frames", "columns", "width", "height", "fps", "prompt", "completion")
"""What raters are told of an item: neither which policy acted nor what stands in its file of numbers."""


@dataclass(frozen=True)
class Site:
    """A project that is being served.

    Attributes:
        project: Its folder and question.
        store: Its answers.
        items: Its items.
        book: Its answers, as far as they were read.
        sessions: Of raters.
        owner: The owner's password.
        cookies: Their names.
        public_url: The origin that raters see, if it is another than the server's own.
        top_up: Called with a rater, a number and the items that she is not to be asked about, when there is less to
            rate than was asked for.
        clock: Seconds since 1970.
    """

    project: Project
    store: AnswerStore
    items: Catalogue
    book: Book
    sessions: Sessions
    owner: OwnerDoor
    cookies: Cookies
    public_url: str | None
    top_up: Callable[[str, int, Collection[str]], None] | None
    clock: Callable[[], float] = time.time

    @property
    def question(self) -> Question:
        """What raters are asked."""
        return self.project.question

    @property
    def name(self) -> str:
        """What the project is called on its pages."""
        return self.project.folder.resolve().name

    def shown(self, item: Item) -> dict[str, Any]:
        """Return what raters are told of an item."""
        names = (*SHOWN, "reward") if self.question.show_reward else SHOWN
        content = {name: item.content[name] for name in names if name in item.content}
        return content | {"id": item.id}

    def whole(self, item: Item) -> dict[str, Any]:
        """Return what raters are told of an item, and of both items of a pair."""
        content = self.shown(item)
        if item.kind == "pair":
            for side in ("left", "right"):
                part = self.items.find(str(item.content[side]))
                content[side] = None if part is None else self.shown(part)
        return content

    def set_cookie(self, response: Response, name: str, value: str, seconds: float) -> None:
        """Give a browser a cookie that programs on the page cannot read and other sites do not send."""
        secure = (self.public_url or "").startswith("https:")
        response.set_cookie(
            name, value, max_age=int(seconds), path="/", httponly=True, samesite="strict", secure=secure
        )


class PageError(HTTPException):
    """What a page must do something about itself: it belongs to another rater, or asks another question.

    Attributes:
        why: ``rater`` or ``question``.
    """

    def __init__(self, why: str, sentence: str):
        """Make it a conflict."""
        super().__init__(409, sentence)
        self.why = why


def rater_of(request: Request) -> str:
    """Return who asks."""
    rater = request.scope["uard.rater"]
    if rater is None:
        raise HTTPException(401, "This page needs your personal link. Open it, or ask for a new one.")
    return str(rater)


def from_page(request: Request) -> tuple[str, dict[str, Any]]:
    """Return who asks, and what her page has sent; a page of another rater in the same browser speaks for nobody."""
    rater, body = rater_of(request), body_of(request)
    named = body.get("rater")
    if not isinstance(named, str):
        raise HTTPException(400, "The request must name the rater whose page it comes from.")
    if named != rater:
        raise PageError(
            "rater",
            f"This page is {named}'s, and this browser is now {rater}'s. Nothing was stored under another name; "
            f"open a link of {named}'s here again, or close this page.",
        )
    return rater, body


def body_of(request: Request) -> dict[str, Any]:
    """Return what was sent: a JSON object, or the fields of a form, of text and numbers that can be stored."""
    sent = cast("bytes", request.scope["uard.body"])
    if request.headers.get("content-type", "").startswith("application/x-www-form-urlencoded"):
        return dict(parse_qsl(sent.decode("utf-8", "replace")))
    try:
        body: Any = json.loads(sent, parse_constant=_no_number)
        if isinstance(body, dict) and isinstance(comment := cast("Any", body).get("comment"), str):
            body["comment"] = comment.encode(
                "utf-8", "replace"
            ).decode()  # what she wrote is not lost for half an emoji
        _check(cast("object", body))
    except ValueError:  # that is no JSON, or no UTF-8
        raise HTTPException(400, "The request is no JSON.") from None
    except RecursionError:
        raise HTTPException(400, "The request is nested too deeply.") from None
    if not isinstance(body, dict):
        raise HTTPException(400, "The request must be a JSON object.")
    return cast("dict[str, Any]", body)


def _check(value: object) -> None:
    """Refuse what JSON can write and nobody can store: half a character, numbers that are infinite or too long."""
    if isinstance(value, str) and not _is_whole(value):
        raise HTTPException(400, "The request holds half a character (an unpaired surrogate).")
    if isinstance(value, int | float) and not abs(value) <= LARGEST:
        raise HTTPException(400, "The request holds a number that is too large.")
    if isinstance(value, dict):
        _check_all(cast("dict[str, object]", value).keys())
        _check_all(cast("dict[str, object]", value).values())
    elif isinstance(value, list):
        _check_all(cast("list[object]", value))


def _check_all(values: Iterable[object]) -> None:
    for value in values:
        _check(value)


def _is_whole(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _no_number(name: str) -> float:
    raise ValueError(name)
