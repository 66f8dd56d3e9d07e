"""Do diagnostics predict learning? Final returns of a study against diagnostics of its codes."""

from collections.abc import Sequence
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from jbrep.report.figures.curves import below, cell
from jbrep.report.figures.plot import Plot
from jbrep.report.figures.style import PAGE, Looks, Styles, ink, limits, plain, reference
from jbrep.stats.analysis import GroupAnalysis
from jbrep.stats.association import Association

_SHOWN = ("rewarded", "forward", "reward", "value", "action", "error")  # in panels of their own
_ACROSS, _HEIGHT = 3, 1.65  # panels beside each other, and their height [inches]
_PANEL = (1.05, 0.95)  # of their axes, about [inches]
_CHARACTER, _LINE, _MARKER = 0.038, 0.08, 0.045  # of a name, and of a point's radius [inches]
_ROOM = 0.08  # of an axis, at its ends


def diagnostics(associations: Sequence[Association], looks: Looks) -> Plot:
    """How well each diagnostic ranks the codes, and the codes by the main ones; of at least one."""
    return Plot(
        "diagnostics",
        "Final return against diagnostics",
        "Each code by the main diagnostics, better ones to the right, with its mean final return. "
        "Where there are five codes or more, on the left: the rank correlation of each diagnostic "
        "with the final return, with its 95 % bootstrap interval over families of codes: 1 if the "
        "better value always goes with the higher return.",
        (
            *("task", "algorithm", "diagnostic", "representation", "value", "final_return"),
            *("rank_correlation", "low", "high", "codes", "families"),
        ),
        [
            (
                *(each.group.task, each.group.algorithm, each.diagnostic.name, name),
                *(cell(value), cell(final)),
                *(*map(cell, each.correlation), len(each.values), len(set(each.families))),
            )
            for each in associations
            for name, value, final in zip(
                each.representations, each.values, each.returns, strict=True
            )
        ],
        lambda: _draw(associations, looks),
    )


def _draw(associations: Sequence[Association], looks: Looks) -> Figure:
    """For each group a column of rank correlations, and beside it panels of codes."""
    groups = {each.group.name: each.group for each in associations}
    by_group = {name: [a for a in associations if a.group.name == name] for name in groups}
    rows = max(-(-len(_main(each)) // _ACROSS) for each in by_group.values())
    rows = max(rows, 2)  # room for the names of all diagnostics
    figure = Figure(figsize=(PAGE, 0.6 + _HEIGHT * rows * len(groups)))
    ranked = any(np.isfinite(each.correlation.value) for each in associations)
    widths = (1.15, 1, 1, 1) if ranked else (1, 1, 1)
    grid = figure.add_gridspec(rows * len(groups), len(widths), width_ratios=widths)
    look, panels = looks(), []
    for i, (name, group) in enumerate(groups.items()):
        told = plain(f"{group.task},\n{group.algorithm}")
        if ranked:
            left = figure.add_subplot(grid[i * rows : (i + 1) * rows, 0])
            _draw_correlations(left, by_group[name])
            left.set_title(told)
        for j, each in enumerate(_main(by_group[name])):
            place = i * rows + j // _ACROSS, j % _ACROSS + (len(widths) - _ACROSS)
            axes = figure.add_subplot(grid[place])
            _draw_codes(axes, each, group, look)
            what = "final return" if ranked else f"{told}\nfinal return"
            axes.set_ylabel("" if j % _ACROSS else what)
            panels.append(axes)
    below(figure, panels)
    return figure


def _main(associations: Sequence[Association]) -> list[Association]:
    by_name = {each.diagnostic.name: each for each in associations}
    return [by_name[name] for name in _SHOWN if name in by_name]


def _draw_correlations(axes: Axes, associations: Sequence[Association]) -> None:
    """A row for each diagnostic."""
    axes.axvline(0, **reference())
    for row, each in enumerate(associations):
        value, low, high = each.correlation
        axes.plot((low, high), (row, row), color=ink(), lw=1.4)
        axes.plot(value, row, "o", color=ink(), ms=4)
    axes.set_yticks(range(len(associations)), [plain(a.diagnostic.name) for a in associations])
    axes.set(xlim=(-1.05, 1.05), ylim=(len(associations) - 0.4, -0.6))
    axes.set_xlabel("rank correlation with final return")
    axes.grid(visible=False, axis="y")


def _draw_codes(axes: Axes, association: Association, group: GroupAnalysis, look: Styles) -> None:
    """A point for each code, with its name where there is room."""
    values, returns = association.values, association.returns
    wide = limits(values)
    extent = limits(label.numbers["final_return_mean"].value for label in group.labels)
    axes.set(xlim=wide.with_room(_ROOM), ylim=extent.with_room(_ROOM))
    if association.diagnostic.better < 0:
        axes.invert_xaxis()
    points = axes.transLimits.transform(np.stack((values, returns), 1)) * _PANEL
    names = association.representations
    for name, x, y, place in zip(names, values, returns, _free(names, points), strict=True):
        style = {**look[name], "linestyle": "none"}
        axes.plot(x, y, ms=4, label=plain(name), clip_on=False, **style)
        if place is not None:
            offset = (72 * place[0], 72 * place[1])
            text: Any = {"textcoords": "offset points", "size": 5, "va": "center", "ha": "left"}
            axes.annotate(plain(name), (x, y), offset, **text)
    correlation = association.correlation.value
    known = f" {correlation:.2f}" if np.isfinite(correlation) else ""
    axes.set_title(plain(association.diagnostic.name) + known)
    axes.set_xlabel(plain(fill(association.diagnostic.words, 30)), size=6)


def _free(names: Sequence[str], points: Any) -> list[tuple[float, float] | None]:
    """Where each name can begin, from its point; None where it would cover something.

    Points (n, 2), and places, are in inches; names come in order of precedence.
    """
    taken = [Bbox(((x - _MARKER, y - _MARKER), (x + _MARKER, y + _MARKER))) for x, y in points]
    places: list[tuple[float, float] | None] = []
    for name, (x, y) in zip(names, points, strict=True):
        width = _CHARACTER * len(name)
        places.append(None)
        for dx, dy in ((0.05, 0.0), (-0.05 - width, 0.0), (-width / 2, 0.09), (-width / 2, -0.09)):
            box = Bbox.from_bounds(x + dx, y + dy - _LINE / 2, width, _LINE)
            inside = min(box.min) >= 0 and np.all(box.max <= np.array(_PANEL))
            if inside and not any(map(box.fully_overlaps, taken)):
                taken.append(box)
                places[-1] = (dx, dy)
                break
    return places
