"""The report: one static page, made from the store alone, that opens without a server or a network.

It is made of sections (``uard.lab.views.sections``): ours, and those of installed packages. Beside it are written the
leaderboard and whatever files a section has.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

from markupsafe import escape

from uard import __version__
from uard._support import files
from uard.lab import studies
from uard.lab.execution.store import Store
from uard.lab.result import WINDOW
from uard.lab.views import (
    acquisition,
    best_of_n,
    figures,
    games,
    grids,
    grpo,
    leaderboard,
    panels,
    published,
    robots,
    sections,
)
from uard.lab.views.sections import Section
from uard.lab.views.study_results import StudyResults
from uard.lab.views.tables import study_table
from uard.lab.views.templates import HERE, picture, render, table
from uard.plugins import PluginError

_PACKAGES = ("jax", "numpy", "scipy", "gymnasium", "matplotlib")
_LEADERBOARD = 61  # its place among the links: after "every mitigation"


def write(
    folder: Path, store: Store, seeds: Sequence[int], mitigations: tuple[str, ...] = ()
) -> tuple[Path, list[PluginError]]:
    """Write ``index.html``, ``leaderboard.html`` and the files of sections into a folder.

    Args:
        folder: Made if it is not there.
        store: Holds all grid studies, and whatever else the leaderboard shows.
        seeds: Over these.
        mitigations: Further ones that took part in the studies.

    Returns:
        The page, and an error for each package whose sections could not be made.

    Raises:
        InvalidValueError: the folder cannot be written.
        LookupError: a study is not finished.
    """
    results = StudyResults(store, seeds, studies.find(("grid",), mitigations))
    ours = [
        _ours(results),
        *_panels(),
        *robots.section(robots.published()),
        _games(),
        _best_of_n(),
        *_acquisition(),
        *grpo.section(grpo.published()),
        _made(store, len(results.seeds)),
    ]
    theirs, broken = sections.of_packages(results, [*ours, _losses(())])
    every = sorted([*ours, *theirs], key=lambda s: s.order)
    page = write_page(folder, [*every, _losses(every)], len(results.seeds), [(_LEADERBOARD, "leaderboard.html")])
    leaderboard.write(folder / "leaderboard.html", store)
    return page, broken


def write_page(folder: Path, every: Sequence[Section], seeds: int, others: Sequence[tuple[float, str]] = ()) -> Path:
    """Write ``index.html`` and the files of some sections into a folder; return the page.

    Args:
        folder: Made if it is not there.
        every: The sections.
        seeds: Of every cell.
        others: Pages that are written beside it, by their places among the links.

    Raises:
        InvalidValueError: the folder cannot be written.
    """
    every = sorted(every, key=lambda s: s.order)
    links = [(s.order, f"#{s.id}", s.label or s.title) for s in every]
    links += [(order, name, name.removesuffix(".html").capitalize()) for order, name in others]
    page = render(
        HERE,
        "page.html.j2",
        version=__version__,
        seeds=seeds,
        window=WINDOW,
        sections=every,
        programs=[f"{{\n{s.js}\n}}" for s in every if s.js],
        links=[link for _, *link in sorted(links)],
    )
    files.prepare_folder(folder, "report")
    for name, text in ((name, text) for section in every for name, text in section.files.items()):
        files.write(folder / name, text, "report")
    files.write(folder / "index.html", page, "report")
    return folder / "index.html"


def _losses(every: Sequence[Section]) -> Section:
    items = "".join(f"<li>{escape(loss)}</li>" for section in every for loss in section.losses)
    return Section("losses", "Where uard fails or is beaten", 20, f"<ul>{items}</ul>", "Where uard loses")


def _ours(results: StudyResults) -> Section:
    html = render(
        HERE,
        "ours.html.j2",
        pictures=grids.pictures(results),
        tables=grids.tables(results),
        everything=[study_table(s, results) for s in results.studies.values() if s.name != "matrix"],
    )
    return Section(
        "ours", "Every mitigation, everywhere", 60, html, "Every mitigation", losses=tuple(grids.losses(results))
    )


def _panels() -> list[Section]:
    """Return what was published of the study of random panels; nothing if it is not whole: it is the headline."""
    results = published.packaged()
    (study,) = studies.find(("panels",))
    if not all(map(results.has, study.rows)):
        return []
    return [panels.section(study, panels.regrets(study, results.per_seed), results.seeds(study.name))]


def _games() -> Section:
    results = published.packaged()
    html = "".join(map(table, games.tables(results)))
    return Section("games", "Reward-gaming gridworlds", 75, html, "Games", losses=tuple(games.losses(results)))


def _best_of_n() -> Section:
    data = published.packaged_json("best-of-n.json")
    note = (
        "Lines: gold, mean over seeds, the band its interval for uard. Dotted: the score by which was chosen; where it "
        "rises and gold does not, it is over-optimised."
    )
    image = figures.data_uri(best_of_n.figure(data))
    html = render(
        HERE,
        "best_of_n.html.j2",
        figure=picture("Best-of-n: gold and proxy against KL", note, image),
        table=best_of_n.table(data),
    )
    losses = tuple(best_of_n.losses(data))
    return Section("best-of-n", "Best-of-n over-optimisation", 90, html, "Best-of-n", losses=losses)


def _acquisition() -> list[Section]:
    """Return the study as it was run first, and again with new and more seeds, which say where random is as good."""
    files = [f"acquisition{run}.json" for run in ("", "-again", "-overlap")]
    runs = [data for data in map(published.packaged_json, files) if data is not None]
    note = "Mean over seeds; the band is the interval of asking at random."
    shown = [
        (
            f"Seeds {data['seeds'][0]} to {data['seeds'][-1]}, at most {data['overlap']} raters an item",
            picture("Regret against answers, by rule", note, figures.data_uri(acquisition.figure(data))),
            acquisition.losses(data),
            acquisition.tables(data),
        )
        for data in runs
    ]
    html = render(HERE, "acquisition.html.j2", runs=shown)
    losses = tuple(loss for data in runs[1:] for loss in acquisition.losses(data))
    return [Section("acquisition", "Who is asked what", 92, html, losses=losses)]


def _made(store: Store, seeds: int) -> Section:
    cells, runs = store.count()
    html = render(
        HERE,
        "made.html.j2",
        cells=cells,
        runs=runs,
        seeds=seeds,
        sources=published.packaged().sources,
        versions={p: metadata.version(p) for p in _PACKAGES} | {"python": platform.python_version()},
        machine=f"{platform.machine()}, {os.cpu_count()} cores",
    )
    return Section("made", "How this was made", 1000, html, "How it was made")
