"""Figures of the report: drawn once as SVG for a light and a dark page, with the numbers that they show.

A ``Chart`` draws and writes down what it draws; ``Chart.picture`` ends it. ``files`` has the numbers of pictures as
CSV, to be written beside the page; ``uard.lab.views.templates.picture`` puts a picture on it.

    >>> chart = Chart(["6x6"], x="episode", y="true return")
    >>> chart.line(0, [1, 2, 3], [0.0, 1.0, 2.0], "uard", low=[0.0, 0.5, 1.0], high=[0.0, 1.5, 3.0])
    >>> picture = chart.picture("true-return", "True return", "It rises.", "uard reproduce scale")
    >>> picture.rows[1]
    ('6x6', 'episode', 'true return', 'uard', 2.0, 1.0, 0.5, 1.5)
    >>> list(files([picture]))
    ['figure-true-return.csv']
"""

from __future__ import annotations

import base64
import csv
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from uard import _checks
from uard.lab.study import Row
from uard.lab.views.palette import DARK, DOTTED, LIGHT, LOOKS, Look, look
from uard.lab.views.study_results import StudyResults

matplotlib.use("Agg")

WIDTH = 10.0  # inches of 96 px: as wide as the text of a page 1000 px wide
COLUMNS = ("panel", "x axis", "y axis", "series", "x", "y", "low", "high")  # of the CSV of every chart
_LINE = 15.0  # px from one label at the end of a line to the next
_STYLE: Any = {
    "font.family": "sans-serif",
    "font.size": 9.5,  # points of 96 / 72 px: no text is smaller than 12 px
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9.5,
    "xtick.labelsize": 9.0,
    "ytick.labelsize": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "text.color": LIGHT["ink"],
    "axes.labelcolor": LIGHT["ink"],
    "axes.titlecolor": LIGHT["ink"],
    "axes.edgecolor": LIGHT["soft"],
    "xtick.color": LIGHT["soft"],
    "ytick.color": LIGHT["soft"],
    "grid.color": LIGHT["line"],
    "grid.linewidth": 0.7,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
}
Cell = str | float | None


@dataclass(frozen=True)
class Picture:
    """A picture, what to see in it, and the numbers that it shows.

    Attributes:
        id: Names it and its file: small letters, digits and hyphens.
        title: Above it.
        note: Says what to see.
        image: A ``data:`` address.
        columns: Of ``rows``.
        rows: Exactly what is drawn.
        command: What makes it.
        figure: What matplotlib drew, if it did.
    """

    id: str
    title: str
    note: str
    image: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    command: str
    figure: Figure | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        if not re.fullmatch(r"[a-z0-9][a-z0-9-]*", self.id):
            raise _checks.InvalidValueError("id", self.id, "small letters, digits and hyphens")
        if not self.image.startswith("data:image/"):
            raise _checks.InvalidValueError("image", self.image[:40], "a data: address of an image")
        for name in ("title", "note", "command"):
            if not getattr(self, name).strip():
                raise _checks.InvalidValueError(name, getattr(self, name), "some words")
        for row in self.rows:
            if len(row) != len(self.columns):
                raise _checks.InvalidValueError("rows", row, f"as many cells as columns, {len(self.columns)}")

    @property
    def file(self) -> str:
        """The name of its CSV."""
        return f"figure-{self.id}.csv"

    @property
    def csv(self) -> str:
        """Its numbers."""
        return as_csv(self.columns, self.rows)


