"""The doctor: which known traps is a log of rewards and ratings in, and what avoids them?

    >>> from uard import doctor
    >>> log = {"reward": [0, 1, 4] * 20, "rating_ann": [0, 1.1, -1.2] * 20, "rating_bob": [0.1, 1, -1] * 20}
    >>> [f.code for f in doctor(log, "uard-operator").findings]
    ['reward-contradicted']

Nothing is trained. The doctor puts the log through the filter that is going to be used (``uard`` if none is named) and
through the filter as printed, and looks at what comes out. A trap of the printed filter that the chosen one avoids is
a ``note``; one that the chosen one is in, or that no filter avoids, is a ``warning`` or a ``danger``.

Differences are measured in units: the standard deviation of the observed rewards. It is taken for granted that what is
rated was rated often enough: the pseudo-count with which ``uard`` meets the first ratings is left out.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from uard import _checks
from uard.method import calibration, uncertainty
from uard.method.mitigations import Feedback, RewardDiscounting, measure_usual, named
from uard.method.weights import discount
from uard.ratings import readers as logs
from uard.ratings.agreement import krippendorff_alpha
from uard.ratings.readers import RatingLog

Severity = Literal["danger", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("danger", "warning", "note")

PRINTED = "uard-operator"
_PAIRS = 200_000  # of rows that are compared
_LARGEST = 1e100  # what is larger is no reward, and its square no number
_ROUNDING = 1e-6  # of a unit: logs are often written in single precision
_FEW = 30  # rated rows below which no statistic means much


@dataclass(frozen=True)
class Finding:
    """A trap that applies.

    Attributes:
        code: Its name; see ``CODES``.
        severity: ``danger``: training goes wrong; ``warning``: it may; ``note``: it would with another setting.
        evidence: What in the log shows it, in numbers.
        consequence: What it would do to training.
        remedy: What avoids it.
        numbers: The numbers of the evidence, by name.
    """

    code: str
    severity: Severity
    evidence: str
    consequence: str
    remedy: str
    numbers: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Diagnosis:
    """What the doctor found.

    Attributes:
        source: Which log.
        mitigation: The filter that is going to be used.
        rows: Rows of the log.
        raters: Names of the annotators.
        rated: Share of rows that somebody rated, in [0, 1].
        agreement: Krippendorff's alpha (interval metric) of the annotators, <= 1; None where it is not defined.
        calibration: How well sigma predicts |reward - true reward| on rated rows; None without a true reward. For
            ``sigma_h`` alone, ``sigma_h_with_proxy`` (the reward counted as one more rater) and ``sigma_m`` (if
            logged): ``spearman`` and, where there are lies and honest rows, ``auroc`` (a lie is off by over a unit).
        findings: The worst first.
    """

    source: str
    mitigation: str
    rows: int
    raters: tuple[str, ...]
    rated: float
    agreement: float | None
    calibration: Mapping[str, Mapping[str, float]] | None
    findings: tuple[Finding, ...]

    def count(self, severity: Severity) -> int:
        """Return how many findings are of this severity."""
        return sum(f.severity == severity for f in self.findings)

    def as_data(self) -> dict[str, Any]:
        """Return everything as plain data that JSON can hold."""
        return asdict(self) | {"raters": list(self.raters), "findings": [asdict(f) for f in self.findings]}

    def __str__(self) -> str:
        """Return the whole diagnosis as text, 100 columns wide."""
        who = f"{len(self.raters)} rater{'s' * (len(self.raters) != 1)}"
        names = f" ({', '.join(self.raters)})" if 0 < len(self.raters) <= 8 else ""
        lines = [f"{self.source}: {self.rows} rows, {who}{names}, {_percent(self.rated)} of rows rated"]
        alpha = "not defined (fewer than two ratings of anything, or all ratings equal)"
        if self.agreement is not None:
            alpha = f"{self.agreement:.3f} (1 perfect, 0 chance; below 0.667 by custom too low to rely on)"
        lines.append(f"agreement   Krippendorff's alpha {alpha}")
        for sigma, values in (self.calibration or {}).items():
            shown = ", ".join(f"{name} {value:.3f}" for name, value in values.items())
            lines.append(f"calibration {sigma.replace('_with_proxy', ' with the reward as a rater')}: {shown}")
        lines.append(f"filter      {self.mitigation}")
        for f in self.findings:
            lines += ["", f"{f.severity.upper():8}{f.code}"]
            for name in ("evidence", "consequence", "remedy"):
                lines.append(
                    textwrap.fill(getattr(f, name), 100, initial_indent=f"  {name:12}", subsequent_indent=14 * " ")
                )
        found = ", ".join(f"{self.count(s)} {s}" for s in SEVERITIES if self.count(s))
        return "\n".join([*lines, "", f"findings: {found or 'none'}"])


def doctor(
    log: RatingLog | str | Path | Mapping[str, Any],
    mitigation: str | RewardDiscounting = "uard",
    *,
    reward: str = "reward",
    ratings: Sequence[str] | None = None,
) -> Diagnosis:
    """Name every known trap that a log of rewards and ratings is in.

    Args:
        log: A ``uard.ratings.readers.RatingLog``; the path of a CSV, JSONL or Parquet file; or named columns. See ``uard.ratings.readers``
            for the columns.
        mitigation: The filter that is going to be used: the name of one, or a ``RewardDiscounting``.
        reward: Name of the column of rewards, for a file or columns.
        ratings: Names of the annotators' columns; all that start with ``rating`` if left out.

    Raises:
        InvalidValueError: the log cannot be read (the message names row and column), no reward in it is a number, or
            the mitigation is no reliability filter.
    """
    if isinstance(log, str | Path):
        log = logs.read(log, reward, ratings)
    elif not isinstance(log, RatingLog):
        log = logs.from_columns(log, reward, ratings)
    name = mitigation if isinstance(mitigation, str) else "your filter"
    case = _case(log, name, _method(mitigation))
    found = [_not_finite(log), *(check(case) for check in CHECKS)]
    return Diagnosis(
        log.source,
        name if isinstance(mitigation, str) else repr(mitigation),
        len(log),
        log.raters,
        float(case.rated.mean()),
        krippendorff_alpha(case.ratings),
        _calibration(case),
        tuple(sorted((f for f in found if f is not None), key=lambda f: SEVERITIES.index(f.severity))),
    )


def filtered(log: RatingLog, mitigation: str | RewardDiscounting = "uard") -> np.ndarray:
    """Return the reward to learn from of every row of a log, (n,): what the doctor looks at.

    Args:
        log: A log whose rewards and ratings are finite; missing ratings are NaN.
        mitigation: A form of the filter, by name or itself.

    Raises:
        InvalidValueError: a reward is NaN or infinite, a rating or sigma_m is infinite (the message names the row), or
            the mitigation is no reliability filter.
    """
    _checks.finite("reward", log.reward)
    _checks.finite("ratings", np.where(np.isnan(log.ratings), 0.0, log.ratings))
    heard, distinct = _feedback(log.reward, log.ratings, _numbered(log.item))
    return _filtered(_method(mitigation), log.reward, log.sigma_m, heard, distinct)[1]


def _method(mitigation: str | RewardDiscounting) -> RewardDiscounting:
    method = named(mitigation) if isinstance(mitigation, str) else mitigation
    if not isinstance(method, RewardDiscounting):
        raise _checks.InvalidValueError("mitigation", mitigation, "a form of the filter (uard, uard-operator, ...)")
    return method


def _numbered(item: np.ndarray | None) -> np.ndarray | None:
    return None if item is None else np.unique(item, return_inverse=True)[1]


class _Outcome(NamedTuple):
    """What a filter makes of each row."""

    name: str
    method: RewardDiscounting
    weight: np.ndarray
    believed: np.ndarray


class _Case(NamedTuple):
    """A log of which only usable numbers are left, and what the filters make of it.

    Attributes:
        log: The whole log.
        rows: Numbers of the rows that are left.
        reward: Their rewards.
        ratings: Their ratings, NaN where one is missing.
        sigma_m: The ensemble's disagreement, or None.
        true: What they were really worth, NaN where unknown, or None.
        feedback: What is known of each row's item.
        distinct: What is known of every distinct item.
        rated: Whether that is anything.
        unit: Standard deviation of the rewards.
        noise: How far the mean of a row's ratings may be from what raters mean: so many of its usual standard errors
            that of all rows hardly one gets there by chance.
        mine: The filter that is going to be used.
        printed: The filter as printed.
        advised: The filter that we recommend.
    """

    log: RatingLog
    rows: np.ndarray
    reward: np.ndarray
    ratings: np.ndarray
    sigma_m: np.ndarray | None
    true: np.ndarray | None
    feedback: Feedback
    distinct: Feedback
    rated: np.ndarray
    unit: float
    noise: float
    mine: _Outcome
    printed: _Outcome
    advised: _Outcome

    def place(self, row: int) -> str:
        return self.log.place(int(self.rows[row]))

    def several(self) -> np.ndarray:
        """Return where two or more people rated."""
        return self.rated & (self.feedback.raters >= 2)

    def gap(self) -> np.ndarray:
        """Return the reward minus the mean rating; 0 where nobody rated."""
        return np.where(self.rated, self.reward - self.feedback.mean, 0.0)

    def far(self) -> np.ndarray:
        """Return where the mean rating is more than a unit from the reward, and that is no noise."""
        return np.abs(self.gap()) > max(self.unit, self.noise)

    def agreed(self, distance: np.ndarray) -> np.ndarray:
        """Return where raters are nearer to each other than to what is at that distance from their mean."""
        return self.several() & (3.0 * self.feedback.spread < np.abs(distance))


def _usable(x: np.ndarray) -> np.ndarray:
    return np.abs(x) < _LARGEST


def _case(log: RatingLog, name: str, method: RewardDiscounting) -> _Case:
    rows = np.flatnonzero(_usable(log.reward))
    if not rows.size:
        raise _checks.InvalidValueError(f"{log.source}: column of rewards", "no number", "finite numbers")
    reward, ratings = log.reward[rows], np.where(_usable(log.ratings[rows]), log.ratings[rows], np.nan)
    sigma_m = None if log.sigma_m is None else np.where(_usable(log.sigma_m), log.sigma_m, 0.0)[rows]
    true = None if log.true_reward is None else np.where(_usable(log.true_reward), log.true_reward, np.nan)[rows]
    item = None if log.item is None else _numbered(log.item[rows])
    heard, distinct = _feedback(reward, ratings, item)
    several = heard.raters >= 2
    error = heard.spread[several] / np.sqrt(np.maximum(heard.raters[several] - 1.0, 1.0))
    deviation = float(reward.std())

    def outcome(name: str, method: RewardDiscounting) -> _Outcome:
        return _Outcome(name, method, *_filtered(method, reward, sigma_m, heard, distinct))

    return _Case(
        log,
        rows,
        reward,
        ratings,
        sigma_m,
        true,
        heard,
        distinct,
        heard.count > 0,
        deviation if deviation > 1e-12 * np.abs(reward).max() else 1.0,
        1.5 * math.sqrt(2.0 * math.log(error.size)) * float(np.median(error)) if error.size else 0.0,
        outcome(name, method),
        outcome(PRINTED, _method(PRINTED)),
        outcome("uard", _method("uard")),
    )


def _feedback(reward: np.ndarray, ratings: np.ndarray, item: np.ndarray | None) -> tuple[Feedback, Feedback]:
    """Return what is known of every row's item, and of every distinct item."""
    here = np.isfinite(ratings)
    raters = here.sum(1).astype(float)
    rated = raters > 0
    present = np.where(here, ratings, 0.0)
    mean = present.sum(1) / np.maximum(raters, 1.0)
    lowest = np.where(rated, np.where(here, ratings, np.inf).min(1, initial=np.inf), 0.0)
    spread = np.zeros_like(reward)
    if ratings.shape[1] > 1:
        spread = np.asarray(uncertainty.sigma_human(present, mask=here, empty=0.0))
    visits = Feedback(rated.astype(float), mean, lowest, spread, reward, raters)
    if item is None:
        return visits, visits
    count = np.bincount(item, rated)
    columns = [np.bincount(item, column * rated) / np.maximum(count, 1.0) for column in visits[1:]]
    distinct = Feedback(count, *columns)
    return Feedback._make(column[item] for column in distinct), distinct


