"""What runs end at, how they spread, how fast they learn: a point for each run, an interval."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from jbrep.figures.curves import Group, below, looks
from jbrep.figures.plot import Plot
from jbrep.figures.style import COLUMN, PAGE, plain, reference, solved_line_style
from jbrep.jitterbug.tasks import SOLVED_RETURN

_ENDS = ("low", "high")
_LABEL = ("task", "algorithm", "representation")
_JITTER = 0.16  # between the outermost runs and the middle of their label


def final_return(groups: Sequence[Group]) -> Plot:
    """Final return and its spread by representation."""
    return Plot(
        "final_return",
        "Final return and its spread",
        "Left: mean over the last tenth of training, a point for each run, and the mean over runs "
        "with its 95 % interval. Right: the standard deviation over runs with its 95 % interval.",
        (
            *_LABEL,
            "seed",
            "final_return",
            "mean",
            "mean_low",
            "mean_high",
            "sd",
            "sd_low",
            "sd_high",
        ),
        list(_by_run(groups, "final_return", ("final_return_mean", "final_return_sd"))),
        lambda: _draw_final(groups),
    )


def learning_rate(groups: Sequence[Group]) -> Plot:
    """How fast each representation learns: the mean return over training."""
    return Plot(
        "learning_rate",
        "How fast agents learn",
        "Mean return over all of training (the area under the learning curve), a point for each "
        "run, and the mean over runs with its 95 % interval.",
        (*_LABEL, "seed", "mean_return", "mean", "mean_low", "mean_high"),
        list(_by_run(groups, "mean_return", ("mean_return_mean",))),
        lambda: _draw_learning(groups),
    )


def variance_ratio(groups: Sequence[Group], baseline: str, level: float) -> Plot:
    """Variances of final returns against the baseline's."""
    return Plot(
        "variance_ratio",
        "Variance against the full observation's",
        f"Ratio of the variance of final returns to that on {baseline}. Thick: 95 % interval; "
        f"thin: {100 * level:.2f} %, at which all verdicts hold together. Below 1 varies less.",
        (*_LABEL, "ratio", *_ENDS, "low_together", "high_together", "verdict"),
        [
            (*key, *values, *verdict["simultaneous"][1:], verdict["verdict"])
            for key, values, verdict in _ratios(groups)
        ],
        lambda: _draw_ratios(groups),
    )


def profiles(groups: Sequence[Group], returns: Sequence[float]) -> Plot:
    """The share of runs above each return."""
    return Plot(
        "profiles",
        "Performance profiles",
        "The share of runs whose final return is above that on the axis, with its 95 % bootstrap "
        "interval (Agarwal et al. 2021). Higher is better; steep is steady.",
        (*_LABEL, "final_return", "share", *_ENDS),
        [
            (group["task"], group["algorithm"], label["representation"], at, *share)
            for group in groups
            for label in group["labels"]
            for at, share in zip(returns, label["profile"], strict=True)
        ],
        lambda: _draw_profiles(groups, returns),
    )


def _by_run(groups: Sequence[Group], value: str, numbers: Sequence[str]) -> Iterator[Any]:
    for group in groups:
        for label in group["labels"]:
            key = (group["task"], group["algorithm"], label["representation"])
            shared = [_cell(v) for name in numbers for v in label["numbers"][name]]
            for seed, each in zip(label["seeds"], label["by_run"][value], strict=True):
                yield (*key, seed, _cell(each), *shared)


