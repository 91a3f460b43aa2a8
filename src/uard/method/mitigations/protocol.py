"""What every mitigation is: from an observed reward and what is known of its ratings to the reward that is learned from.

A mitigation knows no agent and no environment. A user's own is one small class:

    >>> from dataclasses import dataclass
    >>> from uard import LearningSignal, Mitigation
    >>> @dataclass(frozen=True)
    ... class Halve(Mitigation):
    ...     factor: float = 0.5
    ...     def signal(self, evidence, statistics):
    ...         return LearningSignal(self.factor * evidence.reward, 1.0)

All methods are pure and take NumPy, JAX or torch arrays of any one shape.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, Literal, NamedTuple

from uard.method.arrays import Array, namespace
from uard.method.feedback import Feedback

Backup = Literal["greedy", "consistent"]
ActsOn = Literal["reward", "score", "both"]


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
        signal: What is learned.
        sigma_h: Disagreement of the raters (and of the proxy with them, if it counts), in reward units; 0 where nobody
            has rated.
        lam: lambda_t; 0 for a mitigation that has none.
        weight: w in [0, 1]; 1 for a mitigation that has none.
        anchor: b, in reward units. Of a mitigation that discounts, what is learned is b + w (r - b).
        doubt: Total uncertainty U, in reward units.
    """

    signal: LearningSignal
    sigma_h: Array
    lam: Array
    weight: Array
    anchor: Array
    doubt: Array


class Mitigation(ABC):
    """What every mitigation has; all but ``signal`` have the defaults of one that changes rewards only.

    Attributes:
        reads_feedback: Whether ratings are used at all; if not, none are drawn.
        discounts: Whether ``explain`` gives a weight and an anchor from which the reward follows.
        acts_on: ``reward``: it changes the reward that is learned from; ``score``: how actions are scored; ``both``.
        backup: ``greedy``: the target takes the best value; ``consistent``: the value of the action with the best
            *score*.
    """

    reads_feedback: ClassVar[bool] = True
    discounts: ClassVar[bool] = False
    acts_on: ActsOn = "reward"
    backup: Backup = "greedy"

    def fit(self, feedback: Feedback, rated: Array) -> Any:
        """Return the statistics of the panel over all distinct state-actions, for the methods below.

        Args:
            feedback: Of every state-action.
            rated: Which of them were rated (bool).
        """
        return ()

    @abstractmethod
    def signal(self, evidence: Evidence, statistics: Any) -> LearningSignal:
        """Return the reward to learn from; ``statistics`` is what ``fit`` returned."""

    def score(
        self, mu: Array, sigma_m: Array, feedback: Feedback, statistics: Any, *, one_action: bool = False
    ) -> Array:
        """Score actions, given mean values ``mu`` and the ensemble's disagreement; the agent prefers the highest.

        Args:
            mu: (..., A) with the actions on the last axis, or any shape with ``one_action``.
            sigma_m: Alike.
            feedback: Alike.
            statistics: What ``fit`` returned.
            one_action: Whether every number is a state's only action, as with continuous actions.
        """
        return mu

    def explain(self, evidence: Evidence, statistics: Any) -> Explanation:
        """Return what is learned and why; of a mitigation without weights, everything is believed as it is learned."""
        signal, feedback = self.signal(evidence, statistics), evidence.feedback
        xp = namespace(evidence.reward, feedback.sd)
        zero = xp.zeros_like(evidence.reward)
        sigma_h = xp.where(feedback.count > 0, feedback.sd, zero)
        return Explanation(signal, sigma_h, zero, zero + 1.0, signal.reward + zero, evidence.sigma_m + sigma_h)

    def without_prior(self) -> Mitigation:
        """Return the mitigation for state-actions that never come twice.

        A pseudo-count with which few ratings are met would hold down all that will ever be known of them.
        """
        return self
