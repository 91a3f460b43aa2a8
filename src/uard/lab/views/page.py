"""The report: static pages, made from the store alone, that open without a server or a network.

They are made of sections (``uard.lab.views.sections``): ours, and those of installed packages. The first page answers
in one screen; the others have the paper's claims, and every number. Beside them stand the leaderboard and whatever
files a section has.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from uard import __version__
from uard._support import files
from uard._support.text import counted
from uard.lab import studies
from uard.lab.execution.store import Store
from uard.lab.result import WINDOW
from uard.lab.study import Study
from uard.lab.views import (
    acquisition,
    best_of_n,
    figures,
    front,
    games,
    grids,
    grpo,
    leaderboard,
    losses,
    panels,
    published,
    robots,
    sections,
)
from uard.lab.views.panels import Regrets
from uard.lab.views.sections import Section
from uard.lab.views.study_results import StudyResults
from uard.lab.views.tables import bounds, number, study_table
from uard.lab.views.templates import HERE, picture, render, table
from uard.plugins import PluginError

_PACKAGES = ("jax", "numpy", "scipy", "gymnasium", "matplotlib")
_FIRST = "index.html"
TITLES = {
    _FIRST: "uard: learning from rewards that cannot be fully trusted",
    "paper.html": "The paper, claim by claim",
    "numbers.html": "Every number",
}
_LEADS = {
    "#choose": "When a simple rule is enough",
    "#losses": "Where it fails",
    "paper.html": "The paper's claims",
    "numbers.html": "Every number",
}
_METRICS = f"per episode over the last {WINDOW} training episodes · mean [95 % interval], sd and seeds on hover"


def write(
    folder: Path, store: Store, seeds: Sequence[int], mitigations: tuple[str, ...] = ()
) -> tuple[Path, list[PluginError]]:
    """Write the pages, ``leaderboard.html`` and the files of sections into a folder.

    Args:
        folder: Made if it is not there.
        store: Holds all grid studies, and whatever else the leaderboard shows.
        seeds: Over these.
        mitigations: Further ones that took part in the studies.

    Returns:
        The first page, and an error for each package whose sections could not be made.

    Raises:
        InvalidValueError: the folder cannot be written.
        LookupError: a study is not finished.
    """
    results = StudyResults(store, seeds, studies.find(("grid",), mitigations))
    ours = [
        *_panels(),
        *_ours(results),
        *robots.section(robots.published()),
        _games(),
        _best_of_n(),
        *_acquisition(),
        *grpo.section(grpo.published()),
        _made(store, len(results.seeds)),
    ]
    own = [f"{Path(store.path).name}{end}" for end in ("", "-wal", "-shm")]  # the store may lie in this folder
    theirs, broken = sections.of_packages(results, ours, own)
    every = [*ours, *theirs]
    page = write_pages(folder, every, len(results.seeds), board=True)
    leaderboard.write(folder / sections.BOARD, store, _links(every, board=True))
    return page, broken


def write_pages(folder: Path, every: Sequence[Section], seeds: int, board: bool = False) -> Path:
    """Write the pages that have sections, and the files of these, into a folder; return the first page.

    Args:
        folder: Made if it is not there.
        every: The sections; what they say of losses gets one of its own.
        seeds: Of every cell.
        board: Whether a leaderboard is written beside them.

    Raises:
        InvalidValueError: the folder cannot be written.
    """
    every = [*every, _losses(every)]
    there = {name: [s for s in every if s.page == name] for name in sections.PAGES}
    there = {name: sorted(found, key=lambda s: s.order) for name, found in there.items() if found}
    files.prepare_folder(folder, "report")
    for name, text in ((name, text) for section in every for name, text in section.files.items()):
        files.write(folder / name, text, "report")
    for name, found in there.items():
        page = render(
            HERE,
            "page.html.j2",
            here=name,
            title=TITLES[name],
            meta=_meta(name, seeds),
            version=__version__,
            sections=found,
            leads=_leads(every) if name == _FIRST else (),
            styles=[_text("style.css") + _text("data.css"), *(s.css for s in found if s.css)],
            programs=[f"(() => {{\n{js}\n}})();" for js in (_text("tables.js"), *(s.js for s in found)) if js],
            pages=_links(every, board),
        )
        files.write(folder / name, page, "report")
    return folder / next(iter(there))


def _meta(name: str, seeds: int) -> str:
    """Return the line below a page's heading; only on the paper's page all numbers have equally many seeds."""
    if name == _FIRST:
        return ""
    return f"uard {__version__} · {_METRICS}" + f" · {counted(seeds, 'seed')} per cell" * (name == "paper.html")


def _links(every: Sequence[Section], board: bool) -> list[tuple[str, str]]:
    """Return the pages that are written, and what links call them."""
    used = {s.page for s in every}
    there = [(name, label) for name, label in sections.PAGES.items() if name in used]
    return there + [(sections.BOARD, "Leaderboard")] * board


def _leads(every: Sequence[Section]) -> list[tuple[str, str]]:
    """Return where a reader of the first screen may go on, of what there is."""
    there = {f"#{s.id}" for s in every if s.page == _FIRST} | {s.page for s in every}
    return [(target, label) for target, label in _LEADS.items() if target in there]


def _text(name: str) -> str:
    return (HERE / name).read_text(encoding="utf-8")


def _losses(every: Sequence[Section]) -> Section:
    found = losses.sorted_by_weight(loss for section in every for loss in section.losses)
    html = render(
        HERE,
        "losses.html.j2",
        losses=[(x, losses.drawn(x)) for x in found],
        kinds=losses.KINDS,
        studies=sorted({x.study for x in found}),
        rivals=sorted({x.against for x in found} - {""}),
        number=number,
        bounds=bounds,
        said=losses.said,
    )
    title = "Where uard fails or is beaten"
    return Section("losses", title, 20, html, "Where it fails", _text("losses.css"), page=_FIRST)


def _ours(results: StudyResults) -> list[Section]:
    drawn = grids.pictures(results)
    html = render(HERE, "ours.html.j2", pictures=drawn, tables=grids.tables(results))
    rows = [study_table(s, results) for s in results.studies.values() if s.name != "matrix"]
    everything = "".join(map(table, rows))
    lost = tuple(grids.losses(results))
    return [
        Section(
            "ours",
            "Every mitigation, everywhere",
            60,
            html,
            "Every mitigation",
            losses=lost,
            files=figures.files(drawn),
        ),
        Section("rows", "All rows of all other studies", 200, everything, "All rows"),
    ]


def _panels() -> list[Section]:
    """Return what was published of the study of random panels; nothing if it is not whole: it is the headline."""
    results = published.packaged()
    (study,) = studies.find(("panels",))
    if not all(map(results.has, study.rows)):
        return []
    found, command = panels.regrets(study, results.per_seed), results.command(study.name)
    return of_panels(study, found, results.seeds(study.name), command)


def of_panels(study: Study, found: Sequence[Regrets], seeds: int, command: str) -> list[Section]:
    """Return the first screen, when which rule is enough, and every number of a study of random panels.

    Args:
        study: Of random panels.
        found: See ``uard.lab.views.panels.regrets``.
        seeds: Of every row.
        command: What makes it all.
    """
    return [front.section(found, seeds, command), front.choose(found), panels.section(study, found, seeds, command)]


def _games() -> Section:
    results = published.packaged()
    html = "".join(map(table, games.tables(results)))
    return Section("games", "Reward-gaming gridworlds", 75, html, "Games", losses=tuple(games.losses(results)))


def _best_of_n() -> Section:
    data = published.packaged_json("best-of-n.json")
    drawn = best_of_n.picture_of(data)
    html = render(HERE, "best_of_n.html.j2", figure=picture(drawn), table=best_of_n.table(data))
    lost, written = tuple(best_of_n.losses(data)), figures.files([drawn])
    return Section("best-of-n", "Best-of-n over-optimisation", 90, html, "Best-of-n", losses=lost, files=written)


def _acquisition() -> list[Section]:
    """Return the study as it was run first, and again with new and more seeds, which say where random is as good."""
    names = [f"acquisition{run}.json" for run in ("", "-again", "-overlap")]
    runs = [data for data in map(published.packaged_json, names) if data is not None]
    drawn = [acquisition.picture_of(data) for data in runs]
    shown = [
        (
            f"Seeds {data['seeds'][0]} to {data['seeds'][-1]}, at most {data['overlap']} raters an item",
            picture(image),
            [loss.sentence() for loss in acquisition.losses(data)],
            acquisition.tables(data),
        )
        for data, image in zip(runs, drawn, strict=True)
    ]
    html = render(HERE, "acquisition.html.j2", runs=shown)
    lost = tuple(loss for data in runs[1:] for loss in acquisition.losses(data))
    return [Section("acquisition", "Who is asked what", 93, html, losses=lost, files=figures.files(drawn))]


def _sources() -> list[dict[str, Any]]:
    """Return how every published study was made, each once."""
    every = (*published.packaged().sources, *robots.published().sources, *grpo.published().sources)
    return list({str(s["command"]): s for s in every}.values())


def _brought() -> list[Mapping[str, Any]]:
    """Return what was published by commands of their own, which are no studies of cells."""
    names = ("best-of-n", "acquisition", "acquisition-again", "acquisition-overlap")
    return [data for name in names if (data := published.packaged_json(f"{name}.json")) is not None]


def _made(store: Store, seeds: int) -> Section:
    cells, runs = store.count()
    html = render(
        HERE,
        "made.html.j2",
        cells=cells,
        runs=runs,
        seeds=seeds,
        sources=_sources(),
        commands=[data["command"] for data in _brought()],
        versions={p: metadata.version(p) for p in _PACKAGES} | {"python": platform.python_version()},
        machine=f"{platform.machine()}, {os.cpu_count()} cores",
    )
    return Section("made", "How this was made", 1000, html, "How it was made", page=_FIRST)
