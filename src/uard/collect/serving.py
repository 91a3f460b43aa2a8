"""Runs the server of a project: one at a time, with links for those who have not entered yet."""

from __future__ import annotations

import errno
import importlib
import ipaddress
import json
import os
import secrets
import socket
from collections.abc import Callable, Collection, Generator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from uard import _checks
from uard.collect import asking
from uard.collect.address import origin_of
from uard.collect.project import Project
from uard.collect.store import AnswerStore

PORT = 8321
LOCK = "serving.lock"
_LOCKED_BYTE = 1 << 30  # beyond what the file holds: Windows lets nobody read a byte that is locked
_ENDING = 1.0  # seconds that answers on their way have when the server ends


def serve(
    project_folder: str | Path,
    raters: Sequence[str] = (),
    *,
    host: str = "127.0.0.1",
    port: int = PORT,
    public_url: str | None = None,
    owner_password: str | None = None,
    new_links: bool = False,
    top_up: Callable[[Project, AnswerStore], Callable[[str, int, Collection[str]], None]] | None = None,
    say: Callable[[str], None] = print,
) -> None:
    """Serve a project until SIGINT or SIGTERM.

    Args:
        project_folder: Where it is.
        raters: Names of those who are invited; those who were invited before keep what they have.
        host: Address to listen at. Others than this machine's own need ``public_url``.
        port: To listen at; 0 for any that is free.
        public_url: The address that raters see, where a server with TLS stands before this one.
        owner_password: For ``/owner``; made anew for each start if left out.
        new_links: Whether all raters are given new links; those of before are void, their browsers stay known.
        top_up: Given the project and its store, returns what asks a rater for more when there is too little to rate;
            ``uard.collect.asking`` if left out.
        say: Prints a line.

    Raises:
        InvalidValueError: no such project, another server runs on it, the port is taken, or the host is not this
            machine's own and there is no ``public_url``.
        StoreError: the store cannot be opened.
        ModuleNotFoundError: the extra ``uard[collect]`` is not installed.
    """
    public = _checked(host, public_url)
    _checks.whole("port", port, low=0, high=65_535)
    uvicorn: Any = _uvicorn()
    from uard.collect.app import create_app

    project = Project.open(project_folder)
    password = owner_password or secrets.token_urlsafe(12)
    with _alone(project.folder) as announce, _listening(host, port) as listener:
        address = f"http://{_as_written(host)}:{listener.getsockname()[1]}"
        announce(address)
        with project.store() as store:
            wrong = project.damaged(store.items()[0])
            _tell_damage(wrong, say)
            more = _asking(project, store) if top_up is None else top_up(project, store)
            app = create_app(project, store, owner_password=password, public_url=public, top_up=more)
            url = public or address
            links = invite(store, raters, new_links)
            for rater, secret in links:
                say(f"{rater}: {url}/enter/{secret}")
            _tell_known(store, [rater for rater, _ in links], say)
            say(f"owner: {url}/owner" + ("" if owner_password else f"  (password {password})"))
            ends = "Each link works once. Ctrl-C ends the server; every answer that was acknowledged is kept."
            _run(uvicorn, app, listener, behind=public is not None, ready=lambda: say(ends))


def _asking(project: Project, store: AnswerStore) -> Callable[[str, int, Collection[str]], None]:
    def more(rater: str, count: int, without: Collection[str]) -> None:
        asking.top_up(project, store, rater, count, without)

    return more


def invite(store: AnswerStore, raters: Sequence[str], new_links: bool = False) -> list[tuple[str, str]]:
    """Return names and new secrets of the raters who need a link.

    Args:
        store: Where they are known.
        raters: Who should be there.
        new_links: Whether all raters get a new one, which makes those that were given out before void.
    """
    known = [r.name for r in store.raters()]
    names = dict.fromkeys((*raters, *known)) if new_links else [n for n in dict.fromkeys(raters) if n not in known]
    return [(n, store.invite(n)) for n in names]


def _tell_known(store: AnswerStore, new: Collection[str], say: Callable[[str], None]) -> None:
    """Say why some raters are given no link."""
    others = [r for r in store.raters() if r.name not in new]
    waiting = [r.name for r in others if r.invited and not r.entered]
    if waiting:
        say(f"invited before, with links that still work: {', '.join(waiting)} (--new-links makes new ones)")
    if entered := [r.name for r in others if r.entered]:
        say(f"known by their browsers already: {', '.join(entered)} (--new-links makes links for other browsers)")


