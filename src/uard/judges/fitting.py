"""What a log of scores tells of a panel of judges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from uard import _checks
from uard.judges.asking import is_listed
from uard.judges.fitted import Fitted
from uard.judges.groups import told_apart
from uard.judges.panel import CLIP, FittedJudge, JudgePanel
from uard.judges.scales import Scale
from uard.judges.score_log import ScoreLog
from uard.method import rater_statistics
from uard.method.mitigations import Mitigation, PooledDiscounting
from uard.ratings.aggregate import aggregate
from uard.ratings.log import RatingLog
from uard.ratings.pairs import sample_of_rows, shared
from uard.ratings.raters import summary
from uard.ratings.sentinels import others_of, sentinels

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Integer

FEWEST = 10  # completions that a judge must have scored
AGREES = 2.0  # standard errors of a correlation, from which on two judges judge the same thing
ALIKE = 0.95  # correlation of two judges from which on one of them is redundant
FEW_PROMPTS = 3  # with two completions each, from which on a judge can be said to tell none apart


def fit(
    log: ScoreLog,
    *,
    rule: str | Mitigation = "uard",
    proxy: str = "mean",
    weights: Sequence[float] = (),
    clip: float = CLIP,
    failures: Mapping[str, Sequence[float]] | None = None,
) -> Fitted:
    """Fit a panel to a log of scores of ordinary completions, such as those of the model before training.

    Location and scale of a judge are mean and standard deviation of its scores, of which none counts as farther than
    ten standard deviations of the ordinary ones (``uard.judges.scales``). A score that one judge gives again and again
    while the others find nothing unusual in these completions is taken for a failure (``uard.ratings.sentinels``),
    unless ``failures`` says which are. Rare failures are often not found (``benchmarks/failures.py``), so that it is
    better to declare them. The rest is what the pooled rule measures of raters (``uard.method.rater_statistics``) on
    standardised scores, of which no judge has given two for one completion.

    Examples:
        >>> random = np.random.default_rng(0)
        >>> quality = random.normal(size=200)
        >>> scores = np.stack([quality, 50 + 10 * quality, random.normal(size=200)], 1) + 0.1
        >>> fitted = fit(ScoreLog(("a", "b", "c"), scores))
        >>> [f"{judge.location:.0f} {judge.scale:.0f}" for judge in fitted.panel.judges], fitted.redundant
        (['0 1', '50 10', '0 1'], (('a', 'b', 1.0),))

    Args:
        log: Of at least 10 scores of each judge.
        rule: See ``JudgePanel``, as for the following.
        proxy: What is believed or doubted.
        weights: Of the mean.
        clip: In standard deviations.
        failures: Scores by judge that are none, ``[]`` where all are scores; found in the log for judges that are not
            named.

    Raises:
        InvalidValueError: a judge has scored fewer than 10 completions, alone or together with any other judge, or a
            setting is not allowed.
    """
    if not hasattr(log, "groups"):
        raise _checks.InvalidValueError("log", log, "a ScoreLog, such as read_scores(file) returns")
    declared = _declared(log, failures or {})
    groups = log.groups
    compared, told = told_apart(log.scores, groups)
    apart = np.where(compared >= FEW_PROMPTS, told > 0, True)
    found = _found(log, apart, declared)
    failing = {name: (*declared.get(name, ()), *found[name]) for name in log.judges}
    judges = [_judge(log, k, (*log.missing, *failing[name])) for k, name in enumerate(log.judges)]
    judges = [
        replace(x, tells_apart=bool(told[k] > 0)) if compared[k] >= FEW_PROMPTS else x for k, x in enumerate(judges)
    ]
    panel = JudgePanel(tuple(judges), proxy=proxy, weights=tuple(weights), clip=clip, rule=rule)  # type: ignore[arg-type]
    _check_together(log)
    ratings = np.stack([judge.standardised(x) for judge, x in zip(judges, log.scores.T, strict=True)], axis=1)
    ratings = np.clip(ratings, -clip, clip)
    panel = _measured(replace(panel, completions=len(ratings)), ratings)
    parts = None if log.prompts is None else groups.astype(str)
    told_of = summary(RatingLog(None, ratings, log.judges, true_reward=log.truth, by=parts, source=log.source))
    times = {name: {x: int((log.scores[:, k] == x).sum()) for x in failing[name]} for k, name in enumerate(log.judges)}
    several = None if log.prompts is None else int((np.bincount(groups) > 1).sum())
    alike = _redundant(ratings, log.judges)
    return Fitted(panel, told_of, alike, log.source, times, found, several, log.truth is not None)


def _declared(log: ScoreLog, failures: Mapping[str, Sequence[float]]) -> dict[str, tuple[float, ...]]:
    """Return the failures that the user has named, none of them perhaps, by judge."""
    for name, values in failures.items():
        _checks.choose("name of a judge in failures", name, log.judges)
        if not is_listed(values):
            raise _checks.InvalidValueError(f"failures of judge {name!r}", values, "a list of numbers")
        for value in values:
            _checks.number(f"failures of judge {name!r}", value)
    return {name: tuple(dict.fromkeys(map(float, values))) for name, values in failures.items()}


def _found(
    log: ScoreLog, apart: Bool[np.ndarray, " K"], declared: Mapping[str, Sequence[float]]
) -> dict[str, tuple[float, ...]]:
    """Return the failures of every judge that nobody has named.

    What they are is asked of those judges only who agree with it beyond chance (the mean of the others means nothing if
    half of it is noise or the opposite), who are no copies of it, and who tell completions apart.
    """
    scores = log.scores.copy()
    for k, name in enumerate(log.judges):
        scores[np.isin(scores[:, k], declared.get(name, ())), k] = np.nan
    different = scores[_different(log)]
    different = different[sample_of_rows(len(different), different.shape[1])]
    usual = np.clip(np.stack([_ratings(column) for column in different.T], axis=1), -CLIP, CLIP)
    both = shared(usual)
    agrees = (both.correlation * np.sqrt(both.rows) > AGREES) & (both.correlation < ALIKE) & apart
    found: dict[str, tuple[float, ...]] = {}
    for k, name in enumerate(log.judges):
        if name in declared:
            found[name] = ()
            continue
        sample = np.where(agrees[k], usual, np.nan)
        sample[:, k] = different[:, k]
        found[name] = tuple(float(s.value) for s in sentinels(sample, k, others_of(sample)[:, k]))
    return found


def _ratings(scores: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    scale = Scale()
    scale.observe(scores[~np.isnan(scores)])
    return scale.ratings(scores)


def _judge(log: ScoreLog, k: int, failures: Sequence[float]) -> FittedJudge:
    """Return a judge's scale."""
    name, scores = log.judges[k], log.scores[:, k]
    given = scores[~(np.isnan(scores) | np.isin(scores, failures))]
    if given.size < FEWEST:
        allowed = f"at least {FEWEST}: log more, or leave this judge out"
        raise _checks.InvalidValueError(f"{log.source}: number of scores of judge {name!r}", given.size, allowed)
    scale = Scale()
    scale.observe(given)
    missing = 1.0 - given.size / scores.size
    none = tuple(dict.fromkeys(failures))
    return FittedJudge(name, scale.location, scale.deviation, missing=missing, sentinels=none)


