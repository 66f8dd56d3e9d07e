"""Figures of encoders, from their evaluation."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jbrep.encoders import FULL
from jbrep.evaluation.evaluation import Diagnostics, Evaluation
from jbrep.reporting.figures.panels import COLUMN, Plot, Row, by, line, panels, plain, styles
from jbrep.text import r2_text

MOST = 40  # features in a picture
_SUMS = {"mean": "mean of features", "reward": "reward"}  # of a prediction, in words
_LOWEST, _HIGHEST = -0.1, 1.03  # R² on an axis
_CHARACTER = 0.06  # of a title [inches]


def encoder_plots(evaluation: Evaluation) -> list[Plot]:
    """What codes predict, by feature and by steps ahead, and what encoders that decode lose."""
    task, encoders = evaluation.data.task, evaluation.encoders
    horizon = encoders[FULL].horizon if FULL in encoders else None
    predicted, lost = [*_predicted(encoders)], [*_lost(encoders)]
    ahead = [row for row in predicted if row["steps"] == horizon]
    sums = [row for row in predicted if row["target"] in _SUMS.values()]
    most = f" Of more than {MOST} features those with the least are shown; all are in the table."
    plots = (
        Plot(
            "prediction_by_feature",
            f"{task}: what can be predicted {horizon} steps ahead",
            f"R² of each feature's change over {horizon} steps, and of the mean reward over them, "
            "predicted from the code and the actions taken meanwhile, on held-out episodes. What a "
            f"code can't predict but {FULL} can, an agent that sees the code can't control.{most}",
            ahead,
            partial(_heat_map, title=f"{task}: prediction over {horizon} steps"),
        ),
        Plot(
            "prediction_by_horizon",
            f"{task}: prediction by steps ahead",
            "R² of the changes over so many steps, averaged over features, and of the mean reward "
            "over them, predicted from the code and the actions taken meanwhile, on held-out "
            f"episodes; bars: 95 % intervals over episodes. What is below {_LOWEST} isn't shown.",
            sums,
            partial(
                panels,
                looks=styles(encoders, FULL),
                title=lambda key: f"{task}: {key[0]}",
                mark=line("steps", "r2", "low", "high", bars=True),
                facet=("target",),
                series="encoder",
                axis_labels=("steps ahead", "R² on held-out episodes"),
                limits={(each,): (_LOWEST, _HIGHEST) for each in _SUMS.values()},
            ),
        ),
        Plot(
            "error_by_feature",
            f"{task}: reconstruction of each feature",
            f"R² of each feature's reconstruction on held-out episodes.{most}",
            lost,
            partial(_heat_map, title=f"{task}: reconstruction of each feature"),
        ),
    )
    return [plot for plot in plots if plot.rows]


def _predicted(encoders: Mapping[str, Diagnostics]) -> Iterator[Row]:
    for label, known in encoders.items():
        for steps, scores in known.prediction.items():
            sums = {words: getattr(scores, name) for name, words in _SUMS.items()}
            for target, (value, low, high) in {**scores.features, **sums}.items():
                key = {"encoder": label, "steps": int(steps), "target": target}
                yield {**key, "r2": value, "low": low, "high": high}


def _lost(encoders: Mapping[str, Diagnostics]) -> Iterator[Row]:
    for label, known in encoders.items():
        if label == FULL or not known.reconstruction:
            continue
        for feature in known.reconstruction.features:
            value, low, high = feature.r2
            yield {"encoder": label, "target": feature.name, "r2": value, "low": low, "high": high}


def _heat_map(rows: Sequence[Row], title: str) -> Figure:
    """A cell for the R² of each target and encoder, coloured from 0 to 1."""
    columns, targets = by(rows, "encoder"), by(rows, "target")
    scores = {key: own[0]["r2"] for key, own in by(rows, "target", "encoder").items()}
    values = np.array([[scores[*row, *each] for each in columns] for row in targets], float)
    sums = [name in _SUMS.values() for (name,) in targets]
    order = np.lexsort((np.nan_to_num(values, nan=1).mean(axis=1), ~np.array(sums)))
    shown = np.sort(order[: MOST + sum(sums)])  # in the order of the observation
    width = max(COLUMN, 1.7 + 0.29 * len(columns))
    figure = Figure(figsize=(width, 1.0 + 0.16 * len(shown)))
    axes: Axes = figure.subplots()
    picture = axes.imshow(values[shown], cmap="cividis", vmin=0, vmax=1, aspect="auto")
    for (row, each), value in np.ndenumerate(values[shown]):
        colour = "black" if value > 0.6 or np.isnan(value) else "white"
        text = r2_text(None if np.isnan(value) else value)
        axes.text(each, row, text, ha="center", va="center", color=colour, size=5)
    names = [plain(name) for (name,) in targets]
    axes.set_yticks(range(len(shown)), [names[i] for i in shown])
    axes.set_xticks(range(len(columns)), [plain(n) for (n,) in columns], rotation=60, ha="right")
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    figure.suptitle(fill(plain(title), int(width / _CHARACTER)), x=0.01, ha="left", size=7.5)
    figure.colorbar(picture, label="R²")
    return figure
