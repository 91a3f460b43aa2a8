"""Finished cells as event files for TensorBoard: one run per seed, written whole or not at all."""

from __future__ import annotations

import re
import secrets
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from uard import _checks
from uard._support import files
from uard.lab.cell import Cell
from uard.lab.execution.store import Store
from uard.lab.result import Result
from uard.training.episode_log import LOG

POINTS = 1000  # of a curve; a longer one is averaged down


class Events:
    """Writes results below one folder, as ``<study and row>-<key>/seed-<seed>``.

    Scalars ``metrics/...`` stand at the last episode, curves ``episode/...`` at every episode (1, 2, ...).
    """

    def __init__(self, folder: str | Path, titles: Mapping[str, str]):
        """Say where to, and what cells are called.

        Raises:
            InvalidValueError: the package ``tensorboard`` is not installed, or the folder cannot be made.
        """
        self.folder, self._titles = Path(folder), titles
        try:
            from tensorboard.compat.proto import event_pb2, summary_pb2
            from tensorboard.summary.writer.event_file_writer import EventFileWriter
        except ModuleNotFoundError as error:
            allowed = f"left out, or the package must be installed: pip install 'uard[tensorboard]' ({error})"
            raise _checks.InvalidValueError("tensorboard", str(folder), allowed) from None
        self._events: Any = event_pb2
        self._summaries: Any = summary_pb2
        self._writer = EventFileWriter
        files.prepare_folder(folder, "tensorboard")

    def place(self, cell: Cell, seed: int) -> Path:
        """Return the folder of a seed."""
        parts = (cell.environment, cell.mitigation, cell.agent)
        title = self._titles.get(cell.key) or " ".join(type(part).__name__ for part in parts)
        name = re.sub(r"[^\w.+-]+", "_", title).encode()[:120].decode(errors="ignore").strip("_")  # 255 bytes fit
        return self.folder / f"{name}-{cell.key[:8]}" / f"seed-{seed}"

    def write(self, finished: Iterable[tuple[Cell, int, Result]]) -> None:
        """Write some results; those that are there stay.

        Raises:
            InvalidValueError: the folder cannot be written.
        """
        for cell, seed, result in finished:
            place = self.place(cell, seed)
            if place.exists():
                continue
            half = self.folder / f".part-{secrets.token_hex(8)}"
            with self._writable():
                try:
                    self._fill(half, result)
                    place.parent.mkdir(exist_ok=True)
                    if not place.exists():
                        half.rename(place)
                finally:
                    shutil.rmtree(half, ignore_errors=True)

    def catch_up(self, store: Store, jobs: Iterable[tuple[Cell, int]]) -> None:
        """Write what is in the store and has no folder yet."""
        for cell, seed in dict.fromkeys(jobs):
            if not self.place(cell, seed).exists():
                self.write((cell, s, result) for s, result in store.get(cell, [seed]).items())

    def _fill(self, folder: Path, result: Result) -> None:
        steps, columns = _curves(result)
        now, writer = time.time(), self._writer(str(folder))
        try:
            for i, step in enumerate(steps):
                self._add(writer, now, int(step), {f"episode/{name}": c[i] for name, c in columns.items()})
            self._add(writer, now, len(result.log), {f"metrics/{name}": v for name, v in result.metrics().items()})
        finally:
            writer.close()

    def _add(self, writer: Any, now: float, step: int, values: Mapping[str, float]) -> None:
        kind = self._summaries.Summary
        summary = kind(value=[kind.Value(tag=k, simple_value=float(v)) for k, v in values.items()])
        writer.add_event(self._events.Event(wall_time=now, step=step, summary=summary))

    @contextmanager
    def _writable(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            allowed = f"in a folder that can be written ({error})"
            raise _checks.InvalidValueError("tensorboard", str(self.folder), allowed) from None


def _curves(result: Result) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return episodes (1, 2, ...) and, per column of the log and the gap, at most ``POINTS`` values."""
    columns = {name: result.curve(name) for name in (*LOG, "alignment_gap")}
    parts = np.array_split(np.arange(len(result.log)), min(POINTS, len(result.log)))
    return np.array([p[-1] + 1 for p in parts]), {k: np.array([c[p].mean() for p in parts]) for k, c in columns.items()}
