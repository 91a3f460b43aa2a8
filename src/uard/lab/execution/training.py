"""Training one batch, whatever happens in it: one that fails or diverges takes no other with it."""

from __future__ import annotations

import pickle
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TypeVar

from uard._checks import InvalidValueError, number
from uard.lab.execution.batching import Job
from uard.lab.result import DivergedError, Result

T = TypeVar("T")

# Per job its result, the divergence or a traceback; or one traceback for all of them.
Answer = list[Result | DivergedError | str] | str


def train_batch(batch: Sequence[Job]) -> list[Result]:
    """Train jobs of one program in this process.

    Raises:
        FloatingPointError: a run diverged.
    """
    return [finish() for finish in batch[0][0].trainer.train(batch)]


def attempt(batch: Sequence[Job], folder: Path | None) -> Answer:
    """Train a batch; if that raises, each of its cells alone.

    Args:
        batch: Jobs of one program.
        folder: Of the checkpoints of long runs; see ``Trainer.train``.
    """
    finishers = _guarded(lambda: batch[0][0].trainer.train(batch, folder))
    if isinstance(finishers, list):
        return [_guarded(partial(_finished, finish)) for finish in finishers]
    cells = dict.fromkeys(cell for cell, _ in batch)
    if len(cells) < 2:
        return str(finishers)
    alone: dict[Job, Result | DivergedError | str] = {}
    for cell in cells:
        jobs = [job for job in batch if job[0] == cell]
        answer = attempt(jobs, folder)
        alone |= zip(jobs, [answer] * len(jobs) if isinstance(answer, str) else answer, strict=True)
    return [alone[job] for job in batch]


def packed(batch: list[Job], folder: Path | None) -> bytes | None:
    """Pickle a batch for ``attempt_packed``; None if it cannot be: its class is local to a function, say."""
    try:
        return pickle.dumps((batch, folder))
    except KeyboardInterrupt:
        raise
    except BaseException:
        return None


def attempt_packed(data: bytes) -> Answer:
    """Train a batch as ``attempt`` does, in another process; a class that cannot be imported here is a failure."""
    unpacked = _guarded(lambda: pickle.loads(data))
    return attempt(*unpacked) if isinstance(unpacked, tuple) else str(unpacked)


def _finished(finish: Callable[[], Result]) -> Result:
    """Return a result that a store takes: one whose metrics are numbers."""
    result = finish()
    if not len(result.log):
        raise InvalidValueError("episodes or steps", 0, "enough for one episode to end")
    for name, value in result.metrics().items():
        number(f"the metric {name}", value)
    return result


def _guarded(action: Callable[[], T]) -> T | DivergedError | str:
    try:
        return action()
    except DivergedError as error:
        return error
    except KeyboardInterrupt:  # of whoever stops the study
        raise
    except BaseException:  # SystemExit, too: what is trained may not end the study, as if all were well perhaps
        return traceback.format_exc()
