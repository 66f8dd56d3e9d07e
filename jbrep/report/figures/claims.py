"""What claims are held against: their estimates, with the boundaries that would decide them."""

import textwrap
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from jbrep.report.figures.curves import Groups, cell, names_with_runs
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
from jbrep.report.words import Statement, statements
from jbrep.stats.analysis import Analysis, GroupAnalysis
from jbrep.stats.claims import Verdict

_MAX_DECADES = 4  # of a ratio, on each side of 1
_ACROSS = 38  # characters of a panel's axis


def claim_plot(analysis: Analysis, looks: Looks) -> Plot:
    """The estimate of each claim, with its boundary."""
    return Plot(
        "claims",
        "What is claimed",
        f"Each representation against {analysis.baseline}. Thick: 95 % interval; thin: the "
        "interval of the test that was made; dashed: the boundary of each claim, which it must "
        "not contain. A triangle at an edge: the interval goes beyond it.",
        (
            *("task", "algorithm", "representation", "claim", "estimate", "low", "high"),
            *("test_low", "test_high", "boundary", "verdict"),
        ),
        list(_rows(analysis)),
        lambda: _draw(analysis, looks),
    )


def _rows(analysis: Analysis) -> Iterator[tuple[Any, ...]]:
    for group in analysis.groups:
        for comparison in group.compared:
            for each in comparison.verdicts:
                numbers = (*each.estimate, *each.interval[1:], each.boundary)
                key = (group.task, group.algorithm, comparison.representation, each.claim)
                yield (*key, *map(cell, numbers), each.verdict)


def _draw(analysis: Analysis, looks: Looks) -> Figure:
    """A row of panels for each group, a column for each estimand, to one scale each."""
    groups = [group for group in analysis.groups if group.compared]
    look, claims = looks(), statements(analysis.planned)
    columns = _columns(claims)
    most = max(len(group.compared) for group in groups)
    width = COLUMN if len(columns) == 1 else PAGE
    figure = Figure(figsize=(width, 0.2 + (0.75 + 0.19 * most) * len(groups)))
    panels = figure.subplots(len(groups), len(columns), squeeze=False, sharey="row")
    for j, numbers in enumerate(columns):
        claim = claims[numbers[0]]
        for axes, group in zip(panels[:, j], groups, strict=True):
            _scale(axes, claim.is_ratio, groups, numbers)
            _draw_panel(axes, group, numbers, look)
            title = ", ".join(claims[number].name for number in numbers)
            axes.set_title(plain(f"{group.name}\n{title}" if j == 0 else f"\n{title}"))
            axes.set_xlabel(textwrap.fill(plain(claim.estimand), _ACROSS))
    for axes, group in zip(panels[:, 0], groups, strict=True):
        _, *names = names_with_runs([group]).values()
        axes.set_yticks(range(len(names)), names)
        axes.set_ylim(len(names) - 0.4, -0.6)
    return figure


def _columns(claims: Sequence[Statement]) -> list[list[int]]:
    """The numbers of the claims of each estimand."""
    found: dict[str, list[int]] = {}
    for number, claim in enumerate(claims):
        found.setdefault(claim.estimand, []).append(number)
    return [*found.values()]


def _verdicts(groups: Groups, numbers: Sequence[int]) -> list[Verdict]:
    every = (each.verdicts for group in groups for each in group.compared)
    return [verdicts[number] for verdicts in every for number in numbers]


def _scale(axes: Axes, is_ratio: bool, groups: Groups, numbers: Sequence[int]) -> None:
    """The same limits for all groups; no interval stretches them far."""
    shown = _verdicts(groups, numbers)
    ends = np.array([[*v.estimate, *v.interval, v.boundary] for v in shown])
    if not is_ratio:
        values = np.concatenate([ends[:, 0], ends[:, -1]])
        extent = limits(values[np.isfinite(values)]).with_ends(v.estimate for v in shown)
        axes.set_xlim(extent.with_room(0.05))
        axes.xaxis.set_major_locator(MaxNLocator(5))
    else:
        known = np.append(ends[np.isfinite(ends) & (ends > 0)], 1)
        decades = min(float(np.abs(np.log10(known)).max()), _MAX_DECADES)
        axes.set(xscale="log", xlim=(10 ** -(decades + 0.1), 10 ** (decades + 0.1)))
        _few_decades(axes, decades)


def _draw_panel(axes: Axes, group: GroupAnalysis, numbers: Sequence[int], look: Styles) -> None:
    left, right = axes.get_xlim()
    for verdict in _verdicts([group], numbers)[: len(numbers)]:
        axes.axvline(verdict.boundary, **reference())
    for row, comparison in enumerate(group.compared):
        verdict, style = comparison.verdicts[numbers[0]], look[comparison.representation]
        for (_, *ends), width in ((verdict.interval, 0.8), (verdict.estimate, 2)):
            drawn = np.nan_to_num(ends, nan=np.nan, neginf=left, posinf=right)
            axes.plot(drawn, [row, row], color=style["color"], linewidth=width)
        axes.plot([verdict.estimate.value], [row], style["marker"], color=style["color"], ms=4)
        mark_cut(axes, "x", row, [*verdict.estimate, *verdict.interval], style["color"])
    axes.grid(visible=False, axis="y")


def _few_decades(axes: Axes, limit: float) -> None:
    """Ticks as 0.1 and 10, or as 1/3 and 3 where the axis is short."""
    ticks = 3.0 ** np.arange(-1, 2) if limit < 1 else 10.0 ** np.arange(-int(limit), limit + 0.01)
    axes.xaxis.set_major_locator(FixedLocator(ticks[:: -(-len(ticks) // 7)].tolist()))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:.2g}" if x < 1 else f"{x:,.0f}"))
