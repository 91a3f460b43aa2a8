"""How cells are trained: one trainer for each kind of training, found by what environment and agent declare."""

from __future__ import annotations

from typing import Any

from uard.lab.trainers.base import Trainer
from uard.lab.trainers.compiled import CompiledReplay, CompiledRollout
from uard.lab.trainers.language import LanguageModel
from uard.lab.trainers.simulated import SimulatedReplay, SimulatedRollout
from uard.lab.trainers.tabular import Tabular

__all__ = ["TRAINERS", "Trainer", "trainer_of"]

TRAINERS: tuple[Trainer, ...] = (
    Tabular(),
    CompiledReplay(),
    CompiledRollout(),
    SimulatedReplay(),
    SimulatedRollout(),
    LanguageModel(),
)


def trainer_of(agent: Any, environment: Any) -> Trainer | None:
    """Return who trains such an agent in such an environment; None if that cannot be.

    Examples:
        >>> from uard.lab.registry import AGENTS, ENVIRONMENTS
        >>> trainer_of(AGENTS["dqn"], ENVIRONMENTS["CartPole"]).name
        'compiled-replay'
        >>> trainer_of(AGENTS["q-learning"], ENVIRONMENTS["CartPole"]) is None  # no tables are that large
        True
    """
    return next((trainer for trainer in TRAINERS if trainer.serves(agent, environment)), None)
