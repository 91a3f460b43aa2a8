"""Panels of raters: how each of K people rates a step.

A simulated rater sees the observed reward (the proxy), the true reward and whether the step is *contested* (one that
pays for something else than what was meant, such as entering a trap), and answers with a number. In a legitimate twin
the two rewards agree, but the contested steps stay contested. A panel reads the truth, as people do; the learner gets
nothing but the ratings.

How a panel rates a step is a law, and an answer is drawn from it:

    >>> import numpy as np
    >>> law = PANELS["main"].law(np.array(4.0), np.array(-1.0), np.array(True))
    >>> law.centre.tolist(), law.deviation.tolist()
    ([-1.0, 2.0, 1.0], [0.1, 0.0, 1.0])
    >>> answers(law, np.zeros(3))[0].tolist()
    [-1.0, 2.0, 1.0]
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, fields
from itertools import groupby
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from uard import _checks
from uard.method.arrays import Array, Numbers, namespace, where

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

A_PANEL = "a tuple of one Rater or more"
OUTLIER = 6.0  # times the usual noise
MOST = 1e30  # of a rater's numbers: single precision holds what is made of them
UNIFORMS = 3  # uniform numbers that an answer needs of a rater who lapses, skips steps or counts in stars


@dataclass(frozen=True)
class Rater:
    """How one simulated rater answers: scale (true + temptation (proxy - true)) + bias + noise.

    Examples:
        >>> Rater(temptation=0.5, bias=1.0).centre(proxy=4.0, true=-1.0)
        2.5

    Attributes:
        temptation: How far the rater is drawn from the truth towards the proxy, in [0, 1]; 1 repeats the proxy.
        bias: Added to every rating, in reward units.
        scale: Every rating is multiplied by this, not 0; a contrary rater's is negative.
        noise: Standard deviation of normal noise, in reward units, >= 0.
        contested_noise: The same on contested steps; ``noise`` if left out.
        lapse: Chance that an answer does not depend on the step: uniform over the panel's range.
        coverage: Share of the steps put to the panel that the rater answers, in (0, 1].
        stars: Answers are rounded to so many levels, evenly spaced over the panel's range, >= 2; not rounded if left
            out.
        outliers: Chance that an answer's noise is six times as large, in [0, 1].
        veto_above: Of steps whose true reward is higher, the rater's mean answer is ``veto``; of none if left out.
        veto: See there; in reward units.
    """

    temptation: float = 0.0
    bias: float = 0.0
    scale: float = 1.0
    noise: float = 0.1
    contested_noise: float | None = None
    lapse: float = 0.0
    coverage: float = 1.0
    stars: int | None = None
    outliers: float = field(default=0.0, metadata={"omitted_at": 0.0})
    veto_above: float | None = field(default=None, metadata={"omitted_at": None})
    veto: float = field(default=0.0, metadata={"omitted_at": 0.0})

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.number("temptation", self.temptation, low=0, high=1)
        _checks.number("bias", self.bias, low=-MOST, high=MOST)
        _checks.number("scale", self.scale, low=-MOST, high=MOST)
        if self.scale == 0:
            raise _checks.InvalidValueError("scale", self.scale, "another number than 0")
        _checks.number("noise", self.noise, low=0, high=MOST)
        if self.contested_noise is not None:
            _checks.number("contested_noise", self.contested_noise, low=0, high=MOST)
        _checks.number("lapse", self.lapse, low=0, high=1)
        _checks.number("coverage", self.coverage, low=0, high=1, open_low=True)
        if self.stars is not None:
            _checks.whole("stars", self.stars, low=2, high=1000)
        _checks.number("outliers", self.outliers, low=0, high=1)
        if self.veto_above is not None:
            _checks.number("veto_above", self.veto_above, low=-MOST, high=MOST)
        _checks.number("veto", self.veto, low=-MOST, high=MOST)
        if self.veto and self.veto_above is None:
            raise _checks.InvalidValueError("veto", self.veto, "left out where veto_above is")

    def __str__(self) -> str:
        """Return the noise and what else is not the default, such as ``noise 0.1, temptation 0.6``."""
        noise = f"noise {self.noise:g}"
        if self.contested_noise is not None:
            noise += f", {self.contested_noise:g} on contested steps"
        others = [f for f in fields(self) if "noise" not in f.name and getattr(self, f.name) != f.default]
        return ", ".join([noise, *(f"{f.name} {getattr(self, f.name):g}" for f in others)])

    @property
    def plain(self) -> bool:
        """Whether every answer is normal: no lapses, nothing skipped, no stars, no outliers."""
        return self.lapse == 0 and self.coverage == 1 and self.stars is None and self.outliers == 0

    def centre(self, proxy: Numbers, true: Numbers) -> Array:
        """Return the rater's mean answer to steps of which proxy and true reward are given; in reward units."""
        # A rater who repeats the proxy repeats it to the bit.
        seen = proxy if self.temptation == 1 else true + self.temptation * (proxy - true)
        said = seen if self.scale == 1 and self.bias == 0 else self.scale * seen + self.bias
        return said if self.veto_above is None else where(true > self.veto_above, self.veto + 0.0 * said, said)


