"""``uard collect simulate``: a simulated panel at the page, in place of people."""

from __future__ import annotations

import re
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from uard import __version__, _checks
from uard._support.text import counted
from uard.cli import terminal
from uard.cli.settings import Pairs
from uard.cli.settings import settings as read
from uard.ratings.panels import RANGE

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.console import Console

    from uard.collect import Question
    from uard.ratings.panels import Panel, RatingLaw

NAME = "simulated-"  # before the number of a rater


@dataclass(frozen=True)
class Simulate:
    """Let a simulated panel rate at a page that `uard collect serve` shows on this machine: for trying, not for data.

    The raters come in by links of their own, and answer through the same interface as browsers do. They leave when
    there has been nothing to rate for a while. What they say stands in the project as what people say does, so take a
    copy of one in which people rate.
    """

    project: Positional[str]
    """A project's folder."""
    panel: str = "random:7"
    """Who rates: a name, random:SEED, or random:SEED:SCALE. The scale, which is 1 for a grid's rewards, is that of the
    project's range if it is left out."""
    url: str = "http://127.0.0.1:8321"
    """The page's address."""
    environment: str | None = None
    """Whose tables say what a step is truly worth, such as TrapGrid, for clips of one step. If left out, raters take
    the observed reward for the true one."""
    set: Pairs = ()
    """A field of the environment, e.g. size=8. Repeatable."""
    answers: int | None = None
    """Answers after which each rater leaves."""
    idle: float = 5.0
    """Seconds without anything to rate after which each rater leaves."""
    pause: float = 0.0
    """Seconds that each rater takes for an answer."""
    seed: int = 0
    """Of what they draw."""
    beside_people: bool = False
    """Rate also where people have answered."""
    json: str | None = None
    """Write one JSON object to this file; - for standard output."""

    def run(self, console: Console) -> None:
        """Let them rate, and say how many answers there were and how long each took."""
        import numpy as np

        from uard.collect import Project
        from uard.collect.simulate import Simulation, Visitor, law_by_reward
        from uard.ratings.panels import as_panel

        for name, value in (("idle", self.idle), ("pause", self.pause)):
            _checks.number(name, value, low=0, high=1e6)
        if self.answers is not None:
            _checks.whole("answers", self.answers, low=1)
        _checks.whole("seed", self.seed)
        Visitor(self.url)  # an address that is none is refused before anybody is invited
        project = Project.open(self.project)
        project.outside(self.json, "json")
        panel = as_panel(self._scaled(project.question))
        law_of = law_by_reward(panel) if self.environment is None else self._by_tables(panel)
        with closing(project.store()) as store:
            people = [a.rater for a in store.answers()[0] if not a.rater.startswith(NAME)]
            if people and not self.beside_people:
                allowed = f"a copy of it, or with --beside-people: {people[0]} has answered, and this is not undone"
                raise _checks.InvalidValueError("project", self.project, allowed)
            links = {f"{NAME}{k + 1}": "" for k in range(len(panel.raters))}
            links = {name: store.invite(name) for name in links}
        visit = Simulation(
            self.url, links, project, law_of, self.seed, pause=self.pause, idle=self.idle, most=self.answers
        )
        report = visit.run()
        for name, why in report.errors.items():
            terminal.warning(console, f"{name}: {why}")
        milliseconds = 1000 * np.array(report.seconds or [0.0])
        numbers: dict[str, Any] = {
            "answers": sum(map(len, report.acknowledged.values())),
            "raters": {name: len(done) for name, done in report.acknowledged.items()},
            "median_ms": float(np.median(milliseconds)),
            "percentile_95_ms": float(np.quantile(milliseconds, 0.95)),
            "errors": report.errors,
        }
        if self.json is not None:
            terminal.write_json({"version": __version__, "project": self.project} | numbers, self.json)
        if self.json != "-":
            each = f"median {numbers['median_ms']:.0f} ms, 95 % within {numbers['percentile_95_ms']:.0f} ms"
            terminal.say(terminal.output(), f"{counted(numbers['answers'], 'answer')}; {each}")
        if report.errors:
            raise SystemExit(1)

    def _scaled(self, question: Question) -> str:
        """Return the panel's name, with the scale of the question's range if it is a random one without a scale."""
        scale = (question.high - question.low) / (RANGE[1] - RANGE[0])
        return f"{self.panel}:{scale:.6f}" if re.fullmatch(r"random:\d+", self.panel) else self.panel

    def _by_tables(self, panel: Panel) -> Callable[[Any], RatingLaw]:
        from uard.envs import names
        from uard.envs.base import TableEnvironment

        world = names.build(str(self.environment), **read(self.set))
        if not isinstance(world, TableEnvironment):
            raise _checks.InvalidValueError("environment", self.environment, "one of numbered states, such as TrapGrid")
        law = world.rating_law(panel)

        def of(content: Any) -> RatingLaw:
            key = content.get("key")
            if key is None:
                raise _checks.InvalidValueError("item", content, "a clip of one step (uard collect record --length 1)")
            return law.at(*key)

        return of
