"""A whole study: results of every representation, comparisons with the baseline, verdicts."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np

from jbrep.stats.aggregates import Aggregate, aggregates
from jbrep.stats.bootstrap import Array, Interval, without_nan
from jbrep.stats.comparison import Comparison, compare
from jbrep.stats.curves import compared
from jbrep.stats.intervals import LEVEL, mean_within
from jbrep.stats.labels import YES, RepresentationResult, describe
from jbrep.stats.rules import Planned, Verdict
from jbrep.stats.runs import Group, RunCurve, evaluated_run, groups
from jbrep.stats.scale import SOLVED, Ends, best_blind, scale_of

References = Mapping[str, Mapping[str, Sequence[float]]]  # returns by task and policy


@dataclass(frozen=True, eq=False)
class GroupAnalysis:
    """The results for one task and algorithm."""

    task: str
    algorithm: str
    grid: Array  # training steps at which runs are compared, (g,)
    cut: str | None  # which evaluations the grid leaves out, in words; None if it leaves out none
    return_floor: float  # the least possible return of the task; NaN if unknown
    return_ceiling: float  # the largest possible one; NaN if unknown
    failure_return: float  # what a failed run counts as from the step of failure on
    ends: Ends  # the returns that score 0 and 1
    blind: Interval  # the return that shows whether agents learned, as in `Scale`
    # mean returns of policies that don't learn, each with its 95 % interval over starts
    references: Mapping[str, Interval]
    # the return to reach for each of STEPS_TO; NaN where there is none
    thresholds: Mapping[str, float]
    profile_returns: Array  # where performance profiles are evaluated, ascending, (k,)
    labels: tuple[RepresentationResult, ...]  # results of each representation, the baseline first
    # of the other representations with the baseline, in the same order
    comparisons: tuple[Comparison, ...]
    verdicts: tuple[Verdict, ...]  # on the claims that were registered

    @property
    def solved(self) -> float:
        """The return from which on the task counts as solved; NaN if unknown."""
        return self.thresholds[SOLVED]

    @property
    def best_policy(self) -> str | None:
        """The best of the policies that don't look; None if there is none."""
        return best_blind({policy: mean.value for policy, mean in self.references.items()})

    @property
    def compared(self) -> tuple[Comparison, ...]:
        """What can be compared with the baseline: nothing if that didn't learn."""
        return self.comparisons if self.labels[0].learnt == YES else ()

    @property
    def name(self) -> str:
        """Task and algorithm, for titles."""
        return f"{self.task}, {self.algorithm}"


@dataclass(frozen=True, eq=False)
class Analysis:
    """The results of a study."""

    seed: int  # of all resampling
    planned: Planned  # what reached the verdicts
    groups: tuple[GroupAnalysis, ...]  # by task and algorithm
    verdicts: tuple[Verdict, ...]  # on all claims that were registered, by task and algorithm
    aggregates: tuple[Aggregate, ...]  # results across tasks that have scores, of each algorithm

    @property
    def baseline(self) -> str:
        """The representation that the others are compared with."""
        return self.planned.rules.baseline


def analyse(
    runs: Sequence[RunCurve],
    planned: Planned | None = None,
    seed: int = 0,
    references: References | None = None,
) -> Analysis:
    """All numbers and verdicts of a study; they don't depend on the order of its runs.

    Args:
        runs: every run of the study.
        planned: what the runs are compared with, and the claims that get verdicts; by default the
            full observation, and none.
        seed: of all resampling.
        references: returns of policies that don't learn, by task and policy.
    """
    planned = planned or Planned()
    by_group, played = groups(runs, planned.rules.baseline), references or {}
    verdicts = planned(by_group, seed)
    analysed = tuple(
        _analyse_group(
            group,
            tuple(each for each in verdicts if (each.task, each.algorithm) == key),
            played.get(key[0], {}),
            seed,
        )
        for key, group in by_group.items()
    )
    return Analysis(
        seed=seed,
        planned=planned,
        groups=analysed,
        verdicts=tuple(verdicts),
        aggregates=tuple(aggregates(_scores(analysed), seed)),
    )


def _analyse_group(
    group: Group,
    verdicts: tuple[Verdict, ...],
    references: Mapping[str, Sequence[float]],
    seed: int,
) -> GroupAnalysis:
    first, known = evaluated_run(group), compared(group)
    starts = None
    if len(first.steps):
        starts = len(first.evaluations[-1]) if known.on_all_starts else first.returns.shape[1]
    played = {
        policy: mean_within(np.array(returns[:starts]), first.bounds, LEVEL)
        for policy, returns in references.items()
    }
    scale = scale_of(known, played)
    baseline, *others = (
        describe(runs, known.curves[name], known.finals[name], scale, seed)
        for name, runs in group.items()
    )
    return GroupAnalysis(
        task=first.task,
        algorithm=first.algorithm,
        cut=known.cut,
        return_floor=_or_nan(first.return_floor),
        return_ceiling=_or_nan(first.return_ceiling),
        failure_return=_or_nan(first.failure_return),
        references=played,
        labels=(baseline, *others),
        comparisons=tuple(compare(each, baseline, known, seed) for each in others),
        verdicts=verdicts,
        **scale._asdict(),
    )


def _scores(groups: Sequence[GroupAnalysis]) -> dict[str, dict[str, dict[str, Array]]]:
    """What each run scores, by algorithm, task and representation, where that is known."""
    scores: dict[str, dict[str, dict[str, Array]]] = {}
    for group in groups:
        if not math.isnan(group.ends.top):
            scores.setdefault(group.algorithm, {})[group.task] = {
                each.representation: each.by_run["score"] for each in group.labels
            }
    return scores


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else float(value)


def to_plain(value: Any) -> Any:
    """Results as plain JSON: an interval is [value, low, high], None stands for not finite."""
    if isinstance(value, Interval):
        return value.tolist()
    if isinstance(value, Ends):
        return to_plain(value._asdict())
    if is_dataclass(value):
        return {field.name: to_plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {key: to_plain(part) for key, part in value.items()}
    if isinstance(value, tuple):
        return [to_plain(part) for part in value]
    if isinstance(value, np.ndarray | float):
        return without_nan(np.asarray(value).tolist())
    return value
