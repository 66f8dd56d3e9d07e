"""Learning curves: returns over training."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, MaxNLocator

from jbrep.figures.plot import Plot
from jbrep.figures.style import COLUMN, PAGE, plain, reference, solved_line_style, styles
from jbrep.jitterbug.tasks import SOLVED_RETURN
from jbrep.stats.runs import in_order

Group = dict[str, Any]  # of statistics.json: what was found for a task and an algorithm
Evaluated = tuple[str, str, str, int, int]  # task, algorithm, representation, seed, step
Heuristics = Mapping[str, Sequence[float]]  # returns of the hand-written policy, by task

_BAND = ("p10", "p50", "p90")
_COLUMNS = ("task", "algorithm", "representation", "step", *_BAND, "iqm", "iqm_low", "iqm_high")


class Return(NamedTuple):
    """A row of returns.csv: an episode of an evaluation."""

    task: str
    algorithm: str
    representation: str
    seed: int
    step: int
    episode: int
    episode_return: float


def baseline_curves(groups: Sequence[Group], heuristics: Heuristics) -> Plot:
    """The baseline alone, tasks by algorithms, as the paper's Fig. 7."""
    first = [{**group, "labels": group["labels"][:1]} for group in groups]
    name = groups[0]["labels"][0]["representation"]
    return Plot(
        "training_curves",
        f"Training on the {name} observation",
        _CAPTION,
        _COLUMNS,
        list(_rows(first)),
        lambda: _grid_of_curves(first, heuristics),
    )


def curves(groups: Sequence[Group], heuristics: Heuristics) -> Plot:
    """Every representation on one axis, tasks by algorithms."""
    return Plot(
        "representations",
        "Training on the full and on reduced observations",
        _CAPTION,
        _COLUMNS,
        list(_rows(groups)),
        lambda: _grid_of_curves(groups, heuristics),
    )


_CAPTION = (
    "Return of the deterministic policy over training: median and 10 to 90 % over runs. Dashed: "
    "the hand-written policy's median on the same starts; dotted: "
    f"{SOLVED_RETURN:.0f}, where the paper calls a task solved."
)


def every_run(returns: Sequence[Return], baseline: str) -> Plot:
    """Each run by itself: a row for each task and algorithm, a panel for each representation."""
    episodes = defaultdict(list)
    for row in returns:
        key = (row.task, row.algorithm, row.representation, row.seed, row.step)
        episodes[key].append(row.episode_return)
    means = {key: float(np.mean(each)) for key, each in episodes.items()}
    return Plot(
        "every_run",
        "Every run",
        "Mean return of each evaluation, a line for each run; thick: the median of all.",
        ("task", "algorithm", "representation", "seed", "step", "mean_return"),
        [(*key, f"{mean:.3f}") for key, mean in means.items()],
        lambda: _draw_runs(means, baseline),
    )


def _rows(groups: Sequence[Group]) -> Iterator[tuple[Any, ...]]:
    for group in groups:
        for label in group["labels"]:
            curve = label["curve"]
            columns = [group["grid"], *(curve[name] for name in _BAND), *np.array(curve["iqm"]).T]
            for step, *values in zip(*columns, strict=True):
                key = (group["task"], group["algorithm"], label["representation"], int(step))
                yield *key, *("" if v is None else f"{v:.3f}" for v in values)


