"""How judges are named and asked: reward functions as TRL calls them, synchronous or ``async``.

A judge is called with the keywords ``prompts``, ``completions`` and whatever else the question holds, and returns one
number per completion, or None where it has no score.
"""

from __future__ import annotations

import asyncio
import contextvars
import copy
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

RewardFunction = Callable[..., Any]
RESERVED = {"raw", "weight", "sigma_h", "sigma_m", "why"}  # names of other columns in the logs
LONGEST = 100  # characters of a name
MOST_SAID = 500  # characters of an exception in a message
_Nested = tuple[Any, Callable[[], Any]]  # a place in a list or dictionary, and what copies its part
_IN_ONE_PIECE = {str, int, float, bool, type(None)}  # what has no parts that could be changed
WORKERS = min(32, (os.cpu_count() or 1) + 4)  # what asyncio.to_thread runs at a time, as in asyncio's own pool


class JudgeError(RuntimeError):
    """A judge raised; the message names it, and what it raised is the cause."""


class UnfitJudgeError(_checks.InvalidValueError):
    """A judge cannot be called with a question at all, or its scores cannot be read: asking again mends nothing.

    ``ask`` passes it on, while of a judge that raises anything else scores are missing.
    """

    def __init__(self, what: str, name: str, value: Any, allowed: str):
        """Say what of a judge, if not all of it, has a value that must be something else."""
        super().__init__(f"{what}judge {name!r}", value, allowed)
        self._said = what, value, allowed

    def of(self, name: str) -> UnfitJudgeError:
        """Return the same about a judge that goes by another name here."""
        what, value, allowed = self._said
        return UnfitJudgeError(what, name, value, allowed)


class Scores(list[float]):
    """Scores of a batch, NaN where one is missing, and why some are.

    Examples:
        >>> scores = Scores([1.0, float("nan")], late=1)
        >>> scores, scores.late, scores.failed
        ([1.0, nan], 1, 0)

    Attributes:
        late: Completions for which there was no answer in time.
        failed: Completions for which the judge raised.
        error: What it raised about the first of these, or None.
    """

    def __init__(self, scores: Sequence[float], late: int = 0, failed: int = 0, error: Exception | None = None):
        """Take the scores."""
        super().__init__(scores)
        self.late, self.failed, self.error = late, failed, error


class Answer(NamedTuple):
    """What became of asking one judge.

    Attributes:
        given: What it returned; None if it was late or raised.
        seconds: How long that took, or was waited for.
        late: Whether it did not answer within its limit, or was not asked because it is busy with an earlier question.
        error: What it raised, by the judge's name; None if nothing.
    """

    given: Any
    seconds: float
    late: bool = False
    error: JudgeError | None = None

    @property
    def missed(self) -> bool:
        """Whether there is nothing to read."""
        return self.late or self.error is not None


def by_name(judges: Mapping[str, RewardFunction] | Sequence[RewardFunction]) -> dict[str, RewardFunction]:
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
    pairs = list(judges.items()) if isinstance(judges, Mapping) else [(name_of(judge), judge) for judge in judges]
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
    if taken := RESERVED & set(names):
        raise _checks.InvalidValueError(
            "names of the judges", names, f"others than {', '.join(sorted(taken))}, of the logs"
        )
    if len(set(names)) < len(names):
        allowed = "different names: give the judges as a dictionary, {'name': function, ...}"
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
    judges: Mapping[str, RewardFunction],
    question: dict[str, Any],
    limits: Mapping[str, float] | None = None,
    busy: dict[str, Callable[[], bool]] | None = None,
) -> dict[str, Answer]:
    """Ask every judge, the ``async`` ones at the same time as the others, in whatever order they are given.

    A judge gets lists, dictionaries and tuples of its own, so that one which changes them changes nobody else's. A
    synchronous judge runs here, one after the other; one that has a limit runs in a thread of its own, which cannot be
    stopped when it is late, only left alone. ``async`` judges share one loop in one thread and are cancelled when they
    are late; one that blocks this loop (``time.sleep``) makes the others late too. None of these threads keeps the
    process from ending. A judge that raises an Exception or SystemExit has given nothing, and its answer says why; what
    else it raises passes, and so does the error about one that cannot be called with these keywords at all.

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
        InvalidValueError: a judge does not take the keywords, or a ``Judge`` got something else than scores.
    """
    size = len(question["completions"])
    limits, busy = limits or {}, {} if busy is None else busy
    calls: dict[str, _Call] = {}
    answers = {name: Answer(None, 0.0, late=True) for name in judges}
    own = copies_of(question)

    def without(name: str, began: float, error: BaseException) -> Answer:
        refuse_unfit(name, judges[name], question, error)
        raised = JudgeError(f"judge {name!r} raised on {size} completions: {said(error)}")
        raised.__cause__ = error
        return Answer(None, time.monotonic() - began, error=raised)

    asked = [name for name in judges if name not in busy or not busy[name]()]
    try:
        for name in sorted(asked, key=lambda name: not is_async(judges[name])):  # these are at work beside the others
            began = time.monotonic()
            try:
                calls[name] = _start(judges[name], own(), size, limits.get(name))
            except (Exception, SystemExit) as error:  # a judge must not end a training as if all were well
                answers[name] = without(name, began, error)
        for name, call in calls.items():
            try:
                answers[name] = call.answer()
            except (Exception, SystemExit) as error:
                answers[name] = without(name, call.began, error)
            if answers[name].late:
                busy[name] = call.busy
    finally:
        for call in calls.values():
            call.future.cancel()
    return answers


