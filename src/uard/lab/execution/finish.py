"""How a trained lane becomes a result: a walk without exploration, calibration, what is held of each state-action."""

from __future__ import annotations

from typing import Any

import numpy as np

from uard.agents.tabular import QLearning
from uard.envs.base import Tables
from uard.envs.tables import HiddenTruth, Task
from uard.lab.cell import Cell
from uard.lab.execution.examine import examine
from uard.lab.result import DivergedError, Result
from uard.method import calibration, uncertainty
from uard.method.mitigations import Feedback, Mitigation


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
    path = [int(np.atleast_1d(task.start)[0])]
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


def finish_deep(cell: Cell, seed: int, out: dict[str, Any]) -> Result:
    """Turn a trained deep lane into a result; calibration of what was learned of the raters where there are tables.

    Raises:
        DivergedError: the run diverged.
    """
    from uard.training.compiled.common import QUANTITIES

    if out["fault"]:
        quantity, step, good = QUANTITIES[int(out["fault"])], int(out["fault_step"]), int(out["good_step"])
        raise DivergedError(
            f"training diverged: {quantity} at step {step} of seed {seed} was not finite or beyond all measure; all "
            f"was well at step {good}: {cell}",
            f"{cell.key}-{seed}-{good}",
            arrays_by_place(out["good"]),
        )
    log = out["log"][: int(out["episodes"])]
    if not np.isfinite(log).all():
        raise DivergedError(
            f"training diverged: the reward of seed {seed} was not finite: {cell}", f"{cell.key}-{seed}"
        )
    extra: dict[str, np.ndarray] = {}
    slots, rewards = out["walk"]
    path = np.zeros(0, np.int32)
    if isinstance(cell.environment, Tables):
        task, truth = cell.environment.task(), cell.environment.truth()
        path = _walked(task, slots)
        extra["tables"] = _tables(task, out)
        if cell.mitigation.reads_feedback:
            extra |= _knowledge(cell, task, truth, out)
    else:
        extra["walk_return"] = np.asarray(rewards.sum(), np.float32)
    return Result(log, int(out["steps"]), path, extra)


def finish_host(job: Any, done: Any) -> Result:
    """Turn a run in MuJoCo into a result; ``evaluation`` and ``ends`` are those of ``training.host.Done``."""
    extra = {"evaluation": done.evaluation.astype(np.float32), "ends": done.ends} | examine(job, done.live)
    return Result(done.log.astype(np.float32), int(done.live.steps), np.zeros(0, np.int32), extra)


def arrays_by_place(tree: Any) -> dict[str, np.ndarray]:
    """Return a pytree's arrays by their place in it."""
    import jax

    return {jax.tree_util.keystr(path).lstrip("."): np.asarray(x) for path, x in jax.tree.leaves_with_path(tree)}


def _walked(task: Task, slots: np.ndarray) -> np.ndarray:
    """Return the states of a walk given as state-actions, -1 after its end; the last state included."""
    states, actions = np.divmod(slots[slots >= 0], task.next_state.shape[1])
    if not len(states):
        return np.zeros(0, np.int32)
    return np.append(states, task.next_state[states[-1], actions[-1]]).astype(np.int32)


def _tables(task: Task, out: dict[str, Any]) -> np.ndarray:
    """What the trained agent holds of every state-action, (S, A, len(TABLES)): its raters, its ensemble."""
    states, actions = task.next_state.shape
    rated = np.asarray(out["rated"])
    rated = rated.reshape(-1, actions) if rated.size > 1 else np.zeros((states, actions))
    columns = [*out["feedback"][:5], *out["values"], rated]
    return np.stack([np.asarray(c)[:states] for c in columns], axis=-1).astype(np.float32)


def _knowledge(cell: Cell, task: Task, truth: HiddenTruth, out: dict[str, Any]) -> dict[str, np.ndarray]:
    """Calibration of what was learned of the raters: of sigma_h, and of the predicted ratings, rated and not."""
    states, actions = task.next_state.shape
    known = Feedback(*(np.asarray(x)[:states].astype(float) for x in out["feedback"]))
    rated = np.asarray(out["rated"]).reshape(-1, actions)[:states] > 0
    calibrated = _calibration(known._replace(count=rated.astype(float)), truth)
    said = cell.environment.speech(cell.panel, cell.noise)
    draws = said.centre + said.deviation * np.random.default_rng(0).standard_normal((500, *said.centre.shape))
    spread = draws.std(-1, ddof=0).mean(0) if draws.shape[-1] > 1 else np.zeros(rated.shape)
    errors = []
    for got, meant in ((known.mean, said.centre.mean(-1)), (known.spread, spread)):
        for where in (rated, ~rated):
            errors.append(np.sqrt(np.mean((got - meant)[where] ** 2)) if where.any() else 0.0)
    both = bool(rated.any() and not rated.all())
    errors.append(calibration.auroc(known.count.ravel(), rated.ravel()) if both else 0.5)
    return {"calibration": np.array(calibrated, np.float32), "rating_error": np.array(errors, np.float32)}
