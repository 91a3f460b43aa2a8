"""GRPO of a small language model against reward models, by TRL: one run at a time."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, final

from uard.lab.result import Result
from uard.lab.trainers.base import Finish, Trainer
from uard.training.feedback.rating_model import RatingModel
from uard.training.feedback.transition_model import TransitionModel

if TYPE_CHECKING:
    from uard.lab.cell import Cell

TABLE: Mapping[str, RatingModel | TransitionModel | None] = {"table": None}


@final
class LanguageModel(Trainer):
    """See ``uard.lab.language``; the judges are the environment's, so a cell's panel means nothing here."""

    name = "language"
    version = 1
    kinds = ("language",)
    families = ("language",)
    at_once = 1
    budget = "steps"
    rating_models = TABLE
    knows_truth = True
    has_panel = False

    def program(self, cell: Cell) -> Hashable:
        """Return the environment: who has its models already goes on with it, others begin with another one."""
        return self.name, cell.environment

    def cost(self, cell: Cell) -> float:
        """Return the steps of GRPO, each as long as half a million of a tabular agent's."""
        return (cell.steps or 0) * 500_000

    def train(self, batch: Sequence[tuple[Cell, int]], folder: Path | None = None) -> list[Finish]:
        """Train nothing yet: what is returned does. Language and reward models are kept in the folder."""
        return [partial(_train_one, cell, seed, folder) for cell, seed in batch]


def _train_one(cell: Cell, seed: int, folder: Path | None) -> Result:
    from uard.lab.language import training

    assert cell.steps is not None
    if folder is not None:
        folder.mkdir(exist_ok=True)
    return training.train(cell.environment, cell.agent, cell.mitigation, seed, cell.steps, folder)