def refuse_unfit(name: str, judge: RewardFunction, question: Mapping[str, Any], error: BaseException) -> None:
    """Raise if a judge raised because nothing that is wrong with it would be mended by asking again.

    Examples:
        >>> def forgets(prompts, completions):
        ...     return [0.0] * len(completions)
        >>> refuse_unfit("forgets", forgets, {"prompts": [], "completions": [], "solution": []}, TypeError())
        Traceback (most recent call last):
        uard...UnfitJudgeError: judge 'forgets' = '(prompts, completions)': must be ... add **question ...

    Args:
        name: The judge's.
        judge: What was called.
        question: The keywords that it was called with.
        error: What it raised. A TypeError from inside it is its own.

    Raises:
        InvalidValueError: its scores could not be read, or its signature is known and does not take the keywords.
    """
    if isinstance(error, UnfitJudgeError):
        raise error.of(name) from error.__cause__
    if not isinstance(error, TypeError):
        return
    try:
        signature = inspect.signature(judge, follow_wrapped=False)
    except (TypeError, ValueError):  # of some that are written in C
        return
    try:
        signature.bind(**question)
    except TypeError as unbound:
        allowed = f"a function that can be called with the keywords {', '.join(question)} ({unbound}): "
        raise UnfitJudgeError("", name, str(signature), allowed + _advice(signature, question)) from error


