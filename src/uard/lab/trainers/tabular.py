"""Tabular agents: all runs of a batch in one compiled program."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np

from uard.agents.tabular import QLearning
from uard.envs.tables import MIN_STATES, HiddenTruth, Task
from uard.lab.result import Result
from uard.lab.trainers.base import Finish, Trainer
from uard.method import calibration, uncertainty
from uard.method.mitigations import Feedback, Mitigation

if TYPE_CHECKING:
    from uard.lab.cell import Cell


@final
class Tabular(Trainer):
    """Q-learning on tables."""

    name = "tabular"
    version = 1
    kinds = ("tables",)
    families = ("tabular",)
    at_once = 64  # about half a second of work
    rating_models = {"table": None}  # noqa: RUF012 (read only)
    snapshots = True
    knows_truth = True

    def place(self, environment: Any) -> Hashable:
        """Return the class and the number of states: all else are numbers in tables."""
        return place_of_tables(environment)

    def cost(self, cell: Cell) -> float:
        """Return the most environment steps."""
        return (cell.environment.horizon or 0) * cell.episodes

    def train(self, batch: Sequence[tuple[Cell, int]], folder: Path | None = None) -> list[Finish]:
        """Train a batch."""
        from uard.training.compiled import tabular
        from uard.training.xla import keep_programs

        keep_programs()
        tables: dict[Cell, Any] = {}
        runs = []
        for cell, seed in batch:
            if cell not in tables:
                environment = cell.environment
                task, truth = environment.task(), environment.truth()
                if cell.mitigation.reads_truth:
                    task = task._replace(reward=truth.reward)
                tables[cell] = task, truth, environment.rating_law(cell.panel, cell.noise)
            task, truth, law = tables[cell]
            runs.append(tabular.make_run(task, law, truth, cell.agent, cell.mitigation, seed, cell.rated))
        first = batch[0][0]
        program = tabular.Program(first.episodes, first.ddof, first.snapshots)
        fields = ("log", "steps", "q", "feedback")
        if first.snapshots:
            fields = (*fields, "q_snapshots", "feedback_snapshots")
        trained = tabular.train(runs, program, fields)
        return [partial(_finish, cell, *tables[cell][:2], out) for (cell, _), out in zip(batch, trained, strict=True)]


def place_of_tables(environment: Any) -> Hashable:
    """Return what environments with tables must have in common to share a program."""
    return type(environment).__name__, max(MIN_STATES, environment.states)


def calibration_of(feedback: Feedback, truth: HiddenTruth) -> np.ndarray:
    """Return ``uard.lab.result.CALIBRATION``: how well the raters' deviation tells hacks and errors, (4,) float32."""
    seen = feedback.count > 0
    hack, error = truth.hack[seen], np.abs(feedback.proxy - truth.reward)[seen]
    sigma = feedback.sd[seen]
    joint = np.asarray(uncertainty.with_proxy(feedback.mean, feedback.sd, feedback.proxy, feedback.raters))[seen]
    if hack.size < 2:
        return np.array([0.5, 0.5, 0.0, 0.0], np.float32)
    both = bool(hack.any() and not hack.all())
    ranks = [calibration.auroc(s, hack) if both else 0.5 for s in (sigma, joint)]
    return np.array(ranks + [calibration.spearman(s, error) for s in (sigma, joint)], np.float32)


def _finish(cell: Cell, task: Task, truth: HiddenTruth, out: dict[str, Any]) -> Result:
    """Turn a trained run into a result: greedy path, calibration, curves of both uncertainties.

    Raises:
        FloatingPointError: the run diverged.
    """
    states = task.next_state.shape[0]
    if not (np.isfinite(out["log"]).all() and np.isfinite(out["q"]).all()):
        raise FloatingPointError(f"training diverged: NaN or infinity in the values or the log of {cell}")
    feedback = out["feedback"].map(lambda x: x[:states])
    extra: dict[str, np.ndarray] = {}
    if cell.mitigation.reads_feedback:
        extra["calibration"] = calibration_of(feedback, truth)
    if cell.snapshots:
        extra["uncertainty"] = _uncertainty_curves(out, truth, states)
    path = _greedy_path(task, cell.agent, cell.mitigation, out["q"][:states], feedback)
    return Result(out["log"], int(out["steps"]), path, extra)


def _greedy_path(task: Task, agent: QLearning, mitigation: Mitigation, q: np.ndarray, feedback: Feedback) -> np.ndarray:
    """Return the states that the trained agent visits without exploring, the start included."""
    statistics = mitigation.fit(feedback, feedback.count > 0)
    mu = q.mean(-1)
    sigma = q.std(-1, ddof=1) if agent.heads > 1 else np.zeros_like(mu)
    policy = np.asarray(mitigation.score(mu, sigma, feedback, statistics)).argmax(-1)
    path = [int(np.atleast_1d(task.start)[0])]
    for _ in range(int(task.horizon)):
        place = path[-1], policy[path[-1]]
        path.append(int(task.next_state[place]))
        if task.terminal[place]:
            break
    return np.array(path, np.int32)


def _uncertainty_curves(out: dict[str, Any], truth: HiddenTruth, states: int) -> np.ndarray:
    """Mean sigma_m and sigma_h at hacks and elsewhere, (snapshots, 4), over state-actions seen so far."""
    rows = []
    for i, q in enumerate(out["q_snapshots"]):
        feedback = out["feedback_snapshots"].map(lambda x, i=i: x[i, :states])
        sigma_m = q[:states].std(-1, ddof=1) if q.shape[-1] > 1 else np.zeros(q[:states].shape[:-1])
        seen = feedback.count > 0
        row = []
        for sigma in (sigma_m, feedback.sd):
            for where in (truth.hack & seen, ~truth.hack & seen):
                row.append(sigma[where].mean() if where.any() else 0.0)
        rows.append(row)
    return np.array(rows, np.float32)
