"""What every agent declares: the family of training loops that can train it."""

from __future__ import annotations

from abc import ABC
from typing import ClassVar, Literal

Family = Literal["tabular", "replay", "rollout", "continuous-replay", "language"]


class Agent(ABC):
    """A learner's configuration; subclasses are frozen dataclasses, and pure functions of a state that others hold.

    Attributes:
        family: Which kind of training loop trains it: one that keeps tables (``tabular``), one that replays transitions
            of discrete actions (``replay``) or of continuous ones (``continuous-replay``), or one that learns from
            what was just done (``rollout``; actions of both kinds), or one that trains a language model (``language``).
    """

    family: ClassVar[Family]
