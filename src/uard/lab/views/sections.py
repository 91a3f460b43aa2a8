"""Sections of the report: what this laboratory and installed packages have to show, each a part of one page."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from uard import _checks
from uard.lab.views import markup
from uard.lab.views.losses import Loss
from uard.lab.views.study_results import StudyResults
from uard.plugins import Plugin, PluginError, brought

PAGES: Mapping[str, str] = {  # of sections, and what links call them
    "index.html": "In short",
    "paper.html": "The paper",
    "numbers.html": "Every number",
}
BOARD = "leaderboard.html"  # is made from a store and has no sections
_LONGEST = 120  # characters of a heading, and of a file's name


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
            ``style`` attributes. What a package brings must end all that it begins, and its ids must be its own.
        label: What the navigation calls it; the title if empty.
        css: Rules for it. They hold on the whole page, so begin each selector with its id.
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
        for name in ("id", "title", "label", "css", "js"):
            object.__setattr__(self, name, _checks.text(name, getattr(self, name)))
        _checks.text("html", self.html)
        for name in ("title", "label"):
            if len(getattr(self, name)) > _LONGEST:
                raise _checks.InvalidValueError(name, getattr(self, name), f"at most {_LONGEST} characters")
        if not re.fullmatch(r"[a-z][a-z0-9-]*", self.id):
            raise _checks.InvalidValueError("id", self.id, "small letters, digits and hyphens")
        _checks.number("order", self.order)
        _checks.choose("page", self.page, PAGES)
        if not isinstance(self.losses, tuple):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise _checks.InvalidValueError("losses", self.losses, "a tuple of uard.lab.views.losses.Loss")
        for loss in self.losses:
            _checks.instance("losses", loss, Loss, "of uard.lab.views.losses.Loss")
        for name, ends in (("css", ("</style",)), ("js", ("</script", "<!--"))):
            for end in ends:
                if end in getattr(self, name).lower():
                    raise _checks.InvalidValueError(name, getattr(self, name), f"without {end}")
        given = dict(_checks.instance("files", self.files, Mapping, "a mapping of names to texts"))
        object.__setattr__(self, "files", MappingProxyType(given))  # nobody changes it after this
        for name, text in given.items():
            good = isinstance(name, str) and len(name) <= _LONGEST and re.fullmatch(r"\w[\w.-]*", name)
            if not good or name.lower() in (*PAGES, BOARD):
                raise _checks.InvalidValueError("files", name, f"a plain name, none of {', '.join((*PAGES, BOARD))}")
            _checks.instance(f"files[{name!r}]", text, str, "text")


def of_packages(
    results: StudyResults, ours: Iterable[Section], kept_files: Collection[str] = ()
) -> tuple[list[Section], list[PluginError]]:
    """Return the sections that packages bring, and what of it is broken.

    Of two that want one name the first has it: ours, then those of uard's own package, then the others by their names.

    Args:
        results: What they are made from.
        ours: Whose ids and files nobody else may have.
        kept_files: Names of other files in the report's folder that no section may write.
    """
    taken = {*RESERVED, *(name.lower() for name in kept_files), *(name for section in ours for name in names(section))}

    def read(plugin: Plugin) -> list[Section]:
        made = plugin.call(results)
        if not (type(made) in (list, tuple) and all(isinstance(s, Section) for s in made)):
            raise PluginError(plugin, f"{_checks.short(made)} is no list of Section")
        return list(made)

    good, bad = brought("report", read)
    kept: list[Section] = []
    for plugin, section in ((plugin, section) for plugin, made in good.items() for section in made):
        own = names(section)
        double = sorted(name for name in set(own) if name in taken or own.count(name) > 1)
        why = f"the name {double[0]!r} in it is taken" if double else markup.fault(section.html)
        if why:
            bad.append(PluginError(plugin, f"its section {section.id!r} is left out, for {why}"))
        else:
            taken.update(own)
            kept.append(section)
    return kept, bad


RESERVED = ("content", "losses", "losses-title", "losses-table")  # ids of every first page


def names(section: Section) -> list[str]:
    """Return what a section calls its own: the ids on its page, and its files as a disk without capitals has them."""
    heading = [f"{section.id}-title"] if section.title else []
    return [section.id, *heading, *markup.ids(section.html), *(name.lower() for name in section.files)]


def broken() -> list[PluginError]:
    """Return an error for each package's sections that cannot be imported."""
    return brought("report", Plugin.get)[1]
