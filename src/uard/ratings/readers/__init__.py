"""Readers of logs of rewards and ratings: CSV, JSONL, JSON, Parquet, or named columns; wide, or as tools export them.

Wide: a row per step (or per completion, or per item that was rated). Its columns:

* ``reward``: the observed reward; without it only what concerns the raters can be known;
* every column whose name starts with ``rating``: one annotator each, empty where a rating is missing; in JSON and
  Parquet also one column of lists;
* ``sigma_m``: the ensemble's disagreement, >= 0; ``true_reward``: what the step was really worth;
* ``item``: what was rated (a state-action, a prompt); rows with the same item are visits of one thing;
* ``episode``, ``step``: names of the row in messages.

Long: a row per answer, known by a column that says who gave it (``annotator``, ``worker_id``, ``user``,
``completed_by`` ...: ``layout.RATERS``). It has further

* what was rated: ``item``, ``task_id``, ``instance_id`` ... (``layout.ITEMS``), or ``id`` if there is no other;
* the rating: the only column that starts with ``rating``, else ``score``, ``label``, ``value`` ... (``layout.VALUES``);
* when, if somebody answers twice (``spelling.TIMES``, the first that is there); the later answer is the rating;
* ``reward``, ``sigma_m``, ``true_reward``, equal in all rows of an item. Without rewards the log has none.

Case and punctuation of these names do not matter; ``rater``, ``item`` and ``rating`` decide where several could be
meant. Label Studio's JSON, Argilla's records, potato's CSV, TSV, JSONL and JSON, and crowd-kit's task-worker-label are
read as they are: see ``tools``.

Other columns are left alone. Rows are counted from 1, without the header. ``nan``, ``na``, ``n/a``, ``null``, ``none``,
``-`` and nothing mean that a number is missing; ``missing`` names further words. NaN and infinity are read as they are:
the doctor reports them. Numbers are plain decimals: neither ``1_000`` nor True is one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from uard import _checks
from uard.ratings.log import RatingLog
from uard.ratings.readers.columns import Numbers, Wanted, cells_of, names_in
from uard.ratings.readers.formats import FORMATS, table
from uard.ratings.readers.layout import LogChoice, layout_of
from uard.ratings.readers.long_form import long_log
from uard.ratings.readers.wide_form import wide_log

__all__ = ["FORMATS", "from_columns", "read"]


def read(
    path: str | Path,
    reward: str = "reward",
    ratings: Sequence[str] | None = None,
    *,
    rater: str | None = None,
    item: str | None = None,
    rating: str | None = None,
    missing: Sequence[str] = (),
    by: str | None = None,
) -> RatingLog:
    r"""Read a log from a file.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "log.csv"
        ...     _ = file.write_text("reward,rating_ann,rating_bob\n4,-1,\n0,0,0.1\n")
        ...     wide = read(file)
        ...     _ = file.write_text("task,worker,label\na,ann,5\na,bob,4\nb,bob,?\nb,ann,2\n")
        ...     long = read(file, missing=["?"])
        >>> wide.raters, wide.ratings.tolist()
        (('rating_ann', 'rating_bob'), [[-1.0, nan], [0.0, 0.1]])
        >>> long.raters, long.ratings.tolist(), long.reward
        (('ann', 'bob'), [[5.0, 4.0], [2.0, nan]], None)

    Args:
        path: A ``.csv`` (or ``.tsv``), ``.jsonl`` (or ``.ndjson``), ``.json`` or ``.parquet`` file. Text is UTF-8; a
            CSV is separated by commas, semicolons or tabs and has a header.
        reward: Name of the column of rewards.
        ratings: Wide form: names of the annotators' columns; all that start with ``rating`` if left out.
        rater: Long form: the column that says who rated.
        item: The column that says what was rated.
        rating: Long form: the column of ratings, or the question whose answers are read.
        missing: Further words that mean that a number is missing, such as ``?``. One that is a number, such as ``0`` or
            ``-1``, means so among the ratings alone.
        by: Name of a column that divides the rows into parts, if any.

    Raises:
        InvalidValueError: the file cannot be read or is empty, a column is missing or it cannot be told which is meant
            (the message lists those that are there), or cells are no numbers (it names row and column, or all such
            words with their counts); a Parquet file without pyarrow; answers about pairs, which
            ``uard.ratings.preferences`` reads.
    """
    wanted = _wanted(str(path), reward, ratings, rater, item, rating, missing, by)
    numbers = Numbers(wanted.source, wanted.missing)
    columns, names = table(path, LogChoice(wanted), numbers)
    return _log(columns, names, wanted, numbers)


def from_columns(
    columns: Mapping[str, Any],
    reward: str = "reward",
    ratings: Sequence[str] | None = None,
    source: str = "log",
    *,
    rater: str | None = None,
    item: str | None = None,
    rating: str | None = None,
    missing: Sequence[str] = (),
    by: str | None = None,
) -> RatingLog:
    """Take a log from named columns: a dict of lists or arrays, or a data frame.

    Examples:
        >>> from_columns({"reward": [4.0, 0.0], "rating_ann": [-1.0, None]}).ratings.tolist()
        [[-1.0], [nan]]

    Args:
        columns: Name to column; None and NaN mean that a number is missing.
        reward: See ``read``, as for the following.
        ratings: Names of the annotators' columns.
        source: What to call the log in messages.
        rater: The column that says who rated.
        item: The column that says what was rated.
        rating: The column of ratings.
        missing: Further words that mean that a number is missing.
        by: Name of a column that divides the rows into parts, if any.

    Raises:
        InvalidValueError: see ``read``; a column is no list or array, such as text, or columns are of unequal length.
    """
    wanted = _wanted(source, reward, ratings, rater, item, rating, missing, by)
    if not hasattr(columns, "keys") and not hasattr(columns, "columns"):
        raise _checks.InvalidValueError(source, columns, "named columns: a dict of lists or arrays, or a data frame")
    names: list[Any] = list(getattr(columns, "columns", columns))
    for name in names:
        if not isinstance(name, str):
            raise _checks.InvalidValueError(f"{source}: name of a column", name, "text")
    as_numbers, as_texts = LogChoice(wanted).columns(names)
    cells = {n: cells_of(columns[n], n, source) for n in (*as_numbers, *as_texts)}
    (first, rows), *others = ((n, len(c)) for n, c in cells.items())
    for name, length in others:
        if length != rows:
            allowed = f"of {rows} rows, like {first!r}"
            raise _checks.InvalidValueError(f"{source}: column {name!r}", f"{length} rows", allowed)
    return _log(cells, names, wanted, Numbers(source, wanted.missing))


def _wanted(
    source: str,
    reward: str,
    ratings: Sequence[str] | None,
    rater: str | None,
    item: str | None,
    rating: str | None,
    missing: Sequence[str],
    by: str | None,
) -> Wanted:
    several = None if ratings is None else names_in("ratings", ratings)
    return Wanted(source, reward, several, rater, item, rating, names_in("missing", missing), by)


def _log(columns: dict[str, Any], names: Sequence[str], wanted: Wanted, numbers: Numbers) -> RatingLog:
    layout = layout_of(names, wanted)
    return (long_log if layout.rater else wide_log)(columns, layout, numbers)