def as_csv(columns: Sequence[str], rows: Iterable[Sequence[Cell]]) -> str:
    """Return numbers and names as CSV; what a table calculator would take for a formula has an apostrophe before it.

    Examples:
        >>> print(as_csv(("who", "return"), [("raw", -2.5), ("a, b", None), ("=1+1", 3.0)]))
        who,return
        raw,-2.5
        "a, b",
        '=1+1,3
        <BLANKLINE>
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([_written(x) for x in row] for row in rows)
    return out.getvalue()


def _written(x: Cell) -> str:
    if isinstance(x, str):
        return f"'{x}" if x.startswith(("=", "+", "-", "@", "\t", "\r")) else x
    return "" if x is None or not np.isfinite(x) else f"{x:.6g}"


def files(pictures: Iterable[Picture]) -> dict[str, str]:
    """Return the CSV of each picture by the name of its file."""
    return {p.file: p.csv for p in pictures}


def svg(figure: Figure) -> str:
    """Return a figure as an SVG for a light and a dark page; it has no script and refers to nothing elsewhere.

    Colours are those of ``palette.LIGHT``, and on a dark page, or in a browser that prefers one, those of
    ``palette.DARK``. Text is text, in the font of the reader's system; paths have one decimal, a tenth of a pixel.
    """
    buffer = io.StringIO()
    nothing: dict[str, Any] = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "uard"}):
        figure.savefig(buffer, format="svg", metadata=nothing)
    text = buffer.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->\s*", "", text, flags=re.DOTALL)
    text = re.sub(r"<[^>]+>", _shortened, text)
    text = re.sub(r"\s*\n\s*", "\n", text)
    return text.replace("<defs>", f"<style>{_rules()}</style><defs>", 1)


def _shortened(tag: re.Match[str]) -> str:
    """Return a tag with few decimals and without a font, which all share; text beside tags is kept."""
    text = re.sub(r" d=\"[^\"]*\"", lambda path: re.sub(r"(\.\d)\d+", r"\1", path[0]), tag[0])
    text = re.sub(r"(\.\d\d)\d+", r"\1", text)
    text = re.sub(r"\.0+(?!\d)|(\.\d)0(?!\d)", r"\1", text)
    return re.sub(r"font-family: [^;\"]*(; )?", "", text)


def _rules() -> str:
    """Return the font, and the rules of a dark page: what is drawn in a light colour has the dark one of that name."""
    rules = (
        f'[style*="{part}: {LIGHT[name]}"] {{ {part}: {DARK[name]} !important }}'
        for name in LIGHT
        for part in ("fill", "stroke")
    )
    fonts = "text { font-family: system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif }"
    return f"{fonts} @media (prefers-color-scheme: dark) {{ {' '.join(rules)} }}"


def data_uri(text: str) -> str:
    """Return an SVG as an address that needs no file beside the page."""
    return "data:image/svg+xml;base64," + base64.b64encode(text.encode()).decode()


def apart(places: Sequence[float], gap: float, low: float = 0.0, high: float = 1.0) -> list[float]:
    """Return places that are at least a gap apart, as near as possible to those that were given, and in their order.

    Least squares by pooling neighbours that are too near; if there is no room for all, they reach beyond ``high``.

    Examples:
        >>> apart([0.5, 0.52, 0.9], gap=0.1)
        [0.46, 0.56, 0.9]
        >>> apart([0.0, 0.0], gap=0.25)
        [0.0, 0.25]
    """
    order = sorted(range(len(places)), key=lambda i: places[i])
    pools: list[list[float]] = []  # mean of what is pooled, less the room of those before; how many they are
    for rank, i in enumerate(order):
        pools.append([places[i] - rank * gap, 1.0])
        while len(pools) > 1 and pools[-2][0] >= pools[-1][0]:
            mean, count = pools.pop()
            pools[-1][0] = (pools[-1][0] * pools[-1][1] + mean * count) / (pools[-1][1] + count)
            pools[-1][1] += count
    free = [mean for mean, count in pools for _ in range(int(count))]
    top = max(low, high - (len(places) - 1) * gap)
    found = {
        i: round(min(max(x, low), top) + rank * gap, 9) for rank, (i, x) in enumerate(zip(order, free, strict=True))
    }
    return [found[i] for i in range(len(places))]


def moving_average(curves: np.ndarray, width: int = 10, every: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Return every so many-th point of the moving average of curves, and at which point it ends (from 1).

    Examples:
        >>> x, y = moving_average(np.array([[1.0, 3.0, 5.0, 7.0]]), width=2, every=2)
        >>> x.tolist(), y.tolist()
        ([2, 4], [[2.0, 6.0]])

    Args:
        curves: (seeds, points).
        width: Of the window.
        every: What is left out between two points is not drawn, and not in the CSV.
    """
    sums = np.cumsum(np.pad(curves, ((0, 0), (1, 0))), axis=1)
    smooth = (sums[:, width:] - sums[:, :-width]) / width
    return np.arange(width, curves.shape[1] + 1)[::every], smooth[:, ::every]


