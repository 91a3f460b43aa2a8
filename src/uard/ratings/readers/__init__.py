"""Readers of logs of rewards and ratings: CSV, JSONL, Parquet, or named columns.

A log is a table with one row per step (or per completion, or per item that was rated). Its columns:

* ``reward``: the observed reward, the only one that must be there;
* every column whose name starts with ``rating``: one annotator each, empty where a rating is missing; in JSONL and
  Parquet also one column of lists;
* ``sigma_m``: the ensemble's disagreement, >= 0; ``true_reward``: what the step was really worth;
* ``item``: what was rated (a state-action, a prompt); rows with the same item are visits of one thing;
* ``episode``, ``step``: names of the row in messages.

Other columns are left alone. Rows are counted from 1, without the header. ``nan``, ``na``, ``n/a``, ``null``, ``none``
and nothing mean that a number is missing. NaN and infinity are read as they are: the doctor reports them.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from uard import _checks
from uard.ratings.log import RatingLog
from uard.ratings.readers.columns import Wanted, assembled
from uard.ratings.readers.csv_file import read_csv
from uard.ratings.readers.jsonl import read_jsonl
from uard.ratings.readers.parquet import read_parquet

FORMATS: dict[str, Callable[[Path, Wanted], dict[str, Any]]] = {
    ".csv": read_csv,
    ".tsv": read_csv,
    ".jsonl": read_jsonl,
    ".ndjson": read_jsonl,
    ".parquet": read_parquet,
    ".pq": read_parquet,
}


def read(
    path: str | Path, reward: str = "reward", ratings: Sequence[str] | None = None, *, by: str | None = None
) -> RatingLog:
    r"""Read a log from a file.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "log.csv"
        ...     _ = file.write_text("reward,rating_ann,rating_bob\n4,-1,\n0,0,0.1\n")
        ...     log = read(file)
        >>> log.raters, log.ratings.tolist()
        (('rating_ann', 'rating_bob'), [[-1.0, nan], [0.0, 0.1]])

    Args:
        path: A ``.csv`` (or ``.tsv``), ``.jsonl`` (or ``.ndjson``) or ``.parquet`` file. Text is UTF-8; a CSV is
            separated by commas, semicolons or tabs and has a header.
        reward: Name of the column of rewards.
        ratings: Names of the annotators' columns; all that start with ``rating`` if left out.
        by: Name of a column that divides the rows into parts, if any.

    Raises:
        InvalidValueError: the file cannot be read or is empty, a column is missing (the message lists those that are
            there), or a cell is no number (it names row and column); a Parquet file without pyarrow.
    """
    path = Path(path)
    reader = FORMATS.get(path.suffix.lower())
    if reader is None:
        raise _checks.InvalidValueError("log", str(path), f"a file that ends in {', '.join(FORMATS)}")
    wanted = Wanted(str(path), reward, None if ratings is None else tuple(ratings), by)
    try:
        columns = reader(path, wanted)
    except OSError as error:
        why = os.strerror(error.errno) if error.errno else error
        raise _checks.InvalidValueError("log", str(path), f"a file that can be read ({why})") from None
    except UnicodeDecodeError as error:
        raise _checks.InvalidValueError(
            "log", str(path), f"UTF-8 text (byte {error.start}: {error.object[error.start : error.start + 1]!r})"
        ) from None
    return assembled(columns, wanted)


def from_columns(
    columns: Mapping[str, Any],
    reward: str = "reward",
    ratings: Sequence[str] | None = None,
    source: str = "log",
    *,
    by: str | None = None,
) -> RatingLog:
    """Take a log from named columns: a dict of lists or arrays, or a pandas data frame.

    Examples:
        >>> from_columns({"reward": [4.0, 0.0], "rating_ann": [-1.0, None]}).ratings.tolist()
        [[-1.0], [nan]]

    Args:
        columns: Name to column; None and NaN mean that a number is missing.
        reward: Name of the column of rewards.
        ratings: Names of the annotators' columns; all that start with ``rating`` if left out.
        source: What to call the log in messages.
        by: Name of a column that divides the rows into parts, if any.

    Raises:
        InvalidValueError: see ``read``.
    """
    wanted = Wanted(source, reward, None if ratings is None else tuple(ratings), by)
    names = list(columns)
    wanted.check(names)
    return assembled({n: list(columns[n]) for n in names if wanted.has(n)}, wanted)
