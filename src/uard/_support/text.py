"""Text of others: what comes from a file, a package or the name of an environment is shown and never obeyed."""

from __future__ import annotations

import re

# Control characters but tab and line feed; what turns the direction of text; line ends; halves of surrogate pairs.
_OBEYED = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def counted(number: int, noun: str, plural: str = "") -> str:
    """Return a number and what it counts.

    Examples:
        >>> counted(1, "cell"), counted(0, "cell"), counted(2, "study", "studies")
        ('1 cell', '0 cells', '2 studies')
    """
    return f"{number} {noun if number == 1 else plural or noun + 's'}"


def printable(text: str) -> str:
    r"""Return text in which what a terminal would obey, or could not print, is spelt out.

    Examples:
        >>> print(printable("rating \x1b[31mred"))
        rating \x1b[31mred
    """
    return _OBEYED.sub(lambda found: repr(found[0])[1:-1], text)
