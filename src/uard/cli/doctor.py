"""``uard doctor``: name the traps in a log of rewards and ratings. Needs no JAX."""

from __future__ import annotations

import importlib
import inspect
import os
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from uard import InvalidValueError, __version__, _checks
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
    """Change a field of it, e.g. vetoes=1. Repeatable."""
    by: str | None = None
    """A column of the file that divides the rows into parts; agreement is reported within each."""
    set: Pairs = ()
    """A keyword of the environment, e.g. panel=main. Repeatable."""
    steps: int | None = None
    """Steps in the environment; 1000 if left out."""
    seed: int | None = None
    """Seed of the environment and of the actions; 0 if left out."""
    strict: bool = False
    """Let a warning count as a danger."""
    json: str | None = None
    """Write one JSON object to this file; - for standard output."""

    def run(self, console: Console) -> None:
        """Read or roll out the log, and print what was found."""
        from uard import doctor

        terminal.check_json(self.json, self.log)
        mitigation: Any = self.mitigation
        if self.set_mitigation:
            mitigation = mitigation_named(mitigation, read(self.set_mitigation, "--set-mitigation"))
        found = doctor(self._log(), mitigation)
        if self.json is not None:
            terminal.write_json({"version": __version__} | found.as_data(), self.json)
        if self.json != "-":
            terminal.lines(found.text(min(100, terminal.width())))
        if found.count("danger") or (self.strict and found.count("warning")):
            sys.exit(1)

    def _log(self) -> RatingLog:
        """Return the log: of a file if it looks like one, else of an environment."""
        from uard.ratings import readers, rollout

        if Path(self.log).suffix.lower() in readers.FORMATS or os.path.exists(self.log):
            self._only("an environment", "set", "steps", "seed")
            columns = {"rater": self.rater, "item": self.item, "rating": self.rating, "by": self.by}
            return readers.read(self.log, self.reward, self.ratings or None, **columns, missing=self.missing)
        self._only("a file", "reward", "ratings", "rater", "item", "rating", "missing", "by")
        env = _environment(self.log, read(self.set))
        try:
            return rollout.rollout(
                env, 1000 if self.steps is None else self.steps, 0 if self.seed is None else self.seed
            )
        finally:
            env.close()

    def _only(self, what: str, *options: str) -> None:
        """Refuse options that do not apply to the log.

        Raises:
            InvalidValueError: naming the option.
        """
        defaults = {f.name: f.default for f in fields(self)}
        for name in options:
            if (value := getattr(self, name)) != defaults[name]:
                raise InvalidValueError(f"--{name}", value, f"left out: it is for {what}, and {self.log} is none")


def _environment(name: str, keywords: dict[str, Any]) -> Any:
    """Return an environment by its id.

    Raises:
        InvalidValueError: there is none of that name, or it has no such keyword (the message lists those it has).
    """
    import gymnasium
    from gymnasium.envs.registration import load_env_creator

    import uard.envs  # noqa: F401  (registers ids)
    from uard.ratings import readers

    module, colon, known = name.rpartition(":")
    try:
        if colon:
            importlib.import_module(module)
        if (spec := gymnasium.registry.get(known)) is not None:
            creator: Any = spec.entry_point
            known_to = inspect.signature(load_env_creator(creator) if isinstance(creator, str) else creator).parameters
            for keyword in () if any(p.kind is p.VAR_KEYWORD for p in known_to.values()) else keywords:
                _checks.choose(f"keyword of {name}", keyword, known_to)
        return gymnasium.make(known, **keywords)
    except InvalidValueError:
        raise
    except (gymnasium.error.Error, ImportError, AttributeError, TypeError, ValueError) as error:
        endings = ", ".join(readers.FORMATS)
        allowed = f"a file that ends in {endings}, or the id of a Gymnasium environment ({error})"
        raise InvalidValueError("log", name, allowed) from None
