"""What every mitigation is: from an observed reward and what is known of its ratings to the reward that is learned.

A mitigation knows no agent and no environment. All methods are pure and take NumPy, JAX or torch arrays of any one
shape.
"""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, get_args

import numpy as np

from uard import _checks
from uard.method.arrays import Array, Numbers, as_floats, namespace
from uard.method.feedback import Feedback

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

Backup = Literal["greedy", "consistent"]
ActsOn = Literal["reward", "score", "both"]
METHODS = {
    "fit": ("self", "feedback", "rated"),
    "signal": ("self", "evidence", "statistics"),
    "explain": ("self", "evidence", "statistics"),
    "score": ("self", "mu", "sigma_m", "feedback", "statistics"),
}
"""What a mitigation's methods are given, in this order."""


class Evidence(NamedTuple):
    """All that a mitigation may know of some steps.

    Attributes:
        reward: Observed.
        sigma_m: Disagreement of an ensemble, in reward units, >= 0.
        feedback: What is known of the ratings of these state-actions.
    """

    reward: Float[Array, "*batch"]
    sigma_m: Float[Array, "*batch"]
    feedback: Feedback


class LearningSignal(NamedTuple):
    """What is learned of some steps.

    Attributes:
        reward: The reward to learn from.
        sample_weight: How much the step counts: 0 skips it, 1 is a full step. A number is meant for all.
    """

    reward: Float[Array, "*batch"]
    sample_weight: Numbers


class Explanation(NamedTuple):
    """Why a reward is believed as far as it is.

    Attributes:
        signal: What is learned.
        sigma_h: Disagreement of the raters (and of the proxy with them, if it counts), in reward units; 0 where nobody
            has rated. Of ``uard`` it is tau.
        lam: lambda_t; 0 for a mitigation that has none.
        weight: w in [0, 1]; 1 for a mitigation that has none.
        anchor: b, in reward units. Of a mitigation that discounts, what is learned is b + w (r - b), less the premium
            risk sqrt(w (1 - w)) |r - b| of ``uard`` for not knowing whether the reward lies.
        doubt: Total uncertainty U, in reward units.
    """

    signal: LearningSignal
    sigma_h: Float[Array, "*batch"]
    lam: Float[Array, "*batch"]
    weight: Float[Array, "*batch"]
    anchor: Float[Array, "*batch"]
    doubt: Float[Array, "*batch"]


