"""How well codes predict what comes next, given the actions: by feature and by horizon."""

from collections.abc import Iterator, Sequence
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from jbrep.encoders import FULL
from jbrep.report.figures.curves import below
from jbrep.report.figures.plot import Plot
from jbrep.report.figures.style import COLUMN, PAGE, Encoders, draw_line, ink, line_styles, plain
from jbrep.stats.bootstrap import Array
from jbrep.text import r2_text

MOST = 40  # features in a picture, and names on an axis
_SUMS = {"mean": "mean of features", "reward": "reward"}  # of a prediction, in words
_COLUMNS = ("encoder", "steps", "target", "r2", "low", "high")
_CHARACTER = 0.06  # of a title [inches]
_LOWEST, _HIGHEST = -0.1, 1.03  # R² on an axis


def heat_map(values: Array, rows: Sequence[str], columns: Sequence[str], title: str) -> Figure:
    """A cell for each R² (rows, columns), coloured from 0 to 1; NaN where it isn't defined."""
    width = max(COLUMN, 1.7 + 0.29 * len(columns))
    figure = Figure(figsize=(width, 1.0 + 0.16 * len(rows)))
    axes: Axes = figure.subplots()
    picture = axes.imshow(values, cmap="cividis", vmin=0, vmax=1, aspect="auto")
    for (row, column), value in np.ndenumerate(values):
        colour = ink() if np.isnan(value) else "black" if value > 0.6 else "white"
        shown = r2_text(None if np.isnan(value) else value)
        axes.text(column, row, shown, ha="center", va="center", color=colour, size=5)
    axes.set_yticks(range(len(rows)), [plain(name) for name in rows])
    axes.set_xticks(range(len(columns)), [plain(n) for n in columns], rotation=60, ha="right")
    bare(axes)
    lines = (fill(plain(line), int(width / _CHARACTER)) for line in title.splitlines())
    figure.suptitle("\n".join(lines), x=0.01, ha="left", size=7.5)
    figure.colorbar(picture, label="R²")
    return figure


def least(scores: Array) -> NDArray[np.int64]:
    """The features with the least scores (features,), in the order of the observation."""
    return np.sort(np.argsort(scores, kind="stable")[:MOST])


def bare(axes: Axes) -> None:
    """Remove what a matrix doesn't need."""
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)


def prediction_plots(task: str, encoders: Encoders) -> list[Plot]:
    """Controlled forward prediction of those encoders that it was measured of; none if of none."""
    measured = {label: e for label, e in encoders.items() if e.prediction}
    return [_by_feature(task, measured), _by_horizon(task, measured)] if measured else []


def _by_feature(task: str, encoders: Encoders) -> Plot:
    """R² of each feature's change and of the reward (rows) for each encoder (columns)."""
    steps = str(next(iter(encoders.values())).horizon)
    count = len(_features(encoders, steps))
    part = f" Of {count} features the {MOST} that lose most are shown; all are in the table."
    return Plot(
        "prediction_by_feature",
        f"{task}: what can be predicted {steps} steps ahead",
        f"R² of each feature's change over {steps} steps and of the mean reward over them, "
        "predicted from the code and the actions taken meanwhile, on held-out episodes. What a "
        f"code can't predict but {FULL} can, an agent that sees the code can't control."
        + (part if count > MOST else ""),
        _COLUMNS,
        list(_rows(encoders)),
        lambda: _draw_features(task, encoders, steps),
    )


def _features(encoders: Encoders, steps: str) -> list[str]:
    return list(next(iter(encoders.values())).prediction[steps].features)


def _rows(encoders: Encoders) -> Iterator[tuple[Any, ...]]:
    for label, e in encoders.items():
        for steps, scores in e.prediction.items():
            for name, values in scores.features.items():
                yield label, int(steps), name, *values
            for key, words in _SUMS.items():
                yield label, int(steps), words, *getattr(scores, key)


def _draw_features(task: str, encoders: Encoders, steps: str) -> Figure:
    scores = [e.prediction[steps] for e in encoders.values()]
    features = _features(encoders, steps)
    values = np.array([[s.features[f].value for f in features] for s in scores], float).T
    sums = np.array([[getattr(s, key).value for key in _SUMS] for s in scores], float).T
    shown = least(_against_full(values, list(encoders)))
    figure = heat_map(
        np.concatenate((values[shown], sums)),
        [*(features[i] for i in shown), *_SUMS.values()],
        list(encoders),
        f"{task}:\nprediction of changes and reward over {steps} steps",
    )
    figure.axes[0].axhline(len(shown) - 0.5, color="white", linewidth=1.5)
    return figure


def _against_full(values: Array, labels: list[str]) -> Array:
    """The mean R² of each feature over encoders, less that of the full observation, (features,)."""
    known = np.nan_to_num(values)
    return known.mean(axis=1) - (known[:, labels.index(FULL)] if FULL in labels else 0)


def _by_horizon(task: str, encoders: Encoders) -> Plot:
    """R² against the steps ahead, a line for each encoder."""
    return Plot(
        "prediction_by_horizon",
        f"{task}: prediction by steps ahead",
        "R² of the changes over so many steps, averaged over features, and of the mean reward over "
        "them, predicted from the code and the actions taken meanwhile, on held-out episodes; "
        f"bars: 95 % intervals over episodes. What is below {_LOWEST} isn't shown.",
        _COLUMNS,
        [row for row in _rows(encoders) if row[2] in _SUMS.values()],
        lambda: _draw_horizons(task, encoders),
    )


def _draw_horizons(task: str, encoders: Encoders) -> Figure:
    figure = Figure(figsize=(PAGE, 2.5 + 0.02 * len(encoders)))
    panels = figure.subplots(1, len(_SUMS), sharey=True)
    look = line_styles(encoders)
    for axes, (key, words) in zip(panels, _SUMS.items(), strict=True):
        for label, e in encoders.items():
            scores = [getattr(each, key) for each in e.prediction.values()]
            draw_line(axes, [*e.prediction], scores, label=plain(label), **look[label])
        axes.set(xlabel="steps ahead", title=words)
    low, high = panels[0].get_ylim()
    high = np.clip(high, -_LOWEST, _HIGHEST)  # one far below widens the margin above, too
    panels[0].set(ylabel="R² on held-out episodes", ylim=(max(low, _LOWEST), high))
    below(figure, panels)
    figure.suptitle(plain(f"{task}: prediction by steps ahead"), size=8)
    return figure
