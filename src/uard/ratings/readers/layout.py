"""What the columns of a source are, by their names: one per rater (wide), or one answer per row (long)."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import NamedTuple

from uard import _checks
from uard.ratings.log import LABELS, NUMBERS
from uard.ratings.readers.columns import Choice, Wanted
from uard.ratings.readers.sides import sides_among
from uard.ratings.readers.spelling import TIMES, among, normal

RATERS = frozenset((
    "annotator", "annotatorid", "annotatorname", "annotationagent", "worker", "workerid", "rater", "raterid",
    "user", "userid", "username", "completedby", "labeler", "labelerid", "labeller", "labellerid", "judge",
    "judgeid", "performer", "performerid", "reviewer", "reviewerid", "coder", "coderid", "assessor",
    "assessorid", "evaluator", "evaluatorid", "participant", "participantid",
))  # fmt: skip
"""Columns that say who rated, as ``spelling.normal`` gives their names."""
ITEMS = frozenset((
    "item", "itemid", "task", "taskid", "instance", "instanceid", "example", "exampleid", "sample", "sampleid",
    "question", "questionid", "unit", "unitid", "doc", "docid", "document", "documentid", "externalid",
))  # fmt: skip
"""Columns that say what was rated."""
VALUES = frozenset((
    "score", "label", "value", "response", "answer", "annotation", "stars", "grade", "vote", "judgment",
    "judgement", "verdict",
))  # fmt: skip
"""Columns that hold ratings, besides those that begin with ``rating``."""
SCHEMA = ":::"  # potato: schema:::label


class Layout(NamedTuple):
    """Which columns of a source are what.

    Attributes:
        reward: The rewards; None if there are none.
        ratings: Wide form: the raters' columns. Long form: the column of ratings; potato's may be several, of which a
            row fills one.
        rater: Who rated; None in the wide form.
        item: What was rated, or None.
        time: When, or None.
        others: Further columns of numbers that are there.
        names: Further columns of names that are there.
        by: What divides the rows into parts, or None.
    """

    reward: str | None
    ratings: tuple[str, ...]
    rater: str | None
    item: str | None
    time: str | None
    others: tuple[str, ...]
    names: tuple[str, ...]
    by: str | None = None

    @property
    def parted(self) -> bool:
        """Whether the ratings are potato's, whose columns must be read as text."""
        return self.rater is not None and SCHEMA in self.ratings[0]

    @property
    def numbers(self) -> tuple[str, ...]:
        """The columns that hold numbers."""
        return (*((self.reward,) if self.reward else ()), *(() if self.parted else self.ratings), *self.others)

    @property
    def texts(self) -> tuple[str, ...]:
        """The columns that hold names or times."""
        said = (self.rater, self.item, self.time, *self.names, self.by, *(self.ratings if self.parted else ()))
        return tuple(n for n in dict.fromkeys(said) if n is not None)


@dataclass(frozen=True)
class LogChoice(Choice):
    """The columns of a log of ratings.

    Attributes:
        wanted: What the user says about them.
    """

    wanted: Wanted

    @property
    def named(self) -> frozenset[str]:
        """See ``Choice``."""
        said = (self.wanted.reward, self.wanted.item, self.wanted.by, *NUMBERS, *(n for n in LABELS if n != "item"))
        return frozenset(n for n in said if n is not None)

    def candidate(self, name: str) -> bool:
        """See ``Choice``."""
        plain, wanted = normal(name), self.wanted
        known = plain in RATERS or plain in ITEMS or plain in VALUES or plain in TIMES or plain == "id"
        said = name in self.named or name in LABELS or name in (wanted.rater, wanted.rating, *(wanted.ratings or ()))
        return known or said or name.startswith("rating") or SCHEMA in name

    def columns(self, names: Sequence[str]) -> tuple[Sequence[str], Sequence[str]]:
        """See ``Choice``."""
        found = layout_of(names, self.wanted)
        return found.numbers, found.texts

    def may_be_list(self, name: str) -> bool:
        """See ``Choice``."""
        return name != self.wanted.reward and (name.startswith("rating") or name in (self.wanted.ratings or ()))

    def everywhere(self, names: Sequence[str]) -> Sequence[str]:
        """See ``Choice``."""
        found = layout_of(names, self.wanted)
        return () if found.rater or found.reward is None else (found.reward,)


def layout_of(names: Sequence[str], wanted: Wanted) -> Layout:
    """Return which columns of a source are what.

    Examples:
        >>> layout_of(["Task", "worker", "label"], Wanted("answers.csv")).rater
        'worker'

    Args:
        names: Of all columns; ``x[0]`` is a part of ``x``.
        wanted: What the user says about them.

    Raises:
        InvalidValueError: a column is missing, is there twice, or it cannot be told which one is meant. The message
            lists the columns, and names the options that decide.
    """
    raters = [] if wanted.ratings is not None else among(names, RATERS, but=(wanted.reward,))
    listed = wanted.rating is None and any(n.startswith("rating") and "[" in n for n in names)
    if wanted.ratings is None and wanted.rater is None and wanted.rating is None:
        _no_preferences(names, wanted)
    long = wanted.rater is not None or wanted.rating is not None or (raters and not listed)
    found = (_long(names, raters, wanted) if long else _wide(names, wanted))._replace(by=wanted.by)
    needed = {n for n in (*found.numbers, *found.texts)}
    for name, count in Counter(names).items():
        if count > 1 and name in needed:
            raise _checks.InvalidValueError(f"{wanted.source}: column", name, "there only once")
    return found


