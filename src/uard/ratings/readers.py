"""Logs of rewards and ratings: read from CSV, JSONL or Parquet, taken from columns, or rolled out.

A log is a table with one row per step (or per completion, or per item that was rated). Its columns:

* ``reward``: the observed reward, the only one that must be there;
* every column whose name starts with ``rating``: one annotator each, empty where a rating is missing; in JSONL and
  Parquet also one column of lists;
* ``sigma_m``: the ensemble's disagreement, >= 0; ``true_reward``: what the step was really worth;
* ``item``: what was rated (a state-action, a prompt); rows with the same item are visits of one thing;
* ``episode``, ``step``: names of the row in messages.

Other columns are left alone. Rows are counted from 1, without the header. ``nan``, ``na``, ``n/a``, ``null``, ``none``
and nothing mean that a number is missing. NaN and infinity are read as they are: it is the doctor that speaks of them.
"""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from uard import _checks

NUMBERS = ("sigma_m", "true_reward")
LABELS = ("item", "episode", "step")
FORMATS = {".csv": "CSV", ".tsv": "CSV", ".jsonl": "JSONL", ".ndjson": "JSONL", ".parquet": "Parquet", ".pq": "Parquet"}
_MISSING = frozenset(("", "nan", "na", "n/a", "null", "none"))
_CHUNK = 50_000  # rows of text that are held at a time


@dataclass(frozen=True, eq=False)
class RatingLog:
    """Rewards and what people said of them, one row per step.

    Attributes:
        reward: Observed rewards, (n,) with n >= 1; NaN where one is missing.
        ratings: Ratings in the reward's unit, (n, K); NaN where one is missing. K = 0 if nobody rates.
        raters: Names of the K annotators; ``rating_1`` and so on if left out.
        sigma_m: Ensemble disagreement, (n,), >= 0, or None.
        true_reward: What each step was really worth, (n,), or None.
        item: What was rated, (n,), or None where every row is another thing.
        episode: Name of each row's episode, (n,), or None.
        step: Name of each row's step, (n,), or None.
        source: Where the log is from.
    """

    reward: np.ndarray
    ratings: np.ndarray
    raters: tuple[str, ...] = ()
    sigma_m: np.ndarray | None = None
    true_reward: np.ndarray | None = None
    item: np.ndarray | None = None
    episode: np.ndarray | None = None
    step: np.ndarray | None = None
    source: str = "log"

    def __post_init__(self) -> None:
        """Check shapes, and that no sigma_m is negative."""
        reward = _checks.as_numpy("reward", self.reward)
        ratings = _checks.as_numpy("ratings", self.ratings)
        if reward.ndim != 1 or not reward.size:
            raise _checks.InvalidValueError("reward.shape", reward.shape, "(n,) with at least one row")
        if ratings.ndim != 2 or len(ratings) != len(reward):
            raise _checks.InvalidValueError("ratings.shape", ratings.shape, f"({len(reward)}, K), a row per reward")
        raters = tuple(self.raters) or tuple(f"rating_{k + 1}" for k in range(ratings.shape[1]))
        if len(raters) != ratings.shape[1]:
            raise _checks.InvalidValueError("raters", raters, f"{ratings.shape[1]} names, one per column of ratings")
        checked: dict[str, Any] = {"reward": reward, "ratings": ratings, "raters": raters}
        for name in (*NUMBERS, *LABELS):
            column = getattr(self, name)
            if column is not None:
                column = _checks.as_numpy(name, column) if name in NUMBERS else np.asarray(column)
                _checks.same_shape(name, column, "reward", reward)
                checked[name] = column
        if "sigma_m" in checked and (checked["sigma_m"] < 0).any():
            row = int(np.argmax(checked["sigma_m"] < 0))
            raise _bad_cell(self.source, row, "sigma_m", float(checked["sigma_m"][row]), "a number >= 0")
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.reward)

    def place(self, row: int) -> str:
        """Name a row, counted here from 0: ``row 7 (episode 2, step 3)``."""
        labels = [f"{n} {getattr(self, n)[row]}" for n in ("episode", "step") if getattr(self, n) is not None]
        return f"row {row + 1}" + (f" ({', '.join(labels)})" if labels else "")


