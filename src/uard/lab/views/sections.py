"""Sections of the report: what this laboratory and installed packages have to show, each a part of one page."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from uard import _checks
from uard.lab.views.losses import Loss
from uard.lab.views.study_results import StudyResults
from uard.plugins import Plugin, PluginError, brought

PAGES: Mapping[str, str] = {  # of sections, and what links call them
    "index.html": "In short",
    "paper.html": "The paper",
    "numbers.html": "Every number",
}
BOARD = "leaderboard.html"  # is made from a store and has no sections


@dataclass(frozen=True)
class Section:
    """A part of a page of the report.

    Examples:
        >>> from markupsafe import escape
        >>> text = escape("Hacks < 0.1 at a slack of 0.2.")
        >>> Section("ceiling", "The ceiling", order=65.0, html=f"<p>{text}</p>").html
        '<p>Hacks &lt; 0.1 at a slack of 0.2.</p>'

    Attributes:
        id: Where links lead to: letters, digits and hyphens, as in HTML.
        title: Its heading; none if empty.
        order: Its place on its page: sections are sorted by this number. Of every number, ours stand at 15 (random
            panels), 60 (every mitigation), 75 (games), 90 (best-of-n).
        html: What it says below its heading; taken as it is, so text in it must be escaped
            (``uard.lab.views.templates``). What would run in it does not: no ``<script>``, no ``onclick``, no
            ``style`` attributes.
        label: What the navigation calls it; the title if empty.
        css: Rules for it.
        js: A program for it, in a scope of its own. Nothing on the page may be loaded from elsewhere.
        losses: Where ``uard`` fails or is beaten: they stand in the table of that name on the first page.
        files: What else is written beside the page: texts by their names.
        page: On which page it stands, one of ``PAGES``.
    """

    id: str
    title: str
    order: float
    html: str
    label: str = ""
    css: str = ""
    js: str = ""
    losses: tuple[Loss, ...] = ()
    files: Mapping[str, str] = field(default_factory=dict)
    page: str = "numbers.html"

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        if not re.fullmatch(r"[a-z][a-z0-9-]*", self.id):
            raise _checks.InvalidValueError("id", self.id, "small letters, digits and hyphens")
        _checks.number("order", self.order)
        _checks.choose("page", self.page, PAGES)
        for loss in self.losses:
            if not isinstance(loss, Loss):  # pyright: ignore[reportUnnecessaryIsInstance]
                raise _checks.InvalidValueError("losses", loss, "of uard.lab.views.losses.Loss")
        for name, end in (("css", "</style"), ("js", "</script")):
            if end in getattr(self, name).lower():
                raise _checks.InvalidValueError(name, getattr(self, name), f"without {end}>")
        for name in self.files:
            if not re.fullmatch(r"\w[\w.-]*", name) or name in (*PAGES, BOARD):
                raise _checks.InvalidValueError("files", name, f"a plain name, none of {', '.join((*PAGES, BOARD))}")


def of_packages(results: StudyResults, ours: Iterable[Section]) -> tuple[list[Section], list[PluginError]]:
    """Return the sections that packages bring, and what of it is broken.

    Args:
        results: What they are made from.
        ours: Whose ids and files nobody else may have.
    """
    taken = {name for section in ours for name in (section.id, *section.files)}

    def read(plugin: Plugin) -> list[Section]:
        made = plugin.call(results)
        if not (isinstance(made, list | tuple) and all(isinstance(s, Section) for s in made)):
            raise PluginError(plugin, f"{_checks.short(made)} is no list of Section")
        new = [name for section in made for name in (section.id, *section.files)]
        for name in new:
            if name in taken or new.count(name) > 1:
                raise PluginError(plugin, f"the name {name!r} of its section or file is taken")
        taken.update(new)
        return list(made)

    good, bad = brought("report", read)
    return [section for made in good.values() for section in made], bad


def broken() -> list[PluginError]:
    """Return an error for each package's sections that cannot be imported."""
    return brought("report", Plugin.get)[1]