class Chart:
    """Panels side by side that are drawn step by step, and the numbers that are drawn.

    Attributes:
        figure: What is drawn.
        axes: Its panels, row by row.
        rows: What was drawn, one point each, see ``COLUMNS``.
    """

    def __init__(
        self,
        titles: Sequence[str],
        x: str | Sequence[str],
        y: str | Sequence[str],
        columns: int = 0,
        height: float = 3.5,
        share: bool = False,
    ):
        """Begin one.

        Args:
            titles: Of the panels.
            x: What is at the bottom of all, or of each, with its unit.
            y: What is at their left.
            columns: How many stand in a row; 0 for all.
            height: Of a row of panels, in inches of 96 px.
            share: Whether all have the same vertical axis.
        """
        columns = columns or len(titles)
        rows = -(-len(titles) // columns)
        self.titles = tuple(titles)
        self.x, self.y = ((label,) * len(titles) if isinstance(label, str) else tuple(label) for label in (x, y))
        with matplotlib.rc_context(_STYLE):
            # An SVG counts 72 units an inch, and a browser draws 96 px: both are sizes of type here.
            self.figure = Figure(figsize=(WIDTH, height * rows), layout="constrained")
            grid = self.figure.subplots(rows, columns, squeeze=False, sharey=share)
            self.axes: list[Axes] = list(grid.flat)
            for i, axis in enumerate(self.axes[: len(titles)]):
                alone = not share or i % columns == 0
                axis.set(title=self.titles[i], xlabel=self.x[i], ylabel=self.y[i] if alone else "")
                axis.tick_params(length=0)
                axis.margins(x=0.015)
        self.figure.get_layout_engine().set(w_pad=0.08, h_pad=0.06, wspace=0.03, hspace=0.04)  # type: ignore[union-attr]
        for axis in self.axes[len(titles) :]:
            axis.remove()
        del self.axes[len(titles) :]
        self.height = height
        self.rows: list[tuple[Cell, ...]] = []
        self._ends: dict[int, list[tuple[float, float, str, Look]]] = {}

    def line(
        self,
        panel: int,
        x: Any,
        y: Any,
        name: str,
        low: Any = None,
        high: Any = None,
        look_of: Look | None = None,
        label: str | None = None,
        markers: bool = False,
    ) -> None:
        """Draw a line, and a band from low to high if there is one.

        Args:
            panel: Number of the panel.
            x: Of the points.
            y: Alike; NaN is left out.
            name: Of the line, in the CSV and for its look.
            low: Where the band begins.
            high: Where it ends.
            look_of: How it is drawn; by its name if left out.
            label: What stands at its end; the name if left out, nothing if empty.
            markers: Whether points are marked.
        """
        how = look_of or look(name)
        x, y = np.asarray(x, float), np.asarray(y, float)
        axis = self.axes[panel]
        marks: Any = {"marker": "o", "ms": 4.0} if markers else {}
        axis.plot(x, y, color=how.light, ls=how.dash, lw=how.width, label=name, solid_capstyle="round", **marks)
        ends: tuple[Any, Any] = [None] * len(x), [None] * len(x)
        if low is not None and high is not None:
            ends = np.asarray(low, float), np.asarray(high, float)
            axis.fill_between(x, *ends, color=how.light, alpha=0.16, lw=0)
        for point in zip(x, y, *ends, strict=True):
            self._write(panel, name, *point)
        here = np.flatnonzero(np.isfinite(y))
        if label != "" and len(here):
            self._ends.setdefault(panel, []).append((float(x[here[-1]]), float(y[here[-1]]), label or name, how))

    def dots(
        self, panel: int, x: Any, y: Any, name: str, how: Look | None = None, hollow: bool = False, size: float = 4.5
    ) -> None:
        """Draw points."""
        how = how or look(name)
        x, y = np.asarray(x, float), np.asarray(y, float)
        face = "none" if hollow else how.light
        self.axes[panel].plot(x, y, "o", color=how.light, mfc=face, ms=size, mew=1.2, label=name)
        for point in zip(x, y, strict=True):
            self._write(panel, name, *point)

    def bars(self, panel: int, x: Any, y: Any, name: str, low: Any, high: Any, width: float) -> None:
        """Draw bars with their intervals."""
        how = look(name)
        x, y, low, high = (np.asarray(z, float) for z in (x, y, low, high))
        axis = self.axes[panel]
        axis.bar(x, y, width, color=how.light, label=name)
        axis.errorbar(x, y, np.stack([y - low, high - y]), fmt="none", color=LIGHT["ink"], lw=1)
        for point in zip(x, y, low, high, strict=True):
            self._write(panel, name, *point)

    def reference(self, panel: int, value: float, text: str, way: Literal["x", "y"] = "y", at: float = 0.02) -> None:
        """Draw a dotted grey line across a panel, the paper's number perhaps, and say on it what it is.

        Args:
            panel: Number of the panel.
            value: Where it is.
            text: Stands on it; nothing if empty.
            way: Of which axis the value is.
            at: Where the text begins along the line, a share of the panel.
        """
        axis = self.axes[panel]
        draw = axis.axhline if way == "y" else axis.axvline
        draw(value, color=LIGHT["grey"], ls=DOTTED, lw=1.4)
        self._write(panel, text or "mark", *((None, value) if way == "y" else (value, None)))
        place: Any = (at, value) if way == "y" else (value, at)
        coordinates: Any = ("axes fraction", "data") if way == "y" else ("data", "axes fraction")
        axis.annotate(text, place, (3, 3), coordinates, "offset points", color=LIGHT["soft"], fontsize=9.0)

    def shade(self, panel: int, windows: Iterable[tuple[float, float]]) -> None:
        """Shade some windows of the horizontal axis."""
        for first, last in windows:
            self.axes[panel].axvspan(first, last, color=LIGHT["shade"], lw=0, zorder=0)
            self._write(panel, "shaded", first, None, first, last)

    def plain(self, panel: int, ticks: Mapping[float, str] | Sequence[float], way: Literal["x", "y"] = "x") -> None:
        """Set the ticks of an axis, written plainly: no power of ten, and none between them."""
        axis = self.axes[panel].xaxis if way == "x" else self.axes[panel].yaxis
        named = ticks if isinstance(ticks, Mapping) else {t: f"{t:,g}".replace(",", " ") for t in ticks}
        axis.set_ticks(list(named), list(named.values()))
        axis.set_ticks([], minor=True)

    def thousands(self, panel: int) -> None:
        """Write large numbers of the horizontal axis in groups of three digits."""
        self.axes[panel].xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,.0f}".replace(",", " ")))

    def key(self, names: Mapping[str, Look], columns: int = 0) -> None:
        """Draw a legend above all panels, for what no line's end can name."""
        lines = [Line2D([], [], color=how.light, ls=how.dash, lw=max(how.width, 1.8)) for how in names.values()]
        with matplotlib.rc_context(_STYLE):
            self.figure.legend(
                lines, list(names), loc="outside upper left", ncols=columns or len(names), frameon=False, fontsize=9.0
            )

    def picture(self, id: str, title: str, note: str, command: str) -> Picture:
        """Name the lines at their ends and return the picture."""
        with matplotlib.rc_context(_STYLE):
            self._label()
        image = data_uri(svg(self.figure))
        return Picture(id, title, note, image, COLUMNS, tuple(self.rows), command, self.figure)

    def _write(self, panel: int, name: str, x: Any, y: Any, low: Any = None, high: Any = None) -> None:
        if all(z is None or np.isfinite(z) for z in (x, y)):
            numbers = (None if z is None else float(z) for z in (x, y, low, high))
            self.rows.append((self.titles[panel], self.x[panel], self.y[panel], name, *numbers))

    def _label(self) -> None:
        """Write the name of each line at the right, with a short piece of the line between its end and the name."""
        room = 96 * self.height - 70  # px that title, ticks and label leave of a row
        for panel, ends in self._ends.items():
            axis = self.axes[panel]
            axis.set(
                xlim=axis.get_xlim(), ylim=axis.get_ylim()
            )  # a transform knows its limits only once they are asked for
            drawn = [axis.transLimits.transform(axis.transScale.transform((x, y))) for x, y, *_ in ends]
            edges = [min(max(float(y), 0.0), 1.0) for _, y in drawn]
            places = apart(edges, _LINE / room)
            for (x, _), edge, place, (*_, text, how) in zip(drawn, edges, places, ends, strict=True):
                for xs, ys, width in (
                    ([min(float(x), 1.005), 1.005], [edge, edge], 0.5),  # a line that ends before the edge
                    ([1.005, 1.03, 1.05], [edge, place, place], 0.8 * max(how.width, 1.4)),
                ):
                    axis.plot(
                        xs, ys, color=how.light, ls=how.dash, lw=width, transform=axis.transAxes, clip_on=False,
                        label="_leader",
                    )  # fmt: skip
                axis.annotate(
                    text,
                    (1.06, place),
                    xycoords="axes fraction",
                    va="center",
                    fontsize=9.0,
                    fontweight="bold" if text == "uard" else "normal",
                )


