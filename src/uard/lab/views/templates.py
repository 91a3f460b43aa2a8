"""Templates of pages: text that stands in them is escaped, a name that nobody gave is an error."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from uard.lab.views.tables import Table

HERE = Path(__file__).parent


def render(folder: Path, name: str, **values: Any) -> str:
    """Return a template's text with its places filled in.

    A template may use ``show(table)`` and ``picture(title, note, image)``, which are the functions of this module.

    Args:
        folder: Where the template is.
        name: Of its file.
        values: By the names that it uses.
    """
    return _environment(folder).get_template(name).render(**values)


@cache
def _environment(folder: Path) -> jinja2.Environment:
    loader = jinja2.FileSystemLoader([folder, HERE])
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    environment.globals.update(show=table, picture=picture)
    return environment


def table(data: Table) -> Markup:
    """Return a table as HTML."""
    return Markup(render(HERE, "table.html.j2", table=data))


def picture(title: str, note: str, image: str) -> Markup:
    """Return a figure as HTML; ``image`` is a ``data:`` address (``uard.lab.views.figures.data_uri``)."""
    return Markup(render(HERE, "picture.html.j2", title=title, note=note, image=image))
