"""Laws for lambda_t (A44). The paper gives none; these are ours."""

from __future__ import annotations

from uard import _checks
from uard.method.arrays import Array, namespace


def standing(value: Array, location: Array, deviation: Array, floor: Array = 0.0) -> Array:
    """z = (value - location) / max(deviation, floor): how unusual a disagreement is; dimensionless.

    Where both deviation and floor are 0 nothing can be unusual and z = 0.
    """
    xp = namespace(value, location, deviation, floor)
    width = deviation + xp.zeros_like(value - location) if hasattr(value, "shape") else xp.asarray(deviation)
    width = xp.maximum(width, floor + xp.zeros_like(width))
    flat = width <= 0
    return xp.where(flat, xp.zeros_like(width), (value - location) / xp.where(flat, xp.ones_like(width), width))


def adaptive_lambda(z: Array, lam: Array = 2.0, kappa: Array = 2.0) -> Array:
    """lambda_t = lambda (1 + kappa max(0, z - 1)): more skepticism where disagreement stands out (A44).

    Args:
        z: Standing of the disagreement, see ``standing``.
        lam: Base lambda >= 0.
        kappa: Gain >= 0; 0 gives the paper's constant lambda.
    """
    _checks.number("lam", lam, low=0)
    _checks.number("kappa", kappa, low=0)
    xp = namespace(z)
    return lam * (1.0 + kappa * xp.maximum(z - 1.0, xp.zeros_like(z - 1.0)))


def towards_target_discount(lam: float, mean_weight: float, target: float, rate: float = 0.1) -> float:
    """One step of the alternative law: raise lambda while rewards are believed more than ``target`` on average.

    lambda <- lambda exp(rate (mean_weight - target)), an integral controller in log space, so lambda stays > 0.

    Args:
        lam: Present lambda > 0.
        mean_weight: Mean weight over recent steps, in [0, 1].
        target: The mean weight that is wanted, in (0, 1].
        rate: Step size > 0.
    """
    import math

    _checks.number("lam", lam, low=0, open_low=True)
    _checks.number("mean_weight", mean_weight, low=0, high=1)
    _checks.number("target", target, low=0, high=1, open_low=True)
    _checks.number("rate", rate, low=0, open_low=True)
    return lam * math.exp(rate * (mean_weight - target))
