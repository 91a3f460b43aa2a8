"""What the configuration of an environment is: a frozen dataclass of one of four kinds.

The kind says which agents can be trained in it, and how (``uard.lab.trainers``): tables, a compiled world, a simulator
that runs on the host, or a language, whose episodes are answers (``uard.lab.language``).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import DTypeLike

from uard import _checks
from uard.envs.simulator import Simulator
from uard.envs.tables import HiddenTruth, Task
from uard.ratings.panels import Panel, RatingLaw

if TYPE_CHECKING:
    from uard.envs.world import TableWorld

Kind = Literal["tables", "world", "simulator", "language"]


class Environment(ABC):
    """An environment's configuration; subclasses are frozen dataclasses.

    Examples:
        >>> from uard.envs.names import build
        >>> [build(name).kind for name in ("TrapGrid6", "CartPole", "Hopper")]
        ['tables', 'world', 'simulator']

    Attributes:
        kind: How it is run.
        horizon: Steps per episode, a whole number >= 1.
    """

    kind: ClassVar[Kind]
    horizon: Any  # a field of all subclasses; some fill it in from their other fields


class CompiledEnvironment(Environment):
    """One whose world is compiled together with the training loop; its actions are discrete.

    Examples:
        >>> from uard.envs.names import build
        >>> from uard.ratings.panels import MAIN
        >>> world = build("CartPole").world(MAIN)
        >>> world.actions, world.features, world.raters
        (2, 4, 3)
    """

    kind: ClassVar[Kind] = "world"

    @abstractmethod
    def world(self, panel: Panel, noise: float = 0.0) -> Any:
        """Build the compiled environment (``uard.envs.world.World``), each step rated by a panel (needs JAX).

        Args:
            panel: Who rates.
            noise: Standard deviation of extra normal noise of every rater, in reward units, >= 0.

        Raises:
            InvalidValueError: for a noise that is not >= 0.
        """


class TableEnvironment(CompiledEnvironment):
    """One that is small enough for tables; tabular agents need it.

    Examples:
        >>> from uard.envs.grids.trapgrid import TrapGrid
        >>> grid = TrapGrid(size=6)
        >>> into_trap = grid.state((2, 3)), 1  # down, to (3, 3)
        >>> grid.task().reward[into_trap].item(), grid.truth().reward[into_trap].item()
        (4.0, -1.0)
    """

    kind: ClassVar[Kind] = "tables"

    @property
    @abstractmethod
    def states(self) -> int:
        """Number of states."""

    @abstractmethod
    def task(self, dtype: DTypeLike = np.float32) -> Task:
        """Return what an agent meets, (S, A) tables, its rewards as ``dtype``: compiled programs compute in float32."""

    @abstractmethod
    def truth(self, dtype: DTypeLike = np.float32) -> HiddenTruth:
        """Return what only the evaluation may see, (S, A) tables, its rewards as ``dtype``."""

    def rating_law(self, panel: Panel, noise: float = 0.0) -> RatingLaw:
        """Return what a panel says of every step, (S, A, K) float32; arguments and errors as for ``world``."""
        return law_of_tables(panel, self.task(), self.truth(), noise)

    def world(self, panel: Panel, noise: float = 0.0) -> TableWorld:
        """Build the compiled environment of the tables; it has at least 100 states, see ``uard.envs.tables.pad``."""
        from uard.envs.world import table_world

        return table_world(self.task(), self.truth(), self.rating_law(panel, noise))


class SimulatedEnvironment(Environment):
    """One that runs on the host, in several copies; its actions are continuous, within [-1, 1].

    Examples:
        >>> from uard.envs.names import build
        >>> pendulum = build("InvertedPendulum", horizon=100)
        >>> pendulum.features, pendulum.actions, pendulum.steps_per_second
        (4, 1, 25)

    Attributes:
        steps_per_second: Of simulated time.
    """

    kind: ClassVar[Kind] = "simulator"
    steps_per_second: ClassVar[int]
    horizon: int

    @property
    @abstractmethod
    def features(self) -> int:
        """Length of an observation."""

    @property
    @abstractmethod
    def actions(self) -> int:
        """Length of an action."""

    @abstractmethod
    def simulator(self, copies: int, seed: int, threads: int = 1) -> Simulator:
        """Build and reset all copies.

        Args:
            copies: E >= 1.
            seed: Of everything random, a whole number >= 0.
            threads: Threads that share the copies, >= 1; results do not depend on it.

        Raises:
            InvalidValueError: for copies or threads out of their range.
        """


def law_of_tables(panel: Panel, task: Task, truth: HiddenTruth, noise: float = 0.0) -> RatingLaw:
    """Return what a panel says of every step of tables.

    Args:
        panel: Who rates.
        task: Gives the observed reward.
        truth: Gives the true reward and the contested steps.
        noise: Standard deviation of extra normal noise of every rater, in reward units, >= 0.

    Raises:
        InvalidValueError: for a noise that is not >= 0.
    """
    _checks.number("noise", noise, low=0)
    law = panel.law(np.asarray(task.reward, float), np.asarray(truth.reward, float), np.asarray(truth.hack), noise)
    return law._replace(centre=law.centre.astype(np.float32), deviation=law.deviation.astype(np.float32))