def _tell_damage(wrong: Mapping[str, str], say: Callable[[str], None]) -> None:
    if wrong:
        several = f"{len(wrong)} item{'s are' if len(wrong) > 1 else ' is'}"
        say(f"{several} set aside, and shown to nobody; answers that exist are kept:")
        for name, why in list(wrong.items())[:5]:
            say(f"  {name}: {why}")
        if len(wrong) > 5:
            say(f"  and {len(wrong) - 5} more (see the owner's page)")


def _uvicorn() -> Any:
    try:
        return importlib.import_module("uvicorn")
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"the page for raters needs uvicorn: pip install 'uard[collect]' ({error})", name=error.name
        ) from None


def _run(uvicorn: Any, app: Any, listener: socket.socket, behind: bool, ready: Callable[[], None]) -> None:
    config = uvicorn.Config(
        app,
        log_level="warning",
        access_log=False,  # it would hold the secrets of links
        server_header=False,
        lifespan="off",
        ws="none",
        proxy_headers=behind,  # from this machine: the address of whoever asks, for the limits
        timeout_graceful_shutdown=int(_ENDING),
    )
    server = uvicorn.Server(config)
    start = server.startup

    async def startup(sockets: list[socket.socket] | None = None) -> None:
        await start(sockets=sockets)
        ready()  # from now on a signal ends it in order

    server.startup = startup
    with suppress(KeyboardInterrupt):  # uvicorn ends cleanly first, then raises what it was ended by
        server.run(sockets=[listener])


def _checked(host: str, public_url: str | None) -> str | None:
    """Return the public address in the spelling of browsers; refuse a host that needs one and has none."""
    if not is_local(host) and public_url is None:
        allowed = (
            "127.0.0.1, or together with public_url: answers and links must not cross a network without TLS, "
            "and docs/guides/people.md says how to put a server with TLS before this one"
        )
        raise _checks.InvalidValueError("host", host, allowed)
    return None if public_url is None else origin_of(public_url)


def is_local(host: str) -> bool:
    """Whether a host is this machine as only its own programs see it.

    Examples:
        >>> is_local("127.0.0.1"), is_local("localhost"), is_local("::1"), is_local("0.0.0.0")
        (True, True, True, False)
    """
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _as_written(host: str) -> str:
    return f"[{host}]" if ":" in host else host


@contextmanager
def _listening(host: str, port: int) -> Generator[socket.socket]:
    kind = socket.AF_INET6 if ":" in host else socket.AF_INET
    # Named as TCP, for asyncio sends small answers at once on such sockets only; on others each waits for 40 ms.
    with socket.socket(kind, socket.SOCK_STREAM, socket.IPPROTO_TCP) as listener:
        if os.name == "posix":  # a port whose last server ended a moment ago is free; elsewhere this means to share it
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((host, port))
            listener.listen(2048)
        except OSError as error:
            raise _checks.InvalidValueError("port", port, _what_port(error, host)) from None
        yield listener


def _what_port(error: OSError, host: str) -> str:
    if error.errno == errno.EADDRINUSE:
        return "free, and another program listens there: end it, or take another one (0 is any free one)"
    if error.errno == errno.EACCES:
        return "1024 or more: lower ones are the system's"
    return f"one at which this machine can listen at {host} ({error.strerror or error})"


@contextmanager
def _alone(folder: Path) -> Generator[Callable[[str], None]]:
    """Hold the project's lock, which ends with the process, however that ends; what is yielded tells the address."""
    path = folder / LOCK
    with _opened(path) as file:
        if not _lock(file):
            raise _checks.InvalidValueError("project", str(folder), f"served once, and {_first(path)}")

        def announce(address: str) -> None:
            file.truncate(0)
            file.write(json.dumps({"pid": os.getpid(), "address": address}).encode())
            file.flush()

        try:
            yield announce
        finally:
            file.truncate(0)


def _opened(path: Path) -> BinaryIO:
    try:
        return path.open("a+b")
    except OSError as error:
        allowed = f"in a folder that can be written to ({error.strerror})"
        raise _checks.InvalidValueError("project", str(path.parent), allowed) from None


def _first(path: Path) -> str:
    try:
        known = json.loads(path.read_bytes())
        return f"another server has it already: {known['address']}, process {known['pid']}"
    except (OSError, ValueError, KeyError, TypeError):
        return "another server has it already"


def _lock(file: BinaryIO) -> bool:
    try:
        if os.name == "nt":  # pragma: no cover
            msvcrt: Any = importlib.import_module("msvcrt")
            file.seek(_LOCKED_BYTE)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            fcntl: Any = importlib.import_module("fcntl")
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
