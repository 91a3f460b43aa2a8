"""What stands before every route: who may ask, from where, how much and how often; and what browsers are told."""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import logging
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable
from http.cookies import CookieError, SimpleCookie
from typing import NamedTuple
from urllib.parse import urlsplit

from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from uard import _checks
from uard.collect.address import PORTS, origin_of
from uard.collect.app.pages import refusal
from uard.collect.store import AnswerStore, StoreError, hashed

MOST_BYTES = 64 * 1024  # of a request's body
BODY_SECONDS = 30.0  # in which it must have arrived
FRESH = 0.5  # seconds for which the list of raters may be old; the owner's own changes act at once
OWNER_SECONDS = 12 * 3600.0  # until the owner logs in again
PER_SESSION = (200.0, 400.0)  # requests per second, and at once: as fast as any rater or simulated one
PER_ADDRESS = (20.0, 400.0)  # of those without a session: fifty raters who open their links in one moment
WRONG_LOGINS = (10, 60.0)  # wrong passwords in so many seconds, then each login takes
SLOW = 1.0  # second, one after the other
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'self'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class Cookies(NamedTuple):
    """Names of cookies; of each project others, for a browser sends those of all ports of a host to each of them.

    Attributes:
        rater: By which a rater's browser is known.
        owner: By which the owner's is.
    """

    rater: str
    owner: str

    @staticmethod
    def of(identity: str) -> Cookies:
        """Return the names for a project.

        Examples:
            >>> Cookies.of("c0ffee").rater
            'uard_rater_c0ffee'
        """
        return Cookies(f"uard_rater_{identity}", f"uard_owner_{identity}")


class Buckets:
    """How often something may be asked: tokens that run out and come back with time.

    Examples:
        >>> buckets = Buckets(clock=iter([0.0, 0.0, 0.5]).__next__)
        >>> [buckets.wait("ann", rate=1.0, burst=1.0) for _ in range(3)]
        [0.0, 1.0, 0.5]
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic, most: int = 10_000):
        """Begin with all of them full; beyond ``most`` those that are full again are forgotten."""
        self._clock = clock
        self._most = most
        self._left: dict[str, tuple[float, float, float]] = {}  # tokens, when, and when it is full again

    def wait(self, name: str, rate: float, burst: float) -> float:
        """Take a token, and return 0; or how many seconds to wait until there is one."""
        now = self._clock()
        tokens, before, _ = self._left.get(name, (burst, now, now))
        tokens = min(burst, tokens + (now - before) * rate)
        lacking = max(1.0 - tokens, 0.0)
        tokens -= not lacking
        self._left[name] = tokens, now, now + (burst - tokens) / rate
        if len(self._left) > self._most:
            self._left = {key: entry for key, entry in self._left.items() if entry[2] > now}
        return lacking / rate


class Sessions:
    """Whose cookie is whose.

    Examples:
        >>> import tempfile
        >>> from uard.collect import Project
        >>> with tempfile.TemporaryDirectory() as folder, Project.create(folder).store() as store:
        ...     _, cookie = store.enter(store.invite("ann"))
        ...     sessions = Sessions(store)
        ...     sessions.rater(cookie), sessions.rater("another"), sessions.paused("ann")
        ('ann', None, False)
    """

    def __init__(self, store: AnswerStore, clock: Callable[[], float] = time.monotonic):
        """Begin with what the store knows."""
        self._store = store
        self._clock = clock
        self._lock = threading.Lock()
        self._read_at = float("-inf")
        self._names: dict[str, str] = {}
        self._paused: frozenset[str] = frozenset()

    @property
    def stale(self) -> bool:
        """Whether the store is asked before the next answer."""
        return self._clock() - self._read_at > FRESH

    def forget(self) -> None:
        """Ask the store before the next answer."""
        self._read_at = float("-inf")

    def refresh(self) -> None:
        """Ask the store if that is due."""
        with self._lock:
            if self.stale:
                now, raters = self._clock(), self._store.raters()
                self._names = {session: rater.name for rater in raters for session in rater.sessions}
                self._paused = frozenset(rater.name for rater in raters if rater.paused)
                self._read_at = now

    def rater(self, cookie: str | None) -> str | None:
        """Return the name of the rater who has a cookie."""
        if not cookie:
            return None
        self.refresh()
        return self._names.get(hashed(cookie))

    def paused(self, rater: str) -> bool:
        """Whether a rater is shown nothing now."""
        self.refresh()
        return rater in self._paused


class OwnerDoor:
    """The owner's password and the cookies of those who knew it.

    Examples:
        >>> door = OwnerDoor("open sesame")
        >>> cookie = door.enter("open sesame")
        >>> door.knows(cookie), door.enter("open barley"), door.knows("another")
        (True, None, False)
    """

    def __init__(self, password: str, clock: Callable[[], float] = time.monotonic):
        """Keep the password, which must not be empty."""
        if not password:
            raise _checks.InvalidValueError("owner_password", password, "text that is not empty")
        self._password = password.encode()
        self._clock = clock
        self._until: dict[str, float] = {}
        self._wrong: deque[float] = deque(maxlen=WRONG_LOGINS[0])
        self._turn = asyncio.Lock()

    async def enter_in_turn(self, password: str) -> str | None:
        """Return as ``enter`` does, but slowly while somebody guesses.

        Nobody is locked out, for whoever guesses may share the owner's address: the right password is always heard.
        """
        number, seconds = WRONG_LOGINS
        if len(self._wrong) == number and self._clock() - self._wrong[0] < seconds:
            async with self._turn:  # not all at once, whatever number of connections they come by
                await asyncio.sleep(SLOW)
                return self.enter(password)
        return self.enter(password)

    def enter(self, password: str) -> str | None:
        """Return a new cookie for the right password; None for another."""
        if not hmac.compare_digest(password.encode(), self._password):
            self._wrong.append(self._clock())
            return None
        cookie = secrets.token_urlsafe(16)
        self._until[hashed(cookie)] = self._clock() + OWNER_SECONDS
        return cookie

    def knows(self, cookie: str | None) -> bool:
        """Whether a cookie is the owner's."""
        return bool(cookie) and self._until.get(hashed(cookie or ""), float("-inf")) > self._clock()

    def leave(self, cookie: str | None) -> None:
        """Forget a cookie."""
        self._until.pop(hashed(cookie or ""), None)


