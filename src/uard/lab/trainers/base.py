"""What the laboratory must know of a kind of training: whom it serves, what a cell means to it, how it trains."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from uard.agents.base import Family
from uard.envs.base import Kind
from uard.lab.config import plain
from uard.lab.result import Result
from uard.training.feedback.rating_model import RatingModel
from uard.training.feedback.transition_model import TransitionModel

if TYPE_CHECKING:
    from uard.lab.cell import Cell

Finish = Callable[[], Result]  # of one job; raises DivergedError if that diverged


class Trainer(ABC):
    """A kind of training.

    Examples:
        >>> from uard.lab.cell import Cell
        >>> trainer = Cell().trainer
        >>> trainer.name, trainer.budget, trainer.families, [*trainer.rating_models]
        ('tabular', 'episodes', ('tabular',), ['table'])

    Attributes:
        name: Part of the keys of its cells.
        version: Part of them, too: a whole number that is raised when the code of this kind of training changes what
            a result means. Older results are then not found, never mixed with new ones; other kinds keep theirs.
        kinds: Of the environments that it serves.
        families: Of the agents.
        at_once: Most seeds that one call trains.
        budget: What of a cell says for how long; the other field means nothing to it.
        rating_models: How it can know of ratings, by the names of the command line, the default first. ``table``,
            which is None: running means per state-action.
        snapshots: Whether it can keep tables along the way.
        knows_truth: Whether it can train an oracle, whose mitigation reads the true reward.
        queries: How the steps that are rated may be chosen.
        has_panel: Whether a cell's panel rates; where it does not, the environment says who judges.
    """

    name: ClassVar[str]
    version: ClassVar[int]
    kinds: ClassVar[tuple[Kind, ...]]
    families: ClassVar[tuple[Family, ...]]
    at_once: ClassVar[int]
    budget: ClassVar[Literal["episodes", "steps"]] = "episodes"
    rating_models: ClassVar[Mapping[str, RatingModel | TransitionModel | None]]
    snapshots: ClassVar[bool] = False
    knows_truth: ClassVar[bool] = False
    queries: ClassVar[tuple[str, ...]] = ("random",)
    has_panel: ClassVar[bool] = True

    def serves(self, agent: Any, environment: Any) -> bool:
        """Whether it trains such an agent in such an environment."""
        return environment.kind in self.kinds and agent.family in self.families

    @property
    def usual_rating_model(self) -> RatingModel | TransitionModel | None:
        """How it knows of ratings if nothing is said."""
        return next(iter(self.rating_models.values()))

    def program(self, cell: Cell) -> Hashable:
        """Return what cells must have in common to be trained by one call, and to share a compiled program."""
        raters = cell.panel.raters
        return (
            self.name,
            structure(cell.agent),
            structure(cell.mitigation),
            self.place(cell.environment),
            (len(raters), all(rater.plain for rater in raters)),
            (cell.episodes, cell.steps),
            (cell.ddof, cell.snapshots),
            str(cell.rating_model),
        )

    def place(self, environment: Any) -> Hashable:
        """Return what environments must have in common for that."""
        return structure(environment)

    @abstractmethod
    def cost(self, cell: Cell) -> float:
        """Return how long a seed takes, in some unit, alike for all trainers."""

    @abstractmethod
    def train(self, batch: Sequence[tuple[Cell, int]], folder: Path | None = None) -> list[Finish]:
        """Train some cells and seeds of one program.

        Args:
            batch: ``at_once`` of them at most.
            folder: Where long runs keep checkpoints, and go on from them; nowhere if None.

        Returns:
            For each, what gives its result.
        """


def structure(config: Any) -> Hashable:
    """Return what of a configuration is fixed in a compiled program: all but its numbers with a fraction."""
    value = plain(config)
    if isinstance(value, dict):
        return tuple((name, structure(v)) for name, v in value.items())
    return "number" if isinstance(value, float) else str(value)