def ends_of(summaries: Sequence[Any]) -> tuple[list[float], list[float], list[float]]:
    """Return means, and where their intervals begin and end; one seed has none, which is its mean."""
    every = [(s.mean, *(s.ci95 or (s.mean, s.mean))) for s in summaries]
    mean, low, high = zip(*every, strict=True)
    return list(mean), list(low), list(high)


def command(results: StudyResults) -> str:
    """Return what makes a figure of grid studies."""
    return f"uard reproduce --seeds {len(results.seeds)} --report report"


def made_by(sources: Iterable[Mapping[str, Any]], word: str, otherwise: str) -> str:
    """Return the first command of published files in which a word stands, and another one if there is none.

    Examples:
        >>> made_by([{"command": "uard reproduce games --seeds 10"}, {}], "games", "")
        'uard reproduce games --seeds 10'
    """
    return next((x for source in sources if word in (x := str(source.get("command", ""))).split()), otherwise)


def competition(results: StudyResults) -> Picture:
    """True return of the serious rivals against rater noise, 10x10."""
    noises = list(dict.fromkeys(r["noise"] for r in results.studies["matrix"].rows))
    panels = ("main", "appendix")
    chart = Chart(
        [f"10x10, +4, {panel} panel" for panel in panels],
        "noise of every rater (sd, reward units)",
        "true return per episode",
        share=True,
    )
    for i, panel in enumerate(panels):
        for name in ("mean-of-annotations", "worst-of-annotations", "lcb", "excess", "uard"):
            s = [
                results.get("matrix", "true_return", mitigation=name, size=10, trap=4.0, panel=panel, noise=z)
                for z in noises
            ]
            mean, low, high = ends_of(s)
            chart.line(i, range(len(noises)), mean, name, low, high, markers=True)
        chart.plain(i, {j: f"{z:g}" for j, z in enumerate(noises)})
    return chart.picture(
        "competition",
        "Against the serious rivals",
        "See who stays up as raters become noisy, from left to right. Points are means over seeds, bands their 95 % "
        "intervals.",
        command(results),
    )


