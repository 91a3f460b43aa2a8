"""How judges are named and asked: reward functions as TRL calls them, synchronous or ``async``.

A judge is called with the keywords ``prompts``, ``completions`` and whatever else the question holds, and returns one
number per completion, or None where it has no score.
"""

from __future__ import annotations

import asyncio
import contextvars
import functools
import inspect
import itertools
import math
import os
import sys
import threading
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence, Set
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from uard import _checks

if TYPE_CHECKING:
    from jaxtyping import Float

Judge = Callable[..., Any]
RESERVED = {"raw", "weight", "sigma_h", "sigma_m"}  # names of other columns in the logs
LONGEST = 100  # characters of a name
WORKERS = min(32, (os.cpu_count() or 1) + 4)  # what asyncio.to_thread runs at a time, as in asyncio's own pool


class JudgeError(RuntimeError):
    """A judge raised; the message names it, and what it raised is the cause."""


class Answer(NamedTuple):
    """What became of asking one judge.

    Attributes:
        given: What it returned; None if it was late.
        seconds: How long that took, or was waited for.
        late: Whether it did not answer within its limit, or was not asked because it is busy with an earlier question.
    """

    given: Any
    seconds: float
    late: bool = False


def by_name(judges: Mapping[str, Judge] | Sequence[Judge]) -> dict[str, Judge]:
    """Return the judges by their names: the keys of a mapping, else their ``__name__``.

    Examples:
        >>> def length(completions, **question):
        ...     return [len(text) for text in completions]
        >>> list(by_name([length, max])), list(by_name({"long": length, "also long": length}))
        (['length', 'max'], ['long', 'also long'])

    Args:
        judges: At least two. Names are as ``check_name`` wants them.

    Raises:
        InvalidValueError: for fewer than two, for judges without an order, and for judges that cannot be called or told
            apart.
    """
    given: Any = judges
    if not isinstance(given, Mapping | Sequence) or isinstance(given, str | bytes):
        raise _checks.InvalidValueError("judges", judges, "a list of reward functions, or a dictionary of them by name")
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
        check_name("name of a judge", name)
    if len(set(names)) < len(names) or RESERVED & set(names):
        allowed = f"different names, none of {', '.join(sorted(RESERVED))}: give the judges as a dictionary"
        raise _checks.InvalidValueError("names of the judges", names, allowed)
    return dict(pairs)


def check_name(field: str, name: Any) -> None:
    """Check a name that goes to logs and terminals, where brackets, line ends and escape sequences are instructions.

    Examples:
        >>> check_name("name of a judge", "reads well")

    Raises:
        InvalidValueError: unless it is a text of 1 to 100 printable characters without square brackets.
    """
    good = isinstance(name, str) and 0 < len(name) <= LONGEST and name.isprintable() and not set(name) & set("[]")
    if not good:
        allowed = f"a text of 1 to {LONGEST} printable characters, without square brackets"
        raise _checks.InvalidValueError(field, name, allowed)


