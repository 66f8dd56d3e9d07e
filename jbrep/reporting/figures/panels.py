"""Figures: tables drawn as panels of marks in one style, safe for the colour-blind; their files."""

import io
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from jbrep.progress import Progress
from jbrep.records.storage import exclusive, make_folder, write_whole
from jbrep.records.tables import csv_text
from jbrep.stats.runs import LARGEST_RETURN

Row = Mapping[str, Any]  # of a table, by the names of its columns
Key = tuple[Any, ...]  # values that rows have in common
Look = Mapping[str, Any]  # colour and marker
Limits = tuple[float, float]
# draws the rows of a series in a panel, by its look and name, at its place among all
Mark = Callable[[Axes, Sequence[Row], Look, str, int], None]

COLUMN, PAGE = 3.45, 7.1  # widths in a paper of two columns [inches]
INK = "black"
_MARKERS = "osD^vPX*"
# Okabe and Ito's
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F7F7F")
PAPER: Any = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.labelsize": 7,
    "axes.linewidth": 0.6,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 7.5,
    "figure.constrained_layout.use": True,
    "font.size": 7,
    "grid.alpha": 0.25,
    "grid.linewidth": 0.5,
    "legend.fontsize": 6.5,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "pdf.fonttype": 42,  # text stays text
    "savefig.dpi": 250,
    "svg.hashsalt": "jbrep",
    "xtick.labelsize": 6.5,
    "xtick.major.width": 0.6,
    "ytick.labelsize": 6.5,
    "ytick.major.width": 0.6,
}
_UNDATED: Any = {  # the same bytes each time
    "pdf": {"CreationDate": None},
    "png": {"Software": None},
    "svg": {"Date": None},
}
_DASHES = ("--", "-.", (0, (6, 1.5)), (0, (6, 1.5, 1, 1.5, 1, 1.5)))
_SHADES = (0.75, 0.5)  # of a colour, where colours are used again
_ROOM = 0.04  # of an axis, at its ends, for whole markers
_FILLED = 1 / 3  # of an axis, at least, by the values themselves
_BEYOND = 0.25  # of their range, for the ends of intervals on either side
_NAMES_APART = 0.06  # of an axis, between names of lines
_CHARACTER, _HANDLE, _LINE = 0.05, 0.5, 0.14  # of a legend: widths, height of a line [inches]
_USUAL_LINES = 3  # of a legend, that figures have room for


@dataclass(frozen=True, eq=False)
class Plot:
    """A figure to be drawn from a table."""

    name: str  # of its files
    title: str  # a few words
    caption: str  # what the figure shows
    rows: Sequence[Row]  # the table
    draw: Callable[[Sequence[Row]], Figure]

    @cached_property
    def figure(self) -> Figure:
        """The figure, drawn and laid out once for any number of files."""
        with mpl.rc_context(PAPER):
            figure = self.draw(self.rows)
            figure.draw_without_rendering()
            figure.set_layout_engine("none")  # or savefig draws everything twice
        return figure

    def picture(self, kind: str) -> bytes:
        """The figure as pdf, png or svg; an svg has no background."""
        content = io.BytesIO()
        with mpl.rc_context({**PAPER, "figure.constrained_layout.use": False}):
            how = {"format": kind, "metadata": _UNDATED[kind], "transparent": kind == "svg"}
            self.figure.savefig(content, **how)
        return content.getvalue()

    @property
    def csv(self) -> str:
        """The table as text, numbers with seven digits."""
        return csv_text([*self.rows[0]], ([*map(_cell, row.values())] for row in self.rows))


def _cell(value: Any) -> Any:
    if isinstance(value, float):
        return f"{value:.7g}" if np.isfinite(value) else ""
    return "" if value is None else value


def write(plots: Collection[Plot], folder: Path) -> None:
    """Write each figure as PDF and PNG, and its table as CSV."""
    make_folder(folder)
    with exclusive(folder):
        for plot in Progress(plots, unit="figure", delay=1, leave=False):
            for kind in ("pdf", "png"):
                write_whole(folder / f"{plot.name}.{kind}", plot.picture(kind))
            write_whole(folder / f"{plot.name}.csv", plot.csv.encode())


