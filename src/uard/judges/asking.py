"""How judges are named and asked: reward functions as TRL calls them, synchronous or ``async``.

A judge is called with the keywords ``prompts``, ``completions`` and whatever else the question holds, and returns one
number per completion, or None where it has no score.
"""

from __future__ import annotations

import asyncio
import functools
import inspect
import math
import os
import threading
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from uard import _checks

if TYPE_CHECKING:
    from jaxtyping import Float

Judge = Callable[..., Any]
RESERVED = {"raw", "weight", "sigma_h", "sigma_m"}  # names of other columns in the logs


class JudgeError(RuntimeError):
    """A judge raised; the message names it, and what it raised is the cause."""


def by_name(judges: Mapping[str, Judge] | Sequence[Judge]) -> dict[str, Judge]:
    """Return the judges by their names: the keys of a mapping, else their ``__name__``.

    Examples:
        >>> def length(completions, **question):
        ...     return [len(text) for text in completions]
        >>> list(by_name([length, max])), list(by_name({"long": length, "also long": length}))
        (['length', 'max'], ['long', 'also long'])

    Args:
        judges: At least two.

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
    """Ask every judge, the ``async`` ones at the same time as the others.

    Examples:
        >>> def length(completions, **question):
        ...     return [len(text) for text in completions]
        >>> async def questions(completions, **question):
        ...     return [text.count("?") for text in completions]
        >>> ask({"length": length, "questions": questions}, {"completions": ["why?", "so"]})
        {'length': [4, 2], 'questions': [1, 0]}

    Args:
        judges: By name, see ``by_name``.
        question: The keywords with which each is called; ``completions`` among them.

    Returns:
        What each judge returned, by name.

    Raises:
        JudgeError: if one raises.
    """
    size = len(question["completions"])
    answers: dict[str, Any] = {}
    for name, judge in judges.items():
        with _naming(name, size):
            answer: Any = judge(**question)
        if inspect.iscoroutine(answer):
            answer = asyncio.run_coroutine_threadsafe(answer, _event_loop(os.getpid()))
        answers[name] = answer
    for name, answer in answers.items():
        if isinstance(answer, Future):
            with _naming(name, size):
                answers[name] = cast("Future[Any]", answer).result()
    return answers


def as_scores(name: str, answer: Any, size: int) -> Float[np.ndarray, " B"]:
    """Return a judge's answer as numbers, NaN where it gave None or NaN.

    Examples:
        >>> as_scores("length", [4, None], size=2).tolist()
        [4.0, nan]

    Args:
        name: The judge's, for messages.
        answer: What it returned: a list, an array or a tensor.
        size: B, how many completions it was asked about.

    Raises:
        InvalidValueError: for another number of scores, or one that is no finite number; names judge and place.
    """
    try:
        listed: Any = answer.tolist() if hasattr(answer, "tolist") else list(answer)
    except TypeError:
        allowed = f"a list of {size} numbers (or None), one per completion"
        raise _checks.InvalidValueError(f"answer of judge {name!r}", answer, allowed) from None
    field, allowed = f"number of scores of judge {name!r}", f"{size}, one per completion"
    if not isinstance(listed, list):  # the tolist() of one number
        raise _checks.InvalidValueError(field, listed, allowed)
    given = cast("list[Any]", listed)
    if len(given) != size:
        raise _checks.InvalidValueError(field, len(given), allowed)
    scores = np.full(size, math.nan)
    for index, score in enumerate(given):
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
        judge = cast("functools.partial[Any]", judge).func
    return getattr(judge, "__name__", type(judge).__name__)


@contextmanager
def _naming(name: str, size: int) -> Generator[None]:
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
