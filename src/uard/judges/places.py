"""Places for calls that may be under way at once, and threads that make such calls and are left alone when late."""

from __future__ import annotations

import contextvars
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future
from typing import Any, NamedTuple


class LateError(TimeoutError):
    """A call did not end in time, or was not made because others hang."""


class Part(NamedTuple):
    """What a function is asked at once.

    Attributes:
        rows: Which completions of a batch it is about.
        keys: What tells these completions apart from others.
        question: The keywords of the call.
    """

    rows: Sequence[int]
    keys: Sequence[Hashable]
    question: dict[str, Any]


class Places:
    """Places for calls that may be under way at once, whichever threads and event loops they are made from.

    Examples:
        >>> places = Places(1)
        >>> first, second = places.ask(), places.ask()
        >>> first.done(), second.done()
        (True, False)
        >>> places.leave(first)
        >>> second.done()
        True
    """

    def __init__(self, number: int | None, hanging: int = 1):
        """Say how many.

        Args:
            number: Of places; any number if None.
            hanging: How many calls may hang where there is any number of places; with a number, as many as there are.
        """
        self._number, self._bound = (math.inf, hanging) if number is None else (number, number)
        self._held: dict[Future[None], bool] = {}  # and whether its call hangs
        self._waiting = deque[Future[None]]()
        self._lock = threading.Lock()

    def ask(self) -> Future[None]:
        """Return a place, which one has once it is done; it raises LateError if too many calls hang."""
        place: Future[None] = Future()
        with self._lock:
            self._waiting.append(place)
            self._give()
        return place

    def leave(self, place: Future[None]) -> None:
        """Give a place back, or no longer wait for it; the second time does nothing."""
        with self._lock:
            if self._held.pop(place, None) is None:
                place.cancel()
            self._give()

    def hangs(self, place: Future[None]) -> None:
        """Say that a call is late and still holds its place; if it has left it, that does nothing."""
        with self._lock:
            if place in self._held:
                self._held[place] = True
            self._give()

    def _give(self) -> None:
        too_many = sum(self._held.values()) >= self._bound
        while self._waiting and (too_many or len(self._held) < self._number):
            place = self._waiting.popleft()
            if not place.set_running_or_notify_cancel():
                continue
            if too_many:
                place.set_exception(LateError(f"{self._bound} calls that were late are still under way"))
            else:
                self._held[place] = False
                place.set_result(None)


class Workers:
    """Threads that ask about one part after the other; none keeps the process from ending."""

    def __init__(self, places: Places, ask: Callable[[Part], Any], parts: Sequence[Part], number: int):
        """Start.

        Args:
            places: Where each call needs one.
            ask: The call.
            parts: What about.
            number: How many threads ask at a time; those that are late do not count.
        """
        self._places, self._ask, self._parts = places, ask, parts
        self._left = deque(range(len(parts)))
        self._changed = threading.Condition()
        self._outcomes: dict[int, Any] = {}
        self._begun: dict[int, tuple[Future[None], float]] = {}
        for _ in range(min(number, len(parts))):
            self._start()

    def outcomes(self, limit: float | None) -> list[Any]:
        """Wait for all; a part that takes longer than ``limit`` seconds is left alone, and so is its thread.

        Returns:
            What each call returned or raised, LateError where it did neither in time.
        """
        try:
            return [self._outcome(number, limit) for number in range(len(self._parts))]
        finally:
            self._left.clear()  # who is interrupted wants no more

    def _outcome(self, number: int, limit: float | None) -> Any:
        with self._changed:
            self._changed.wait_for(lambda: number in self._outcomes or number in self._begun)
            if number not in self._outcomes:
                place, began = self._begun[number]
                left = None if limit is None else max(0.0, began + limit - time.monotonic())
                if not self._changed.wait_for(lambda: number in self._outcomes, left):
                    self._outcomes[number] = LateError()
                    self._places.hangs(place)
                    self._start()
            return self._outcomes[number]

    def _start(self) -> None:
        context = contextvars.copy_context()
        threading.Thread(target=context.run, args=(self._work,), name="uard-judge", daemon=True).start()

    def _work(self) -> None:
        while True:
            try:
                number = self._left.popleft()
            except IndexError:
                return
            place = self._places.ask()
            try:
                place.result()
                with self._changed:
                    self._begun[number] = place, time.monotonic()
                    self._changed.notify_all()
                outcome = self._ask(self._parts[number])
            except BaseException as error:
                outcome = error
            finally:
                self._places.leave(place)
            with self._changed:
                if number in self._outcomes:  # it was late, and another thread has taken over
                    return
                self._outcomes[number] = outcome
                self._changed.notify_all()
