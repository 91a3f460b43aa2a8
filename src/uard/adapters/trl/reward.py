"""TRL: several judges become one reward that is believed as far as they agree (GRPO, RLOO).

TRL adds the reward functions of a list up, so their disagreement is lost. Here one function holds all judges:

    reward = UncertaintyDiscountedReward([relevance, clarity, RewardModel(model, tokenizer)])
    trainer = GRPOTrainer(..., reward_funcs=reward, callbacks=[ReliabilityCallback(reward)])

**What normalisation leaves of the discount.** A completion earns b + w (r - b), less a premium: r is the judges'
weighted mean, b a cautious pool of what they say, w how far r is believed. Trainers compare the completions of one
prompt, so what *differs* among them survives: a contested completion falls behind the others. What they share does not:

* a *shift*, the same w and r - b for all completions of a prompt, is always lost with the mean of the group: judges
  who disagree about the prompt only, by the same amount for each completion, change nothing;
* a *factor*, where all rewards of a group shrink alike (w and b are the same), is lost with the
  group's standard deviation, by which GRPO divides with ``scale_rewards="group"``, its default, and with
  ``multi_objective_aggregation="normalize_then_sum"``. Under "batch" and "none", and in RLOO, it survives.

How much of the discount is left is measured in every group (``advantage_change``), and ``ReliabilityCallback`` warns
where it is nothing.

Nothing here imports TRL, transformers or torch before a model or the callback is used.
"""

from __future__ import annotations

import copy
import math
import threading
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from uard import _checks
from uard.adapters.trl.advantages import advantage_change
from uard.adapters.trl.memory import Memory, Tally
from uard.judges import (
    Answer,
    Combined,
    FittedJudge,
    JudgePanel,
    RewardFunction,
    Scale,
    as_scores,
    ask,
    by_name,
    check_name,
)
from uard.judges.asking import is_listed, limits_of
from uard.judges.doubts import Doubt, UnscoredWarning, doubts_of_answers, missed, raise_if_all_raised, whys
from uard.judges.groups import group_means, groups_of, judges_at_least, told_apart
from uard.judges.panel import CLIP
from uard.judges.reward import for_judges
from uard.judges.rules import check_rule
from uard.judges.scales import ABSURD, Moments
from uard.method.mitigations import Mitigation, uard
from uard.ratings.stream import RewardStream

if TYPE_CHECKING:
    from jaxtyping import Float, Integer

_Ensemble = np.ndarray | None  # sigma_m (B,), or the scores of its members (B, N)

DISCOUNTED = 0.9  # a group whose mean weight is below this is discounted
CANCELLED = 0.05  # and its discount cancelled, if the normalised advantages change by less than this
ENOUGH_GROUPS = 16  # groups that a judge has compared before a verdict about it
WIDEST_SIGMA = 1e12  # standard deviations; more would only overflow

_OF_PROCESS = ("_lock", "_pauses", "_busy", "_model")  # what of a reward is not pickled


class UselessJudgeWarning(UserWarning):
    """A judge cannot be compared with the others, always agrees with them, or tells no advantages apart."""


class AbsurdScoreWarning(UserWarning):
    """A judge gave a score that is far beyond all its others."""


