"""What is trained, by whom, as configurations: a language with its judges, and GRPO."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from uard import _checks
from uard.agents.base import Agent, Family
from uard.envs.base import Environment, Kind
from uard.lab.language.task import CONDITIONS, LONGEST


@dataclass(frozen=True)
class Language(Environment):
    """The language of ``uard.lab.language.task`` and five reward models, each of which learned what somebody prefers.

    An episode is an answer. The observed reward is what the judges say, the true one is gold, and a hack is a word that
    is in no clause.

    Examples:
        >>> len(Language("shared bias").annotators)
        5

    Attributes:
        condition: Whose preferences were learned, one of ``CONDITIONS``.
        taught: Batches of 64 answers of people that the language model has read, >= 1, and so have five others, the
            same for all seeds, with which reward models begin.
        pairs: Pairs of answers that every annotator compared, >= 2.
        compared: Batches of 32 pairs that a reward model has read, >= 1.
    """

    kind: ClassVar[Kind] = "language"
    horizon: ClassVar[Any] = LONGEST

    condition: str = "independent"
    taught: int = 300
    pairs: int = 3000
    compared: int = 120

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.choose("condition", self.condition, CONDITIONS)
        _checks.whole("taught", self.taught, low=1)
        _checks.whole("pairs", self.pairs, low=2)
        _checks.whole("compared", self.compared, low=1)

    @property
    def annotators(self) -> tuple[Any, ...]:
        """Who compared answers."""
        return CONDITIONS[self.condition]


@dataclass(frozen=True)
class Grpo(Agent):
    """GRPO as TRL has it, with its defaults but for what is named here.

    Examples:
        >>> Grpo(prompts=4).batch
        32

    Attributes:
        learning_rate: Of AdamW, constant, > 0.
        prompts: In each step, >= 1.
        completions: Of each prompt, which are compared with each other, >= 2.
    """

    family: ClassVar[Family] = "language"

    learning_rate: float = 1.5e-4
    prompts: int = 6
    completions: int = 8

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.number("learning_rate", self.learning_rate, low=0, open_low=True)
        _checks.whole("prompts", self.prompts, low=1)
        _checks.whole("completions", self.completions, low=2)

    @property
    def batch(self) -> int:
        """Completions in each step."""
        return self.prompts * self.completions
