"""A panel of judges: what is known of each, and how their scores of a completion become one reward.

What is known is fitted once (``uard.judges.fitting``) and does not change, so that the reward of a completion depends
on its own scores only: not on its batch, not on the order of batches, not on the process that asks.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from uard import _checks
from uard._support import files
from uard.judges.asking import RESERVED, as_scores, check_name, is_listed
from uard.judges.rules import check_rule
from uard.method.mitigations import Evidence, Mitigation, PooledDiscounting, uard
from uard.method.mitigations.pooled import Believed
from uard.method.rater_statistics import FLOOR, PER_RATER, RaterStatistics
from uard.ratings import state
from uard.ratings.aggregate import aggregate, nothing

if TYPE_CHECKING:
    from jaxtyping import Float

FORMAT, VERSION = "uard panel of judges", 1
LARGEST = 1e300  # larger scores are taken for this one
CLIP, WIDEST_CLIP = 5.0, 1e6  # standard deviations; more would only overflow
WIDEST = 1e9  # standard deviations that anything of a panel may measure; the squares of more would overflow
AGREE = 0.9  # a weight from which on judges are said to agree


@dataclass(frozen=True)
class FittedJudge:
    """What is known of one judge.

    Examples:
        >>> clarity = FittedJudge("clarity", location=5.0, scale=2.0)
        >>> clarity.standardised(np.array([7.0, np.nan])).tolist()
        [1.0, nan]

    Attributes:
        name: Of the judge.
        location: Mean of its scores, in its own unit.
        scale: Their standard deviation, in its own unit; 0 of a judge whose scores were all equal, who is left out.
        bias: What it says beyond the proxy, in standard deviations.
        idiosyncrasy: Variance of what it means that the others do not explain, in squared standard deviations, >= 0.
        noise: Variance of one of its scores, likewise.
        heard: Whether the rule ``uard`` listens to it.
        missing: Which share of the completions it did not score, in [0, 1].
        sentinels: Scores that are none: what it gave where it had failed.
        tells_apart: Whether it has ever told the completions of one prompt apart; None if that was not seen. A judge
            that has not is left out: no advantage depends on it.
    """

    name: str
    location: float = 0.0
    scale: float = 1.0
    bias: float = 0.0
    idiosyncrasy: float = 0.0
    noise: float = 0.01
    heard: bool = True
    missing: float = 0.0
    sentinels: tuple[float, ...] = ()
    tells_apart: bool | None = None

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        check_name("name of a judge", self.name)
        of = f"of judge {self.name!r}"
        _checks.number(f"location {of}", self.location, low=-LARGEST, high=LARGEST)
        _checks.number(f"scale {of}", self.scale, low=0, high=LARGEST)
        _checks.number(f"bias {of}", self.bias, low=-WIDEST, high=WIDEST)
        for name in ("idiosyncrasy", "noise"):
            _checks.number(f"{name} {of}", getattr(self, name), low=0, high=WIDEST**2)
        _checks.number(f"missing {of}", self.missing, low=0, high=1)
        _checks.truth(f"heard {of}", self.heard)
        if self.tells_apart is not None:
            _checks.truth(f"tells_apart {of}", self.tells_apart)
        if not is_listed(self.sentinels):
            raise _checks.InvalidValueError(f"sentinels {of}", self.sentinels, "a tuple of numbers")
        for value in self.sentinels:
            _checks.number(f"sentinels {of}", value)
        object.__setattr__(self, "sentinels", tuple(self.sentinels))

    @property
    def counts(self) -> bool:
        """Whether its scores say anything about a completion."""
        return self.scale > 0 and self.tells_apart is not False

    def standardised(self, scores: Float[np.ndarray, " B"]) -> Float[np.ndarray, " B"]:
        """Return scores in standard deviations; NaN where one is missing, a failure, or means nothing."""
        return _standardised(scores[:, None], _Units.of([self]))[:, 0]


class Combined(NamedTuple):
    """What became of B completions; in standard deviations of a judge. NaN where nobody scored one.

    Attributes:
        reward: What to learn from.
        weight: w in [0, 1]: how far the proxy is believed; 1 for a rule without weights.
        tau: By how much judges differ beyond their own errors (sigma_h); 0 for a completion with fewer than two scores.
        proxy: What is believed: mean or median of the judges, or one of them.
        ratings: Each judge's score, standardised and cut off; NaN where one is missing.
        judges: Names of the K judges.
    """

    reward: Float[np.ndarray, " B"]
    weight: Float[np.ndarray, " B"]
    tau: Float[np.ndarray, " B"]
    proxy: Float[np.ndarray, " B"]
    ratings: Float[np.ndarray, "B K"]
    judges: tuple[str, ...]

    def why(self, row: int) -> str:
        """Say in words why a completion is believed as far as it is."""
        said = {name: x for name, x in zip(self.judges, self.ratings[row].tolist(), strict=True) if not math.isnan(x)}
        if not said:
            return "no judge scored it"
        each = ", ".join(f"{name} {x:+.1f}" for name, x in sorted(said.items(), key=lambda pair: -pair[1]))
        if len(said) < 2:
            return f"{each} alone: nobody to compare with"
        weight = float(self.weight[row])
        return f"{'agreed' if weight >= AGREE else 'contested'} ({each}): believed to {100 * weight:.0f} %"


@dataclass(frozen=True)
class JudgePanel:
    """Judges on one scale, and the rule that makes one reward of their scores. Nothing changes it.

    Examples:
        >>> panel = JudgePanel((FittedJudge("relevance"), FittedJudge("clarity", 5.0, 2.0), FittedJudge("wow")))
        >>> combined = panel.combine({"relevance": [1.0, 0.0], "clarity": [7.0, None], "wow": [0.9, 5.0]})
        >>> combined.weight.round(2).tolist(), combined.why(1)
        ([1.0, 0.0], 'contested (wow +5.0, relevance +0.0): believed to 0 %')

    Attributes:
        judges: K >= 2 judges with different names.
        rule: One of ``uard.judges.rules.RULES``, as a mitigation; its name is taken too.
        proxy: What the rule believes or doubts: ``mean``, ``median``, or the name of a judge (the mean where it is
            missing).
        weights: Of the mean, one number > 0 per judge; equal if left out.
        clip: Scores are cut off at this many standard deviations, in (0, 1e6].
        usual: Median reward that was learned in the log, in standard deviations.
        typical: Median proxy in the log, likewise.
        spread: Standard deviation of the proxy in the log, in [1e-9, 1e9].
        span: Range of scores and proxy in the log, and a spread, likewise.
        completions: How many were in the log.
    """

    judges: tuple[FittedJudge, ...]
    rule: Mitigation = field(default_factory=uard)
    proxy: str = "mean"
    weights: tuple[float, ...] = ()
    clip: float = CLIP
    usual: float = 0.0
    typical: float = 0.0
    spread: float = 1.0
    span: float = 10.0
    completions: int = 0

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        judges: Any = self.judges
        if not is_listed(judges) or not all(isinstance(judge, FittedJudge) for judge in judges):
            raise _checks.InvalidValueError("judges", judges, "FittedJudge(name, ...), at least two of them")
        names = self.names
        if len(names) < 2 or len(set(names)) < len(names):
            allowed = "at least two judges with different names: one never disagrees with itself"
            raise _checks.InvalidValueError("judges", list(names), allowed)
        object.__setattr__(self, "rule", check_rule(self.rule))
        if taken := ({"mean", "median"} | RESERVED) & set(names):
            raise _checks.InvalidValueError(
                "names of the judges", list(names), f"others than {', '.join(sorted(taken))}"
            )
        _checks.choose("proxy", self.proxy, ("mean", "median", *names))
        if not is_listed(self.weights):
            raise _checks.InvalidValueError("weights", self.weights, "a number > 0 per judge")
        weights = tuple(self.weights) or (1.0,) * len(names)
        if len(weights) != len(names):
            raise _checks.InvalidValueError("len(weights)", len(weights), f"{len(names)}, one per judge")
        for name, weight in zip(names, weights, strict=True):
            _checks.number(f"weight of judge {name!r}", weight, low=0, open_low=True)
        shares = tuple(float(weight) / max(weights) for weight in weights)
        if not all(shares):
            raise _checks.InvalidValueError("weights", weights, "numbers of which none vanishes beside another")
        object.__setattr__(self, "weights", shares)
        _checks.number("clip", self.clip, low=0, high=WIDEST_CLIP, open_low=True)
        for name in ("usual", "typical"):
            _checks.number(name, getattr(self, name), low=-WIDEST, high=WIDEST)
        for name in ("spread", "span"):
            _checks.number(name, getattr(self, name), low=1 / WIDEST, high=WIDEST)
        _checks.whole("completions", self.completions)

    @classmethod
    def plain(cls, judges: Sequence[str], **settings: Any) -> JudgePanel:
        """Return a panel of judges of whom nothing is known but that all score in one unit, about 0, of deviation 1.

        Scores in another unit are cut off at ``clip``: give location and scale of such judges (``FittedJudge``).

        Args:
            judges: Their names.
            settings: Other fields of the panel.
        """
        return cls(tuple(FittedJudge(name) for name in judges), **settings)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the judges, in order."""
        return tuple(judge.name for judge in self.judges)

    def combine(self, scores: Mapping[str, Any] | Float[np.ndarray, "B K"]) -> Combined:
        """Return one reward per completion, and why.

        A completion with fewer than two scores has nothing to be checked against: ``uard`` believes its proxy as it
        believes what nobody has rated, the other rules take it as it is. One without any score has no reward (NaN).

        Args:
            scores: Of B completions, by the names of all judges of the panel, or as an array with a column for each in
                its order; NaN, or in lists None, where one is missing. A judge who is not asked any more has None.

        Raises:
            InvalidValueError: judges are missing or unknown, or a score is no finite number.
        """
        return self.of_ratings(_standardised(self._columns(scores), self._units))

    def without_failures(self, scores: Float[np.ndarray, "B K"]) -> Float[np.ndarray, "B K"]:
        """Return scores of the judges, in their order, without those that are failures: NaN."""
        return _without_failures(scores, self._units)

    def of_ratings(self, ratings: Float[np.ndarray, "B K"]) -> Combined:
        """Return what ``combine`` does of scores that are standardised already; NaN where one is missing."""
        ratings = np.ascontiguousarray(np.clip(ratings, -self.clip, self.clip))
        here = ~np.isnan(ratings)
        number, proxy = here.sum(1), self.proxy_of(ratings)
        checked = np.where(number >= 2, 1.0, np.nan)[:, None] * ratings
        zero = np.zeros(len(ratings))
        held = np.where(number > 0, proxy, zero)
        why = self.rule.explain(Evidence(held, zero, aggregate(checked, held)), self._statistics)
        reward, weight, tau = (
            np.where(number > 0, np.asarray(x) + zero, np.nan) for x in (why.signal.reward, why.weight, why.sigma_h)
        )
        return Combined(reward, weight, np.where(number >= 2, tau, zero), proxy, ratings, self.names)

    def proxy_of(self, ratings: Float[np.ndarray, "B K"]) -> Float[np.ndarray, " B"]:
        """Return what the rule believes or doubts, of standardised scores; NaN where all are missing."""
        here = ~np.isnan(ratings)
        held, shares = np.where(here, ratings, 0.0), np.array(self.weights)
        # Not as products of matrices, whose last bits depend on how many rows there are.
        total = (here * shares).sum(1)
        proxy = np.divide((held * shares).sum(1), total, out=np.full(len(ratings), np.nan), where=total > 0)
        if self.proxy == "median":
            some = here.any(1)
            proxy[some] = np.nanmedian(ratings[some], axis=1)
        elif self.proxy != "mean":
            one = self.names.index(self.proxy)
            proxy = np.where(here[:, one], ratings[:, one], proxy)
        return proxy

    def renamed(self, names: Mapping[str, str]) -> JudgePanel:
        """Return the panel with other names for some judges.

        Raises:
            UnknownNameError: there is no such judge.
        """
        for name in names:
            _checks.choose("name of a judge", name, self.names)
        judges = tuple(replace(judge, name=names.get(judge.name, judge.name)) for judge in self.judges)
        return replace(self, judges=judges, proxy=names.get(self.proxy, self.proxy))

    def save(self, path: str | Path) -> None:
        """Write it to a JSON file, which is whole at any time.

        Raises:
            InvalidValueError: it cannot be written.
        """
        content = self._content()
        content = json.loads(json.dumps(content, default=lambda number: number.item()))  # of NumPy, perhaps
        text = json.dumps({**content, "checksum": _checksum(content)}, indent=1, allow_nan=False)
        files.write(path, f"{text}\n", "panel")

    @classmethod
    def load(cls, path: str | Path, judges: Sequence[str] | None = None) -> JudgePanel:
        """Read what ``save`` has written; nothing in the file is executed.

        Args:
            path: Of the file.
            judges: Names of the judges that are going to be asked; others are an error that names them.

        Raises:
            InvalidValueError: it cannot be read, is no such file, of another version, changed since, or of other
                judges.
        """
        try:
            content = json.loads(Path(path).read_bytes(), parse_constant=_no_number)
            panel = cls._of(content)
        except (*state.BROKEN, RecursionError) as error:
            why = f"{type(error).__name__}: {error}"
            allowed = f"a file that `uard judges fit` or JudgePanel.save wrote ({why})"
            raise _checks.InvalidValueError("panel", str(path), allowed) from None
        if judges is not None:
            panel.check_judges(judges)
        return panel

    def check_judges(self, names: Sequence[str]) -> None:
        """Check that these are the judges of the panel, in any order.

        Raises:
            InvalidValueError: naming who is missing, who is unknown, and what to do.
        """
        gone, new = ([name for name in a if name not in b] for a, b in ((self.names, names), (names, self.names)))
        if not gone and not new:
            return
        parts = [f"{text} {', '.join(map(repr, who))}" for text, who in (("without", gone), ("with", new)) if who]
        allowed = (
            f"those of the panel, {', '.join(map(repr, self.names))}; fit it again {' and '.join(parts)}. One who "
        )
        allowed += "was renamed: panel.renamed({'old': 'new'}); one who is not asked any more: a function that returns "
        allowed += "None for each completion"
        raise _checks.InvalidValueError("judges", list(names), allowed)

    def _columns(self, scores: Any) -> Float[np.ndarray, "B K"]:
        if isinstance(scores, Mapping):
            by_name = cast("Mapping[str, Any]", scores)
            self.check_judges(list(by_name))
            sizes = [len(given) for given in by_name.values() if is_listed(given)]
            if sizes:  # a judge that was not asked may have None
                by_name = {name: [None] * sizes[0] if x is None else x for name, x in by_name.items()}
            return np.stack([as_scores(name, by_name[name], (sizes or [1])[0]) for name in self.names], axis=1)
        array = _checks.as_numpy("scores", scores)
        if array.ndim != 2 or array.shape[1] != len(self.judges):
            allowed = f"(B, {len(self.judges)}): a column for each of {', '.join(self.names)}"
            raise _checks.InvalidValueError("scores.shape", array.shape, allowed)
        if np.isinf(array).any():
            raise _checks.InvalidValueError("scores", "inf", "finite numbers, NaN where one is missing")
        return array

    @cached_property
    def _units(self) -> _Units:
        return _Units.of(self.judges)

    @cached_property
    def _statistics(self) -> Any:
        """What the rule's ``fit`` would have returned on the log."""
        if not isinstance(self.rule, PooledDiscounting):
            none = nothing((1,), len(self.judges))  # these rules read none where two have rated
            return self.rule.fit(none, none.count > 0)
        each = {name: np.array([float(getattr(judge, name)) for judge in self.judges]) for name in PER_RATER}
        of_all = ((FLOOR * self.spread) ** 2, self.typical, self.span, self.spread)
        raters = RaterStatistics(*(each[name] for name in PER_RATER), *map(np.float64, of_all))
        return Believed(raters, np.float64(self.usual))

    def _content(self) -> dict[str, Any]:
        fields = {name: getattr(self, name) for name in _PLAIN}
        judges = [asdict(judge) for judge in self.judges]
        return {"format": FORMAT, "version": VERSION, "judges": judges, "rule": state.described(self.rule), **fields}

    @classmethod
    def _of(cls, content: Any) -> JudgePanel:
        kept = cast("dict[str, Any]", content if isinstance(content, dict) else {})
        if kept.get("format") != FORMAT:
            raise _checks.InvalidValueError("format", kept.get("format"), repr(FORMAT))
        if kept.get("version") != VERSION:
            raise _checks.InvalidValueError("version", kept.get("version"), f"{VERSION}: fit again with this uard")
        if kept.pop("checksum", None) != _checksum(kept):
            raise _checks.InvalidValueError("checksum", "another", "that of the content: was the file changed by hand?")
        rule = state.mitigation_of(kept["rule"])
        judges = tuple(FittedJudge(**judge | {"sentinels": tuple(judge["sentinels"])}) for judge in kept["judges"])
        plain: dict[str, Any] = {name: kept[name] for name in _PLAIN}
        plain["weights"] = tuple(plain["weights"])
        return cls(judges, check_rule(rule), **plain)


