"""How a trained lane becomes a result: a walk without exploration, calibration, what is held of each state-action."""

from __future__ import annotations

from typing import Any

import numpy as np

from uard.agents.tabular import QLearning
from uard.envs.base import TableEnvironment
from uard.envs.tables import HiddenTruth, Task
from uard.lab.cell import Cell
from uard.lab.execution.examine import examine
from uard.lab.result import DivergedError, Result
from uard.method import calibration, uncertainty
from uard.method.mitigations import Feedback, Mitigation
from uard.ratings.aggregate import aggregate
from uard.ratings.panels import draw


def greedy_path(task: Task, agent: QLearning, mitigation: Mitigation, q: np.ndarray, feedback: Feedback) -> np.ndarray:
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


def finish(cell: Cell, task: Task, truth: HiddenTruth, out: dict[str, Any]) -> Result:
    """Turn a trained lane into a result: greedy path, calibration, curves of both uncertainties."""
    states = task.next_state.shape[0]
    if not (np.isfinite(out["log"]).all() and np.isfinite(out["q"]).all()):
        raise FloatingPointError(f"training diverged: NaN or infinity in the values or the log of {cell}")
    feedback = out["feedback"].map(lambda x: x[:states])
    extra: dict[str, np.ndarray] = {}
    if cell.mitigation.reads_feedback:
        extra["calibration"] = np.array(_calibration(feedback, truth), np.float32)
    if cell.snapshots:
        extra["uncertainty"] = _uncertainty_curves(out, truth, states)
    path = greedy_path(task, cell.agent, cell.mitigation, out["q"][:states], feedback)
    return Result(out["log"], int(out["steps"]), path, extra)


def _calibration(feedback: Feedback, truth: HiddenTruth) -> list[float]:
    seen = feedback.count > 0
    hack, error = truth.hack[seen], np.abs(feedback.proxy - truth.reward)[seen]
    sigma = feedback.sd[seen]
    joint = np.asarray(uncertainty.with_proxy(feedback.mean, feedback.sd, feedback.proxy, feedback.raters))[seen]
    if hack.size < 2:
        return [0.5, 0.5, 0.0, 0.0]
    both = bool(hack.any() and not hack.all())
    ranks = [calibration.auroc(s, hack) if both else 0.5 for s in (sigma, joint)]
    return ranks + [calibration.spearman(s, error) for s in (sigma, joint)]


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
    if isinstance(cell.environment, TableEnvironment):
        task, truth = cell.environment.task(), cell.environment.truth()
        path = _walked(task, slots)
        extra["tables"] = _tables(task, out)
        if cell.mitigation.reads_feedback:
            extra |= _knowledge(cell, task, truth, out)
    else:
        extra["walk_return"] = np.asarray(rewards.sum(), np.float32)
    return Result(log, int(out["steps"]), path, extra)


def finish_host(loop: Any, trained: Any) -> Result:
    """Turn a ``training.host.loop.TrainedRun`` into a result."""
    extra = {"evaluation": trained.evaluation.astype(np.float32), "ends": trained.ends} | examine(loop, trained.state)
    return Result(trained.log.astype(np.float32), int(trained.state.steps), np.zeros(0, np.int32), extra)


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
    f = out["feedback"]
    columns = [f.count, f.mean, f.lowest, f.sd, f.proxy, *out["values"], rated]
    return np.stack([np.asarray(c)[:states] for c in columns], axis=-1).astype(np.float32)


def _knowledge(cell: Cell, task: Task, truth: HiddenTruth, out: dict[str, Any]) -> dict[str, np.ndarray]:
    """Calibration of what was learned of the raters: of sigma_h, and of the predicted ratings, rated and not."""
    states, actions = task.next_state.shape
    known = out["feedback"].map(lambda x: np.asarray(x)[:states].astype(float))
    rated = np.asarray(out["rated"]).reshape(-1, actions)[:states] > 0
    calibrated = _calibration(known._replace(count=rated.astype(float)), truth)
    law = cell.environment.rating_law(cell.panel, cell.noise)
    repeated = law._replace(centre=np.broadcast_to(law.centre, (500, *law.centre.shape)))
    visits = aggregate(draw(repeated, np.random.default_rng(0)), np.zeros((500, *rated.shape)))
    errors = []
    for got, meant in ((known.mean, law.centre.mean(-1)), (known.sd, visits.sd.mean(0))):
        for where in (rated, ~rated):
            errors.append(np.sqrt(np.mean((got - meant)[where] ** 2)) if where.any() else 0.0)
    both = bool(rated.any() and not rated.all())
    errors.append(calibration.auroc(known.count.ravel(), rated.ravel()) if both else 0.5)
    return {"calibration": np.array(calibrated, np.float32), "rating_error": np.array(errors, np.float32)}
