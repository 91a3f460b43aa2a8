"""What the report says of the paper: sections that join the page by the door of plugins (``uard.plugins``)."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup
from matplotlib.figure import Figure

from uard.lab.views import published
from uard.lab.views.figures import data_uri
from uard.lab.views.sections import Section
from uard.lab.views.study_results import StudyResults
from uard.lab.views.tables import Table
from uard.lab.views.templates import render, table
from uard.replication import audit, deep, figures, ledger, locomotion, paper
from uard.replication.ledger import Entry
from uard.replication.report import tables, walks

HERE = Path(__file__).parent

FIGURES: tuple[tuple[str, str, Callable[[StudyResults], Figure]], ...] = (  # title, what to see
    (
        "G2 · filters",
        "Left: the three filters. Right: goal rate by form and by where it acts. Acting on J as printed never reaches the goal, whatever the form.",
        figures.filters,
    ),
    (
        "G3 · the verification delay",
        "The paper's curve turns to the goal near episode 400. As printed, UARD stays flat near -2; `uard` turns early.",
        figures.hero,
    ),
    (
        "G4 · trap visits",
        "Thin lines are seeds, thick ones their mean (moving average over 10 episodes).",
        figures.hacks,
    ),
    (
        "G5 · the alignment gap",
        "The baseline's observed and true return part; those of `uard` meet.",
        figures.alignment_gap,
    ),
    ("G8 · true return", "UARD as printed settles at -4: forty steps of -0.1.", figures.true_return),
    (
        "G9 · two uncertainties",
        "Bootstrapped heads. sigma_m at the trap falls after its peak, elsewhere it grows with the values; sigma_h stays. Bands are one SD over seeds.",
        figures.uncertainty,
    ),
    (
        "G11 on the grid · noisy raters",
        "The raw agent reads no ratings, so noise cannot hurt it: its line is flat, not rising by 277 %.",
        figures.noise,
    ),
    ("G13 · sign preservation", "Three meanings of one word: equal, smaller, larger.", figures.sign_preservation),
    (
        "G16 · observed return of all agents",
        "A low observed return is no virtue: a random walker has it too.",
        figures.learning_curves,
    ),
)


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
        Section("tables", "The paper's tables beside ours", 40, _shown(tables.tables(results)), "The paper's tables"),
        Section("figures", "Figures", 50, _figures(results)),
        _deep(),
        _mujoco(),
        Section("theory", "Theorem 1", 100, _shown(tables.theory_tables())),
        _ledger(results, entries, verdicts),
        _audit(),
    ]


def _shown(these: Sequence[Table]) -> str:
    return "".join(map(table, these))


def _short(results: StudyResults, entries: Sequence[Entry], verdicts: Mapping[str, int]) -> Section:
    headline = tables.headline(results)
    html = render(
        HERE, "short.html.j2", headline=headline, claims=len(entries), verdicts=verdicts, version=paper.VERSION
    )
    return Section("short", "In short", 10, html)


def _walks(results: StudyResults) -> Section:
    data = json.dumps(walks.walks(results)).replace("<", "\\u003c")  # nothing in it may end the element around it
    html = render(HERE, "film.html.j2", walks=Markup(data), image=data_uri(figures.walks(results)))
    css, js = _text("film.css"), _text("film.js")
    return Section("film", "What the trained agents actually do", 30, html, "What they do", css, js)


def _figures(results: StudyResults) -> str:
    pictures = [(title, note, data_uri(draw(results))) for title, note, draw in FIGURES]
    return render(HERE, "figures.html.j2", pictures=pictures)


def _deep() -> Section:
    results = published.packaged()
    html = render(HERE, "deep.html.j2", pictures=deep.drawn(results), tables=deep.tables(results))
    return Section("deep", "Deep agents", 70, html, losses=tuple(deep.losses(results)))


def _mujoco() -> Section:
    results = published.packaged()
    pictures = [*locomotion.drawn(results), *locomotion.film()]
    html = render(HERE, "mujoco.html.j2", pictures=pictures, tables=locomotion.tables(results))
    return Section("mujoco", "Hopper and Walker2d", 80, html, "MuJoCo", losses=tuple(locomotion.losses(results)))


def _ledger(results: StudyResults, entries: Sequence[Entry], verdicts: Mapping[str, int]) -> Section:
    html = render(HERE, "ledger.html.j2", entries=entries, verdicts=verdicts, version=paper.VERSION)
    data = json.dumps(ledger.as_data(entries, results.seeds), indent=2, allow_nan=False) + "\n"
    css, js = _text("ledger.css"), _text("ledger.js")
    return Section("ledger", "Ledger of claims", 110, html, "Ledger", css, js, files={"ledger.json": data})


def _audit() -> Section:
    html = render(HERE, "audit.html.j2", checks=[_check(c) for c in audit.run()])
    return Section("audit", "The paper's arithmetic, recomputed", 120, html, "Arithmetic", _text("audit.css"))


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
