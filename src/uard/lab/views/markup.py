"""What HTML from elsewhere may do to the page that it stands in: nothing outside its own section."""

from __future__ import annotations

import re
from html.parser import HTMLParser

_VOID = frozenset(re.findall(r"\w+", "area br col embed hr img input link meta source track wbr"))
_OURS = frozenset(
    re.findall(
        r"\w+",
        "html head body main title base meta link script style template iframe frame frameset object embed form "
        "noembed noframes textarea plaintext xmp",
    )
)
"""Elements that act on the whole page, load something, or hide what follows."""
_DATA = "script", "application/json"  # which no browser runs
_ENDED = frozenset(
    re.findall(
        r"\w+",
        "path circle ellipse line polygon polyline rect g use image text tspan stop defs marker mask pattern symbol "
        "lineargradient radialgradient clippath animate set",
    )
)
"""Elements of drawings that a slash ends; of HTML it ends nothing."""


def ids(html: str) -> list[str]:
    """Return the ids in a text of HTML.

    Examples:
        >>> ids('<p title="a > b, id=no" id="one">no id=three</p><svg ID = two></svg>')
        ['one', 'two']
    """
    return _read(html).ids


def fault(html: str) -> str | None:
    """Say why a text of HTML cannot stand on a page of others; None if it can.

    Examples:
        >>> fault("<p>A line<br>and another.</p>") is None
        True
        >>> fault("<p>Never <b>ended.")
        '<b> in line 1 is not ended'
        >>> fault('<meta http-equiv="refresh" content="0">')
        '<meta> in line 1 is not for a part of a page'
    """
    if (at := re.search("<[!?]", html)) is not None:
        return f"{html[at.start() : at.start() + 4]} begins what no part of a page needs: comments, declarations"
    reader = _read(html)
    if reader.fault is None and "<" in reader.rawdata:
        return f"a tag is not ended in line {reader.getpos()[0]}"
    if reader.fault is None and reader.open:
        name, line = reader.open[-1]
        return f"<{name}> in line {line} is not ended"
    return reader.fault


def _read(html: str) -> _Reader:
    reader = _Reader(convert_charrefs=False)
    reader.feed(html)
    return reader


class _Reader(HTMLParser):
    """Follows what is open; remembers ids, and the first fault."""

    open: list[tuple[str, int]]
    ids: list[str]
    fault: str | None = None

    def __init__(self, **options: bool):
        super().__init__(**options)
        self.open, self.ids = [], []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.ids += [value for name, value in attrs if name == "id" and value]
        harmless = (tag, dict(attrs).get("type")) == _DATA or (tag == "title" and self._drawing)
        if tag in _OURS and not harmless:
            self._found(f"<{tag}> in line {self.getpos()[0]} is not for a part of a page")
        if tag not in _VOID:
            self.open.append((tag, self.getpos()[0]))

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag in _ENDED and self._drawing:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        if self.open and self.open[-1][0] == tag:
            self.open.pop()
        elif tag not in _VOID:
            self._found(f"</{tag}> in line {self.getpos()[0]} ends what is not open, or is not the innermost")

    @property
    def _drawing(self) -> bool:
        """Whether what is read now is part of a drawing, not of HTML inside one."""
        inside = [name for name, _ in self.open if name in ("svg", "desc", "title", "foreignobject")]
        return bool(inside) and inside[-1] == "svg"

    def _found(self, fault: str) -> None:
        self.fault = self.fault or fault