def _grid_of_curves(groups: Sequence[Group], heuristics: Heuristics) -> Figure:
    look = looks(groups)

    def draw(axes: Axes, group: Group) -> None:
        if returns := heuristics.get(group["task"]):
            axes.axhline(float(np.median(returns)), label="hand-written", **reference())
        axes.axhline(SOLVED_RETURN, **solved_line_style())
        for label in group["labels"]:
            name, curve = label["representation"], label["curve"]
            low, median, high = (np.array(curve[key], float) for key in _BAND)
            colour, marker = look[name]["color"], look[name]["marker"]
            axes.fill_between(group["grid"], low, high, color=colour, alpha=0.15, linewidth=0)
            axes.plot(
                *(group["grid"], median),
                **{"color": colour, "marker": marker, "ms": 2.5, "label": plain(name)},
                markevery=max(1, len(median) // 8),
            )

    return _grid(groups, draw)


def looks(groups: Sequence[Group]) -> dict[str, dict[str, Any]]:
    """Colour and marker of each representation, the baseline in the colour of text."""
    names = [label["representation"] for group in groups for label in group["labels"]]
    return styles(names, first=names[0])


def _grid(groups: Sequence[Group], draw: Callable[[Axes, Group], None]) -> Figure:
    """A panel for each task (rows) and algorithm (columns), over steps of training."""
    tasks = list(dict.fromkeys(group["task"] for group in groups))
    algorithms = list(dict.fromkeys(group["algorithm"] for group in groups))
    by_place = {(group["task"], group["algorithm"]): group for group in groups}
    width = COLUMN if len(algorithms) == 1 else PAGE
    figure = Figure(figsize=(width, 0.5 + (2.0 if len(algorithms) < 3 else 1.6) * len(tasks)))
    panels = figure.subplots(len(tasks), len(algorithms), squeeze=False, sharey=True)
    for (i, j), axes in np.ndenumerate(panels):
        group = by_place.get((tasks[i], algorithms[j]))
        if group is None:
            axes.set_axis_off()
            continue
        draw(axes, group)
        axes.set_title(plain(f"{tasks[i]}, {algorithms[j]}"))
        _training_axes(axes, group["grid"][-1])
        axes.set_xlabel("training step" if i == len(tasks) - 1 else "")
        axes.set_ylabel("" if j else "return")
    below(figure, panels.ravel())
    return figure


def _training_axes(axes: Axes, last: float, ticks: int = 5) -> None:
    """Steps from 0 on, returns from 0 to 1,000."""
    axes.set(xlim=(0, last), ylim=(-15, 1015), yticks=range(0, 1001, 250))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.xaxis.set_major_locator(MaxNLocator(ticks))


def below(figure: Figure, panels: Iterable[Axes]) -> None:
    """One legend under all panels, lines to compare with last; as many columns as usual fit."""
    entries = {
        name: handle
        for axes in panels
        for handle, name in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    names = sorted(entries, key=lambda name: _is_broken(entries[name]))
    columns = 4 if figure.get_figwidth() < PAGE else 6
    figure.legend([entries[n] for n in names], names, loc="outside lower center", ncols=columns)


def _is_broken(handle: Any) -> bool:
    return isinstance(handle, Line2D) and handle.get_linestyle() not in ("-", "None")


def _draw_runs(means: Mapping[Evaluated, float], baseline: str) -> Figure:
    names = in_order((key[2] for key in means), baseline)
    groups = list(dict.fromkeys(key[:2] for key in means))
    look = styles(names, first=baseline)
    figure = Figure(figsize=(PAGE, 0.35 + 1.35 * len(groups)))
    panels = figure.subplots(len(groups), len(names), squeeze=False, sharey=True, sharex="row")
    for (i, j), axes in np.ndenumerate(panels):
        runs: dict[int, dict[int, float]] = defaultdict(dict)
        for (*label, seed, step), mean in means.items():
            if label == [*groups[i], names[j]]:
                runs[seed][step] = mean
        if not runs:
            axes.set_axis_off()
            continue
        _draw_label(axes, runs, look[names[j]]["color"])
        title = f"{', '.join(groups[i])}\n{names[j]}" if j == 0 else names[j]
        axes.set_title(plain(title))
        last = max(key[4] for key in means if key[:2] == groups[i])
        _training_axes(axes, last, ticks=5 if len(names) < 5 else 3)
        axes.set_xlabel("training step" if i == len(groups) - 1 else "")
        axes.set_ylabel("" if j else "return")
    return figure


def _draw_label(axes: Axes, runs: Mapping[int, Mapping[int, float]], colour: str) -> None:
    for steps in runs.values():
        axes.plot(list(steps), list(steps.values()), color=colour, linewidth=0.6, alpha=0.55)
    shared = sorted(set.intersection(*(set(steps) for steps in runs.values())))
    if len(runs) > 1:
        middle = [np.median([steps[step] for steps in runs.values()]) for step in shared]
        axes.plot(shared, middle, color=colour, linewidth=1.6)
