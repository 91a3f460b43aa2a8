"""The colours of figures: eleven hues after Okabe and Ito (2008), for a light and a dark page.

Each has at least 3 : 1 contrast against the page and its tinted boxes (``tests/unit/test_figures.py`` computes it).
Where two lines share a hue they differ in their dashes, so that nothing is told by colour alone.
"""

from __future__ import annotations

from typing import NamedTuple

BACK = {"light": ("#ffffff", "#f4f7fa"), "dark": ("#12171d", "#1b222a")}  # of style.css: pages, and what is tinted
LIGHT = {
    "ink": "#1d2733",
    "soft": "#5b6773",
    "line": "#d9dfe6",  # the grid, which nobody must read
    "shade": "#f5e3bf",  # a window that text and lines stand on
    "grey": "#767f88",
    "blue": "#0072b2",
    "sky": "#2b93c9",
    "green": "#00805f",
    "lime": "#6f8f00",
    "orange": "#b77700",
    "vermillion": "#cf4f00",
    "purple": "#b2568c",
    "violet": "#6a51a3",
}
DARK = {
    "ink": "#e6ebf0",
    "soft": "#a7b2bd",
    "line": "#3a444f",
    "shade": "#43391f",
    "grey": "#98a2ac",
    "blue": "#5aa9e6",
    "sky": "#8fd0f5",
    "green": "#2fc79a",
    "lime": "#b6cf4a",
    "orange": "#eba937",
    "vermillion": "#ff7a45",
    "purple": "#dd8fc0",
    "violet": "#a893e0",
}
UNREAD = ("line", "shade")  # the names of what needs no contrast

Dash = str | tuple[float, tuple[float, ...]]
SOLID: Dash = "-"
DASHED: Dash = (0.0, (4.0, 1.6))
DOTTED: Dash = (0.0, (1.2, 1.4))
MIXED: Dash = (0.0, (6.0, 1.5, 1.2, 1.5))


class Look(NamedTuple):
    """How a line is drawn: the name of a colour, its dashes, its width in points."""

    colour: str
    dash: Dash = SOLID
    width: float = 1.5

    @property
    def light(self) -> str:
        """The colour as it is drawn; a dark page replaces it."""
        return LIGHT[self.colour]


OURS = Look("green", width=2.6)
LOOKS = {
    # Mitigations, and what judges' answers are made into.
    "uard": OURS,
    "uard-0.1": Look("green", DASHED, 1.8),
    "uard, 1 veto": Look("green", MIXED),
    "uard, unrated believed": Look("green", DOTTED, 1.8),
    "uard, median as proxy": Look("green", DOTTED),
    "uard-paper": Look("blue", width=2.0),
    "uard-consistent": Look("violet", DASHED),
    "uard-operator": Look("blue", DOTTED),
    "raw": Look("vermillion", width=2.0),
    "one model": Look("vermillion"),
    "mean-of-annotations": Look("orange"),
    "mean of ratings": Look("orange"),
    "mean": Look("orange"),
    "median": Look("orange", DASHED),
    "min-proxy-mean": Look("lime", DASHED),
    "min-proxy-median": Look("lime", DOTTED),
    "excess": Look("lime"),
    "worst-of-annotations": Look("sky"),
    "worst case (WCO)": Look("sky"),
    "lowest": Look("sky"),
    "lcb": Look("purple"),
    "mean - variance / 2 (UWO)": Look("purple", DASHED),
    "uwo": Look("purple", DASHED),
    "log-mean-exp": Look("violet"),
    "screening": Look("violet", DASHED),
    "witness": Look("violet", DOTTED),
    "true reward": Look("ink", DASHED),
    "true-reward": Look("ink", DASHED),
    # Agents.
    "baseline": Look("vermillion", width=2.0),
    "multi-head": Look("orange"),
    "random walk": Look("grey", DASHED),
    "dqn": Look("vermillion"),
    "ensemble-dqn": Look("vermillion", DASHED),
    "cql": Look("orange"),
    "sunrise": Look("purple"),
    "ppo": Look("blue"),
    "trpo": Look("sky"),
    "cpo": Look("violet"),
    "cpo-oracle": Look("violet", DASHED),
    "sac": Look("grey"),
    "edac": Look("lime"),
    # Who is asked what.
    "random": Look("grey", width=2.0),
    "disputed": Look("vermillion"),
    "half random, half disputed": Look("vermillion", DASHED),
    "least-known": Look("blue"),
    "highest-reward": Look("green"),
    "half random, half highest-reward": Look("green", DASHED),
    "near-ties": Look("violet"),
}
_OTHERS = tuple(
    Look(colour, dash) for dash in (MIXED, DOTTED, DASHED) for colour in ("blue", "purple", "orange", "violet", "grey")
)


def look(name: str) -> Look:
    """Return how a line of this name is drawn; a name that nobody knows here always gets the same look.

    Examples:
        >>> look("uard").colour, look("lcb, ours").colour == look("lcb, ours").colour
        ('green', True)
    """
    return LOOKS.get(name) or _OTHERS[sum(name.encode()) % len(_OTHERS)]


def contrast(one: str, other: str) -> float:
    """Return the contrast of two colours as WCAG 2 has it, from 1 (none) to 21.

    Examples:
        >>> round(contrast("#ffffff", "#000000"), 6), contrast("#0072b2", "#0072b2")
        (21.0, 1.0)
    """
    bright, dim = sorted((_luminance(one), _luminance(other)), reverse=True)
    return (bright + 0.05) / (dim + 0.05)


def _luminance(colour: str) -> float:
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    red, green, blue = (x / 12.92 if x <= 0.04045 else ((x + 0.055) / 1.055) ** 2.4 for x in parts)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue
