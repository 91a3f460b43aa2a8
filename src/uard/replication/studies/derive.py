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
