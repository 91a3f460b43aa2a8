"""Mitigations: what reward is learned from, how actions are scored, which score the backup follows.

A mitigation turns (observed reward, what the raters said, ensemble disagreement) into the reward that any agent
learns from. It knows no agent and no environment. Those here are frozen dataclasses; a user's own is one more:

    >>> from dataclasses import dataclass
    >>> from uard import LearningSignal, Mitigation
    >>> @dataclass(frozen=True)
    ... class Halve(Mitigation):
    ...     factor: float = 0.5
    ...     def signal(self, evidence, usual):
    ...         return LearningSignal(self.factor * evidence.reward, 1.0)

All methods are pure and take NumPy, JAX or torch arrays of any one shape.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

from uard import _checks, plugins
from uard.method import adaptation, uncertainty
from uard.method.arrays import Array, namespace
from uard.method.weights import ReliabilityFilter, discount

Backup = Literal["greedy", "consistent"]


class Feedback(NamedTuple):
    """What the learner believes of the ratings at some state-actions; arrays of one shape, in reward units.

    Attributes:
        count: Rated visits; 0 where nobody rated, and there the other four mean nothing.
        mean: Mean rating.
        lowest: Mean of the lowest rating of a visit.
        spread: sigma_h, the annotators' deviation.
        proxy: Mean observed reward of the rated visits.
        raters: Number of annotators K.
    """

    count: Array
    mean: Array
    lowest: Array
    spread: Array
    proxy: Array
    raters: Array


def as_column(feedback: Feedback) -> Feedback:
    """Return the feedback of (B,) steps as that of states with one action each, (B, 1)."""
    return Feedback._make([*(x[:, None] for x in feedback[:5]), feedback.raters])


class Evidence(NamedTuple):
    """All that a mitigation may know of a step: observed reward, ensemble disagreement, feedback."""

    reward: Array
    sigma_m: Array
    feedback: Feedback


class LearningSignal(NamedTuple):
    """The reward to learn from, and how much the step counts (0 skips it, 1 is a full step)."""

    reward: Array
    sample_weight: Array


class Explanation(NamedTuple):
    """Why a reward is believed as far as it is; arrays of one shape.

    Attributes:
        sigma_h: Disagreement of the raters (and the proxy, if it counts), in reward units.
        lam: lambda_t.
        weight: w in [0, 1].
        anchor: b, in reward units; what is learned from is b + w (r - b).
    """

    sigma_h: Array
    lam: Array
    weight: Array
    anchor: Array


class Usual(NamedTuple):
    """What is usual over the distinct state-actions rated so far.

    Attributes:
        disagreement: Location and deviation of sigma_h.
        scale: Standard deviation of the observed reward, the unit in which sigmas are measured; 1 before any
            rating and while all observed rewards are equal.
        lowest: Mean of the lowest ratings: what a step is worth at least; 0 before any rating.
    """

    disagreement: uncertainty.Spread
    scale: Array
    lowest: Array


@runtime_checkable
class Mitigation(Protocol):
    """What every mitigation has; the defaults are the plain agent's.

    Attributes:
        reads_feedback: Whether ratings are used at all; if not, none are drawn.
        backup: ``greedy``: the target takes the best value; ``consistent``: the value of the action with the
            best *score*.
    """

    reads_feedback: ClassVar[bool] = True
    backup: Backup = "greedy"

    def usual(self, feedback: Feedback, seen: Array) -> Any:
        """Summarise all distinct state-actions (mask ``seen``: those rated); given to the two methods below."""
        return ()

    def signal(self, evidence: Evidence, usual: Any) -> LearningSignal:
        """Return the reward to learn from."""
        ...

    def score(self, mu: Array, sigma_m: Array, feedback: Feedback, usual: Any) -> Array:
        """Score the actions on the last axis, given mean values ``mu``; the agent prefers the highest."""
        return mu


def _where(condition: Array, yes: Array, no: Array) -> Array:
    xp = namespace(condition, yes, no)
    return xp.where(condition, yes, no)


def measure_usual(feedback: Feedback, seen: Array, proxy_is_rater: bool) -> Usual:
    """Location and deviation of sigma_h, and the scale of the reward, over distinct state-actions."""
    xp = namespace(feedback.mean)
    sigma = feedback.spread
    if proxy_is_rater:
        sigma = uncertainty.with_proxy(feedback.mean, sigma, feedback.proxy, feedback.raters)
    centre = uncertainty.spread(feedback.proxy, seen).location
    variance = uncertainty.spread((feedback.proxy - centre) * (feedback.proxy - centre), seen).location
    scale = xp.sqrt(variance)
    seen_proxy = xp.where(seen, feedback.proxy, xp.zeros_like(feedback.proxy))
    rounding = xp.finfo(scale.dtype).eps * xp.sum(xp.ones_like(seen_proxy)) * xp.max(xp.abs(seen_proxy))
    scale = xp.where(scale > rounding, scale, xp.ones_like(scale))
    return Usual(uncertainty.spread(sigma, seen), scale, uncertainty.spread(feedback.lowest, seen).location)


def in_part(reward: Array, lowest: Array, weight: Array) -> Array:
    """Believe a reward that nobody has rated in part: draw it towards what a step is usually worth at least."""
    return discount(reward, weight, lowest)


@dataclass(frozen=True)
class Raw(Mitigation):
    """Learn from the observed reward: no mitigation."""

    reads_feedback: ClassVar[bool] = False

    def signal(self, evidence: Evidence, usual: Any) -> LearningSignal:
        """Return the observed reward."""
        return LearningSignal(evidence.reward, 1.0)


Statistic = Literal["mean", "lowest", "bound"]


@dataclass(frozen=True)
class RatedReward(Mitigation):
    """Learn from a statistic of the ratings (its running mean) instead of the observed reward.

    Attributes:
        statistic: ``mean`` or ``lowest`` of the ratings, or ``bound``: mean - k sigma over the ratings and the
            observed reward.
        k: Deviations below the mean for ``bound``, >= 0.
        unrated_weight: How far the observed reward is believed where nobody has rated it yet, in [0, 1]; 1 takes it
            as it is.
    """

    statistic: Statistic = "mean"
    k: float = 1.0
    unrated_weight: float = 1.0

    def __post_init__(self) -> None:
        """Check the parameters."""
        _checks.choose("statistic", self.statistic, ("mean", "lowest", "bound"))
        _checks.number("k", self.k, low=0)
        _checks.number("unrated_weight", self.unrated_weight, low=0, high=1)

    def usual(self, feedback: Feedback, seen: Array) -> Usual:
        """Measure what is usual; see ``Usual``."""
        return measure_usual(feedback, seen, proxy_is_rater=False)

    def signal(self, evidence: Evidence, usual: Usual) -> LearningSignal:
        """Return the statistic."""
        f, r = evidence.feedback, evidence.reward
        if self.statistic == "mean":
            rated = f.mean
        elif self.statistic == "lowest":
            rated = f.lowest
        else:
            mean = (f.raters * f.mean + r) / (f.raters + 1.0)
            rated = mean - self.k * uncertainty.with_proxy(f.mean, f.spread, r, f.raters)
        return LearningSignal(_where(f.count > 0, rated, in_part(r, usual.lowest, self.unrated_weight)), 1.0)


@dataclass(frozen=True)
class Screening(Mitigation):
    """Leave out of learning every step on which the raters disagree more than a threshold.

    The hard form of the filter: w in {0, 1}, and a step with w = 0 is skipped.

    Attributes:
        limit: Largest sigma_h (proxy counted as a rater) that is still learned from, in units of the reward's
            running scale, > 0.
    """

    limit: float = 0.5

    def __post_init__(self) -> None:
        """Check the parameter."""
        _checks.number("limit", self.limit, low=0, open_low=True)

    def usual(self, feedback: Feedback, seen: Array) -> Usual:
        """Measure the reward's scale."""
        return measure_usual(feedback, seen, proxy_is_rater=True)

    def signal(self, evidence: Evidence, usual: Usual) -> LearningSignal:
        """Return the observed reward, and sample weight 0 where it is screened out."""
        f, r = evidence.feedback, evidence.reward
        sigma = uncertainty.with_proxy(f.mean, f.spread, r, f.raters)
        out = (f.count > 0) & (sigma > self.limit * usual.scale)
        one = namespace(sigma).ones_like(sigma)
        return LearningSignal(r, _where(out, 0.0 * one, one))


