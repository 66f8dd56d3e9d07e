"""A whole study: results of every representation, comparisons with the baseline, verdicts."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jbrep.encoders import FULL
from jbrep.errors import DamageError
from jbrep.records.typed import read_json, typed
from jbrep.stats.aggregates import Aggregate, aggregates
from jbrep.stats.bootstrap import Array, Interval
from jbrep.stats.comparison import Comparison, compare
from jbrep.stats.curves import compared
from jbrep.stats.intervals import LEVEL
from jbrep.stats.labels import RepresentationResult, check_names, describe
from jbrep.stats.means import mean_within
from jbrep.stats.older import in_version_2, in_version_3
from jbrep.stats.plain import READERS, to_plain
from jbrep.stats.rules import Planned
from jbrep.stats.runs import LARGEST_RETURN, Group, RunCurve, groups
from jbrep.stats.scale import SOLVED, STEPS_TO, scale_of
from jbrep.stats.verdict import Judge, Statement, Verdict

FORMAT = "jbrep statistics"
FORMAT_VERSION = 3


References = Mapping[str, Mapping[str, Sequence[float]]]  # returns by task and policy


@dataclass(frozen=True, eq=False)
class GroupAnalysis:
    """The results for one task and algorithm.

    Args:
        task: the task's name.
        algorithm: the algorithm's name.
        grid: training steps at which runs are compared, (g,).
        cut: which evaluations the grid leaves out, in words; None if it leaves out none.
        return_floor: the least possible return of the task; NaN if unknown.
        return_ceiling: the largest possible one; NaN if unknown.
        failure_return: what a failed run counts as from the step of failure on.
        reference: the return that gains are counted from, as in `Scale`.
        references: mean returns of policies that don't learn, each with its 95 % interval over
            starts.
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
    return_ceiling: float
    failure_return: float
    reference: float
    references: Mapping[str, Interval]
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
        claims: that there are verdicts on.
        notes: how verdicts were reached, in sentences.
        groups: by task and algorithm.
        aggregates: results across tasks, where an algorithm learned several.

    Raises:
        ValueError: parts that don't fit together.
    """

    baseline: str
    seed: int
    claims: tuple[Statement, ...]
    notes: tuple[str, ...]
    groups: tuple[GroupAnalysis, ...]
    aggregates: tuple[Aggregate, ...]

    def __post_init__(self) -> None:
        claims = [claim.name for claim in self.claims]
        if not claims or len(set(claims)) < len(claims):
            raise ValueError("there must be claims, each once")
        for comparison in (each for group in self.groups for each in group.comparisons):
            if (found := [verdict.claim for verdict in comparison.verdicts]) != claims:
                raise ValueError(f"claims: {', '.join(found)}; expected {', '.join(claims)}")
        first = {group.labels[0].representation for group in self.groups}
        if first != {self.baseline}:
            raise ValueError(f"each group must begin with the baseline {self.baseline}")

    @property
    def open_aggregates(self) -> list[Aggregate]:
        """Results across tasks of the representations that wait for a look on none."""
        every = (each for group in self.groups for each in group.comparisons)
        closed = {each.representation for each in every if not each.is_open}
        return [each for each in self.aggregates if each.representation not in closed]

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
        try:
            if record["format_version"] == 1:
                record = in_version_2(record)
            if record["format_version"] < FORMAT_VERSION:
                record = in_version_3(record)
            analysis: Analysis = typed(record, cls, READERS)
        except ValueError as error:
            raise DamageError(f"{path} is damaged: {error}") from None
        except (LookupError, TypeError, AttributeError):
            raise DamageError(f"{path} is damaged: parts of it are missing or misplaced") from None
        return analysis


def analyse(
    runs: Sequence[RunCurve],
    judge: Judge | None = None,
    baseline: str = FULL,
    seed: int = 0,
    references: References | None = None,
) -> Analysis:
    """All numbers and verdicts of a study; they don't depend on the order of its runs.

    Args:
        runs: every run of the study.
        judge: what reaches verdicts; by default there are estimates of each claim alone.
        baseline: the representation that the others are compared with.
        seed: of all resampling.
        references: returns of policies that don't learn, by task and policy.

    Raises:
        InputError: runs that can't be compared, or would mislead; see jbrep.stats.runs.groups.
    """
    judge = judge or Planned()
    by_group = groups(runs, baseline)
    verdicts = judge(by_group, seed)
    analysed = tuple(
        _analyse_group(group, verdicts[key], (references or {}).get(key[0], {}), seed)
        for key, group in by_group.items()
    )
    return Analysis(
        baseline=baseline,
        seed=seed,
        claims=tuple(judge.claims),
        notes=tuple(judge.notes),
        groups=analysed,
        aggregates=tuple(aggregates(_gains(analysed), seed)),
    )


def _analyse_group(
    group: Group,
    verdicts: Mapping[str, tuple[Verdict, ...]],
    references: Mapping[str, Sequence[float]],
    seed: int,
) -> GroupAnalysis:
    first = next(iter(group.values()))[0]
    grid, cut, curves, finals = compared(group)
    scale = scale_of(list(finals.values()), next(iter(curves.values())), grid, first)
    baseline, *others = (
        describe(runs, curves[name], finals[name], scale, seed) for name, runs in group.items()
    )
    return GroupAnalysis(
        task=first.task,
        algorithm=first.algorithm,
        cut=cut,
        return_floor=_or_nan(first.return_floor),
        return_ceiling=_or_nan(first.return_ceiling),
        failure_return=_or_nan(first.failure_return),
        references={
            policy: mean_within(np.array(returns), first.bounds, LEVEL)
            for policy, returns in references.items()
        },
        labels=(baseline, *others),
        comparisons=tuple(
            compare(each, baseline, verdicts[each.representation], first.bounds, seed)
            for each in others
        ),
        **scale._asdict(),
    )


def _gains(groups: Sequence[GroupAnalysis]) -> dict[str, dict[str, dict[str, Array]]]:
    """What each run gains, by algorithm, task and representation, where the baseline gains."""
    gains: dict[str, dict[str, dict[str, Array]]] = {}
    for group in groups:
        finals = {each.representation: each.by_run["final_return"] for each in group.labels}
        if next(iter(finals.values())).mean() > group.reference:
            gains.setdefault(group.algorithm, {})[group.task] = {
                name: each - group.reference for name, each in finals.items()
            }
    return gains


def _ascend(values: Array) -> bool:
    """Whether values (n,) ascend and are at least two."""
    return len(values) > 1 and bool(np.all(values[:-1] < values[1:]))


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else float(value)
