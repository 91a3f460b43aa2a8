"""Logs of scores: a row per completion, a score of each judge."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from uard import _checks
from uard.judges.asking import RESERVED
from uard.judges.contents import content_of
from uard.ratings.readers.columns import Choice, Numbers, names_in
from uard.ratings.readers.formats import table

if TYPE_CHECKING:
    from jaxtyping import Float, Integer

SCORES = "scores"  # a column of objects: each judge's score by its name


@dataclass(frozen=True, eq=False)
class ScoreLog:
    """Scores of n completions.

    Examples:
        >>> log = ScoreLog(("a", "b"), np.array([[1.0, 2.0], [3.0, np.nan]]), prompts=["why?", "why?"])
        >>> log.groups.tolist()
        [0, 0]

    Attributes:
        judges: Names of the K judges.
        scores: In their own units, NaN where one is missing.
        prompts: Of each completion, or None where it is not known.
        truth: What each completion is really worth, NaN where unknown, or None.
        source: Where it is from.
        missing: Numbers that mean that there is no score, whoever gives them; a panel that is fitted knows them.
    """

    judges: tuple[str, ...]
    scores: Float[np.ndarray, "n K"]
    prompts: Sequence[Any] | None = None
    truth: Float[np.ndarray, " n"] | None = None
    source: str = "scores"
    missing: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Check shapes and numbers.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        scores = _checks.as_numpy("scores", self.scores)
        if scores.ndim != 2 or not len(scores) or scores.shape[1] != len(self.judges):
            allowed = f"(n, {len(self.judges)}) with n >= 1: a column for each of {', '.join(self.judges)}"
            raise _checks.InvalidValueError("scores.shape", scores.shape, allowed)
        for name, column in zip(self.judges, scores.T, strict=True):
            if np.isinf(column).any():
                row = int(np.argmax(np.isinf(column)))
                allowed = "finite numbers; nothing where one is missing"
                raise _checks.InvalidValueError(
                    f"{self.source}: row {row + 1}, score of {name!r}", float(column[row]), allowed
                )
        for value in self.missing:
            _checks.number("missing", value)
        object.__setattr__(self, "scores", np.where(np.isin(scores, self.missing), np.nan, scores))
        for name, values in (("prompts", self.prompts), ("truth", self.truth)):
            if values is not None and len(values) != len(scores):
                raise _checks.InvalidValueError(f"len({name})", len(values), f"{len(scores)}, one per completion")
        if self.truth is not None:
            truth = _checks.as_numpy("truth", self.truth)
            if np.isinf(truth).any():
                raise _checks.InvalidValueError("truth", "inf", "finite numbers, NaN where it is not known")
            object.__setattr__(self, "truth", truth)

    @property
    def groups(self) -> Integer[np.ndarray, " n"]:
        """The number of each completion's prompt, from 0; all different where prompts are not known."""
        if self.prompts is None:
            return np.arange(len(self.scores))
        number: dict[Hashable, int] = {}
        return np.array([number.setdefault(content_of(prompt), len(number)) for prompt in self.prompts], dtype=int)


@dataclass(frozen=True)
class _Columns(Choice):
    source: str
    judges: tuple[str, ...] | None
    prompt: str | None
    truth: str | None

    def candidate(self, name: str) -> bool:
        """See ``Choice``."""
        return True

    def may_be_list(self, name: str) -> bool:
        """See ``Choice``."""
        return name == SCORES

    def columns(self, names: Sequence[str]) -> tuple[Sequence[str], Sequence[str]]:
        """See ``Choice``."""
        for name in (self.prompt, self.truth):
            if name is not None and name not in names:
                raise _checks.UnknownNameError(f"{self.source}: column", name, set(names))
        truth = () if self.truth is None else (self.truth,)
        return (*self.of_judges(names).values(), *truth), [n for n in (self.prompt or "prompt",) if n in names]

    def of_judges(self, names: Sequence[str]) -> dict[str, str]:
        """Return the judges by name, and the column of each."""
        inside = {n.removeprefix(f"{SCORES}."): n for n in names if n.startswith(f"{SCORES}.")} or _of_trl(names)
        if self.judges is None:
            if inside:
                return inside
            allowed = "an object of scores by judge, such as {'clarity': 0.5}; or name the judges' columns with "
            allowed += f"judges (--judges). Columns: {', '.join(names)}"
            raise _checks.InvalidValueError(f"{self.source}: column", SCORES, allowed)
        whole = {column: name for name, column in inside.items()}
        found: dict[str, str] = {}
        for name in self.judges:
            if name not in names and name not in inside:
                if "," in name:
                    allowed = "names with spaces between them, as in --judges clarity tone"
                    raise _checks.InvalidValueError("judges", name, allowed)
                others = {n for n in names if n not in (self.prompt or "prompt", self.truth, SCORES, *whole)}
                raise _checks.UnknownNameError(f"{self.source}: judge", name, {*inside} or others)
            found[whole.get(name, name)] = inside.get(name, name)
        return found