def read(path: str | Path, reward: str = "reward", ratings: Sequence[str] | None = None) -> RatingLog:
    """Read a log from a file.

    Args:
        path: A ``.csv`` (or ``.tsv``), ``.jsonl`` (or ``.ndjson``) or ``.parquet`` file. Text is UTF-8; a CSV is
            separated by commas, semicolons or tabs and has a header.
        reward: Name of the column of rewards.
        ratings: Names of the annotators' columns; all that start with ``rating`` if left out.

    Raises:
        InvalidValueError: the file cannot be read or is empty, a column is missing (the message lists those that are
            there), or a cell is no number (it names row and column); a Parquet file without pyarrow.
    """
    path = Path(path)
    kind = FORMATS.get(path.suffix.lower())
    if kind is None:
        raise _checks.InvalidValueError("log", str(path), f"a file that ends in {', '.join(FORMATS)}")
    wanted = _Wanted(str(path), reward, None if ratings is None else tuple(ratings))
    try:
        columns = {"CSV": _csv, "JSONL": _jsonl, "Parquet": _parquet}[kind](path, wanted)
    except OSError as error:
        why = os.strerror(error.errno) if error.errno else error
        raise _checks.InvalidValueError("log", str(path), f"a file that can be read ({why})") from None
    except UnicodeDecodeError as error:
        raise _checks.InvalidValueError(
            "log", str(path), f"UTF-8 text (byte {error.start}: {error.object[error.start : error.start + 1]!r})"
        ) from None
    return _assembled(columns, wanted)


def from_columns(
    columns: Mapping[str, Any], reward: str = "reward", ratings: Sequence[str] | None = None, source: str = "log"
) -> RatingLog:
    """Take a log from named columns: a dict of lists or arrays, or a pandas data frame.

    Args:
        columns: Name to column; None and NaN mean that a number is missing.
        reward: Name of the column of rewards.
        ratings: Names of the annotators' columns; all that start with ``rating`` if left out.
        source: What to call the log in messages.

    Raises:
        InvalidValueError: see ``read``.
    """
    wanted = _Wanted(source, reward, None if ratings is None else tuple(ratings))
    names = list(columns)
    wanted.check(names)
    return _assembled({n: list(columns[n]) for n in names if wanted.has(n)}, wanted)


def rollout(env: Any, steps: int = 1000, seed: int = 0) -> RatingLog:
    """Take random actions in a Gymnasium environment and log what it pays and what is said of it.

    Read from ``info``: ``ratings``, K numbers; ``sigma_m``; and ``evaluation.true_reward`` as the environments of this
    package give it. Where states and actions are whole numbers a row's item is its state-action.

    Args:
        env: A ``gymnasium.Env``; it is not closed.
        steps: Number of steps, >= 1.
        seed: Seed of the environment and of the actions.

    Raises:
        InvalidValueError: the number of ratings or what ``info`` holds changes from one step to another.
    """
    _checks.whole("steps", steps, low=1)
    _checks.whole("seed", seed, low=0)
    env.action_space.seed(seed)
    columns: dict[str, list[Any]] = {n: [] for n in ("reward", "ratings", "sigma_m", "true_reward", *LABELS)}
    state, _ = env.reset(seed=seed)
    episode = step = 0
    for _ in range(steps):
        action = env.action_space.sample()
        following, reward, terminated, truncated, info = env.step(action)
        said = {"ratings": info.get("ratings"), "sigma_m": info.get("sigma_m")}
        said["true_reward"] = info["evaluation"].true_reward if "evaluation" in info else None
        whole = isinstance(state, int | np.integer) and isinstance(action, int | np.integer)
        said["item"] = f"state {state}, action {action}" if whole else None
        for name, value in (said | {"reward": float(reward), "episode": episode, "step": step}).items():
            columns[name].append(value)
        state, step = following, step + 1
        if terminated or truncated:
            state, _ = env.reset()
            episode, step = episode + 1, 0
    for name in ("ratings", "sigma_m", "true_reward", "item"):
        absent = [v is None for v in columns[name]]
        if any(absent):
            if not all(absent):
                row = absent.index(not absent[0])
                raise _bad_cell("rollout", row, name, columns[name][row], "in info at every step, or at none")
            del columns[name]
    widths = [np.shape(v) for v in columns.get("ratings", ())]
    for row, width in enumerate(widths):
        if len(width) != 1 or width != widths[0]:
            raise _bad_cell("rollout", row, "ratings", columns["ratings"][row], "a row of K ratings, as in the first")
    ratings = columns.pop("ratings", np.zeros((steps, 0)))
    name = "rollout" if env.spec is None else env.spec.id
    source = f"{name}, {steps} random steps, seed {seed}"
    return RatingLog(ratings=ratings, source=source, **columns)  # type: ignore[arg-type]


