"""What one seed of a cell leaves behind, and the metrics that are read off it."""

from __future__ import annotations

import hashlib
import json
import math
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from uard import _checks
from uard.lab import statistics
from uard.training.episode_log import LOG

WINDOW = 100  # metrics are per episode over the last 100 episodes, as the paper's
METRICS = (
    "hacks",
    "success_rate",
    "true_return",
    "observed_return",
    "alignment_gap",
    "misalignment",
    "episode_length",
    "abstained",
)


SHARES = ("success_rate",)  # metrics that are shares of a seed's episodes
COLUMNS = (*LOG, "alignment_gap")  # that ``Result.curve`` knows
_FORMERLY = {"trap_visits": "hacks", "goal": "success", "goal_rate": "success_rate"}

# Columns of what a result has in ``extra`` under "calibration", "rating_error" and "tables".
CALIBRATION = ("auroc_sigma_h", "auroc_with_proxy", "spearman_sigma_h", "spearman_with_proxy")
RATING_ERROR = ("rmse_mean_rated", "rmse_mean_unrated", "rmse_sigma_h_rated", "rmse_sigma_h_unrated", "auroc_count")
TABLES = ("count", "mean", "lowest", "sd", "proxy", "mu", "sigma_m", "lowest_value", "rated")


class CorruptResultError(RuntimeError):
    """A stored result whose bytes are not what was written."""


class DivergedError(FloatingPointError):
    """A run whose loss, values or parameters left the finite numbers; it is in no table.

    Attributes:
        name: Of its checkpoint.
        good: The agent's arrays when all was well last, by their place in its state.
    """

    def __init__(self, message: str, name: str = "", good: dict[str, np.ndarray] | None = None):
        """Say which quantity diverged, and at which step."""
        super().__init__(message)
        self.name, self.good = name, good or {}

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel between processes whole."""
        return type(self), (str(self), self.name, self.good)


def check_name(field: str, name: str, known: Iterable[str]) -> str:
    """Return the name of a metric or a column if it is ``known``.

    Examples:
        >>> check_name("column", "trap_visits", COLUMNS)
        Traceback (most recent call last):
            ...
        uard._checks.InvalidValueError: column = 'trap_visits': must be 'hacks', as it is called now

    Raises:
        UnknownNameError: it is not.
        InvalidValueError: it is not, but was up to version 0.1; with what it is called now.
    """
    known = tuple(known)
    if name not in known and _FORMERLY.get(name) in known:
        raise _checks.InvalidValueError(field, name, f"{_FORMERLY[name]!r}, as it is called now")
    return _checks.choose(field, name, known)


def digest(data: bytes) -> str:
    """Return the checksum of a packed result: SHA-256 as 64 hexadecimal digits.

    Examples:
        >>> digest(b"some bytes")[:12]
        '0d22cdcc10e6'
    """
    return hashlib.sha256(data).hexdigest()


@dataclass(frozen=True)
class Result:
    """One trained seed.

    Examples:
        >>> log = np.array([[1.0, -2.0, 3.0, 0.0, 40.0, 0.0]])  # one episode, in which a trap paid 5 too much
        >>> result = Result(log, steps=40, path=np.array([0, 1]), extra={})
        >>> result.metrics()["alignment_gap"], result.curve("true_return").tolist()
        (5.0, [-2.0])
        >>> Result.unpack(*result.pack()).steps
        40

    Attributes:
        log: (episodes, 6) per-episode sums, columns ``uard.training.episode_log.LOG``.
        steps: Environment steps taken.
        path: (n,) states that the greedy policy visits after training, the start included.
        extra: Further arrays (calibration, uncertainty curves) by name.
    """

    log: np.ndarray
    steps: int
    path: np.ndarray
    extra: dict[str, np.ndarray]

    def metrics(self) -> dict[str, float]:
        """Return ``METRICS`` by name: means per episode over the last ``WINDOW`` episodes.

        ``alignment_gap`` is |observed - true| per episode, ``misalignment`` the same per step.
        """
        tail = self.log[-WINDOW:].astype(float)
        visits, true, observed, goal, length, abstained = tail.T
        gap = np.abs(observed - true)
        values = (visits, goal, true, observed, gap, gap.sum() / length.sum(), length, abstained)
        return {name: float(np.mean(v)) for name, v in zip(METRICS, values, strict=True)}

    def curve(self, name: str) -> np.ndarray:
        """Return one column of the log, (episodes,); ``alignment_gap`` is |observed - true|.

        Raises:
            UnknownNameError: there is no such column.
        """
        check_name("column", name, COLUMNS)
        if name == "alignment_gap":
            return np.abs(self.curve("observed_return") - self.curve("true_return"))
        return self.log[:, LOG.index(name)].astype(float)

    def pack(self) -> tuple[bytes, str]:
        """Return the bytes to store and their checksum."""
        arrays = {"log": self.log, "steps": np.int64(self.steps), "path": self.path, **self.extra}
        parts = {name: np.ascontiguousarray(a) for name, a in arrays.items()}
        header = json.dumps([(name, a.dtype.str, np.shape(arrays[name])) for name, a in parts.items()]).encode()
        data = zlib.compress(header + b"\n" + b"".join(a.tobytes() for a in parts.values()), 1)
        return data, digest(data)

    @staticmethod
    def unpack(data: bytes, checksum: str | None = None) -> Result:
        """Read what ``pack`` wrote.

        Args:
            data: The bytes.
            checksum: Theirs; left out if whoever kept them has checked it.

        Raises:
            CorruptResultError: the bytes do not have that checksum, are no packed result, or hold NaN.
        """
        if checksum is not None and digest(data) != checksum:
            raise CorruptResultError("checksum does not match")
        try:
            arrays = _arrays(data)
            log, steps, path = arrays.pop("log"), int(arrays.pop("steps")), arrays.pop("path")
        except (zlib.error, ValueError, TypeError, KeyError, RecursionError, MemoryError, OverflowError) as error:
            raise CorruptResultError(f"it is no packed result ({type(error).__name__}: {error})") from None
        if log.ndim != 2 or log.shape[1] != len(LOG) or not len(log) or log.dtype.kind not in "fiu" or steps < 0:
            raise CorruptResultError(f"the log has shape {log.shape}, {steps} steps: must be (episodes, {len(LOG)})")
        if not np.isfinite(log).all():
            raise CorruptResultError("the log holds NaN or infinity")
        return Result(log, steps, path, arrays)


def _arrays(data: bytes) -> dict[str, np.ndarray]:
    header, _, body = zlib.decompress(data).partition(b"\n")
    named, offset = {}, 0
    for name, dtype, shape in json.loads(header):
        count = math.prod(shape)
        named[name] = np.frombuffer(body, dtype, count, offset).reshape(shape)
        offset += named[name].nbytes
    if offset != len(body):
        raise ValueError(f"{len(body)} bytes instead of {offset}")
    return named


def summaries(results: list[Result]) -> dict[str, statistics.Summary]:
    """Summarise every metric over seeds.

    Examples:
        >>> seeds = [Result(np.full((1, 6), x), steps=1, path=np.array([0]), extra={}) for x in (0.5, 1.0)]
        >>> summaries(seeds)["hacks"].per_seed
        (0.5, 1.0)

    Raises:
        InvalidValueError: no results, or a metric that is not finite.
    """
    rows = [r.metrics() for r in results]
    return {name: statistics.summarise([row[name] for row in rows], name, name in SHARES) for name in METRICS}
