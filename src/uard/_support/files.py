"""Writing files: what is at a path is whole at any time, and what is no regular file is written to, never replaced.

A regular file is written beside its target, flushed to the disk and renamed over it, so that a reader, a crash or a
full disk meets the old content or the new one and never a part. Links are followed: the file that they name is
replaced, the link stays. Devices, pipes and open descriptors (``/dev/null``, ``/dev/stdout``, a FIFO) are written to.
"""

from __future__ import annotations

import errno
import os
import re
import secrets
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from uard._checks import InvalidValueError


@contextmanager
def replacing(path: str | Path) -> Iterator[BinaryIO]:
    """Open a file for writing; it takes its place when the block has ended without an error.

    Args:
        path: Its folder must be there.

    Yields:
        The file, open for bytes.

    Raises:
        OSError: it cannot be written, or is write-protected; what was there before is still there.
    """
    target, descriptor = _followed(os.fspath(path))
    before = _status(path)
    if descriptor is not None:
        for stream in (sys.stdout, sys.stderr):  # what was printed before comes before
            stream.flush()
        with os.fdopen(os.dup(descriptor), "wb") as file:
            yield file
        return
    if before is not None and not stat.S_ISREG(before.st_mode):
        with open(path, "wb") as file:  # a folder refuses this
            yield file
        return
    if before is not None and not os.access(target, os.W_OK):
        raise PermissionError(errno.EACCES, "it is write-protected", target)
    half = os.path.join(os.path.dirname(target), f".uard-{secrets.token_hex(8)}.part")
    try:
        with os.fdopen(os.open(half, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666), "wb") as file:
            if before is not None:
                _take_over(file.fileno(), before)
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(half, target)
    except BaseException:
        with suppress(OSError):
            os.unlink(half)
        raise


def write(path: str | Path, text: str, field: str) -> None:
    """Write text as UTF-8, as ``replacing`` does.

    Args:
        path: Its folder is made, and those that it is in.
        text: The whole content.
        field: What the path is called in the error.

    Raises:
        InvalidValueError: it cannot be written.
    """
    try:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as file:
            file.write(text.encode(errors="backslashreplace"))  # half a surrogate pair has no UTF-8
    except OSError as error:
        raise InvalidValueError(field, str(path), f"a file that can be written ({error.strerror or error})") from None


def prepare(path: str | Path, field: str, *read: str | Path | None) -> None:
    """Make a file's folder and refuse now, not after hours of work, what could not be written.

    Args:
        path: Of a file that is going to be written.
        field: What the path is called in the error.
        read: Files that are read, or written to, by the same command; None is none.

    Raises:
        InvalidValueError: it could not, or it is one of those that are read, by whatever name.
    """
    for other in read:
        if other is not None and _is_same(path, other):
            raise InvalidValueError(field, str(path), f"another file than {other}, which it would destroy")
    try:
        target, descriptor = _followed(os.fspath(path))
        if descriptor is not None:
            os.fstat(descriptor)
            return
        found = _status(path)
    except OSError as error:
        raise InvalidValueError(field, str(path), f"a file that can be written ({error.strerror or error})") from None
    if found is not None and stat.S_ISDIR(found.st_mode):
        raise InvalidValueError(field, str(path), "a file, not a folder")
    if found is None or stat.S_ISREG(found.st_mode):
        _prepare_folder(os.path.dirname(target), str(path), field)
    if found is not None and not os.access(path, os.W_OK):
        raise InvalidValueError(field, str(path), "a file that can be written, and it is write-protected")


def _is_same(path: str | Path, other: str | Path) -> bool:
    with suppress(OSError, ValueError):  # of a name that is none
        return os.path.isfile(path) and os.path.samefile(path, other)
    return False


def prepare_folder(path: str | Path, field: str) -> None:
    """Make a folder, and those that it is in, and refuse one into which nothing can be written.

    Raises:
        InvalidValueError: naming ``field`` and the path.
    """
    _prepare_folder(path, str(path), field)


def _prepare_folder(folder: str | Path, path: str, field: str) -> None:
    try:
        if not os.fspath(folder):
            raise FileNotFoundError(errno.ENOENT, "an empty name")
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidValueError(field, path, f"in a folder that can be written ({error})") from None
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InvalidValueError(field, path, "in a folder that can be written")


def _followed(path: str) -> tuple[str, int | None]:
    """Return the absolute path that links lead to, and its number if that is a descriptor which this process has open.

    Such a "file" (``/dev/stdout``) must not be opened anew: that would begin again at its start, or fail for a socket.
    """
    if not path:
        raise IsADirectoryError(errno.EISDIR, "an empty name", path)
    _status(path)  # a circle of links is an error
    while True:
        folder, name = os.path.split(os.path.abspath(path))
        folder = os.path.realpath(folder)
        path = os.path.join(folder, name)
        if name.isdecimal() and re.fullmatch(rf"/proc/{os.getpid()}(/task/\d+)?/fd|/dev/fd", folder):
            return path, int(name)
        if not os.path.islink(path):
            return path, None
        path = os.path.join(folder, os.readlink(path))


def _status(path: str | Path) -> os.stat_result | None:
    try:
        return os.stat(path)
    except (FileNotFoundError, NotADirectoryError):
        return None


def _take_over(descriptor: int, before: os.stat_result) -> None:
    """Give a new file the owner, as far as this user may, and the permissions of the one that it replaces."""
    with suppress(OSError):
        os.fchown(descriptor, before.st_uid, before.st_gid)
    os.fchmod(descriptor, stat.S_IMODE(before.st_mode))