def _bad_cell(source: str, row: int, column: str, value: object, allowed: str) -> _checks.InvalidValueError:
    return _checks.InvalidValueError(f"{source}: row {row + 1}, column {column!r}", value, allowed)


@dataclass(frozen=True)
class _Wanted:
    """Which columns of a source are read."""

    source: str
    reward: str
    ratings: tuple[str, ...] | None

    def has(self, name: str) -> bool:
        return name == self.reward or name in NUMBERS or name in LABELS or bool(self.among([name]))

    def among(self, names: Iterable[str]) -> list[str]:
        """Return the annotators' columns among ``names``; ``x[0]`` is a part of ``x``."""
        others = [n for n in names if n != self.reward]
        if self.ratings is None:
            return [n for n in others if n.startswith("rating")]
        return [n for r in self.ratings for n in others if n == r or n.startswith(f"{r}[")]

    def check(self, names: Sequence[str]) -> None:
        """Say which columns are there if one that is needed is not."""
        whole = {name.partition("[")[0] for name in names} | set(names)
        for needed in (self.reward, *(self.ratings or ())):
            if needed not in whole:
                raise _checks.UnknownNameError(f"{self.source}: column", needed, names)
        if not self.among(names):
            allowed = f"there; name them with ratings (--ratings). Columns: {', '.join(names)}"
            raise _checks.InvalidValueError(f"{self.source}: columns that start with", "rating", allowed)
        for name in names:
            if names.count(name) > 1 and self.has(name):
                raise _checks.InvalidValueError(f"{self.source}: column", name, "there only once")


def _assembled(columns: Mapping[str, Any], wanted: _Wanted) -> RatingLog:
    numbers = {n: _numbers(c, n, wanted.source) for n, c in columns.items() if n not in LABELS}
    lengths = {n: len(c) for n, c in columns.items()}
    for name, length in lengths.items():
        if length != lengths[wanted.reward]:
            allowed = f"of {lengths[wanted.reward]} rows, like {wanted.reward!r}"
            raise _checks.InvalidValueError(f"{wanted.source}: column {name!r}", f"{length} rows", allowed)
    if not lengths[wanted.reward]:
        raise _checks.InvalidValueError("log", wanted.source, "a log with at least one row")
    order = wanted.among(numbers)
    return RatingLog(
        reward=numbers[wanted.reward],
        ratings=np.stack([numbers[n] for n in order], axis=1),
        raters=tuple(order),
        **{n: numbers[n] for n in NUMBERS if n in numbers},
        **{n: np.asarray([str(x) for x in columns[n]]) for n in LABELS if n in columns},
        source=wanted.source,
    )


_PLAIN = frozenset((int, float, type(None), np.float64, np.float32, np.int64, np.int32))
_A_NUMBER = "a number, or nothing where it is missing"


def _numbers(cells: Any, column: str, source: str) -> np.ndarray:
    """Return a column as floats, NaN where a number is missing; text is none, even if it reads like one."""
    if isinstance(cells, np.ndarray):
        return cells
    if set(map(type, cells)) <= _PLAIN:
        try:
            return np.array(cells, dtype=float)
        except OverflowError:  # a whole number of more than 300 digits
            pass
    return np.array([_number(x, row, column, source) for row, x in enumerate(cells)], dtype=float)


def _number(cell: Any, row: int, column: str, source: str) -> float:
    if cell is None:
        return np.nan
    try:
        if isinstance(cell, bool | np.bool_ | str | bytes):
            raise TypeError
        return float(cell)
    except (TypeError, ValueError, OverflowError):
        raise _bad_cell(source, row, column, cell, _A_NUMBER) from None


def _csv(path: Path, wanted: _Wanted) -> dict[str, Any]:
    with path.open(encoding="utf-8-sig", newline="") as file:
        first = file.readline()
        if not first.strip():
            raise _checks.InvalidValueError("log", str(path), "a CSV file whose first line names its columns")
        _no_binary(first, path)
        separator = max(",;\t", key=first.count)
        names = [name.strip() for name in next(csv.reader([first], delimiter=separator))]
        wanted.check(names)
        places = [(names.index(n), n) for n in dict.fromkeys(names) if wanted.has(n)]
        parts: dict[str, list[Any]] = {n: [] for _, n in places}
        start = 0
        for rows in _chunks(csv.reader(file, delimiter=separator), path):
            if set(map(len, rows)) != {len(names)}:
                i = next(i for i, row in enumerate(rows) if len(row) != len(names))
                allowed = f"{len(names)} cells, as the header has"
                raise _checks.InvalidValueError(f"{path}: row {start + i + 1}", separator.join(rows[i]), allowed)
            for place, name in places:
                cells = [row[place] for row in rows]
                parts[name].append(cells if name in LABELS else _parsed(cells, start, name, str(path)))
            start += len(rows)
    return {
        n: [x for p in part for x in p] if n in LABELS else np.concatenate([np.zeros(0), *part])
        for n, part in parts.items()
    }


