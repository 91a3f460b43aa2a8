"""What is published of the paper's studies beside metrics: numbers that need a trained agent's tables or its walk."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from uard.envs.base import TableEnvironment
from uard.lab.cell import Cell
from uard.lab.result import TABLES, Result
from uard.lab.trainers import examine
from uard.method import bellman, calibration
from uard.replication import distortion

BINS = 20  # of a training's steps
EVERY = 5  # steps of an episode that are published as one
LEARNED = ("hacks", "true_return", "observed_return")  # the first columns of the log
SIGMA_QUALITY = ("auroc_unseen", "spearman_error")


def sigma_m(cell: Cell, found: Mapping[int, Result]) -> dict[str, Any]:
    """How good is each seed's sigma_m? See ``sigma_quality``."""
    return {"sigma_m": [sigma_quality(cell, result) for result in found.values()]}


def sigma_quality(cell: Cell, result: Result) -> tuple[float, float]:
    """How good is sigma_m? AUROC of it for state-actions never tried, and its rank correlation with |mu - Q*|.

    Q* is exact for the observed reward. Needs an agent all of whose steps were rated, so that tried means rated.
    """
    assert isinstance(cell.environment, TableEnvironment)
    held = {name: result.extra["tables"][..., i].astype(float) for i, name in enumerate(TABLES)}
    tried = held["rated"] > 0
    task = cell.environment.task()
    exact = bellman.solve(task.reward, 1.0, task.next_state, task.terminal, cell.agent.gamma)  # type: ignore[attr-defined]
    both = bool(tried.any() and not tried.all())
    unseen = calibration.auroc(held["sigma_m"].ravel(), ~tried.ravel()) if both else 0.5
    return unseen, calibration.spearman(held["sigma_m"].ravel(), np.abs(held["mu"] - exact).ravel())


def distorted(cell: Cell, found: Mapping[int, Result]) -> dict[str, Any]:
    """What each seed does when its reward is distorted (``uard.replication.distortion``); the first seed's trace."""
    traces = [distortion.walk(cell, result, seed) for seed, result in found.items()]
    return {
        "activations": [distortion.activations(t) for t in traces],
        "largest": [t.adjusted[t.counts].max() for t in traces],
        "mean_inside": [t.adjusted[t.counts].mean() for t in traces],
        "trace": traces[0][:4],
    }


def reactions(cell: Cell, found: Mapping[int, Result]) -> dict[str, Any]:
    """The same of MuJoCo's agents (``uard.lab.trainers.examine``)."""
    results = list(found.values())
    return {
        "perturbed": [r.extra["perturbed"].ravel() for r in results],
        "warning": [r.extra["warning"].ravel() for r in results],
        "reaction": [examine.reaction(r.extra["trace"]) for r in results],
        "trace": results[0].extra["trace"].T,
    }


def drifting(cell: Cell, found: Mapping[int, Result]) -> dict[str, Any]:
    """How each seed's training went, by environment steps, and what a kick does after it.

    ``learning`` (BINS, len(LEARNED)) are means over the episodes that ended in each part of the training; ``kicked`` is
    ``examine.examine``'s, its steps in groups of ``EVERY``.
    """
    assert cell.steps is not None
    results = list(found.values())
    return {
        "learning": [learning(r.log[:, : len(LEARNED)], r.extra["ends"], cell.steps) for r in results],
        "kicked": [grouped(r.extra["kicked"]).round(3) for r in results],
    }


def learning(log: np.ndarray, ends: np.ndarray, steps: int) -> np.ndarray:
    """Return means of the columns (episodes, C) over the episodes that ended in each part of a training, (BINS, C).

    A part in which no episode ended has the means of the one before it.

    Examples:
        >>> learning(np.array([[1.0], [3.0], [7.0]]), np.array([1, 5, 200]), 200)[[0, 1, 19]].tolist()
        [[2.0], [2.0], [7.0]]

    Args:
        log: Of the episodes.
        ends: Environment step at which each ended, (episodes,).
        steps: Of the whole training; what ends after them counts with the last part.
    """
    part = np.minimum((ends * BINS / steps).astype(int), BINS - 1)
    means, last = [], np.zeros(log.shape[1])
    for i in range(BINS):
        last = log[part == i].mean(0) if (part == i).any() else last
        means.append(last)
    return np.array(means)


def grouped(kicked: np.ndarray) -> np.ndarray:
    """Return (kicks, steps, columns) in groups of ``EVERY`` steps, each step as heavy as the copies that stand then."""
    standing = kicked[..., :1]
    groups = (len(kicked), -1, EVERY)
    weights = standing.reshape(*groups, 1)
    sums = (kicked.reshape(*groups, kicked.shape[-1]) * weights).sum(2)
    means = sums / np.maximum(weights.sum(2), 1e-9)
    return np.concatenate([weights.mean(2), means[..., 1:]], -1)
