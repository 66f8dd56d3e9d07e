"""A recording of the training curves of a study."""

from collections import defaultdict
from collections.abc import Sequence
from functools import reduce
from pathlib import Path

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from jbrep.encoders import FULL
from jbrep.inspection.blueprint import TRAINING_STEP, curves_layout
from jbrep.inspection.recording import Colour, Recording, palette
from jbrep.stats import RunCurve
from jbrep.stats.bootstrap import Array
from jbrep.stats.runs import in_order, with_failure_returns

_RUN_WIDTH = 1.0  # [points]
_MEDIAN_WIDTH = 4.0  # [points]


def median_curve(runs: Sequence[RunCurve]) -> tuple[NDArray[np.int64], Array]:
    """Median over runs at the steps at which all were evaluated.

    A failed run counts as its failure_return from the step at which it failed.
    """
    whole = [run.steps for run in runs if run.failed_at is None] or [runs[0].curve()[0]]
    steps: NDArray[np.int64] = reduce(np.intersect1d, whole)
    each = [np.interp(steps, *run.curve()) for run in runs]
    return steps, np.median(each, axis=0)


def record_curves(runs: Sequence[RunCurve], source: str, path: Path) -> None:
    """Write the training curves of runs, with a colour for each representation.

    Args:
        runs: of one study, or of several.
        source: their folder, as the recording's title.
        path: the .rrd file.

    Raises:
        InputError: the file can't be written.
    """
    labels = defaultdict(list)
    for run in sorted(with_failure_returns(runs), key=lambda run: (run.label, run.seed)):
        labels[run.label].append(run)
    representations = in_order((run.representation for run in runs), FULL)
    colours = dict(zip(representations, palette(len(representations)), strict=True))
    numbers = [number for run in runs for number in (run.steps, run.returns)]
    recording = Recording(source, _about(source, labels), *numbers)
    for label, group in labels.items():
        name = group[0].representation
        for run in group:
            path_of_run = f"{label}/seed-{run.seed}"
            _send(recording, path_of_run, run.curve(), name, colours[name], _RUN_WIDTH)
        _send(recording, f"{label}/median", median_curve(group), name, colours[name], _MEDIAN_WIDTH)
    groups = sorted({f"{run.task}/{run.algorithm}" for run in runs})
    recording.write(path, curves_layout(groups, max(int(run.curve()[0][-1]) for run in runs)))


def _send(
    recording: Recording,
    path: str,
    points: tuple[NDArray[np.int64], Array],
    name: str,
    colour: Colour,
    width: float,
) -> None:
    steps, returns = points
    times = [rr.TimeColumn(TRAINING_STEP, sequence=steps)]
    recording.send_series(path, times, returns[:, None], [name], [colour], width)


def _about(source: str, labels: dict[str, list[RunCurve]]) -> str:
    """The runs and their final returns, as Markdown."""
    lines = [f"# {source}", "", "| runs | seeds | median return at the end |", "|---|---|---|"]
    for label, runs in labels.items():
        last = np.median([run.curve()[1][-1] for run in runs])
        lines.append(f"| {label} | {len(runs)} | {last:.0f} |")
    return "\n".join(lines)
