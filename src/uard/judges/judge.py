"""A judge with manners: asked again when it fails, not by too many at once, not twice the same, and not for ever."""

from __future__ import annotations

import asyncio
import inspect
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence, Set
from typing import Any, cast

import numpy as np

from uard import _checks
from uard.judges.asking import (
    Scores,
    UnfitJudgeError,
    as_scores,
    awaited,
    check_name,
    copies_of,
    is_async,
    is_listed,
    listed,
    name_of,
    refuse_unfit,
)
from uard.judges.contents import content_of
from uard.judges.places import LateError, Part, Places, Workers

MOST = 1_000_000  # scores that a cache may keep
LONGEST = 60.0  # seconds between two attempts
HANGING = 8  # calls about one completion that may hang at once, where no number is given; all others are late at once
GRACE = 1.0  # seconds that an async function has for cleaning up when it is late, before it counts as hanging
_OF_PROCESS = ("_lock", "_places", "_cache")  # not pickled; in a cache may be objects of this process


class Judge:
    """A reward function, and how to ask it; itself a reward function that is asked about a batch.

    Examples:
        >>> def stars(prompt, completion, **question):
        ...     return -1 if "?" in completion else len(completion)  # -1: it could not parse the answer
        >>> judge = Judge(stars, per_sample=True, failures=[-1], cache=1000)
        >>> judge(prompts=["why?"] * 3, completions=["so", "what?", "so"])
        [2.0, nan, 2.0]

    Attributes:
        function: What is asked.
        per_sample: Whether it is asked about one completion at a time.
        timeout: Seconds for a call, or None.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        name: str | None = None,
        *,
        per_sample: bool = False,
        timeout: float | None = None,
        retries: int = 0,
        backoff: float = 1.0,
        concurrent: int | None = None,
        cache: int = 0,
        failures: Sequence[float] = (),
    ):
        """Say how to ask a reward function.

        Args:
            function: Plain or ``async``. Of a batch: as ``uard.judges.ask`` calls it, with ``prompts``, ``completions``
                and the question's other columns. Per sample: with ``prompt``, ``completion`` and the other columns'
                own entries; it returns one number or None.
            name: Of the judge; the function's if left out.
            per_sample: Whether it is asked about one completion at a time.
            timeout: Seconds > 0 for a batch or, per sample, for one completion, with all attempts but without waiting
                for a place; no limit if left out. What is late is missing. A plain function is left alone in its thread
                then, and an ``async`` one is cancelled. As long as ``concurrent`` of them (of those about one
                completion 8, about a batch 1, if left out) still hang, all further ones are late at once.
            retries: Further attempts >= 0 after one that raised.
            backoff: Seconds >= 0 before the second attempt, twice as many before each next, at most a minute.
            concurrent: Calls >= 1 that may be under way at once, from all threads and event loops of the process,
                those that are late and still hang among them. If left out, plain functions are asked about one sample
                after the other, and ``async`` ones about all at once.
            cache: Scores >= 0 that are kept: a prompt and completion of the same content (texts, messages, images,
                arrays) are not asked about again, even if others of their batch failed. Only where nothing else decides
                the score.
            failures: Scores that it gives when it has failed; they are missing.

        Raises:
            InvalidValueError: naming the argument.
        """
        if not callable(function):
            raise _checks.InvalidValueError("function", function, "a reward function")
        _checks.truth("per_sample", per_sample)
        if timeout is not None:
            _checks.number("timeout", timeout, low=0, high=threading.TIMEOUT_MAX, open_low=True)
        _checks.whole("retries", retries, high=100)
        _checks.number("backoff", backoff, low=0)
        if concurrent is not None:
            _checks.whole("concurrent", concurrent, low=1, high=1000)
        _checks.whole("cache", cache, high=MOST)
        if (not is_listed(failures) and not isinstance(failures, Set)) or getattr(failures, "shape", None) == ():
            raise _checks.InvalidValueError("failures", failures, "a list of numbers")
        for value in failures:
            _checks.number("failures", value)
        self.__name__ = name_of(function) if name is None else name
        check_name("name of a judge", self.__name__)
        self.function, self.per_sample, self.timeout = function, per_sample, timeout
        self.is_async = is_async(function)
        self._retries, self._backoff, self._concurrent = retries, backoff, concurrent
        self._most, self._failures = cache, tuple(failures)
        self._start()

    def _start(self) -> None:
        """Set up what belongs to this process and is not kept."""
        self._lock = threading.Lock()
        self._cache: OrderedDict[Hashable, float] = OrderedDict()
        self._places = Places(self._concurrent, hanging=HANGING if self.per_sample else 1)

    def __getstate__(self) -> dict[str, Any]:
        """Return what pickling keeps."""
        return {name: value for name, value in vars(self).items() if name not in _OF_PROCESS}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take it up again."""
        vars(self).update(state)
        self._start()

    def __repr__(self) -> str:
        """Name it."""
        return f"Judge({self.__name__!r})"

    def __call__(self, prompts: Sequence[Any], completions: Sequence[Any], **columns: Any) -> Any:
        """Return ``Scores``, NaN where there is none; of an ``async`` function, an awaitable of them.

        Args:
            prompts: B prompts.
            completions: B completions.
            columns: What else the function is told; lists, tuples, arrays, tensors and the like of B rows are columns.

        Raises:
            InvalidValueError: there is not one prompt per completion, the function does not take such a question, or it
                gave something else than scores.
            Exception: what the function raised in its last attempt, if there is no score at all.
        """
        return self._answer({"prompts": prompts, "completions": completions, **columns}, self.timeout)

    def answer_unlimited(self, prompts: Sequence[Any], completions: Sequence[Any], **columns: Any) -> Any:
        """Do the same without a limit for the batch: ``ask`` keeps it, and knows who is still at work after it."""
        limit = self.timeout if self.per_sample else None
        return self._answer({"prompts": prompts, "completions": completions, **columns}, limit)

    def _answer(self, question: dict[str, Any], limit: float | None) -> Any:
        prompts, completions = question["prompts"], question["completions"]
        if len(prompts) != len(completions):
            allowed = f"{len(completions)}, one per completion"
            raise _checks.InvalidValueError("number of prompts", len(prompts), allowed)
        keys = self._keys(prompts, completions)
        with self._lock:
            known = {key: self._cache[key] for key in keys if key in self._cache}
        first = {key: row for row, key in reversed([*enumerate(keys)]) if key not in known}
        parts = self._parts(question, keys, sorted(first.values()))
        if self.is_async:
            return self._later(keys, known, parts, limit)
        return self._scores(keys, known, parts, self._outcomes(parts, limit))

    def _keys(self, prompts: Sequence[Any], completions: Sequence[Any]) -> list[Hashable]:
        """Return what tells questions apart: the place in the batch where nothing is kept."""
        if not self._most:
            return [*range(len(completions))]
        return [(content_of(asked), content_of(said)) for asked, said in zip(prompts, completions, strict=True)]

    def _parts(self, question: dict[str, Any], keys: Sequence[Hashable], rows: Sequence[int]) -> list[Part]:
        """Return what is asked at once: about all these rows, or about one after the other."""
        size = len(keys)
        columns = {name for name, values in question.items() if _is_column(values, size)}
        if self.per_sample:
            one = {"prompts": "prompt", "completions": "completion"}
            parts: list[Part] = []
            for row in rows:
                own = {n: _entry(x, row) if n in columns else x for n, x in question.items() if n not in one.values()}
                parts.append(Part([row], [keys[row]], {one.get(n, n): x for n, x in own.items()}))
            return parts
        if not rows:
            return []
        if len(rows) < size:
            question = {name: _of_rows(x, rows) if name in columns else x for name, x in question.items()}
        return [Part(rows, [keys[row] for row in rows], question)]

    def _outcomes(self, parts: Sequence[Part], limit: float | None) -> list[Any]:
        """Ask a plain function."""
        if limit is None and (self._concurrent is None or not self.per_sample):
            return [self._placed(part) for part in parts]
        return Workers(self._places, self._attempts, parts, self._concurrent or 1).outcomes(limit)

    def _placed(self, part: Part) -> Any:
        """Ask in this thread, when there is a place."""
        place = self._places.ask()
        try:
            place.result()
            return self._attempts(part)
        except Exception as error:
            return error
        finally:
            self._places.leave(place)

    def _attempts(self, part: Part) -> list[float]:
        for wait in self._waits():
            try:
                return self._read(part, awaited(self.function(**copies_of(part.question)())))
            except Exception as error:
                self._raise_unless_mended(part, error, wait)
            time.sleep(wait or 0.0)
        raise AssertionError

    async def _attempts_later(self, part: Part) -> Any:
        """Do the same with an ``async`` function; return what else it raises, for SystemExit would end the loop."""
        try:
            for wait in self._waits():
                try:
                    answer = self.function(**copies_of(part.question)())
                    return self._read(part, await answer if inspect.isawaitable(answer) else answer)
                except Exception as error:
                    self._raise_unless_mended(part, error, wait)
                await asyncio.sleep(wait or 0.0)
        except asyncio.CancelledError as error:
            if (task := asyncio.current_task()) is None or task.cancelling():
                raise
            failed = RuntimeError("it cancelled itself")  # not we it, so that others of the batch go on
            failed.__cause__ = error
            return failed
        except GeneratorExit:
            raise
        except BaseException as error:
            return error
        raise AssertionError

    def _raise_unless_mended(self, part: Part, error: Exception, wait: float | None) -> None:
        """Raise what a call raised, if it is not worth another attempt or there is none."""
        refuse_unfit(self.__name__, self.function, part.question, error)
        if wait is None:
            raise error

    def _waits(self) -> Iterator[float | None]:
        """Yield the seconds to wait after each attempt that fails, None after the last."""
        for attempt in range(self._retries):
            yield min(LONGEST, self._backoff * 2.0**attempt)
        yield None

    def _read(self, part: Part, answer: Any) -> list[float]:
        """Return a function's answer as scores, and keep those that are there."""
        if self.per_sample:
            try:
                scores = as_scores(self.__name__, [answer], 1, part.rows)
            except UnfitJudgeError as error:  # it may answer otherwise when it is asked again, and it is nobody else's
                raise ValueError(str(error.of(self.__name__))) from error
        else:
            scores = as_scores(self.__name__, listed(answer, len(part.rows)), len(part.rows), part.rows)
        scores[np.isin(scores, self._failures)] = np.nan
        found = scores.tolist()
        if self._most:
            with self._lock:  # who has no score may have one later
                self._cache.update({key: x for key, x in zip(part.keys, found, strict=True) if x == x})
                while len(self._cache) > self._most:
                    self._cache.popitem(last=False)
        return found

    async def _later(
        self, keys: Sequence[Hashable], known: Mapping[Hashable, float], parts: Sequence[Part], limit: float | None
    ) -> Scores:
        """Ask an ``async`` function."""
        outcomes = await asyncio.gather(*(self._outcome_later(part, limit) for part in parts))
        return self._scores(keys, known, parts, outcomes)

    async def _outcome_later(self, part: Part, limit: float | None) -> Any:
        place = self._places.ask()
        try:
            await asyncio.wrap_future(place)
        except LateError as error:
            return error
        except BaseException:
            self._places.leave(place)
            raise
        task = asyncio.ensure_future(self._attempts_later(part))
        task.add_done_callback(lambda _: self._places.leave(place))
        if limit is None:
            return await task
        try:
            await asyncio.wait([task], timeout=limit)
            return task.result() if task.done() else LateError()
        finally:
            if not task.done():
                task.cancel()  # which it may ignore, and then it hangs
                asyncio.get_running_loop().call_later(GRACE, self._places.hangs, place)

    def _scores(
        self, keys: Sequence[Hashable], known: Mapping[Hashable, float], parts: Sequence[Part], outcomes: Sequence[Any]
    ) -> Scores:
        """Return all scores in order.

        Raises:
            Exception: what is no failure, or there is nothing but failures.
        """
        found, lost = dict(known), dict[Hashable, Exception]()
        for part, outcome in zip(parts, outcomes, strict=True):
            if isinstance(outcome, UnfitJudgeError) or not isinstance(outcome, list | Exception):
                raise outcome
            if isinstance(outcome, Exception):
                lost |= dict.fromkeys(part.keys, outcome)
            else:
                found |= dict(zip(part.keys, cast("list[float]", outcome), strict=True))
        late = sum(isinstance(lost.get(key), LateError) for key in keys)
        failed = sum(key in lost for key in keys) - late
        first = next((error for error in lost.values() if not isinstance(error, LateError)), None)
        if first is not None and failed == len(keys):
            raise first
        return Scores([found.get(key, np.nan) for key in keys], late, failed, first)


def _is_column(values: Any, size: int) -> bool:
    """Whether something has so many rows; a text and a dictionary have other parts, and an array may have no rows."""
    try:
        return is_listed(values) and hasattr(values, "__getitem__") and len(values) == size
    except TypeError:
        return False


def _entry(column: Any, row: int) -> Any:
    return column.iloc[row] if hasattr(column, "iloc") else column[row]  # the index of a table may be any numbers


def _of_rows(column: Any, rows: Sequence[int]) -> Any:
    if hasattr(column, "iloc"):
        return column.iloc[list(rows)]
    return column[np.array(rows)] if hasattr(column, "shape") else [column[row] for row in rows]