def _filtered(
    method: RewardDiscounting, reward: np.ndarray, sigma_m: np.ndarray | None, heard: Feedback, distinct: Feedback
) -> tuple[np.ndarray, np.ndarray]:
    """Return every row's weight and the reward that would be learned from."""
    sigma_m = np.zeros_like(reward) if sigma_m is None else sigma_m
    method = replace(method, prior_count=0.0)
    usual = measure_usual(distinct, distinct.count > 0, method.proxy_is_rater)
    anchor = method.reward_anchor(reward, heard, usual)
    weight = method.weight(reward - anchor, reward, sigma_m, heard, usual)
    return np.asarray(weight), np.asarray(discount(reward, weight, anchor))


def _moved(case: _Case, method: RewardDiscounting, shift: float, factor: float) -> np.ndarray:
    """Return what would be learned from if all rewards and ratings were multiplied, then shifted."""

    def moved(f: Feedback) -> Feedback:
        mean, lowest, proxy = (factor * x + shift for x in (f.mean, f.lowest, f.proxy))
        return Feedback(f.count, mean, lowest, factor * f.spread, proxy, f.raters)

    sigma_m = None if case.sigma_m is None else factor * case.sigma_m
    heard, distinct = moved(case.feedback), moved(case.distinct)
    return _filtered(method, factor * case.reward + shift, sigma_m, heard, distinct)[1]