def _chunks(reader: Iterator[list[str]], path: Path) -> Iterator[list[list[str]]]:
    """Yield rows in chunks; empty lines are no rows."""
    full = (row for row in reader if row)
    while True:
        try:
            rows = list(islice(full, _CHUNK))
        except csv.Error as error:
            raise _checks.InvalidValueError("log", str(path), f"a CSV file ({error})") from None
        if not rows:
            return
        yield rows


def _parsed(cells: list[str], start: int, column: str, source: str) -> np.ndarray:
    try:
        return np.array([float(cell or "nan") for cell in cells])
    except ValueError:
        return np.array([_from_text(cell, start + i, column, source) for i, cell in enumerate(cells)])


def _from_text(cell: str, row: int, column: str, source: str) -> float:
    try:
        return float(cell)
    except ValueError:
        if cell.strip().lower() in _MISSING:
            return np.nan
        raise _bad_cell(source, row, column, cell, _A_NUMBER) from None


def _no_binary(text: str, path: Path) -> None:
    if "\0" in text:
        raise _checks.InvalidValueError("log", str(path), "text, not binary data")


def _jsonl(path: Path, wanted: _Wanted) -> dict[str, Any]:
    columns: dict[tuple[str, int | None], list[Any]] = {}
    others: set[str] = set()
    row = 0

    def put(name: str, part: int | None, cell: Any) -> None:
        column = columns.get((name, part))
        if column is None:
            if not wanted.has(name):
                others.add(name)
                return
            column = columns[name, part] = [None] * row
        column.extend([None] * (row - len(column)))
        column.append(cell)

    with path.open(encoding="utf-8-sig") as file:
        for line in file:
            if line.isspace():
                continue
            for name, value in _entry(line, row, path, wanted.reward).items():
                if isinstance(value, list):
                    for part, cell in enumerate(value):
                        put(name, part, cell)
                else:
                    put(name, None, value)
            row += 1
    if not row:
        raise _checks.InvalidValueError("log", str(path), "a JSONL file with at least one row")
    for column in columns.values():
        column.extend([None] * (row - len(column)))
    named = {name if part is None else f"{name}[{part}]": column for (name, part), column in columns.items()}
    wanted.check([*named, *others])
    return named


def _entry(line: str, row: int, path: Path, reward: str) -> dict[str, Any]:
    _no_binary(line, path)
    try:
        entry = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise _checks.InvalidValueError(f"{path}: row {row + 1}", line.strip(), f"JSON ({error})") from None
    if not isinstance(entry, dict):
        raise _checks.InvalidValueError(f"{path}: row {row + 1}", entry, "a JSON object")
    if reward not in entry:
        raise _checks.UnknownNameError(f"{path}: row {row + 1}, column", reward, entry)
    return entry


def _parquet(path: Path, wanted: _Wanted) -> dict[str, Any]:
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ModuleNotFoundError:
        allowed = "a CSV or JSONL file, or first: pip install 'uard[doctor]' (pyarrow reads Parquet)"
        raise _checks.InvalidValueError("log", str(path), allowed) from None
    try:
        file = parquet.ParquetFile(path)
        names = list(file.schema_arrow.names)
        table = file.read([n for n in names if wanted.has(n)])
    except pa.ArrowException as error:
        raise _checks.InvalidValueError("log", str(path), f"a Parquet file ({error})") from None
    columns: dict[str, Any] = {}
    for name in table.column_names:
        column = table.column(name)
        kind = column.type
        if name in LABELS:
            columns[name] = column.to_pylist()
        elif pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind) or pa.types.is_large_list(kind):
            rows = [x or [] for x in column.to_pylist()]
            for i in range(max(map(len, rows), default=0)):
                columns[f"{name}[{i}]"] = [row[i] if i < len(row) else None for row in rows]
        elif any(t(kind) for t in (pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal, pa.types.is_null)):
            columns[name] = np.asarray(column.cast(pa.float64()).to_numpy(), dtype=float)
        else:
            raise _checks.InvalidValueError(f"{path}: column {name!r}", str(kind), "a column of numbers")
    wanted.check([*columns, *(n for n in names if not wanted.has(n))])
    return columns