def _of_trl(names: Sequence[str]) -> dict[str, str]:
    """Return the judges by name, and the column of each, of a log that TRL wrote of this package's reward."""
    rewards = [n.removesuffix("/sigma_h") for n in names if n.endswith("/sigma_h")]
    if len(rewards) != 1:
        return {}
    inside = {n.removeprefix(f"{rewards[0]}/"): n for n in names if n.startswith(f"{rewards[0]}/")}
    return {name: column for name, column in inside.items() if name not in RESERVED}


def read_scores(
    path: str | Path | Sequence[str | Path],
    judges: Sequence[str] | None = None,
    *,
    prompt: str | None = None,
    truth: str | None = None,
    missing: Sequence[str] = (),
) -> ScoreLog:
    """Read a log of scores: CSV, JSONL, JSON or Parquet.

    In TRL's files of completions ``UncertaintyDiscountedReward`` has a column ``uard/<judge>`` for each judge.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "scores.jsonl"
        ...     _ = file.write_text('{"prompt": "why?", "scores": {"clarity": 0.5, "tone": null}}')
        ...     log = read_scores(file)
        >>> log.judges, log.scores.tolist(), log.prompts
        (('clarity', 'tone'), [[0.5, nan]], ['why?'])

    Args:
        path: A file, each row a completion; or several of the same judges, as TRL writes one for each step.
        judges: The judges' columns, or some of those in ``scores`` or in TRL's log; all of these if left out.
        prompt: The column of prompts; ``prompt`` if it is there and this is left out.
        truth: The column that says what completions are really worth, if any.
        missing: Further words, or numbers, that mean that a score is missing, whichever judge gives them.

    Raises:
        InvalidValueError: the file cannot be read or is empty, a column is missing, or a cell is no number; the message
            names row and column.
    """
    if isinstance(path, str | Path):
        return _read(path, judges, prompt, truth, missing)
    logs = [_read(one, judges, prompt, truth, missing) for one in path]
    if not logs:
        raise _checks.InvalidValueError("path", path, "at least one file")
    first = logs[0]
    for log in logs:
        same = set(log.judges) == set(first.judges) and (log.prompts is None) == (first.prompts is None)
        if not same:
            allowed = f"the judges of {first.source}, {', '.join(first.judges)}, and prompts in all files or in none"
            raise _checks.InvalidValueError(f"{log.source}: judges", list(log.judges), allowed)
    scores = [log.scores[:, [log.judges.index(name) for name in first.judges]] for log in logs]
    return ScoreLog(
        first.judges,
        np.concatenate(scores),
        None if first.prompts is None else [text for log in logs for text in log.prompts or ()],
        None if first.truth is None else np.concatenate([log.truth for log in logs if log.truth is not None]),
        first.source if len(logs) == 1 else f"{first.source} and {len(logs) - 1} more",
        first.missing,
    )


def _read(
    path: str | Path, judges: Sequence[str] | None, prompt: str | None, truth: str | None, missing: Sequence[str]
) -> ScoreLog:
    named, missing = None if judges is None else names_in("judges", judges), names_in("missing", missing)
    choice = _Columns(str(path), named, prompt, truth)
    numbers = Numbers(str(path), missing)
    columns, names = table(path, choice, numbers)
    found = choice.of_judges([*dict.fromkeys([*columns, *names])])
    scores = np.stack(
        [numbers.of(_as_numbers(columns[column]), column, text=True) for column in found.values()], axis=1
    )
    worth = None if truth is None else numbers.of(columns[truth], truth)
    numbers.check()
    texts = columns.get(prompt or "prompt")
    return ScoreLog(
        tuple(found), scores, None if texts is None else list(texts), worth, str(path), numbers.missing_numbers
    )


def _as_numbers(cells: Any) -> Any:
    """Return truth values, which some judges give, as 1 and 0."""
    if isinstance(cells, np.ndarray):
        return cast("Any", cells)
    return [float(cell) if isinstance(cell, bool) else cell for cell in cells]
