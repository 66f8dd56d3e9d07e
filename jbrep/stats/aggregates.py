"""Results across tasks, with intervals from resampling runs within each task.

After Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the Statistical Precipice".
A run's score is its gain over standing still as a share of the mean gain on the full state, so that
tasks can be put together: 0 is no better than standing still, 1 as good as the full state.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from jbrep.stats.bootstrap import Array, Interval
from jbrep.stats.curves import iqm
from jbrep.stats.intervals import percentile

SCORES = np.linspace(0, 1.2, 61)  # at which profiles are evaluated


@dataclass(frozen=True, eq=False)
class Aggregate:
    """A representation's runs on several tasks, with one algorithm.

    Args:
        algorithm: its name.
        representation: its name.
        tasks: their names.
        runs: on each task: the first of those with more.
        iqm: interquartile mean of scores, with its 95 % interval.
        optimality_gap: mean of what scores lack to 1, with its 95 % interval.
        scores: where the profile is evaluated, (k,).
        profile: the share of runs with a score above each of these, averaged over tasks, (k,).

    Raises:
        ValueError: a profile that doesn't fit its scores.
    """

    algorithm: str
    representation: str
    tasks: tuple[str, ...]
    runs: int
    iqm: Interval
    optimality_gap: Interval
    scores: Array
    profile: Interval

    def __post_init__(self) -> None:
        if np.shape(self.profile.value) != self.scores.shape:
            raise ValueError("the profile must have as many values as scores")
        if np.ndim(self.iqm.value) or np.ndim(self.optimality_gap.value):
            raise ValueError("iqm and optimality_gap must be one interval each")


def aggregates(
    scores: Mapping[str, Mapping[str, Mapping[str, Array]]], seed: int
) -> Iterator[Aggregate]:
    """The results of each algorithm and representation that has runs on two tasks or more.

    Args:
        scores: by algorithm, representation and task, (runs,) each.
        seed: of the resamples.
    """
    for algorithm, by_name in scores.items():
        tasks = max((tuple(by_task) for by_task in by_name.values()), key=len)
        for name, by_task in by_name.items():
            if len(tasks) > 1 and by_task.keys() == set(tasks):
                yield _aggregate(algorithm, name, tasks, [by_task[task] for task in tasks], seed)


def _aggregate(
    algorithm: str, name: str, tasks: tuple[str, ...], scores: Sequence[Array], seed: int
) -> Aggregate:
    runs = min(map(len, scores))
    samples = [each[:runs] for each in scores]
    return Aggregate(
        algorithm=algorithm,
        representation=name,
        tasks=tasks,
        runs=runs,
        iqm=percentile(lambda *each: iqm(_together(each)), *samples, seed=seed),
        optimality_gap=percentile(
            lambda *each: (1 - np.minimum(_together(each), 1)).mean(axis=-1), *samples, seed=seed
        ),
        scores=SCORES,
        profile=percentile(
            lambda *each: _together(each).mean(axis=-1),
            *((sample > SCORES[:, None]).astype(float) for sample in samples),
            seed=seed,
        ),
    )


def _together(samples: Sequence[Array]) -> Array:
    return np.concatenate(samples, axis=-1)
