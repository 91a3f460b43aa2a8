"""A law for lambda_t (A44). The paper gives none; this is ours."""

from __future__ import annotations

from uard import _checks
from uard.method.arrays import Array, Numbers, namespace


def z_score(value: Numbers, location: Numbers, deviation: Numbers, floor: Numbers = 0.0) -> Array:
    """z = (value - location) / max(deviation, floor): how unusual a disagreement is; dimensionless.

    Examples:
        >>> float(z_score(2.0, location=0.5, deviation=0.25))
        6.0

    Args:
        value: A disagreement, in reward units.
        location: Its mean over all state-actions, in reward units.
        deviation: Its mean absolute deviation, in reward units, >= 0.
        floor: Least deviation that is divided by, in reward units, >= 0.

    Returns:
        z, of the shape that all broadcast to; 0 where deviation and floor are 0, for there nothing is unusual.
    """
    xp = namespace(value, location, deviation, floor)
    gap = value - location
    gap = gap if hasattr(gap, "shape") else xp.asarray(gap)
    zero = xp.zeros_like(gap)
    width = xp.maximum(deviation + zero, floor + zero)
    flat = width <= 0
    return xp.where(flat, zero, gap / xp.where(flat, xp.ones_like(width), width))


def adaptive_lambda(z: Numbers, lam: Numbers = 2.0, kappa: Numbers = 2.0) -> Array:
    """lambda_t = lambda (1 + kappa max(0, z - 1)): more skepticism where disagreement stands out (A44).

    Examples:
        >>> float(adaptive_lambda(3.0, lam=2.0, kappa=2.0)), float(adaptive_lambda(0.5, lam=2.0, kappa=2.0))
        (10.0, 2.0)

    Args:
        z: z-score of the disagreement, see ``z_score``.
        lam: Base lambda, a number >= 0.
        kappa: Gain, a number >= 0; 0 gives the paper's constant lambda.

    Returns:
        lambda_t >= 0, of the shape of ``z``.

    Raises:
        InvalidValueError: for a negative or non-finite lambda or kappa.
    """
    _checks.number("lam", lam, low=0)
    _checks.number("kappa", kappa, low=0)
    xp = namespace(z)
    above = z - 1.0
    return lam * (1.0 + kappa * xp.maximum(above, xp.zeros_like(above)))
