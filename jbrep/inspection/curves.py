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
from jbrep.inspection.recording import Recording, palette
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
        curves = {f"seed-{run.seed}": (run.curve(), _RUN_WIDTH) for run in group}
        curves["median"] = median_curve(group), _MEDIAN_WIDTH
        for curve, ((steps, returns), width) in curves.items():
            times = [rr.TimeColumn(TRAINING_STEP, sequence=steps)]
            look = [name], [colours[name]], width
            recording.send_series(f"{label}/{curve}", times, returns[:, None], *look)
    groups = sorted({f"{run.task}/{run.algorithm}" for run in runs})
    recording.write(path, curves_layout(groups, max(int(run.curve()[0][-1]) for run in runs)))


def _about(source: str, labels: dict[str, list[RunCurve]]) -> str:
    """The runs and their final returns, as Markdown."""
    lines = [f"# {source}", "", "| runs | seeds | median return at the end |", "|---|---|---|"]
    for label, runs in labels.items():
        last = np.median([run.curve()[1][-1] for run in runs])
        lines.append(f"| {label} | {len(runs)} | {last:.0f} |")
    return "\n".join(lines)
