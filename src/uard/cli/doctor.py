"""``uard doctor``: name the traps in a log of rewards and ratings. Needs no JAX."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from uard import InvalidValueError, __version__
from uard.cli import terminal
from uard.cli.settings import Pairs, Words
from uard.cli.settings import mitigation as mitigation_named
from uard.cli.settings import settings as read

if TYPE_CHECKING:
    from rich.console import Console

    from uard import RatingLog


@dataclass(frozen=True)
class Doctor:
    """Name every known trap that a log of rewards and ratings is in, and what avoids it.

    Exit code 0: no danger; 1: a danger (with --strict also a warning); 2: bad input.
    """

    log: Positional[str]
    """A CSV, JSON, JSONL or Parquet file (columns: reward, rating..., and if you have them sigma_m, true_reward, item,
    episode, step; or a row per answer, as annotation tools export them), or the id of a Gymnasium environment, which is
    rolled out with random actions."""
    reward: str = "reward"
    """The column of rewards."""
    ratings: tuple[str, ...] = ()
    """The annotators' columns; all that start with `rating` if left out."""
    rater: str | None = None
    """In a log of one answer per row, the column that says who rated."""
    item: str | None = None
    """The column that says what was rated."""
    rating: str | None = None
    """In a log of one answer per row, the column of ratings, or the question whose answers are read."""
    missing: Words = ()
    """A further word that means that a number is missing, e.g. '?'. Repeatable."""
    mitigation: str = "uard"
    """The filter that is going to be used."""
    set_mitigation: Pairs = ()
    """Change a field of it, e.g. kappa=0. Repeatable."""
    set: Pairs = ()
    """A keyword of the environment, e.g. panel=main. Repeatable."""
    steps: int = 1000
    """Steps in the environment."""
    seed: int = 0
    """Seed of the environment and of the actions."""
    strict: bool = False
    """Let a warning count as a danger."""
    json: str | None = None
    """Write one JSON object to this file; - for standard output."""

    def run(self, console: Console) -> None:
        """Read or roll out the log, and print what was found."""
        from uard import doctor

        terminal.check_json(self.json)
        mitigation: Any = self.mitigation
        if self.set_mitigation:
            mitigation = mitigation_named(mitigation, read(self.set_mitigation, "--set-mitigation"))
        found = doctor(self._log(), mitigation)
        if self.json is not None:
            terminal.write_json({"version": __version__} | found.as_data(), self.json)
        if self.json != "-":
            print(found)
        if found.count("danger") or (self.strict and found.count("warning")):
            sys.exit(1)

    def _log(self) -> RatingLog:
        """Return the log: of a file if it looks like one, else of an environment."""
        from uard.ratings import readers, rollout

        if Path(self.log).suffix.lower() in readers.FORMATS or os.path.exists(self.log):
            columns = {"rater": self.rater, "item": self.item, "rating": self.rating}
            return readers.read(self.log, self.reward, self.ratings or None, **columns, missing=self.missing)
        import gymnasium

        import uard.envs  # noqa: F401  (registers ids)

        keywords = read(self.set)
        try:
            env = gymnasium.make(self.log, **keywords)
        except gymnasium.error.Error as error:
            endings = ", ".join(readers.FORMATS)
            allowed = f"a file that ends in {endings}, or the id of a Gymnasium environment ({error})"
            raise InvalidValueError("log", self.log, allowed) from None
        except TypeError as error:  # an unknown keyword
            raise InvalidValueError("set", dict(keywords), f"keywords of {self.log} ({error})") from None
        try:
            return rollout.rollout(env, self.steps, self.seed)
        finally:
            env.close()