class Guard:
    """Middleware before all routes.

    Routes find in their scope: ``uard.rater`` (a name or None), ``uard.owner`` (whether the owner asks), ``uard.body``
    (the bytes of a POST).
    """

    def __init__(self, app: ASGIApp, *, sessions: Sessions, owner: OwnerDoor, cookies: Cookies, public_url: str | None):
        """Stand before ``app``."""
        self._app = app
        self._cookies = cookies
        self._sessions = sessions
        self._owner = owner
        self._public = origin_of(public_url) if public_url else None
        self._names = frozenset[str]() if self._public is None else _names_of(self._public)
        self._buckets = Buckets()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or let it through."""
        if scope["type"] != "http":
            if scope["type"] == "lifespan":
                await self._app(scope, receive, send)
            return

        started: list[bool] = []

        async def sending(message: Message) -> None:
            if message["type"] == "http.response.start":
                started.append(True)
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        async def refuse(status: int, sentence: str, **headers: str) -> None:
            response = refusal(scope, status, sentence, {k.replace("_", "-"): v for k, v in headers.items()})
            await response(scope, receive, sending)

        headers = Headers(scope=scope)
        host = headers.get("host", "")
        if not self._ours(host):
            return await refuse(400, f"This server does not answer to the name {host!r}.")
        cookies = _cookies(headers.get("cookie", ""))
        try:
            if self._sessions.stale:
                await run_in_threadpool(self._sessions.refresh)
            rater = self._sessions.rater(cookies.get(self._cookies.rater))
        except StoreError as error:
            return await refuse(*trouble(error), Retry_After="5")
        owner = self._owner.knows(cookies.get(self._cookies.owner))
        seconds = self._wait(scope, cookies, rater, owner)
        if seconds:
            return await refuse(429, "Too many requests; wait a moment.", Retry_After=str(int(seconds) + 1))
        body = b""
        if scope["method"] not in ("GET", "HEAD"):
            origin = headers.get("origin")
            if origin is None or origin not in (f"http://{host}" if self._is_local(host) else None, self._public):
                return await refuse(403, "This was sent from another page than ours, or by a program without Origin.")
            try:
                async with asyncio.timeout(BODY_SECONDS):
                    read = await _body(headers, receive)
            except TimeoutError:
                return await refuse(400, "The request came too slowly.")
            if read is None:
                return await refuse(413, f"A request may have {MOST_BYTES} bytes.", Connection="close")
            body = read
        scope["uard.rater"], scope["uard.owner"], scope["uard.body"] = rater, owner, body
        try:
            await self._app(scope, receive, sending)
        except Exception:  # a mistake of ours; the page keeps what it sent and tries again
            logging.getLogger(__name__).exception("%s %s", scope["method"], scope["path"])
            if started:
                raise
            await refuse(500, "Something went wrong on the server. Its owner finds more in its output.")

    def _ours(self, host: str) -> bool:
        return self._is_local(host) or host.lower() in self._names

    @staticmethod
    def _is_local(host: str) -> bool:
        try:
            name = urlsplit(f"//{host}").hostname or ""
            return name == "localhost" or ipaddress.ip_address(name).is_loopback
        except ValueError:
            return False

    def _wait(self, scope: Scope, cookies: dict[str, str], rater: str | None, owner: bool) -> float:
        address = str((scope.get("client") or ("",))[0])
        if (scope["method"], scope["path"]) == ("POST", "/owner/login"):
            return 0.0  # see ``OwnerDoor``
        if rater is None and not owner:
            return self._buckets.wait(f"address {address}", *PER_ADDRESS)
        return self._buckets.wait(
            f"session {hashed(cookies[self._cookies.rater if rater else self._cookies.owner])}", *PER_SESSION
        )


def _names_of(origin: str) -> frozenset[str]:
    """Return what a browser or a server before this one may write as the host of an origin."""
    parts = urlsplit(origin)
    return frozenset({parts.netloc, f"{parts.netloc}:{PORTS[parts.scheme]}"} if parts.port is None else {parts.netloc})


async def _body(headers: Headers, receive: Receive) -> bytes | None:
    """Return the body; None if it is too long."""
    length = headers.get("content-length", "0")
    if not length.isdecimal() or int(length) > MOST_BYTES:
        return None
    body = b""
    while True:
        message = await receive()
        body += message.get("body", b"")
        if len(body) > MOST_BYTES:
            return None
        if not message.get("more_body", False):
            return body


def _cookies(header: str) -> dict[str, str]:
    found: dict[str, str] = {}
    for part in header.split(";"):  # one by one, so that a broken cookie of another program spoils no other
        try:
            found |= {name: morsel.value for name, morsel in SimpleCookie(part.strip()).items()}
        except CookieError:
            continue
    return found


def trouble(error: StoreError) -> tuple[int, str]:
    """Return the status and the sentence for a store that cannot be used now."""
    if "full" in str(error):
        return 507, "The server's disk is full. Nothing is lost: this page sends your answers again."
    return 503, "The answers cannot be stored now. Nothing is lost: this page sends your answers again."
