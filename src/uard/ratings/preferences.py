"""Answers about pairs: which of two did a rater prefer?"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from uard import _checks
from uard.ratings.log import bad_cell
from uard.ratings.readers.columns import MISSING, Choice, Numbers, name_of
from uard.ratings.readers.formats import table
from uard.ratings.readers.layout import RATERS
from uard.ratings.readers.sides import Sides, sides_among
from uard.ratings.readers.spelling import among, normal

if TYPE_CHECKING:
    from jaxtyping import Float, Shaped

TIES = frozenset(("tie", "tied", "equal", "same", "draw", "both", "neither", "tiebothbad", "bothbad"))
SKIPS = frozenset(("skip", "skipped", "unsure", "dontknow", "cannottell", "nopreference"))
FIRST = frozenset(("left", "a", "1", "first"))
SECOND = frozenset(("right", "b", "2", "second"))


@dataclass(frozen=True, eq=False)
class Preferences:
    """Answers about pairs, turned so that a pair is the same whichever of the two stood first.

    Examples:
        >>> a, b, who = np.array(["a", "a"]), np.array(["b", "b"]), np.array(["ann", "bob"])
        >>> asked = Preferences(a, b, np.array([1.0, 0.5]), who)
        >>> len(asked), asked.raters, asked.agreement()
        (2, ('ann', 'bob'), 0.0)

    Attributes:
        first: Of every answer, that of the two whose name comes first in the alphabet.
        second: The other.
        outcome: 1 where the first was preferred, 0 where the second was, 0.5 for a tie.
        rater: Who answered, or None where the source does not say.
        skipped: How many answers were none, and are left out.
        swapped: In how many of the others the sides stood the other way round.
        source: Where they are from.
    """

    first: Shaped[np.ndarray, " m"]
    second: Shaped[np.ndarray, " m"]
    outcome: Float[np.ndarray, " m"]
    rater: Shaped[np.ndarray, " m"] | None = None
    skipped: int = 0
    swapped: int = 0
    source: str = "preferences"

    def __len__(self) -> int:
        """Return the number of answers."""
        return len(self.outcome)

    @property
    def raters(self) -> tuple[str, ...]:
        """The names of those who answered, in order."""
        return () if self.rater is None else tuple(sorted(set(self.rater.tolist())))

    def agreement(self) -> float | None:
        """Return in which share of cases two raters of one pair answer the same, in [0, 1]; by chance it is about 1/2.

        Of a rater who answers twice about a pair, the last answer counts. None if no pair was judged by two.
        """
        if self.rater is None:
            return None
        last = dict(zip(zip(self.first, self.second, self.rater, strict=True), self.outcome.tolist(), strict=True))
        each: dict[tuple[str, str], Counter[float]] = {}
        for (first, second, _), outcome in last.items():
            each.setdefault((first, second), Counter())[outcome] += 1
        same = sum(n * (n - 1) for answers in each.values() for n in answers.values())
        cases = sum(n * (n - 1) for n in (answers.total() for answers in each.values()))
        return same / cases if cases else None


def read(path: str | Path) -> Preferences:
    r"""Read answers about pairs from a file.

    Columns: two sides (``left`` and ``right``, ``response_a`` and ``response_b``, ``model_a`` and ``model_b`` ...) and
    which was preferred (``choice``, ``winner``, ``preferred``, ``label`` ...: a side, its column, its content, ``tie``
    or ``skip``); or ``chosen`` and ``rejected``. And who answered, as in ``uard.ratings.readers``.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "pairs.csv"
        ...     _ = file.write_text("worker,left,right,choice\nann,x,y,left\nbob,y,x,right\nann,x,z,skip\n")
        ...     asked = read(file)
        >>> asked.outcome.tolist(), asked.skipped, asked.swapped, asked.agreement()
        ([1.0, 1.0], 1, 1, 1.0)

    Args:
        path: A file with one of the endings that ``uard.ratings.readers`` reads.

    Raises:
        InvalidValueError: it cannot be read, there are no such columns, an answer names no side or no rater, or both
            sides are the same.
    """
    source = str(path)
    choice = _PairChoice(source)
    columns, names = table(path, choice, Numbers(source))
    sides, who = choice.of(names)
    words = _words(columns, sides, source)
    pairs = zip(columns[sides.first], columns[sides.second], strict=True)
    found: list[tuple[str, str, float, str | None]] = []
    swapped = 0
    for row, ((one, other), outcome) in enumerate(zip(pairs, words, strict=True)):
        if outcome is None:
            continue
        first, second = name_of(one), name_of(other)
        if first is None or second is None or first == second:
            raise _checks.InvalidValueError(f"{source}: row {row + 1}, sides", (one, other), "two different things")
        rater = name_of(columns[who][row]) if who is not None else None
        if who is not None and rater is None:
            raise bad_cell(source, row, who, None, "the name of who answered")
        swapped += first > second
        found.append((second, first, 1.0 - outcome, rater) if first > second else (first, second, outcome, rater))
    return Preferences(
        first=np.array([x[0] for x in found], dtype=object),
        second=np.array([x[1] for x in found], dtype=object),
        outcome=np.array([x[2] for x in found], dtype=float),
        rater=None if who is None else np.array([x[3] for x in found], dtype=object),
        skipped=len(words) - len(found),
        swapped=swapped,
        source=source,
    )


def _words(columns: dict[str, Any], sides: Sides, source: str) -> list[float | None]:
    """Return how the first side came out of every answer: 1, 0, 0.5 for a tie; None where there is no answer.

    Raises:
        InvalidValueError: naming all words that are none of these, with their counts.
    """
    if sides.choice is None:
        return [1.0] * len(columns[sides.first])
    unknown: Counter[str] = Counter()

    def outcome(one: Any, other: Any, answer: Any) -> float | None:
        word = name_of(answer)
        if word is None or word.lower() in MISSING or normal(word) in SKIPS:
            return None
        for value, words, side, content in ((1.0, FIRST, sides.first, one), (0.0, SECOND, sides.second, other)):
            if word == name_of(content) or normal(word) == normal(side) or normal(word) in words:
                return value
        if normal(word) not in TIES:
            unknown[word] += 1
        return 0.5

    rows = zip(columns[sides.first], columns[sides.second], columns[sides.choice], strict=True)
    found = [outcome(*row) for row in rows]
    if unknown:
        allowed = f"{sides.first} or {sides.second}, what stands there, left or right, a or b, 1 or 2, tie, or skip"
        shown = dict(unknown.most_common(5))
        raise _checks.InvalidValueError(f"{source}: column {sides.choice!r}, with counts", shown, allowed)
    return found


@dataclass(frozen=True)
class _PairChoice(Choice):
    """The columns of answers about pairs; ``source`` is what messages call their file."""

    source: str

    def candidate(self, name: str) -> bool:
        return True

    def columns(self, names: Sequence[str]) -> tuple[Sequence[str], Sequence[str]]:
        sides, who = self.of(names)
        return (), tuple(n for n in (*sides, who) if n is not None)

    def of(self, names: Sequence[str]) -> tuple[Sides, str | None]:
        """Return the sides, and who answered."""
        sides = sides_among(names)
        if sides is None:
            allowed = (
                f"two sides, such as left and right, and a choice; or chosen and rejected. Columns: {', '.join(names)}"
            )
            raise _checks.InvalidValueError(f"{self.source}: columns of pairs", "none", allowed)
        raters = among(names, RATERS, but=sides)
        if len(raters) > 1:
            raise _checks.InvalidValueError(f"{self.source}: column that says who answered", ", ".join(raters), "one")
        for name in (*sides, *raters):
            if name is not None and list(names).count(name) > 1:
                raise _checks.InvalidValueError(f"{self.source}: column", name, "there only once")
        return sides, raters[0] if raters else None
