"""A law for lambda_t (A44). The paper gives none; this is ours."""

from __future__ import annotations

from uard import _checks
from uard.method.arrays import Array, namespace


def z_score(value: Array, location: Array, deviation: Array, floor: Array = 0.0) -> Array:
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
        z: z-score of the disagreement, see ``z_score``.
        lam: Base lambda >= 0.
        kappa: Gain >= 0; 0 gives the paper's constant lambda.
    """
    _checks.number("lam", lam, low=0)
    _checks.number("kappa", kappa, low=0)
    xp = namespace(z)
    return lam * (1.0 + kappa * xp.maximum(z - 1.0, xp.zeros_like(z - 1.0)))
