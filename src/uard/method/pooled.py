"""The pooled rule: is every rater centred at the reward, or do raters scatter about a truth of their own?

Of a state-action with observed reward r, raters k = 1..K have said z_k on average, each with an error of variance v_k.
Two hypotheses explain it:

* *centred*: the reward tells the truth, so z_k ~ N(r, v_k);
* *apart*: it does not; z_k ~ N(m, v_k + tau^2) about a truth m that may be anything within the span of what is ever
  said. tau^2, by which raters differ beyond their own errors, is DerSimonian and Laird's [1986], and m is marginalised
  by Laplace's approximation.

With a prior share of lies, the weight is the posterior of the first, w = 1 / (1 + odds): the paper's reciprocal filter,
whose doubt is now the odds that the reward lies. What is learned is drawn towards a cautious pool of what raters say.
The statistics of the panel (who is how noisy, biased, idiosyncratic) are ``uard.method.rater_statistics``.

Pure functions of NumPy, JAX or torch arrays. Nothing here reads a value estimate, so that with any weights the Bellman
operator on what is learned is a contraction (Theorem 1).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from uard.method.arrays import Array, Numbers, all_true, dot, least, namespace, total
from uard.method.feedback import ByRater
from uard.method.rater_statistics import RaterStatistics, error_of_means
from uard.method.uncertainty import root

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

LARGEST_ODDS = 50.0  # of their logarithm: beyond it a weight is 0 or 1 in any precision
OUTLIER = 3.0  # standard deviations from what the others say, beyond which a rater dissents
EXPERT = 2.0  # times more precise than the others: then a lone dissenter is no veto
FEWEST = 5  # raters at a state-action among whom one dissenter may be overruled; each further one needs two more


class Pool(NamedTuple):
    """What raters say together of some state-actions, in reward units.

    Attributes:
        heard: Number of raters who count.
        centre: Their pooled mean under *apart*.
        tau: By how much they differ beyond their own errors, a standard deviation: sigma_h.
        error: Standard error of ``centre``; 0 where nobody is heard.
        lowest: The least that any of them says.
        log_odds: Logarithm of the odds of *apart* against *centred* without the prior, 0 where nobody is heard.
    """

    heard: Float[Array, "*batch"]
    centre: Float[Array, "*batch"]
    tau: Float[Array, "*batch"]
    error: Float[Array, "*batch"]
    lowest: Float[Array, "*batch"]
    log_odds: Float[Array, "*batch"]


def errors(
    reward: Float[Array, "*batch"], by_rater: ByRater, statistics: RaterStatistics, slack: Numbers
) -> Float[Array, "*batch K"]:
    """Return the variance v_k of each rater's mean about a reward that tells the truth, in squared reward units.

    It is that about what the rater means (``rater_statistics.error_of_means``), another floor, for the reward's mean is
    no more exact, and a slack that grows with how unusual the reward is.

    Examples:
        >>> import numpy as np
        >>> from uard.method import rater_statistics
        >>> reward = np.array([0.0, 0.0, 10.0])
        >>> twice = ByRater(np.full((3, 1), 2.0), reward[:, None], np.full((3, 1), 0.5))
        >>> statistics = rater_statistics.fit(reward, twice, np.ones(3, bool))
        >>> errors(reward, twice, statistics, slack=0.1).round(2).tolist()
        [[0.24], [0.24], [1.24]]

    Args:
        reward: Observed.
        by_rater: What each rater has said here.
        statistics: Of the panel.
        slack: By which share of an unusual reward a rater may be off without a reason, >= 0.
    """
    off = slack * (reward - statistics.typical)
    return error_of_means(by_rater, statistics) + statistics.floor + (off * off)[..., None]


def pool(
    reward: Float[Array, "*batch"],
    said: Float[Array, "*batch K"],
    here: Bool[Array, "*batch K"],
    variance: Float[Array, "*batch K"],
    span: Numbers,
) -> Pool:
    """Weigh the two hypotheses against each other.

    Examples:
        >>> import numpy as np
        >>> said, here, variance = np.array([[2.0, 4.0]]), np.ones((1, 2), bool), np.ones((1, 2))
        >>> pooled = pool(np.array([3.0]), said, here, variance, span=10.0)
        >>> pooled.centre.tolist(), pooled.tau.tolist(), pooled.error.round(3).tolist()
        ([3.0], [1.0], [1.0])

    Args:
        reward: Observed.
        said: Each rater's mean without the rater's bias; may hold anything where nobody was heard.
        here: Who is heard.
        variance: Of each rater's error, > 0.
        span: Within how wide a range truths lie, > 0.
    """
    xp = namespace(said)
    sums = _sums(said, reward, here, variance)
    tau2 = _variance_between(sums)
    shrunk = 1.0 + tau2[..., None] * sums.weight
    weight = sums.weight / shrunk  # 1 / (v + tau^2)
    first = weight * sums.gap
    second = sums.first - first
    precision, first = total(weight), total(first)
    anybody = precision > 0
    determinants = total(xp.log(shrunk)) + xp.log(1.0 + span * span * precision)
    precision = _where(anybody, precision, 1.0)
    gap = first / precision
    # Both hypotheses' squares are about the reward: those about the centre are precision * gap^2 less.
    squares = dot(second, sums.gap) + first * gap
    return Pool(
        heard=sums.heard,
        centre=_where(anybody, reward + gap, 0.0),
        tau=root(tau2),
        error=_where(anybody, 1.0 / xp.sqrt(precision), 0.0),
        lowest=_where(anybody, reward + least(_where(here, sums.gap, xp.inf)), 0.0),
        log_odds=_where(anybody, 0.5 * (squares - determinants), 0.0),
    )


def variance_between(
    said: Float[Array, "*batch K"], here: Bool[Array, "*batch K"], variance: Float[Array, "*batch K"]
) -> Float[Array, "*batch"]:
    """Return tau^2, the variance of raters about each other beyond their own errors [DerSimonian and Laird 1986].

    Examples:
        >>> import numpy as np
        >>> variance_between(np.array([[2.0, 4.0]]), np.ones((1, 2), bool), np.ones((1, 2))).tolist()
        [1.0]

    Args:
        said: What each rater says.
        here: Who is heard.
        variance: Of each rater's error, > 0.
    """
    return _variance_between(_sums(said, precise_mean(said, here, variance), here, variance))


def overruled(
    said: Float[Array, "*batch K"],
    here: Bool[Array, "*batch K"],
    variance: Float[Array, "*batch K"],
    noise: Float[Array, " K"],
    vetoes: int,
) -> Bool[Array, "*batch K"]:
    """Return who is still heard after so many vetoes were overruled.

    A veto is the lowest word of five raters or more (seven for a second, and so on) that is three standard deviations
    below what the others say, as they differ, from somebody who is no more precise than they are: a lone expert is
    heard, one who merely hates something is not.

    Examples:
        >>> import numpy as np
        >>> said, here = np.array([[10.0, 10.0, 10.0, 10.0, -3.0]]), np.ones((1, 5), bool)
        >>> overruled(said, here, np.full((1, 5), 0.1), np.full(5, 0.1), vetoes=1).tolist()
        [[True, True, True, True, False]]

    Args:
        said: What each rater says, without biases.
        here: Who is heard.
        variance: Of each rater's error, > 0.
        noise: Variance of one answer of each rater.
        vetoes: How many may be overruled, >= 0.
    """
    xp, raters = namespace(said), said.shape[-1]
    zero = xp.zeros_like(said)
    count = xp.sum(xp.astype(here, said.dtype), axis=-1)
    for number in range(min(vetoes, max(0, raters - FEWEST + 2) // 2)):
        largest = zero + xp.finfo(said.dtype).max
        lowest = here & (said == xp.min(xp.where(here, said, largest), axis=-1)[..., None])
        # Of several who say the same, the least precise one, so that the order of raters does not matter.
        loosest = xp.argmax(xp.where(lowest, variance, -largest), axis=-1)
        dissenter = (xp.arange(raters) == loosest[..., None]) & here
        others = here & ~dissenter
        tau2 = variance_between(said, others, variance)
        distance = precise_mean(said, others, variance)[..., None] - said
        alone = distance > OUTLIER * xp.sqrt(variance + tau2[..., None])
        left = xp.sum(xp.astype(others, said.dtype), axis=-1)
        usual = xp.sum(xp.where(others, zero + noise, zero), axis=-1) / xp.maximum(left, xp.ones_like(left))
        imprecise = noise >= usual[..., None] / EXPERT**2
        enough = count >= FEWEST + 2 * number
        here = here & ~(dissenter & alone & imprecise & enough[..., None])
    return here


def precise_mean(
    said: Float[Array, "*batch K"], here: Bool[Array, "*batch K"], variance: Float[Array, "*batch K"]
) -> Float[Array, "*batch"]:
    """Return the mean of what raters say, each weighed by the inverse of their variance; 0 where nobody is heard.

    Examples:
        >>> import numpy as np
        >>> precise_mean(np.array([[1.0, 4.0]]), np.ones((1, 2), bool), np.array([[1.0, 2.0]])).tolist()
        [2.0]

    Args:
        said: What each rater says.
        here: Who is heard.
        variance: Of each rater's error, > 0.
    """
    xp = namespace(said)
    sums = _sums(said, xp.zeros_like(said[..., 0]), here, variance)
    return total(sums.first) / _where(sums.heard > 0, sums.total, 1.0)


class _Sums(NamedTuple):
    """What raters who are heard say beyond something, weighed by the inverse variances; sums over them."""

    heard: Float[Array, "*batch"]
    weight: Float[Array, "*batch K"]
    gap: Float[Array, "*batch K"]
    first: Float[Array, "*batch K"]
    total: Float[Array, "*batch"]


def _sums(
    said: Float[Array, "*batch K"],
    about: Float[Array, "*batch"],
    here: Bool[Array, "*batch K"],
    variance: Float[Array, "*batch K"],
) -> _Sums:
    weight, gap = 1.0 / variance, said - about[..., None]
    if all_true(here):
        heard = np.full(gap.shape[:-1], gap.shape[-1], gap.dtype)
    else:
        xp, heard = namespace(said), here.sum(-1, dtype=said.dtype)
        weight, gap = xp.where(here, weight, 0.0), xp.where(here, gap, 0.0)
    return _Sums(heard, weight, gap, weight * gap, total(weight))


def _variance_between(s: _Sums) -> Float[Array, "*batch"]:
    several = s.heard > 1.0
    whole = _where(several, s.total, 1.0)
    first, second = total(s.first), dot(s.first, s.gap)
    excess = second - first * first / whole - (s.heard - 1.0)
    squares = dot(s.weight, s.weight / whole[..., None])  # no square: of tiny rewards it overflows
    spread = whole - squares
    several = several & (spread > 0)  # where one rater outweighs all others by more than a float can tell it is not
    return _where(several & (excess > 0), excess / _where(several, spread, 1.0), 0.0)


def _where(mask: Bool[Array, "*any"], yes: Array, no: float) -> Array:
    """Return ``yes``, with a number where the mask is not true."""
    return yes if all_true(mask) else namespace(yes).where(mask, yes, no)
