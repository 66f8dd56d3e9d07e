"""How small? Returns and their spread over latent size: python tools/small.py OUT.png FOLDER ...

A column for each task of the studies, a line for each method; representations are called
METHOD-SIZE, the others, such as symmetry, are levels.
"""

import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jbrep.evaluation.evaluation import Score
from jbrep.records.storage import write_whole
from jbrep.reporting.figures.panels import PAGE, Look, Plot, reference, styles
from jbrep.reporting.findings import Findings, Group
from jbrep.reporting.tables import read_tables

_NAME = re.compile(r"(?P<method>[a-z-]+)-(?P<size>\d+)$")
_SHOWN = {"final_return_mean": "mean final return", "final_return_sd": "SD over runs"}


class Point(NamedTuple):
    """A number of the agents on one representation."""

    task: str
    method: str
    size: int  # 0 of a level
    number: str  # a key of _SHOWN
    value: Score


def points(groups: Sequence[Group]) -> Iterator[Point]:
    """Those of all agents."""
    for group in groups:
        for agents in group.agents:
            found = _NAME.match(agents.representation)
            method = found["method"] if found else agents.representation
            for number in _SHOWN:
                size = int(found["size"]) if found else 0
                yield Point(group.task, method, size, number, agents.numbers[number])


def draw(groups: Sequence[Group]) -> Figure:
    """Means above, standard deviations below; dashed: the best blind baseline."""
    every = [*points(groups)]
    tasks = [*dict.fromkeys(each.task for each in every)]
    blind = {group.task: group.ends["blind"] for group in groups}
    look = styles([*dict.fromkeys(each.method for each in every)])
    figure = Figure(figsize=(PAGE, 3.6))
    panels = figure.subplots(2, len(tasks), squeeze=False, sharex=True, sharey="row")
    for row, number in enumerate(_SHOWN):
        for axes, task in zip(panels[row], tasks, strict=True):
            own = [each for each in every if (each.task, each.number) == (task, number)]
            for method in dict.fromkeys(each.method for each in own):
                of_method = [each for each in own if each.method == method]
                _draw_method(axes, of_method, look[method])
            if not row:
                axes.axhline(blind[task] or 0.0, **{**reference(), "label": "best blind baseline"})
                axes.set_title(task)
            axes.set_ylim(bottom=0)
        panels[row][0].set_ylabel(_SHOWN[number])
    for axes in panels[-1]:
        axes.set(xticks=sorted({each.size for each in every} - {0}), xlabel="latent size l")
    found = dict(zip(*panels[0][0].get_legend_handles_labels()[::-1], strict=True))
    figure.legend(found.values(), found.keys(), loc="outside lower center", ncols=len(found))
    return figure


def _draw_method(axes: Axes, own: Sequence[Point], look: Look) -> None:
    """A line over sizes with 95 % intervals, or a level."""
    sizes, name = [each.size for each in own], own[0].method
    values = np.array([each.value for each in own], float)
    if sizes == [0]:
        axes.axhline(values[0, 0], color=look["color"], lw=1, label=name)
    else:
        spread = np.abs(values[:, 1:].T - values[:, 0])
        axes.errorbar(sizes, values[:, 0], spread, **look, ms=3.5, lw=1, label=name)


def main(out: str, *folders: str) -> None:
    groups = [g for each in folders for g in Findings.of(read_tables(Path(each))).groups]
    for each in points(groups):
        if each.number == "final_return_mean":
            print(each.task, each.method, each.size or "", f"{each.value.value:.0f}")
    write_whole(Path(out), Plot("small", "", "", [], lambda _: draw(groups)).picture("png"))


if __name__ == "__main__":
    main(*sys.argv[1:])