class Judged(NamedTuple):
    """What became of one batch of B completions, in standard deviations of a judge; NaN where no judge scored one.

    Attributes:
        scores: As the K judges gave them, in units of their own; NaN where one is missing.
        ratings: The same in standard deviations of each judge; NaN where a score is missing or its judge has given
            nothing but this score so far, or has never told the completions of one prompt apart.
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


class UncertaintyDiscountedReward:
    """Several judges as one reward function for TRL's GRPOTrainer and RLOOTrainer.

    The judges' scores are brought to one scale; their weighted mean is the proxy r, their disagreement sigma_h. What is
    learned from is r, drawn towards a cautious pool of what judges say the further, the less likely it is that all of
    them mean r (``uard.method.mitigations.uard``). Its unit is a judge's standard deviation.

    A score of None or NaN is missing: the other judges decide. A completion with fewer than two ratings has nothing to
    be checked against and is believed as little as the mitigation believes unrated steps. One that no judge scored gets
    None, which TRL leaves out of training. All of this is counted in ``tally`` and logged.

    With running scales a judge that has never told the completions of one prompt apart is left out like one that always
    says the same: no advantage can depend on it. From the first difference on it counts. A panel does not change: it
    leaves out for good who told none apart in the log that it was fitted to, if that log had prompts.

    Judges get prompts and completions as TRL has them: where these are conversations, a completion is a list of
    messages, and its text is ``completion[-1]["content"]``.

    Every call changes it, except while it is ``paused`` or the model that it follows is evaluated; pickling keeps all
    that it knows. What a call returns belongs to it, whatever other threads ask meanwhile. In distributed training each
    process has its own running scales: give ``scales`` if groups are split over processes.

    Examples:
        >>> def length(completions, **question):
        ...     return [len(text) for text in completions]
        >>> def clarity(completions, **question):
        ...     return [-text.count("um") for text in completions]
        >>> reward = UncertaintyDiscountedReward([length, clarity])
        >>> learned = reward(["why?"] * 3, ["so", "therefore", "um, um, therefore"])
        >>> [f"{x:.1f}" for x in reward.last.raw], [f"{x:.1f}" for x in learned]
        (['-0.2', '0.3', '-0.1'], ['-0.5', '0.1', '-0.8'])

    Attributes:
        judges: The judges by name.
        last: What became of the latest batch, whichever thread asked about it; None before the first.
        tally: Counts over all batches.
    """

    def __init__(
        self,
        judges: Mapping[str, RewardFunction] | Sequence[RewardFunction],
        panel: JudgePanel | str | Path | None = None,
        *,
        weights: Sequence[float] | None = None,
        proxy: str = "mean",
        scales: Sequence[tuple[float, float] | None] | None = None,
        sigma_m: RewardFunction | None = None,
        mitigation: Mitigation | None = None,
        clip: float = CLIP,
        timeout: float | Mapping[str, float] | None = None,
        name: str = "uard",
        rule: str | Mitigation | None = None,
    ):
        """Take the judges.

        Args:
            judges: K >= 2 reward functions as TRL calls them (keywords ``prompts``, ``completions``,
                ``completion_ids``, ``trainer_state``, ``log_extra``, ``log_metric`` and the columns of the data set;
                one number or None per completion; ``async def`` too), ``RewardModel`` among them, and ``Judge`` where
                one is to be asked with care. Their names are the keys of a mapping, else their ``__name__``.
            panel: What ``uard judges fit`` wrote, or its file: then each completion has the same reward in any batch
                and process. Scales run with the training if it is left out. Whatever the panel says is not given here.
            weights: One number > 0 per judge, for the mean; equal if left out.
            proxy: ``mean``, ``median``, or the name of the judge that is the proxy. Where it has no score the mean
                steps in.
            scales: One (location, deviation > 0) per judge in its own unit, or None for the running one; all are
                running if left out.
            sigma_m: Like a judge, but it gives the disagreement of an ensemble: one number >= 0 per completion in
                standard deviations of a judge, or a row with the scores of N >= 2 members per completion.
            mitigation: What discounts; ``uard()`` if left out: no completion comes twice, so its own
                scores are all that will ever be known of it.
            clip: Ratings are cut off at this many standard deviations, in (0, 1e6].
            timeout: Seconds > 0 that each judge has for a batch, or those of some by name; no limit if left out. What
                is late is missing (of ``sigma_m``: 0). A synchronous judge with a limit runs in a thread of its own.
            name: What TRL and the logs call this reward; like the judges' names printable and without brackets.
            rule: Of running scales: one of ``uard.judges.RULES`` by name, another word for ``mitigation``. A panel has
                its own (``JudgePanel(rule=...)``, ``uard judges fit --rule``).

        Raises:
            InvalidValueError: for fewer than two judges (one never disagrees with itself and would be trusted
                blindly), judges that cannot be called or told apart, bad numbers, and a rule beside a panel.
        """
        if rule is not None:
            if panel is not None or mitigation is not None:
                allowed = (
                    "left out beside a mitigation, and beside a panel, which has its own: JudgePanel(..., rule=...) "
                )
                raise _checks.InvalidValueError("rule", rule, allowed + "or `uard judges fit --rule`")
            mitigation = check_rule(rule)
        self.judges = by_name(judges)
        if sigma_m is not None and not callable(sigma_m):
            raise _checks.InvalidValueError("sigma_m", sigma_m, "a function with the signature of a judge")
        check_name("name", name)
        self.last: Judged | None = None
        self.__name__ = name
        self._asked = self.judges if sigma_m is None else {**self.judges, "sigma_m": sigma_m}
        self._limits = limits_of(timeout, self._asked)
        self._warned = set[str]()
        self._fitted = panel is not None
        if panel is None:
            running = tuple(FittedJudge(name) for name in self.judges)
            shares = _weights(weights, len(self.judges))
            self._panel = JudgePanel(running, proxy=proxy, weights=shares, clip=clip)
        else:
            given = {"weights": weights, "scales": scales, "sigma_m": sigma_m, "mitigation": mitigation}
            given |= {"proxy": proxy if proxy != "mean" else None, "clip": clip if clip != CLIP else None}
            self._panel = _panel(panel, list(self.judges), given)
            scales = [(judge.location, judge.scale) if judge.scale > 0 else None for judge in self._panel.judges]
        stream = RewardStream(uard() if mitigation is None else mitigation)
        self._memory = Memory(Tally.of(self.judges), _scales(scales, len(self.judges)), Scale(), stream)
        self._start()

    def _start(self) -> None:
        """Set up what belongs to this process and is not kept."""
        self._lock, self._pauses = threading.Lock(), 0
        self._busy: dict[str, Callable[[], bool]] = {}
        self._model: Any = None

    def __getstate__(self) -> dict[str, Any]:
        """Return what pickling keeps."""
        return {name: value for name, value in vars(self).items() if name not in _OF_PROCESS}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take it up again."""
        vars(self).update(state)
        self._start()

    @property
    def tally(self) -> Tally:
        """Counts over all batches that it has learned from."""
        return self._memory.tally

    @property
    def deviations(self) -> dict[str, float]:
        """Standard deviation of each judge's scores; 0 for one that has never varied."""
        return {name: scale.deviation for name, scale in zip(self.judges, self._memory.scales, strict=True)}

    @contextmanager
    def paused(self) -> Generator[None]:
        """Learn nothing from completions meanwhile: scales, tally and mean disagreement stay as they are.

        Examples:
            >>> reward = UncertaintyDiscountedReward({"a": lambda **_: [1, 2], "b": lambda **_: [1, 2]})
            >>> with reward.paused():
            ...     looked_at = reward(["why?"] * 2, ["so", "therefore"])
            >>> reward.tally.completions
            0
        """
        with self._lock:
            self._pauses += 1
        try:
            yield
        finally:
            with self._lock:
                self._pauses -= 1

    def follow(self, model: Any) -> None:
        """Learn nothing from completions while a model is not in training mode (``model.training``), as in evaluation.

        ``ReliabilityCallback`` calls this with the trainer's model.
        """
        self._model = model

    def save(self, path: str | Path) -> None:
        """Write all that it has learned from completions to a file, as numbers; the judges are not in it.

        Args:
            path: The file is whole at any time; its folder must be there.
        """
        with self._lock:
            self._memory.save(path)

    def load(self, path: str | Path) -> None:
        """Go on with what ``save`` has written; nothing in the file is executed. Fixed scales stay as they are given.

        Raises:
            InvalidValueError: naming the file, if it is not such a file, is damaged, or is of other judges.
        """
        with self._lock:
            self._memory.load(path)

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
            JudgeError: if all judges raise and none has ever scored anything.
            InvalidValueError: if there is not one prompt per completion, or a judge gives the wrong number of scores,
                or one that is no finite number.

        Warns:
            UnscoredWarning: the first time that no judge scores a completion.
            LateJudgeWarning: the first time that a judge is late.
            FailedJudgeWarning: the first time that a judge raises.
            AbsurdScoreWarning: the first time that a judge gives a score far beyond all its others.
            UselessJudgeWarning: once a judge has scored 16 groups and told the completions of none apart.
        """
        prompts, completions = _listed("prompts", prompts), _listed("completions", completions)
        size = len(completions)
        if len(prompts) != size:
            raise _checks.InvalidValueError("number of prompts", len(prompts), f"{size}, one per completion")
        if size == 0:
            return []
        learning = self._pauses == 0 and getattr(self._model, "training", True)
        question = {"prompts": prompts, "completions": completions, "completion_ids": completion_ids}
        question |= {"log_extra": log_extra, "log_metric": log_metric, **columns}
        answers = ask(self._asked, question, self._limits, self._busy)
        columns_of = [_scores(name, answers[name], size) for name in self.judges]
        scores = self._panel.without_failures(np.stack(columns_of, axis=1))
        ensemble = _ensemble(answers.get("sigma_m"), size)
        groups = groups_of(prompts)
        with self._lock:
            memory = self._memory if learning else copy.deepcopy(self._memory)
            absurd = _observe(memory, scores, ensemble, groups)
            if memory.tally.completions == memory.tally.unscored:  # nobody has ever worked: it is no outage
                raise_if_all_raised([answers[name].error for name in self.judges], completions)
            self.last = judged = self._discount(memory, scores, ensemble)
            change = advantage_change(judged.raw, judged.reward, groups)
            _count(memory.tally, judged, groups, change)
            doubts = [
                *_doubts(memory, judged, absurd, self._panel if self._fitted else None),
                *doubts_of_answers(answers, completions, self._limits),
            ]
            new = {doubt.text: doubt.kind for doubt in doubts if doubt.about not in self._warned}
            if learning:  # else nothing was counted, and whoever is warned of later is warned of then
                self._warned |= {doubt.about for doubt in doubts}
            for name, answer in answers.items():
                late, failed, _ = missed(answer, size)
                memory.tally.late[name] += late > 0
                memory.tally.failed[name] += failed > 0
        if log_extra is not None:
            self._log_completions(judged, log_extra)
        if log_metric is not None:
            self._log_means(judged, groups, change, answers, log_metric)
        for message, kind in new.items():
            warnings.warn(message, kind, stacklevel=2)
        return [None if math.isnan(reward) else reward for reward in judged.reward.tolist()]

    def _discount(self, memory: Memory, scores: Float[np.ndarray, "B K"], ensemble: _Ensemble) -> Judged:
        if self._fitted:
            c, zero = self._panel.combine(scores), np.zeros(len(scores))
            return Judged(scores, c.ratings, c.proxy, c.reward, c.weight, c.tau, zero, zero)
        rated = [scale.ratings(column) for scale, column in zip(memory.scales, scores.T, strict=True)]
        ratings = np.clip(np.stack(rated, axis=1), -self._panel.clip, self._panel.clip)
        ratings[:, [memory.tally.never_tells_apart(name) for name in self.judges]] = np.nan
        # 0, the mean of all completions so far, where no judge tells completions apart.
        raw = np.nan_to_num(self._panel.proxy_of(ratings))
        scored = (~np.isnan(scores)).any(1)
        checked = (~np.isnan(ratings)).sum(1, keepdims=True) >= 2
        sigma_m = _disagreement(ensemble, memory.members, len(scores))
        f = memory.stream(raw[scored], np.where(checked, ratings, np.nan)[scored], sigma_m[scored])

        def whole(values: Float[np.ndarray, " scored"]) -> Float[np.ndarray, " B"]:
            column = np.full(len(scores), np.nan)
            column[scored] = values
            return column

        columns = (f.raw, f.reward, f.weight, f.sigma_h, f.sigma_m, f.lam)
        return Judged._make([scores, ratings, *map(whole, columns)])

    def _log_completions(self, judged: Judged, log_extra: Callable[[str, list[Any]], None]) -> None:
        names = [*self.judges, "raw", "weight", "sigma_h", "sigma_m"]
        columns = [*judged.scores.T, judged.raw, judged.weight, judged.sigma_h, judged.sigma_m]
        for name, values in zip(names, columns, strict=True):
            log_extra(f"{self.__name__}/{name}", [None if x != x else x for x in values.tolist()])  # not NaN
        j = judged
        combined = Combined(j.reward, j.weight, j.sigma_h, j.raw, j.ratings, tuple(self.judges))
        log_extra(f"{self.__name__}/why", whys(combined))

    def _log_means(
        self,
        judged: Judged,
        groups: Integer[np.ndarray, " B"],
        change: Float[np.ndarray, " groups"],
        answers: Mapping[str, Answer],
        log_metric: Callable[[str, float], None],
    ) -> None:
        missing = np.isnan(judged.scores)
        names = [*(f"{name}/mean" for name in self.judges), "raw", "weight", "sigma_h", "sigma_m", "lam"]
        j = judged
        values = dict(zip(names, _means([*j.scores.T, j.raw, j.weight, j.sigma_h, j.sigma_m, j.lam]), strict=True))
        shares = missing.mean(0).tolist()
        values |= {f"{name}/missing": share for name, share in zip(self.judges, shares, strict=True)}
        values |= {f"{name}/seconds": answer.seconds for name, answer in answers.items()}
        values |= {f"{name}/failed": float(answer.error is not None) for name, answer in answers.items()}
        values |= {"unscored": missing.all(1).mean(), "advantage_change": _means([change])[0]}
        values["judges_at_least"] = judges_at_least(judged.ratings, groups)
        for name, value in values.items():
            if not math.isnan(value):
                log_metric(f"{self.__name__}/{name}", float(value))


def _observe(
    memory: Memory, scores: Float[np.ndarray, "B K"], ensemble: _Ensemble, groups: Integer[np.ndarray, " B"]
) -> dict[str, float]:
    """Take a batch into the scales and count who tells completions apart; return one absurd score of each judge."""
    absurd: dict[str, float] = {}
    compared, told = told_apart(scores, groups)
    means = np.array([scale.known.mean for scale in memory.scales])
    limits = np.array([-1.0 if scale.fixed is None else ABSURD * scale.fixed for scale in memory.scales])
    with np.errstate(over="ignore"):  # what is too large is far away
        news = np.any(np.greater(abs(scores - means), limits), axis=0)  # nothing else tells a fixed scale anything
    for k, (name, scale) in enumerate(zip(memory.tally.missing, memory.scales, strict=True)):
        memory.tally.compared[name] += int(compared[k])
        memory.tally.told_apart[name] += int(told[k])
        if not news[k]:
            continue
        found = scale.observe(scores[~np.isnan(scores[:, k]), k])
        memory.tally.absurd[name] += found.size
        if found.size:
            absurd[name] = float(found[0])
    if ensemble is not None and ensemble.ndim == 2:
        memory.members.observe(ensemble)
    return absurd


def _count(
    tally: Tally, judged: Judged, groups: Integer[np.ndarray, " B"], change: Float[np.ndarray, " groups"]
) -> None:
    missing = np.isnan(judged.scores)
    unscored = missing.all(1)
    for name, number in zip(tally.missing, missing.sum(0).tolist(), strict=True):
        tally.missing[name] += number
    tally.completions += unscored.size
    tally.unscored += int(unscored.sum())
    tally.unchecked += int(((~np.isnan(judged.ratings)).sum(1) < 2)[~unscored].sum())
    tally.weight += float(np.nansum(judged.weight))
    tally.widest = float(np.max(judged.sigma_h, initial=tally.widest, where=~unscored))
    discounted = ~np.isnan(change) & (group_means(judged.weight, groups) < DISCOUNTED)
    if not discounted.any():
        return
    undivided = advantage_change(judged.raw, judged.reward, groups, divided=False)
    tally.discounted += int(discounted.sum())
    tally.shifted += int((discounted & (undivided < CANCELLED)).sum())
    tally.cancelled += int((discounted & (change < CANCELLED)).sum())


def _doubts(memory: Memory, judged: Judged, absurd: Mapping[str, float], fitted: JudgePanel | None) -> Iterator[Doubt]:
    """Say what is wrong with the judges."""
    unscored = np.isnan(judged.scores).all(1)
    if unscored.any():
        yield Doubt(
            "unscored",
            UnscoredWarning,
            f"no judge scored completion {int(np.argmax(unscored))} ({unscored.sum()} of {unscored.size} in this "
            "batch): they get no reward and teach nothing. Counted in tally.unscored from now on",
        )
    for name, score in absurd.items():
        yield Doubt(
            f"absurd {name}",
            AbsurdScoreWarning,
            f"judge {name!r} gave the score {score:g}, more than {ABSURD:g} of its standard deviations from its mean: "
            "a mistake? Its rating is cut off, and it hardly moves a running scale. Counted in tally.absurd from now "
            "on",
        )
    for name, scale in zip(memory.tally.missing, memory.scales, strict=True):
        groups = memory.tally.compared[name]
        if groups >= ENOUGH_GROUPS and memory.tally.never_tells_apart(name) and scale.deviation > 0:
            yield Doubt(
                f"apart {name}",
                UselessJudgeWarning,
                f"judge {name!r} has scored {groups} groups and told the completions of none apart: does it score the "
                f"prompt? {_what_becomes_of(name, fitted)}",
            )


def _what_becomes_of(judge: str, fitted: JudgePanel | None) -> str:
    """Say whether a judge that tells no completions apart counts."""
    if fitted is None:
        return "No advantage depends on it, and it is left out until it does"
    known = fitted.judges[fitted.names.index(judge)]
    if not known.counts:
        return "No advantage depends on it: the panel, which does not change, leaves it out"
    log = "has it tell completions apart" if known.tells_apart else "had no prompts, or too few, to see this in"
    return (
        f"The panel does not change and counts it, for the log that it was fitted to {log}: what it thinks of the "
        "prompt is taken for disagreement. Fit the panel again to a log with prompts, or without this judge"
    )


def _scores(name: str, answer: Answer, size: int) -> Float[np.ndarray, " B"]:
    return np.full(size, np.nan) if answer.missed else as_scores(name, answer.given, size)


def _ensemble(answer: Answer | None, size: int) -> _Ensemble:
    """Return what the ensemble answered; None if there is none, or it is late or has failed."""
    if answer is None or answer.missed:
        return None
    values = _checks.as_numpy("sigma_m", answer.given)
    if values.shape == (size,):
        _checks.nonnegative("sigma_m", values)
        return values
    if values.ndim != 2 or len(values) != size or values.shape[1] < 2:
        allowed = f"({size},) or ({size}, N) with N >= 2 members"
        raise _checks.InvalidValueError("shape of the answer of sigma_m", values.shape, allowed)
    _checks.finite("sigma_m", values)
    return values


def _disagreement(ensemble: _Ensemble, members: Scale, size: int) -> Float[np.ndarray, " B"]:
    """Return sigma_m in standard deviations of a judge."""
    if ensemble is None or (ensemble.ndim == 2 and members.deviation == 0):
        return np.zeros(size)
    if ensemble.ndim == 1:
        return np.clip(ensemble, 0.0, WIDEST_SIGMA)
    return np.std(np.clip(members.ratings(ensemble), -WIDEST_SIGMA, WIDEST_SIGMA), axis=1, ddof=1)


def _means(columns: Sequence[Float[np.ndarray, " n"]]) -> list[float]:
    """Return the mean of what is known of each column, NaN where nothing is; large numbers do not overflow."""
    table = np.stack(columns)
    known = ~np.isnan(table)
    number = known.sum(1)
    parts = np.where(known, table, 0.0) / np.maximum(number, 1)[:, None]
    return np.where(number > 0, parts.sum(1), np.nan).tolist()


def _listed(field: str, values: Any) -> list[Any]:
    if not is_listed(values):
        raise _checks.InvalidValueError(field, values, "a list with one entry per completion")
    return list(values)


def _panel(panel: JudgePanel | str | Path, judges: list[str], given: Mapping[str, Any]) -> JudgePanel:
    for name, value in given.items():
        if value is not None:
            raise _checks.InvalidValueError(name, value, "left out where a panel is given, which holds it")
    return for_judges(panel, judges)


def _of_each(field: str, values: Any, number: int) -> list[Any]:
    """Return a list with an entry for each judge."""
    allowed = f"{number}, one per judge"
    if not is_listed(values):
        raise _checks.InvalidValueError(field, values, f"a list of {allowed}")
    if len(values) != number:
        raise _checks.InvalidValueError(f"len({field})", len(values), allowed)
    return list(values)


def _weights(weights: Sequence[float] | None, number: int) -> tuple[float, ...]:
    return () if weights is None else tuple(_of_each("weights", weights, number))


def _scales(scales: Sequence[tuple[float, float] | None] | None, number: int) -> list[Scale]:
    if scales is None:
        return [Scale() for _ in range(number)]
    return [_scale(f"scales[{judge}]", pair) for judge, pair in enumerate(_of_each("scales", scales, number))]


def _scale(field: str, pair: Any) -> Scale:
    if pair is None:
        return Scale()
    try:
        location, deviation = pair
    except (TypeError, ValueError):
        raise _checks.InvalidValueError(field, pair, "(location, deviation), or None for the running one") from None
    _checks.number(f"{field}[0]", location)
    _checks.number(f"{field}[1]", deviation, low=0, open_low=True)
    return Scale(Moments(mean=float(location)), fixed=float(deviation))
