"""The command line, ``uard run`` and its like (``uard --help``). A command imports what it needs when it runs."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from uard import __version__

if TYPE_CHECKING:
    from rich.console import Console

DEFAULT_STORE = "results/uard.sqlite"
_NEEDS_LAB = "the laboratory is not installed: pip install 'uard[lab]'"

try:
    import tyro
    from tyro.conf import Positional, UseAppendAction, arg
except ModuleNotFoundError:  # the core is installed without its laboratory
    sys.exit(_NEEDS_LAB)

_Pairs = UseAppendAction[tuple[str, ...]]


@dataclass(frozen=True)
class Watch:
    """What to leave for those who watch."""

    tensorboard: str | None = None
    """Write TensorBoard event files of every finished seed below this folder."""
    log: str | None = None
    """Append what happens to this file."""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """The least that is worth a line there."""


_Watch = Annotated[Watch, arg(name="")]


@dataclass(frozen=True)
class Run:
    """Train one agent on one environment with one mitigation, and print its metrics.

    Metrics are per episode over the last 100 episodes; every interval is over seeds.
    """

    environment: Positional[str] = "TrapGrid"
    """Which environment (see `uard list`)."""
    set: Annotated[_Pairs, arg(metavar="NAME=VALUE")] = ()
    """Change a field of the environment, e.g. size=12 or 'traps=[[2,5],[7,3]]'. Repeatable."""
    agent: str = "q-learning"
    """Which agent."""
    set_agent: Annotated[_Pairs, arg(metavar="NAME=VALUE")] = ()
    """Change a field of the agent, e.g. heads=1. Repeatable."""
    mitigation: str = "uard"
    """What the agent does about a reward that may lie."""
    set_mitigation: Annotated[_Pairs, arg(metavar="NAME=VALUE")] = ()
    """Change a field of the mitigation, e.g. lam=5 or kappa=0. Repeatable."""
    panel: str = "main"
    """Who rates."""
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
    watch: _Watch = Watch()


@dataclass(frozen=True)
class Reproduce:
    """Run the paper's grid studies and ours, and write the report. Finished cells are never run again."""

    studies: Positional[tuple[str, ...]] = ()
    """Which studies or groups of them (see `uard list`): grid if left out, grid-deep, games."""
    mitigation: Annotated[_Pairs, arg(metavar="NAME")] = ()
    """Let this one, your own perhaps, join every study that compares mitigations. Repeatable."""
    seeds: int = 10
    """Number of seeds (0, 1, ...)."""
    report: str | None = None
    """Write the report into this folder; only possible for the whole grid."""
    extract: str | None = None
    """Write what the report needs of these studies to this small JSON file (- for standard output)."""
    store: str = DEFAULT_STORE
    """Where finished seeds are kept."""
    workers: int | None = None
    """Processes; one per core if left out."""
    engine: str = "local"
    """Who trains: local (processes of this machine) or ray (a Ray cluster)."""
    address: str | None = None
    """Of the Ray cluster's head, host:port, or auto; if left out, Ray is started on this machine."""
    gpus: float = 0.0
    """GPUs of a Ray task, a fraction perhaps."""
    failed: bool = False
    """Only what failed when it was last tried."""
    watch: _Watch = Watch()


@dataclass(frozen=True)
class Ledger:
    """Say of every claim of the paper that a grid can answer whether it holds."""

    claims: Positional[tuple[str, ...]] = ()
    """Only these, e.g. J5 F3; all if left out."""
    json: str | None = None
    """Write the ledger as JSON to this file; - for standard output."""
    seeds: int = 10
    """Number of seeds (0, 1, ...)."""
    store: str = DEFAULT_STORE
    """Where finished seeds are kept; what is missing is trained first."""
    workers: int | None = None
    """Processes; one per core if left out."""
    watch: _Watch = Watch()