@dataclass(frozen=True)
class RewardDiscounting(Mitigation):
    """Uncertainty-Aware Reward Discounting in all its forms; the defaults are what we recommend (``uard``).

    Attributes:
        filter: Weights and parameters of the Reliability Filter.
        acts_on: ``reward``: learn from b + w (r - b) (T_lambda, A21); ``score``: learn from the raw reward and act
            on J (A19, A38); ``both``.
        anchor: ``zero`` as printed, or ``lowest``: the running mean of the lowest rating for rewards, the
            worst action's value for scores; of a state that offers one action, as a continuous agent's do, the
            ensemble's lower bound mu - sigma_m.
        kappa: Gain of the adaptive lambda_t (A44) >= 0; 0 keeps lambda constant.
        proxy_is_rater: Count the observed reward as one more rater in sigma_h.
        standardise: Measure sigmas in units of the running scale of the observed reward.
        unrated_weight: How far a reward is believed that nobody has rated yet, in [0, 1], on top of the ensemble's
            doubt.
        prior_count: Pseudo-count >= 0 with which anchor and trust of few ratings are drawn towards those of an
            unrated step (the usual lowest rating, ``unrated_weight``).
        backup: See ``Mitigation``.
    """

    filter: ReliabilityFilter = field(default_factory=ReliabilityFilter)
    acts_on: Literal["reward", "score", "both"] = "reward"
    anchor: Literal["zero", "lowest"] = "lowest"
    kappa: float = 50.0
    proxy_is_rater: bool = True
    standardise: bool = True
    unrated_weight: float = 0.1
    prior_count: float = 2.0
    backup: Backup = "greedy"

    def __post_init__(self) -> None:
        """Check the parameters."""
        _checks.choose("acts_on", self.acts_on, ("reward", "score", "both"))
        _checks.choose("anchor", self.anchor, ("zero", "lowest"))
        _checks.choose("backup", self.backup, ("greedy", "consistent"))
        _checks.number("kappa", self.kappa, low=0)
        _checks.number("unrated_weight", self.unrated_weight, low=0, high=1)
        _checks.number("prior_count", self.prior_count, low=0)

    def usual(self, feedback: Feedback, seen: Array) -> Usual:
        """Measure what is usual; see ``Usual``."""
        return measure_usual(feedback, seen, self.proxy_is_rater)

    def disagreement(self, proxy: Array, feedback: Feedback) -> Array:
        """Return sigma_h of steps whose observed reward is ``proxy``; 0 where nobody has rated."""
        sigma_h = feedback.spread
        if self.proxy_is_rater:
            sigma_h = uncertainty.with_proxy(feedback.mean, sigma_h, proxy, feedback.raters)
        return _where(feedback.count > 0, sigma_h, 0.0)

    def coefficient(self, sigma_h: Array, usual: Usual) -> Array:
        """Return lambda_t (A44), which rises with how unusual sigma_h is."""
        z = adaptation.standing(sigma_h, *usual.disagreement, floor=_DEVIATION_FLOOR * usual.scale)
        return adaptation.adaptive_lambda(z, self.filter.lam, self.kappa)

    def weight(self, mu: Array, proxy: Array, sigma_m: Array, feedback: Feedback, usual: Usual) -> Array:
        """Return w for something of size ``mu`` whose observed reward is ``proxy``."""
        return self._weigh(mu, proxy, sigma_m, feedback, usual)[0]

    def _weigh(
        self, mu: Array, proxy: Array, sigma_m: Array, feedback: Feedback, usual: Usual
    ) -> tuple[Array, Array, Array]:
        """Return w, sigma_h and lambda_t."""
        sigma_h = self.disagreement(proxy, feedback)
        lam = self.coefficient(sigma_h, usual)
        unit = usual.scale if self.standardise else 1.0
        weight = self.filter.weight(
            sigma_m / unit, sigma_h / unit, mu=(mu if self.anchor == "zero" else abs(mu)) / unit, lam=lam
        )
        # A factor, not a mixture: where nobody has rated, the ensemble's doubt still counts.
        one = namespace(weight).ones_like(weight)
        weight = weight * uncertainty.shrink(one, feedback.count, self.unrated_weight, self.prior_count)
        return weight, sigma_h, lam

    def reward_anchor(self, reward: Array, feedback: Feedback, usual: Usual) -> Array:
        """Return b, what a reward is drawn towards."""
        if self.anchor == "zero":
            return 0.0 * reward
        return uncertainty.shrink(feedback.lowest, feedback.count, usual.lowest, self.prior_count)

    def explain(self, evidence: Evidence, usual: Usual) -> Explanation:
        """Return weight and anchor of a reward, and what they were made from."""
        f, r = evidence.feedback, evidence.reward
        anchor = self.reward_anchor(r, f, usual)
        weight, sigma_h, lam = self._weigh(r - anchor, r, evidence.sigma_m, f, usual)
        return Explanation(sigma_h, lam, weight, anchor)

    def signal(self, evidence: Evidence, usual: Usual) -> LearningSignal:
        """Return b + w (r - b), or the observed reward if only scores are discounted."""
        if self.acts_on == "score":
            return LearningSignal(evidence.reward, 1.0)
        why = self.explain(evidence, usual)
        return LearningSignal(discount(evidence.reward, why.weight, why.anchor), 1.0)

    def score(self, mu: Array, sigma_m: Array, feedback: Feedback, usual: Usual) -> Array:
        """Return J, or ``mu`` if only rewards are discounted."""
        if self.acts_on == "reward":
            return mu
        xp = namespace(mu)
        if self.anchor == "zero":
            anchor = xp.zeros_like(mu)
        else:
            anchor = mu - sigma_m if mu.shape[-1] == 1 else xp.min(mu, axis=-1, keepdims=True)
        return discount(mu, self.weight(mu - anchor, feedback.proxy, sigma_m, feedback, usual), anchor)


