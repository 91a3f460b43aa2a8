"""SIGINT and SIGTERM end the program within seconds, each with its own exit code, whatever is being computed.

The first signal raises ``StopError`` wherever the main thread is. That may be too little: Python runs a handler only
between two steps of its own, not while XLA compiles for a minute; and an exception that is raised inside a callback of
JAX or a destructor is swallowed there. So the signal is also remembered, for ``check`` in loops, and a watcher, who is
told by the operating system and not by the handler, ends the process after ``GRACE`` seconds. A second signal ends it
at once, unless it is the first one that a handler of somebody else's (uvicorn's) raises again for us. Ending so is
safe: files are replaced whole, a store is whole after any write, workers end with their parent, and what a dead process
had claimed is free.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import NoReturn

GRACE = 2.0  # seconds from the first signal to the end of the process, whatever it does
WORDS = {int(signal.SIGINT): "interrupted", int(signal.SIGTERM): "terminated"}
_received: int | None = None


class StopError(KeyboardInterrupt):
    """A signal that ends the program."""


def received() -> int | None:
    """Return the number of the signal that is to end the program; None if there was none."""
    return _received


def check() -> None:
    """Act on a signal whose exception was swallowed.

    Raises:
        StopError: there was one.
    """
    if _received is not None:
        raise StopError


def end() -> NoReturn:
    """End the process with the signal's exit code and without Python's own ending: it crashes while XLA computes."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(128 + (_received or 0))


@contextmanager
def ending() -> Iterator[None]:
    """Let SIGINT and SIGTERM end the block, and after ``GRACE`` seconds the process; an ignored one stays ignored.

    After a signal the watcher stays at work when the block has ended: ``end`` is then to be called.
    """
    if threading.current_thread() is not threading.main_thread():  # no other may set handlers
        yield
        return
    read, write = os.pipe()
    os.set_blocking(write, False)
    descriptor = signal.set_wakeup_fd(write, warn_on_full_buffer=False)
    before = {n: signal.signal(n, _stop) for n in WORDS if signal.getsignal(n) is not signal.SIG_IGN}
    threading.Thread(target=_watch, args=(read,), daemon=True).start()
    try:
        yield
    finally:
        if _received is None:
            for number, handler in before.items():
                signal.signal(number, handler)
            signal.set_wakeup_fd(descriptor)
            os.close(write)


def _stop(number: int, _: object) -> None:
    global _received
    if _received is None:  # the watcher sees to a second one
        _received = number
        raise StopError


def _watch(read: int) -> None:
    """End the process some time after the first signal, or with the second."""
    first = number = _next(read, None)
    if first is not None:
        deadline = time.monotonic() + GRACE
        while number is not None and signal.getsignal(number) is not _stop:
            number = _next(read, deadline)  # a server's handler has it, which raises it again for us when all is closed
        if number is not None:
            _next(read, time.monotonic() + GRACE)
        with suppress(OSError, ValueError):
            if select.select([], [2], [], 0)[1]:  # else the message would wait, for ever perhaps
                cursor = b"\x1b[?25h" if os.isatty(2) else b""  # which a progress bar has hidden
                os.write(2, cursor + f"{WORDS[first]}, without waiting for what was being computed\n".encode())
        os._exit(128 + first)
    os.close(read)


def _next(read: int, deadline: float | None) -> int | None:
    """Return the next signal of ours; None if the pipe is closed or the time is over."""
    while deadline is None or select.select([read], [], [], max(deadline - time.monotonic(), 0))[0]:
        data = os.read(read, 1)
        if not data or data[0] in WORDS:
            return data[0] if data else None
    return None


def quiet_output() -> None:
    """Let nothing more be written to standard output, whose reader is gone; flushing it at exit would raise again."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def open_output() -> None:
    """Give a process that was started without standard output or error (``>&-``) one that goes nowhere."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 (as long as the process)