@dataclass(frozen=True)
class Status:
    """Say how far studies are, who is at work on them, and what failed; changes nothing."""

    studies: Positional[tuple[str, ...]] = ()
    """Which studies or groups of them; those of which the store knows anything if left out."""
    seeds: int | None = None
    """Seeds that every cell should have; as many as the store knows of any cell of a study if left out."""
    errors: bool = False
    """Print the tracebacks of what failed."""
    json: str | None = None
    """Write one JSON object to this file; - for standard output."""
    store: str = DEFAULT_STORE
    """Where finished seeds are kept."""


@dataclass(frozen=True)
class Compare:
    """Say whether two stores agree: bit by bit, or but for the noise over seeds. Exit code 1 if they do not."""

    store_a: Positional[str]
    """One store."""
    store_b: Positional[str]
    """The other: of another machine, version, engine."""
    json: str | None = None
    """Write one JSON object to this file; - for standard output."""


@dataclass(frozen=True)
class BestOfN:
    """Choose the best of n = 1 .. 10 000 by K reward models, and see what it is worth in gold."""

    seeds: int = 20
    """Number of seeds (0, 1, ...); about a second each."""
    json: str | None = None
    """Write one JSON object to this file; - for standard output."""


@dataclass(frozen=True)
class Leaderboard:
    """Write a page that ranks mitigations over everything that a store holds, your own included."""

    store: str = DEFAULT_STORE
    """Where finished seeds are kept; nothing is trained."""
    out: str = "leaderboard.html"
    """The page."""


@dataclass(frozen=True)
class List:
    """List environments, agents, mitigations, panels and studies."""


@dataclass(frozen=True)
class Doctor:
    """Name every known trap that a log of rewards and ratings is in, and what avoids it.

    Exit code 0: no danger; 1: a danger (with --strict also a warning); 2: bad input.
    """

    log: Positional[str]
    """A CSV, JSONL or Parquet file (columns: reward, rating..., and if you have them sigma_m, true_reward, item,
    episode, step), or the id of a Gymnasium environment, which is rolled out with random actions."""
    reward: str = "reward"
    """The column of rewards."""
    ratings: tuple[str, ...] = ()
    """The annotators' columns; all that start with `rating` if left out."""
    mitigation: str = "uard"
    """The filter that is going to be used."""
    set_mitigation: Annotated[_Pairs, arg(metavar="NAME=VALUE")] = ()
    """Change a field of it, e.g. kappa=0. Repeatable."""
    set: Annotated[_Pairs, arg(metavar="NAME=VALUE")] = ()
    """A keyword of the environment, e.g. panel=main. Repeatable."""
    steps: int = 1000
    """Steps in the environment."""
    seed: int = 0
    """Seed of the environment and of the actions."""
    strict: bool = False
    """Let a warning count as a danger."""
    json: str | None = None
    """Write one JSON object to this file; - for standard output."""


