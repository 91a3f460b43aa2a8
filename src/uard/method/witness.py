"""Whom to believe (experimental): if the reward lies, which rater tells the truth?

A generative model of what raters k = 1..K say of a state-action on average, z_k, each with an error of variance v_k:

* with probability 1 - pi the reward r is honest, and each rater says N(r, v_k), or with probability ``stray`` anything;
* else it over-reports (a share phi of lies) or under-reports, and *one rater tells the truth* R. Each other rater tells
  it, too, or errs with probability ``errs``: half of these repeat the reward, half say something between the truth and
  the largest thing that is said. Nobody errs away from the reward.

pi and phi are learned by expectation maximisation over distinct rated state-actions. What is learned is the posterior
mean less ``risk`` posterior standard deviations. Three kinds of panels broke this model when they were first met;
``uard.method.pooled`` is the rule that is recommended. Pure functions of NumPy, JAX or torch arrays.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

from uard.method import rater_statistics
from uard.method.arrays import Array, Numbers, namespace
from uard.method.feedback import ByRater
from uard.method.pooled import LARGEST_ODDS
from uard.method.rater_statistics import RaterStatistics, masked_median
from uard.method.uncertainty import root

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

AWAY = 1e-12  # times the chance of a stray rating: a rater who errs away from the reward
ROUNDS = 15  # of expectation maximisation
LIES_WORTH, OVER_WORTH = 2.0, 5.0  # state-actions, or lies, that the prior shares are worth
FEWEST = 3  # state-actions from which it is judged whether a rater's answers depend on what is rated
TABLE = 2**21  # entries of the largest array of hypotheses times raters; of more, some hypotheses come after others
ROUNDING = 1e-6  # of the range: no closer than this, one number lies on no side of another
NEVER = -1e30  # logarithm of the likelihood of a hypothesis that is not there
_ERFC = (
    0.00819275584, 0.129908998, -0.735104204, 1.38610644, -1.06239728, 0.246833129, -0.17770727, 0.0954640677,
    0.374195094, 1.00002055, -1.26551221,
)  # fmt: skip


class Prior(NamedTuple):
    """What is believed of any panel before it is met.

    Attributes:
        lies: Share of state-actions whose reward lies, in (0, 1).
        over: Share of these at which it says too much, in (0, 1).
        errs: Chance that a rater errs where the reward lies, in (0, 1).
        stray: Chance that a rater is simply wrong, > 0, and less than 1 with ``errs``. The larger, the less one
            dissenter counts.
        slack: By which share of an unusual truth a rater may be off without a reason, >= 0.
        risk: How many posterior standard deviations are taken off, >= 0.
    """

    lies: Numbers = 0.2
    over: Numbers = 0.9
    errs: Numbers = 0.3
    stray: Numbers = 1e-4
    slack: Numbers = 0.1
    risk: Numbers = 0.5


PRIOR = Prior()


class WitnessStatistics(NamedTuple):
    """What is known of a panel of K raters, in reward units.

    Attributes:
        raters: Noise, bias, idiosyncrasy and the like.
        attention: In (0, 1]: the less a rater's answers depend on what is rated, the lower; divides the variance.
        lowest: What is ever said or observed, without biases.
        highest: Likewise.
        lies: Share of state-actions whose reward lies, as learned.
        over: Share of these at which it says too much, as learned.
        usual: Median of what is learned over rated state-actions.
    """

    raters: RaterStatistics
    attention: Float[Array, " K"]
    lowest: Float[Array, ""]
    highest: Float[Array, ""]
    lies: Float[Array, ""]
    over: Float[Array, ""]
    usual: Float[Array, ""]


class Hypotheses(NamedTuple):
    """Likelihoods, up to a factor per state-action: the reward is honest; or it lies, and rater j tells the truth.

    Attributes:
        honest: Logarithm, of an honest reward.
        lie: Logarithm, of a lie of which rater j tells the truth; ``NEVER`` for a rater who is not heard.
        truth: What is then true.
        variance: Of that truth.
        over: Whether the reward then says too much.
    """

    honest: Float[Array, "*batch"]
    lie: Float[Array, "*batch K"]
    truth: Float[Array, "*batch K"]
    variance: Float[Array, "*batch K"]
    over: Bool[Array, "*batch K"]


class Belief(NamedTuple):
    """What is believed of some state-actions.

    Attributes:
        weight: Posterior probability that the reward is honest.
        anchor: Posterior mean of the truth if it is not.
        deviation: Posterior standard deviation of the truth.
        learned: Posterior mean less a premium for that deviation.
    """

    weight: Float[Array, "*batch"]
    anchor: Float[Array, "*batch"]
    deviation: Float[Array, "*batch"]
    learned: Float[Array, "*batch"]


def fit(
    reward: Float[Array, " n"], by_rater: ByRater, rated: Bool[Array, " n"], prior: Prior = PRIOR
) -> WitnessStatistics:
    """Measure a panel, and how often the reward lies.

    Examples:
        >>> import numpy as np
        >>> reward = np.array([4.0] + 9 * [-0.1])
        >>> said = np.array([[-1.0, 2.0, 4.0]] + 9 * [[-0.1, -0.1, -0.1]])
        >>> panel = fit(reward, ByRater(np.ones((10, 3)), said, np.zeros((10, 3))), np.ones(10, bool))
        >>> float(panel.lies.round(2)), float(panel.over.round(2))  # (2 * 0.2 + 1) / (2 + 10), (5 * 0.9 + 1) / (5 + 1)
        (0.12, 0.92)

    Args:
        reward: Mean observed reward of each distinct state-action.
        by_rater: What each rater has said of it, (n, K) arrays.
        rated: Which of them anybody has rated.
        prior: What is believed before.
    """
    xp = namespace(by_rater.mean)
    reward, by_rater, rated = rater_statistics.thinned(reward, by_rater, rated)
    raters = rater_statistics.fit(reward, by_rater, rated)
    said, here = by_rater.mean - raters.bias, (by_rater.count > 0) & rated[:, None]
    known = xp.where(rated, reward, raters.typical)[:, None]
    every = xp.concat([known, xp.where(here, said, known)], axis=-1)
    number, zero = xp.sum(xp.astype(rated, said.dtype)), 0.0 * raters.scale
    panel = WitnessStatistics(
        raters,
        attention(by_rater, here, raters),
        xp.min(every),
        xp.max(every),
        zero + prior.lies,
        zero + prior.over,
        zero,
    )
    seen = hypotheses(reward, by_rater, panel, prior)
    too_much, too_little = (
        _log_sum(xp.where(side, seen.lie, NEVER + 0.0 * seen.lie)) for side in (seen.over, ~seen.over)
    )
    for _ in range(ROUNDS):
        share = _shares(
            xp.log(1.0 - panel.lies) + seen.honest,
            xp.log(panel.lies * panel.over) + too_much,
            xp.log(panel.lies * (1.0 - panel.over)) + too_little,
        )
        over, under = (xp.sum(xp.where(rated, x, 0.0 * x)) for x in share[1:])
        panel = panel._replace(
            lies=(LIES_WORTH * prior.lies + over + under) / (LIES_WORTH + number),
            over=(OVER_WORTH * prior.over + over) / (OVER_WORTH + over + under),
        )
    return panel._replace(usual=masked_median(believe(reward, seen, panel, prior.risk).learned, rated))


def of_raters(panel: WitnessStatistics, raters: int) -> WitnessStatistics:
    """Return the statistics of the first raters; one who was not there when they were measured is a usual one.

    Examples:
        >>> import numpy as np
        >>> one = fit(np.arange(5.0), ByRater(np.ones((5, 1)), np.ones((5, 1)), np.zeros((5, 1))), np.ones(5, bool))
        >>> of_raters(one, 3).attention.tolist()
        [1.0, 1.0, 1.0]

    Args:
        panel: Statistics.
        raters: How many are there now.
    """
    xp, known = namespace(panel.attention), panel.attention.shape[0]
    more = [xp.ones_like(panel.attention[:1])] * (raters - known)
    attention = xp.concat([panel.attention[:raters], *more])
    return panel._replace(raters=rater_statistics.of_raters(panel.raters, raters), attention=attention)


def attention(by_rater: ByRater, here: Bool[Array, "n K"], raters: RaterStatistics) -> Float[Array, " K"]:
    """Return how far each rater's answers depend on what is rated, compared with the median rater's, in [1e-4, 1].

    That is an upper bound of the variance of what the rater means of different state-actions, over the median rater's
    variance: of one who answers at random, nothing is left once noise is taken off.

    Examples:
        >>> import numpy as np
        >>> means = np.arange(100.0)[:, None] * [1.0, 1.0, 0.0]  # the third says 0 of everything
        >>> by_rater = ByRater(np.ones((100, 3)), means, np.zeros((100, 3)))
        >>> raters = rater_statistics.fit(means[:, 0], by_rater, np.ones(100, bool))
        >>> attention(by_rater, np.ones((100, 3), bool), raters).round(2).tolist()
        [1.0, 1.0, 0.0]

    Args:
        by_rater: What each rater has said of each distinct state-action.
        here: Where they have said anything.
        raters: Their statistics.
    """
    xp = namespace(by_rater.mean)
    one, zero = xp.ones_like(by_rater.mean), xp.zeros_like(by_rater.mean)
    error = raters.noise / xp.where(here, by_rater.count, one)
    weight, said = xp.where(here, 1.0 / (error + raters.scale**2), zero), xp.where(here, by_rater.mean, zero)
    total, answered = xp.sum(weight, axis=0), xp.sum(xp.astype(here, said.dtype), axis=0)
    safe = xp.where(total > 0, total, xp.ones_like(total))
    gap = said - xp.sum(weight * said, axis=0) / safe
    enough = answered >= FEWEST
    between = xp.where(enough, xp.sum(weight * (gap * gap - error), axis=0) / safe, 0.0 * safe)
    bound = between + 2.0 * xp.sqrt(2.0 * xp.sum(weight**2 * error**2, axis=0)) / safe
    usual = masked_median(xp.maximum(between, 0.0 * between), answered > 0)
    judged = enough & (usual > 0)
    return xp.where(judged, xp.clip(bound / xp.where(usual > 0, usual, usual + 1.0), 1e-4, 1.0), xp.ones_like(safe))


def hypotheses(
    reward: Float[Array, "*batch"], by_rater: ByRater, panel: WitnessStatistics, prior: Prior = PRIOR
) -> Hypotheses:
    """Return how likely it is what raters say under each hypothesis.

    Examples:
        >>> import numpy as np
        >>> reward = np.array([4.0] + 9 * [-0.1])
        >>> said = np.array([[-1.0, 2.0, 4.0]] + 9 * [[-0.1, -0.1, -0.1]])
        >>> by_rater = ByRater(np.ones((10, 3)), said, np.zeros((10, 3)))
        >>> seen = hypotheses(reward, by_rater, fit(reward, by_rater, np.ones(10, bool)))
        >>> seen.truth[0].round(1).tolist(), bool(seen.lie[0].max() > seen.honest[0])
        ([-1.0, -1.0, 2.5], True)

    Args:
        reward: Observed.
        by_rater: What each rater has said here.
        panel: Its statistics.
        prior: Its chances of errors, and the slack.
    """
    xp, raters = namespace(by_rater.mean), panel.raters
    here, r = (by_rater.count > 0) & (raters.heard > 0), reward[..., None]
    variance = rater_statistics.error_of_means(by_rater, raters) / panel.attention
    variance = xp.where(here, variance, xp.ones_like(variance))
    said = xp.where(here, by_rater.mean - raters.bias, r)
    width = panel.highest - panel.lowest + raters.scale
    off = prior.slack * (r - raters.typical)
    honest_variance = variance + off * off + raters.floor
    repeats = _density(said - r, honest_variance)
    honest = _log_product((1.0 - prior.stray) * repeats + prior.stray / width, here)
    each = _Said(said, here, variance, repeats, r, xp.maximum(r, xp.max(said, axis=-1, keepdims=True)), width)
    size, number = max(1, math.prod(said.shape)), said.shape[-1]
    step = max(1, min(number, TABLE // size))
    parts = [
        _truthful(said[..., k : k + step, None], variance[..., k : k + step, None], each, panel, prior)
        for k in range(0, number, step)
    ]
    log, truth, spread, agree = (xp.concat([part[i] for part in parts], axis=-1) for i in range(4))
    over = truth < r
    room = xp.where(over, r - panel.lowest, panel.highest - r)
    density = 1.0 / (xp.maximum(room, 0.0 * room) + raters.scale)
    log = log + xp.log(density * xp.sqrt(2.0 * math.pi * spread) / xp.maximum(agree, xp.ones_like(agree)))
    knows = here & (12.0 * variance <= width * width)  # more exact than one who says anything in the range
    return Hypotheses(honest, xp.where(knows, log, NEVER + 0.0 * log), truth, spread, over)


def believe(reward: Float[Array, "*batch"], seen: Hypotheses, panel: WitnessStatistics, risk: Numbers = 0.5) -> Belief:
    """Weigh the hypotheses.

    Examples:
        >>> import numpy as np
        >>> reward = np.array([4.0] + 9 * [-0.1])
        >>> said = np.array([[-1.0, 2.0, 4.0]] + 9 * [[-0.1, -0.1, -0.1]])
        >>> by_rater = ByRater(np.ones((10, 3)), said, np.zeros((10, 3)))
        >>> panel = fit(reward, by_rater, np.ones(10, bool))
        >>> belief = believe(reward, hypotheses(reward, by_rater, panel), panel)
        >>> belief.weight[:2].round(2).tolist(), bool(belief.learned[0] < -0.9)
        ([0.0, 1.0], True)

    Args:
        reward: Observed.
        seen: Likelihoods.
        panel: Its shares of lies.
        risk: How many posterior standard deviations are taken off, >= 0.
    """
    xp = namespace(reward)
    side = xp.log(xp.where(seen.over, panel.over + 0.0 * seen.lie, 1.0 - panel.over + 0.0 * seen.lie))
    lies = seen.lie + side
    total = _log_sum(lies)
    some = total > 0.5 * NEVER
    share = xp.where(some[..., None], xp.exp(lies - total[..., None]), 0.0 * lies)
    anchor = xp.where(some, xp.sum(share * seen.truth, axis=-1), reward)
    variance = xp.sum(share * ((seen.truth - anchor[..., None]) ** 2 + seen.variance), axis=-1)
    odds = xp.log(panel.lies / (1.0 - panel.lies)) + total - seen.honest
    odds = xp.where(some, xp.clip(odds, -LARGEST_ODDS, LARGEST_ODDS), 0.0 * odds)
    weight = xp.where(some, 1.0 / (1.0 + xp.exp(odds)), 1.0 + 0.0 * odds)
    lie = xp.where(some, 1.0 / (1.0 + xp.exp(-odds)), 0.0 * odds)  # 1 - w without rounding
    deviation = root(weight * lie * (reward - anchor) ** 2 + lie * variance)
    return Belief(weight, anchor, deviation, anchor + weight * (reward - anchor) - risk * deviation)


class _Said(NamedTuple):
    """What is the same under all hypotheses of some state-actions; the last axis is that of the raters."""

    said: Float[Array, "*batch K"]
    here: Bool[Array, "*batch K"]
    variance: Float[Array, "*batch K"]
    repeats: Float[Array, "*batch K"]
    reward: Float[Array, "*batch 1"]
    top: Float[Array, "*batch 1"]
    width: Numbers


def _truthful(
    truth: Array, spread: Array, each: _Said, panel: WitnessStatistics, prior: Prior
) -> tuple[Array, Array, Array, Array]:
    """Return log-likelihood, truth, its variance and how many agree, if each of J raters tells the truth: (..., J).

    ``truth`` and ``spread`` are what they say and its variance, (..., J, 1).
    """
    xp = namespace(truth)
    said, here, variance, repeats, r, top = (x[..., None, :] for x in each[:-1])
    agree, right = xp.ones_like(truth), 1.0 - prior.errs - prior.stray

    def likelihood(truth: Array) -> tuple[Array, Array, Array]:
        off = prior.slack * (truth - panel.raters.typical)
        v = variance + off * off
        low, high = xp.where(truth < r, truth, r), xp.where(truth < r, top, truth)
        errs = 0.5 * _uniform(said, xp.sqrt(v), low, high) + 0.5 * repeats
        beyond = xp.where(r > truth, truth - said, said - truth)
        away = beyond > ROUNDING * each.width
        stray = xp.where(away, AWAY + 0.0 * v, 1.0 + 0.0 * v) * prior.stray / each.width
        tells = right * _density(said - truth, v)
        return tells, tells + prior.errs * errs + stray, v

    for _ in range(2):  # the truth is what all say who agree with them
        tells, every, v = likelihood(truth)
        agrees = xp.where(here, tells / every, 0.0 * v)
        number, precision = (xp.sum(x, axis=-1, keepdims=True) for x in (agrees, agrees / v))
        some = number > 1e-6
        safe = xp.where(some, precision, xp.ones_like(precision))
        truth = xp.where(some, xp.sum(agrees / v * said, axis=-1, keepdims=True) / safe, truth)
        spread, agree = xp.where(some, 1.0 / safe, spread), xp.where(some, number, agree)
    log = _log_product(likelihood(truth)[1], here)
    return log, truth[..., 0], spread[..., 0], agree[..., 0]


def _density(distance: Array, variance: Array) -> Array:
    """Return the normal density."""
    xp = namespace(distance)
    return xp.exp(-0.5 * distance * distance / variance) / xp.sqrt(2.0 * math.pi * variance)


def _uniform(said: Array, sd: Array, low: Array, high: Array) -> Array:
    """Return the density of a number that is uniform between two others, and said with a normal error."""
    xp = namespace(said)
    a, b = (low - said) / sd, (high - said) / sd
    flipped = a + b > 0  # differences are taken in the lower tail, where they lose no digits
    a, b = xp.where(flipped, -b, a), xp.where(flipped, -a, b)
    wide = b - a > 0.01
    width = xp.where(wide, high - low, sd)
    return xp.where(wide, (_below(b) - _below(a)) / width, _density((0.5 * (a + b)) * sd, sd * sd))


def _below(x: Array) -> Array:
    """Return the normal distribution function, within 1e-7 of its value: log(erfc(z) exp(z^2) / t) as a polynomial.

    t = 1 / (1 + z / 2), z = |x| / sqrt(2); the coefficients interpolate at Chebyshev's points.
    """
    xp = namespace(x)
    z = abs(x) / math.sqrt(2.0)
    t = 1.0 / (1.0 + 0.5 * z)
    series = 0.0 * t
    for coefficient in _ERFC:
        series = series * t + coefficient
    tail = 0.5 * t * xp.exp(series - z * z)
    return xp.where(x < 0, tail, 1.0 - tail)


def _log_product(density: Array, mask: Array) -> Array:
    """Return the logarithm of the product over raters who are heard; a density is positive where they are."""
    xp = namespace(density)
    return xp.sum(xp.log(xp.where(mask, density, xp.ones_like(density))), axis=-1)


def _log_sum(logs: Array) -> Array:
    """Return the logarithm of the sum over the last axis, ``NEVER`` or less where nothing is there."""
    xp = namespace(logs)
    largest = xp.max(logs, axis=-1, keepdims=True)
    return largest[..., 0] + xp.log(xp.sum(xp.exp(logs - largest), axis=-1))


def _shares(*logs: Array) -> list[Any]:
    """Return the shares of the exponentials of some logarithms in their sum."""
    xp = namespace(*logs)
    total = _log_sum(xp.stack(logs, axis=-1))
    return [xp.exp(x - total) for x in logs]
