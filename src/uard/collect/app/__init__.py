"""The pages on which people rate, and the owner's page: a Starlette application (extra ``uard[collect]``)."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import cast

try:
    from starlette.applications import Starlette
    from starlette.exceptions import HTTPException
    from starlette.middleware import Middleware
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.routing import Mount
    from starlette.staticfiles import StaticFiles
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"the page for raters needs Starlette and Jinja2: pip install 'uard[collect]' ({error})", name=error.name
    ) from None

from uard._checks import InvalidValueError
from uard.collect.address import origin_of
from uard.collect.app.memory import Book, Catalogue
from uard.collect.app.owner import OwnerRoutes
from uard.collect.app.pages import STATIC, refusal
from uard.collect.app.rating import RaterRoutes
from uard.collect.app.security import Cookies, Guard, OwnerDoor, Sessions, trouble
from uard.collect.app.site import PageError, Site
from uard.collect.project import Project
from uard.collect.store import AnswerStore, ConflictError, LinkUsedError, StoreError

__all__ = ["create_app"]


def create_app(
    project: Project,
    store: AnswerStore,
    *,
    owner_password: str,
    public_url: str | None = None,
    top_up: Callable[[str, int, Collection[str]], None] | None = None,
) -> Starlette:
    """Return the application that serves a project.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder, Project.create(folder).store() as store:
        ...     app = create_app(Project.open(folder), store, owner_password="open sesame")
        ...     len(app.routes)
        20

    Args:
        project: Its folder and question.
        store: Its answers.
        owner_password: For the page ``/owner``.
        public_url: The address that raters see, such as ``https://rate.example.org``, where another server stands
            before this one; without it only names of this machine are answered to.
        top_up: Called with a rater's name, a number and the names of items that she is not to be asked about, when
            there is less for her to rate than her page asks for, so that more can be requested.

    Raises:
        InvalidValueError: the password is empty, or the address is none.
        StoreError: the store cannot be read.
    """
    public = None if public_url is None else origin_of(public_url)
    sessions, owner, cookies = Sessions(store), OwnerDoor(owner_password), Cookies.of(store.identity)
    site = Site(project, store, Catalogue(project, store), Book(store), sessions, owner, cookies, public, top_up)
    guard = Middleware(Guard, sessions=sessions, owner=owner, cookies=cookies, public_url=public)
    static = Mount("/static", StaticFiles(directory=STATIC), name="static")
    return Starlette(
        routes=[*RaterRoutes(site).routes(), *OwnerRoutes(site).routes(), static],
        middleware=[guard],
        exception_handlers={
            HTTPException: _http,
            StoreError: _store,
            ConflictError: _conflict,
            LinkUsedError: _used,
            InvalidValueError: _invalid,
        },
    )


async def _http(request: Request, error: Exception) -> Response:
    known = cast("HTTPException", error)
    sentence = "There is no such page." if known.detail == "Not Found" else known.detail
    why = known.why if isinstance(known, PageError) else None
    return refusal(request.scope, known.status_code, sentence, dict(known.headers or {}), why)


async def _store(request: Request, error: Exception) -> Response:
    return refusal(request.scope, *trouble(cast("StoreError", error)), {"Retry-After": "5"})


async def _conflict(request: Request, error: Exception) -> Response:
    return refusal(request.scope, 409, str(error))


async def _used(request: Request, error: Exception) -> Response:
    return refusal(request.scope, 403, str(error))


async def _invalid(request: Request, error: Exception) -> Response:
    return refusal(request.scope, 400, str(error))
