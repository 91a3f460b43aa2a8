"""Several judges as one reward: asked together, combined by a panel. What adapters to trainers are made of."""

from __future__ import annotations

import asyncio
import contextvars
import math
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from uard import _checks
from uard.judges.asking import Answer, JudgeError, RewardFunction, as_scores, ask, by_name, is_listed, limits_of
from uard.judges.doubts import Doubt, UnscoredWarning, doubts_of_answers, missed, raise_if_all_raised
from uard.judges.panel import Combined, JudgePanel

if TYPE_CHECKING:
    from jaxtyping import Float

LOGGED = "uard/"  # before all names in logs: a judge called ``score`` or ``reward`` must not take a trainer's own place
_OF_PROCESS = ("_lock", "_busy")  # what is not pickled


class Judged(NamedTuple):
    """What became of B completions.

    Attributes:
        combined: Rewards, and why.
        scores: As the K judges gave them, NaN where one is missing.
        answers: What became of asking each judge.
    """

    combined: Combined
    scores: Float[np.ndarray, "B K"]
    answers: dict[str, Answer]

    def rewards(self) -> list[float | None]:
        """Return what to learn from, None where nobody scored a completion."""
        return [None if math.isnan(x) else x for x in self.combined.reward.tolist()]

    def every_reward(self, kind: str, texts: Sequence[Any]) -> list[float]:
        """Return what to learn from, for a trainer that has no missing reward: 0 would be one.

        Args:
            kind: Of what was scored, such as ``solution``, for the message.
            texts: What was scored.

        Raises:
            JudgeError: nobody scored one; if judges raised, what the first of them did is the cause.
        """
        rewards = [x for x in self.rewards() if x is not None]
        if len(rewards) < len(self.scores):
            row = int(np.argmax(np.isnan(self.combined.reward)))
            cause = next((answer.error for answer in self.answers.values() if answer.error is not None), None)
            raise JudgeError(f"no judge scored {kind} {row}: {_checks.short(texts[row])}") from cause
        return rewards

    def log_of(self, row: int) -> dict[str, float]:
        """Return numbers about a completion for a log, always under the same names, which are those of TRL's logs.

        These are ``uard/raw`` (the proxy), ``uard/weight``, ``uard/sigma_h`` (tau) and each judge's score as
        ``uard/<judge>``; NaN where there is none.

        Examples:
            >>> reward = PanelReward({"a": lambda **_: [1.0], "b": lambda **_: [None]}, JudgePanel.plain(["a", "b"]))
            >>> reward(["why?"], ["so"]).log_of(0)
            {'uard/raw': 1.0, 'uard/weight': 0.05, 'uard/sigma_h': 0.0, 'uard/a': 1.0, 'uard/b': nan}
        """
        c = self.combined
        numbers = {"raw": float(c.proxy[row]), "weight": float(c.weight[row]), "sigma_h": float(c.tau[row])}
        numbers |= dict(zip(c.judges, self.scores[row].tolist(), strict=True))
        return {LOGGED + name: x for name, x in numbers.items()}


class Counts(NamedTuple):
    """Counts over all completions so far, in the words of the tally of TRL's reward; those of each judge by its name.

    Attributes:
        missing: How many each judge did not score.
        late: Batches for which each judge was late, for a part of them perhaps.
        failed: Batches about which it raised, alike.
        completions: All of them.
        unscored: How many no judge scored.
    """

    missing: dict[str, int]
    late: dict[str, int]
    failed: dict[str, int]
    completions: int = 0
    unscored: int = 0

    @classmethod
    def of(cls, judges: Sequence[str]) -> Counts:
        """Return the counts of judges before the first batch."""
        missing, late, failed = (dict.fromkeys(judges, 0) for _ in range(3))
        return cls(missing, late, failed)

    def and_of(self, judged: Judged) -> Counts:
        """Return the counts with those of another batch."""
        gone, names = np.isnan(judged.scores), list(self.missing)
        how = {name: missed(judged.answers[name], len(gone)) for name in names}
        missing = {name: self.missing[name] + n for name, n in zip(names, gone.sum(0).tolist(), strict=True)}
        late = {name: self.late[name] + (how[name].late > 0) for name in names}
        failed = {name: self.failed[name] + (how[name].failed > 0) for name in names}
        return Counts(missing, late, failed, self.completions + len(gone), self.unscored + int(gone.all(1).sum()))


