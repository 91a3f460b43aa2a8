"""Agents with continuous actions on a simulator: one run at a time, with a checkpoint now and then."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, final

import numpy as np

from uard._support import signals
from uard.lab.result import Result
from uard.lab.trainers.base import Finish, Trainer
from uard.lab.trainers.examine import examine
from uard.training.feedback.transition_model import QUERIES, TransitionModel

if TYPE_CHECKING:
    from uard.lab.cell import Cell


class Simulated(Trainer):
    """What both kinds have in common; ``training.host.loops`` has a loop for each."""

    kinds = ("simulator",)
    at_once = 1
    budget = "steps"
    rating_models = {"model": TransitionModel()}  # noqa: RUF012 (read only)
    queries = QUERIES

    def cost(self, cell: Cell) -> float:
        """Return the environment steps, each a thousand times as long as a tabular agent's."""
        return (cell.steps or 0) * 1000

    def train(self, batch: Sequence[tuple[Cell, int]], folder: Path | None = None) -> list[Finish]:
        """Train nothing yet: what is returned does, one run each, so that one that diverges takes no other with it."""
        return [partial(self._train_one, cell, seed, folder) for cell, seed in batch]

    def _train_one(self, cell: Cell, seed: int, folder: Path | None) -> Result:
        from uard.training.host import loop as host
        from uard.training.host.loops import loop_of
        from uard.training.xla import keep_programs, make_room

        keep_programs()
        make_room(self.program(cell))
        assert cell.steps is not None
        job = host.Job(
            cell.environment,
            cell.agent,
            cell.mitigation,
            seed,
            cell.steps,
            cell.panel,
            cell.noise,
            cell.rated,
            cell.rating_model if isinstance(cell.rating_model, TransitionModel) else TransitionModel(),
            cell.ddof,
            query=cell.query,
        )
        loop = loop_of(job)
        path = None if folder is None else checkpoint_of(folder, cell, seed)
        trained = host.run(loop, path, f"{cell.key} {seed}", stop=lambda: signals.received() is not None)
        extra = {"evaluation": trained.evaluation.astype(np.float32), "ends": trained.ends}
        extra |= examine(loop, trained.state)
        return Result(trained.log.astype(np.float32), int(trained.state.steps), np.zeros(0, np.int32), extra)


@final
class SimulatedReplay(Simulated):
    """SAC and its family."""

    name = "simulated-replay"
    version = 1
    families = ("continuous-replay",)


@final
class SimulatedRollout(Simulated):
    """PPO, TRPO and CPO."""

    name = "simulated-rollout"
    version = 1
    families = ("rollout",)


def checkpoint_of(folder: Path, cell: Cell, seed: int) -> Path:
    """Return where a run keeps its checkpoint."""
    return folder / f"{cell.key}-{seed}.checkpoint"


def forget_checkpoint(folder: Path, cell: Cell, seed: int) -> None:
    """Remove the checkpoint of a run that is stored, and what killed processes have left of it."""
    checkpoint = checkpoint_of(folder, cell, seed)
    for file in folder.glob(f"{checkpoint.name}*"):
        file.unlink(missing_ok=True)
