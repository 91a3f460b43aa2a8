"""How long the rest of a study will take, learnt from what has been trained so far."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any

from uard.lab.cell import Cell

Job = tuple[Cell, int]
Shape = Callable[[Cell], tuple[Hashable, float]]


@dataclass
class _Program:
    """What is known of all batches that share a compiled program."""

    kind: Hashable
    waiting: float = 0.0  # cost of what nobody has begun
    largest: float = 0.0  # cost of a batch
    batches: int = 0
    cost: float = 0.0
    seconds: float = 0.0
    first_cost: float = 0.0
    first_seconds: float = 0.0

    def rate(self) -> float | None:
        """Seconds per cost; without the first batch, which compiled, as soon as there is another."""
        if self.batches > 1:
            return (self.seconds - self.first_seconds) / (self.cost - self.first_cost)
        return self.seconds / self.cost if self.batches else None


class Forecast:
    """Seconds that remain: every cell weighs as much as cells like it have taken in this run.

    A cell's cost (environment steps, weighted by the kind of agent) is multiplied by the seconds per cost of its own
    program; of agents of its kind if its program has not run yet; of everything if its kind has not. What compiling a
    program takes is learnt from first batches, and added for every program that is still to come. Nothing is said
    before a program has run twice, or three have run: who has seen one batch does not know what of it was compiling.
    """

    def __init__(self, queue: Sequence[Sequence[Job]], workers: int, shape: Shape):
        """Learn what is to be done.

        Args:
            queue: Batches of jobs of equal shapes.
            workers: How many are trained at the same time.
            shape: Gives a cell's program and its cost.
        """
        self._workers, self._shape = max(1, workers), shape
        self._programs: dict[Hashable, _Program] = {}
        self._busy: dict[tuple[Job, ...], float] = {}
        self._waiting: set[Job] = set()
        for batch in queue:
            program, cost = self._cost(batch)
            program.waiting += cost
            program.largest = max(program.largest, cost)
            self._waiting.update(batch)

    def begin(self, batch: Sequence[Job], now: float) -> None:
        """A batch is being trained from ``now`` on."""
        self.drop(batch)
        self._busy[tuple(batch)] = now

    def drop(self, jobs: Sequence[Job]) -> None:
        """Somebody else trains these."""
        for job in jobs:
            if job in self._waiting:
                self._waiting.remove(job)
                program, cost = self._cost([job])
                program.waiting -= cost

    def end(self, batch: Sequence[Job], now: float) -> None:
        """A batch that was begun is done."""
        began = self._busy.pop(tuple(batch), None)
        if began is None:
            return
        program, cost = self._cost(batch)
        seconds = now - began
        if not program.batches:
            program.first_cost, program.first_seconds = cost, seconds
        program.batches, program.cost, program.seconds = (
            program.batches + 1,
            program.cost + cost,
            program.seconds + seconds,
        )

    def remaining(self, now: float) -> float | None:
        """Return the seconds that are left, None if nothing is known yet.

        It is never less than the longest batch still needs, however many workers there are.
        """
        batches = [p.batches for p in self._programs.values()]
        if max(batches, default=0) < 2 and sum(batches) < 3:
            return None
        compiling = self._compiling()
        pieces, longest, count = 0.0, 0.0, len(self._busy)
        for p in self._programs.values():
            if p.waiting > 0:
                rate, start = self._rate(p), 0.0 if p.batches else compiling
                pieces += p.waiting * rate + start
                longest = max(longest, min(p.largest, p.waiting) * rate + start)
                count += max(1, round(p.waiting / p.largest))
        for batch, began in self._busy.items():
            p, cost = self._cost(batch)
            left = max(0.0, cost * self._rate(p) + (0.0 if p.batches else compiling) - (now - began))
            pieces, longest = pieces + left, max(longest, left)
        return max(longest, pieces / max(1, min(self._workers, count)))

    def _cost(self, batch: Sequence[Job]) -> tuple[_Program, float]:
        name, cost = self._shape(batch[0][0])
        cell: Any = batch[0][0]
        program = self._programs.setdefault(name, _Program((type(cell.agent), type(cell.environment))))
        return program, max(cost, 1.0) * len(batch)

    def _rate(self, program: _Program) -> float:
        if (rate := program.rate()) is not None:
            return rate
        known = [p for p in self._programs.values() if p.batches]
        like = [p for p in known if p.kind == program.kind] or known
        if warm := [p for p in like if p.batches > 1]:
            return sum(p.seconds - p.first_seconds for p in warm) / sum(p.cost - p.first_cost for p in warm)
        return sum(p.seconds for p in like) / sum(p.cost for p in like)

    def _compiling(self) -> float:
        extra = [
            p.first_seconds - p.first_cost * rate
            for p in self._programs.values()
            if p.batches > 1 and (rate := p.rate()) is not None
        ]
        return max(0.0, sum(extra) / len(extra)) if extra else 0.0