def _advice(signature: inspect.Signature, question: Mapping[str, Any]) -> str:
    """Say how a function would take a question that it does not take."""
    one, many = {"prompt", "completion"}, {"prompts", "completions"}
    if one & set(signature.parameters) and many <= set(question):
        return "one that is asked about one completion at a time is Judge(function, per_sample=True)"
    if many & set(signature.parameters) and one <= set(question):
        return "per_sample=True asks about one completion at a time, with prompt and completion"
    empty, named = inspect.Parameter.empty, (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    needs = [n for n, p in signature.parameters.items() if p.default is empty and p.kind in named and n not in question]
    if needs:
        return f"{', '.join(needs)} is not in the question"
    return "add **question to take what it does not need"


def said(error: BaseException) -> str:
    """Return kind and text of an exception, which may fail to give a text, or give a page of it.

    Examples:
        >>> said(OSError("no route"))
        'OSError: no route'
    """
    try:
        text = "".join(c if c.isprintable() else " " for c in str(error)[:MOST_SAID])
    except Exception:
        return type(error).__name__
    return f"{type(error).__name__}: {text}"


def as_scores(name: str, answer: Any, size: int, rows: Sequence[int] | None = None) -> Float[np.ndarray, " B"]:
    """Return a judge's answer as numbers, NaN where it gave None or NaN.

    Examples:
        >>> as_scores("length", [4, None], size=2).tolist()
        [4.0, nan]

    Args:
        name: The judge's, for messages.
        answer: What it returned: a list, an array or a tensor, of numbers or truth values (1 and 0). A dictionary, a
            set and a text have no score per completion.
        size: B, how many completions it was asked about.
        rows: Which completions of the user's these are, for messages; all from 0 on if left out.

    Raises:
        InvalidValueError: for another number of scores, or one that is no finite number; names judge and place.
    """
    allowed = f"a list of {size} numbers (or None), one per completion"
    if not hasattr(answer, "tolist") and not is_listed(answer):
        raise UnfitJudgeError("answer of ", name, answer, allowed)
    try:
        listed: Any = answer.tolist() if hasattr(answer, "tolist") else list(answer)
    except Exception as error:
        raise UnfitJudgeError("answer of ", name, answer, allowed) from error
    allowed = f"{size}, one per completion"
    if not isinstance(listed, list):  # the tolist() of one number
        raise UnfitJudgeError("number of scores of ", name, listed, allowed)
    given = cast("list[Any]", listed)
    if len(given) != size:
        raise UnfitJudgeError("number of scores of ", name, len(given), allowed)
    if set(map(type, given)) <= {float} and not np.isinf(numbers := np.array(given, float)).any():
        return numbers  # what most judges give, at once
    scores = np.full(size, math.nan)
    for index, score in enumerate(given):
        if score is None:
            continue
        if type(score).__name__ == "NAType":  # pandas
            continue
        plain = score.item() if getattr(score, "shape", None) == () and hasattr(score, "item") else score
        if not isinstance(plain, int | float) or abs(plain) > sys.float_info.max:
            allowed = "a finite number, or None or NaN where the judge has no score"
            if isinstance(score, list):
                allowed += "; of scores of shape (B, 1) take scores.squeeze(-1)"
            raise UnfitJudgeError(f"score {index if rows is None else rows[index]} of ", name, score, allowed)
        scores[index] = plain
    return scores


def limits_of(timeout: Any, asked: Mapping[str, RewardFunction]) -> dict[str, float]:
    """Return the seconds that each judge has for a batch, by name; those without a limit are not in it.

    A ``Judge`` keeps its own limit, without the time for which a call waits for its place.

    Examples:
        >>> limits_of({"slow": 30}, {"slow": max, "quick": min}), limits_of(5, {"slow": max})
        ({'slow': 30.0}, {'slow': 5.0})

    Args:
        timeout: Seconds > 0 for each judge, or by name, or None.
        asked: The judges.

    Raises:
        UnknownNameError: there is no such judge.
        InvalidValueError: a number is not allowed.
    """
    given: dict[str, Any] = {}
    if isinstance(timeout, Mapping):
        given = dict(cast("Mapping[str, Any]", timeout))
    elif timeout is not None:
        given = dict.fromkeys(asked, timeout)
    for name, seconds in given.items():
        _checks.choose("name of a judge in timeout", name, asked)
        _checks.number(f"timeout of judge {name!r}", seconds, low=0, high=threading.TIMEOUT_MAX, open_low=True)
    return {name: float(seconds) for name, seconds in given.items()}


def is_listed(values: Any) -> bool:
    """Whether something has parts in an order that says which is whose; a text and a dictionary have other parts.

    Examples:
        >>> is_listed((1, 2)), is_listed("12"), is_listed({1: 2}), is_listed({1, 2}), is_listed(None)
        (True, False, False, False, False)
    """
    others: tuple[Any, ...] = (str, bytes, bytearray, Mapping, Set)
    return hasattr(values, "__len__") and not isinstance(values, others)


def name_of(judge: Any) -> str:
    """Return what a reward function is called: its ``__name__``, or its class's.

    Examples:
        >>> name_of(max), name_of(functools.partial(max, 1))
        ('max', 'max')
    """
    while isinstance(judge, functools.partial):
        judge = cast("functools.partial[Any]", judge).func
    return getattr(judge, "__name__", type(judge).__name__)


def is_async(judge: Any) -> bool:
    """Whether calling a judge only begins its work.

    Examples:
        >>> async def later(**question): ...
        >>> is_async(later), is_async(functools.partial(later, k=1)), is_async(max)
        (True, True, False)
    """
    if isinstance(known := getattr(judge, "is_async", None), bool):  # a Judge knows of its function
        return known
    call = judge
    while isinstance(call, functools.partial):
        call = cast("functools.partial[Any]", call).func
    # What a wrapper wraps says nothing of it: it may wait for an async function itself.
    return inspect.iscoroutinefunction(call if inspect.isroutine(call) else getattr(call, "__call__", call))  # noqa: B004


def awaited(answer: Any) -> Any:
    """Return what a plain function's answer comes to, if that is something to wait for: a coroutine of a client.

    Examples:
        >>> async def later():
        ...     return [1.0]
        >>> awaited(later()), awaited([2.0])
        ([1.0], [2.0])
    """
    if not inspect.isawaitable(answer):
        return answer
    given = asyncio.run_coroutine_threadsafe(_awaited(answer, sys.maxsize - 1), _event_loop(os.getpid())).result()[0]
    if isinstance(given, _Raised):
        raise given.error
    return given


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
        if self.limit is not None and ended > self.began + self.limit:  # and nobody looked, as others were at work
            return Answer(None, ended - self.began, late=True)
        return Answer(given, ended - self.began)


def _start(judge: RewardFunction, question: dict[str, Any], size: int, limit: float | None) -> _Call:
    """Call a judge; a synchronous one has answered, or is late, when this returns."""
    future: Future[tuple[Any, float]] = Future()
    # A Judge would keep a limit of its own, and then nobody knew whether its function is still at work.
    asked = judge if limit is None else getattr(judge, "answer_unlimited", judge)
    began = time.monotonic()

    def call() -> None:
        future.set_running_or_notify_cancel()
        try:
            future.set_result((listed(asked(**question), size), time.monotonic()))
        except BaseException as error:
            future.set_result((_Raised(error), time.monotonic()))

    if limit is None:
        future.set_result((listed(asked(**question), size), time.monotonic()))
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
        return listed(await answer, size), time.monotonic()
    except asyncio.CancelledError:
        raise
    except BaseException as error:  # SystemExit would end the loop, and all later judges would wait for ever
        return _Raised(error), time.monotonic()


def listed(answer: Any, size: int) -> Any:
    """Return an answer as it is, an iterator's as a list: its work is done here, where it has a name and a limit.

    Examples:
        >>> listed(iter("abc"), size=1)  # one too many, to be found out
        ['a', 'b']
    """
    if not isinstance(answer, Iterator):
        return answer
    return list(itertools.islice(cast("Iterator[Any]", answer), size + 1))


def copies_of(value: Any) -> Callable[[], Any]:
    """Return what makes copies of lists, dictionaries and tuples, whatever they are nested in.

    What else is in them, such as texts, images and arrays, is not copied. All is looked through once, so that several
    copies take little longer than one.

    Examples:
        >>> chat = [{"role": "user", "content": "why?"}]
        >>> copy = copies_of(chat)()
        >>> copy == chat, copy[0] is chat[0]
        (True, False)
    """
    return _copier(value) or (lambda: value)


def _copier(value: Any) -> Callable[[], Any] | None:
    """Return what copies, or None where there is nothing to copy."""
    if isinstance(value, dict):
        parts = cast("dict[Any, Any]", value)
        places = parts.items() if not _IN_ONE_PIECE.issuperset(map(type, parts.values())) else ()
    elif isinstance(value, list | tuple):
        parts = cast("list[Any]", value)
        places = enumerate(parts) if not _IN_ONE_PIECE.issuperset(map(type, parts)) else ()
    else:
        return None
    nested = [(place, copier) for place, part in places if (copier := _copier(part)) is not None]
    if isinstance(value, tuple):
        make: Any = getattr(type(parts), "_make", tuple)  # of a named tuple
        own = _filled(list, parts, nested)
        return (lambda: make(own())) if nested else None
    return _filled(copy.copy, parts, nested)


def _filled(copied: Callable[[Any], Any], parts: Any, nested: Sequence[_Nested]) -> Callable[[], Any]:
    def filled() -> Any:
        new = copied(parts)
        for place, copier in nested:
            new[place] = copier()
        return new

    return filled


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


_loops: dict[int, asyncio.AbstractEventLoop] = {}  # by process: a loop does not run in a process that was forked


def _event_loop(process: int) -> asyncio.AbstractEventLoop:
    """Return this process's one loop for judges, so that a client which a judge keeps stays usable."""
    if process not in _loops:
        loop = asyncio.new_event_loop()
        # Of several threads that come here at once one wins. A lock might be held while the process is forked.
        if _loops.setdefault(process, loop) is loop:
            loop.set_default_executor(_Threads())
            threading.Thread(target=loop.run_forever, name="uard-judges", daemon=True).start()
        else:
            loop.close()
    return _loops[process]
