"""Results across tasks, with intervals from resampling runs within each task.

After Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the Statistical Precipice".
A run scores 0 where it returns what the best policy that doesn't look returns, and 1 at what a
reference policy does, so that tasks can be put together.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from jbrep.stats.bootstrap import Array, Interval
from jbrep.stats.curves import iqm
from jbrep.stats.intervals import percentile

SCORES = np.linspace(0, 1.2, 61)  # at which profiles are evaluated


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


def aggregates(
    scores: Mapping[str, Mapping[str, Mapping[str, Array]]], seed: int
) -> Iterator[Aggregate]:
    """The results of each algorithm and representation that has runs on two tasks or more.

    Scores are by algorithm, task and representation, (runs,) each.
    """
    for algorithm, by_task in scores.items():
        names = dict.fromkeys(name for by_name in by_task.values() for name in by_name)
        for name in names if len(by_task) > 1 else ():
            if all(name in by_name for by_name in by_task.values()):
                own = [by_name[name] for by_name in by_task.values()]
                yield _aggregate(algorithm, name, tuple(by_task), own, seed)


def _aggregate(
    algorithm: str, name: str, tasks: tuple[str, ...], scores: Sequence[Array], seed: int
) -> Aggregate:
    runs = min(map(len, scores))

    def interval(statistic: Callable[[Array], Array]) -> Interval:
        def of_samples(*samples: Array) -> Array:
            return statistic(np.concatenate(samples, axis=-1))

        return percentile(of_samples, *(each[:runs] for each in scores), seed=seed)

    return Aggregate(
        algorithm=algorithm,
        representation=name,
        tasks=tasks,
        runs=runs,
        iqm=interval(iqm),
        optimality_gap=interval(lambda each: (1 - np.minimum(each, 1)).mean(axis=-1)),
        scores=SCORES,
        profile=interval(_shares_above),
    )


def _shares_above(scores: Array) -> Array:
    return (scores > SCORES.reshape(-1, *[1] * scores.ndim)).mean(axis=-1)
