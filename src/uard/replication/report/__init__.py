"""What the report says of the paper: sections that join the page by the door of plugins (``uard.plugins``)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from uard.lab.views import published
from uard.lab.views.figures import files as written
from uard.lab.views.sections import Section
from uard.lab.views.study_results import StudyResults
from uard.lab.views.tables import Table
from uard.lab.views.templates import render, table
from uard.replication import audit, deep, figures, ledger, locomotion, paper
from uard.replication.ledger import Entry
from uard.replication.report import tables, walks

HERE = Path(__file__).parent
PAGE = "paper.html"


def sections(results: StudyResults) -> list[Section]:
    """Return all of them (entry point of ``uard.reports``).

    Args:
        results: Of at least the grid studies, the paper's and ours.
    """
    entries = ledger.entries(results)
    verdicts = {v: sum(e.verdict == v for e in entries) for v in ledger.VERDICTS}
    return [
        _short(results, entries, verdicts),
        _walks(results),
        Section("tables", "The paper's tables beside ours", 40, _shown(tables.tables(results)), "Tables", page=PAGE),
        _figures(results),
        _deep(),
        _mujoco(),
        Section("theory", "Theorem 1", 100, _shown(tables.theory_tables()), page=PAGE),
        _ledger(results, entries, verdicts),
        _audit(),
    ]


def _shown(these: Sequence[Table]) -> str:
    return "".join(map(table, these))


def _short(results: StudyResults, entries: Sequence[Entry], verdicts: Mapping[str, int]) -> Section:
    headline, found = tables.headline(results), {"fewer": tables.fewer(results), "printed": paper.TABLE_3[-1].reduction}
    html = render(
        HERE, "short.html.j2", headline=headline, claims=len(entries), verdicts=verdicts, version=paper.VERSION, **found
    )
    return Section("short", "The answer", 10, html, page=PAGE)


def _walks(results: StudyResults) -> Section:
    data = json.dumps(walks.walks(results)).replace("<", "\\u003c")  # nothing in it may end the element around it
    drawn = figures.walks(results)
    html = render(HERE, "film.html.j2", walks=Markup(data), picture_of_walks=drawn)
    css, js = _text("film.css"), _text("film.js")
    return Section(
        "film",
        "What the trained agents actually do",
        30,
        html,
        "What they do",
        css,
        js,
        files=written([drawn]),
        page=PAGE,
    )


def _figures(results: StudyResults) -> Section:
    drawn = [draw(results) for draw in figures.FIGURES]
    html, title = render(HERE, "figures.html.j2", pictures=drawn), "The paper's figures, drawn again"
    return Section("figures", title, 50, html, "Figures", files=written(drawn), page=PAGE)


def _deep() -> Section:
    results = published.packaged()
    drawn = deep.drawn(results)
    html = render(HERE, "deep.html.j2", pictures=drawn, tables=deep.tables(results))
    return Section("deep", "Deep agents", 70, html, losses=tuple(deep.losses(results)), files=written(drawn))


def _mujoco() -> Section:
    results = published.packaged()
    pictures = [*locomotion.drawn(results), *locomotion.film()]
    html = render(HERE, "mujoco.html.j2", pictures=pictures, tables=locomotion.tables(results))
    lost = tuple(locomotion.losses(results))
    return Section("mujoco", "Hopper and Walker2d", 80, html, "MuJoCo", losses=lost, files=written(pictures))


def _ledger(results: StudyResults, entries: Sequence[Entry], verdicts: Mapping[str, int]) -> Section:
    html = render(HERE, "ledger.html.j2", entries=entries, verdicts=verdicts, version=paper.VERSION)
    data = json.dumps(ledger.as_data(entries, results.seeds), indent=2, allow_nan=False) + "\n"
    css = _text("ledger.css")
    return Section("ledger", "Ledger of claims", 20, html, "Ledger", css, files={"ledger.json": data}, page=PAGE)


def _audit() -> Section:
    html = render(HERE, "audit.html.j2", checks=[_check(c) for c in audit.run()])
    return Section(
        "audit", "The paper's arithmetic, recomputed", 120, html, "Arithmetic", _text("audit.css"), page=PAGE
    )


def _check(c: audit.Check) -> dict[str, str]:
    def text(values: Mapping[str, Any]) -> str:
        shown = ((k, f"{v:.4g}" if isinstance(v, float | int) else v) for k, v in values.items() if v is not None)
        return "; ".join(f"{k}: {v}" for k, v in shown) or "–"

    return {
        "id": c.id,
        "question": c.question,
        "printed": text(c.paper),
        "recomputed": text(c.recomputed),
        "judgement": f"{c.judgement.verdict} ({c.judgement.count})" if c.judgement else "nothing claimed",
        "verdict": c.verdict,
        "parts": audit.one_by_one([*c.parts, *(o for o in c.found if o.opinion)]),
    }


def _text(name: str) -> str:
    return (HERE / name).read_text(encoding="utf-8")
