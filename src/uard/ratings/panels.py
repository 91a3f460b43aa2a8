"""Panels of raters: what each of K people says of a step.

A simulated rater sees the observed reward (the proxy), the true reward and whether the step is *contested* (one that
pays for something else than what was meant, such as entering a trap), and answers with a number. In a legitimate twin
the two rewards agree, but the contested steps stay contested. A panel reads the truth, as people do; the learner gets
nothing but the ratings.

What a panel says of a step is a law, and an answer is drawn from it:

    >>> import numpy as np
    >>> law = PANELS["main"].law(np.array(4.0), np.array(-1.0), np.array(True))
    >>> law.centre.tolist(), law.deviation.tolist()
    ([-1.0, 2.0, 1.0], [0.1, 0.0, 1.0])
    >>> answers(law, np.zeros(3))[0].tolist()
    [-1.0, 2.0, 1.0]
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from uard import _checks
from uard.method.arrays import Array, namespace

UNIFORMS = 3  # uniform numbers that an answer needs of a rater who lapses, skips steps or counts in stars


@dataclass(frozen=True)
class Rater:
    """How one simulated rater answers: scale (true + temptation (proxy - true)) + bias + noise.

    Attributes:
        temptation: How far the rater is drawn from the truth towards the proxy, in [0, 1]; 1 repeats the proxy.
        bias: Added to every rating, in reward units.
        scale: Every rating is multiplied by this, > 0.
        noise: Standard deviation of normal noise, in reward units, >= 0.
        contested_noise: The same on contested steps; ``noise`` if left out.
        lapse: Chance that an answer does not depend on the step: uniform over the panel's range.
        coverage: Share of the steps put to the panel that the rater answers, in (0, 1].
        stars: Answers are rounded to so many levels, evenly spaced over the panel's range, >= 2; not rounded if left
            out.
    """

    temptation: float = 0.0
    bias: float = 0.0
    scale: float = 1.0
    noise: float = 0.1
    contested_noise: float | None = None
    lapse: float = 0.0
    coverage: float = 1.0
    stars: int | None = None

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.number("temptation", self.temptation, low=0, high=1)
        _checks.number("bias", self.bias)
        _checks.number("scale", self.scale, low=0, open_low=True)
        _checks.number("noise", self.noise, low=0)
        if self.contested_noise is not None:
            _checks.number("contested_noise", self.contested_noise, low=0)
        _checks.number("lapse", self.lapse, low=0, high=1)
        _checks.number("coverage", self.coverage, low=0, high=1, open_low=True)
        if self.stars is not None:
            _checks.whole("stars", self.stars, low=2, high=1000)

    @property
    def plain(self) -> bool:
        """Whether every answer is normal: no lapses, nothing skipped, no stars."""
        return self.lapse == 0 and self.coverage == 1 and self.stars is None

    def centre(self, proxy: Array, true: Array) -> Array:
        """Return the rater's mean answer."""
        # A rater who repeats the proxy repeats it to the bit.
        seen = proxy if self.temptation == 1 else true + self.temptation * (proxy - true)
        return seen if self.scale == 1 and self.bias == 0 else self.scale * seen + self.bias


class Quirks(NamedTuple):
    """What makes answers other than normal: (K,) chance of a lapse, coverage, width of a star (0: none); the range."""

    lapse: Array
    coverage: Array
    step: Array
    low: Array
    high: Array


class RatingLaw(NamedTuple):
    """How a panel answers: rating k is normal with (..., K) ``centre`` and ``deviation``, but for its quirks.

    Attributes:
        centre: In reward units.
        deviation: In reward units, >= 0.
        reach: (...), 1 where the panel can rate, 0 where nobody ever does; None if it reaches every step.
        quirks: See ``Quirks``; None where all raters are plain.
    """

    centre: Array
    deviation: Array
    reach: Array | None = None
    quirks: Quirks | None = None

    def at(self, *place: Array) -> RatingLaw:
        """Return the law of one state-action, or of several."""
        reach = None if self.reach is None else self.reach[place]
        return self._replace(centre=self.centre[place], deviation=self.deviation[place], reach=reach)


