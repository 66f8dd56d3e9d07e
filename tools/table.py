"""The paper's table, of a study: python tools/table.py OUT.png FOLDER.

Means and standard deviations of final returns, a row for each task and algorithm, a column for each
representation: printed as Markdown, and drawn with the means as colours.
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from jbrep.records.storage import write_whole
from jbrep.reporting.figures.panels import PAGE, Plot
from jbrep.reporting.findings import Findings, Group
from jbrep.reporting.tables import read_tables

_MOST = 1000  # return of an episode
_DARK = 600  # a mean from which its cell is dark
_ROW = 0.24  # inches
_SHOWN = "final_return_mean", "final_return_sd"
_NONE = [np.nan, np.nan]


def numbers(group: Group) -> dict[str, list[float]]:
    """Mean and standard deviation over runs, by representation."""
    values = {each.representation: each.numbers for each in group.agents}
    return {
        name: np.array([of[each].value for each in _SHOWN], float).tolist()
        for name, of in values.items()
    }


def draw(groups: list[Group]) -> Figure:
    """A cell for each mean, coloured, with the standard deviation beside it."""
    rows = [numbers(each) for each in groups]
    columns = [*rows[0]]
    figure = Figure(figsize=(PAGE, 0.6 + _ROW * len(rows)))
    axes = figure.subplots()
    means = [[row.get(name, _NONE)[0] for name in columns] for row in rows]
    axes.imshow(means, cmap="Blues", vmin=0, vmax=_MOST, aspect="auto")
    for y, row in enumerate(rows):
        for x, name in enumerate(columns):
            mean, sd = row.get(name, _NONE)
            color = "white" if mean > _DARK else "black"
            axes.text(x, y, f"{mean:.0f} ± {sd:.0f}", ha="center", va="center", color=color)
    axes.set_xticks(range(len(columns)), columns)
    axes.set_yticks(range(len(rows)), [f"{each.task}, {each.algorithm}" for each in groups])
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.tick_params(top=True, labeltop=True, bottom=False, labelbottom=False, length=0)
    for y in range(1, len(groups)):
        if groups[y].task != groups[y - 1].task:
            axes.axhline(y - 0.5, color="white", lw=3)
    return figure


def main(out: str, folder: str) -> None:
    groups = [*Findings.of(read_tables(Path(folder))).groups]
    columns = [*numbers(groups[0])]
    print("| task | algorithm | " + " | ".join(columns) + " |")
    print("|---|---|" + "---:|" * len(columns))
    for group in groups:
        cells = [f"{mean:.0f} ± {sd:.0f}" for mean, sd in numbers(group).values()]
        print(f"| {group.task} | {group.algorithm} | {' | '.join(cells)} |")
    write_whole(Path(out), Plot("table", "", "", [], lambda _: draw(groups)).picture("png"))


if __name__ == "__main__":
    main(*sys.argv[1:])
