"""What one seed of a cell leaves behind, and the metrics that are read off it."""

from __future__ import annotations

import hashlib
import json
import math
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from uard import calibration, statistics, uncertainty
from uard.agents.tabular import QLearning
from uard.envs.tabular import HiddenTruth, Task
from uard.lab.cell import Cell
from uard.mitigation import Feedback, Mitigation
from uard.training.fused import LOG

WINDOW = 100  # metrics are per episode over the last 100 episodes, as the paper's
METRICS = (
    "trap_visits",
    "goal_rate",
    "true_return",
    "observed_return",
    "alignment_gap",
    "misalignment",
    "episode_length",
    "abstained",
)


class CorruptResultError(RuntimeError):
    """A stored result whose bytes are not what was written."""


def digest(data: bytes) -> str:
    """Return the checksum of a packed result."""
    return hashlib.sha256(data).hexdigest()


@dataclass(frozen=True)
class Result:
    """One trained seed.

    Attributes:
        log: (episodes, 6) per-episode sums of ``fused.LOG``.
        steps: Environment steps taken.
        path: States that the greedy policy visits after training, the start included.
        extra: Further arrays (calibration, uncertainty curves) by name.
    """

    log: np.ndarray
    steps: int
    path: np.ndarray
    extra: dict[str, np.ndarray]

    def metrics(self) -> dict[str, float]:
        """Return the mean per episode over the last ``WINDOW`` episodes; the gap is |observed - true| per episode."""
        tail = self.log[-WINDOW:].astype(float)
        visits, true, observed, goal, length, abstained = tail.T
        gap = np.abs(observed - true)
        values = (visits, goal, true, observed, gap, gap.sum() / length.sum(), length, abstained)
        return {name: float(np.mean(v)) for name, v in zip(METRICS, values, strict=True)}

    def curve(self, name: str) -> np.ndarray:
        """Return one column of the log, per episode; ``alignment_gap`` is |observed - true|."""
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
    def unpack(data: bytes, checksum: str) -> Result:
        """Read what ``pack`` wrote.

        Raises:
            CorruptResultError: the bytes do not have that checksum, or hold NaN.
        """
        if digest(data) != checksum:
            raise CorruptResultError("checksum does not match")
        header, _, body = zlib.decompress(data).partition(b"\n")
        named, offset = {}, 0
        for name, dtype, shape in json.loads(header):
            count = math.prod(shape)
            named[name] = np.frombuffer(body, dtype, count, offset).reshape(shape)
            offset += named[name].nbytes
        log, steps, path = named.pop("log"), int(named.pop("steps")), named.pop("path")
        if not np.isfinite(log).all():
            raise CorruptResultError("the log holds NaN or infinity")
        return Result(log, steps, path, named)


def summaries(results: list[Result]) -> dict[str, statistics.Summary]:
    """Summarise every metric over seeds."""
    rows = [r.metrics() for r in results]
    return {name: statistics.summarise([row[name] for row in rows], name) for name in METRICS}


def read_feedback(rows: np.ndarray, raters: int) -> Feedback:
    """Read the learner's rating table (S, A, 5) on the host."""
    count, mean, lowest, spread, proxy = np.moveaxis(rows, -1, 0)
    return Feedback(count, mean, lowest, spread, proxy, np.float32(raters))


def greedy_path(task: Task, agent: QLearning, mitigation: Mitigation, q: np.ndarray, feedback: Feedback) -> np.ndarray:
    """Return the states that the trained agent visits without exploring, the start included."""
    usual = mitigation.usual(feedback, feedback.count > 0)
    mu = q.mean(-1)
    sigma = q.std(-1, ddof=1) if agent.heads > 1 else np.zeros_like(mu)
    policy = np.asarray(mitigation.score(mu, sigma, feedback, usual)).argmax(-1)
    path = [int(task.start)]
    for _ in range(int(task.horizon)):
        place = path[-1], policy[path[-1]]
        path.append(int(task.next_state[place]))
        if task.terminal[place]:
            break
    return np.array(path, np.int32)


def finish(cell: Cell, task: Task, truth: HiddenTruth, raters: int, out: dict[str, Any]) -> Result:
    """Turn a trained lane into a result: greedy path, calibration, curves of both uncertainties."""
    states = task.next_state.shape[0]
    if not (np.isfinite(out["log"]).all() and np.isfinite(out["q"]).all()):
        raise FloatingPointError(f"training diverged: NaN or infinity in the values or the log of {cell}")
    feedback = read_feedback(out["feedback"][:states], raters)
    extra: dict[str, np.ndarray] = {}
    if cell.mitigation.reads_feedback:
        extra["calibration"] = np.array(_calibration(feedback, truth), np.float32)
    if cell.snapshots:
        extra["uncertainty"] = _uncertainty_curves(out, truth, states, raters)
    path = greedy_path(task, cell.agent, cell.mitigation, out["q"][:states], feedback)
    return Result(out["log"], int(out["steps"]), path, extra)


CALIBRATION = ("auroc_sigma_h", "auroc_with_proxy", "spearman_sigma_h", "spearman_with_proxy")


def _calibration(feedback: Feedback, truth: HiddenTruth) -> list[float]:
    seen = feedback.count > 0
    hack, error = truth.hack[seen], np.abs(feedback.proxy - truth.reward)[seen]
    sigma = feedback.spread[seen]
    joint = np.asarray(uncertainty.with_proxy(feedback.mean, feedback.spread, feedback.proxy, feedback.raters))[seen]
    if hack.size < 2:
        return [0.5, 0.5, 0.0, 0.0]
    both = bool(hack.any() and not hack.all())
    ranks = [calibration.auroc(s, hack) if both else 0.5 for s in (sigma, joint)]
    return ranks + [calibration.spearman(s, error) for s in (sigma, joint)]


def _uncertainty_curves(out: dict[str, Any], truth: HiddenTruth, states: int, raters: int) -> np.ndarray:
    """Mean sigma_m and sigma_h at hacks and elsewhere, (snapshots, 4), over state-actions seen so far."""
    rows = []
    for q, table in zip(out["q_snapshots"], out["feedback_snapshots"], strict=True):
        feedback = read_feedback(table[:states], raters)
        sigma_m = q[:states].std(-1, ddof=1) if q.shape[-1] > 1 else np.zeros(q[:states].shape[:-1])
        seen = feedback.count > 0
        row = []
        for sigma in (sigma_m, feedback.spread):
            for where in (truth.hack & seen, ~truth.hack & seen):
                row.append(sigma[where].mean() if where.any() else 0.0)
        rows.append(row)
    return np.array(rows, np.float32)
