"""Differences of final returns that claims are held against, or those from the baseline."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jbrep.report.figures.curves import cell
from jbrep.report.figures.plot import Plot
from jbrep.report.figures.style import (
    COLUMN,
    PAGE,
    Looks,
    Styles,
    limits,
    mark_cut,
    plain,
    reference,
)
from jbrep.stats.analysis import Analysis, GroupAnalysis
from jbrep.stats.bootstrap import Interval
from jbrep.stats.claims import CLAIMS
from jbrep.stats.intervals import UNDEFINED


class _Row(NamedTuple):
    """A difference of final returns."""

    x: str
    y: str
    claim: str  # that was registered; none of a comparison with the baseline
    verdict: str
    estimate: Interval
    tested: Interval
    boundary: float


def differences(analysis: Analysis) -> bool:
    """Whether there are any."""
    return any(_rows(group, analysis.baseline) for group in analysis.groups)


def difference_plot(analysis: Analysis, looks: Looks) -> Plot:
    """The differences, with the boundary of each claim."""
    return Plot(
        "differences",
        "Differences of final returns",
        "Of registered claims, or else from the baseline, seed by seed. Thick: 95 % interval; "
        "thin: the interval of the test that was made; dashed: the boundary, which it must not "
        "hold. A triangle at an edge: the interval goes beyond it.",
        (
            *("task", "algorithm", "representation", "than", "claim", "verdict", "difference"),
            *("low", "high", "test_low", "test_high", "boundary"),
        ),
        list(_cells(analysis)),
        lambda: _draw(analysis, looks),
    )


def _rows(group: GroupAnalysis, baseline: str) -> list[_Row]:
    judged = [
        _Row(v.x, v.y, v.claim, v.verdict, v.estimate, v.interval, v.boundary)
        for v in group.verdicts
        if CLAIMS[v.claim].is_of_returns and np.isfinite(v.estimate.value)
    ]
    return judged or [
        _Row(c.representation, baseline, "", "", c.numbers["final_return_difference"], UNDEFINED, 0)
        for c in group.compared
    ]


def _cells(analysis: Analysis) -> Iterator[tuple[Any, ...]]:
    for group in analysis.groups:
        for row in _rows(group, analysis.baseline):
            numbers = (*row.estimate, *row.tested[1:], row.boundary)
            yield group.task, group.algorithm, *row[:4], *map(cell, numbers)


def _draw(analysis: Analysis, looks: Looks) -> Figure:
    """A panel for each group, on a scale of its own."""
    look = looks()
    every = {group.name: _rows(group, analysis.baseline) for group in analysis.groups}
    panels = {name: rows for name, rows in every.items() if rows}
    longest = max(len(_name(row)) for rows in panels.values() for row in rows)
    heights = [0.6 + 0.24 * len(rows) for rows in panels.values()]
    figure = Figure(figsize=(COLUMN if longest < 30 else PAGE, sum(heights) + 0.2))
    of_panels = figure.subplots(len(panels), 1, squeeze=False, height_ratios=heights)[:, 0]
    for axes, (name, rows) in zip(of_panels, panels.items(), strict=True):
        _draw_panel(axes, rows, look)
        axes.set_title(plain(name))
    of_panels[-1].set_xlabel("difference of final returns")
    return figure


def _name(row: _Row) -> str:
    return f"{row.x} {row.claim} than {row.y}" if row.claim else f"{row.x} - {row.y}"


def _draw_panel(axes: Axes, rows: list[_Row], look: Styles) -> None:
    extent = limits([0.0, *(each for row in rows for each in (row.estimate.value, row.boundary))])
    axes.set_xlim(extent.with_ends(row.estimate for row in rows).with_room(0.05))
    left, right = axes.get_xlim()
    for place, row in enumerate(rows):
        style = look[row.x]
        for (_, *ends), width in ((row.tested, 0.8), (row.estimate, 2)):
            drawn = np.clip(np.nan_to_num(ends, nan=np.nan, neginf=left, posinf=right), left, right)
            axes.plot(drawn, [place, place], color=style["color"], linewidth=width)
        axes.plot([row.estimate.value], [place], style["marker"], color=style["color"], ms=4)
        axes.plot([row.boundary] * 2, [place - 0.45, place + 0.45], **reference())
        mark_cut(axes, "x", place, [*row.estimate, *row.tested], style["color"])
    axes.grid(visible=False, axis="y")
    axes.set_yticks(range(len(rows)), [plain(_name(row)) for row in rows])
    axes.set_ylim(len(rows) - 0.4, -0.6)
