"""Templates of pages: text that stands in them is escaped, a name that nobody gave is an error.

Every page begins with ``policy(styles, programs)``: a browser then loads nothing from elsewhere and runs nothing but
these very programs, whatever a text on the page, or the HTML of a section, may contain.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from uard.lab.views.figures import Picture
from uard.lab.views.tables import Table

HERE = Path(__file__).parent


def render(folder: Path, name: str, **values: Any) -> str:
    """Return a template's text with its places filled in.

    A template may use ``show(table)``, ``picture(picture)`` and ``policy(styles, programs)``, which are the functions
    of this module.

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
    environment.globals.update(show=table, picture=picture, policy=policy)
    return environment


def table(data: Table, id: str = "") -> Markup:
    """Return a table as HTML.

    Args:
        data: What it shows.
        id: Of its figure; made of what it shows if empty.
    """
    digest = hashlib.sha256(repr((data.title, data.columns, data.rows)).encode(errors="replace")).hexdigest()
    shown = data.shown()
    details = any(cell.details for row in shown for cell in row)
    name = id or f"table-{digest[:10]}"
    return Markup(render(HERE, "table.html.j2", table=data, shown=shown, details=details, id=name))


def picture(data: Picture) -> Markup:
    """Return a picture as HTML; its numbers are to be written beside the page (``uard.lab.views.figures.files``)."""
    return Markup(render(HERE, "picture.html.j2", picture=data))


def policy(styles: Iterable[str], programs: Iterable[str]) -> Markup:
    """Return the Content-Security-Policy of a page, to stand at its head.

    Args:
        styles: Contents of its ``<style>`` elements, to the letter; attributes of that name have no effect.
        programs: Contents of its ``<script>`` elements; attributes such as ``onclick`` and ``javascript:`` links run
            nothing.
    """

    def hashes(texts: Iterable[str]) -> str:
        plain = (re.sub("\r\n?", "\n", text) for text in texts)  # which is what a browser reads
        digests = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in plain)
        return " ".join(f"'sha256-{digest}'" for digest in digests) or "'none'"

    rules = {
        "default-src": "'none'",
        "img-src": "data:",
        "style-src": hashes(styles),
        "script-src": hashes(programs),
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    content = "; ".join(f"{name} {value}" for name, value in rules.items())
    return Markup('<meta http-equiv="Content-Security-Policy" content="{}">').format(Markup(content))