def _no_preferences(names: Sequence[str], wanted: Wanted) -> None:
    if sides_among(names) is not None and not any(n.startswith("rating") for n in names):
        allowed = (
            f"ratings, a number per answer; these are answers about pairs, which `uard preferences {wanted.source}` "
        )
        allowed += "and uard.ratings.preferences.read read"
        raise _checks.InvalidValueError(f"{wanted.source}: columns", ", ".join(names), allowed)


def _wide(names: Sequence[str], wanted: Wanted) -> Layout:
    others = [n for n in names if n != wanted.reward]
    whole = {n.partition("[")[0] for n in names} | set(names)
    reward = _reward(wanted, whole)
    for needed in (reward, *(wanted.ratings or ()), wanted.item, wanted.by):
        if needed is not None and needed not in whole:
            raise _checks.UnknownNameError(f"{wanted.source}: column", needed, set(names))
    if wanted.ratings is None:
        ratings = [n for n in others if n.startswith("rating")]
    else:
        ratings = [n for r in wanted.ratings for n in others if n == r or n.startswith(f"{r}[")]
    if not ratings:
        allowed = f"there; name them with ratings (--ratings). Columns: {', '.join(names)}"
        raise _checks.InvalidValueError(f"{wanted.source}: columns that start with", "rating", allowed)
    item = wanted.item or ("item" if "item" in names else None)
    return Layout(reward, tuple(ratings), None, item, None, *_others(names, (item, *ratings)))


def _reward(wanted: Wanted, names: set[str]) -> str | None:
    """Return the column of rewards; None where nobody has named one and none has the usual name, or one like it."""
    absent = wanted.reward == "reward" and not get_close_matches("reward", [n.casefold() for n in names], cutoff=0.8)
    return None if absent else wanted.reward


def _long(names: Sequence[str], raters: Sequence[str], wanted: Wanted) -> Layout:
    whole = set(names)
    reward = _reward(wanted, whole)
    for needed in (wanted.rater, wanted.item, wanted.by, reward):
        if needed is not None and needed not in whole:
            raise _checks.UnknownNameError(f"{wanted.source}: column", needed, whole)
    wide = "ratings (--ratings) names the columns if each rater has one"
    rater = wanted.rater or _one(raters, names, "says who rated", f"name it with rater (--rater); {wide}", wanted)
    items = among(names, ITEMS, but=(rater, wanted.rating, reward)) or among(names, ("id",), but=(rater, reward))
    item = wanted.item or _one(items, names, "says what was rated", f"name it with item (--item); {wide}", wanted)
    if item == rater:
        raise _checks.InvalidValueError("item", item, "a column that is not already the rater")
    questions = ratings_among(names, but=(rater, item, reward))
    if wanted.rating is not None and wanted.rating not in questions:
        if wanted.rating not in whole:
            raise _checks.UnknownNameError(f"{wanted.source}: column", wanted.rating, whole | set(questions))
        if wanted.rating in (rater, item, reward):
            role = ("rater", "item", "reward")[(rater, item, reward).index(wanted.rating)]
            raise _checks.InvalidValueError("rating", wanted.rating, f"a column that is not already the {role}")
        questions[wanted.rating] = [wanted.rating]
    rating = wanted.rating or _one(
        list(questions), names, "holds ratings", f"name it with rating (--rating); {wide}", wanted
    )
    time = next((n for t in TIMES for n in among(names, (t,), but=(rater, item, rating, reward))), None)
    return Layout(reward, tuple(questions[rating]), rater, item, time, *_others(names, (rater, item, rating)))


def ratings_among(names: Iterable[str], but: Sequence[str | None]) -> dict[str, list[str]]:
    """Return the columns that may hold ratings: name -> its columns, several if it is one of potato's questions.

    Where one name alone begins with ``rating`` it is that column, whatever else could be.
    """
    found: dict[str, list[str]] = {}
    for name in names:
        schema, parted, _ = name.partition(SCHEMA)
        if parted and schema != "span_annotation":
            found.setdefault(schema, []).append(name)
        elif name not in but and not parted and (normal(name) in VALUES or _is_rating(name)):
            found[name] = [name]
    called_so = [name for name in found if _is_rating(name)]
    return {called_so[0]: found[called_so[0]]} if len(called_so) == 1 else found


def _is_rating(name: str) -> bool:
    """Whether a column is called after a rating itself, not after its number or time."""
    return normal(name).startswith("rating") and not _ABOUT.search(name.casefold())


_ABOUT = re.compile(r"[\W_](id|at|on|time|date|timestamp|seconds|duration|count|number|comment|reason)$")


def _others(names: Sequence[str], taken: Sequence[str | None]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    free = set(names).difference(n for n in taken if n is not None)
    return tuple(n for n in NUMBERS if n in free), tuple(n for n in LABELS if n != "item" and n in free)


def _one(found: Sequence[str], names: Sequence[str], what: str, remedy: str, wanted: Wanted) -> str:
    if len(found) == 1:
        return found[0]
    shown = ", ".join(found) if found else "none"
    allowed = f"one; {remedy}. Columns: {', '.join(names)}"
    raise _checks.InvalidValueError(f"{wanted.source}: column that {what}", shown, allowed)