def ask(
    judges: Mapping[str, Judge],
    question: dict[str, Any],
    limits: Mapping[str, float] | None = None,
    busy: dict[str, Callable[[], bool]] | None = None,
) -> dict[str, Answer]:
    """Ask every judge, the ``async`` ones at the same time as the others.

    A judge gets lists of its own, so that one which changes them changes nobody else's. A synchronous judge runs here,
    one after the other; one that has a limit runs in a thread of its own, which cannot be stopped when it is late, only
    left alone. ``async`` judges share one loop in one thread and are cancelled when they are late; one that blocks
    this loop (``time.sleep``) makes the others late too. None of these threads keeps the process from ending.

    Examples:
        >>> def length(completions, **question):
        ...     return [len(text) for text in completions]
        >>> async def hangs(completions, **question):
        ...     await asyncio.sleep(3600)
        >>> answers = ask({"length": length, "hangs": hangs}, {"completions": ["why?", "so"]}, limits={"hangs": 0.1})
        >>> answers["length"].given, answers["hangs"].late
        ([4, 2], True)

    Args:
        judges: By name, see ``by_name``.
        question: The keywords with which each is called; ``completions`` among them.
        limits: Seconds > 0 by name; a judge that is not named has no limit.
        busy: Judges that were late before, by name, and whether they still are at it: these are not asked. Judges that
            are late now are added to it.

    Returns:
        By name.

    Raises:
        JudgeError: if one raises an Exception or SystemExit; what else it raises passes as it is.
    """
    size = len(question["completions"])
    limits, busy = limits or {}, {} if busy is None else busy
    calls: dict[str, _Call] = {}
    answers = {name: Answer(None, 0.0, late=True) for name in judges}
    try:
        for name in [name for name in judges if name not in busy or not busy[name]()]:
            with _Naming(name, size):
                calls[name] = _start(judges[name], _with_own_lists(question), size, limits.get(name))
        for name, call in calls.items():
            with _Naming(name, size):
                answers[name] = call.answer()
            if answers[name].late:
                busy[name] = call.busy
    finally:
        for call in calls.values():
            call.future.cancel()
    return answers


def as_scores(name: str, answer: Any, size: int) -> Float[np.ndarray, " B"]:
    """Return a judge's answer as numbers, NaN where it gave None or NaN.

    Examples:
        >>> as_scores("length", [4, None], size=2).tolist()
        [4.0, nan]

    Args:
        name: The judge's, for messages.
        answer: What it returned: a list, an array or a tensor, of numbers or truth values (1 and 0). A dictionary, a
            set and a text have no score per completion.
        size: B, how many completions it was asked about.

    Raises:
        InvalidValueError: for another number of scores, or one that is no finite number; names judge and place.
    """
    allowed = f"a list of {size} numbers (or None), one per completion"
    if not hasattr(answer, "tolist") and not is_listed(answer):
        raise _checks.InvalidValueError(f"answer of judge {name!r}", answer, allowed)
    try:
        listed: Any = answer.tolist() if hasattr(answer, "tolist") else list(answer)
    except Exception as error:
        raise _checks.InvalidValueError(f"answer of judge {name!r}", answer, allowed) from error
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
        plain = score.item() if getattr(score, "shape", None) == () and hasattr(score, "item") else score
        if not isinstance(plain, int | float) or abs(plain) > sys.float_info.max:
            allowed = "a finite number, or None or NaN where the judge has no score"
            raise _checks.InvalidValueError(f"score {index} of judge {name!r}", score, allowed)
        scores[index] = plain
    return scores


def is_listed(values: Any) -> bool:
    """Whether something has parts in an order that says which is whose; a text and a dictionary have other parts.

    Examples:
        >>> is_listed((1, 2)), is_listed("12"), is_listed({1: 2}), is_listed({1, 2}), is_listed(None)
        (True, False, False, False, False)
    """
    others: tuple[Any, ...] = (str, bytes, bytearray, Mapping, Set)
    return hasattr(values, "__len__") and not isinstance(values, others)


def _name(judge: Any) -> str:
    while isinstance(judge, functools.partial):
        judge = cast("functools.partial[Any]", judge).func
    return getattr(judge, "__name__", type(judge).__name__)


class _Naming:
    """Turns an Exception of a block into a ``JudgeError``; as a generator it could not do so with StopIteration."""

    def __init__(self, name: str, size: int):
        self._judge = f"judge {name!r} raised on {size} completions"

    def __enter__(self) -> None:
        return

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, Exception | SystemExit):  # a judge must not end a training as if all were well
            raise JudgeError(f"{self._judge}: {type(error).__name__}: {error}") from error


@dataclass(frozen=True)
class _Raised:
    error: BaseException