def _pairs(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all pairs of two lists of rows, or as many drawn at random as can be looked at."""
    if first.size * second.size <= _PAIRS:
        return np.repeat(first, second.size), np.tile(second, first.size)
    random = np.random.default_rng(0)
    return random.choice(first, _PAIRS), random.choice(second, _PAIRS)


def _percent(share: float) -> str:
    text = f"{100 * share:.1f}"
    return f"{100 * share:.2g} %" if text == "0.0" and share > 0 else f"{text.removesuffix('.0')} %"


def _rows(n: int) -> str:
    return f"{n} row" + "s" * (n != 1)


# What is in the log.


def _not_finite(log: RatingLog) -> Finding | None:
    columns = {"reward": log.reward}
    columns |= {name: log.ratings[:, k] for k, name in enumerate(log.raters)}
    columns |= {name: column for name in logs.NUMBERS if (column := getattr(log, name)) is not None}
    parts, numbers = [], {}
    for name, column in columns.items():
        bad = ~_usable(column)
        if name in log.raters:
            bad &= ~np.isnan(column)  # a missing rating, of which another check speaks
        if bad.any():
            first = int(np.argmax(bad))
            parts.append(f"{name} in {_rows(int(bad.sum()))}, first {column[first]} in {log.place(first)}")
            numbers[name] = float(bad.sum())
    if not parts:
        return None
    return Finding(
        "not-finite",
        "danger",
        f"NaN, infinite or beyond {_LARGEST:g}: {'; '.join(parts)}.",
        "One NaN reward makes every mean, target and gradient that it enters NaN, and often silently so; an infinite "
        "rating makes sigma_h and the anchor infinite. Here these rows and cells are left out of everything below.",
        "Drop these rows, or mark missing ratings as missing (sigma_human(ratings, mask=...)); find out what wrote them.",
        numbers,
    )


def _few_ratings(case: _Case) -> Finding | None:
    rated, share = int(case.rated.sum()), float(case.rated.mean())
    if rated == 0:
        return Finding(
            "no-ratings",
            "danger",
            f"None of {len(case.reward)} rows has a rating.",
            "Without ratings uard only scales the reward, and protects from nothing; sigma_m alone hardly sees a lie.",
            "Have at least two people rate a sample of steps, those with the highest rewards first.",
            {"rated_rows": 0.0},
        )
    if rated >= _FEW and share >= 0.1:
        return None
    return Finding(
        "few-ratings",
        "warning",
        f"{rated} of {len(case.reward)} rows are rated ({_percent(share)}).",
        "What nobody has rated is believed in part (uard: a tenth) or wholly (the filter as printed), whatever it claims; "
        f"and with fewer than {_FEW} rated rows the numbers here mean little.",
        "Rate more, the highest rewards first; with few ratings of one noisy rater named('lcb') does better than uard.",
        {"rated_rows": float(rated), "rated_share": share},
    )


def _missing_ratings(case: _Case) -> Finding | None:
    here = np.isfinite(case.ratings)
    if here.all() or not case.rated.any():
        return None
    per_rater = 1.0 - here.mean(0)
    worst = int(per_rater.argmax())
    missing, none = float(1.0 - here.mean()), int((here.sum(1) == 0).sum())
    evidence = (
        f"{_percent(missing)} of ratings are missing; most of {case.log.raters[worst]} ({_percent(per_rater[worst])}). "
        f"{_rows(none)} have none at all"
    )
    numbers = {"missing": missing, "unrated_rows": float(none)}
    numbers |= {f"missing_{name}": float(x) for name, x in zip(case.log.raters, per_rater, strict=True)}
    if none:
        empty = here.sum(1) == 0
        numbers["mean_reward_unrated"] = float(case.reward[empty].mean())
        numbers["mean_reward_rated"] = float(case.reward[~empty].mean())
        evidence += (
            f", with a mean reward of {numbers['mean_reward_unrated']:.3g} against "
            f"{numbers['mean_reward_rated']:.3g} of the others"
        )
    return Finding(
        "missing-ratings",
        "warning" if missing > 0.05 else "note",
        evidence + ".",
        "A NaN that is averaged poisons sigma_h and the anchor; fewer raters on a row mean a smaller sigma_h, so gaps look "
        "like agreement; and a lie that nobody rated is hardly doubted.",
        "Pass a mask: sigma_human(ratings, mask=np.isfinite(ratings), empty=...); ask the missing rater again.",
        numbers,
    )


def _idle_raters(case: _Case) -> Finding | None:
    """Raters that say nothing of their own: they repeat the reward or another rater, or always say the same."""
    said, numbers = [], {}
    sample = np.unique(np.linspace(0, len(case.reward) - 1, 100_000).astype(int))
    reward, ratings, names = case.reward[sample], case.ratings[sample], case.log.raters

    def repeats(a: np.ndarray, b: np.ndarray) -> float:
        a, b = (x[np.isfinite(a) & np.isfinite(b)] for x in (a, b))
        same = np.abs(a - b) <= _ROUNDING * case.unit
        return float(same.mean()) if a.size >= _FEW and np.ptp(b) > 0 else 0.0

    for k, name in enumerate(names):
        column = ratings[:, k]
        here = np.isfinite(column)
        if here.sum() >= _FEW and np.ptp(column[here]) == 0 and np.ptp(reward[here]) > 0:
            said.append(f"{name} always says {column[here][0]:g}")
            numbers[f"constant_{name}"] = float(column[here][0])
        elif (share := repeats(column, reward)) >= 0.99:
            said.append(f"{name} repeats the reward exactly in {_percent(share)} of its rows")
            numbers[f"repeats_reward_{name}"] = share
        else:
            for j in range(k):
                if (share := repeats(column, ratings[:, j])) >= 0.99:
                    said.append(f"{name} equals {names[j]} in {_percent(share)} of their rows")
                    numbers[f"{name}_repeats_{names[j]}"] = share
                    break
    if not said:
        return None
    return Finding(
        "idle-raters",
        "warning",
        "; ".join(said) + ".",
        "Such a rater knows nothing of its own. Copies lower sigma_h, so they turn doubt into trust; a copy of the reward "
        "confirms every lie in it.",
        "Leave these columns out (--ratings), and find out whether the people rated alone or saw the reward.",
        numbers,
    )


def _one_rater(case: _Case) -> Finding | None:
    if not case.rated.any() or case.several().any():
        return None
    far = np.abs(case.gap()) > case.unit
    kept = {o.name: _kept(case, o, far) for o in (case.mine, case.printed)}
    numbers = {"rated_rows": float(case.rated.sum()), "contradicted_rows": float(far.sum())}
    evidence = f"No row has more than one rating, so sigma_h = 0 in all {int(case.rated.sum())} rated rows."
    blind = False
    if far.any():
        numbers |= {f"kept_{name}": share for name, share in kept.items()}
        blind = kept[case.mine.name] >= 0.5
        evidence += (
            f" In {_rows(int(far.sum()))} the rating is more than one unit ({case.unit:.3g}) from the reward; there "
            + " and ".join(f"{name} still believes {_percent(share)} of the difference" for name, share in kept.items())
            + "."
        )
    return Finding(
        "one-rater",
        "danger" if blind else "warning",
        evidence,
        "One person never disagrees with itself: sigma_h = 0 is read as certainty, which means blind trust in the reward.",
        "Count the reward as one more rater (proxy_is_rater=True, as uard does; it then lives on the distance between "
        "rating and reward, which noise can hide), or have a second person rate a sample.",
        numbers,
    )


def _kept(case: _Case, outcome: _Outcome, where: np.ndarray) -> float:
    """Return how much of the difference between reward and mean rating is still believed; 1 is all."""
    if not where.any():
        return 0.0
    mean = case.feedback.mean[where]
    share = (outcome.believed[where] - mean) / (case.reward[where] - mean)
    return float(np.clip(share, 0.0, 1.0).mean())


def _contradicted(case: _Case) -> Finding | None:
    """Raters agree with each other, and not with the reward; or the two are not in one unit."""
    gap, far = case.gap(), case.far()
    if _mostly(far, case.rated):
        return _other_units(case, far)
    agreed = far & case.agreed(gap)
    if not agreed.any():
        return None
    mine, printed, advised = (_kept(case, o, agreed) for o in (case.mine, case.printed, case.advised))
    worst = int(np.argmax(np.where(agreed, np.abs(gap), 0.0)))
    severity: Severity = "danger" if mine >= 0.5 else "warning" if mine >= 0.1 else "note"
    above = int((agreed & (gap > 0)).sum())
    kept = {case.mine.name: mine, PRINTED: printed}
    return Finding(
        "reward-contradicted",
        severity,
        f"In {_rows(int(agreed.sum()))} ({above} of them paid too much) raters agree with each other and the reward is more "
        f"than a unit ({case.unit:.3g}) away; most of all in {case.place(worst)}: reward {case.reward[worst]:.3g}, ratings "
        f"{case.feedback.mean[worst]:.3g} ± {case.feedback.spread[worst]:.2g}. Of the difference "
        f"{' and '.join(f'{name} still believes {_percent(share)}' for name, share in kept.items())}.",
        "Agreement makes sigma_h small, so a filter that looks at the raters alone trusts the reward most where they "
        "all contradict it, and the agent learns to go there.",
        f"Count the reward as one more rater (proxy_is_rater=True): named('uard') believes {_percent(advised)} of it here.",
        {
            "rows": float(agreed.sum()),
            "largest": float(gap[worst]),
            "kept": mine,
            "kept_printed": printed,
            "kept_uard": advised,
        },
    )


def _mostly(part: np.ndarray, whole: np.ndarray) -> bool:
    return bool(part.sum() > 0.5 * whole.sum())


def _other_units(case: _Case, far: np.ndarray) -> Finding:
    reward, mean = case.reward[case.rated], case.feedback.mean[case.rated]
    together = 0.0
    if np.ptp(mean) > 0 and np.ptp(reward) > 0:
        together = float(np.corrcoef(reward, mean)[0, 1])
    numbers = {
        "far_share": float(far.sum() / case.rated.sum()),
        "mean_reward": float(reward.mean()),
        "mean_rating": float(mean.mean()),
        "correlation": together,
    }
    return Finding(
        "other-units",
        "danger",
        f"In {_percent(numbers['far_share'])} of the rated rows the ratings are more than a unit ({case.unit:.3g}) from the reward "
        f"(means {numbers['mean_rating']:.3g} and {numbers['mean_reward']:.3g}; correlation {together:.2f}).",
        "The filter compares ratings with rewards: their distance is doubt, the lowest rating is the anchor. If they are "
        "in other units (stars against points) every reward is doubted or replaced by a number that means something else.",
        "Bring the ratings into the reward's unit first, on rows that can be trusted. If they are in it already, the reward is "
        "wrong nearly everywhere: learn from the ratings, named('worst-of-annotations') or named('lcb').",
        numbers,
    )


def _colluding(case: _Case) -> Finding | None:
    if case.true is None:
        return None
    known = case.rated & np.isfinite(case.true)
    true = np.where(known, case.true, 0.0)
    error = np.where(known, case.feedback.mean - true, 0.0)
    wrong = case.agreed(error) & (np.abs(error) > max(case.unit, case.noise))
    if not wrong.any() or _mostly(case.far(), case.rated):
        return None
    worst = int(np.argmax(np.where(wrong, np.abs(error), 0.0)))
    paid = float((case.mine.believed - true)[wrong].mean())
    share = float(wrong.sum() / max(int(known.sum()), 1))
    return Finding(
        "colluding-raters",
        "danger",
        f"In {_rows(int(wrong.sum()))} ({_percent(share)} of those whose true reward is known) raters agree with each other and are "
        f"more than a unit ({case.unit:.3g}) from the true reward; most of all in {case.place(worst)}: ratings "
        f"{case.feedback.mean[worst]:.3g} ± {case.feedback.spread[worst]:.2g}, true {true[worst]:.3g}. There "
        f"{case.mine.name} would pay {paid:+.3g} more than the truth on average.",
        "Agreement is read as truth. No method that listens to these raters can help; the agent learns what they repeat.",
        "No setting avoids it. Ask people who do not see the reward or each other, and check a sample against the truth.",
        {"rows": float(wrong.sum()), "share": share, "largest": float(error[worst]), "overpaid": paid},
    )


def _dead_ensemble(case: _Case) -> Finding | None:
    sigma = case.sigma_m
    if sigma is None or sigma.size < 2:
        return None
    constant = np.ptp(sigma) <= _ROUNDING * sigma.max()
    if not constant and sigma.max() > 1e-3 * case.unit:
        return None
    kind = "the same" if constant else "nearly 0"
    return Finding(
        "dead-ensemble",
        "warning",
        f"sigma_m is {kind} in all {sigma.size} rows: {sigma.min():.3g} to {sigma.max():.3g}, the unit being {case.unit:.3g}.",
        "alpha sigma_m then says nothing of where the model does not know: a constant factor at best. What nobody has rated "
        "is believed as if it were known.",
        "Make the members differ: own initialisation and own data (bootstrap masks), or random priors; and check that "
        "sigma_m is taken over the members, not over one shared output.",
        {"smallest": float(sigma.min()), "largest": float(sigma.max())},
    )


class _Truth(NamedTuple):
    """The rated rows whose truth is known: their numbers, how far their reward is off, and whether that is a lie."""

    rows: np.ndarray
    error: np.ndarray
    lie: np.ndarray

    def both_kinds(self) -> bool:
        return min(self.lie.sum(), (~self.lie).sum()) >= 5


def _truth(case: _Case) -> _Truth | None:
    if case.true is None:
        return None
    rows = np.flatnonzero(case.rated & np.isfinite(case.true))
    error = np.abs(case.reward - case.true)[rows]
    return _Truth(rows, error, error > case.unit) if rows.size >= 2 else None


def _quality(sigma: np.ndarray, truth: _Truth) -> dict[str, float]:
    known = np.round(sigma[truth.rows], 6)
    quality = {"spearman": calibration.spearman(known, truth.error)}
    return quality | ({"auroc": calibration.auroc(known, truth.lie)} if truth.both_kinds() else {})


def _calibration(case: _Case) -> dict[str, dict[str, float]] | None:
    truth, f = _truth(case), case.feedback
    if truth is None:
        return None
    with_proxy = uncertainty.with_proxy(f.mean, f.spread, case.reward, f.raters)
    sources = {"sigma_h": f.spread, "sigma_h_with_proxy": with_proxy}
    sources |= {} if case.sigma_m is None else {"sigma_m": case.sigma_m}
    return {name: _quality(sigma / case.unit, truth) for name, sigma in sources.items()}


def _blind_sigma(case: _Case) -> Finding | None:
    truth = _truth(case)
    if truth is None or not truth.both_kinds():
        return None
    quality = _quality(1.0 - case.mine.weight, truth)
    if quality["auroc"] >= 0.75:
        return None
    lies = int(truth.lie.sum())
    return Finding(
        "blind-sigma",
        "danger" if quality["auroc"] < 0.6 else "warning",
        f"Of a row whose reward lies by more than a unit (there are {lies}) and one whose does not, {case.mine.name} doubts "
        f"the lie more in {_percent(quality['auroc'])} of cases (AUROC of 1 - w; 50 % is chance). Spearman of 1 - w with "
        f"|reward - true|: {quality['spearman']:.2f}.",
        "The method assumes that the error grows with sigma. Here it does not: honest rewards are discounted as much as "
        "lies, which slows learning and prevents nothing.",
        "See which source is blind (the lines on calibration): count the reward as one more rater, ask other raters, "
        "or a richer ensemble. If none sees it, do not filter; learn from the ratings or repair the reward.",
        {**quality, "lies": float(lies)},
    )


# What a filter does to the log.


def _by_setting(case: _Case, check: Callable[[_Case, _Outcome], Finding | None]) -> Finding | None:
    """Look at the filter that is going to be used; a trap of the printed one alone is a note."""
    found = check(case, case.mine)
    if found is not None:
        if case.mine.name == case.advised.name:
            return found
        good = check(case, case.advised) is None
        verdict = "avoids" if good else "does not avoid"
        return replace(found, remedy=f"{found.remedy} On this log named('uard') {verdict} it.")
    found = check(case, case.printed)
    if found is None:
        return None
    return replace(
        found,
        severity="note",
        consequence=f"With the filter as printed: {found.consequence}",
        remedy=f"Nothing to do: {case.mine.name} avoids it on this log. {found.remedy}",
    )


def _smaller_penalties(case: _Case, outcome: _Outcome) -> Finding | None:
    r, mean, believed = case.reward, case.feedback.mean, outcome.believed
    gain = np.where(case.rated & (r < 0), believed - np.maximum(r, mean), 0.0)
    lost = (gain > 0.05 * case.unit) & (gain > 0.1 * np.abs(r))
    if not lost.any():
        return None
    i, j = _pairs(np.flatnonzero(lost), np.flatnonzero(case.rated))
    worse = (r[i] < r[j]) & (mean[i] < mean[j])
    turned = worse & (believed[i] > believed[j])
    share = float(turned.sum() / max(int(worse.sum()), 1))
    worst = int(np.argmax(np.where(lost, gain, 0.0)))
    return Finding(
        "smaller-penalties",
        "danger" if turned.any() else "warning",
        f"{outcome.name} makes {int(lost.sum())} of {int((case.rated & (r < 0)).sum())} rated penalties smaller than reward and mean "
        f"rating say; most of all in {case.place(worst)}: {r[worst]:.3g} becomes {believed[worst]:.3g}. In {_percent(share)} of their "
        "pairs with a step that both reward and raters call better, the penalty is paid more.",
        "w < 1 draws a negative reward up to an anchor of zero: the agent is let off exactly where people disagree about how "
        "bad it was, and enters a hazard that it would avoid without a filter.",
        "Draw rewards towards the lowest rating, anchor='lowest', not towards zero.",
        {"penalties": float(lost.sum()), "largest_gain": float(gain[worst]), "turned": share},
    )


def _origin_and_unit(case: _Case, outcome: _Outcome) -> Finding | None:
    rated = np.flatnonzero(case.rated)
    i, j = _pairs(rated, rated)
    apart = np.abs(case.reward[i] - case.reward[j]) > 0.1 * case.unit
    i, j = i[apart], j[apart]
    if not i.size:
        return None
    before = outcome.believed[i] - outcome.believed[j]
    flips: dict[str, float] = {}
    for name, shift, factor in (("shift", -10.0, 1.0), ("scale", 0.0, 0.1)):
        moved = _moved(case, outcome.method, shift, factor)
        after = (moved[i] - moved[j]) / factor
        tiny = 1e-9 * case.unit
        flips[name] = float(((before * after < 0) & (np.abs(before) > tiny) & (np.abs(after) > tiny)).mean())
    if max(flips.values()) < 0.01:
        return None
    return Finding(
        "origin-and-unit",
        "danger" if max(flips.values()) >= 0.1 else "warning",
        f"If 10 is subtracted from all rewards and ratings, {outcome.name} turns the order of {_percent(flips['shift'])} of pairs of "
        f"rows; if all are multiplied by 0.1, of {_percent(flips['scale'])} ({i.size} pairs that differ by over a tenth of a unit).",
        "What the agent prefers then depends on where zero is and on the unit, which carry no meaning: reward "
        "normalisation, another bonus or a rescaled model changes what it learns.",
        "anchor='lowest' makes the filter indifferent to a shift, standardise=True to the unit.",
        flips,
    )


def _lie_still_pays(case: _Case, outcome: _Outcome) -> Finding | None:
    gap, far = case.gap(), case.far()
    contested = far & (gap > 0) & ~case.agreed(gap) & case.several()
    if not contested.any() or _mostly(far, case.rated):
        return None
    extra = (outcome.believed - case.feedback.mean)[contested]
    if extra.mean() < 0.25 * case.unit:
        return None
    worst = int(np.argmax(np.where(contested, outcome.believed - case.feedback.mean, -np.inf)))
    kept = _kept(case, outcome, contested)
    return Finding(
        "lie-still-pays",
        "danger" if extra.mean() > case.unit else "warning",
        f"In {_rows(int(contested.sum()))} raters are divided about a reward that is more than a unit ({case.unit:.3g}) above their mean. "
        f"{outcome.name} still pays {extra.mean():+.3g} more than the mean rating there ({_percent(kept)} of the difference); most of "
        f"all in {case.place(worst)}: reward {case.reward[worst]:.3g}, ratings {case.feedback.mean[worst]:.3g} ± "
        f"{case.feedback.spread[worst]:.2g}, paid {outcome.believed[worst]:.3g}.",
        "The discount is too small to change what is best: the agent goes where the reward lies, only with a smaller bonus.",
        "Let lambda rise where disagreement stands out (kappa > 0) and draw rewards towards the lowest rating.",
        {"rows": float(contested.sum()), "overpaid": float(extra.mean()), "kept": kept},
    )


def _saturated(case: _Case, outcome: _Outcome) -> Finding | None:
    if case.rated.sum() < 10:
        return None
    low, middle, high = np.quantile(outcome.weight[case.rated], [0.05, 0.5, 0.95])
    disagreement = float(np.quantile(case.feedback.spread[case.rated], 0.95) / case.unit)
    numbers = {"q05": float(low), "median": float(middle), "q95": float(high), "sigma_h_q95_in_units": disagreement}
    spoken = f"{outcome.name}: weights of rated rows {low:.3g} (5 %), {middle:.3g} (median), {high:.3g} (95 %)"
    if high < 0.1:
        return Finding(
            "saturated-weights",
            "danger",
            f"{spoken}: nothing is believed.",
            "The agent learns from the anchor alone; honest steps are discounted like lies, and with an anchor of zero "
            "there is nothing left to learn.",
            "Measure sigmas in units of the reward (standardise=True), or lower lam.",
            numbers,
        )
    if low > 0.9 and disagreement > 0.5:
        return Finding(
            "saturated-weights",
            "warning",
            f"{spoken}: everything is believed, though raters disagree by up to {disagreement:.2g} units (95 % of rows).",
            "The filter does nothing: it costs ratings and protects no more than the raw reward.",
            "Measure sigmas in units of the reward (standardise=True), or raise lam. If all rows are disagreed upon alike, "
            "no filter can tell them apart: give raters clearer instructions.",
            numbers,
        )
    return None


CHECKS: tuple[Callable[[_Case], Finding | None], ...] = (
    _few_ratings,
    _missing_ratings,
    _idle_raters,
    _one_rater,
    _contradicted,
    _colluding,
    _dead_ensemble,
    _blind_sigma,
    lambda case: _by_setting(case, _smaller_penalties),
    lambda case: _by_setting(case, _origin_and_unit),
    lambda case: _by_setting(case, _lie_still_pays),
    lambda case: _by_setting(case, _saturated),
)
CODES = (
    "not-finite", "no-ratings", "few-ratings", "missing-ratings", "idle-raters", "one-rater", "reward-contradicted",
    "other-units", "colluding-raters", "dead-ensemble", "blind-sigma", "smaller-penalties", "origin-and-unit",
    "lie-still-pays", "saturated-weights",
)  # fmt: skip
