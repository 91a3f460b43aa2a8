"""A check for values that are no ratings."""

from __future__ import annotations

import numpy as np

from uard.diagnosis.case import Case
from uard.diagnosis.finding import Finding, listed, row_count
from uard.ratings.agreement import krippendorff_alpha
from uard.ratings.sentinels import sentinels


def sentinel_value(case: Case) -> Finding | None:
    """A value that one rater gives to rows that the others find as good as any: a failure written down as a number."""
    sample = case.sample
    found = [
        (int(rater), s)
        for k, rater in enumerate(sample.raters)
        for s in sentinels(sample.ratings, k, sample.others[:, k])
    ]
    if not found:
        return None
    without = case.ratings.copy()
    numbers: dict[str, float] = {}
    parts: list[str] = []
    for rater, s in found:
        name, value = case.log.raters[rater], f"{s.value:g}"
        at = case.ratings[:, rater] == s.value
        without[at, rater] = np.nan
        numbers |= {f"rows_{name}_{value}": float(at.sum()), f"others_{name}_{value}": s.others}
        parts.append(
            f"{name} is exactly {value} in {row_count(int(at.sum()))} of {int(np.isfinite(case.ratings[:, rater]).sum())}, "
            f"first in {case.place(int(np.argmax(at)))}, where the others average {s.others:.3g} (by its other rows that "
            f"would mean {s.line:.3g})"
        )
    alphas = krippendorff_alpha(case.ratings), krippendorff_alpha(without)
    numbers |= {n: a for n, a in zip(("alpha", "alpha_without"), alphas, strict=True) if a is not None}
    change = f" Alpha is {alphas[0]:.2f} with them and {alphas[1]:.2f} without." if None not in alphas else ""
    values = ", ".join(dict.fromkeys(f"--missing {s.value:g}" for _, s in found))
    return Finding(
        "sentinel-value",
        "danger",
        f"{listed(parts)}.{change}",
        "An answer that failed is read as a verdict: where it is low, good rows are doubted and drawn towards it; where it "
        "is high, bad ones are praised; and disagreement is seen where there was no answer.",
        f"Leave these cells empty, or {values} if that is no rating; and let what writes the log tell failures from scores.",
        numbers,
    )
