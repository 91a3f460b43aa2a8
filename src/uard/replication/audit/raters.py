"""The paper's annotators: how far their ratings of one step are apart, exactly, by quadrature."""

from __future__ import annotations

import math

import numpy as np

from uard.method.weights import reciprocal_weight
from uard.replication import paper

MAIN = (-1.0, 2.0, 1.0)  # of all triples with the paper's sigma_h the one that we take: true, tempted, erratic

# Quadrature over a Rayleigh variable: midpoints v of [0, 1] with P(R < radius) = v^2, so that R grows like v near 0.
V = (np.arange(200) + 0.5) / 200
RAYLEIGH, MASS = np.sqrt(-2.0 * np.log1p(-(V**2))), V / V.sum()


class RaterSpread:
    """sigma_h of three raters with independent normal errors and no bias: exact by quadrature over an angle.

    The errors' deviations from their mean live in a plane, so sigma_h = R sqrt(g(angle)) with R Rayleigh-distributed
    and the angle uniform.

    Attributes:
        g: (angles,) squared scale at each angle.
    """

    def __init__(self, deviations: tuple[float, ...], ddof: int, angles: int = 64):
        """Take the raters' standard deviations and the ddof of sigma_h."""
        size = len(deviations)
        centring = np.eye(size) - 1.0 / size
        scales = np.diag(deviations)
        high, low = np.linalg.eigvalsh(scales @ centring @ scales)[::-1][:2]
        angle = (np.arange(angles) + 0.5) * (math.pi / 2 / angles)
        self.g = (high * np.cos(angle) ** 2 + low * np.sin(angle) ** 2) / (size - ddof)

    def mean(self) -> float:
        """E sigma_h."""
        return math.sqrt(math.pi / 2) * float(np.sqrt(self.g).mean())

    def exceeds(self, threshold: float) -> float:
        """P(sigma_h >= threshold)."""
        return float(np.exp(-(threshold**2) / (2.0 * self.g)).mean())

    def below(self, other: RaterSpread) -> float:
        """P(a draw of this spread < an independent draw of the other)."""
        return float((other.g / (other.g + self.g[:, None])).mean())

    def mean_weight(self, lam: float, beta: float = paper.BETA) -> float:
        """E w over fresh draws, for the reciprocal filter."""
        weight = reciprocal_weight(np.sqrt(self.g)[:, None] * RAYLEIGH, lam * beta)
        return float((weight @ MASS).mean())

    def weight_ratio_limit(self, other: RaterSpread) -> float:
        """E w of this spread over E w of the other, for lambda to infinity."""
        return float(np.mean(1.0 / np.sqrt(self.g)) / np.mean(1.0 / np.sqrt(other.g)))


def appendix(ddof: int) -> tuple[RaterSpread, RaterSpread]:
    """Return the spread of the appendix's annotators at traps and elsewhere."""
    trap, elsewhere = (RaterSpread(sd, ddof) for sd in paper.APPENDIX_RATER_SD.values())
    return trap, elsewhere


def annotator_sigmas() -> dict[str, tuple[float, float]]:
    """Return sigma_h at traps and elsewhere of the readings of the annotators (means over fresh draws)."""
    readings = {
        "main, population SD": (paper.SIGMA_H_AT_TRAP, 0.0),
        "main, sample SD": (float(np.std(MAIN, ddof=1)), 0.0),
    }
    for ddof in (0, 1):
        trap, elsewhere = appendix(ddof)
        readings[f"appendix, ddof {ddof}"] = (trap.mean(), elsewhere.mean())
    return readings