@dataclass(frozen=True)
class Panel:
    """Several raters, who are asked together.

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
        if not isinstance(self.raters, tuple) or not self.raters:
            raise _checks.InvalidValueError("raters", self.raters, "a tuple of one Rater or more")
        for k, rater in enumerate(self.raters):
            if not isinstance(rater, Rater):
                raise _checks.InvalidValueError(f"raters[{k}]", rater, "a Rater")
        if self.low is None or self.high is None:
            if any(rater.lapse > 0 or rater.stars is not None for rater in self.raters):
                allowed = "given with high: raters who lapse or count in stars answer within a range"
                raise _checks.InvalidValueError("low", self.low, allowed)
        else:
            _checks.number("low", self.low)
            _checks.number("high", self.high, low=self.low, open_low=True)

    def law(self, proxy: Array, true: Array, contested: Array, noise: Array = 0.0) -> RatingLaw:
        """Return how the panel answers about steps of any shape; nothing is checked.

        Args:
            proxy: Observed reward, an array of floats (one of no dimensions for one step).
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
        columns = [r.lapse for r in self.raters], [r.coverage for r in self.raters], width
        lapse, coverage, step = (np.array(c, np.float32) for c in columns)
        return Quirks(lapse, coverage, step, np.float32(low), np.float32(high))


def _noise(rater: Rater, proxy: Array, contested: Array, xp: Any) -> Array:
    everywhere = xp.full_like(proxy, rater.noise)
    if rater.contested_noise is None:
        return everywhere
    return xp.where(contested, xp.full_like(proxy, rater.contested_noise), everywhere)


def answers(law: RatingLaw, normal: Array, uniform: Array | None = None) -> tuple[Array, Array | None]:
    """Return one rating of every rater (..., K), and which of them exist (None: all do).

    Args:
        law: How they answer.
        normal: (..., K) standard normal numbers.
        uniform: (..., K, ``UNIFORMS``) numbers in [0, 1); needed only if the law has quirks.
    """
    ratings = law.centre + law.deviation * normal
    if law.quirks is None:
        return ratings, None
    assert uniform is not None
    xp, q = namespace(ratings, uniform), law.quirks
    ratings = xp.where(uniform[..., 0] < q.lapse, q.low + (q.high - q.low) * uniform[..., 1], ratings)
    width = xp.where(q.step > 0, q.step, xp.ones_like(q.step))
    starred = xp.clip(q.low + width * xp.round((ratings - q.low) / width), q.low, q.high)
    return xp.where(q.step > 0, starred, ratings), uniform[..., 2] < q.coverage


def draw(law: RatingLaw, random: np.random.Generator) -> np.ndarray:
    """Return one rating of every rater (..., K) as NumPy numbers, NaN where a rater did not or cannot answer."""
    normal = random.standard_normal(law.centre.shape)
    uniform = None if law.quirks is None else random.random((*law.centre.shape, UNIFORMS))
    ratings, mask = answers(law, normal, uniform)
    ratings = ratings if mask is None else np.where(mask, ratings, np.nan)
    return ratings if law.reach is None else np.where(np.asarray(law.reach)[..., None] > 0, ratings, np.nan)


# The paper gives no numbers for the first but sigma_h = 1.247, the deviation of {-1, 2, 1}. So on a contested step its
# tempted rater stands 60 % of the way from truth to proxy, the erratic one varies (sd 1) about 40 %; with -1 and +4
# that is 2 and 1. Elsewhere all three tell the truth with sd 0.1.
MAIN = Panel((Rater(), Rater(temptation=0.6, contested_noise=0.0), Rater(temptation=0.4, contested_noise=1.0)))
APPENDIX = Panel((Rater(), Rater(noise=0.3), Rater(noise=0.2, contested_noise=1.0)))
COLLUDING = Panel((Rater(temptation=1.0, noise=0.0),) * 3)
SINGLE = Panel((Rater(),))

PANELS: dict[str, Panel] = {"main": MAIN, "appendix": APPENDIX, "colluding": COLLUDING, "single": SINGLE}
DESCRIPTIONS: dict[str, str] = {
    "main": "One truthful, one tempted, one erratic on contested steps (section 5.8 of the paper).",
    "appendix": "Three truthful ones with noise of sd 0.1, 0.3 and 0.2, the last 1.0 where contested (its appendix).",
    "colluding": "Three who all repeat the proxy: no method that listens to them can help, a control that must fail.",
    "single": "One truthful rater with sd 0.1, who alone never disagrees with itself.",
}


def as_panel(panel: str | Panel) -> Panel:
    """Return the panel of a name, or the panel itself.

    Raises:
        UnknownNameError: with the nearest name.
    """
    return panel if isinstance(panel, Panel) else PANELS[_checks.choose("panel", panel, PANELS)]


def name_of(panel: Panel) -> str:
    """Return a panel's name if it has one, else what it is."""
    return next((name for name, other in PANELS.items() if other == panel), str(panel))