def _check_together(log: ScoreLog) -> None:
    here = (~np.isnan(log.scores)).astype(float)
    together = here.T @ here - np.diag(here.sum(0))
    for name, most in zip(log.judges, together.max(1).tolist(), strict=True):
        if most < FEWEST:
            allowed = f"at least {FEWEST}: judges are checked against each other on the same completions"
            what = f"{log.source}: completions that judge {name!r} and another one have both scored"
            raise _checks.InvalidValueError(what, int(most), allowed)


def _different(log: ScoreLog) -> Integer[np.ndarray, " rows"]:
    """Return rows without those of which a prompt has the same scores already: most likely the same completion.

    A deterministic judge says the same of it each time, which is no sign of a failure.
    """
    keys = np.column_stack([log.groups, np.where(np.isnan(log.scores), np.inf, log.scores)])
    return np.sort(np.unique(keys, axis=0, return_index=True)[1])


def _measured(panel: JudgePanel, ratings: Float[np.ndarray, "n K"]) -> JudgePanel:
    """Return the panel with what the pooled rule measures of its judges."""
    scored = (~np.isnan(ratings)).any(1)
    ratings = ratings[scored]
    if not len(ratings):
        return panel
    proxy = panel.proxy_of(ratings)
    checked = np.where((~np.isnan(ratings)).sum(1, keepdims=True) >= 2, ratings, np.nan)
    feedback = aggregate(checked, proxy)
    assert feedback.by_rater is not None
    found = rater_statistics.fit(proxy, feedback.by_rater, feedback.count > 0)
    judges = tuple(
        replace(
            judge,
            bias=float(found.bias[k]),
            idiosyncrasy=float(found.idiosyncrasy[k]),
            noise=float(found.noise[k]),
            heard=judge.counts and bool(found.heard[k] > 0),
        )
        for k, judge in enumerate(panel.judges)
    )
    panel = replace(
        panel, judges=judges, typical=float(found.typical), spread=float(found.scale), span=float(found.span)
    )
    if not isinstance(panel.rule, PooledDiscounting):
        return panel
    believed = panel.rule.fit(feedback, feedback.count > 0)
    return replace(panel, usual=float(believed.usual))


def _redundant(ratings: Float[np.ndarray, "n K"], names: Sequence[str]) -> tuple[tuple[str, str, float], ...]:
    both = shared(ratings[sample_of_rows(len(ratings), ratings.shape[1])])
    alike = [
        (names[i], names[j], float(both.correlation[i, j]))
        for i in range(len(names))
        for j in range(i + 1, len(names))
        if both.correlation[i, j] >= ALIKE and both.rows[i, j] >= FEWEST
    ]
    return tuple(alike)