def budgets(results: StudyResults) -> Picture:
    """True return against the share of steps that are rated, 10x10."""
    rows: list[Row] = list(results.studies["budgets"].rows)
    names = list(dict.fromkeys(r["mitigation"] for r in rows))
    shown = [(p, z) for p in ("main", "appendix") for z in (0.0, 1.2)]
    titles = [f"{panel} panel, noise of sd {level:g}" for panel, level in shown]
    chart = Chart(titles, "steps that are rated", "true return per episode", columns=2, height=3.4)
    for i, (panel, level) in enumerate(shown):
        for name in names:
            s = [
                results.get("budgets", "true_return", mitigation=name, panel=panel, noise=level, rated=b)
                for b in (0.01, 0.1, 1.0)
            ]
            mean, low, high = ends_of(s)
            chart.line(i, range(3), mean, name, low, high, _budget_look(name), markers=True)
        chart.plain(i, {0: "1 %", 1: "10 %", 2: "100 %"})
    return chart.picture(
        "budgets",
        "Few ratings",
        "See how little has to be rated: at 1 % of the steps rules part. Dashed: the same rivals with our treatment of "
        "steps that nobody has rated. Points are means over seeds, bands their 95 % intervals.",
        command(results),
    )


def _budget_look(name: str) -> Look:
    if name in LOOKS:
        return LOOKS[name]
    base, _, ours = name.partition(",")
    plain = look(base.replace("worst-of", "worst-of-annotations").replace("-annotations-annotations", "-annotations"))
    return plain._replace(dash=(0.0, (4.0, 1.6))) if ours else plain
