"""Do raters who rate something twice say the same twice?"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uard.diagnosis.case import Case, usable
from uard.diagnosis.finding import Finding

if TYPE_CHECKING:
    from jaxtyping import Float

ENOUGH = 10  # earlier answers of a rater, with fewer of which nothing is said about that rater
ERRORS = 3.0  # standard errors by which a rater's own difference must be above that between raters
CELLS = 2_000_000  # of the table of items and raters that are compared; of a larger one rows at even distances


def self_consistency(case: Case) -> Finding | None:
    """Raters who rated something more than once: their own difference beside that between raters.

    Both are mean absolute differences in reward units: of a rater's earlier answer from the one that counts, and of the
    ratings that two raters give one row. A rater whose own answers differ more than raters do, by ``ERRORS`` standard
    errors and in ``ENOUGH`` answers or more, is named. The difference between raters holds their noise and their
    biases, so a rater as noisy as the others is below it on average.
    """
    log = case.log
    if log.repeats is None:
        return None
    row, rater, earlier = log.repeats
    known = usable(earlier) & usable(log.ratings[row, rater])
    own, rater = np.abs(earlier - log.ratings[row, rater])[known], rater[known]
    between = _between(np.where(usable(log.ratings), log.ratings, np.nan))
    if not own.size:
        return None
    numbers = {"repeats": float(own.size), "own_difference": float(own.mean())}
    evidence = f"{own.size} time{'s' * (own.size != 1)} a rater has answered again; the answers differ by {own.mean():.3g} on average"
    worst: list[str] = []
    if between is not None:
        numbers["difference_between_raters"] = between
        evidence += f"; different raters of one row differ by {between:.3g}"
        for k in np.unique(rater):
            mine = own[rater == k]
            error = float(mine.std(ddof=1) / np.sqrt(mine.size)) if mine.size >= ENOUGH else np.inf
            if mine.mean() > between + ERRORS * error:
                worst.append(f"{log.raters[k]} by {mine.mean():.3g} in {mine.size} answers")
                numbers[f"own_difference_{log.raters[k]}"] = float(mine.mean())
    if worst:
        evidence += f". More than that contradict themselves: {', '.join(worst)}"
    return Finding(
        "self-consistency",
        "warning" if worst else "note",
        evidence + ".",
        "Nobody can agree with others better than with themselves: this difference is noise that more raters average out and no "
        "instruction to agree removes. The last answer is the rating; the earlier ones are not used otherwise.",
        "Ask those who contradict themselves whether the question is clear, or leave their answers out."
        if worst
        else "Nothing to do.",
        numbers,
    )


def _between(ratings: Float[np.ndarray, "n K"]) -> float | None:
    """Return the mean absolute difference of two raters of one row, each row weighing as many pairs as it has."""
    step = max(1, -(-ratings.size // CELLS))
    ordered: Float[np.ndarray, "n K"] = np.sort(ratings[::step], axis=1)  # what is missing comes last
    count = np.isfinite(ordered).sum(1)
    # In order x_0 <= x_1 ... the differences of all pairs add up to sum_i (2 i - m + 1) x_i.
    known = np.where(np.isfinite(ordered), ordered, 0.0)
    total = sum(float(((2 * i + 1 - count) * known[:, i]).sum()) for i in range(ratings.shape[1]))
    pairs = (count * (count - 1) // 2).sum()
    return float(total / pairs) if pairs else None