class Quirks(NamedTuple):
    """What makes the answers of K raters other than normal.

    Attributes:
        lapse: Chance of a lapse.
        coverage: Share of the steps that are answered.
        step: Width of a star, in reward units; 0 for a rater who does not count in stars.
        low: Lower end of the range of answers, in reward units.
        high: Upper end.
        outliers: Chance of an outlier.
    """

    lapse: Float[Array, " K"]
    coverage: Float[Array, " K"]
    step: Float[Array, " K"]
    low: Float[Array, ""]
    high: Float[Array, ""]
    outliers: Float[Array, " K"]


class RatingLaw(NamedTuple):
    """How a panel of K raters answers: rating k is normal, but for its quirks.

    Attributes:
        centre: Mean of each rater's answers, in reward units.
        deviation: Standard deviation of each rater's answers, in reward units, >= 0; broadcasts to ``centre``.
        reach: 1 where the panel can rate, 0 where nobody ever does; None if it reaches every step.
        quirks: See ``Quirks``; None where all raters are plain.
    """

    centre: Float[Array, "*batch K"]
    deviation: Float[Array, "*#batch K"]
    reach: Float[Array, "*batch"] | None = None
    quirks: Quirks | None = None

    def at(self, *place: Any) -> RatingLaw:
        """Return the law of one state-action, or of several.

        Examples:
            >>> law = PANELS["single"].law(np.array([4.0, 0.0]), np.array([-1.0, 0.0]), np.array([True, False]))
            >>> law.at(0).centre.tolist()
            [-1.0]

        Args:
            place: One index per axis of the batch, a number or an array.
        """
        reach = None if self.reach is None else self.reach[place]
        return self._replace(centre=self.centre[place], deviation=self.deviation[place], reach=reach)


