"""A whole study: results of every representation, comparisons with the baseline, verdicts."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from jbrep.encoders import FULL
from jbrep.errors import DamageError
from jbrep.files.typed import read_json, typed
from jbrep.stats.bootstrap import Array
from jbrep.stats.comparison import Comparison, adjusted, compare, simultaneous_level
from jbrep.stats.curves import common_grid, final_returns, on_grid
from jbrep.stats.first_claims import CLAIMS
from jbrep.stats.labels import RepresentationResult, check_names, describe
from jbrep.stats.plain import READERS, to_plain
from jbrep.stats.runs import LARGEST_RETURN, Group, RunCurve, groups
from jbrep.stats.scale import SOLVED, STEPS_TO, scale_of
from jbrep.stats.version1 import in_version_2

FORMAT = "jbrep statistics"
FORMAT_VERSION = 2


@dataclass(frozen=True, eq=False)
class GroupAnalysis:
    """The results for one task and algorithm.

    Args:
        task: the task's name.
        algorithm: the algorithm's name.
        grid: training steps at which runs are compared, (g,).
        cut: which evaluations the grid leaves out, in words; None if it leaves out none.
        return_floor: the least possible return of the task; NaN if unknown.
        failure_return: what a failed run counts as from the step of failure on.
        reference: the return that gains are counted from, as in `Scale`.
        thresholds: the return to reach for each of STEPS_TO; NaN where there is none.
        profile_returns: where performance profiles are evaluated, ascending, (k,).
        labels: results of each representation, the baseline first.
        comparisons: of the other representations with the baseline, in the same order.

    Raises:
        ValueError: parts that don't fit together.
    """

    task: str
    algorithm: str
    grid: Array
    cut: str | None
    return_floor: float
    failure_return: float
    reference: float
    thresholds: Mapping[str, float]
    profile_returns: Array
    labels: tuple[RepresentationResult, ...]
    comparisons: tuple[Comparison, ...]

    def __post_init__(self) -> None:
        if not _ascend(self.grid) or self.grid[0] < 0:
            raise ValueError("the grid must have at least two ascending steps")
        names = [label.representation for label in self.labels]
        if not names or len(set(names)) < len(names):
            raise ValueError("each representation must have one result")
        if [comparison.representation for comparison in self.comparisons] != names[1:]:
            raise ValueError("each representation but the first must have one comparison")
        check_names("thresholds", self.thresholds, STEPS_TO)
        profile = self.profile_returns
        if not _ascend(profile) or np.abs(profile).max() > 2 * LARGEST_RETURN:
            raise ValueError("profile_returns must be at least two ascending returns")
        for label in self.labels:
            if len(label.curve.mean) != len(self.grid):
                raise ValueError(f"the curve of {label.representation} doesn't fit the grid")
            if np.shape(label.profile.value) != self.profile_returns.shape:
                raise ValueError("each profile must have as many values as profile_returns")

    @property
    def solved(self) -> float:
        """The return from which on the task counts as solved; NaN if unknown."""
        return self.thresholds[SOLVED]

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

    Raises:
        ValueError: parts that don't fit together.
    """

    baseline: str
    seed: int
    simultaneous_level: float
    groups: tuple[GroupAnalysis, ...]

    def __post_init__(self) -> None:
        first = {group.labels[0].representation for group in self.groups}
        if first != {self.baseline}:
            raise ValueError(f"each group must begin with the baseline {self.baseline}")

    def to_json(self) -> str:
        """All of it as JSON; an interval is [value, low, high], null stands for not finite."""
        record = {"format": FORMAT, "format_version": FORMAT_VERSION, **self.tolist()}
        return json.dumps(record, indent=2, allow_nan=False) + "\n"

    def tolist(self) -> dict[str, Any]:
        """The same as plain dicts, lists, numbers and text."""
        return dict(to_plain(self))

    @classmethod
    def from_json(cls, text: str, path: Path) -> "Analysis":
        """What to_json wrote, also in the first release, with NaN for all that wasn't finite.

        Args:
            text: the JSON.
            path: where it comes from, for messages.

        Raises:
            DamageError: it is damaged, or something else.
            InputError: it is of a newer jbrep.
        """
        record = read_json(text, path, FORMAT, FORMAT_VERSION)
        if record["format_version"] == 1:
            record = in_version_2(record)
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
    first = next(iter(group.values()))[0]
    grid, cut = common_grid(group)
    curves = {n: np.stack([on_grid(run, grid) for run in runs]) for n, runs in group.items()}
    finals = final_returns(group, curves, grid)
    scale = scale_of(list(finals.values()), next(iter(curves.values())), grid, first)
    baseline, *others = (
        describe(runs, curves[name], finals[name], scale, seed) for name, runs in group.items()
    )
    compared = (compare(each, baseline, scale.reference, family, seed) for each in others)
    return GroupAnalysis(
        task=first.task,
        algorithm=first.algorithm,
        cut=cut,
        return_floor=_or_nan(first.return_floor),
        failure_return=_or_nan(first.failure_return),
        labels=(baseline, *others),
        comparisons=tuple(compared),
        **scale._asdict(),
    )


def _ascend(values: Array) -> bool:
    """Whether values (n,) ascend and are at least two."""
    return len(values) > 1 and bool(np.all(values[:-1] < values[1:]))


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else float(value)
