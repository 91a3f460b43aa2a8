"""TRL: several judges become one reward that is believed as far as they agree (GRPO, RLOO).

TRL adds the reward functions of a list up, so their disagreement is lost. Here one function holds all judges:

    reward = UncertaintyDiscountedReward([relevance, clarity, RewardModel(model, tokenizer)])
    trainer = GRPOTrainer(..., reward_funcs=reward, callbacks=[ReliabilityCallback(reward)])

**What normalisation leaves of the discount.** A completion earns b + w (r - b): r is the judges' weighted mean, b
the lowest of them, w how far r is believed. Trainers compare the completions of one prompt, so what *differs* among
them survives: a contested completion falls behind the others. What they share does not:

* a *shift*, the same w and r - b for all completions of a prompt, is always lost with the mean of the group: judges
  who disagree about the prompt only, by the same amount for each completion, change nothing;
* a *factor*, where all rewards of a group shrink alike (w is the same, and b too: ``anchor="zero"``), is lost with the
  group's standard deviation, by which GRPO divides with ``scale_rewards="group"``, its default, and with
  ``multi_objective_aggregation="normalize_then_sum"``. Under "batch" and "none", and in RLOO, it survives.

How much of the discount is left is measured in every group (``advantage_change``), and ``ReliabilityCallback`` warns
where it is nothing.

Nothing here imports TRL, transformers or torch before a model or the callback is used.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from uard import _checks
from uard.adapters.trl.advantages import advantage_change, group_means, groups_of
from uard.judges import Judge, Scale, as_scores, ask, by_name
from uard.method.mitigations import Mitigation, uard
from uard.ratings.stream import RewardStream

if TYPE_CHECKING:
    from jaxtyping import Float, Integer

DISCOUNTED = 0.9  # a group whose mean weight is below this is discounted
CANCELLED = 0.05  # and its discount cancelled, if the normalised advantages change by less than this


class UnscoredWarning(UserWarning):
    """No judge scored a completion, so it teaches nothing."""


class Judged(NamedTuple):
    """What became of one batch of B completions, in standard deviations of a judge; NaN where no judge scored one.

    Attributes:
        scores: As the K judges gave them, in units of their own; NaN where one is missing.
        ratings: The same in standard deviations of each judge; NaN where a score is missing or its judge has given
            nothing but this score so far.
        raw: The proxy r: the judges' weighted mean, or the judge that was named as the proxy.
        reward: b + w (r - b): what is learned from.
        weight: w in [0, 1].
        sigma_h: The judges' disagreement; 0 for a completion with fewer than two ratings.
        sigma_m: The disagreement of an ensemble; 0 without one.
        lam: lambda_t.
    """

    scores: Float[np.ndarray, "B K"]
    ratings: Float[np.ndarray, "B K"]
    raw: Float[np.ndarray, " B"]
    reward: Float[np.ndarray, " B"]
    weight: Float[np.ndarray, " B"]
    sigma_h: Float[np.ndarray, " B"]
    sigma_m: Float[np.ndarray, " B"]
    lam: Float[np.ndarray, " B"]


@dataclass
class Tally:
    """Counts over all completions so far.

    Attributes:
        missing: How many each judge did not score.
        completions: All of them.
        unscored: How many no judge scored.
        unchecked: How many were scored, but by fewer than two judges that tell completions apart.
        weight: Sum of the weights of the scored ones.
        widest: Largest sigma_h.
        discounted: Groups with a mean weight below 0.9.
        shifted: Of these, how many have nearly the same advantages without the discount.
        cancelled: How many have if a group's advantages are divided by their standard deviation; those shifted too.
    """

    missing: dict[str, int]
    completions: int = 0
    unscored: int = 0
    unchecked: int = 0
    weight: float = 0.0
    widest: float = 0.0
    discounted: int = 0
    shifted: int = 0
    cancelled: int = 0


class UncertaintyDiscountedReward:
    """Several judges as one reward function for TRL's GRPOTrainer and RLOOTrainer.

    The judges' scores are brought to one scale; their weighted mean is the proxy r, their disagreement sigma_h. What is
    learned from is b + w (r - b): r, drawn towards the lowest judge b the further, the more the judges disagree
    compared with their mean disagreement over all completions so far (``uard.method.mitigations.uard``). Its unit is a
    judge's standard deviation.

    A score of None or NaN is missing: the other judges decide. A completion with fewer than two ratings has nothing to
    be checked against and is believed as little as the mitigation believes unrated steps. One that no judge scored gets
    None, which TRL leaves out of training. All of this is counted in ``tally`` and logged.

    Every call changes it; pickling keeps all that it knows. In distributed training each process has its own running
    scales: give ``scales`` if groups are split over processes.

    Examples:
        >>> def length(completions, **question):
        ...     return [len(text) for text in completions]
        >>> def clarity(completions, **question):
        ...     return [-text.count("um") for text in completions]
        >>> reward = UncertaintyDiscountedReward([length, clarity])
        >>> learned = reward(["why?"] * 3, ["so", "therefore", "um, um, therefore"])
        >>> [f"{x:.1f}" for x in reward.last.raw], [f"{x:.1f}" for x in learned]
        (['-0.2', '0.3', '-0.1'], ['-0.5', '0.3', '-1.3'])

    Attributes:
        judges: The judges by name.
        last: What became of the latest batch; None before the first.
        tally: Counts over all batches.
    """

    def __init__(
        self,
        judges: Mapping[str, Judge] | Sequence[Judge],
        *,
        weights: Sequence[float] | None = None,
        proxy: str | None = None,
        scales: Sequence[tuple[float, float] | None] | None = None,
        sigma_m: Judge | None = None,
        mitigation: Mitigation | None = None,
        clip: float = 5.0,
        name: str = "uard",
    ):
        """Take the judges.

        Args:
            judges: K >= 2 reward functions as TRL calls them (keywords ``prompts``, ``completions``,
                ``completion_ids``, ``trainer_state``, ``log_extra``, ``log_metric`` and the columns of the data set;
                one number or None per completion; ``async def`` too), ``RewardModel`` among them. Their names are the
                keys of a mapping, else their ``__name__``.
            weights: One number > 0 per judge, for the mean; equal if left out.
            proxy: Name of the judge that is the proxy instead of the mean. Where it has no score the mean steps in.
            scales: One (location, deviation > 0) per judge in its own unit, or None for the running one; all are
                running if left out.
            sigma_m: Like a judge, but it gives the disagreement of an ensemble: one number >= 0 per completion in
                standard deviations of a judge, or a row with the scores of N >= 2 members per completion.
            mitigation: What discounts; ``uard(prior_count=0)`` if left out: no completion comes twice, so its own
                scores are all that will ever be known of it.
            clip: Ratings are cut off at this many standard deviations, > 0.
            name: What TRL and the logs call this reward.

        Raises:
            InvalidValueError: for fewer than two judges (one never disagrees with itself and would be trusted
                blindly), judges that cannot be called or told apart, and bad numbers.
        """
        self.judges = by_name(judges)
        if sigma_m is not None and not callable(sigma_m):
            raise _checks.InvalidValueError("sigma_m", sigma_m, "a function with the signature of a judge")
        if proxy is not None:
            _checks.choose("proxy", proxy, self.judges)
        _checks.number("clip", clip, low=0, open_low=True)
        self.last: Judged | None = None
        self.tally = Tally(dict.fromkeys(self.judges, 0))
        self.__name__ = name
        self._weights = _weights(weights, len(self.judges))
        self._scales = _scales(scales, len(self.judges))
        self._members = Scale()
        self._proxy = None if proxy is None else list(self.judges).index(proxy)
        self._sigma_m, self._clip = sigma_m, clip
        self._stream = RewardStream(uard(prior_count=0.0) if mitigation is None else mitigation)

    @property
    def deviations(self) -> dict[str, float]:
        """Standard deviation of each judge's scores; 0 for one that has never varied."""
        return {name: scale.deviation for name, scale in zip(self.judges, self._scales, strict=True)}

    @property
    def memory(self) -> Any:
        """All that it has learned from completions, to be pickled and set again; the judges are not in it."""
        return self.tally, self._scales, self._members, self._stream

    @memory.setter
    def memory(self, memory: Any) -> None:
        names = list(memory[0].missing)
        if names != list(self.judges):
            raise _checks.InvalidValueError("judges", list(self.judges), f"{names}, those that the memory is of")
        self.tally, self._scales, self._members, self._stream = memory

    def __call__(
        self,
        prompts: Sequence[Any],
        completions: Sequence[Any],
        completion_ids: Any = None,
        log_extra: Callable[[str, list[Any]], None] | None = None,
        log_metric: Callable[[str, float], None] | None = None,
        **columns: Any,
    ) -> list[float | None]:
        """Return one reward per completion, None where no judge scored it; TRL calls this.

        Args:
            prompts: B prompts; neighbours with the same prompt are a group.
            completions: B completions, as texts or as lists of messages.
            completion_ids: Their tokens, for judges that read them.
            log_extra: Given a name and B values, of which TRL logs a column beside the completions.
            log_metric: Given a name and a number, which TRL logs.
            columns: Other columns of the data set, for the judges.

        Raises:
            JudgeError: if a judge raises.
            InvalidValueError: if a judge gives the wrong number of scores, or one that is no finite number.

        Warns:
            UnscoredWarning: the first time that no judge scores a completion.
        """
        asked = self.judges if self._sigma_m is None else {**self.judges, "sigma_m": self._sigma_m}
        question = {"prompts": prompts, "completions": completions, "completion_ids": completion_ids}
        answers = ask(asked, {**question, "log_extra": log_extra, "log_metric": log_metric, **columns})
        scores = np.stack([as_scores(name, answers[name], len(completions)) for name in self.judges], axis=1)
        sigma_m = self._ensemble(answers, len(completions))
        self.last = self._discount(scores, sigma_m)
        self._count(self.last)
        groups = groups_of(prompts)
        change = advantage_change(self.last.raw, self.last.reward, groups)
        self._count_groups(self.last, groups, change)
        if log_extra is not None:
            self._log_completions(self.last, log_extra)
        if log_metric is not None:
            self._log_means(self.last, change, log_metric)
        return [None if math.isnan(reward) else reward for reward in self.last.reward.tolist()]

    def _ensemble(self, answers: dict[str, Any], size: int) -> Float[np.ndarray, " B"]:
        """Return sigma_m from what the ensemble answered, if there is one."""
        if self._sigma_m is None:
            return np.zeros(size)
        values = _checks.as_numpy("sigma_m", answers["sigma_m"])
        if values.shape == (size,):
            _checks.nonnegative("sigma_m", values)
            return values
        if values.ndim != 2 or len(values) != size or values.shape[1] < 2:
            allowed = f"({size},) or ({size}, N) with N >= 2 members"
            raise _checks.InvalidValueError("shape of the answer of sigma_m", values.shape, allowed)
        _checks.finite("sigma_m", values)
        self._members.observe(values)
        return np.std(values, axis=1, ddof=1) / (self._members.deviation or 1.0)

    def _discount(self, scores: Float[np.ndarray, "B K"], sigma_m: Float[np.ndarray, " B"]) -> Judged:
        here = ~np.isnan(scores)
        for judge, scale in enumerate(self._scales):
            scale.observe(scores[here[:, judge], judge])
        rated = np.stack([scale.ratings(column) for scale, column in zip(self._scales, scores.T, strict=True)], 1)
        ratings = np.clip(rated, -self._clip, self._clip)
        raw = self._combine(ratings)
        scored = here.any(1)
        checked = (~np.isnan(ratings)).sum(1, keepdims=True) >= 2
        filtered = self._stream(raw[scored], np.where(checked, ratings, np.nan)[scored], sigma_m[scored])

        def whole(values: Float[np.ndarray, " scored"]) -> Float[np.ndarray, " B"]:
            column = np.full(len(scores), np.nan)
            column[scored] = values
            return column

        f = filtered
        columns = (f.raw, f.reward, f.weight, f.sigma_h, f.sigma_m, f.lam)
        return Judged._make([scores, ratings, *map(whole, columns)])

    def _combine(self, ratings: Float[np.ndarray, "B K"]) -> Float[np.ndarray, " B"]:
        """Return the proxy; 0, the mean of all completions so far, where no judge tells completions apart."""
        here = ~np.isnan(ratings)
        total = here @ self._weights
        mean = np.where(here, ratings, 0.0) @ self._weights / np.where(total > 0, total, 1.0)
        return mean if self._proxy is None else np.where(here[:, self._proxy], ratings[:, self._proxy], mean)

    def _count(self, judged: Judged) -> None:
        tally, missing = self.tally, np.isnan(judged.scores)
        unscored = missing.all(1)
        if unscored.any() and not tally.unscored:
            warnings.warn(
                f"no judge scored completion {int(np.argmax(unscored))} ({unscored.sum()} of {unscored.size} in this "
                "batch): they get no reward and teach nothing. Counted in tally.unscored from now on",
                UnscoredWarning,
                stacklevel=3,
            )
        for name, number in zip(self.judges, missing.sum(0).tolist(), strict=True):
            tally.missing[name] += number
        tally.completions += unscored.size
        tally.unscored += int(unscored.sum())
        tally.unchecked += int(((~np.isnan(judged.ratings)).sum(1) < 2)[~unscored].sum())
        tally.weight += float(np.nansum(judged.weight))
        tally.widest = float(np.max(judged.sigma_h, initial=tally.widest, where=~unscored))

    def _count_groups(
        self, judged: Judged, groups: Integer[np.ndarray, " B"], change: Float[np.ndarray, " groups"]
    ) -> None:
        discounted = ~np.isnan(change) & (group_means(judged.weight, groups) < DISCOUNTED)
        undivided = advantage_change(judged.raw, judged.reward, groups, divided=False)
        self.tally.discounted += int(discounted.sum())
        self.tally.shifted += int((discounted & (undivided < CANCELLED)).sum())
        self.tally.cancelled += int((discounted & (change < CANCELLED)).sum())

    def _log_completions(self, judged: Judged, log_extra: Callable[[str, list[Any]], None]) -> None:
        columns = {name: judged.scores[:, k] for k, name in enumerate(self.judges)}
        columns |= {name: getattr(judged, name) for name in ("raw", "weight", "sigma_h", "sigma_m")}
        for name, values in columns.items():
            log_extra(f"{self.__name__}/{name}", [None if math.isnan(x) else x for x in values.tolist()])

    def _log_means(
        self, judged: Judged, change: Float[np.ndarray, " groups"], log_metric: Callable[[str, float], None]
    ) -> None:
        missing = np.isnan(judged.scores)
        values = {f"{name}/missing": missing[:, k].mean() for k, name in enumerate(self.judges)}
        values |= {f"{name}/mean": _mean(judged.scores[:, k]) for k, name in enumerate(self.judges)}
        values |= {name: _mean(getattr(judged, name)) for name in ("raw", "weight", "sigma_h", "sigma_m", "lam")}
        values |= {"unscored": missing.all(1).mean(), "advantage_change": _mean(change)}
        for name, value in values.items():
            if not math.isnan(value):
                log_metric(f"{self.__name__}/{name}", float(value))


def _mean(values: Float[np.ndarray, " n"]) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else math.nan


def _weights(weights: Sequence[float] | None, number: int) -> Float[np.ndarray, " K"]:
    if weights is None:
        return np.ones(number)
    if len(weights) != number:
        raise _checks.InvalidValueError("len(weights)", len(weights), f"{number}, one per judge")
    for judge, weight in enumerate(weights):
        _checks.number(f"weights[{judge}]", weight, low=0, open_low=True)
    return np.array(weights, np.float64)


def _scales(scales: Sequence[tuple[float, float] | None] | None, number: int) -> list[Scale]:
    if scales is None:
        return [Scale() for _ in range(number)]
    if len(scales) != number:
        raise _checks.InvalidValueError("len(scales)", len(scales), f"{number}, one per judge")
    made: list[Scale] = []
    for judge, pair in enumerate(scales):
        location, deviation = (0.0, None) if pair is None else pair
        _checks.number(f"scales[{judge}][0]", location)
        if deviation is not None:
            _checks.number(f"scales[{judge}][1]", deviation, low=0, open_low=True)
        made.append(Scale(location=location, fixed=deviation))
    return made
