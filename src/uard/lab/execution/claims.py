"""Who is training what: the processes that share a store, and whether they are still alive."""

from __future__ import annotations

import os
import secrets
import socket
import time
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

HEARTBEAT = 15.0  # seconds between two heartbeats
LEASE = 120.0  # seconds without one, after which a process that cannot be looked up counts as dead

_at_work: set[str] = set()  # tokens of owners in this process


class _Seen(NamedTuple):
    """A heartbeat of an owner elsewhere; since when, by this machine's steady clock; whether it was another before."""

    beat: float
    since: float
    changed: bool


_seen: dict[str, _Seen] = {}  # by token, the last heartbeat of every owner that this process has looked at


@dataclass(frozen=True)
class Owner:
    """One run of the runner in one process.

    Attributes:
        token: Random, so that no two are equal.
        host: Name of the machine, for people.
        place: Where ``pid`` and ``born`` mean something: one start of one kernel, one namespace of processes. Empty
            where a process cannot be looked up.
        pid: Process id.
        born: When the process started, in the kernel's ticks: a later process with the same id has another one.
    """

    token: str
    host: str
    place: str
    pid: int
    born: int

    @staticmethod
    def here() -> Owner:
        """Return a new owner in this process."""
        born = _born(os.getpid())
        owner = Owner(secrets.token_hex(8), socket.gethostname(), _place() if born else "", os.getpid(), born or 0)
        _at_work.add(owner.token)
        return owner

    def stop(self) -> None:
        """Count as dead from now on, for this process at least."""
        _at_work.discard(self.token)

    def alive(self, beat: float) -> bool:
        """Whether it still runs: exactly if it is of this machine (Linux), by its heartbeats elsewhere.

        Clocks of two machines may differ by any amount, and each may be set at any time. So one elsewhere that has been
        seen to change its heartbeat is alive until it has not done so for ``LEASE`` seconds of this machine's steady
        clock. One that has not is dead then, too, and at once if its heartbeat is older than that by the date.

        Args:
            beat: Its last heartbeat, in seconds since 1970 by its own clock.
        """
        if self.place and self.place == _place():
            if self.pid == os.getpid() and _born(self.pid) == self.born:
                return self.token in _at_work
            return _born(self.pid) == self.born
        now, before = time.monotonic(), _seen.get(self.token)
        if before is None or before.beat != beat:
            before = _seen[self.token] = _Seen(beat, now, changed=before is not None)
        return now - before.since < LEASE and (before.changed or time.time() - beat < LEASE)

    def __str__(self) -> str:
        """Return host and process id."""
        return f"{self.host}:{self.pid}"


def _born(pid: int) -> int | None:
    """Return when a process started; None if it has ended (a zombie has) or nobody can tell."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except (OSError, UnicodeDecodeError):
        return None
    return None if fields[0] in "ZX" else int(fields[19])


def _place() -> str:
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""
