"""``uard reproduce``: run studies and write the report."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from uard import InvalidValueError, _checks
from uard._support import files
from uard._support.text import counted
from uard.cli import progress, terminal, training
from uard.cli.list import broken
from uard.cli.settings import Names
from uard.cli.training import DEFAULT_STORE, UNWATCHED, WatchOptions

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from rich.console import Console

    from uard.lab.execution.store import Store
    from uard.lab.study import Row, Study
    from uard.lab.views.panels import PerSeed


@dataclass(frozen=True)
class Reproduce:
    """Run studies, all grid studies if none is named, and write the report. Finished cells are never run again."""

    studies: Positional[tuple[str, ...]] = ()
    """Which studies or groups of them (see `uard list`): grid if left out, games, panels, grid-deep."""
    mitigation: Names = ()
    """Let this one, your own perhaps, join every study that compares mitigations. Repeatable."""
    seeds: int = 10
    """Number of seeds."""
    first_seed: int = 0
    """The first of them; the others follow it."""
    report: str | None = None
    """Write the report into this folder; only possible for the whole grid, or of panels alone."""
    extract: str | None = None
    """Write what the report needs of these studies to this small JSON file (- for standard output)."""
    published: str | None = None
    """Train nothing, but read what --extract wrote of panels."""
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
    watch: WatchOptions = UNWATCHED

    def run(self, console: Console) -> None:
        """Train what is missing, then write the report or print the studies' tables."""
        from uard.lab import studies
        from uard.lab.execution.store import Store

        _checks.whole("seeds", self.seeds, low=2, high=100_000)
        _checks.whole("first_seed", self.first_seed, high=2**31)
        terminal.check_workers(self.workers)
        engine = self._engine()
        unusable = [str(error) for error in broken()]
        for text in unusable:
            terminal.warning(console, text)
        chosen = studies.find(self.studies, self.mitigation)
        self._check_outputs(chosen)
        if self.published is not None:
            self._show_published(chosen[0], console)
            return
        store, seeds = Store(self.store), self._seeds
        self._train(chosen, store, console, engine)
        if self.failed:
            return
        if self.extract is not None:
            from uard.lab.views import published

            data = published.extract(chosen, store, seeds, self._command)
            terminal.write_json(data, self.extract, "extract", indent=None)
        if len(chosen) == 1 and chosen[0].brief:
            from uard.lab.views.study_results import StudyResults

            results = StudyResults(store, seeds, chosen)

            def per_seed(row: Row, metric: str) -> np.ndarray:
                return results.values(row.cell, metric)

            self._show_panels(chosen[0], per_seed, self.seeds, self._command, console)
        elif self.report is not None:
            from uard.lab.views import page

            with progress.spinner(console, "writing the report"):
                written, errors = page.write(Path(self.report), store, seeds, self.mitigation)
            for text in map(str, errors):
                if text not in unusable:
                    terminal.warning(console, text)
            terminal.say(console, f"report: {written}")
        else:
            from uard.lab.views.study_results import StudyResults
            from uard.lab.views.tables import study_table

            results = StudyResults(store, seeds, chosen)
            for study in chosen:
                terminal.show(study_table(study, results))
                self._show_own(study, store)

    def _show_published(self, study: Study, console: Console) -> None:
        from uard.lab.views.published import Published, read_file

        results = Published([study], [read_file(str(self.published))])
        if missing := len(study.rows) - len(results.rows(study.name)):
            allowed = f"a file with all rows of {study.name}: {missing} of {len(study.rows)} are not in it"
            raise InvalidValueError("published", self.published, allowed)
        command = results.command(study.name)
        self._show_panels(study, results.per_seed, results.seeds(study.name), command, console)

    def _show_panels(self, study: Study, per_seed: PerSeed, seeds: int, command: str, console: Console) -> None:
        """Print the regrets of a study of random panels, or write a page of them."""
        from uard.lab.views import page, panels

        found = panels.regrets(study, per_seed)
        if self.report is None:
            for table in panels.tables(found):
                terminal.show(table)
            return
        written = page.write_pages(Path(self.report), page.of_panels(study, found, seeds, command), seeds)
        terminal.say(console, f"report: {written}")

    def _show_own(self, study: Study, store: Store) -> None:
        """Print what a study has to show beside its metrics."""
        from uard.lab.views import grpo, published

        if study.name == grpo.STUDY:
            found = published.Published([study], [published.extract([study], store, self._seeds, self._said_of_seeds)])
            for table in grpo.tables(found):
                terminal.show(table)

    @property
    def _seeds(self) -> range:
        return range(self.first_seed, self.first_seed + self.seeds)

    @property
    def _command(self) -> str:
        """What makes the same again."""
        joining = [f"--mitigation {shlex.quote(name)}" for name in self.mitigation]
        return " ".join(["uard reproduce", *self.studies, *joining, self._said_of_seeds])

    @property
    def _said_of_seeds(self) -> str:
        """Options that name these seeds."""
        return f"--seeds {self.seeds}" + (f" --first-seed {self.first_seed}" if self.first_seed else "")

    def _engine(self) -> Any:
        if _checks.choose("engine", self.engine, ("local", "ray")) == "ray":
            from uard.lab.execution.cluster import Ray

            if self.workers is not None:
                raise InvalidValueError("workers", self.workers, "left out with --engine ray")
            return Ray(self.address, self.gpus)
        for option, given in (("address", self.address), ("gpus", self.gpus)):
            if given:
                raise InvalidValueError(option, given, "left out without --engine ray")
        return None

    def _check_outputs(self, chosen: Sequence[Study]) -> None:
        """Refuse before training, not after it, what cannot be written."""
        from uard.lab import studies
        from uard.lab.views import sections

        alone = len(chosen) == 1 and bool(chosen[0].brief)
        whole = {s.name for s in studies.grid()} <= {s.name for s in chosen}
        if self.report is not None and not (alone or whole):
            raise InvalidValueError("report", self.report, "left out unless all grid studies are run, or panels alone")
        if self.published is not None and not alone:
            raise InvalidValueError("published", self.published, "left out unless panels alone are shown")
        if self.published is not None and self.mitigation:
            raise InvalidValueError("mitigation", self.mitigation, "left out with --published, which trains nothing")
        if self.published is not None and self.extract is not None:
            raise InvalidValueError("extract", self.extract, "left out with --published, which trains nothing")
        if self.report is not None:
            files.prepare_folder(self.report, "report")
            for page in (*sections.PAGES, sections.BOARD):
                files.prepare(Path(self.report, page), "report", self.store, self.published)
        terminal.check_json(self.extract, self.store, field="extract")
        for name, given in (("report", self.report), ("extract", self.extract)):
            if self.failed and given is not None:
                raise InvalidValueError(name, given, "left out with --failed, which runs a part only")

    def _train(self, chosen: Sequence[Study], store: Store, console: Console, engine: Any) -> None:
        jobs = list(dict.fromkeys(job for study in chosen for job in study.jobs(self._seeds)))
        if self.failed:
            failures = store.failures()
            jobs = [(cell, seed) for cell, seed in jobs if (cell.key, seed) in failures]
        names = "".join(f"{name} " for name in self.studies)
        trained = training.train(
            jobs,
            store,
            console,
            f"{counted(len(chosen), 'study', 'studies')}, {counted(len(jobs), 'run')}",
            self.watch,
            workers=self.workers,
            studies=chosen,
            engine=engine,
            again=f"only these again: uard reproduce {names}{self._said_of_seeds} --store {self.store} --failed\n"
            f"their tracebacks: uard status {names}--store {self.store} --errors",
        )
        before = len(jobs) - trained
        there = f"{before} {'was' if before == 1 else 'were'} in {self.store} already"
        terminal.say(console, f"{counted(trained, 'run')} trained, {there}")
