"""Panels of annotators (C0-C9): what each of K people says of a step.

A panel is a function of the observed reward, the true reward and the *contested* steps (entering a trap), each of the
same shape and of NumPy or JAX, the rewards floats. In a legitimate twin the two rewards agree, but the contested steps
stay contested: the paper keys its erratic rater on the trap, not on the lie. Every panel can be given extra noise on
every rater. It reads the truth, as people do; the learner gets nothing but the ratings.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from uard import _checks
from uard.envs.tables import HiddenTruth, Ratings, Task
from uard.method.arrays import namespace

if TYPE_CHECKING:
    from uard.envs.base import Tables
    from uard.envs.world import TableWorld

Array = Any
Speech = tuple[Array, Array]


def main(proxy: Array, true: Array, contested: Array) -> Speech:
    """Section 5.8 (C1-C3): one truthful, one tempted at a constant, one erratic on contested steps.

    The paper gives no numbers but sigma_h = 1.247, the deviation of {-1, 2, 1} (audit d). So on a contested step the
    tempted rater stands 60 % of the way from truth to proxy and the erratic one varies (sd 1) about 40 %; with -1
    and +4 that is 2 and 1. Elsewhere all three tell the truth with sd 0.1.
    """
    xp = namespace(proxy, true, contested)
    gap = proxy - true
    centre = xp.stack([true, true + 0.6 * gap, true + 0.4 * gap], axis=-1)
    small = xp.full_like(proxy, 0.1)
    return centre, xp.stack([small, xp.where(contested, 0.0, small), xp.where(contested, 1.0, small)], axis=-1)


def appendix(proxy: Array, true: Array, contested: Array) -> Speech:
    """Appendix (C4-C6): truth plus normal noise of sd 0.1, 0.3 and 1.0 on contested steps, 0.2 elsewhere."""
    xp = namespace(proxy, true, contested)
    first, second, third = (xp.full_like(proxy, sd) for sd in (0.1, 0.3, 0.2))
    return xp.stack([true] * 3, axis=-1), xp.stack([first, second, xp.where(contested, 1.0, third)], axis=-1)


def colluding(proxy: Array, true: Array, contested: Array) -> Speech:
    """Three raters who all repeat the proxy. No method that listens to them can help: a should-fail control."""
    xp = namespace(proxy, true, contested)
    centre = xp.stack([proxy] * 3, axis=-1)
    return centre, xp.zeros_like(centre)


def single(proxy: Array, true: Array, contested: Array) -> Speech:
    """One truthful rater with sd 0.1: alone it never disagrees with itself."""
    centre = true[..., None]
    return centre, namespace(proxy, true, contested).full_like(centre, 0.1)


PANELS: dict[str, Callable[[Array, Array, Array], Speech]] = {
    "main": main,
    "appendix": appendix,
    "colluding": colluding,
    "single": single,
}


def check(panel: str, noise: float) -> None:
    """Check the name of a panel and the standard deviation of its extra noise, which is >= 0."""
    _checks.choose("panel", panel, PANELS)
    _checks.number("noise", noise, low=0)


def raters(panel: str) -> int:
    """Return a panel's number of annotators K."""
    return PANELS[panel](np.zeros(1), np.zeros(1), np.zeros(1, bool))[0].shape[-1]


def say(panel: str, proxy: Array, true: Array, contested: Array, noise: Array = 0.0) -> Ratings:
    """Return what the panel says of steps of any shape: (..., K) centre and deviation; nothing is checked.

    Args:
        panel: A name in ``PANELS``.
        proxy: Observed reward, an array (one of no dimensions for one step).
        true: True reward.
        contested: Whether the step is contested.
        noise: Standard deviation of extra normal noise on every rater, in reward units, >= 0.
    """
    centre, deviation = PANELS[panel](proxy, true, contested)
    return Ratings(centre, namespace(deviation).sqrt(deviation**2 + noise**2))


def ratings(panel: str, task: Task, truth: HiddenTruth, noise: float = 0.0) -> Ratings:
    """Return what the panel says of every step.

    Args:
        panel: A name in ``PANELS``.
        task: Gives the observed reward.
        truth: Gives the true reward and the contested steps.
        noise: Standard deviation of extra normal noise on every rater, in reward units, >= 0.
    """
    check(panel, noise)
    said = say(panel, np.asarray(task.reward, float), np.asarray(truth.reward, float), np.asarray(truth.hack), noise)
    return Ratings(said.centre.astype(np.float32), said.deviation.astype(np.float32))


def of_tables(spec: Tables, panel: str, noise: float) -> TableWorld:
    """Return the compiled world of a small problem, rated by a panel (needs JAX)."""
    from uard.envs.world import table_world

    return table_world(spec.task(), spec.truth(), spec.speech(panel, noise))
