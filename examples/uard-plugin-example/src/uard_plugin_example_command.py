"""A command of the command line, in a module of its own: ``uard --help`` imports it, so it should be light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from uard import InvalidValueError

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Bells:
    """Say how many rings pay as much as the goal."""

    bell: float = 2.0
    """What a ring pays."""

    def run(self, console: Console) -> None:
        """Print it; ``console`` is standard error."""
        if not self.bell > 0:
            raise InvalidValueError("bell", self.bell, "a number > 0")
        print(f"{10 / self.bell:g} rings pay as much as the goal")
