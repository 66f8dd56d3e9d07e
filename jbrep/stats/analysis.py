"""A whole study: results of every representation, comparisons with the baseline, verdicts."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from jbrep.encoders import FULL
from jbrep.errors import DamageError
from jbrep.files.typed import read_json, typed
from jbrep.stats.bootstrap import Array
from jbrep.stats.claims import CLAIMS
from jbrep.stats.comparison import Comparison, adjusted, compare, simultaneous_level
from jbrep.stats.curves import common_grid
from jbrep.stats.labels import PROFILE_RETURNS, RepresentationResult, describe, thresholds
from jbrep.stats.plain import READERS, to_plain
from jbrep.stats.runs import Group, RunCurve, groups

FORMAT = "jbrep statistics"
FORMAT_VERSION = 1


@dataclass(frozen=True, eq=False)
class GroupAnalysis:
    """The results for one task and algorithm.

    Args:
        task: the task's name.
        algorithm: the algorithm's name.
        grid: training steps at which runs are compared, (g,).
        cut: which evaluations the grid leaves out, in words; None if it leaves out none.
        thresholds: the return to reach for each of STEPS_TO.
        labels: results of each representation, the baseline first.
        comparisons: of the other representations with the baseline, in the same order.

    Raises:
        ValueError: parts that don't fit together.
    """

    task: str
    algorithm: str
    grid: Array
    cut: str | None
    thresholds: Mapping[str, float]
    labels: tuple[RepresentationResult, ...]
    comparisons: tuple[Comparison, ...]

    def __post_init__(self) -> None:
        if len(self.grid) < 2 or not np.all(np.diff(self.grid) > 0) or self.grid[0] < 0:
            raise ValueError("the grid must have at least two ascending steps")
        names = [label.representation for label in self.labels]
        if not names or len(set(names)) < len(names):
            raise ValueError("each representation must have one result")
        if [comparison.representation for comparison in self.comparisons] != names[1:]:
            raise ValueError("each representation but the first must have one comparison")
        for label in self.labels:
            if len(label.curve.mean) != len(self.grid):
                raise ValueError(f"the curve of {label.representation} doesn't fit the grid")

    @property
    def name(self) -> str:
        """Task and algorithm, for titles."""
        return f"{self.task}, {self.algorithm}"


@dataclass(frozen=True, eq=False)
class Analysis:
    """The results of a study.

    Args:
        baseline: the representation that the others are compared with.
        seed: of all resampling.
        simultaneous_level: of each verdict's interval, so that all hold together at 95 %.
        groups: by task and algorithm.
        profile_returns: where performance profiles are evaluated, (k,).

    Raises:
        ValueError: parts that don't fit together.
    """

    baseline: str
    seed: int
    simultaneous_level: float
    groups: tuple[GroupAnalysis, ...]
    profile_returns: Array = field(default_factory=PROFILE_RETURNS.copy)

    def __post_init__(self) -> None:
        results = [label for group in self.groups for label in group.labels]
        if not results or any(g.labels[0].representation != self.baseline for g in self.groups):
            raise ValueError(f"each group must begin with the baseline {self.baseline}")
        if any(np.shape(each.profile.value) != self.profile_returns.shape for each in results):
            raise ValueError("each profile must have as many values as profile_returns")

    def to_json(self) -> str:
        """All of it as JSON; an interval is [value, low, high], null stands for not finite."""
        record = {"format": FORMAT, "format_version": FORMAT_VERSION, **self.tolist()}
        return json.dumps(record, indent=2, allow_nan=False) + "\n"

    def tolist(self) -> dict[str, Any]:
        """The same as plain dicts, lists, numbers and text."""
        return dict(to_plain(self))

    @classmethod
    def from_json(cls, text: str, path: Path) -> "Analysis":
        """What to_json wrote, with NaN for all that wasn't finite.

        Args:
            text: the JSON.
            path: where it comes from, for messages.

        Raises:
            DamageError: it is damaged, or something else.
            InputError: it is of a newer jbrep.
        """
        record = read_json(text, path, FORMAT, FORMAT_VERSION)
        try:
            analysis: Analysis = typed(record, cls, READERS)
        except ValueError as error:
            raise DamageError(f"{path} is damaged: {error}") from None
        return analysis


def analyse(
    runs: Sequence[RunCurve], baseline: str = FULL, seed: int = 0, planned: int = 0
) -> Analysis:
    """All numbers and verdicts of a study; they don't depend on the order of its runs.

    Args:
        runs: every run of the study.
        baseline: the representation that the others are compared with.
        seed: of all resampling.
        planned: comparisons with the baseline in the whole study. If only a part of its runs is
            given, the verdicts are still as strict as those of the whole.

    Raises:
        InputError: runs that can't be compared, or would mislead; see jbrep.stats.runs.groups.
    """
    runs_by_group = groups(runs, baseline)
    family = len(CLAIMS) * max(planned, sum(len(group) - 1 for group in runs_by_group.values()))
    analysed = [_analyse_group(group, family, seed) for group in runs_by_group.values()]
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
    """The results of a group; the p-values of its verdicts aren't adjusted yet."""
    runs_of_baseline = next(iter(group.values()))
    grid, cut = common_grid(group)
    reach = thresholds(runs_of_baseline, grid)
    baseline, *others = (describe(runs, grid, reach, seed) for runs in group.values())
    return GroupAnalysis(
        task=runs_of_baseline[0].task,
        algorithm=runs_of_baseline[0].algorithm,
        grid=grid,
        cut=cut,
        thresholds=reach,
        labels=(baseline, *others),
        comparisons=tuple(compare(each, baseline, family, seed) for each in others),
    )