class _Units(NamedTuple):
    """Location and scale of K judges, NaN of one whose scores mean nothing, and which scores are none."""

    location: Float[np.ndarray, " K"]
    scale: Float[np.ndarray, " K"]
    sentinels: list[tuple[int, float]]

    @classmethod
    def of(cls, judges: Sequence[FittedJudge]) -> _Units:
        scale = np.array([judge.scale if judge.counts else np.nan for judge in judges])
        sentinels = [(k, value) for k, judge in enumerate(judges) for value in judge.sentinels]
        return cls(np.array([judge.location for judge in judges]), scale, sentinels)


def _without_failures(scores: Float[np.ndarray, "B K"], units: _Units) -> Float[np.ndarray, "B K"]:
    given = scores.copy()
    for k, value in units.sentinels:
        given[scores[:, k] == value, k] = np.nan
    return given


def _standardised(scores: Float[np.ndarray, "B K"], units: _Units) -> Float[np.ndarray, "B K"]:
    given = np.clip(_without_failures(scores, units), -LARGEST, LARGEST)
    with np.errstate(over="ignore"):  # what is too large is cut off later
        return (given - units.location) / units.scale


_PLAIN = ("proxy", "weights", "clip", "usual", "typical", "spread", "span", "completions")


def _checksum(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True, allow_nan=False).encode()).hexdigest()


def _no_number(text: str) -> None:
    raise _checks.InvalidValueError("number", text, "finite")
