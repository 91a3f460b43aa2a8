"""Where ``uard`` fails or is beaten, as data: one line for each, found by rule from results, never written by hand.

Every study says for itself where ours loses (``losses`` of the modules beside this one); the report shows all of it in
one table that can be sorted and filtered.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from markupsafe import Markup, escape

from uard import _checks
from uard.lab import statistics
from uard.lab.statistics import Family, Summary
from uard.lab.views.tables import bounds, number

Kind = Literal["beaten", "fails", "costs", "no better", "control"]
KINDS: Mapping[Kind, str] = {
    "beaten": "beaten beyond noise",
    "fails": "misses its aim",
    "costs": "costs where nothing lies",
    "control": "a control that must fail",
    "no better": "another does as well",
}
_LONGEST = 110  # characters of a line of text


@dataclass(frozen=True)
class Loss:
    """One way in which ``uard`` loses.

    Examples:
        >>> from uard.lab.statistics import summarise
        >>> ours, theirs = summarise([34.0, 33.0, 35.0]), summarise([39.0, 40.0, 41.0])
        >>> lost = Loss("beaten", "games", "the mean earns more", "BoatRace, ppo", "mean", ours, theirs, p=0.001, of=96)
        >>> lost.gap, lost.sure
        (-6.0, 'p = 0.001 of 96 (Holm)')
        >>> round(lost.bad, 2)
        0.15

    Attributes:
        kind: One of ``KINDS``.
        study: Where it was found, in a word or two.
        what: What is lost, in a line.
        where: In which setting.
        against: Whom or what ours is compared with.
        ours: Our number; None if there is none.
        theirs: Theirs.
        metric: What the numbers are.
        p: Of the comparison, corrected for its family; None if nothing was tested.
        of: How many comparisons the family has.
        note: How sure it is, if ``p`` does not say it.
        why: Why, in a line.
    """

    kind: Kind
    study: str
    what: str
    where: str = ""
    against: str = ""
    ours: Summary | None = None
    theirs: Summary | None = None
    metric: str = "true return"
    p: float | None = None
    of: int = 1
    note: str = ""
    why: str = ""

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.choose("kind", self.kind, KINDS)
        for name in ("study", "what", "where", "against", "metric", "note", "why"):
            text = _checks.text(name, getattr(self, name))
            object.__setattr__(self, name, text)
            if len(text) > _LONGEST:
                raise _checks.InvalidValueError(name, text, f"at most {_LONGEST} characters")
            if name in ("study", "what") and not text.strip():
                raise _checks.InvalidValueError(name, text, "some words")
        for name in ("ours", "theirs"):
            s = getattr(self, name)
            if s is not None:
                _checks.instance(name, s, Summary, "a uard.lab.statistics.Summary, or None")
                if np.ndim(s.per_seed) != 1 or (s.ci95 is not None and np.shape(s.ci95) != (2,)):
                    raise _checks.InvalidValueError(name, s, "what uard.lab.statistics.summarise gives")
                _checks.finite(name, [s.mean, s.sd, *(s.ci95 or ())])
        if self.p is not None:
            _checks.number("p", self.p, low=0, high=1)
        _checks.whole("of", self.of, low=1)

    @property
    def gap(self) -> float | None:
        """Our mean less theirs."""
        return None if self.ours is None or self.theirs is None else self.ours.mean - self.theirs.mean

    @property
    def bad(self) -> float | None:
        """How far apart the two are, as a share of the larger: lines of different studies can be sorted by it."""
        if self.gap is None or self.ours is None or self.theirs is None:
            return None
        largest = max(abs(self.ours.mean), abs(self.theirs.mean))
        return abs(self.gap) / largest if largest else 0.0

    @property
    def sure(self) -> str:
        """How sure it is, in words."""
        if self.p is None:
            return self.note or _seeds(self.ours)
        told = "" if self.p < statistics.LEVEL else "not told apart, "
        p = "p < 0.001" if self.p < 0.001 else f"p = {self.p:.1g}"
        said = f"{told}{p} of {self.of} (Holm)" if self.of > 1 else f"{told}{p}"
        return f"{said}; {self.note}" if self.note else said

    def sentence(self) -> str:
        """Return all of it as text, for a terminal or a log."""
        numbers = "; ".join(
            f"{who} {number(s.mean)}{bounds(s.ci95)}"
            for who, s in (("uard", self.ours), (self.against, self.theirs))
            if s is not None
        )
        parts = (f"{self.study}: {self.what}", self.where, f"{self.metric}: {numbers}" if numbers else "", self.sure)
        return "; ".join(part for part in (*parts, self.why) if part) + "."


def _seeds(s: Summary | None) -> str:
    if s is None:
        return ""
    n = len(s.per_seed)
    return "one run" if n == 1 else f"{n} seeds"


def said(s: Summary) -> str:
    """Return deviation and number of seeds, where there are several."""
    return f"sd {number(s.sd)}, {len(s.per_seed)} seeds" if len(s.per_seed) > 1 else ""


def of_family(family: Family, i: int) -> tuple[float | None, int]:
    """Return the corrected p of pair i, None if it was not compared, and how many comparisons the family has."""
    return (None if family.tests[i] is None else family.adjusted[i]), family.compared


def sorted_by_weight(every: Iterable[Loss]) -> list[Loss]:
    """Return losses in the order in which a reader should meet them: by kind, and in each the largest first."""
    kinds = list(KINDS)
    return sorted(every, key=lambda x: (kinds.index(x.kind), -(x.bad or 0.0)))


def drawn(loss: Loss, width: int = 96) -> Markup:
    """Draw both numbers with their intervals on one line, ours above; nothing if one of them is missing.

    Args:
        loss: What is drawn.
        width: Pixels.
    """
    if loss.ours is None or loss.theirs is None:
        return Markup()
    both = (("ours", 6, loss.ours), ("theirs", 16, loss.theirs))
    ends = [x for _, _, s in both for x in (s.mean, *(s.ci95 or ()))]
    low, high = min(ends), max(ends)

    def at(x: float) -> str:
        return f"{4 + (width - 8) * (x - low) / (high - low or 1.0):.1f}"

    parts: list[str] = []
    if low < 0 < high:
        parts.append(f'<path class="zero" d="M{at(0)} 0V22"/>')
    for name, y, s in both:
        line = f"M{at(s.ci95[0])} {y}H{at(s.ci95[1])}" if s.ci95 else ""
        parts.append(
            f'<g class="{name}"><path stroke-width="2" d="{line}"/><circle cx="{at(s.mean)}" cy="{y}" r="3.5"/></g>'
        )
    label = escape(f"uard {number(loss.ours.mean)}, {loss.against} {number(loss.theirs.mean)}")
    size = f'width="{width}" height="22" viewBox="0 0 {width} 22"'
    return Markup(f'<svg role="img" aria-label="{label}" {size}>{"".join(parts)}</svg>')
