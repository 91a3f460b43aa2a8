"""The doctor: which known traps is a log of rewards and ratings in, and what avoids them?

Nothing is trained. The doctor puts the log through the filter that is going to be used (``uard`` if none is named) and
through the filter as printed, and checks what comes out. A trap of the printed filter that the chosen one avoids is
a ``note``; one that the chosen one is in, or that no filter avoids, is a ``warning`` or a ``danger``.

Differences are measured in units: the standard deviation of the observed rewards. It is taken for granted that what is
rated was rated often enough: the pseudo-count with which ``uard-0.1`` meets the first ratings is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from uard import _checks
from uard.diagnosis import (
    agreement_checks,
    copy_checks,
    filter_checks,
    log_checks,
    rater_checks,
    sentinel_checks,
    truth_checks,
)
from uard.diagnosis.case import Case, as_filter, case_of, feedback_of, filtered_rows, numbered
from uard.diagnosis.finding import SEVERITIES, Diagnosis, Finding
from uard.diagnosis.self_consistency import self_consistency
from uard.diagnosis.strata import strata_of
from uard.method.mitigations import Mitigation
from uard.ratings import readers
from uard.ratings.agreement import alpha_interval, krippendorff_alpha
from uard.ratings.log import RatingLog
from uard.ratings.raters import EffectiveRaters, effective_raters

if TYPE_CHECKING:
    from jaxtyping import Float, Shaped


def doctor(
    log: RatingLog | str | Path | Mapping[str, Any],
    mitigation: str | Mitigation = "uard",
    *,
    reward: str = "reward",
    ratings: Sequence[str] | None = None,
    rater: str | None = None,
    item: str | None = None,
    rating: str | None = None,
    missing: Sequence[str] = (),
    by: str | None = None,
) -> Diagnosis:
    """Name every known trap that a log of rewards and ratings is in.

    Examples:
        >>> log = {"reward": [0, 1, 4] * 20, "rating_ann": [0, 1.1, -1.2] * 20, "rating_bob": [0.1, 1, -1] * 20}
        >>> [f.code for f in doctor(log, "uard-operator").findings]
        ['reward-contradicted']

    Args:
        log: A ``uard.ratings.log.RatingLog``; the path of a CSV, JSON, JSONL or Parquet file; or named columns. See
            ``uard.ratings.readers`` for the columns. Of a log without rewards only the raters are checked.
        mitigation: The filter that is going to be used: the name of one, or a ``Mitigation``.
        reward: Name of the column of rewards, for a file or columns.
        ratings: Names of the annotators' columns, likewise; all that start with ``rating`` if left out.
        rater: For a file or columns of one answer per row: the column that says who rated.
        item: Likewise the column that says what was rated.
        rating: Likewise the column of ratings, or the question whose answers are read.
        missing: Further words that mean that a number is missing.
        by: Name of a column, likewise, that divides the rows into parts; agreement is reported within each. A
            ``RatingLog`` has its own.

    Raises:
        InvalidValueError: the log cannot be read (the message names row and column), no reward in it is a number, or
            the mitigation is no reliability filter; ``by`` names more than 50 parts.
    """
    if isinstance(log, str | Path):
        log = readers.read(log, reward, ratings, rater=rater, item=item, rating=rating, missing=missing, by=by)
    elif not isinstance(log, RatingLog):
        log = readers.from_columns(log, reward, ratings, rater=rater, item=item, rating=rating, missing=missing, by=by)
    elif by is not None:
        raise _checks.InvalidValueError("by", by, "left out: the log has its own, RatingLog(by=...)")
    name = mitigation if isinstance(mitigation, str) else "your filter"
    case = case_of(log, name, as_filter(mitigation))
    of_row = None if log.item is None else log.item[case.rows]
    agreement = krippendorff_alpha(case.ratings)
    strata = strata_of(None if log.by is None else log.by[case.rows], case.ratings, of_row)
    found = [log_checks.not_finite(log), *(check(case) for check in (RATER_CHECKS if log.reward is None else CHECKS))]
    found.append(agreement_checks.uneven_agreement(strata, agreement))
    worth = _independence(case, of_row)
    found.append(truth_checks.shared_errors(worth))
    return Diagnosis(
        source=log.source,
        mitigation=name if isinstance(mitigation, str) else repr(mitigation),
        rows=len(log),
        raters=log.raters,
        rated=float(case.rated.mean()),
        agreement=agreement,
        agreement_interval=alpha_interval(case.ratings, of_row),
        strata=strata,
        independence=worth,
        calibration=truth_checks.calibration_of(case),
        findings=tuple(sorted((f for f in found if f is not None), key=lambda f: SEVERITIES.index(f.severity))),
    )


def _independence(case: Case, item: Shaped[np.ndarray, " n"] | None) -> EffectiveRaters | None:
    if case.log.reward is None:
        return None
    if case.true is not None:
        return effective_raters(case.ratings, case.true, "true_reward", item)
    return effective_raters(case.ratings, case.reward, "reward", item)


def filtered(log: RatingLog, mitigation: str | Mitigation = "uard") -> Float[np.ndarray, " n"]:
    """Return the reward to learn from of every row of a log, which the doctor checks.

    Examples:
        >>> log = RatingLog(np.array([1.0, 4.0]), np.array([[1.0, 1.0], [-1.0, 2.0]]))
        >>> filtered(log, "uard-operator").round(2).tolist()
        [1.0, 1.6]

    Args:
        log: A log whose rewards and ratings are finite; missing ratings are NaN.
        mitigation: A form of the filter, by name or itself.

    Raises:
        InvalidValueError: a reward is NaN or infinite, a rating or sigma_m is infinite (the message names the row), or
            the mitigation is no reliability filter.
    """
    if log.reward is None:
        raise _checks.InvalidValueError("reward", None, f"there: {log.source} holds no rewards that could be filtered")
    _checks.finite("reward", log.reward)
    _checks.finite("ratings", np.where(np.isnan(log.ratings), 0.0, log.ratings))
    if log.sigma_m is not None:
        _checks.nonnegative("sigma_m", log.sigma_m)
    known, distinct = feedback_of(log.reward, log.ratings, numbered(log.item))
    return filtered_rows(as_filter(mitigation), log.reward, log.sigma_m, known, distinct)[1]


RATER_CHECKS: tuple[Callable[[Case], Finding | None], ...] = (
    log_checks.no_rewards,
    log_checks.few_ratings,
    log_checks.missing_ratings,
    copy_checks.idle_raters,
    sentinel_checks.sentinel_value,
    agreement_checks.mixed_units,
    agreement_checks.one_rater,
    self_consistency,
)
"""What can be checked without rewards."""
CHECKS: tuple[Callable[[Case], Finding | None], ...] = (
    log_checks.few_ratings,
    log_checks.missing_ratings,
    copy_checks.idle_raters,
    sentinel_checks.sentinel_value,
    rater_checks.straight_lines,
    rater_checks.too_constant,
    copy_checks.copied_ratings,
    agreement_checks.mixed_units,
    agreement_checks.one_rater,
    self_consistency,
    agreement_checks.contradicted,
    truth_checks.colluding,
    log_checks.dead_ensemble,
    truth_checks.blind_sigma,
    lambda case: filter_checks.by_setting(case, filter_checks.smaller_penalties),
    lambda case: filter_checks.by_setting(case, filter_checks.origin_and_unit),
    lambda case: filter_checks.by_setting(case, filter_checks.lie_still_pays),
    lambda case: filter_checks.by_setting(case, filter_checks.saturated),
)
CODES = (
    "not-finite", "no-ratings", "few-ratings", "missing-ratings", "idle-raters", "sentinel-value", "straight-lining",
    "too-constant", "copied-ratings", "mixed-units", "uneven-agreement", "one-rater", "self-consistency", "no-rewards",
    "reward-contradicted", "other-units", "colluding-raters", "shared-errors", "dead-ensemble", "blind-sigma", "smaller-penalties",
    "origin-and-unit", "lie-still-pays", "saturated-weights",
)  # fmt: skip
