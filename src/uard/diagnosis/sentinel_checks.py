"""A check for values that are no ratings."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from uard.diagnosis.case import Case
from uard.diagnosis.finding import Finding, listed, row_count
from uard.ratings.agreement import krippendorff_alpha
from uard.ratings.pairs import TELLING

if TYPE_CHECKING:
    from jaxtyping import Float


class _Sentinel(NamedTuple):
    """A value that says something else than how good the row is.

    Attributes:
        rater: Number of the rater in the log.
        value: The value.
        others: Mean rating of the other raters in its rows.
        line: What they say where this rater means what the value says, by the rater's other rows.
    """

    rater: int
    value: float
    others: float
    line: float


def sentinel_value(case: Case) -> Finding | None:
    """A value that one rater gives to rows that the others find as good as any: a failure written down as a number."""
    sample = case.sample
    found = [s for k in range(sample.raters.size) for s in _sentinels(case, k)]
    if not found:
        return None
    without = case.ratings.copy()
    numbers: dict[str, float] = {}
    parts: list[str] = []
    for s in found:
        name, value = case.log.raters[s.rater], f"{s.value:g}"
        at = case.ratings[:, s.rater] == s.value
        without[at, s.rater] = np.nan
        numbers |= {f"rows_{name}_{value}": float(at.sum()), f"others_{name}_{value}": s.others}
        parts.append(
            f"{name} is exactly {value} in {row_count(int(at.sum()))} of {int(np.isfinite(case.ratings[:, s.rater]).sum())}, "
            f"first in {case.place(int(np.argmax(at)))}, where the others average {s.others:.3g} (by its other rows that "
            f"would mean {s.line:.3g})"
        )
    alphas = krippendorff_alpha(case.ratings), krippendorff_alpha(without)
    numbers |= {n: a for n, a in zip(("alpha", "alpha_without"), alphas, strict=True) if a is not None}
    change = f" Alpha is {alphas[0]:.2f} with them and {alphas[1]:.2f} without." if None not in alphas else ""
    values = ", ".join(dict.fromkeys(f"--missing {s.value:g}" for s in found))
    return Finding(
        "sentinel-value",
        "danger",
        f"{listed(parts)}.{change}",
        "An answer that failed is read as a verdict: where it is low, good rows are doubted and drawn towards it; where it "
        "is high, bad ones are praised; and disagreement is seen where there was no answer.",
        f"Leave these cells empty, or {values} if that is no rating; and let what writes the log tell failures from scores.",
        numbers,
    )


def _sentinels(case: Case, k: int) -> list[_Sentinel]:
    """Return the sentinel values of a rater of the sample.

    Of the rater's most frequent values, each in turn: a line of the others' mean rating on the rater's, fitted to the
    rows with other values, says what the others would say if the value were meant. It is not meant if they are nearer to
    what they say on average (by six tenths of the way at least), by more than noise, and hardly ever give it themselves;
    and if they find its rows better than those of the next higher values, or worse than those of the next lower ones:
    without that, a bend of the line would do.
    """
    x, m = case.sample.ratings[:, k], case.sample.others[:, k]
    both = np.isfinite(x) & np.isfinite(m)
    rows, x, m = np.flatnonzero(both), x[both], m[both]
    values, counts = np.unique(x, return_counts=True)
    often = np.argsort(-counts, kind="stable")[:10]
    often = often[counts[often] >= max(3, 0.002 * x.size)]
    found: list[_Sentinel] = []
    for value in values[often]:
        at = x == value
        a, b = x[~at], m[~at]
        if a.size < 10 or np.ptp(a) == 0 or np.ptp(b) == 0:
            continue
        r = float(np.corrcoef(a, b)[0, 1])
        if r < 0.3 or r * np.sqrt(a.size) < TELLING:
            continue
        slope, c = r * b.std() / a.std(), int(at.sum())
        line, there, usual = b.mean() + slope * (value - a.mean()), float(m[at].mean()), float(b.mean())
        noise = float((b - b.mean() - slope * (a - a.mean())).std()) * np.sqrt(a.size / (a.size - 2))
        error = noise * np.sqrt(1.0 / c + 1.0 / a.size + (value - a.mean()) ** 2 / (a.size * a.var()))
        missed = (there - line) * np.sign(usual - line)
        if missed < 0.6 * abs(usual - line) or missed < max(5.0 * error, noise):
            continue
        if not _out_of_order(value, there, c, a, b, noise):
            continue
        beside = np.delete(case.sample.ratings[rows[at]], k, 1)
        if (beside == value).sum() <= 0.25 * np.isfinite(beside).sum():
            found.append(_Sentinel(int(case.sample.raters[k]), float(value), there, float(line)))
    return found


def _out_of_order(
    value: float, there: float, count: int, x: Float[np.ndarray, " n"], others: Float[np.ndarray, " n"], noise: float
) -> bool:
    """Return whether others find the rows of a value better than its next higher rows, or worse than its next lower ones.

    Args:
        value: The value.
        there: What others say of its rows on average.
        count: How many these are.
        x: This rater's other ratings.
        others: What others say of them.
        noise: Standard deviation of ``others`` about their line.
    """
    for sign in (1.0, -1.0):
        beyond = sign * (x - value)
        near = np.sort(beyond[beyond > 0])[: max(5, x.size // 10)]
        if near.size:
            rows = (beyond > 0) & (beyond <= near[-1])
            error = noise * np.sqrt(1.0 / count + 1.0 / rows.sum())
            if sign * (there - others[rows].mean()) > 3.0 * error:
                return True
    return False
