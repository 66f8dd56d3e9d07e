"""A whole study: results of every representation, comparisons with the baseline, verdicts."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np
from scipy.stats import levene, rankdata

from jbrep.stats.bootstrap import Array, Interval, without_nan
from jbrep.stats.claims import FASTER, LESS_VARIABLE
from jbrep.stats.curves import Compared, compared, iqm
from jbrep.stats.intervals import (
    FEWEST_RUNS,
    LEVEL,
    UNDEFINED,
    Bounds,
    constant,
    mean_within,
    percentile,
    share_of_gain,
    unless_few,
    variance_ratio,
)
from jbrep.stats.labels import RepresentationResult, describe
from jbrep.stats.pairs import Pair, paired
from jbrep.stats.rules import Planned, Verdict
from jbrep.stats.runs import Group, RunCurve, evaluated_run, groups
from jbrep.stats.scale import Ends, best_blind, scale_of

References = Mapping[str, Mapping[str, Sequence[float]]]  # returns by task and policy
SCORES = np.linspace(0, 1.2, 61)  # at which profiles are evaluated
_PAIRED = (
    *("final_return_difference", "score_difference", "mean_return_difference"),
    *("share_of_gain", "steps_later", "spread_ratio"),
)


@dataclass(frozen=True, eq=False)
class Comparison:
    """A representation against the baseline."""

    representation: str
    # differences, ratios and the probability of improvement, by name, each with its 95 % interval
    numbers: Mapping[str, Interval]
    brown_forsythe_p: float  # of equal variances of final returns; NaN where it is undefined
    shared: int  # seeds of both, over which differences are taken
    by_encoder: bool  # whether that is over encoders


@dataclass(frozen=True, eq=False)
class Aggregate:
    """A representation's runs on several tasks, with one algorithm."""

    algorithm: str
    representation: str
    tasks: tuple[str, ...]  # their names; those without a reference policy are left out
    runs: int  # on each task: the first of those with more
    iqm: Interval  # interquartile mean of scores, with its 95 % interval
    optimality_gap: Interval  # mean of what scores lack to 1, with its 95 % interval
    scores: Array  # where the profile is evaluated, (k,)
    # the share of runs with a score above each of these, averaged over tasks, (k,)
    profile: Interval


@dataclass(frozen=True, eq=False)
class GroupAnalysis:
    """The results for one task and algorithm."""

    task: str
    algorithm: str
    grid: Array  # training steps at which runs are compared, (g,)
    cut: str | None  # which evaluations the grid leaves out, in words; None if it leaves out none
    return_floor: float | None  # the least possible return of the task; None if unknown
    return_ceiling: float | None  # the largest possible one; None if unknown
    failure_return: float | None  # what a failed run counts as from the step of failure on
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

    @property
    def best_policy(self) -> str | None:
        """The best blind baseline; None if there is none."""
        return best_blind({policy: mean.value for policy, mean in self.references.items()})


@dataclass(frozen=True, eq=False)
class Analysis:
    """The results of a study."""

    groups: tuple[GroupAnalysis, ...]  # by task and algorithm
    verdicts: tuple[Verdict, ...]  # on all claims that were registered, by task and algorithm
    aggregates: tuple[Aggregate, ...]  # results across tasks that have scores, of each algorithm


def analyse(
    runs: Sequence[RunCurve], planned: Planned | None = None, references: References | None = None
) -> Analysis:
    """All numbers and verdicts of a study; they don't depend on the order of its runs.

    By default these are compared with the full observation, and no claim gets a verdict. References
    are returns of policies that don't learn, by task and policy.
    """
    planned = planned or Planned()
    by_group, played = groups(runs, planned.rules.baseline), references or {}
    analysed = tuple(
        _analyse_group(group, played.get(key[0], {})) for key, group in by_group.items()
    )
    return Analysis(
        groups=analysed,
        verdicts=tuple(planned(by_group)),
        aggregates=tuple(aggregates(_scores(analysed))),
    )


def _analyse_group(group: Group, references: Mapping[str, Sequence[float]]) -> GroupAnalysis:
    first, known, starts = evaluated_run(group), compared(group), None
    if len(first.steps):
        ends = [r.final for runs in group.values() for r in runs if r.final is not None]
        starts = len(ends[0]) if known.on_all_starts else first.returns.shape[1]
    played = {
        policy: mean_within(np.array(returns[:starts]), first.bounds, LEVEL)
        for policy, returns in references.items()
    }
    scale = scale_of(known, played)
    baseline, *others = (
        describe(runs, known.curves[name], known.finals[name], scale)
        for name, runs in group.items()
    )
    return GroupAnalysis(
        task=first.task,
        algorithm=first.algorithm,
        cut=known.cut,
        return_floor=first.return_floor,
        return_ceiling=first.return_ceiling,
        failure_return=first.failure_return,
        references=played,
        labels=(baseline, *others),
        comparisons=tuple(compare(each, baseline, known) for each in others),
        **scale._asdict(),
    )