def panels(
    rows: Sequence[Row],
    *,
    mark: Mark,
    looks: Mapping[str, Look],
    facet: Sequence[str],
    series: str,
    axis_labels: tuple[str, str],
    colour: str = "",
    names: Mapping[str, str] = {},
    title: Callable[[Key], str] = ", ".join,
    lines: Mapping[Key, Mapping[str, float]] = {},
    limits: Mapping[Key, Limits] = {},
    across: int = 3,
    height: float = 2.0,
    row: float = 0.0,
    finish: Callable[[Axes, Sequence[Row]], object] = lambda axes, rows: None,
) -> Figure:
    """A panel for each facet of a table, in it a mark for each series.

    Args:
        rows: the table.
        mark: what draws a series.
        looks: of each series, or of each value of `colour`.
        facet: columns whose values a panel's rows share.
        series: a column.
        axis_labels: of x and y; the name of a column stands for its value.
        colour: the column that decides looks, if not that of the series.
        names: what legends call the series.
        title: of a panel, from what its rows share.
        lines: to compare with, by panel and name, on the axis of values.
        limits: of that axis, by panel.
        across: panels side by side, at most.
        height: of a panel [inches], without its rows.
        row: height of a row [inches]: each series is one, with its name, and values are on the x
            axis, not on y.
        finish: what is done to a panel at last.
    """
    parts = by(rows, *facet)
    across = min(across, len(parts))
    down = -(-len(parts) // across)
    height += row * max(len(by(own, series)) for own in parts.values())
    figure = Figure(figsize=(PAGE if across > 1 or row else COLUMN, 0.4 + height * down))
    grid = figure.subplots(down, across, squeeze=False).ravel()
    for axes in grid[len(parts) :]:
        axes.set_axis_off()
    for number, (axes, (key, own)) in enumerate(zip(grid, parts.items(), strict=False)):
        if key in limits:
            axes.set(**{"xlim" if row else "ylim": limits[key]})
        draw_line = axes.axvline if row else axes.axhline
        for i, (name, value) in enumerate(lines.get(key, {}).items()):
            dotted = {"linestyle": ":"} if name == "solved" else {}
            draw_line(value, label=plain(name), **{**reference(i), **dotted})
        named = [plain(str(names.get(name, name))) for (name,) in by(own, series)]
        for place, of_series in enumerate(by(own, series).values()):
            mark(axes, of_series, looks[of_series[0][colour or series]], named[place], place)
        if row:
            axes.set_yticks(range(len(named)), named if number % across == 0 else [""] * len(named))
            axes.set_ylim(len(named) - 0.4, -0.6)
            axes.grid(visible=False, axis="y")
        axes.set_title(plain(title(key)), size=7.5 if across <= 3 else 6)
        x, y = axis_labels
        if x in own[0] or number + across >= len(parts):
            axes.set_xlabel(plain(str(own[0].get(x, x))))
        if y in own[0] or number % across == 0:
            axes.set_ylabel(plain(str(own[0].get(y, y))))
        finish(axes, own)
    legend_below(figure, grid)
    return figure


def by(rows: Iterable[Row], *columns: str) -> dict[Key, list[Row]]:
    """Rows by their values in some columns, in the order in which these first come."""
    found: dict[Key, list[Row]] = {}
    for row in rows:
        found.setdefault(tuple(row[name] for name in columns), []).append(row)
    return found


def column(rows: Iterable[Row], name: str) -> NDArray[np.float64]:
    """The numbers in a column, NaN for None."""
    return np.array([row[name] for row in rows], float)


def line(x: str, y: str, low: str = "", high: str = "", final: str = "", **style: Any) -> Mark:
    """A mark: a line through numbers, with a band between the columns of their ends.

    With `final`, the number in that column is marked beyond the last one, beside its name.
    """

    def draw(axes: Axes, rows: Sequence[Row], look: Look, name: str, _: int) -> None:
        at, value = column(rows, x), column(rows, y)
        ends = [column(rows, each) for each in (low, high) if each]
        how: Any = {"ms": 2.5, "markevery": max(1, len(at) // 8), "label": name, **look, **style}
        if ends:
            step: Any = "post" if "drawstyle" in style else None
            axes.fill_between(
                at, ends[0], ends[1], color=look["color"], alpha=0.13, lw=0, step=step
            )
        axes.plot(
            at, value, clip_on="drawstyle" in style, **how | ({"label": "_"} if final else {})
        )
        if final:
            end = column(rows[-1:], final)
            own = {"color": look["color"], "clip_on": False}
            axes.plot(at[-1:], end, marker="D", ms=3, ls="none", **own)
            _name_at_end(axes, float(end[0]), name, look["color"])

    return draw


def _name_at_end(axes: Axes, value: float, name: str, colour: str) -> None:
    """Write the name of a line beside its end; names keep the order of the ends, and apart."""
    at, where = (1.03, value), axes.get_yaxis_transform()
    look: Any = {"size": 6, "va": "center", "color": colour, "clip_on": False}
    axes.annotate(name.partition(" (n")[0], at, at, xycoords=where, textcoords=where, **look)
    names: list[Any] = sorted(axes.texts, key=lambda each: each.xy[1])  # annotations alone
    gaps = _NAMES_APART * np.diff(axes.get_ylim()) * np.arange(len(names))
    ends = np.array([each.xy[1] for each in names])
    for each, place in zip(names, isotonic_regression(ends - gaps).x + gaps, strict=True):
        each.set_y(place)


def styles(names: Iterable[str], first: str | None = None) -> dict[str, Look]:
    """Colour and marker of each name; the first's colour is that of text."""
    found: dict[str, Look] = {first: {"color": INK, "marker": _MARKERS[0]}} if first else {}
    for i, name in enumerate(name for name in dict.fromkeys(names) if name != first):
        used = i // len(_COLOURS)
        shade = _SHADES[used % len(_SHADES)] if used else 1.0
        red, green, blue = (shade * part for part in to_rgb(_COLOURS[i % len(_COLOURS)]))
        colour = to_hex((red, green, blue)).upper()
        found[name] = {"color": colour, "marker": _MARKERS[(i + 1) % len(_MARKERS)]}
    return found


def reference(number: int = 0) -> dict[str, Any]:
    """How to draw a line to compare with; several have numbers, and dashes of their own."""
    dashes = _DASHES[number % len(_DASHES)]
    return {"color": INK, "linestyle": dashes, "linewidth": 0.9, "alpha": 0.65}


def plain(text: str) -> str:
    """Text in which a dollar sign begins no formula."""
    return text.replace("$", r"\$")


def fitting(values: Iterable[float], ends: Iterable[float], near: Iterable[float]) -> Limits:
    """Limits of an axis of returns, with room for markers; what isn't finite doesn't count.

    Ends of intervals are within unless they are far beyond the values, and so is what is near
    unless the values would fill less than a third of the axis.
    """
    known, outer, others = (
        np.array([value for value in some if abs(value) <= LARGEST_RETURN])
        for some in (values, ends, near)
    )
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    wider = min([low, *others]), max([high, *others])
    if high - low >= _FILLED * (wider[1] - wider[0]):
        low, high = wider
    beyond = np.clip(outer, low - _BEYOND * (high - low), high + _BEYOND * (high - low))
    low, high = min([low, *beyond]), max([high, *beyond])
    room = _ROOM * (high - low) or 0.5
    return low - room, high + room


def legend_below(figure: Figure, grid: Iterable[Axes]) -> None:
    """One legend below all panels, lines to compare with last, in as many columns as fit.

    The figure grows by the lines of the legend beyond the usual number.
    """
    entries = {
        name: handle
        for axes in grid
        for handle, name in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    names = sorted(entries, key=lambda name: getattr(entries[name], "get_alpha", str)() == 0.65)
    longest = max(map(len, names), default=0)
    columns = max(1, int(figure.get_figwidth() / (_HANDLE + longest * _CHARACTER)))
    more = max(0, -(-len(names) // columns) - _USUAL_LINES)
    figure.set_figheight(figure.get_figheight() + _LINE * more)
    handles = [entries[name] for name in names]
    figure.legend(handles, names, loc="outside lower center", ncols=columns)
