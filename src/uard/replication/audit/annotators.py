"""Section d: sigma_h = 1.247 and the annotators of the appendix."""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq

from uard.replication import paper
from uard.replication.audit.checks import Check
from uard.replication.audit.raters import MAIN, RaterSpread, appendix
from uard.replication.verdicts import Opinion, Part

TARGET = paper.SIGMA_H_AT_TRAP


def checks() -> list[Check]:
    """Return the checks of this section."""
    return [_triples(), _appendix(), _frozen()]


def triples_with_sd(target: float, step: float, ddof: int) -> int:
    """Count unordered triples on a grid in [-10, 10] whose SD rounds to ``target`` at three decimals.

    Args:
        target: The SD, with three decimals.
        step: Of the grid, > 0.
        ddof: Of the SD.
    """
    points = round(20 / step)
    gaps = np.arange(points + 1) * step
    first, second = np.meshgrid(gaps, gaps, indexing="ij")
    inside = first + second <= 20 + 1e-9
    sd = np.std(np.stack([np.zeros_like(first), first, first + second]), axis=0, ddof=ddof)
    hits = inside & (np.abs(np.round(sd, 3) - target) < 1e-9)
    return int((points + 1 - np.round((first + second)[hits] / step)).sum())


def _triples() -> Check:
    population = "integer triples in [-10, 10], population SD"
    return Check(
        "d.triples",
        printed={"sigma_h": TARGET},
        recomputed={
            population: triples_with_sd(TARGET, 1.0, 0),
            "integer triples, sample SD": triples_with_sd(TARGET, 1.0, 1),
            "halves, sample SD": triples_with_sd(TARGET, 0.5, 1),
            "tenths, sample SD": triples_with_sd(TARGET, 0.1, 1),
            "{-1, 2, 1}, population SD": float(np.std(MAIN)),
            "{-1, 2, 1}, sample SD": float(np.std(MAIN, ddof=1)),
        },
        claims=(
            Part(
                "three whole numbers have it with the 1/(M-1) of the equation",
                lambda n: n["integer triples, sample SD"] > 0,
            ),
            Part("three halves have it with 1/(M-1)", lambda n: n["halves, sample SD"] > 0),
            Part("three tenths have it with 1/(M-1)", lambda n: n["tenths, sample SD"] > 0),
            Opinion("ratings of a stochastic rater have one SD, to three decimals", False),
        ),
        findings=(
            Part("three whole numbers have it with 1/M", lambda n: n[population] > 0),
            Part("{-1, 2, 1} have it with 1/M", lambda n: round(n["{-1, 2, 1}, population SD"], 3) == n["sigma_h"]),
        ),
    )


def _appendix() -> Check:
    spreads = {ddof: appendix(ddof) for ddof in (0, 1)}
    first, second, _ = paper.APPENDIX_RATER_SD["trap"]

    def needed(ddof: int) -> float:
        return float(brentq(lambda sd: RaterSpread((first, second, sd), ddof).mean() - TARGET, 0.5, 9.0))  # type: ignore[arg-type]

    return Check(
        "d.appendix",
        printed={"sigma_h": TARGET},
        recomputed={f"mean at traps, ddof {d}": trap.mean() for d, (trap, _) in spreads.items()}
        | {f"mean elsewhere, ddof {d}": elsewhere.mean() for d, (_, elsewhere) in spreads.items()}
        | {f"P(at least 1.247), ddof {d}": trap.exceeds(TARGET) for d, (trap, _) in spreads.items()}
        | {f"third rater's SD for a mean of 1.247, ddof {d}": needed(d) for d in spreads},
        others={f"share, ddof {d}": trap.mean() / TARGET for d, (trap, _) in spreads.items()},
        claims=(
            Part("their mean sigma_h is within a tenth of it, with 1/M", lambda n: abs(n["share, ddof 0"] - 1) < 0.1),
            Part(
                "their mean sigma_h is within a tenth of it, with 1/(M-1)", lambda n: abs(n["share, ddof 1"] - 1) < 0.1
            ),
        ),
        findings=(
            Part("their mean sigma_h is less than half of it, with 1/M", lambda n: n["share, ddof 0"] < 0.5),
            Part("their mean sigma_h is less than half of it, with 1/(M-1)", lambda n: n["share, ddof 1"] < 0.5),
        ),
    )


def _frozen() -> Check:
    trap, elsewhere = appendix(0)
    return Check(
        "d.frozen",
        recomputed={"P": trap.below(elsewhere)},
        findings=(Part("it happens more than one time in ten", lambda n: n["P"] > 0.1),),
    )
