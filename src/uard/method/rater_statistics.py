"""What is known of each rater over all state-actions: noise, bias, idiosyncrasy, and who is heard at all.

All are taken over *distinct* state-actions: an agent that sits in a trap must not change what is thought of a rater.
The estimates are robust, because some rewards lie: what a rater says of them tells nothing of the rater. Pure functions
of NumPy, JAX or torch arrays.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from uard.method.arrays import Array, Numbers, at_least, namespace, smallest
from uard.method.feedback import ByRater
from uard.method.uncertainty import masked_mean, root

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

EQUAL = 1e-5  # of their mean: rewards that deviate by less are all the same
FLOOR = 0.01  # of the reward's scale: no rater is more exact
MOST = 4096  # state-actions over which statistics are taken; of more, these are evenly spread
CHI2_MEDIAN = 0.455  # of one degree of freedom
ROUNDS = 5  # of Huber's iteration
SOME = 0.1  # of the state-actions, at which a rater must be near the reward for a bias to be looked for there
DRAWN = 4.0  # state-actions' worth of no bias that a bias is drawn towards
LOUDEST = 2.0  # times the median deviation: who is noisier is not heard, among three raters or more


PER_RATER = ("noise", "bias", "idiosyncrasy", "heard")


class RaterStatistics(NamedTuple):
    """Statistics of a panel of K raters, in reward units or their squares.

    Attributes:
        noise: Variance of one answer of each rater about the rater's own mean of a state-action.
        bias: What each rater says beyond the reward where it does not lie.
        idiosyncrasy: Variance of what each rater says that neither noise nor the others explain.
        heard: 1 for raters who are heard, 0 for those much noisier than the others.
        floor: Variance below which nothing is told apart.
        typical: Median observed reward.
        span: Width of the range of all that is said and observed, and a scale more.
        scale: Standard deviation of the observed reward.
    """

    noise: Float[Array, " K"]
    bias: Float[Array, " K"]
    idiosyncrasy: Float[Array, " K"]
    heard: Float[Array, " K"]
    floor: Float[Array, ""]
    typical: Float[Array, ""]
    span: Float[Array, ""]
    scale: Float[Array, ""]


def fit(reward: Float[Array, " n"], by_rater: ByRater, rated: Bool[Array, " n"]) -> RaterStatistics:
    """Measure them.

    Examples:
        >>> import numpy as np
        >>> reward = np.arange(5.0)
        >>> kind = ByRater(np.ones((5, 2)), reward[:, None] + [0.0, 0.9], np.zeros((5, 2)))  # one is 0.9 too kind
        >>> fit(reward, kind, np.ones(5, bool)).bias.round(2).tolist()  # drawn to 0 as of nine state-actions
        [0.0, 0.5]

    Args:
        reward: Mean observed reward of each distinct state-action.
        by_rater: What each rater has said of it, (n, K) arrays.
        rated: Which of them anybody has rated.
    """
    xp = namespace(by_rater.mean)
    reward, by_rater, rated = thinned(reward, by_rater, rated)
    here = (by_rater.count > 0) & rated[:, None]
    count, said = xp.where(here, by_rater.count, xp.zeros_like(by_rater.count)), by_rater.mean
    centre = masked_mean(reward, rated)
    deviation = root(masked_mean((reward - centre) ** 2, rated))
    # Equal rewards differ by what rounding makes of their running means; that is no scale.
    scale = xp.where(deviation > EQUAL * abs(centre), deviation, xp.ones_like(deviation))
    floor = (FLOOR * scale) ** 2
    noise = answer_variance(count, by_rater.m2, scale)
    bias = robust_bias(count, said - reward[:, None], noise, scale)
    idiosyncrasy = own_variance(count, said - bias, reward, noise, floor)
    answered = xp.any(here, axis=0)
    sd = xp.sqrt(noise)
    usual = masked_median(sd, answered)
    several = xp.sum(xp.astype(answered, sd.dtype)) > 2.0
    quiet = (sd <= LOUDEST * usual) | ~several
    known = xp.where(rated, reward, centre)
    each = xp.where(here, said, known[:, None])
    top, bottom = (xp.maximum(xp.max(known), xp.max(each)), xp.minimum(xp.min(known), xp.min(each)))
    span = top - bottom + scale
    return RaterStatistics(
        noise, bias, idiosyncrasy, xp.astype(quiet, sd.dtype), floor, masked_median(reward, rated), span, scale
    )


def thinned(
    reward: Float[Array, " n"], by_rater: ByRater, rated: Bool[Array, " n"]
) -> tuple[Float[Array, " m"], ByRater, Bool[Array, " m"]]:
    """Return at most ``MOST`` of the state-actions, evenly spread.

    Examples:
        >>> import numpy as np
        >>> table = ByRater(*np.zeros((3, 10_000, 2)))
        >>> thinned(np.zeros(10_000), table, np.ones(10_000, bool))[0].shape
        (3334,)

    Args:
        reward: Mean observed reward of each distinct state-action.
        by_rater: What each rater has said of it, (n, K) arrays.
        rated: Which of them anybody has rated.
    """
    every = max(1, -(-reward.shape[0] // MOST))
    return reward[::every], ByRater._make(x[::every] for x in by_rater), rated[::every]


def error_of_means(by_rater: ByRater, statistics: RaterStatistics) -> Float[Array, "*batch K"]:
    """Return the variance of each rater's mean about what is meant, in squared reward units.

    The variance of one answer is the rater's own over all state-actions, corrected by what was seen here; to the error
    of the mean come the rater's idiosyncrasy and the floor.

    Examples:
        >>> import numpy as np
        >>> reward = np.array([0.0, 0.0, 10.0])
        >>> twice = ByRater(np.full((3, 1), 2.0), reward[:, None], np.full((3, 1), 0.5))
        >>> error_of_means(twice, fit(reward, twice, np.ones(3, bool))).round(2).tolist()
        [[0.24], [0.24], [0.24]]

    Args:
        by_rater: What each rater has said here; where nothing was said the variance is that of one answer.
        statistics: Of the panel.
    """
    n = at_least(by_rater.count, 1.0)
    return (4.0 * statistics.noise + by_rater.m2) / ((n + 3.0) * n) + statistics.idiosyncrasy + statistics.floor


def of_raters(statistics: RaterStatistics, raters: int) -> RaterStatistics:
    """Return the statistics of the first raters; of one who was not there when they were measured, the usual ones.

    Examples:
        >>> import numpy as np
        >>> one = fit(np.arange(5.0), ByRater(np.ones((5, 1)), np.ones((5, 1)), np.zeros((5, 1))), np.ones(5, bool))
        >>> bool(of_raters(one, 3).noise[2] == one.noise[0]), of_raters(one, 3).bias[1:].tolist()
        (True, [0.0, 0.0])

    Args:
        statistics: Of a panel.
        raters: How many are there now.
    """
    known = statistics.noise.shape[0]
    if known == raters:
        return statistics
    if known > raters:
        return statistics._replace(**{name: getattr(statistics, name)[:raters] for name in PER_RATER})
    xp = namespace(statistics.noise)
    one = xp.ones_like(statistics.noise[:1])
    usual = {"noise": xp.mean(statistics.noise), "bias": 0.0, "idiosyncrasy": xp.mean(statistics.idiosyncrasy)}
    more = {name: [usual.get(name, 1.0) * one] * (raters - known) for name in PER_RATER}
    return statistics._replace(**{name: xp.concat([getattr(statistics, name), *more[name]]) for name in PER_RATER})


def answer_variance(count: Float[Array, "n K"], m2: Float[Array, "n K"], scale: Numbers) -> Float[Array, " K"]:
    """Return the variance of one answer of each rater, drawn towards that of all raters together.

    Three degrees of freedom of the pooled variance are given to everybody; a rater who never rated anything twice has
    the pooled variance.

    Examples:
        >>> import numpy as np
        >>> answer_variance(np.array([[4.0, 1.0]]), np.array([[3.0, 0.0]]), scale=0.0).tolist()
        [0.875, 0.75]

    Args:
        count: Ratings of each state-action by each rater, 0 where there are none.
        m2: Sums of squared deviations from the rater's mean there.
        scale: Of the observed reward; a hundredth of its square is the variance where nothing was rated twice.
    """
    xp = namespace(count)
    freedom = xp.maximum(count - 1.0, 0.0 * count)
    square = xp.where(count > 0, m2, xp.zeros_like(m2))
    pooled = (xp.sum(square) + 0.01 * scale * scale) / (xp.sum(freedom) + 1.0)
    return (xp.sum(square, axis=0) + 3.0 * pooled) / (xp.sum(freedom, axis=0) + 3.0)


def robust_bias(
    count: Float[Array, "n K"], gap: Float[Array, "n K"], noise: Float[Array, " K"], scale: Numbers
) -> Float[Array, " K"]:
    """Return a Huber mean of what each rater says beyond the reward, drawn to 0 by four state-actions' worth.

    Lies put a second mode beside that of the bias, and an agent that is paid for them may have filled the table with
    them. The mode nearest 0 is taken, by beginning at 0 if the rater is near the reward anywhere much; else the median.

    Examples:
        >>> import numpy as np
        >>> robust_bias(np.ones((4, 1)), np.full((4, 1), 0.5), noise=np.array([0.1]), scale=1.0).tolist()
        [0.25]

    Args:
        count: Ratings, 0 where there are none.
        gap: Mean rating minus reward.
        noise: Variance of one answer.
        scale: Of the observed reward.
    """
    xp = namespace(gap)
    here, one, zero = count > 0, xp.ones_like(gap), xp.zeros_like(gap)
    variance = noise / xp.where(here, count, one) + 0.01 * scale * scale
    rated = xp.sum(xp.astype(here, gap.dtype), axis=0)
    near = xp.sum(xp.astype(here & (abs(gap) <= 6.0 * xp.sqrt(variance)), gap.dtype), axis=0)
    middle = masked_median(gap, here, axis=0)
    bias = xp.where(near >= SOME * rated, 0.0 * middle, middle)
    for _ in range(ROUNDS):
        far = abs(gap - bias) / xp.sqrt(variance)
        weight = xp.where(far > 6.0, zero, xp.minimum(one, 2.0 / xp.maximum(far, 1e-9 * one))) / variance
        weight = xp.where(here, weight, zero)
        total = xp.sum(weight, axis=0)
        mean = xp.sum(xp.where(here, weight * gap, zero), axis=0) / xp.where(total > 0, total, xp.ones_like(total))
        bias = xp.where(total > 0, mean, bias)
    return bias * rated / (rated + DRAWN)


def own_variance(
    count: Float[Array, "n K"],
    said: Float[Array, "n K"],
    reward: Float[Array, " n"],
    noise: Float[Array, " K"],
    floor: Numbers,
) -> Float[Array, " K"]:
    """Return the variance of what each rater says that neither noise nor what the others say explains.

    Each rater is compared with the median of the reward and the other raters; the variance is the smallest that leaves
    half of the squared distances below the median of a chi-squared variable.

    Examples:
        >>> import numpy as np
        >>> said = np.array([[0.0, 0.0, 2.0], [1.0, 1.0, -1.0]])  # the third says something else than all others
        >>> own_variance(np.ones((2, 3)), said, np.array([0.0, 1.0]), np.zeros(3), floor=0.0).round(1).tolist()
        [0.0, 0.0, 8.8]

    Args:
        count: Ratings, 0 where there are none.
        said: Mean ratings without the raters' biases.
        reward: Observed.
        noise: Variance of one answer.
        floor: Variance below which nothing is told apart.
    """
    xp = namespace(said)
    here, one, zero = count > 0, xp.ones_like(said), xp.zeros_like(said)
    of_mean = xp.where(here, noise / xp.where(here, count, one), zero)
    others = xp.sum(xp.astype(here, said.dtype), axis=-1)[:, None] - xp.astype(here, said.dtype)
    of_others = (xp.sum(of_mean, axis=-1)[:, None] - of_mean) / xp.maximum(others, one) ** 2
    known = of_mean + of_others + floor
    distance = said - leave_one_out_medians(said, here, reward)
    return xp.maximum(lower_median(distance * distance / CHI2_MEDIAN - known, here), 0.0 * noise)


def leave_one_out_medians(
    said: Float[Array, "n K"], here: Bool[Array, "n K"], reward: Float[Array, " n"]
) -> Float[Array, "n K"]:
    """Return, for each rater, the median of the reward and of what the other raters say.

    Examples:
        >>> import numpy as np
        >>> leave_one_out_medians(np.array([[1.0, 5.0, 9.0]]), np.ones((1, 3), bool), np.array([2.0])).tolist()
        [[5.0, 2.0, 2.0]]

    Args:
        said: What each rater says.
        here: Who has said anything; for the others the number means nothing.
        reward: Observed.
    """
    xp = namespace(said)
    values = xp.concat([reward[:, None], xp.where(here, said, xp.full_like(said, xp.finfo(said.dtype).max))], axis=-1)
    left = _number(here, axis=-1)  # how many values there are, with the reward and without the rater
    ranked = smallest(values, xp.maximum(left - 1, 0 * left) // 2, axis=-1, count=3)

    def without(index: int) -> Float[Array, "n K"]:
        this, following = ranked[:, index : index + 1], ranked[:, index + 1 : index + 2]
        return xp.where(said > this, this, following)

    low = without(0)
    high = xp.where(left % 2 == 0, without(1), low)
    return xp.where(here, 0.5 * low + 0.5 * high, xp.zeros_like(said))


def masked_median(values: Float[Array, "*any"], mask: Bool[Array, "*any"], axis: int = 0) -> Float[Array, "*rest"]:
    """Return the median of the masked-in values along an axis, 0 where there are none.

    Examples:
        >>> import numpy as np
        >>> float(masked_median(np.array([1.0, 3.0, 4.0, 99.0]), np.array([True, True, True, False])))
        3.0
    """
    xp, number = namespace(values), _number(mask, axis)
    middles = _middles(values, mask, number, axis, count=2)
    low, high = (xp.take(middles, xp.asarray([i]), axis=axis) for i in (0, 1))
    return xp.squeeze(xp.where(number % 2 == 0, 0.5 * low + 0.5 * high, low), axis=axis)


def lower_median(values: Float[Array, "*any"], mask: Bool[Array, "*any"], axis: int = 0) -> Float[Array, "*rest"]:
    """Return the lower of the two middle masked-in values, 0 where there are none.

    Examples:
        >>> import numpy as np
        >>> float(lower_median(np.array([1.0, 3.0, 4.0, 99.0]), np.array([True, True, False, False])))
        1.0
    """
    return namespace(values).squeeze(_middles(values, mask, _number(mask, axis), axis, count=1), axis=axis)


def _number(mask: Bool[Array, "*any"], axis: int) -> Array:
    xp = namespace(mask)
    return xp.sum(xp.astype(mask, xp.int64 if hasattr(mask, "detach") else xp.int32), axis=axis, keepdims=True)


def _middles(values: Float[Array, "*any"], mask: Bool[Array, "*any"], number: Array, axis: int, count: int) -> Array:
    """Return the lower of the two middle masked-in values and, asked for two, the next; 0 where there are none."""
    xp = namespace(values)
    held = xp.where(mask, values, xp.full_like(values, xp.finfo(values.dtype).max))
    found = smallest(held, xp.maximum(number - 1, 0 * number) // 2, axis, count)
    return xp.where(number > 0, found, xp.zeros_like(found))
