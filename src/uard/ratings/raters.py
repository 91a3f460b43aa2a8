"""Raters for people: who is noisy, biased, contrary, constant or a copy, and how many independent ones they are worth.

What the pooled rule thinks of a panel (``uard.method.rater_statistics``) is drawn to the usual and has no intervals, as
a learner needs it. Here are estimates that are drawn nowhere, with intervals, and in words.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from uard import _checks
from uard._support.columns import WIDTH, fill
from uard._support.columns import text as columns_text
from uard.method.rater_statistics import LOUDEST
from uard.ratings.agreement import independence
from uard.ratings.jackknife import GROUPS, Estimate, interval, jackknife, texts
from uard.ratings.log import RatingLog
from uard.ratings.pairs import equal_share, line_between
from uard.ratings.rater_estimates import REPEATS, Answers, PanelEstimates, answers_of, sample_of_items

if TYPE_CHECKING:
    from jaxtyping import Float, Integer, Shaped

MOST = 1_000  # raters
MOST_ROWS = 20_000  # from which intervals of the effective number are made
MOST_WITH_INTERVALS = 200  # raters: beyond, there is time for the estimates alone
CONSTANT = 10  # items with one and the same answer, from which on a rater is called constant
COPY = 0.99  # share of equal answers
ALIKE = 0.9  # correlation from which on two raters may be copies
EQUAL = 1e-6  # of a unit
SLIGHT = 0.1  # of a unit: no smaller bias is called one

NoiseFrom = Literal["repeats", "others", "reward", "nothing"]


@dataclass(frozen=True)
class RaterSummary:
    """What is known of one rater, in the unit of the rater's own ratings.

    Examples:
        >>> ann = RaterSummary("ann", 2, 2, 0, None, "nothing", None, None, None, True, "", ())
        >>> ann.name, ann.noise
        ('ann', None)

    Attributes:
        name: Of the rater.
        answers: How many there are.
        items: How many different things were rated.
        repeated: Answers beyond the first about a thing.
        noise: Standard deviation of an answer, >= 0; None where ``noise_from`` is ``nothing``.
        noise_from: ``repeats``: from repeated answers (five or more). ``others``: there are too few, so it is from
            differences to other raters on common items, and holds the rater's idiosyncrasy too; of two raters each is
            given half. ``reward``: nobody else has rated these items, so it is the robust spread about the reward, and
            holds the reward's errors too.
        bias: What the rater says beyond the reward, or beyond the median of the other raters; None where there is
            neither.
        idiosyncrasy: Standard deviation, >= 0, of what the rater means that neither noise nor the others explain, by
            the pooled rule; where nothing was rated twice, it holds the noise. None without answers.
        with_others: Correlation with the median of reward and other raters (without rewards: with their mean), each in
            standard deviations; None where it is not defined.
        heard: Whether the pooled rule listens to the rater.
        why: Why not; empty if it does.
        words: What stands out, in words: ``noisy``, ``biased``, ``contrary``, ``constant``, a copy, other units.
    """

    name: str
    answers: int
    items: int
    repeated: int
    noise: Estimate | None
    noise_from: NoiseFrom
    bias: Estimate | None
    idiosyncrasy: float | None
    with_others: Estimate | None
    heard: bool
    why: str
    words: tuple[str, ...]


@dataclass(frozen=True)
class EffectiveRaters:
    """How many independent raters the raters of an item are worth, K / (1 + (K - 1) rho).

    Examples:
        >>> EffectiveRaters("reward", raters=3.0, correlation=Estimate(0.5, 0.25, 1.0)).number
        Estimate(value=1.5, low=1.0, high=2.0)

    Attributes:
        against: What errors are measured against: ``true_reward``, ``reward``, or ``part``, the mean rating of the part
            of the log. Against the latter two a truth that they miss counts as an error, so that the raters are worth
            at least as many.
        raters: K, the mean number of raters of an item that has at least two.
        correlation: rho, of two raters' errors, in [-1, 1].
    """

    against: str
    raters: float
    correlation: Estimate

    @property
    def number(self) -> Estimate:
        """The effective number, in [1, K]; a rho below 0 counts as 0."""
        worth = [
            None if rho is None else self.raters / (1.0 + (self.raters - 1.0) * min(max(rho, 0.0), 1.0))
            for rho in (self.correlation.value, self.correlation.high, self.correlation.low)
        ]
        value, low, high = worth
        assert value is not None
        return Estimate(value, low, high)

    def as_data(self) -> dict[str, Any]:
        """Return everything as plain data that JSON can hold."""
        estimates = {"correlation": _plain(self.correlation), "number": _plain(self.number)}
        return {"against": self.against, "raters": self.raters, **estimates}


@dataclass(frozen=True)
class PanelSummary:
    """What is known of all raters of a log; ``str(summary)`` is a table.

    Examples:
        >>> panel = summary(RatingLog(None, np.arange(20.0)[:, None] + [0.0, 0.0, 5.0], ("ann", "bob", "cat")))
        >>> panel.against, [r.words for r in panel.raters]
        ('the other raters', [(), (), ('biased by 5',)])

    Attributes:
        source: Where the log is from.
        items: How many different things it holds.
        answers: How many answers.
        against: What biases are measured against: ``the reward`` or ``the other raters``.
        raters: One by one, in the log's order.
        effective: How many they are worth; None where that cannot be told.
    """

    source: str
    items: int
    answers: int
    against: str
    raters: tuple[RaterSummary, ...]
    effective: EffectiveRaters | None

    def as_data(self) -> dict[str, Any]:
        """Return everything as plain data that JSON can hold; what is not known is None."""
        data = asdict(self)
        for rater, told in zip(data["raters"], self.raters, strict=True):
            for name in ("noise", "bias", "with_others"):
                rater[name] = _plain(getattr(told, name))
            rater["words"] = list(told.words)
        if self.effective is not None:
            data["effective"] = self.effective.as_data()
        return data | {"raters": list(data["raters"])}

    def __str__(self) -> str:
        """Return a table, and what is known of all raters together, 80 columns wide."""
        return self.text()

    def text(self, width: int = WIDTH) -> str:
        """Return a table, and what is known of all raters together.

        Args:
            width: Of the longest line, unless a word is longer.
        """
        told = self.raters
        marks = [f" *{r.noise_from[0]}" if r.noise_from not in ("repeats", "nothing") else "" for r in told]
        of_noise, of_bias = texts([r.noise for r in told]), texts([r.bias for r in told], "+")
        own = [None if r.idiosyncrasy is None else Estimate(r.idiosyncrasy) for r in told]
        columns = {
            "rater": [r.name for r in told],
            "answers": [str(r.answers) for r in told],
            "noise [95 %]": [f"{x}{mark}" for x, mark in zip(of_noise, marks, strict=True)],
            "bias [95 %]": of_bias,
            "idiosyncrasy": texts(own),
            "with others": ["?" if r.with_others is None else f"{r.with_others:z.2f}" for r in told],
        }
        several = f"{len(told)} rater{'s' * (len(told) != 1)}"
        title = f"{self.source}: {self.items} items, {several}, {self.answers} answers; bias is against {self.against}"
        notes = [text for letter, text in _NOTES.items() if f" *{letter}" in marks]
        for r in told:
            words = [*r.words, *([f"not heard: {r.why}"] if not r.heard else [])]
            notes += [f"{r.name}: {'; '.join(words)}"] if words else []
        table = columns_text([*columns], zip(*columns.values(), strict=True), width)
        return "\n".join(
            [fill(title, width, rest="  "), table, *(fill(x, width, rest="  ") for x in [*notes, self._worth()])]
        )

    def _worth(self) -> str:
        if self.effective is None:
            return "effective raters: not known (it takes rewards or parts, and two raters with 30 common items)"
        e = self.effective
        missed = "" if e.against == "true_reward" else f"; a truth that the {e.against} misses counts as an error"
        return (
            f"effective raters: {e.number:.2f} of {e.raters:.3g} an item (95 %; mean correlation of errors "
            f"{e.correlation:z.2f}{missed})"
        )


_NOTES = {
    "o": "*o: too few repeated answers; from differences to other raters, idiosyncrasy included",
    "r": "*r: too few repeated answers and no other raters; spread about the reward, whose errors are included",
}


def _plain(estimate: Estimate | None) -> dict[str, Any] | None:
    return None if estimate is None else estimate._asdict()


def summary(log: RatingLog) -> PanelSummary:
    """Return what is known of the raters of a log.

    Intervals are jackknives over items (``uard.ratings.jackknife``) and take five items, and at most 200 raters. Of
    a large log 100 000 ratings, and at least 1000 items, are looked at, at even distances.

    Examples:
        >>> random = np.random.default_rng(0)
        >>> truth = random.normal(size=200)
        >>> said = truth[:, None] + [0.0, 1.0, 0.0] + [0.1, 0.1, 0.5] * random.normal(size=(200, 3))
        >>> panel = summary(RatingLog(truth, said, ("ann", "bob", "cat")))
        >>> [(r.name, f"{r.bias.value:z.1f}", f"{r.noise.value:.1f}", r.words) for r in panel.raters]
        [('ann', '0.0', '0.1', ()), ('bob', '1.0', '0.1', ('biased by 0.989',)), ('cat', '0.0', '0.5', ('noisy',))]

    Args:
        log: Rewards, if it holds any, and ratings; repeated answers and visits of one item tell a rater's noise.

    Raises:
        InvalidValueError: a rating or a reward is infinite or beyond 1e100, or there are over 1000 raters.
    """
    answers = answers_of(log)
    number = answers.count.sum(0)
    answered = np.flatnonzero(number > 0)
    if answered.size > MOST:
        raise _checks.InvalidValueError("raters", int(answered.size), f"at most {MOST}; read a part of the log")
    told: dict[int, RaterSummary] = {}
    effective = None
    against = "the other raters"
    if answered.size:
        part = sample_of_items(answers.of(answered))
        panel = PanelEstimates(part)
        against = "the reward" if panel.rewarded else against
        names = tuple(log.raters[k] for k in answered)
        told = dict(zip(answered.tolist(), _raters(panel, names, answers, answered), strict=True))
        effective = _effective(part)
    nothing = (None, "nothing", None, None, None, False, "no answers", ("no answers",))
    raters = tuple(told[k] if k in told else RaterSummary(name, 0, 0, 0, *nothing) for k, name in enumerate(log.raters))
    return PanelSummary(log.source, len(answers.count), int(number.sum()), against, raters, effective)


def _raters(
    panel: PanelEstimates, names: tuple[str, ...], answers: Answers, columns: Integer[np.ndarray, " K"]
) -> list[RaterSummary]:
    """Return what is known of every rater who has answered; ``columns`` are theirs among all answers."""
    count = answers.count[:, columns]
    repeated = np.maximum(count - 1.0, 0.0).sum(0)
    twice = np.maximum(panel.answers.count - 1.0, 0.0).sum(0) >= REPEATS

    def measures(rows: Integer[np.ndarray, " m"]) -> Float[np.ndarray, " many"]:
        variance = np.where(twice, panel.repeated_variance(rows), panel.variance(rows))
        return np.concatenate([panel.bias(rows), np.cbrt(variance), panel.with_others(rows)])

    rows = np.arange(len(panel.here))
    if len(names) <= MOST_WITH_INTERVALS:
        found = jackknife(measures, rows)
    else:
        value = measures(rows)
        found = value, np.full_like(value, np.nan)
    (bias, root, together), (bias_error, root_error, together_error) = (np.split(x, 3) for x in found)
    items = panel.here.sum(0)
    again = [int((panel.answers.count[:, k] > 1).sum()) if twice[k] else int(items[k]) for k in range(len(names))]
    heard = panel.statistics.heard > 0
    noise = [_deviation(interval(root[k], root_error[k], again[k])) for k in range(len(names))]
    biases = [interval(bias[k], bias_error[k], int(items[k])) for k in range(len(names))]
    others = [_correlation(interval(together[k], together_error[k], int(items[k]))) for k in range(len(names))]
    words = _words(panel, names, noise, biases, others)
    compared = panel.compared
    known_from: list[NoiseFrom] = [
        "repeats" if twice[k] else "others" if compared[k] else "reward" for k in range(len(names))
    ]
    return [
        RaterSummary(
            name,
            int(count[:, k].sum()),
            int((count[:, k] > 0).sum()),
            int(repeated[k]),
            noise[k],
            known_from[k] if noise[k] is not None else "nothing",
            biases[k],
            float(np.sqrt(panel.statistics.idiosyncrasy[k])),
            others[k],
            bool(heard[k]),
            "" if heard[k] else f"noise over {LOUDEST:g} times the usual",
            tuple(words[k]),
        )
        for k, name in enumerate(names)
    ]


def _deviation(root: Estimate | None) -> Estimate | None:
    """Return a standard deviation from the cube root of a variance, which is near normal [Wilson and Hilferty 1931].

    None where the variance is surely below 0: then errors are not independent, and this tells nothing.
    """
    if root is None or (root.high is not None and root.high < 0):
        return None
    return Estimate(*(None if x is None else max(x, 0.0) ** 1.5 for x in root))  # type: ignore[arg-type]


def _correlation(estimate: Estimate | None) -> Estimate | None:
    if estimate is None:
        return None
    value, low, high = estimate
    return Estimate(value, None if low is None else max(low, -1.0), None if high is None else min(high, 1.0))


def _words(
    panel: PanelEstimates,
    names: tuple[str, ...],
    noise: list[Estimate | None],
    bias: list[Estimate | None],
    others: list[Estimate | None],
) -> list[list[str]]:
    """Return what stands out of every rater."""
    unit = float(panel.statistics.scale)
    sds = np.array([np.nan if x is None else x.value for x in noise])
    alike = panel.comparable | np.eye(len(names), dtype=bool)  # of one unit
    odd = np.full(len(names), np.inf) if panel.rewarded else panel.odd
    copies, units = _copies(panel, names, unit), _other_units(panel, names)
    out: list[list[str]] = []
    for k in range(len(names)):
        said = panel.answers.mean[panel.here[:, k], k]
        constant = said.size >= CONSTANT and np.ptp(said) == 0 and not panel.answers.m2[panel.here[:, k], k].any()
        words = [f"constant ({said[0]:.3g})"] if constant else []
        words += copies[k] + units[k]
        n, b, r = noise[k], bias[k], others[k]
        if r is not None and r.high is not None and r.high < 0:
            words.append("contrary")
        elif n is not None and n.low is not None and not constant:
            others_too = sds[alike[k] & np.isfinite(sds)]
            usual = float(np.median(others_too)) if others_too.size > 2 else np.inf
            if n.low > usual and n.value > LOUDEST * usual:
                words.append("noisy")
        sure = 0.0 if b is None or b.low is None or b.high is None else max(b.low, -b.high)
        if b is not None and min(sure, odd[k]) > SLIGHT * unit and not units[k]:
            words.append(f"biased by {b.value:.3g}")
        out.append(words)
    return out


def _copies(panel: PanelEstimates, names: tuple[str, ...], unit: float) -> list[list[str]]:
    """Return of every rater whether it repeats the reward, or else which other rater."""
    both, said, reward = panel.with_reward, panel.answers.mean, panel.answers.reward
    out: list[list[str]] = []
    for k in range(len(names)):
        alike = [j for j in np.flatnonzero(both.correlation[k, : len(names)] > ALIKE) if j != k]
        if reward is not None and panel.rewarded and equal_share(said[:, k], reward, EQUAL * unit) >= COPY:
            out.append(["repeats the reward"])
        else:
            same = [names[j] for j in alike if equal_share(said[:, k], said[:, j], EQUAL * unit) >= COPY]
            out.append([f"the same as {', '.join(sorted(same))}"] if same else [])
    return out


def _other_units(panel: PanelEstimates, names: tuple[str, ...]) -> list[list[str]]:
    """Return of every rater in another unit than the reward the line that leads to it; without rewards, to the most."""
    out: list[list[str]] = [[] for _ in names]
    unit = panel.units
    if unit is None:
        return out
    if panel.rewarded:
        to, name = np.array([len(names)]), "the reward"
        if unit[-1] < 0:
            return out
    else:
        to = np.flatnonzero(unit == panel.main_unit)
        name = " and ".join(sorted(names[k] for k in to)[:3]) + (" and others" if len(to) > 3 else "")
    for k in range(len(names)):
        if unit[k] >= 0 and unit[k] != unit[to[0]]:
            line = line_between(panel.with_reward, k, to)
            shown = "" if line is None else f": {name} is about {line[0]:.3g} x rating {_signed(line[1])}"
            out[k].append(f"in other units than {name}{shown}")
    return out


def _signed(x: float) -> str:
    return f"{'-' if x < 0 else '+'} {abs(x):.3g}"


def _effective(answers: Answers) -> EffectiveRaters | None:
    """Return how many independent raters they are worth, against the truth, the reward, or the means of parts."""
    for name, against in (("true_reward", answers.truth), ("reward", answers.reward), ("part", _part_means(answers))):
        if against is None or not np.isfinite(against).any():
            continue
        return effective_raters(answers.mean, against, name, answers.part)
    return None


def effective_raters(
    ratings: Float[np.ndarray, "n K"],
    against: Float[np.ndarray, " n"],
    name: str,
    part: Shaped[np.ndarray, " n"] | None = None,
) -> EffectiveRaters | None:
    """Return how many independent raters they are worth, with an interval (see ``independence``).

    Of more than 20 000 rows the interval is made from as many at even distances, and drawn together accordingly.

    Examples:
        >>> random = np.random.default_rng(0)
        >>> truth, mistake = random.normal(size=(2, 500))
        >>> ratings = (truth + mistake)[:, None] + random.normal(size=(500, 3))
        >>> f"{effective_raters(ratings, truth, 'true_reward').number:.1f}"
        '1.5 [1.4, 1.6]'

    Args:
        ratings: A column per rater, NaN where one is missing.
        against: What they should have said, NaN where unknown.
        name: What that is called.
        part: To which part of the log each row belongs, such as a prompt. Errors may have something in common within a
            part, so that whole parts are left out for the interval; not of fewer than 25, which are too few for that.

    Returns:
        None where it cannot be told.
    """
    whole = independence(ratings, against, name)
    if whole is None:
        return None
    # By what rows hold, so that their order and that of raters hardly move the interval: only where ratings are equal.
    order = np.lexsort((*np.sort(ratings, axis=1).T, against))
    sample = np.unique(np.linspace(0, len(against) - 1, min(len(against), MOST_ROWS)).astype(int))
    ratings, sampled = ratings[order[sample]], against[order[sample]]
    unit = sample if part is None else part[order[sample]]
    unit = unit if (units := np.unique(unit).size) >= GROUPS else sample

    def correlation(rows: Integer[np.ndarray, " m"]) -> Float[np.ndarray, " 1"]:
        found = independence(ratings[rows], sampled[rows])
        return np.array([np.nan if found is None else found.correlation])

    error = np.nan
    if ratings.shape[1] <= MOST_WITH_INTERVALS:
        error = float(jackknife(correlation, unit)[1][0]) * math.sqrt(len(sample) / len(against))
    rho = _correlation(interval(whole.correlation, error, len(against) if unit is sample else units))
    return None if rho is None else EffectiveRaters(name, whole.raters, rho)


def _part_means(answers: Answers) -> Float[np.ndarray, " n"] | None:
    """Return of every item the mean rating of its part; None where no column divides the log.

    NaN for the only item of a part: its mean would be what the raters said of it themselves.
    """
    if answers.part is None:
        return None
    part = np.unique(answers.part, return_inverse=True)[1]
    here = answers.count > 0
    total = np.bincount(part, np.where(here, answers.mean, 0.0).sum(1))
    means = (total / np.maximum(np.bincount(part, here.sum(1)), 1.0))[part]
    return np.where(np.bincount(part)[part] > 1, means, np.nan)
