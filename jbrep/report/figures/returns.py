"""Final returns, their spread, and learning speed: a point for each run, and intervals."""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jbrep.report.figures.curves import Groups, Played, below, cell, names_with_runs
from jbrep.report.figures.plot import Plot
from jbrep.report.figures.style import (
    COLUMN,
    PAGE,
    Limits,
    Looks,
    Styles,
    draw_policies,
    draw_profile,
    draw_solved,
    limits,
    mark_cut,
    plain,
)
from jbrep.stats.analysis import Analysis, GroupAnalysis
from jbrep.stats.bootstrap import Interval
from jbrep.stats.intervals import FEWEST_RUNS

_LABEL = ("task", "algorithm", "representation")
_JITTER = 0.16  # between the outermost runs and the middle of their representation
_ROOM = 0.04  # of an axis, at its ends, for whole markers
_MOST, _ACROSS = 3, 60  # names that stand side by side, and letters of so many of the longest
_DASHED = " Dashed: policies that don't learn, on the same starts."
_INTERVALS = " Bars: 95 % intervals, from four runs on."
_TILTED = 12  # names at most; more stand upright
_LETTER = 0.06  # length of a character of a name [inches]
_USUAL_HEIGHT = 8  # characters, one upon another, that panels have room for
_CUT = " A triangle at an edge: the interval goes beyond it."


def final_return(groups: Groups, looks: Looks) -> Plot:
    """Final return and its spread by representation."""
    return Plot(
        "final_return",
        "Final return and its spread",
        "Mean return at the end of training, a point for each of n runs, and their mean; from four "
        "runs on, beside it, the standard deviation over runs."
        + _INTERVALS
        + _dashed(groups)
        + _CUT,
        (
            *(*_LABEL, "seed", "final_return", "mean", "mean_low", "mean_high"),
            *("sd", "sd_low", "sd_high"),
        ),
        list(_by_run(groups, "final_return", ("final_return_mean", "final_return_sd"))),
        lambda: _draw_final(groups, looks),
    )


def learning_rate(groups: Groups, played: Played, looks: Looks) -> Plot:
    """How fast each representation learns: the mean return over training.

    Policies that don't learn are beside it where they were `played` on the starts of training.
    """
    return Plot(
        "learning_rate",
        "How fast agents learn",
        "Mean return over all of training (the area under the learning curve), a point for each of "
        "n runs, and their mean."
        + _INTERVALS
        + (_DASHED if any(group.task in played for group in groups) else "")
        + _CUT,
        (*_LABEL, "seed", "mean_return", "mean", "mean_low", "mean_high"),
        list(_by_run(groups, "mean_return", ("mean_return_mean",))),
        lambda: _draw_learning(groups, played, looks),
    )


def profiles(analysis: Analysis, looks: Looks) -> Plot:
    """The share of runs above each return."""
    return Plot(
        "profiles",
        "Performance profiles",
        "The share of n runs whose final return is above that on the axis, with its 95 % bootstrap "
        "interval (Agarwal et al. 2021). Higher is better; steep is steady."
        + _dashed(analysis.groups),
        (*_LABEL, "final_return", "share", "low", "high"),
        [
            (group.task, group.algorithm, label.representation, *row)
            for group in analysis.groups
            for label in group.labels
            for row in zip(group.profile_returns, *label.profile, strict=True)
        ],
        lambda: _draw_profiles(analysis, looks),
    )


def _by_run(groups: Groups, value: str, numbers: Sequence[str]) -> Iterator[tuple[Any, ...]]:
    for group in groups:
        for label in group.labels:
            key = (group.task, group.algorithm, label.representation)
            shared = [cell(part) for name in numbers for part in label.numbers[name]]
            for seed, each in zip(label.seeds, label.by_run[value], strict=True):
                yield (*key, seed, cell(each), *shared)


def _played(group: GroupAnalysis) -> dict[str, float]:
    return {policy: mean.value for policy, mean in group.references.items()}


def _dashed(groups: Groups) -> str:
    return _DASHED if any(group.references for group in groups) else ""


def _height(groups: Groups) -> float:
    """Of a row of panels with the names of representations below, tilted if they are many."""
    longest = max(map(len, names_with_runs(groups).values()))
    most = max(len(group.labels) for group in groups)
    return 1.7 + _LETTER * max(0, math.sin(math.radians(_tilt(most))) * longest - _USUAL_HEIGHT)


def _tilt(names: int) -> float:
    """Of so many names side by side that they don't fit as they are [degrees]."""
    return 30.0 if names <= _TILTED else 90.0