Command = (
    Annotated[Run, tyro.conf.subcommand("run")]
    | Annotated[Reproduce, tyro.conf.subcommand("reproduce")]
    | Annotated[Ledger, tyro.conf.subcommand("ledger")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
    | Annotated[BestOfN, tyro.conf.subcommand("best-of-n")]
    | Annotated[Leaderboard, tyro.conf.subcommand("leaderboard")]
    | Annotated[Status, tyro.conf.subcommand("status")]
    | Annotated[Compare, tyro.conf.subcommand("compare")]
    | Annotated[List, tyro.conf.subcommand("list")]
)


class _TerminatedError(KeyboardInterrupt):
    """SIGTERM, which ends a study as an interrupt does."""


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line.

    Exit code 2 for bad input, 1 for failed runs, a danger or a difference, 130 for an interrupt, 143 for SIGTERM.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments in (["--version"], ["-V"]):
        print(f"uard {__version__}")
        return
    command: Any = tyro.cli(Command, prog="uard", args=arguments, description="Rewards that cannot be fully trusted.")
    from rich.console import Console

    from uard import InvalidValueError

    console = Console(stderr=True, highlight=False)
    try:
        from uard.lab.execution.cluster import ClusterError
        from uard.lab.execution.runner import StudyFailedError
        from uard.lab.execution.store import StoreError
    except ModuleNotFoundError as error:
        sys.exit(f"{_NEEDS_LAB} ({error})")
    try:
        with _terminable():
            _BODIES[type(command)](command, console)
    except (ClusterError, InvalidValueError, StoreError) as error:
        _say(console, str(error), "[red]error:[/red] ")
        sys.exit(2)
    except StudyFailedError as error:
        _say(console, str(error), "[red]error:[/red] ")
        _print_failures(error, command, console)
        sys.exit(1)
    except KeyboardInterrupt as stop:
        what, code = ("terminated", 143) if isinstance(stop, _TerminatedError) else ("interrupted", 130)
        _say(console, f"{what}; every finished cell is stored, the same command goes on from there")
        sys.exit(code)


@contextmanager
def _terminable() -> Iterator[None]:
    """Let SIGTERM end the block as an interrupt does, once; a second one would only disturb the ending."""

    def stop(number: int, _: object) -> None:
        signal.signal(number, signal.SIG_IGN)
        raise _TerminatedError

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _print_failures(error: Any, command: Any, console: Console) -> None:
    """Say which cells failed, one line each, and how to run only those."""
    from uard.lab import studies
    from uard.lab.views.status import titles

    names = titles(studies.find(command.studies)) if isinstance(command, Reproduce) else {}
    cells: dict[tuple[str, str], list[int]] = {}
    for failure in error.failures:
        why = failure.error.strip().rpartition("\n")[2]
        for cell, seed in failure.jobs:
            cells.setdefault((names.get(cell.key) or str(cell), why), []).append(seed)
    for (name, why), seeds in list(cells.items())[:_LINES]:
        _say(console, f"failed: {name}, seeds {sorted(seeds)}: {why}")
    if len(cells) > _LINES:
        _say(console, f"and {len(cells) - _LINES} cells more")
    if isinstance(command, Reproduce):
        chosen = "".join(f"{name} " for name in command.studies)
        where = f"--store {command.store}"
        again = f"uard reproduce {chosen}--seeds {command.seeds} {where} --failed"
        errors = f"uard status {chosen}{where} --errors"
        _say(console, f"only these again: {again}\ntheir tracebacks: {errors}")


def _say(console: Console, text: str, kind: str = "") -> None:
    """Print a line whole, for a path that is broken in two can be neither copied nor found."""
    console.print(kind + _escape(text), soft_wrap=True)


def _escape(text: str) -> str:
    from rich.markup import escape

    return escape(text)


def _run(command: Run, console: Console) -> None:
    import time

    from uard import _checks
    from uard.lab import registry as names
    from uard.lab.cell import Cell
    from uard.lab.execution.store import Store
    from uard.lab.result import summaries
    from uard.lab.study import results_of
    from uard.ratings.panels import as_panel

    _checks.whole("seeds", command.seeds, low=1, high=100_000)
    _check_json(command.json)
    environment = names.environment(command.environment, names.settings(command.set))
    noise = command.noise
    trap_reward = getattr(environment, "trap_reward", 0.0)
    if command.noise_fraction is not None:
        _checks.number("noise_fraction", command.noise_fraction, low=0)
        if not trap_reward:
            raise _checks.InvalidValueError(
                "noise_fraction", command.noise_fraction, "left out where no trap pays; see --noise"
            )
        if noise:
            raise _checks.InvalidValueError("noise", noise, "left out when --noise-fraction is given")
        noise = command.noise_fraction * abs(trap_reward)
    agent = names.agent(command.agent, names.settings(command.set_agent, "--set-agent"), environment)
    cell = Cell(
        environment,
        names.mitigation_named(command.mitigation, names.settings(command.set_mitigation, "--set-mitigation")),
        agent,
        as_panel(command.panel),
        noise,
        command.rated,
        command.episodes,
        rating_model=names.rating_model(command.feedback, agent, environment),
        steps=command.steps,
        query=command.query,
    )
    store = Store(command.store or ":memory:")
    seeds = range(command.seeds)
    started = time.perf_counter()
    what = f"training {len(seeds)} seeds"
    trained = _train([(cell, s) for s in seeds], store, console, what, command.watch)
    seconds = time.perf_counter() - started
    results = results_of(cell, store, seeds)
    metrics = summaries(results)
    steps = sum(r.steps for r in results)
    answer = {
        "metrics": {name: s._asdict() for name, s in metrics.items()},
        "steps_per_second": round(steps / seconds) if trained == len(seeds) else None,
        "steps": steps,
        "noise_as_fraction_of_trap_reward": noise / abs(trap_reward) if trap_reward else None,
        "seeds": list(seeds),
        "config": cell.config(),
        "key": cell.key,
        "version": __version__,
    }
    if command.json is not None:
        _write_json(answer, command.json)
    if command.json != "-":
        from rich.console import Console
        from rich.table import Table

        title = f"{command.environment} / {command.agent} / {command.mitigation} / {command.panel}, {len(seeds)} seeds"
        table = Table("metric", "mean", "sd", "95 % interval", "IQM", title=title)
        for name, s in metrics.items():
            interval = f"{s.ci95[0]:.3f} .. {s.ci95[1]:.3f}"
            table.add_row(name.replace("_", " "), f"{s.mean:.3f}", f"{s.sd:.3f}", interval, f"{s.iqm:.3f}")
        Console().print(table)


def _train(
    jobs: Any,
    store: Any,
    console: Console,
    what: str,
    watch: Watch,
    workers: int | None = None,
    studies: Sequence[Any] = (),
    engine: Any = None,
) -> int:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from uard.lab.execution import runner
    from uard.lab.views.status import duration, titles

    events = None
    if watch.tensorboard is not None:
        from uard.lab.views.tensorboard import Events

        events = Events(watch.tensorboard, titles(studies))
        events.catch_up(store, jobs)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}"),
    )
    with _logging(watch), Progress(*columns, console=console) as bar:
        task = bar.add_task(what, total=None, left="")

        def progress(done: int, total: int, left: float | None) -> None:
            text = "" if left is None else f"about {duration(left)} left" if done < total else "done"
            bar.update(task, completed=done, total=total, left=text)

        trained = runner.run(jobs, store, workers, progress, events.write if events else None, engine)
    if events:
        events.catch_up(store, jobs)  # what other processes have trained
    return trained