_DEVIATION_FLOOR = 0.01  # of the reward's scale: raters who agree to within this are never unusual


def uard(lam: float = 0.2, alpha: float = 0.5, beta: float = 0.5, **changes: Any) -> RewardDiscounting:
    """What we recommend: anchored reward, adaptive lambda, the proxy as one more rater; a pure reward transform.

    The base lambda is a tenth of the paper's and the gain kappa makes up for it where disagreement stands out: noise
    that all ratings share is then no reason for doubt.
    """
    return RewardDiscounting(filter=ReliabilityFilter(lam, alpha, beta), **changes)


def uard_paper(
    lam: float = 2.0, alpha: float = 0.5, beta: float = 0.5, form: Any = "reciprocal", **changes: Any
) -> RewardDiscounting:
    """As printed: raw reward, act on J, ordinary backup (A19, A38)."""
    printed: dict[str, Any] = {
        "acts_on": "score",
        "anchor": "zero",
        "kappa": 0.0,
        "proxy_is_rater": False,
        "standardise": False,
        "unrated_weight": 1.0,
        "prior_count": 0.0,
    }
    return RewardDiscounting(filter=ReliabilityFilter(lam, alpha, beta, form), **(printed | changes))


NAMED: dict[str, Callable[..., Mitigation]] = {
    "raw": Raw,
    "mean-of-annotations": RatedReward,
    "worst-of-annotations": partial(RatedReward, statistic="lowest"),
    "lcb": partial(RatedReward, statistic="bound"),
    "screening": Screening,
    "uard": uard,
    "uard-paper": uard_paper,
    "uard-consistent": partial(uard_paper, backup="consistent"),
    "uard-operator": partial(uard_paper, acts_on="reward"),
    "uard-lite": partial(uard_paper, beta=0.0),
    "human-only": partial(uard_paper, alpha=0.0),
    "no-discount": partial(uard_paper, lam=0.0),
    "uard-exponential": partial(uard_paper, form="exponential"),
    "uard-linear": partial(uard_paper, form="linear"),
    "uard-certainty-equivalent": partial(uard_paper, form="certainty-equivalent"),
    "uard-wiener": partial(uard_paper, form="wiener"),
}


def named(name: str, **parameters: Any) -> Mitigation:
    """Return the mitigation of that name, ours or a plugin's (``uard.plugins``), with some parameters changed.

    Raises:
        UnknownNameError: with the nearest name.
        PluginError: a plugin that cannot be used.
    """
    if name in NAMED:
        return NAMED[name](**parameters)
    return plugins.pick("mitigation", name, NAMED, [*NAMED]).load(is_mitigation)(**parameters)


def is_mitigation(value: object) -> bool:
    """Whether ``value`` has what a mitigation has."""
    return isinstance(value, Mitigation)
