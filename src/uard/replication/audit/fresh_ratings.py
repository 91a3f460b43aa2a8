"""Section f: what if raters rate afresh at every visit, so that mean weights count, or all err a little?"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from scipy import stats
from scipy.optimize import brentq

from uard.method.weights import reciprocal_weight
from uard.replication import paper
from uard.replication.audit.checks import Check
from uard.replication.audit.raters import MAIN, MASS, RAYLEIGH, V, appendix
from uard.replication.audit.solutions import arriving, critical_ratios
from uard.replication.verdicts import Part

Weight = Callable[[float], float]  # of lambda


def checks() -> list[Check]:
    """Return the checks of this part of the section."""
    return [_fresh_ratings(), _noise()]


def arriving_lambda(ratio: float, trap: Weight, elsewhere: Weight, high: float = 1e4) -> float | None:
    """Return the lambda at which the weights' ratio falls to ``ratio``, or None up to ``high``."""

    def excess(lam: float) -> float:
        return trap(lam) / elsewhere(lam) - ratio

    return None if excess(high) > 0 else float(brentq(excess, 0.0, high))  # type: ignore[arg-type]


def _constant(sigma: float) -> Weight:
    return lambda lam: reciprocal_weight(paper.BETA * sigma, lam)


def _fresh_ratings() -> Check:
    trap, elsewhere = appendix(0)
    main, agree = _constant(paper.SIGMA_H_AT_TRAP), _constant(0.0)
    cases = {
        "main at traps, appendix elsewhere; mean sigma_h": (main, _constant(elsewhere.mean())),
        "main at traps, appendix elsewhere; fresh": (main, elsewhere.mean_weight),
        "appendix at traps, agreement elsewhere; mean sigma_h": (_constant(trap.mean()), agree),
        "appendix at traps, agreement elsewhere; fresh": (trap.mean_weight, agree),
        "appendix; fresh": (trap.mean_weight, elsewhere.mean_weight),
    }
    table = {
        f"{name}, +{reward:g}, {size}": arriving_lambda(ratio, *pair)
        for name, pair in cases.items()
        for (size, reward), ratio in critical_ratios().items()
    }
    appendix_only = {name: lam for name, lam in table.items() if name.startswith("appendix; fresh")}
    return Check(
        "f.fresh-ratings",
        printed={"lambda": paper.LAMBDA},
        recomputed={**table, "mean w at traps, appendix, lambda = 2": trap.mean_weight(paper.LAMBDA)},
        others={"lowest": min(arriving(table)), "settings of the appendix that arrive": len(arriving(appendix_only))},
        claims=(Part("the paper's lambda is large enough in some setting", lambda n: n["lambda"] >= n["lowest"]),),
        findings=(Part("none arrives with the appendix's", lambda n: n["settings of the appendix that arrive"] == 0),),
    )


def noisy_sigmas(noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Return sigma_h at traps and elsewhere at the quadrature's points, each of shape (200,), mass ``MASS``.

    The raters say {-1, 2, 1} at traps and agree elsewhere, and each errs by ``noise`` (an SD). The deviations from their
    mean then are those of a point in a plane that errs likewise: sigma_h is a Rice variable over the root of 3.
    """
    away, root = math.sqrt(3.0) * float(np.std(MAIN)), math.sqrt(3.0)
    if noise:
        return stats.rice.ppf(V**2, away / noise, scale=noise) / root, noise * RAYLEIGH / root
    return np.full_like(V, away / root), np.zeros_like(V)


def weight_of_mean(lam: float, sigma: np.ndarray) -> float:
    """Return the weight of the mean sigma_h."""
    return reciprocal_weight(paper.BETA * float(sigma @ MASS), lam)


def mean_weight(lam: float, sigma: np.ndarray) -> float:
    """Return the mean weight of fresh ratings."""
    return float(reciprocal_weight(paper.BETA * sigma, lam) @ MASS)


def _noise() -> Check:
    ratio = critical_ratios()[6, paper.TRAP_REWARD]
    weights = {"mean sigma_h": weight_of_mean, "fresh ratings": mean_weight}
    noises = (0.0, 0.3, 1.2)
    table: dict[str, float | None] = {}
    for noise in noises:
        trap, elsewhere = noisy_sigmas(noise)
        for name, weight in weights.items():
            on, off = partial(weight, sigma=trap), partial(weight, sigma=elsewhere)
            table[f"noise {noise}, {name}: w ratio at lambda = 2"] = on(paper.LAMBDA) / off(paper.LAMBDA)
            table[f"noise {noise}, {name}: lambda that arrives"] = arriving_lambda(ratio, on, off)

    def stays(name: str, noise: float) -> Part:
        quiet, noisy = (f"noise {x}, {name}: w ratio at lambda = 2" for x in (0.0, noise))
        return Part(f"the ratio of weights stays with {name} at {noise}", lambda n: n[noisy] <= n[quiet] + 0.01)

    def enough(name: str, noise: float) -> Part:
        quiet, noisy = (f"noise {x}, {name}: lambda that arrives" for x in (0.0, noise))
        return Part(
            f"the same lambda arrives with {name} at {noise}",
            lambda n: n[noisy] is not None and n[noisy] <= n[quiet] + 0.01,
        )

    return Check(
        "f.noise",
        recomputed=table,
        others={"most noise": noises[-1], "trap": paper.TRAP_REWARD},
        claims=tuple(make(name, noise) for name in weights for noise in noises[1:] for make in (stays, enough)),
        findings=tuple(
            Part(
                f"no lambda is enough with {name} at {noises[-1]}",
                lambda n, x=f"noise {noises[-1]}, {name}: lambda that arrives": n[x] is None,
            )
            for name in weights
        ),
    )