@contextmanager
def _logging(watch: Watch) -> Iterator[None]:
    """Append to the file what the library logs, as long as the block runs."""
    import logging
    import time

    if watch.log is None:
        yield
        return
    _check_writable("log", watch.log, Path(watch.log).parent)
    try:
        handler = logging.FileHandler(watch.log, encoding="utf-8")
    except OSError as error:
        raise _invalid("log", watch.log, f"a file that can be written ({error})") from None
    form = logging.Formatter(f"%(asctime)s.%(msecs)03dZ {os.getpid()} %(levelname)s %(message)s", "%Y-%m-%dT%H:%M:%S")
    form.converter = time.gmtime
    handler.setFormatter(form)
    logger = logging.getLogger("uard")
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(watch.log_level.upper())
    try:
        yield
    except BaseException as error:
        logger.error("ended by %s", type(error).__name__)
        raise
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)
        handler.close()


def _check_json(target: str | None) -> None:
    """Refuse before training, not after it, what cannot be written."""
    if target is not None and target != "-":
        _check_writable("json", target, Path(target).parent)
        if Path(target).is_dir():
            raise _invalid("json", target, "a file, not a folder")


def _check_writable(field: str, target: str, folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _invalid(field, target, f"in a folder that can be written ({error})") from None
    if not os.access(folder, os.W_OK):
        raise _invalid(field, target, "in a folder that can be written")


def _invalid(field: str, value: object, allowed: str) -> Exception:
    from uard import InvalidValueError

    return InvalidValueError(field, value, allowed)


def _write_json(data: Any, target: str, option: str = "json", indent: int | None = 2) -> None:
    text = json.dumps(data, indent=indent, allow_nan=False)
    if target == "-":
        print(text)
        return
    half = Path(f"{target}.{os.getpid()}.part")  # what is at the target is whole at any time
    try:
        half.write_text(text + "\n", encoding="utf-8")
        half.replace(target)
    except OSError as error:
        half.unlink(missing_ok=True)
        raise _invalid(option, target, f"a file that can be written ({error})") from None


def _check_workers(workers: int | None) -> None:
    from uard import _checks

    if workers is not None:
        _checks.whole("workers", workers, low=0, high=1024)


def _engine(command: Reproduce) -> Any:
    from uard import _checks
    from uard.lab.execution.cluster import Ray

    if _checks.choose("engine", command.engine, ("local", "ray")) == "ray":
        if command.workers is not None:
            raise _invalid("workers", command.workers, "left out with --engine ray")
        return Ray(command.address, command.gpus)
    for option, given in (("address", command.address), ("gpus", command.gpus)):
        if given:
            raise _invalid(option, given, "left out without --engine ray")
    return None


def _reproduce(command: Reproduce, console: Console) -> None:
    from uard import _checks
    from uard.lab import studies
    from uard.lab.execution.store import Store

    _checks.whole("seeds", command.seeds, low=2, high=100_000)
    _check_workers(command.workers)
    engine = _engine(command)
    _warn_of_broken(console)
    chosen = studies.find(command.studies, command.mitigation)
    if command.report and {s.name for s in chosen} < {s.name for s in studies.grid()}:
        raise _invalid("report", command.report, "left out unless all grid studies are run")
    if command.report:
        _check_writable("report", command.report, Path(command.report))
    _check_json(command.extract)
    for name in ("report", "extract"):
        if command.failed and getattr(command, name) is not None:
            raise _invalid(name, getattr(command, name), "left out with --failed, which runs a part only")
    store = Store(command.store)
    seeds = range(command.seeds)
    jobs = list(dict.fromkeys(job for study in chosen for job in study.jobs(seeds)))
    if command.failed:
        failures = store.failures()
        jobs = [(cell, seed) for cell, seed in jobs if (cell.key, seed) in failures]
    what = f"{len(chosen)} studies, {len(jobs)} runs"
    trained = _train(jobs, store, console, what, command.watch, command.workers, chosen, engine)
    _say(console, f"{trained} runs trained, {len(jobs) - trained} were in {command.store} already")
    if command.failed:
        return
    if command.extract is not None:
        from uard.lab.views import published

        line = f"uard reproduce {' '.join(command.studies)} --seeds {command.seeds}"
        _write_json(published.extract(chosen, store, seeds, line), command.extract, "extract", indent=None)
    if command.report:
        from uard.lab.views import page

        with console.status("writing the report"):
            written = page.write(Path(command.report), store, seeds, command.mitigation)
        _say(console, f"report: {written}")
    else:
        from rich.console import Console

        from uard.lab.views.evidence import Evidence
        from uard.lab.views.tables import study_table

        evidence = Evidence(store, seeds, chosen)
        for study in chosen:
            study_table(study, evidence).to_rich(Console())


def _ledger(command: Ledger, console: Console) -> None:
    from uard import _checks
    from uard.lab import studies
    from uard.lab.execution.store import Store
    from uard.lab.views.evidence import Evidence
    from uard.replication import ledger

    _checks.whole("seeds", command.seeds, low=2, high=100_000)
    _check_workers(command.workers)
    _check_json(command.json)
    for claim in command.claims:
        _checks.choose("claim", claim, ledger.CLAIMS)
    store = Store(command.store)
    seeds = range(command.seeds)
    jobs = [job for study in studies.grid() for job in study.jobs(seeds)]
    _train(jobs, store, console, "what the ledger needs", command.watch, command.workers, studies.grid())
    evidence = Evidence(store, seeds, studies.grid())
    entries = [e for e in ledger.entries(evidence) if not command.claims or e.claim in command.claims]
    if command.json is not None:
        _write_json(ledger.as_data(entries, seeds), command.json)
    if command.json != "-":
        ledger.to_rich(entries)


def _doctor(command: Doctor, console: Console) -> None:
    from uard import doctor
    from uard.lab import registry as names

    _check_json(command.json)
    mitigation: Any = command.mitigation
    if command.set_mitigation:
        changes = names.settings(command.set_mitigation, "--set-mitigation")
        mitigation = names.mitigation_named(command.mitigation, changes)
    found = doctor(_log(command), mitigation)
    if command.json is not None:
        _write_json({"version": __version__} | found.as_data(), command.json)
    if command.json != "-":
        print(found)
    if found.count("danger") or (command.strict and found.count("warning")):
        sys.exit(1)


def _log(command: Doctor) -> Any:
    """Return the log: of a file if it looks like one, else of an environment."""
    import gymnasium

    import uard.envs  # noqa: F401  (registers ids)
    from uard.lab import registry as names
    from uard.ratings import readers as logs
    from uard.ratings import rollout

    if Path(command.log).suffix.lower() in logs.FORMATS or Path(command.log).exists():
        return logs.read(command.log, command.reward, command.ratings or None)
    settings = names.settings(command.set)
    try:
        env = gymnasium.make(command.log, **settings)
    except gymnasium.error.Error as error:
        allowed = f"a file that ends in {', '.join(logs.FORMATS)}, or the id of a Gymnasium environment ({error})"
        raise _invalid("log", command.log, allowed) from None
    except TypeError as error:  # an unknown keyword
        raise _invalid("set", dict(settings), f"keywords of {command.log} ({error})") from None
    with env:
        return rollout.rollout(env, command.steps, command.seed)


def _best_of_n(command: BestOfN, console: Console) -> None:
    from uard import _checks
    from uard.lab.studies import best_of_n
    from uard.lab.views import best_of_n as overoptimisation

    _checks.whole("seeds", command.seeds, low=2, high=100_000)
    _check_json(command.json)
    with console.status(f"choosing the best of n, {command.seeds} seeds"):
        result = best_of_n.run(range(command.seeds))
    data = {"command": f"uard best-of-n --seeds {command.seeds}", "version": __version__} | result.as_data()
    if command.json is not None:
        _write_json(data, command.json, indent=None)
    if command.json != "-":
        from rich.console import Console

        overoptimisation.table(data).to_rich(Console())
        for loss in overoptimisation.losses(data):
            print(loss)


def _leaderboard(command: Leaderboard, console: Console) -> None:
    from uard.lab.execution.store import Store
    from uard.lab.views import leaderboard

    if not Path(command.store).is_file():
        raise _invalid("store", command.store, "a file that is there; `uard reproduce` and `uard run --store` make one")
    _say(console, f"leaderboard: {leaderboard.write(Path(command.out), Store(command.store))}")


def _status(command: Status, console: Console) -> None:
    from rich.console import Console
    from rich.table import Table

    from uard import _checks
    from uard.lab import studies
    from uard.lab.execution.store import Store
    from uard.lab.views import status

    if command.seeds is not None:
        _checks.whole("seeds", command.seeds, low=1, high=100_000)
    _check_json(command.json)
    chosen = studies.find(command.studies) if command.studies else studies.every()
    with closing(Store(command.store, readonly=True)) as store:
        found = status.status(store, chosen, command.seeds, every=bool(command.studies))
    if command.json is not None:
        _write_json(status.as_data(found), command.json)
    if command.json == "-":
        return
    out = Console(highlight=False)
    _say(out, f"{command.store}: {found.cells} cells, {found.seeds} seeds")
    for line in status.lines(found.runs):
        _say(out, line)
    columns = ("study", "seeds a cell", "finished", "in work", "failed", "missing", "last finished (UTC)")
    table = Table(*columns)
    for s in found.studies:
        numbers = (s.seeds, s.finished, s.claimed, s.failed, s.missing)
        table.add_row(s.name, *map(str, numbers), status.clock(s.last) if s.last else "-")
    out.print(table)
    for failure in found.failures:
        what = failure.why.traceback if command.errors else failure.why.error
        when = status.clock(failure.why.created)
        _say(out, f"failed {when}: {failure.title}, seeds {list(failure.seeds)}: {what}")


def _compare(command: Compare, console: Console) -> None:
    from rich.console import Console
    from rich.table import Table

    from uard.lab import studies
    from uard.lab.execution.store import Store
    from uard.lab.views import compare
    from uard.lab.views.status import titles

    _check_json(command.json)
    with (
        closing(Store(command.store_a, readonly=True)) as a,
        closing(Store(command.store_b, readonly=True)) as b,
    ):
        found = compare.compare(a, b)
    if command.json is not None:
        _write_json(compare.as_data(found), command.json)
    if command.json != "-":
        out = Console(highlight=False)
        differing = sorted((c for c in found.cells if c.effects), key=lambda c: c.effects[0].p)
        if differing:
            names = titles(studies.every())
            table = Table("cell", "seeds", "identical", "metric", "B - A", "in seed sd", "p, corrected")
            rows = [("all cells that differ", None, e) for e in found.everywhere[:1]]
            rows += [(names.get(c.key) or compare.title(c.config), c, c.effects[0]) for c in differing[:_LINES]]
            for name, c, e in rows:
                counts = (str(len(c.seeds)), str(len(c.identical))) if c else ("", "")
                effect = "none" if e.effect is None else f"{e.effect:+.2f}"
                difference = f"{e.difference:+.4g}" if c else ""
                style = "red" if e.differs else None
                table.add_row(_escape(name), *counts, e.metric, difference, effect, f"{e.p:.3g}", style=style)
            out.print(table)
            if len(differing) > _LINES:
                _say(out, f"and {len(differing) - _LINES} cells more that differ; --json has them all")
        for line in compare.lines(found):
            _say(out, line)
    if found.differs:
        sys.exit(1)


def _list(command: List, console: Console) -> None:
    from rich.console import Console
    from rich.table import Table

    from uard import plugins
    from uard.lab import registry as names
    from uard.lab import studies
    from uard.method import mitigations as mitigation
    from uard.ratings.panels import PANELS

    out = Console()
    brought = {kind: names.brought(kind) for kind in plugins.KINDS}
    theirs = {
        kind: {plugin.name: f"{value} (of {plugin.package})" for plugin, value in good.items()}
        for kind, (good, _) in brought.items()
    }
    rows: dict[str, dict[str, str]] = {
        "environments": {k: str(v) for k, v in names.ENVIRONMENTS.items()} | theirs["environment"],
        "agents": {k: str(v) for k, v in names.AGENTS.items()} | theirs["agent"],
        "agents for Hopper and Walker2d": {k: str(v) for k, v in names.CONTINUOUS.items()},
        "mitigations": {k: str(mitigation.named(k)) for k in mitigation.NAMED} | theirs["mitigation"],
        "panels": {k: (v.__doc__ or "").split("\n")[0] for k, v in PANELS.items()},
        **{
            f"studies of {group}": {s.name: f"{s.title} ({s.answers}; {len(s.rows)} cells)" for s in members}
            for group, members in studies.groups().items()
        },
    }
    for title, entries in rows.items():
        table = Table("name", "", title=title, title_justify="left", show_header=False, box=None, padding=(0, 2))
        for name, text in entries.items():
            table.add_row(f"[bold]{name}[/bold]", _escape(text))
        out.print(table)
        out.print()
    _warn_of_broken(console)


def _warn_of_broken(console: Console) -> None:
    """Say which plugins cannot be used, and why."""
    from uard import plugins
    from uard.lab import registry as names

    for kind in plugins.KINDS:
        for error in names.brought(kind)[1]:
            _say(console, str(error), "[yellow]warning:[/yellow] ")


_LINES = 20
_BODIES: dict[type, Callable[[Any, Console], None]] = {
    Run: _run,
    Reproduce: _reproduce,
    Ledger: _ledger,
    Status: _status,
    Compare: _compare,
    Doctor: _doctor,
    BestOfN: _best_of_n,
    Leaderboard: _leaderboard,
    List: _list,
}