class PanelReward:
    """Asks judges, and makes one reward of their scores by a panel that was fitted to them.

    Many threads may call it at once, and each completion has the same reward in any batch and process. It can be
    pickled if its judges can.

    Judges get prompts and completions as they come. Where these are conversations, as TRL has them, a completion is a
    list of messages, and its text is ``completion[-1]["content"]``.

    Examples:
        >>> def length(completions, **question):
        ...     return [len(text) for text in completions]
        >>> def clarity(completions, **question):
        ...     return [-text.count("um") for text in completions]
        >>> reward = PanelReward([length, clarity], JudgePanel.plain(["length", "clarity"]))
        >>> [round(x, 2) for x in reward(["why?"] * 2, ["a", "um, um"]).rewards()]
        [-0.25, -3.75]
        >>> reward.counts
        Counts(missing={'length': 0, 'clarity': 0}, late={...}, failed={...}, completions=2, unscored=0)

    Attributes:
        judges: By name.
        panel: Of these judges, in their order.
        limits: Seconds that judges have for a batch, by name.
        counts: What is missing so far, and why.
    """

    def __init__(
        self,
        judges: Mapping[str, RewardFunction] | Sequence[RewardFunction],
        panel: JudgePanel | str | Path,
        *,
        timeout: float | Mapping[str, float] | None = None,
    ):
        """Take judges and their panel.

        Args:
            judges: K >= 2 reward functions, see ``uard.judges.ask``; ``Judge`` where one is to be asked with care.
            panel: What ``uard judges fit`` wrote, or its file.
            timeout: Seconds > 0 that each judge has for a batch, or those of some by name.

        Raises:
            InvalidValueError: judges that cannot be called or told apart, or that are not the panel's.
        """
        self.judges = by_name(judges)
        self.panel = for_judges(panel, list(self.judges))
        self.limits = limits_of(timeout, self.judges)
        self.counts = Counts.of(list(self.judges))
        self._warned = frozenset[str]()
        self._start()

    def _start(self) -> None:
        """Set up what belongs to this process and is not kept."""
        self._busy: dict[str, Callable[[], bool]] = {}
        self._lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        """Return what pickling keeps."""
        return {name: value for name, value in vars(self).items() if name not in _OF_PROCESS}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take it up again."""
        vars(self).update(state)
        self._start()

    def __call__(self, prompts: Sequence[Any], completions: Sequence[Any], **columns: Any) -> Judged:
        """Ask about some completions.

        Args:
            prompts: B prompts.
            completions: B completions, texts or lists of messages.
            columns: What else judges are told.

        Raises:
            InvalidValueError: there is not one prompt per completion, or a judge gave something else than B numbers.
            JudgeError: all judges raise, and none has ever scored anything.

        Warns:
            LateJudgeWarning, FailedJudgeWarning, UnscoredWarning: once for each judge.
        """
        for field, column in (("prompts", prompts), ("completions", completions)):
            if not is_listed(column):
                raise _checks.InvalidValueError(field, column, "a list, one per completion")
        prompts, completions = list(prompts), list(completions)
        size = len(completions)
        if len(prompts) != size:
            raise _checks.InvalidValueError("number of prompts", len(prompts), f"{size}, one per completion")
        if not size:
            none = np.zeros((0, len(self.judges)))
            return Judged(self.panel.of_ratings(none), none, {name: Answer([], 0.0) for name in self.judges})
        answers = ask(self.judges, {"prompts": prompts, "completions": completions, **columns}, self.limits, self._busy)
        scores = np.full((size, len(self.judges)), np.nan)
        for k, (name, answer) in enumerate(answers.items()):
            if not answer.missed:
                scores[:, k] = as_scores(name, answer.given, size)
        scores = self.panel.without_failures(scores)
        judged = Judged(self.panel.combine(scores), scores, answers)
        with self._lock:
            self.counts = self.counts.and_of(judged)
        if self.counts.unscored == self.counts.completions:
            raise_if_all_raised([answer.error for answer in answers.values()], completions)
        self._warn(judged, completions)
        return judged

    async def later(self, prompts: Sequence[Any], completions: Sequence[Any], **columns: Any) -> Judged:
        """Do the same in a thread of its own, for those who wait in an event loop.

        A call that hangs keeps neither other calls waiting nor the process from ending. All calls are under way at
        once: ``Judge(..., concurrent=8)`` where a judge does not bear that.
        """
        return await asyncio.wrap_future(_in_thread(lambda: self(prompts, completions, **columns)))

    def _warn(self, judged: Judged, completions: Sequence[Any]) -> None:
        found = [*doubts_of_answers(judged.answers, completions, self.limits)]
        unscored = int(np.isnan(judged.scores).all(1).sum())
        if unscored:
            text = (
                f"no judge scored {unscored} of {len(completions)} completions: they have no reward and teach nothing"
            )
            found.append(Doubt("unscored", UnscoredWarning, text))
        with self._lock:
            new = [doubt for doubt in found if doubt.about not in self._warned]
            self._warned |= {doubt.about for doubt in new}
        for doubt in new:
            warnings.warn(doubt.text, doubt.kind, stacklevel=3)


def _in_thread(work: Callable[[], Judged]) -> Future[Judged]:
    """Begin some work; not in a pool, whose places a few judges that hang would fill for ever."""
    future: Future[Judged] = Future()
    context = contextvars.copy_context()

    def run() -> None:
        if future.set_running_or_notify_cancel():
            try:
                future.set_result(context.run(work))
            except BaseException as error:
                future.set_exception(error)

    threading.Thread(target=run, name="uard-reward", daemon=True).start()
    return future


def for_judges(panel: JudgePanel | str | Path, judges: Sequence[str]) -> JudgePanel:
    """Return a panel, or that of a file, with its judges in this order.

    Raises:
        InvalidValueError: it cannot be read, or its judges are others.
    """
    given: Any = panel
    if not isinstance(given, JudgePanel | str | Path):
        raise _checks.InvalidValueError("panel", panel, "a JudgePanel, or the file of one (`uard judges fit -o FILE`)")
    found = given if isinstance(given, JudgePanel) else JudgePanel.load(given)
    found.check_judges(judges)
    order = [found.names.index(name) for name in judges]
    return replace(found, judges=tuple(found.judges[k] for k in order), weights=tuple(found.weights[k] for k in order))