def _cell(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"


def _ratios(groups: Sequence[Group]) -> Iterator[tuple[tuple[str, str, str], list[Any], Any]]:
    for group in groups:
        for comparison in group["comparisons"]:
            key = (group["task"], group["algorithm"], comparison["representation"])
            verdict = next(v for v in comparison["verdicts"] if v["claim"] == "less variance")
            yield key, comparison["numbers"]["variance_ratio"], verdict


def _panels(groups: Sequence[Group], columns: int, height: float = 1.7) -> tuple[Figure, Any]:
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


def _draw_final(groups: Sequence[Group]) -> Figure:
    figure, panels = _panels(groups, 2)
    look = looks(groups)
    for (left, right), group in zip(panels, groups, strict=True):
        _draw_runs(left, group, look, "final_return")
        left.axhline(SOLVED_RETURN, **solved_line_style())
        left.set(ylabel="final return", ylim=(-40, 1040))
        _by_label(right, group)
        for i, label in enumerate(group["labels"]):
            style = look[label["representation"]]
            _interval(right, i, label["numbers"]["final_return_sd"], style)
        right.set_ylabel("SD over runs")
        _from_zero(right)
    return figure


def _draw_learning(groups: Sequence[Group]) -> Figure:
    figure, panels = _panels(groups, 1)
    look = looks(groups)
    for (axes,), group in zip(panels, groups, strict=True):
        _draw_runs(axes, group, look, "mean_return")
        axes.set_ylabel("mean return over training")
        _from_zero(axes)
    return figure


def _from_zero(axes: Axes) -> None:
    """From zero up, with room for whole markers."""
    _, top = axes.get_ylim()
    axes.set_ylim(-0.04 * top, 1.04 * top)


def _draw_runs(axes: Axes, group: Group, look: dict[str, Any], value: str) -> None:
    """A point for each run of each label, and the mean with its interval."""
    _by_label(axes, group)
    for i, label in enumerate(group["labels"]):
        style, runs = look[label["representation"]], np.array(label["by_run"][value], float)
        beside = i - 0.22 + np.linspace(-_JITTER, _JITTER, len(runs)) * (len(runs) > 1)
        axes.plot(beside, runs, ".", color=style["color"], ms=4, alpha=0.6, mew=0)
        _interval(axes, i + 0.16, label["numbers"][f"{value}_mean"], style)


def _by_label(axes: Axes, group: Group) -> None:
    names = [plain(label["representation"]) for label in group["labels"]]
    axes.set_title(plain(f"{group['task']}, {group['algorithm']}"))
    tilt: dict[str, Any] = {"rotation": 30, "ha": "right"} if len(names) > 4 else {}
    axes.set_xticks(range(len(names)), names, **tilt)
    axes.set_xlim(-0.6, len(names) - 0.4)
    axes.grid(visible=False, axis="x")


def _interval(axes: Axes, at: float, values: Sequence[float | None], style: dict[str, Any]) -> None:
    """A value with its interval, upright; no bar where there is none."""
    value, low, high = np.array(values, float)
    spread = None if np.isnan(low) else np.clip([[value - low], [high - value]], 0, None)
    axes.errorbar([at], [value], spread, ms=4, lw=1.4, capsize=2.5, **style)


def _draw_ratios(groups: Sequence[Group]) -> Figure:
    """A panel for each group, a row for each representation, all to one scale."""
    compared = [group for group in groups if group["comparisons"]]
    most = max(len(group["comparisons"]) for group in compared)
    figure, panels = _panels(compared, 1, 0.45 + 0.19 * most)
    look = looks(groups)
    limit = max(_reach(values, verdict) for _, values, verdict in _ratios(groups))
    for (axes,), group in zip(panels, compared, strict=True):
        rows = list(_ratios([group]))
        for i, (key, values, verdict) in enumerate(rows):
            _draw_ratio(axes, i, values, verdict, look[key[2]])
        axes.axvline(1, **reference())
        axes.set_yticks(range(len(rows)), [plain(key[2]) for key, _, _ in rows])
        axes.set(ylim=(len(rows) - 0.4, -0.6), xscale="log", xlabel="variance ratio")
        axes.set_xlim(10 ** -(limit + 0.1), 10 ** (limit + 0.1))
        _few_decades(axes, limit)
        axes.grid(visible=False, axis="y")
        axes.set_title(plain(f"{group['task']}, {group['algorithm']}"))
    return figure


def _reach(values: Sequence[float | None], verdict: Group) -> float:
    """How many powers of ten the intervals go from 1, where they are above 0."""
    ends = np.array((*values, *verdict["simultaneous"], 1), float)
    return float(np.abs(np.log10(ends[ends > 0])).max())


def _draw_ratio(
    axes: Axes, row: int, values: Sequence[float | None], verdict: Group, style: dict[str, Any]
) -> None:
    for (_, low, high), width in ((verdict["simultaneous"], 0.8), (values, 2)):
        axes.plot(np.array([low, high], float), [row, row], color=style["color"], linewidth=width)
    axes.plot(np.array(values[:1], float), [row], style["marker"], color=style["color"], ms=4)


def _few_decades(axes: Axes, limit: float) -> None:
    """Ticks as 0.1 and 10, or as 1/3 and 3 where the axis is short."""
    ticks = 3.0 ** np.arange(-1, 2) if limit < 1 else 10.0 ** np.arange(-int(limit), limit + 0.01)
    axes.xaxis.set_major_locator(FixedLocator(ticks[:: -(-len(ticks) // 7)].tolist()))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:.2g}" if x < 1 else f"{x:,.0f}"))


def _draw_profiles(groups: Sequence[Group], returns: Sequence[float]) -> Figure:
    figure, panels = _panels(groups, 1, 2.0)
    look = looks(groups)
    for (axes,), group in zip(panels, groups, strict=True):
        for label in group["labels"]:
            colour = look[label["representation"]]["color"]
            share, low, high = np.array(label["profile"], float).T
            axes.fill_between(returns, low, high, step="post", color=colour, alpha=0.12, lw=0)
            axes.step(
                returns, share, where="post", color=colour, label=plain(label["representation"])
            )
        axes.axvline(SOLVED_RETURN, **solved_line_style())
        axes.set_title(plain(f"{group['task']}, {group['algorithm']}"))
        axes.set(
            xlim=(0, 1000), ylim=(-0.02, 1.02), xlabel="final return", ylabel="share of runs above"
        )
    below(figure, panels.ravel())
    return figure