@dataclass(frozen=True)
class Panel:
    """Several raters, who are asked together.

    Examples:
        >>> panel = Panel((Rater(), Rater(noise=1.0, stars=5)), low=-2.0, high=2.0)
        >>> law = panel.law(proxy=np.array(1.0), true=np.array(1.0), contested=np.array(False))
        >>> draw(law, np.random.default_rng(0)).shape
        (2,)

    Attributes:
        raters: At least one.
        low: Lower end of the range of answers, in reward units; needed by lapses and stars only.
        high: Upper end.
    """

    raters: tuple[Rater, ...]
    low: float | None = None
    high: float | None = None

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: nobody rates, something that is no ``Rater``, or a rater who lapses or counts in stars
                without a range.
        """
        if not _checks.instance("raters", self.raters, tuple, A_PANEL):
            raise _checks.InvalidValueError("raters", self.raters, A_PANEL)
        for k, rater in enumerate(self.raters):
            _checks.instance(f"raters[{k}]", rater, Rater, "a Rater")
        ranged = any(rater.lapse > 0 or rater.stars is not None for rater in self.raters)
        if ranged and (self.low is None or self.high is None):
            allowed = "given with high: raters who lapse or count in stars answer within a range"
            raise _checks.InvalidValueError("low", self.low, allowed)
        for name in ("low", "high"):
            if getattr(self, name) is not None:
                _checks.number(name, getattr(self, name), low=-MOST, high=MOST)
        if self.low is not None and self.high is not None:
            _checks.number("high", self.high, low=self.low, open_low=True)

    def __str__(self) -> str:
        """Return the raters, in order; those who are alike and side by side together."""
        count = len(self.raters)
        groups = [(text, len(list(same))) for text, same in groupby(map(str, self.raters))]
        alike = "; ".join(text if number == 1 else f"{number} of {text}" for text, number in groups)
        return f"{count} rater{'s' * (count > 1)}: {alike}"

    def law(
        self,
        proxy: Float[Array, "*batch"],
        true: Float[Array, "*batch"],
        contested: Bool[Array, "*batch"],
        noise: Numbers = 0.0,
    ) -> RatingLaw:
        """Return how the panel answers about steps of any shape; nothing is checked.

        Args:
            proxy: Observed reward (an array of no dimensions for one step).
            true: True reward.
            contested: Whether the step is contested.
            noise: Standard deviation of extra normal noise of every rater, in reward units, >= 0.
        """
        xp = namespace(proxy, true, contested)
        centre = xp.stack([rater.centre(proxy, true) for rater in self.raters], axis=-1)
        deviation = xp.stack([_noise(rater, proxy, contested, xp) for rater in self.raters], axis=-1)
        return RatingLaw(centre, xp.sqrt(deviation**2 + noise**2), None, self._quirks())

    def _quirks(self) -> Quirks | None:
        if all(rater.plain for rater in self.raters):
            return None
        low, high = self.low or 0.0, self.high or 0.0
        width = [0.0 if r.stars is None else (high - low) / (r.stars - 1) for r in self.raters]
        lapse, coverage = [r.lapse for r in self.raters], [r.coverage for r in self.raters]
        outliers = [r.outliers for r in self.raters]
        return Quirks._make(np.array(x, np.float32) for x in (lapse, coverage, width, low, high, outliers))


def _noise(
    rater: Rater, proxy: Float[Array, "*batch"], contested: Bool[Array, "*batch"], xp: Any
) -> Float[Array, "*batch"]:
    everywhere = xp.full_like(proxy, rater.noise)
    if rater.contested_noise is None:
        return everywhere
    return xp.where(contested, xp.full_like(proxy, rater.contested_noise), everywhere)


def answers(
    law: RatingLaw, normal: Float[Array, "*batch K"], uniform: Float[Array, "*batch K 3"] | None = None
) -> tuple[Float[Array, "*batch K"], Bool[Array, "*batch K"] | None]:
    """Return one rating of every rater, and which of them exist (None: all do).

    Examples:
        >>> law = PANELS["main"].law(np.array(4.0), np.array(-1.0), np.array(True))
        >>> answers(law, np.ones(3))[0].tolist()
        [-0.9, 2.0, 2.0]

    Args:
        law: How they answer.
        normal: Standard normal numbers.
        uniform: Numbers in [0, 1), ``UNIFORMS`` = 3 for each answer; needed only if the law has quirks.
    """
    if law.quirks is None:
        return law.centre + law.deviation * normal, None
    assert uniform is not None
    xp, q = namespace(law.centre, normal, uniform), law.quirks
    # One number decides whether an answer is an outlier, or what a lapse says: no answer is both.
    noise = xp.where(uniform[..., 1] < q.outliers, OUTLIER * law.deviation, law.deviation)
    ratings = law.centre + noise * normal
    ratings = xp.where(uniform[..., 0] < q.lapse, q.low + (q.high - q.low) * uniform[..., 1], ratings)
    width = xp.where(q.step > 0, q.step, xp.ones_like(q.step))
    starred = xp.clip(q.low + width * xp.round((ratings - q.low) / width), q.low, q.high)
    return xp.where(q.step > 0, starred, ratings), uniform[..., 2] < q.coverage


def draw(law: RatingLaw, random: np.random.Generator) -> Float[np.ndarray, "*batch K"]:
    """Return one rating of every rater as NumPy numbers, NaN where a rater did not or cannot answer.

    Examples:
        >>> law = PANELS["colluding"].law(np.array([4.0, 0.0]), np.array([-1.0, 0.0]), np.array([True, False]))
        >>> draw(law, np.random.default_rng(0)).tolist()
        [[4.0, 4.0, 4.0], [0.0, 0.0, 0.0]]
    """
    shape: tuple[int, ...] = law.centre.shape
    normal = random.standard_normal(shape)
    uniform = None if law.quirks is None else random.random((*shape, UNIFORMS))
    ratings, mask = answers(law, normal, uniform)
    ratings = ratings if mask is None else np.where(mask, ratings, np.nan)
    return ratings if law.reach is None else np.where(np.asarray(law.reach)[..., None] > 0, ratings, np.nan)


# The paper gives no numbers for the first but sigma_h = 1.247, the deviation of {-1, 2, 1}. So on a contested step its
# tempted rater stands 60 % of the way from truth to proxy, the erratic one varies (sd 1) about 40 %; with -1 and +4
# that is 2 and 1. Elsewhere all three tell the truth with sd 0.1.
MAIN = Panel((Rater(), Rater(temptation=0.6, contested_noise=0.0), Rater(temptation=0.4, contested_noise=1.0)))
"""One truthful, one tempted, one erratic on contested steps (section 5.8 of the paper)."""
APPENDIX = Panel((Rater(), Rater(noise=0.3), Rater(noise=0.2, contested_noise=1.0)))
"""Three truthful ones with noise of sd 0.1, 0.3 and 0.2, the last 1.0 on contested steps (the paper's appendix)."""
COLLUDING = Panel((Rater(temptation=1.0, noise=0.0),) * 3)
"""Three who all repeat the proxy: no method that relies on them can help, a control that must fail."""
SINGLE = Panel((Rater(),))
"""One truthful rater with sd 0.1, who alone never disagrees with itself."""

PANELS: dict[str, Panel] = {"main": MAIN, "appendix": APPENDIX, "colluding": COLLUDING, "single": SINGLE}


RANGE = (-12.0, 12.0)  # of random panels' answers in stars and at random, in units of their scale
RANDOM = "random:"  # before the seed in the name of a random panel


def random_panel(seed: int, scale: float = 1.0) -> Panel:
    """Draw a panel.

    One to seven raters, the first of them truthful. Of the others one in two is truthful, one in six is drawn 20 to
    80 % of the way towards the observed reward, one in six repeats it, one in six answers at random; those who repeat
    or answer at random are fewer than half of all. Every rater has a bias (normal, sd 0.3), noise (0.1 to 2.5,
    log-uniform) and a coverage of 1, 1, 0.5 or 0.2. In one panel of three noise is six times as large in 5 % of the
    answers; in one of four all answer in seven stars.

    Examples:
        >>> print(random_panel(9))
        2 raters: noise 1.58814, bias -0.35704, coverage 0.2; noise 0.526578, bias 0.237539

    Args:
        seed: A whole number >= 0. Even ones below 1000 are for development, all others for what is reported.
        scale: Reward units in which biases, noise and ranges are measured, > 0; 1 is that of a grid whose step is -0.1
            and whose goal is 10.

    Raises:
        InvalidValueError: for a seed or a scale out of range.
    """
    _checks.whole("seed", seed, low=0)
    _checks.number("scale", scale, low=0, high=MOST, open_low=True)
    random = np.random.default_rng([seed, 1])
    raters = int(random.integers(1, 8))
    stars = 7 if random.random() < 0.25 else None
    heavy = 0.05 if random.random() < 1 / 3 else 0.0
    useless = 0
    members: list[Rater] = []
    for k in range(raters):
        kind = random.choice(["truthful", "tempted", "repeating", "spamming"], p=[1 / 2, 1 / 6, 1 / 6, 1 / 6])
        if k == 0 or (kind in ("repeating", "spamming") and 2 * (useless + 1) >= raters):
            kind = "truthful"
        useless += kind in ("repeating", "spamming")
        members.append(_rater(kind, random, scale, stars, heavy))
    return Panel(tuple(members), RANGE[0] * scale, RANGE[1] * scale)


def _rater(kind: str, random: np.random.Generator, scale: float, stars: int | None, heavy: float) -> Rater:
    bias = 0.3 * random.normal()
    noise = 0.1 * 25 ** random.random()
    share = random.uniform(0.2, 0.8)
    coverage = float(random.choice([1.0, 1.0, 0.5, 0.2]))
    if kind == "spamming":
        return Rater(lapse=1.0, coverage=coverage, stars=stars)
    return Rater(
        temptation={"truthful": 0.0, "tempted": share, "repeating": 1.0}[kind],
        bias=0.0 if kind == "repeating" else bias * scale,
        noise=noise * scale,
        coverage=coverage,
        stars=stars,
        outliers=heavy,
    )


def is_for_development(seed: int) -> bool:
    """Whether what is drawn from a seed may be tuned on: even ones below 1000. All others are for what is reported.

    Examples:
        >>> [is_for_development(seed) for seed in (998, 999, 1000)]
        [True, False, False]
    """
    return seed % 2 == 0 and seed < 1000


def random_share(seed: int) -> float:
    """Return which share of the steps a random panel's raters are asked about: 1, 1, 0.3, 0.1 or 0.03.

    Examples:
        >>> random_share(9)
        1.0
    """
    return float(np.random.default_rng([seed, 2]).choice([1.0, 1.0, 0.3, 0.1, 0.03]))


KINDS = ("truthful", "tempted", "repeating the proxy", "answering at random", "contrary", "vetoing")


def kind_of(rater: Rater) -> str:
    """Return which of ``KINDS`` a rater is: what matters most of it.

    Examples:
        >>> kind_of(Rater(bias=2.0)), kind_of(Rater(temptation=0.5)), kind_of(Rater(scale=-1.0))
        ('truthful', 'tempted', 'contrary')
    """
    truthful, tempted, repeating, spamming, contrary, vetoing = KINDS
    if rater.lapse == 1:
        return spamming
    if rater.scale < 0:
        return contrary
    if rater.veto_above is not None:
        return vetoing
    return repeating if rater.temptation == 1 else tempted if rater.temptation > 0 else truthful


def composition(panel: Panel) -> str:
    """Say in one line who sits in a panel: kinds, and the ranges of noise, bias and coverage.

    Examples:
        >>> composition(random_panel(9))
        '2 raters: 2 truthful; noise 0.527 to 1.59; bias -0.357 to 0.238; coverage 0.2 to 1'
        >>> composition(MAIN)
        '3 raters: 1 truthful, 2 tempted; noise 0.1'
    """
    kinds = [kind_of(rater) for rater in panel.raters]
    who = ", ".join(f"{kinds.count(kind)} {kind}" for kind in KINDS if kind in kinds)
    parts = [f"{len(kinds)} rater{'s' * (len(kinds) > 1)}: {who}"]
    for name, usual in (("noise", None), ("bias", 0.0), ("coverage", 1.0)):
        values = sorted(getattr(r, name) for r in panel.raters if r.lapse < 1 or name == "coverage")
        if values and values != [usual] * len(values):
            low, high = f"{values[0]:.3g}", f"{values[-1]:.3g}"
            parts.append(f"{name} {low}" if low == high else f"{name} {low} to {high}")
    if any(r.outliers for r in panel.raters):
        parts.append("with outliers")
    if stars := {r.stars for r in panel.raters if r.stars}:
        parts.append(f"{' or '.join(map(str, sorted(stars)))} stars")
    return "; ".join(parts)


def as_panel(panel: str | Panel) -> Panel:
    """Return the panel of a name, or the panel itself; ``random:7`` is ``random_panel(7)``.

    ``random:7:0.3`` is ``random_panel(7, scale=0.3)``.

    Examples:
        >>> as_panel("single") is SINGLE and as_panel(SINGLE) is SINGLE
        True
        >>> as_panel("random:7") == random_panel(7)
        True

    Raises:
        UnknownNameError: with the nearest name.
        InvalidValueError: a random panel whose seed is no whole number, or whose scale is no number > 0.
    """
    if isinstance(panel, Panel):
        return panel
    if str(panel).startswith(RANDOM):
        seed, *scale = panel.removeprefix(RANDOM).split(":", 1)
        number = re.fullmatch(r"[0-9]{1,6}(\.[0-9]{1,9})?", scale[0]) if scale else None
        positive = not scale or (number is not None and float(scale[0]) > 0)
        if not (seed.isascii() and seed.isdecimal() and len(seed) < 20 and positive):
            allowed = f"{RANDOM}SEED or {RANDOM}SEED:SCALE, a whole number of at most 19 digits and a number > 0"
            raise _checks.InvalidValueError("panel", panel, allowed)
        return random_panel(int(seed), *map(float, scale))
    return PANELS[_checks.choose("panel", panel, [*PANELS, f"{RANDOM}SEED"])]
