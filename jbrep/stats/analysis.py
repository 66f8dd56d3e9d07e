"""A whole study: every label, every comparison with the baseline, every verdict."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np

from jbrep.encoders import FULL
from jbrep.stats.bootstrap import Array, Interval, without_nan
from jbrep.stats.claims import CLAIMS
from jbrep.stats.comparison import Comparison, adjusted, compare, simultaneous_level
from jbrep.stats.curves import common_grid
from jbrep.stats.labels import PROFILE_RETURNS, RepresentationResult, describe, thresholds
from jbrep.stats.runs import Group, RunCurve, groups

FORMAT = "jbrep statistics"
FORMAT_VERSION = 1


@dataclass(frozen=True, eq=False)
class GroupAnalysis:
    """What was found for one task and algorithm.

    Args:
        task: the task's name.
        algorithm: the algorithm's name.
        grid: training steps at which runs are compared, (g,).
        cut: what of the runs the grid leaves out; None for nothing.
        thresholds: the return to reach under each name of a number of steps.
        labels: the baseline's first, then by name.
        comparisons: of each other label with the baseline.
    """

    task: str
    algorithm: str
    grid: Array
    cut: str | None
    thresholds: Mapping[str, float]
    labels: tuple[RepresentationResult, ...]
    comparisons: tuple[Comparison, ...]


@dataclass(frozen=True, eq=False)
class Analysis:
    """What was found in a study.

    Args:
        baseline: the representation that the others were compared with.
        seed: of all that was drawn.
        simultaneous_level: of each verdict's interval, so that all hold together at 95 %.
        groups: by task and algorithm.
    """

    baseline: str
    seed: int
    simultaneous_level: float
    groups: tuple[GroupAnalysis, ...]

    def to_json(self) -> str:
        """All of it as JSON; an interval is [value, low, high], null stands for not finite."""
        record = {"format": FORMAT, "format_version": FORMAT_VERSION, **self.tolist()}
        return json.dumps(record, indent=2, allow_nan=False) + "\n"

    def tolist(self) -> dict[str, Any]:
        """The same as plain dicts, lists, numbers and text."""
        return {**_plain(self), "profile_returns": PROFILE_RETURNS.tolist()}


def analyse(
    runs: Sequence[RunCurve], baseline: str = FULL, seed: int = 0, planned: int = 0
) -> Analysis:
    """All numbers and verdicts of a study; they don't depend on the order of its runs.

    Args:
        runs: every run of the study.
        baseline: the representation that the others are compared with.
        seed: of all that is drawn.
        planned: comparisons with the baseline that the whole study has, for when only a part of
            its runs is there: the verdicts of that part are as strict as those of the whole.

    Raises:
        InputError: runs that can't be compared, or would mislead; see jbrep.stats.runs.groups.
    """
    found = groups(runs, baseline)
    family = len(CLAIMS) * max(planned, sum(len(group) - 1 for group in found.values()))
    analysed = [_analyse_group(group, family, seed) for group in found.values()]
    comparisons = iter(adjusted([c for group in analysed for c in group.comparisons]))
    return Analysis(
        baseline=baseline,
        seed=seed,
        simultaneous_level=simultaneous_level(family),
        groups=tuple(
            replace(group, comparisons=tuple(next(comparisons) for _ in group.comparisons))
            for group in analysed
        ),
    )


def _analyse_group(group: Group, family: int, seed: int) -> GroupAnalysis:
    baseline = next(iter(group.values()))
    grid, cut = common_grid(group)
    reach = thresholds(baseline, grid)
    described, *labels = (describe(of_label, grid, reach, seed) for of_label in group.values())
    return GroupAnalysis(
        task=baseline[0].task,
        algorithm=baseline[0].algorithm,
        grid=grid,
        cut=cut,
        thresholds=reach,
        labels=(described, *labels),
        comparisons=tuple(compare(label, described, family, seed) for label in labels),
    )


def _plain(value: Any) -> Any:
    if isinstance(value, Interval):
        return value.tolist()
    if is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, tuple):
        return [_plain(part) for part in value]
    if isinstance(value, np.ndarray | float):
        return without_nan(np.asarray(value).tolist())
    return value
