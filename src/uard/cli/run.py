"""``uard run``: train one agent and print its metrics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from uard import __version__, _checks
from uard._support.text import counted
from uard.cli import settings, terminal, training
from uard.cli.settings import Pairs
from uard.cli.training import UNWATCHED, WatchOptions

if TYPE_CHECKING:
    from rich.console import Console

    from uard.lab.cell import Cell


@dataclass(frozen=True)
class Run:
    """Train one agent on one environment with one mitigation, and print its metrics.

    Metrics are per episode over the last 100 episodes; every interval is over seeds.
    """

    environment: Positional[str] = "TrapGrid"
    """Which environment (see `uard list`)."""
    set: Pairs = ()
    """Change a field of the environment, e.g. size=12 or 'traps=[[2,5],[7,3]]'. Repeatable."""
    agent: str = "q-learning"
    """Which agent."""
    set_agent: Pairs = ()
    """Change a field of the agent, e.g. heads=1. Repeatable."""
    mitigation: str = "uard"
    """What the agent does about a reward that may lie."""
    set_mitigation: Pairs = ()
    """Change a field of the mitigation, e.g. vetoes=1, or lam=5 of uard-0.1. Repeatable."""
    panel: str = "main"
    """Who rates: a name, random:SEED, or random:SEED:SCALE for rewards of another size than a grid's."""
    noise: float = 0.0
    """Standard deviation of extra noise on every rater, in reward units."""
    noise_fraction: float | None = None
    """The same as a fraction of the trap's reward (instead of --noise)."""
    rated: float = 1.0
    """Fraction of steps that are rated."""
    query: str = "random"
    """Which steps are rated: random, or (Hopper and Walker2d) doubtful: half of them where the raters' model knows
    least."""
    feedback: str | None = None
    """How a deep agent knows of ratings: model (learned; what is taken if left out) or table (running means)."""
    episodes: int = 500
    """Training episodes."""
    steps: int | None = None
    """Environment steps, instead of episodes, for Hopper and Walker2d; 1 000 000 if left out."""
    seeds: int = 10
    """Number of seeds (0, 1, ...)."""
    json: str | None = None
    """Write one JSON object to this file; - for standard output."""
    store: str | None = None
    """Keep finished seeds in this file and do not train them again."""
    watch: WatchOptions = UNWATCHED

    def run(self, console: Console) -> None:
        """Train, then print a table or JSON."""
        import time

        from uard.lab.execution.store import Store
        from uard.lab.result import summaries
        from uard.lab.study import results_of
        from uard.ratings.panels import RANDOM, as_panel, composition
        from uard.training.xla import device_name

        _checks.whole("seeds", self.seeds, low=1, high=100_000)
        terminal.check_json(self.json, self.store)
        cell, trap_reward = self._cell()
        if self.panel.startswith(RANDOM):
            terminal.say(console, f"{self.panel}: {composition(as_panel(self.panel))}")
        store = Store(":memory:" if self.store is None else self.store)
        seeds = range(self.seeds)
        started = time.perf_counter()
        jobs = [(cell, s) for s in seeds]
        trained = training.train(jobs, store, console, f"training {counted(len(seeds), 'seed')}", self.watch)
        seconds = time.perf_counter() - started
        results = results_of(cell, store, seeds)
        metrics = summaries(results)
        steps = sum(r.steps for r in results)
        if self.json is not None:
            answer = {
                "metrics": {name: s._asdict() for name, s in metrics.items()},
                "steps_per_second": round(steps / seconds) if trained == len(seeds) else None,
                "steps": steps,
                "noise_as_fraction_of_trap_reward": cell.noise / abs(trap_reward) if trap_reward else None,
                "seeds": list(seeds),
                "config": cell.config(),
                "key": cell.key,
                "version": __version__,
                "device": device_name(),
            }
            terminal.write_json(answer, self.json)
        if self.json != "-":
            self._print(metrics)

    def _cell(self) -> tuple[Cell, float]:
        """Return what is trained, and the reward of its environment's traps (0 if it has none)."""
        from uard.lab import registry
        from uard.lab.cell import Cell
        from uard.ratings.panels import as_panel

        environment = registry.environment(self.environment, settings.settings(self.set))
        trap_reward = getattr(environment, "trap_reward", 0.0)
        agent = registry.agent(self.agent, settings.settings(self.set_agent, "--set-agent"), environment)
        changes = settings.settings(self.set_mitigation, "--set-mitigation")
        cell = Cell(
            environment,
            settings.mitigation(self.mitigation, changes),
            agent,
            as_panel(self.panel),
            self._noise(trap_reward),
            self.rated,
            self.episodes,
            rating_model=registry.rating_model(self.feedback, agent, environment),
            steps=self.steps,
            query=self.query,
        )
        return cell, trap_reward

    def _noise(self, trap_reward: float) -> float:
        if self.noise_fraction is None:
            return self.noise
        _checks.number("noise_fraction", self.noise_fraction, low=0)
        if not trap_reward:
            allowed = "left out where no trap pays; see --noise"
            raise _checks.InvalidValueError("noise_fraction", self.noise_fraction, allowed)
        if self.noise:
            raise _checks.InvalidValueError("noise", self.noise, "left out when --noise-fraction is given")
        return self.noise_fraction * abs(trap_reward)

    def _print(self, metrics: dict[str, Any]) -> None:
        title = f"{self.environment} / {self.agent} / {self.mitigation} / {self.panel}, {counted(self.seeds, 'seed')}"
        rows = []
        for name, s in metrics.items():
            mean = f"{s.mean:z.3f} [{s.ci95[0]:z.3f}, {s.ci95[1]:z.3f}]" if s.ci95 else f"{s.mean:z.3f} one run"
            rows.append((name.replace("_", " "), mean, f"{s.sd:.3f}" if s.ci95 else "–", f"{s.iqm:z.3f}"))
        terminal.table(("metric", "mean [95 %]", "sd", "IQM"), rows, title)
