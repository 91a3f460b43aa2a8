"""Opening a store to look at it: nothing is changed, nothing is left beside it, and a read-only place will do."""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
from contextlib import ExitStack, closing
from pathlib import Path
from urllib.parse import quote


def can_be_written(path: str | Path) -> bool:
    """Whether SQLite can write into a file that is there: it makes others beside it while it does."""
    return os.access(path, os.W_OK) and os.access(Path(path).absolute().parent, os.W_OK | os.X_OK)


def open_for_reading(path: str, leaving: ExitStack) -> sqlite3.Connection:
    """Open a store to read it, while others write into it perhaps.

    Args:
        path: Of the file.
        leaving: Closes the connection, and removes what had to be copied.

    Raises:
        sqlite3.Error: it cannot be read.
        OSError: it cannot be read.
    """
    if can_be_written(path):
        # Read-only connections make the files -wal and -shm and cannot remove them; one that could write does.
        return _opened(leaving, path, "mode=rw")
    wal = Path(f"{path}-wal")
    if not wal.exists() or not wal.stat().st_size:  # else immutable would miss what is in there
        return _opened(leaving, path, "immutable=1")
    db = _opened(leaving, path, "mode=ro")
    try:
        db.execute("select count(*) from sqlite_master")
        return db
    except sqlite3.OperationalError:  # -shm is not there, so that nobody is at work, and cannot be made
        folder = Path(leaving.enter_context(tempfile.TemporaryDirectory(prefix="uard-")))
        for suffix in ("", "-wal"):
            shutil.copyfile(f"{path}{suffix}", folder / f"store{suffix}")
        return _opened(leaving, str(folder / "store"), "mode=rw")


def _opened(leaving: ExitStack, path: str, options: str) -> sqlite3.Connection:
    db = leaving.enter_context(closing(sqlite3.connect(f"file:{quote(path)}?{options}", timeout=60, uri=True)))
    db.execute("pragma query_only = on")
    return db
