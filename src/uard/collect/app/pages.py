"""Templates of the pages, and errors as a page or as JSON, whichever was asked for."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any, cast

import jinja2
from starlette.datastructures import Headers
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.types import Scope

HERE = Path(__file__).parent
STATIC = HERE / "static"
TITLES = {
    400: "That cannot be read",
    401: "You are not logged in",
    403: "That is not allowed",
    404: "There is nothing here",
    405: "That is not done here",
    409: "That is there already",
    413: "That is too much",
    429: "Too fast",
    503: "Not now",
    507: "The disk is full",
}


def render(name: str, **values: Any) -> str:
    """Return a template's text with its places filled in; text is escaped, a name that nobody gave is an error."""
    return _environment().get_template(name).render(**values)


@cache
def _environment() -> jinja2.Environment:
    loader = jinja2.FileSystemLoader(HERE / "templates")
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    environment.trim_blocks = environment.lstrip_blocks = True
    cast("dict[str, Any]", environment.globals).update(short=short, percent=percent)  # pyright: ignore[reportUnknownMemberType]
    return environment


def short(value: Any) -> str:
    """Return a number or an estimate with its interval in few digits; nothing for None.

    Examples:
        >>> short(0.123456), short(None), short(12)
        ('0.123', '', '12')
    """
    if value is None:
        return ""
    return str(value) if isinstance(value, str | int) else format(value, "z.3g")


def percent(share: float | None) -> str:
    """Return a share in percent; nothing for None.

    Examples:
        >>> percent(0.25), percent(None)
        ('25%', '')
    """
    return "" if share is None else f"{share:.0%}"


def page(name: str, status: int = 200, **values: Any) -> HTMLResponse:
    """Return a template as an answer.

    Forms on a page need ``same-origin``: with ``no-referrer`` a browser sends ``Origin: null`` with them.
    """
    return HTMLResponse(render(name, **values), status, {"Referrer-Policy": "same-origin"})


def refusal(
    scope: Scope, status: int, sentence: str, headers: dict[str, str] | None = None, why: str | None = None
) -> Response:
    """Return an error as JSON for programs, with a word for those that can do something, and as a page for people."""
    if wants_json(scope):
        return JSONResponse({"error": sentence} | ({"why": why} if why else {}), status, headers)
    title = TITLES.get(status, "Something went wrong")
    html = render("message.html.j2", title=title, sentence=sentence)
    return HTMLResponse(html, status, headers)


def wants_json(scope: Scope) -> bool:
    """Whether a program asks."""
    headers = Headers(scope=scope)
    return str(scope["path"]).startswith("/api") or "application/json" in (
        headers.get("content-type", "") + headers.get("accept", "")
    )
