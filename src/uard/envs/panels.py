"""Panels of annotators (C0-C9): what each of K people says of a step.

A panel is a function of the observed reward, the true reward and the *contested* steps (entering a trap), each (S, A).
In a legitimate twin the two rewards agree, but the contested steps stay contested: the paper keys its erratic rater on
the trap, not on the lie. Every panel can be given extra noise on every rater. It reads the truth, as people do; the
learner gets nothing but the ratings.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from uard import _checks
from uard.envs.tabular import HiddenTruth, Ratings, Task

Speech = tuple[np.ndarray, np.ndarray]


def main(proxy: np.ndarray, true: np.ndarray, contested: np.ndarray) -> Speech:
    """Section 5.8 (C1-C3): one truthful, one tempted at a constant, one erratic on contested steps.

    The paper gives no numbers but sigma_h = 1.247, the deviation of {-1, 2, 1} (audit d). So on a contested step the
    tempted rater stands 60 % of the way from truth to proxy and the erratic one varies (sd 1) about 40 %; with -1
    and +4 that is 2 and 1. Elsewhere all three tell the truth with sd 0.1.
    """
    gap = proxy - true
    centre = np.stack([true, true + 0.6 * gap, true + 0.4 * gap], axis=-1)
    small = np.full(proxy.shape, 0.1)
    deviation = np.stack([small, np.where(contested, 0.0, small), np.where(contested, 1.0, small)], axis=-1)
    return centre, deviation


def appendix(proxy: np.ndarray, true: np.ndarray, contested: np.ndarray) -> Speech:
    """Appendix (C4-C6): truth plus normal noise of sd 0.1, 0.3 and 1.0 on contested steps, 0.2 elsewhere."""
    third = np.where(contested, 1.0, 0.2)
    deviation = np.stack([np.full(proxy.shape, 0.1), np.full(proxy.shape, 0.3), third], axis=-1)
    return np.repeat(true[..., None], 3, axis=-1), deviation


def colluding(proxy: np.ndarray, true: np.ndarray, contested: np.ndarray) -> Speech:
    """Three raters who all repeat the proxy. No method that listens to them can help: a should-fail control."""
    return np.repeat(proxy[..., None], 3, axis=-1), np.zeros((*proxy.shape, 3))


def single(proxy: np.ndarray, true: np.ndarray, contested: np.ndarray) -> Speech:
    """One truthful rater with sd 0.1: alone it never disagrees with itself."""
    return true[..., None], np.full((*proxy.shape, 1), 0.1)


PANELS: dict[str, Callable[[np.ndarray, np.ndarray, np.ndarray], Speech]] = {
    "main": main,
    "appendix": appendix,
    "colluding": colluding,
    "single": single,
}


def ratings(panel: str, task: Task, truth: HiddenTruth, noise: float = 0.0) -> Ratings:
    """Return what the panel says of every step.

    Args:
        panel: A name in ``PANELS``.
        task: Gives the observed reward.
        truth: Gives the true reward and the contested steps.
        noise: Standard deviation of extra normal noise on every rater, in reward units, >= 0.
    """
    speak = PANELS[_checks.choose("panel", panel, PANELS)]
    _checks.number("noise", noise, low=0)
    centre, deviation = speak(np.asarray(task.reward, float), np.asarray(truth.reward, float), np.asarray(truth.hack))
    return Ratings(centre.astype(np.float32), np.sqrt(deviation**2 + noise**2).astype(np.float32))
