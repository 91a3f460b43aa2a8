"""The owner's numbers: progress, speed, agreement, and what each rater is like. Pure functions of answers and items."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from statistics import median

import numpy as np

from uard.collect.items import Item
from uard.collect.project import Question
from uard.ratings.agreement import alpha_interval, krippendorff_alpha
from uard.ratings.jackknife import Estimate
from uard.ratings.log import RatingLog
from uard.ratings.raters import EffectiveRaters, PanelSummary, RaterSummary, summary
from uard.ratings.table import Answer, Answers

QUICK = 1.0  # seconds, below which an answer can hardly be meant
ALIKE = 0.1  # of the scale: two answers to a hidden repeat that differ by no more agree
MOST_DISPUTED = 12


@dataclass(frozen=True)
class Share:
    """A part of a number.

    Examples:
        >>> str(Share(3, 4)), str(Share(0, 0))
        ('3 of 4', '')
    """

    part: int
    whole: int

    def __str__(self) -> str:
        """Return it in words; nothing of nothing."""
        return f"{self.part} of {self.whole}" if self.whole else ""


@dataclass(frozen=True)
class RaterRow:
    """What the owner sees of a rater.

    Attributes:
        name: As she was invited.
        answers: That stand, without practice.
        skipped: Of them, those that say nothing of the item.
        coverage: Share of the items asked about in earnest that she has answered.
        seconds: Median time of an answer; None without answers.
        quick: Share of answers that took less than ``QUICK``.
        left: Share of the screen's left side among her preferences; None where there are no pairs.
        repeats: Answers to hidden repeats that agree with the first.
        gold: Answers to items of which the answer is known that are right.
        told: What ``uard.ratings.raters`` says of her; None where ratings are no numbers, or there are none.
        last: When she answered last, in seconds since 1970.
    """

    name: str
    answers: int
    skipped: int
    coverage: float
    seconds: float | None
    quick: float | None
    left: float | None
    repeats: Share
    gold: Share
    told: RaterSummary | None
    last: float | None


@dataclass(frozen=True)
class StratumRow:
    """How much raters agree about a part of the items.

    Attributes:
        name: Of the part.
        items: That were rated.
        answers: The ratings of them.
        alpha: Krippendorff's alpha with its interval; None where no item has two ratings that could differ.
    """

    name: str
    items: int
    answers: int
    alpha: Estimate | None


@dataclass(frozen=True)
class Disputed:
    """An item about which raters differ.

    Attributes:
        item: Which.
        spread: Standard deviation between raters, in the question's unit.
        said: The latest answer of each.
    """

    item: Item
    spread: float
    said: tuple[Answer, ...]


@dataclass(frozen=True)
class Overview:
    """All numbers of the owner's page.

    Attributes:
        items: That are asked about in earnest: no practice, gold or examples, and nothing that is set aside.
        rated: Of these items, those with at least one answer; that somebody would not say is one, too.
        complete: Of these items, those with as many raters as there should be.
        answers: Of these items, how many raters have answered each, counted no further than there should be.
        wanted: How many that should become: ``answers`` is as many when all items are complete.
        seconds: Median time of an answer.
        raters: One by one.
        strata: All items together first, then part by part.
        effective: How many independent raters those of an item are worth; None where that cannot be told.
        against: What biases are measured against.
        disputed: Those about which raters differ most.
    """

    items: int
    rated: int
    complete: int
    answers: int
    wanted: int
    seconds: float | None
    raters: tuple[RaterRow, ...]
    strata: tuple[StratumRow, ...]
    effective: EffectiveRaters | None
    against: str
    disputed: tuple[Disputed, ...]


def worth(answer: Answer, item: Item | None) -> float | None:
    """Return what an answer says as a number: 1 and 0 for thumbs up and down, and for a pair's first and second item.

    Examples:
        >>> worth(Answer("a1", "x", "ann", choice="up"), None), worth(Answer("a2", "x", "ann", choice="skip"), None)
        (1.0, None)

    Args:
        answer: What was said.
        item: Of what.
    """
    if answer.choice in ("up", "down"):
        return float(answer.choice == "up")
    if answer.value is not None:
        return answer.value
    if answer.choice == "tie":
        return 0.5
    if answer.choice in ("left", "right") and item is not None and item.kind == "pair":
        preferred = answer.left if answer.choice == "left" else answer.right
        return float(preferred == item.content["left"])
    return None


def overview(
    answers: Answers,
    items: Mapping[str, Item],
    question: Question,
    raters: Sequence[str] = (),
    answered: str = "",
    without: Collection[str] = (),
) -> Overview:
    """Return what the owner sees.

    Examples:
        >>> from uard.collect import text_item
        >>> item = text_item("2 + 2?", "4")
        >>> seen = overview(Answers((Answer("a1", item.id, "ann", 1.0),)), {item.id: item}, Question(overlap=1))
        >>> seen.complete, seen.answers, seen.raters[0].name
        (1, 1, 'ann')

    Args:
        answers: All of them.
        items: By their names.
        question: What raters are asked.
        raters: Who was invited; those who have answered are added.
        answered: Which of the attributes the numbers are about.
        without: Items that nobody is asked about any more.
    """
    known = {k.item for k in (*question.practice, *question.gold, *question.examples)}.union(without)
    paired = question.kind == "pairs"
    asked = {name for name, item in items.items() if (item.kind == "pair") == paired and name not in known}
    standing = [a for a in answers.standing() if a.kind != "practice" and a.attribute == answered]
    log = _log(standing, items)
    panel = summary(log) if log is not None and question.kind != "pairs" else None
    raters_of: defaultdict[str, set[str]] = defaultdict(set)
    for a in standing:
        if a.item in asked:
            raters_of[a.item].add(a.rater)
    names = dict.fromkeys((*raters, *(a.rater for a in standing)))
    return Overview(
        items=len(asked),
        rated=len(raters_of),
        complete=sum(len(who) >= question.overlap for who in raters_of.values()),
        answers=sum(min(len(who), question.overlap) for who in raters_of.values()),
        wanted=len(asked) * question.overlap,
        seconds=_median(standing),
        raters=tuple(_rater(name, standing, items, question, asked, panel) for name in names),
        strata=_strata(log, items),
        effective=None if panel is None else panel.effective,
        against="" if panel is None else panel.against,
        disputed=_disputed(standing, items),
    )


def _log(standing: Sequence[Answer], items: Mapping[str, Item]) -> RatingLog | None:
    """Return ratings as numbers; None if there are none."""
    numbers = [(a, worth(a, items.get(a.item))) for a in standing]
    rows = tuple(
        replace(a, value=value, choice=None, supersedes=None, kind="rating")
        for a, value in numbers
        if value is not None
    )
    rows = tuple(replace(row, attribute="") for row in rows)
    return Answers(rows).to_log(_reward_of(items), source="answers") if rows else None


def _reward_of(items: Mapping[str, Item]) -> Callable[[str], float | None]:
    return lambda name: items[name].reward if name in items else None


def _rater(
    name: str,
    standing: Sequence[Answer],
    items: Mapping[str, Item],
    question: Question,
    asked: Set[str],
    panel: PanelSummary | None,
) -> RaterRow:
    own = [a for a in standing if a.rater == name]
    sides = [a.choice for a in own if a.choice in ("left", "right")]
    told = {} if panel is None else {r.name: r for r in panel.raters}
    quick = [_seconds(a) < QUICK for a in own]
    return RaterRow(
        name,
        answers=len(own),
        skipped=sum(a.choice in ("skip", "cannot tell") for a in own),
        coverage=len({a.item for a in own} & asked) / len(asked) if asked else 0.0,
        seconds=_median(own),
        quick=sum(quick) / len(quick) if quick else None,
        left=sides.count("left") / len(sides) if sides else None,
        repeats=_repeats(own, items, question),
        gold=_gold(own, items, question),
        told=told.get(name),
        last=max((a.given_at for a in own), default=None),
    )


def _seconds(answer: Answer) -> float:
    return answer.given_at - answer.shown_at


def _median(answers: Sequence[Answer]) -> float | None:
    return median(map(_seconds, answers)) if answers else None


def _repeats(own: Sequence[Answer], items: Mapping[str, Item], question: Question) -> Share:
    """Return how many answers to hidden repeats agree with what the rater said before."""
    near = ALIKE * (question.high - question.low if question.kind in ("slider", "stars") else 1.0)
    before: dict[str, float] = {}
    part = whole = 0
    for a in own:
        value = worth(a, items.get(a.item))
        if value is None:
            continue
        if a.kind == "repeat" and a.item in before:
            whole += 1
            part += abs(value - before[a.item]) <= near * (1 + 1e-9)
        before[a.item] = value
    return Share(part, whole)


def _gold(own: Sequence[Answer], items: Mapping[str, Item], question: Question) -> Share:
    part = whole = 0
    for a in own:
        known, value = question.known(a.item, "gold"), worth(a, items.get(a.item))
        if known is not None and value is not None:
            whole += 1
            part += abs(value - known.value) <= known.tolerance + 1e-9
    return Share(part, whole)


def _strata(log: RatingLog | None, items: Mapping[str, Item]) -> tuple[StratumRow, ...]:
    if log is None or log.item is None:
        return ()
    names = np.array([items[name].stratum if name in items else "" for name in log.item.tolist()], dtype=object)
    parts: list[str] = sorted({str(name) for name in names.tolist()})
    rows = [_stratum("all", log.ratings)]
    return tuple(rows + [_stratum(p or "(no name)", log.ratings[names == p]) for p in parts] * (len(parts) > 1))


def _stratum(name: str, ratings: np.ndarray) -> StratumRow:
    alpha, interval = krippendorff_alpha(ratings), alpha_interval(ratings)
    told = None if alpha is None else Estimate(alpha, *(interval or (None, None)))
    return StratumRow(name, len(ratings), int(np.isfinite(ratings).sum()), told)


def _disputed(standing: Sequence[Answer], items: Mapping[str, Item]) -> tuple[Disputed, ...]:
    """Return the items whose raters differ most, in the order of how much."""
    said: defaultdict[str, dict[str, tuple[Answer, float]]] = defaultdict(dict)
    for a in standing:
        value = worth(a, items.get(a.item))
        if value is not None:
            said[a.item][a.rater] = a, value
    found: list[Disputed] = []
    for name, by_rater in said.items():
        if len(by_rater) > 1 and name in items:
            spread = float(np.std([value for _, value in by_rater.values()], ddof=1))
            if spread > 0:
                found.append(Disputed(items[name], spread, tuple(a for a, _ in by_rater.values())))
    found.sort(key=lambda d: -d.spread)
    return tuple(found[:MOST_DISPUTED])