@dataclass(frozen=True)
class _Call:
    """A judge at work.

    Attributes:
        future: Of what it gives, and of the time at which it did (``time.monotonic``).
        began: The time at which it was asked.
        limit: Seconds, or None.
        busy: Whether it is still at work; after a limit the future does not know.
    """

    future: Future[tuple[Any, float]]
    began: float
    limit: float | None
    busy: Callable[[], bool]

    def answer(self) -> Answer:
        """Wait for it, at most until the limit."""
        left = None if self.limit is None else max(0.0, self.began + self.limit - time.monotonic())
        if not wait([self.future], left).done:
            return Answer(None, time.monotonic() - self.began, late=True)
        given, ended = self.future.result()
        if isinstance(given, _Raised):
            raise given.error
        return Answer(given, ended - self.began)


def _start(judge: Judge, question: dict[str, Any], size: int, limit: float | None) -> _Call:
    """Call a judge; a synchronous one has answered, or is late, when this returns."""
    future: Future[tuple[Any, float]] = Future()
    began = time.monotonic()

    def call() -> None:
        future.set_running_or_notify_cancel()
        try:
            future.set_result((_listed(judge(**question), size), time.monotonic()))
        except BaseException as error:
            future.set_result((_Raised(error), time.monotonic()))

    if limit is None:
        future.set_result((_listed(judge(**question), size), time.monotonic()))
        busy = future.running
    else:
        context = contextvars.copy_context()
        thread = threading.Thread(target=context.run, args=(call,), name="uard-judge", daemon=True)
        thread.start()
        wait([future], limit)
        busy = thread.is_alive
    given = future.result()[0] if future.done() else None
    if inspect.isawaitable(given):
        work = _awaited(given, size)
        future = asyncio.run_coroutine_threadsafe(work, _event_loop(os.getpid()))
        return _Call(future, began, limit, lambda: inspect.getcoroutinestate(work) != inspect.CORO_CLOSED)
    return _Call(future, began, limit, busy)


async def _awaited(answer: Awaitable[Any], size: int) -> tuple[Any, float]:
    try:
        return _listed(await answer, size), time.monotonic()
    except asyncio.CancelledError:
        raise
    except BaseException as error:  # SystemExit would end the loop, and all later judges would wait for ever
        return _Raised(error), time.monotonic()


def _listed(answer: Any, size: int) -> Any:
    """Return an answer as it is, an iterator's as a list: its work is done here, where it has a name and a limit."""
    if not isinstance(answer, Iterator):
        return answer
    return list(itertools.islice(cast("Iterator[Any]", answer), size + 1))


def _with_own_lists(question: dict[str, Any]) -> dict[str, Any]:
    """Return a question with lists and, of prompts and completions, messages of its own."""
    deep: dict[str, Any] = {name: _copied(question[name]) for name in ("prompts", "completions") if name in question}
    shallow = {name: cast("list[Any]", value)[:] if type(value) is list else value for name, value in question.items()}
    return shallow | deep


def _copied(value: Any) -> Any:
    """Copy lists and dictionaries, whatever they are nested in; not the texts and images in them."""
    if isinstance(value, list):
        return [_copied(part) for part in cast("list[Any]", value)]
    if isinstance(value, dict):
        return {key: _copied(part) for key, part in cast("dict[Any, Any]", value).items()}
    return value


class _Threads(ThreadPoolExecutor):
    """For ``asyncio.to_thread``: threads that do not keep the process from ending, as those of the usual pool do."""

    def __init__(self) -> None:
        super().__init__(max_workers=WORKERS)
        self._places = threading.Semaphore(WORKERS)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()

        def work() -> None:
            with self._places:
                if not future.set_running_or_notify_cancel():
                    return
                try:
                    future.set_result(fn(*args, **kwargs))
                except BaseException as error:
                    future.set_exception(error)

        threading.Thread(target=work, daemon=True).start()
        return future


@functools.cache
def _event_loop(process: int) -> asyncio.AbstractEventLoop:
    """Return this process's one loop for judges, so that a client which a judge keeps stays usable."""
    loop = asyncio.new_event_loop()
    loop.set_default_executor(_Threads())
    threading.Thread(target=loop.run_forever, name="uard-judges", daemon=True).start()
    return loop
