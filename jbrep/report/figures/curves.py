"""Learning curves: returns over training."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, MaxNLocator

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
    panel_grid,
    plain,
    reference,
    with_runs,
)
from jbrep.stats.analysis import Analysis, GroupAnalysis
from jbrep.study.tables import Return, by_run

Groups = Sequence[GroupAnalysis]
Runs = dict[int, dict[int, float]]  # mean returns of a label, by seed and step
Played = Mapping[str, Mapping[str, float]]  # mean returns by task and policy that learns nothing

_POLICIES = "policies that don't learn, on the same starts"  # in captions
_MOST_ACROSS = 5  # panels of runs side by side
_TITLE = 0.062  # width of a character in a panel's title [inches]
_HANDLE, _CHARACTER, _LINE = 0.5, 0.05, 0.14  # of a legend: widths, height of a line [inches]
_USUAL_LINES = 3  # of a legend, that figures have room for
_FEW = 7  # representations on one axis, beyond which a panel is a page wide and bands are faint
_COLUMNS = (
    *("task", "algorithm", "representation", "step"),
    *("p10", "p50", "p90", "iqm", "iqm_low", "iqm_high"),
)


def curves(groups: Groups, played: Played, looks: Looks) -> Plot:
    """Every representation on one axis, tasks by algorithms."""
    extents = _extents(groups, played)
    caption = "Return of the deterministic policy over training: median and 10 to 90 % over n runs."
    if any(played.get(task) for task in extents):
        caption += f" Dashed: {_POLICIES}."
    solved = {group.solved for group in groups if extents[group.task].contain(group.solved)}
    if solved:
        values = ", ".join(f"{value:,g}" for value in sorted(solved))
        caption += f" Dotted: the return from which on a task counts as solved ({values})."
    return Plot(
        "representations",
        "Return over training by representation",
        caption,
        _COLUMNS,
        list(_rows(groups)),
        lambda: _draw_curves(groups, played, extents, looks),
    )


def _extents(groups: Groups, played: Played) -> dict[str, Limits]:
    """The limits of returns for each task, which its algorithms share."""
    returns = defaultdict[str, list[float]](list)
    for group in groups:
        returns[group.task] += played.get(group.task, {}).values()
        for label in group.labels:
            returns[group.task] += [*label.curve.p10, *label.curve.p90]
    facts = {group.task: (group.return_floor, group.solved) for group in groups}
    return {task: limits(values, *facts[task]) for task, values in returns.items()}


def every_run(returns: Sequence[Return], played: Played, looks: Looks) -> Plot:
    """Each run by itself: a row for each task and algorithm, a panel for each representation.

    Panels come in the order of looks; there is at least one return.
    """
    labels: dict[tuple[str, ...], Runs] = defaultdict(dict)  # by task, algorithm, representation
    for (label, seed), by_step in by_run(returns).items():
        fewest = min(map(len, by_step.values()))  # the last evaluation may have more starts
        means = {step: float(np.mean(each[:fewest])) for step, each in by_step.items()}
        labels[tuple(label.rsplit("/", 2))][seed] = means
    return Plot(
        "every_run",
        "Every run",
        "Mean return of each evaluation, a line for each of n runs; thick: their median."
        + (f" Dashed: {_POLICIES}." if played else ""),
        ("task", "algorithm", "representation", "seed", "step", "mean_return"),
        [
            (*label, seed, step, cell(mean))
            for label, runs in labels.items()
            for seed, means in runs.items()
            for step, mean in means.items()
        ],
        lambda: _draw_runs(labels, played, looks),
    )


def _rows(groups: Groups) -> Iterator[tuple[Any, ...]]:
    for group in groups:
        for label in group.labels:
            curve = label.curve
            columns = (group.grid, curve.p10, curve.p50, curve.p90, *curve.iqm)
            for step, *values in zip(*columns, strict=True):
                key = (group.task, group.algorithm, label.representation, int(step))
                yield *key, *(cell(value) for value in values)


def cell(value: float) -> str:
    """A number in a figure's table; nothing for what isn't finite."""
    return f"{value:.7g}" if np.isfinite(value) else ""


def names_with_runs(groups: Groups) -> dict[str, str]:
    """Each representation for a legend, with the number of its runs."""
    counts = defaultdict(list)
    for group in groups:
        for label in group.labels:
            counts[label.representation].append(len(label.seeds))
    return {name: with_runs(name, each) for name, each in counts.items()}


def _draw_curves(
    groups: Groups, played: Played, extents: Mapping[str, Limits], looks: Looks
) -> Figure:
    """A panel for each task (rows) and algorithm (columns), over steps of training."""
    tasks = list(dict.fromkeys(group.task for group in groups))
    algorithms = list(dict.fromkeys(group.algorithm for group in groups))
    by_place = {(group.task, group.algorithm): group for group in groups}
    look, names = looks(), names_with_runs(groups)
    width = COLUMN if len(algorithms) == 1 and len(names) <= _FEW else PAGE
    figure = Figure(figsize=(width, 0.5 + (2.0 if len(algorithms) < 3 else 1.6) * len(tasks)))
    panels = figure.subplots(len(tasks), len(algorithms), squeeze=False, sharey="row")
    longest = max(len(group.name) for group in groups)
    gap = ", " if _TITLE * longest < width / len(algorithms) else ",\n"
    for (i, j), axes in np.ndenumerate(panels):
        group = by_place.get((tasks[i], algorithms[j]))
        if group is None:
            axes.set_axis_off()
            continue
        draw_policies(axes.axhline, played.get(group.task, {}))
        draw_solved(axes.axhline, group.solved, extents[group.task])
        _draw_medians(axes, group, names, look)
        axes.set_title(plain(f"{tasks[i]}{gap}{algorithms[j]}"))
        _training_axes(axes, group.grid[-1], extents[group.task], len(algorithms))
        axes.set_xlabel("training step" if i == len(tasks) - 1 else "")
        axes.set_ylabel("" if j else "return")
    below(figure, panels.ravel())
    return figure


def _draw_medians(axes: Axes, group: GroupAnalysis, names: Mapping[str, str], look: Styles) -> None:
    """The median over runs of each representation, with a band from 10 to 90 %."""
    grid, faint = group.grid, 0.15 if len(names) <= _FEW else 0.05
    for label in group.labels:
        style, curve = look[label.representation], label.curve
        axes.fill_between(grid, curve.p10, curve.p90, color=style["color"], alpha=faint, lw=0)
        axes.plot(
            grid,
            curve.p50,
            label=names[label.representation],
            ms=2.5,
            markevery=max(1, len(grid) // 8),
            clip_on=False,  # whole markers at the edges
            **style,
        )


def _training_axes(axes: Axes, last: float, extent: Limits, across: int) -> None:
    """Steps from 0 on, and returns, of one of so many panels side by side."""
    axes.set(xlim=(0, max(last, 1)), ylim=extent.with_room(0.015))
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.xaxis.set_major_locator(MaxNLocator(5 if across < _MOST_ACROSS else 3))


def below(figure: Figure, panels: Iterable[Axes]) -> None:
    """One legend below all panels, reference lines last, in as many columns as fit.

    The figure grows by the lines of the legend beyond the usual number.
    """
    entries = {
        name: handle
        for axes in panels
        for handle, name in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    names = sorted(entries, key=lambda name: _is_broken(entries[name]))
    longest = max(map(len, names), default=0)
    columns = max(1, int(figure.get_figwidth() / (_HANDLE + longest * _CHARACTER)))
    lines = -(-len(names) // columns)
    figure.set_figheight(figure.get_figheight() + _LINE * max(0, lines - _USUAL_LINES))
    handles = [entries[name] for name in names]
    figure.legend(handles, names, loc="outside lower center", ncols=columns)


def _is_broken(handle: Any) -> bool:
    return isinstance(handle, Line2D) and handle.get_linestyle() not in ("-", "None")


def _draw_runs(labels: Mapping[tuple[str, ...], Runs], played: Played, looks: Looks) -> Figure:
    of_task = {task: list(of_task.values()) for task, of_task in played.items()}
    lasts: dict[tuple[str, ...], int] = {}  # steps, by task and algorithm
    for label, runs in labels.items():
        for means in runs.values():
            of_task.setdefault(label[0], []).extend(means.values())
            lasts[label[:2]] = max(lasts.get(label[:2], 0), *means)
    look, groups = looks(), list(lasts)
    names = [name for name in look if any(label[2] == name for label in labels)]
    titles = max(len(with_runs(label[2], [len(each)])) for label, each in labels.items())
    across = min(len(names), _MOST_ACROSS, max(1, int(PAGE / (_TITLE * titles))))
    down = -(-len(names) // across)  # rows of a group
    figure = Figure(figsize=(PAGE, 0.35 + 1.35 * len(groups) * down))
    panels = figure.subplots(len(groups) * down, across, squeeze=False, sharey="row", sharex="row")
    for (i, j), axes in np.ndenumerate(panels.reshape(len(groups), -1)):
        label = (*groups[i], *names[j : j + 1])  # without a name beyond the last
        if label not in labels:
            axes.set_axis_off()
            continue
        draw_policies(axes.axhline, played.get(label[0], {}))
        _draw_label(axes, labels[label], look[names[j]]["color"])
        group = f"{', '.join(groups[i])}\n" if j == 0 else ""
        axes.set_title(plain(group) + with_runs(names[j], [len(labels[label])]))
        _training_axes(axes, lasts[groups[i]], limits(of_task[label[0]]), across)
        is_lowest = i == len(groups) - 1 and j >= len(names) - across
        axes.set_xlabel("training step" if is_lowest else "")
        axes.set_ylabel("" if j % across else "return")
    below(figure, panels.ravel())
    return figure


def _draw_label(axes: Axes, runs: Runs, colour: str) -> None:
    for steps in runs.values():
        axes.plot(list(steps), list(steps.values()), color=colour, linewidth=0.6, alpha=0.55)
    shared = sorted(set.intersection(*(set(steps) for steps in runs.values())))
    if len(runs) > 1:
        middle = [np.median([steps[step] for steps in runs.values()]) for step in shared]
        axes.plot(shared, middle, color=colour, linewidth=1.6)


def across_tasks(analysis: Analysis, looks: Looks) -> Plot:
    """Performance profiles of scores across tasks, a panel for each algorithm."""
    return Plot(
        "across_tasks",
        "Across tasks",
        "The share of n runs on each task that score above a number, from 0 for the best policy "
        "that doesn't look to 1 for a reference (dashed), averaged over tasks, with its 95 % "
        "bootstrap interval (Agarwal et al. 2021).",
        ("algorithm", "representation", "tasks", "score", "share", "low", "high"),
        [
            (each.algorithm, each.representation, ", ".join(each.tasks), *map(cell, row))
            for each in analysis.aggregates
            for row in zip(each.scores, *each.profile, strict=True)
        ],
        lambda: _draw(analysis, looks),
    )


def _draw(analysis: Analysis, looks: Looks) -> Figure:
    aggregates = analysis.aggregates
    algorithms = list(dict.fromkeys(each.algorithm for each in aggregates))
    figure, panels = panel_grid(len(algorithms), 2.0)
    look = looks()
    for axes, algorithm in zip(panels, algorithms, strict=True):
        axes.axvline(1, **reference())
        own = [each for each in aggregates if each.algorithm == algorithm]
        for each in own:
            name, colour = each.representation, look[each.representation]["color"]
            draw_profile(axes, each.scores, each.profile, with_runs(name, [each.runs]), colour)
        axes.set_title(plain(f"{algorithm}, {len(own[0].tasks)} tasks"))
        axes.set_xlabel("score")
    below(figure, panels)
    return figure
