"""The ledger's words: ``claims.toml``, and templates that are filled with named numbers."""

from __future__ import annotations

import string
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

from uard.lab.statistics import Summary
from uard.lab.views.tables import bounds, brief, full, mean_sd, number
from uard.replication.paper import Stat


@dataclass(frozen=True)
class Words:
    """What is said of one claim.

    Attributes:
        statement: The claim, in one sentence.
        line: Its line in the paper's source.
        source: What was run.
        ours: Our number: a template, see ``Template``.
        why: The reason: a template.
        missing: What to say where the results are not there, for claims that are answered from published ones.
    """

    statement: str
    line: int
    source: str
    ours: str
    why: str
    missing: str = ""


@cache
def read() -> dict[str, Words]:
    """Return the words of all claims by id, in the ledger's order."""
    text = (resources.files("uard.replication.ledger") / "claims.toml").read_text(encoding="utf-8")
    return {claim: Words(**words) for claim, words in tomllib.loads(text).items()}


class Template(string.Formatter):
    """``str.format`` for the ledger's numbers.

    Beside Python's own, these are the formats; where none is given a number has three digits:

    * ``full``: mean ± sd [95 % interval] of a ``Summary``; ``ci``: mean [95 % interval]; ``brief``: mean ± sd, also of
      a printed ``Stat``;
    * ``percent``: a share as a percentage; ``p``: a p value.

    A dictionary is written as ``setting: value; setting: value``, every value in the format; None is ``none``.

    >>> Template().format("{share:percent}, {p:p}, {visits}", share=0.9361, p=1e-9, visits={"main": 1.5, "none": None})
    '93.6 %, p < 1e-6, main: 1.50; none: none'
    """

    def format_field(self, value: Any, format_spec: str) -> str:
        """Format one value."""
        if isinstance(value, Mapping):
            return "; ".join(f"{k}: {self.format_field(v, format_spec)}" for k, v in value.items())
        if value is None:
            return "none"
        if isinstance(value, bool):
            return "yes" if value else "no"
        if format_spec in _FORMATS:
            return _FORMATS[format_spec](value)
        return (
            number(value) if isinstance(value, float) and not format_spec else super().format_field(value, format_spec)
        )


def _interval(s: Summary) -> str:
    return f"{number(s.mean)}{bounds(s.ci95)}" if s.ci95 else brief(s)


def _brief(s: Summary | Stat) -> str:
    return brief(s) if isinstance(s, Summary) else mean_sd(s.mean, s.sd)


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _p_value(p: float) -> str:
    return "p < 1e-6" if p < 1e-6 else f"p = {p:.2g}"


_FORMATS: dict[str, Callable[[Any], str]] = {
    "full": full,
    "ci": _interval,
    "brief": _brief,
    "percent": _percent,
    "p": _p_value,
}