def _scores(groups: Sequence[GroupAnalysis]) -> dict[str, dict[str, dict[str, Array]]]:
    scores: dict[str, dict[str, dict[str, Array]]] = {}
    for group in groups:
        if not math.isnan(group.ends.top):
            scores.setdefault(group.algorithm, {})[group.task] = {
                each.representation: each.by_run["score"] for each in group.labels
            }
    return scores


def compare(
    label: RepresentationResult, baseline: RepresentationResult, known: Compared
) -> Comparison:
    """A representation against the baseline of the same task and algorithm."""
    finals = label.by_run["final_return"], baseline.by_run["final_return"]
    found = paired(known, label.representation, baseline.representation)
    numbers = _differences(found) if found else dict.fromkeys(_PAIRED, UNDEFINED)
    numbers["variance_ratio"] = variance_ratio(*finals)
    numbers["probability_of_improvement"] = percentile(probability_of_improvement, *finals)
    return Comparison(
        representation=label.representation,
        numbers=numbers,
        brown_forsythe_p=_brown_forsythe(*finals),
        shared=found.runs if found else 0,
        by_encoder=found is not None and found.by_encoder,
    )


def _differences(pair: Pair) -> dict[str, Interval]:
    """What is compared unit by unit; shares of gains and ratios only where the baseline learned."""
    x, y = pair.x, pair.y
    score = pair.ends.score(x.final) - pair.ends.score(y.final)
    every = (
        mean_within(x.final - y.final, Bounds(), LEVEL),
        mean_within(score, Bounds(), LEVEL),
        mean_within(x.mean - y.mean, Bounds(), LEVEL),
        *(
            (
                share_of_gain(x.final, y.final, pair.ends.blind),
                FASTER.estimate(pair, LEVEL),
                LESS_VARIABLE.estimate(pair, LEVEL),
            )
            if pair.y_learns
            else [UNDEFINED] * 3
        ),
    )
    return {n: unless_few(e, pair.units) for n, e in zip(_PAIRED, every, strict=True)}


def probability_of_improvement(x: Array, y: Array) -> Array:
    """The share of pairs in which a run of x (..., n) beats one of y (..., m); ties count half.

    Mann and Whitney's statistic, as in Agarwal et al. 2021.
    """
    n, m = x.shape[-1], y.shape[-1]
    ranks = rankdata(np.concatenate((x, y), axis=-1), axis=-1)[..., :n]
    return (ranks.sum(axis=-1) - n * (n + 1) / 2) / (n * m)


def _brown_forsythe(x: Array, y: Array) -> float:
    if constant(x) or constant(y) or min(len(x), len(y)) < FEWEST_RUNS:
        return np.nan
    return float(levene(x, y, center="median").pvalue)


def aggregates(scores: Mapping[str, Mapping[str, Mapping[str, Array]]]) -> Iterator[Aggregate]:
    """The results of each algorithm and representation that has runs on two tasks or more.

    After Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the Statistical
    Precipice", with runs resampled within each task. Scores are by algorithm, task and
    representation, (runs,) each.
    """
    for algorithm, by_task in scores.items():
        names = dict.fromkeys(name for by_name in by_task.values() for name in by_name)
        for name in names if len(by_task) > 1 else ():
            if all(name in by_name for by_name in by_task.values()):
                own = [by_name[name] for by_name in by_task.values()]
                yield _aggregate(algorithm, name, tuple(by_task), own)


def _aggregate(
    algorithm: str, name: str, tasks: tuple[str, ...], scores: Sequence[Array]
) -> Aggregate:
    runs = min(map(len, scores))

    def interval(statistic: Callable[[Array], Array]) -> Interval:
        def of_samples(*samples: Array) -> Array:
            return statistic(np.concatenate(samples, axis=-1))

        return percentile(of_samples, *(each[:runs] for each in scores))

    return Aggregate(
        algorithm=algorithm,
        representation=name,
        tasks=tasks,
        runs=runs,
        iqm=interval(iqm),
        optimality_gap=interval(lambda each: (1 - np.minimum(each, 1)).mean(axis=-1)),
        scores=SCORES,
        profile=interval(lambda each: (each > SCORES.reshape(-1, *[1] * each.ndim)).mean(axis=-1)),
    )


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
