"""A matrix of R² with a number in each cell."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from jbrep.report.figures.style import COLUMN, ink, plain
from jbrep.stats.bootstrap import Array
from jbrep.text import r2_text

MOST = 40  # features in a picture, and names on an axis


def heat_map(
    values: Array, rows: Sequence[str], columns: Sequence[str], title: str, label: str
) -> Figure:
    """A cell for each value, from 0 to 1.

    Args:
        values: R², (rows, columns); NaN where it isn't defined.
        rows: names.
        columns: names.
        title: above the matrix.
        label: of the colours.
    """
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
    axes.set_title(plain(title))
    figure.colorbar(picture, label=label)
    return figure


def least(scores: Array) -> NDArray[np.int64]:
    """The features with the least scores, in the order of the observation.

    Args:
        scores: of each feature, (features,).
    """
    return np.sort(np.argsort(scores, kind="stable")[:MOST])


def bare(axes: Axes) -> None:
    """Remove what a matrix doesn't need."""
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