def _panels(groups: Groups, columns: int, height: float) -> tuple[Figure, Any]:
    """A row of panels for each group; two groups side by side where a row has one panel."""
    across = 1 if columns > 1 or len(groups) == 1 else 2
    rows = -(-len(groups) // across)
    width = COLUMN if columns * across == 1 else PAGE
    figure = Figure(figsize=(width, 0.3 + height * rows))
    panels = figure.subplots(rows, columns * across, squeeze=False)
    flat = panels.reshape(-1, columns)
    for axes in flat[len(groups) :].ravel():
        axes.set_axis_off()
    return figure, flat[: len(groups)]


def _draw_final(groups: Groups, looks: Looks) -> Figure:
    scatter = any(len(label.seeds) >= FEWEST_RUNS for group in groups for label in group.labels)
    figure, panels = _panels(groups, 2 if scatter else 1, _height(groups))
    look = looks()
    for (left, *others), group in zip(panels, groups, strict=True):
        extent = _draw_runs(left, group, look, "final_return", _played(group), group.solved)
        if not others:
            continue
        (right,) = others
        deviations = [label.numbers["final_return_sd"] for label in group.labels]
        _from_zero(right, deviations, extent.width / 2)  # more than of any such returns
        right.set_ylabel("SD over runs")
        _name_columns(right, group)
        for i, (label, deviation) in enumerate(zip(group.labels, deviations, strict=True)):
            _draw_interval(right, i, deviation, look[label.representation])
    below(figure, panels.ravel())
    return figure


def _draw_learning(groups: Groups, played: Played, looks: Looks) -> Figure:
    figure, panels = _panels(groups, 1, _height(groups))
    look = looks()
    for (axes,), group in zip(panels, groups, strict=True):
        _draw_runs(axes, group, look, "mean_return", played.get(group.task, {}))
    below(figure, panels.ravel())
    return figure


def _from_zero(axes: Axes, intervals: Sequence[Interval], limit: float) -> None:
    """From zero to all values, and to the ends of their intervals as far as a limit."""
    ends = [end for each in intervals for end in each if end <= limit]
    cut = any(each.high > limit for each in intervals)
    top = max([*ends, *(each.value for each in intervals), limit if cut else 0]) or 1
    axes.set_ylim(Limits(0, top).with_room(_ROOM))


def _draw_runs(
    axes: Axes,
    group: GroupAnalysis,
    look: Styles,
    value: str,
    played: Mapping[str, float],
    solved: float = np.nan,
) -> Limits:
    """A point for each run of each representation, and the mean with its interval."""
    means = [label.numbers[f"{value}_mean"] for label in group.labels]
    every = chain(played.values(), *(label.by_run[value] for label in group.labels))
    extent = limits(every, group.return_floor, solved).with_ends(means, group.return_floor)
    draw_solved(axes.axhline, solved, extent)
    axes.set(ylabel=value.replace("_", " "), ylim=extent.with_room(_ROOM))
    _name_columns(axes, group)
    draw_policies(axes.axhline, played)
    for i, (label, mean) in enumerate(zip(group.labels, means, strict=True)):
        style, runs = look[label.representation], label.by_run[value]
        beside = i - 0.22 + np.linspace(-_JITTER, _JITTER, len(runs)) * (len(runs) > 1)
        axes.plot(beside, runs, ".", color=style["color"], ms=4, alpha=0.6, mew=0)
        _draw_interval(axes, i + 0.16, mean, style)
    return extent


def _name_columns(axes: Axes, group: GroupAnalysis) -> None:
    names = list(names_with_runs([group]).values())
    axes.set_title(plain(group.name))
    fits = len(names) <= _MOST and len(names) * max(map(len, names)) <= _ACROSS
    angle = _tilt(len(names))
    tilt: dict[str, Any] = {"rotation": angle, "ha": "right" if angle < 90 else "center"}
    axes.set_xticks(range(len(names)), names, **({} if fits else tilt))
    axes.set_xlim(-0.6, len(names) - 0.4)
    axes.grid(visible=False, axis="x")


def _draw_interval(axes: Axes, at: float, values: Interval, style: dict[str, Any]) -> None:
    """A value with its interval, upright; no bar where there is no interval."""
    value, low, high = values
    spread = None if np.isnan(low) else np.clip([[value - low], [high - value]], 0, None)
    axes.errorbar([at], [value], spread, ms=4, lw=1.4, capsize=2.5, **style)
    mark_cut(axes, "y", at, values, style["color"])


def _draw_profiles(analysis: Analysis, looks: Looks) -> Figure:
    groups = analysis.groups
    figure, panels = _panels(groups, 1, 2.0)
    look, names = looks(), names_with_runs(groups)
    for (axes,), group in zip(panels, groups, strict=True):
        for label in group.labels:
            name, colour = names[label.representation], look[label.representation]["color"]
            draw_profile(axes, group.profile_returns, label.profile, name, colour)
        draw_policies(axes.axvline, _played(group))
        extent = limits(group.profile_returns, solved=group.solved)
        draw_solved(axes.axvline, group.solved, extent)
        axes.set_title(plain(group.name))
        axes.set(xlim=extent.with_room(0.02), xlabel="final return")
    below(figure, panels.ravel())
    return figure
