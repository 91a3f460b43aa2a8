"""Judges: how they are named and asked, and how their scores come to one scale."""

from __future__ import annotations

import asyncio
import functools
import inspect
import math
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from uard import _checks

Judge = Callable[..., Any]

EQUAL = 1e-9  # relative deviation at which numbers count as equal
RESERVED = {"raw", "weight", "sigma_h", "sigma_m"}  # names of other columns in the logs


class JudgeError(RuntimeError):
    """A judge raised; the message names it, and what it raised is the cause."""


@dataclass
class Scale:
    """Mean and standard deviation of all numbers so far, or fixed ones.

    Attributes:
        count: Numbers so far.
        location: Their mean.
        square: Sum of their squared distances from it.
        fixed: The deviation that the user gave; None for the running one.
    """

    count: int = 0
    location: float = 0.0
    square: float = 0.0
    fixed: float | None = None

    @property
    def deviation(self) -> float:
        """Population standard deviation; 0 while all numbers are equal, up to rounding."""
        if self.fixed is not None:
            return self.fixed
        deviation = math.sqrt(self.square / self.count) if self.count else 0.0
        return deviation if deviation > EQUAL * abs(self.location) else 0.0

    def observe(self, values: np.ndarray) -> None:
        """Take in some numbers [Chan et al. 1979], unless the scale is fixed."""
        if self.fixed is not None or values.size == 0:
            return
        mean, total = float(values.mean()), self.count + values.size
        gap = mean - self.location
        self.square += float(((values - mean) ** 2).sum()) + gap * gap * self.count * values.size / total
        self.location += gap * values.size / total
        self.count = total

    def ratings(self, values: np.ndarray) -> np.ndarray:
        """(x - location) / deviation; NaN while the deviation is 0, when a number tells nothing."""
        return (values - self.location) / (self.deviation or math.nan)


def by_name(judges: Mapping[str, Judge] | Sequence[Judge]) -> dict[str, Judge]:
    """Return the judges by their names: the keys of a mapping, else their ``__name__``.

    Raises:
        InvalidValueError: for fewer than two, and for judges that cannot be called or told apart.
    """
    pairs = list(judges.items()) if isinstance(judges, Mapping) else [(_name(judge), judge) for judge in judges]
    names = [name for name, _ in pairs]
    if len(pairs) < 2:
        allowed = "at least two: one never disagrees with itself and would be trusted blindly (members of an ensemble "
        raise _checks.InvalidValueError("judges", names, allowed + "are judges too)")
    for name, judge in pairs:
        if hasattr(judge, "get_input_embeddings"):
            raise _checks.InvalidValueError(f"judge {name!r}", type(judge), "a function: RewardModel(model, tokenizer)")
        if not callable(judge):
            raise _checks.InvalidValueError(f"judge {name!r}", judge, "a reward function or a RewardModel")
    if len(set(names)) < len(names) or RESERVED & set(names):
        allowed = f"different names, none of {', '.join(sorted(RESERVED))}: give the judges as a dictionary"
        raise _checks.InvalidValueError("names of the judges", names, allowed)
    return dict(pairs)


def ask(judges: Mapping[str, Judge], question: dict[str, Any]) -> dict[str, Any]:
    """Ask every judge, the ``async`` ones at the same time as the others, and return what each gave.

    Raises:
        JudgeError: if one raises.
    """
    size, answers = len(question["completions"]), {}
    for name, judge in judges.items():
        with _blaming(name, size):
            answer = judge(**question)
        if inspect.iscoroutine(answer):
            answer = asyncio.run_coroutine_threadsafe(answer, _event_loop(os.getpid()))
        answers[name] = answer
    for name, answer in answers.items():
        if isinstance(answer, Future):
            with _blaming(name, size):
                answers[name] = answer.result()
    return answers


def as_scores(name: str, answer: Any, size: int) -> np.ndarray:
    """Return a judge's answer as (size,) numbers, NaN where it gave None or NaN.

    Raises:
        InvalidValueError: for another number of scores, or one that is no finite number; names judge and place.
    """
    try:
        answer = answer.tolist() if hasattr(answer, "tolist") else list(answer)
    except TypeError:
        allowed = f"a list of {size} numbers (or None), one per completion"
        raise _checks.InvalidValueError(f"what judge {name!r} gave", answer, allowed) from None
    if not isinstance(answer, list) or len(answer) != size:
        got = len(answer) if isinstance(answer, list) else answer
        raise _checks.InvalidValueError(f"number of scores of judge {name!r}", got, f"{size}, one per completion")
    scores = np.full(size, math.nan)
    for index, score in enumerate(answer):
        if score is None:
            continue
        plain = score.item() if getattr(score, "shape", None) == () else score
        if not isinstance(plain, int | float) or math.isinf(plain):
            allowed = "a finite number, or None or NaN where the judge has no score"
            raise _checks.InvalidValueError(f"score {index} of judge {name!r}", score, allowed)
        scores[index] = plain
    return scores


def _name(judge: Any) -> str:
    while isinstance(judge, functools.partial):
        judge = judge.func
    return getattr(judge, "__name__", type(judge).__name__)


@contextmanager
def _blaming(name: str, size: int) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        raise JudgeError(f"judge {name!r} raised on {size} completions: {type(error).__name__}: {error}") from error


@functools.cache
def _event_loop(process: int) -> asyncio.AbstractEventLoop:
    """Return this process's one loop for judges, so that a client which a judge keeps stays usable."""
    loop = asyncio.new_event_loop()
    threading.Thread(target=loop.run_forever, name="uard-judges", daemon=True).start()
    return loop
