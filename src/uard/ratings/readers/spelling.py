"""Names of columns as people spell them: ``WorkerId``, ``worker_id`` and ``worker id`` are one."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from functools import lru_cache

TIMES = (
    "updatedat", "givenat", "submittedat", "completedat", "createdat", "timestamp", "datetime", "date", "time",
)  # fmt: skip
"""Columns that say when; the first that is there counts."""


@lru_cache(maxsize=1 << 16)  # a log may have thousands of columns, and many lists of names are gone through
def normal(name: str) -> str:
    """Return a name without case, spaces and punctuation.

    Examples:
        >>> normal("Worker ID"), normal("completed_by")
        ('workerid', 'completedby')
    """
    return re.sub(r"[\W_]+", "", name.casefold())


def among(names: Sequence[str], known: Collection[str], but: Sequence[str | None] = ()) -> list[str]:
    """Return the names that are spelt like one that is known.

    Examples:
        >>> among(["Task", "worker_id"], {"workerid"})
        ['worker_id']

    Args:
        names: Of columns.
        known: Names as ``normal`` gives them.
        but: Names that are something else.
    """
    return [n for n in dict.fromkeys(names) if n not in but and normal(n) in known]
