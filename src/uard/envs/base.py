"""What a configuration of an environment is: a frozen dataclass that can build its world, or its tables."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

from uard.envs.tables import HiddenTruth, Ratings, Task


@runtime_checkable
class Spec(Protocol):
    """An environment's configuration."""

    @property
    def horizon(self) -> int | None:
        """Steps per episode."""
        ...

    def world(self, panel: str = "main", noise: float = 0.0) -> Any:
        """Build the compiled environment (``uard.envs.world.World``) with its panel of annotators."""
        ...


@runtime_checkable
class Tables(Spec, Protocol):
    """One that is small enough for tables; tabular agents need it."""

    @property
    def states(self) -> int:
        """Number of states."""
        ...

    def task(self) -> Task:
        """Return what an agent meets."""
        ...

    def truth(self) -> HiddenTruth:
        """Return what only the evaluation may see."""
        ...

    def speech(self, panel: str, noise: float) -> Ratings:
        """Return what the panel says of every step."""
        ...