class Mitigation(ABC):
    """What every mitigation has; all but ``signal`` have the defaults of one that changes rewards only.

    A user's own is one small class:

    Examples:
        >>> from dataclasses import dataclass
        >>> @dataclass(frozen=True)
        ... class Halve(Mitigation):
        ...     factor: float = 0.5
        ...     def signal(self, evidence, statistics):
        ...         return LearningSignal(self.factor * evidence.reward, 1.0)
        >>> from uard.ratings.stream import RewardStream
        >>> RewardStream(Halve())([4.0]).reward.tolist()
        [2.0]

    Attributes:
        reads_feedback: Whether ratings are used at all; if not, none are drawn.
        discounts: Whether ``explain`` gives a weight and an anchor from which the reward follows.
        refits_early: Whether the panel's statistics are measured at steps 1, 2, 4 ... of training: a rule that doubts
            nobody before it knows them would learn the first lie before it is doubted.
        reads_truth: Whether it is an oracle that learns from the true reward; only where a trainer can give it that.
        acts_on: ``reward``: it changes the reward that is learned from; ``score``: how actions are scored; ``both``.
        backup: ``greedy``: the target takes the best value; ``consistent``: the value of the action with the best
            *score*.
    """

    reads_feedback: ClassVar[bool] = True
    discounts: ClassVar[bool] = False
    refits_early: ClassVar[bool] = False
    reads_truth: ClassVar[bool] = False
    acts_on: ActsOn = "reward"
    backup: Backup = "greedy"

    def __init_subclass__(cls, **options: Any) -> None:
        """Check what a class says of itself when it is defined.

        Raises:
            InvalidValueError: ``acts_on`` or ``backup`` is unknown, or a method has other parameters.
        """
        super().__init_subclass__(**options)
        for field, allowed in (("acts_on", get_args(ActsOn)), ("backup", get_args(Backup))):
            if isinstance(value := getattr(cls, field), str):  # or it is a dataclass's field
                _checks.choose(f"{cls.__name__}.{field}", value, allowed)
        for name, allowed in METHODS.items():
            method = cls.__dict__.get(name)
            if not inspect.isfunction(method):
                continue
            try:
                inspect.signature(method).bind(*allowed, **({"one_action": True} if name == "score" else {}))
            except TypeError:
                given = str(inspect.signature(method))
                wanted = ", ".join([*allowed, "*, one_action=False"] if name == "score" else allowed)
                raise _checks.InvalidValueError(f"{cls.__name__}.{name}", given, f"({wanted})") from None

    def fit(self, feedback: Feedback, rated: Bool[Array, "*batch"]) -> Any:
        """Return the statistics of the panel over all distinct state-actions, for the methods below.

        Args:
            feedback: Of every state-action.
            rated: Which of them were rated.
        """
        return ()

    @abstractmethod
    def signal(self, evidence: Evidence, statistics: Any) -> LearningSignal:
        """Return the reward to learn from; ``statistics`` is what ``fit`` returned."""

    def score(
        self,
        mu: Float[Array, "*batch A"],
        sigma_m: Float[Array, "*batch A"],
        feedback: Feedback,
        statistics: Any,
        *,
        one_action: bool = False,
    ) -> Float[Array, "*batch A"]:
        """Score actions, given mean values ``mu`` and the ensemble's disagreement; the agent prefers the highest.

        Args:
            mu: Mean value of every action, with the actions on the last axis; of any shape with ``one_action``.
            sigma_m: The ensemble's disagreement, alike, in units of value, >= 0.
            feedback: What is known of the ratings of these state-actions, alike.
            statistics: What ``fit`` returned.
            one_action: Whether every number is a state's only action, as with continuous actions.
        """
        return mu

    def explain(self, evidence: Evidence, statistics: Any) -> Explanation:
        """Return what is learned and why; of a mitigation without weights, everything is believed as it is learned.

        Raises:
            InvalidValueError: ``signal`` gave something else than a reward for each step.
        """
        signal, feedback = self.signal(evidence, statistics), evidence.feedback
        name = f"{type(self).__name__}.signal(...)"
        _checks.instance(name, signal, LearningSignal, "a LearningSignal")
        shape, wanted = tuple(np.shape(signal.reward)), tuple(evidence.reward.shape)
        if shape != wanted:
            raise _checks.InvalidValueError(f"{name}.reward.shape", shape, f"{wanted}, one per step")
        as_floats(f"{name}.reward", signal.reward)
        xp = namespace(evidence.reward, feedback.sd)
        zero = xp.zeros_like(evidence.reward)
        sigma_h = xp.where(feedback.count > 0, feedback.sd, zero)
        return Explanation(signal, sigma_h, zero, zero + 1.0, signal.reward + zero, evidence.sigma_m + sigma_h)

    def reads_sigma_m(self, feedback: Feedback, statistics: Any) -> Bool[Array, "*batch"]:
        """Return at which steps sigma_m has a say in what is learned: at all, unless a mitigation knows better.

        Who filters often asks for sigma_m there only, and keeps what was learned of the others.

        Args:
            feedback: What is known of the ratings of these state-actions.
            statistics: What ``fit`` returned.
        """
        return feedback.count == feedback.count

    def without_prior(self) -> Mitigation:
        """Return the mitigation for state-actions that never come twice.

        A pseudo-count with which few ratings are met would hold down all that will ever be known of them.
        """
        return self
