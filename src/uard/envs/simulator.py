"""What an environment that runs on the host is to a training loop: several copies, stepped together."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from uard.ratings.panels import Panel, draw

Array = np.ndarray


class StepResult(NamedTuple):
    """What all copies' steps led to; leaves (E, ...).

    Attributes:
        observation: (E, features) float64, after the step and before any reset.
        reward: Observed.
        terminated: Whether the episode ended by itself.
        truncated: Whether the horizon was reached (and the episode did not end by itself).
        true_reward: For evaluation and for the panel only.
        hack: Whether the step is contested; for evaluation and for the panel only.
        success: Whether the step reached what the task is about; for evaluation only.
        task_reward: The reward of the task as it was published; for evaluation only.
    """

    observation: Array
    reward: Array
    terminated: Array
    truncated: Array
    true_reward: Array
    hack: Array
    success: Array
    task_reward: Array


class Simulator(ABC):
    """Several copies of an environment with continuous actions. Changed in place.

    Every copy is reset by itself when its episode ends. ``save`` gives all that the future depends on, to the bit.

    Examples:
        >>> from uard.envs.names import build
        >>> simulator = build("InvertedPendulum").simulator(copies=2, seed=0)
        >>> simulator.observe().shape, simulator.step(np.zeros((2, 1))).reward.tolist()
        ((2, 4), [1.0, 1.0])
        >>> simulator.step(np.full((2, 1), 3.0))
        Traceback (most recent call last):
            ...
        uard._checks.InvalidValueError: actions = 3.0: must be within [-1, 1]
        >>> simulator.close()

    Attributes:
        copies: E.
    """

    copies: int

    @abstractmethod
    def observe(self) -> Array:
        """Return the observations of all copies, (E, features)."""

    @abstractmethod
    def reset(self, i: int) -> None:
        """Begin an episode in copy ``i``, in whatever state it is."""

    @abstractmethod
    def step(self, actions: Array) -> StepResult:
        """Take one step in every copy, actions (E, D) in [-1, 1]; copies whose episode ended begin a new one.

        Raises:
            InvalidValueError: actions of another shape, not finite, or out of bounds.
            FloatingPointError: a copy's state left the finite numbers; names copy and step.
        """

    @abstractmethod
    def save(self) -> dict[str, Array]:
        """Return the whole state, random numbers included."""

    @abstractmethod
    def load(self, saved: dict[str, Array]) -> None:
        """Go on from what ``save`` gave; the future is then the same to the bit.

        Raises:
            InvalidValueError: it was saved from another environment or another number of copies.
        """

    @abstractmethod
    def camera(self, height: int = 240, width: int = 320) -> Callable[[int], Array]:
        """Return what takes a picture (height, width, 3) of a copy."""

    @abstractmethod
    def close(self) -> None:
        """Let go of threads and memory."""


def rate(panel: Panel, result: StepResult, noise: float, random: np.random.Generator) -> Array:
    """Return a panel's ratings of all copies' steps, (E, K), NaN where a rater did not answer.

    Examples:
        >>> from uard.ratings.panels import Rater
        >>> panel = Panel((Rater(noise=0.0), Rater(noise=0.0, temptation=1.0)))  # one says the truth, one is deceived
        >>> no = np.array([False])
        >>> result = StepResult(np.zeros((1, 4)), np.array([6.0]), no, no, np.array([-1.5]), no, no, np.zeros(1))
        >>> rate(panel, result, noise=0.0, random=np.random.default_rng(0)).tolist()
        [[-1.5, 6.0]]

    Args:
        panel: Who rates.
        result: Of one step of E copies.
        noise: Standard deviation of extra normal noise of every rater, in reward units, >= 0.
        random: Source of chance.
    """
    law = panel.law(result.reward, result.true_reward, result.hack, np.asarray(noise))
    return draw(law, random)
