"""Results across tasks, with intervals from resampling runs within each task.

After Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the Statistical Precipice".
A run's score is its gain over the best policy that doesn't look as a share of the mean gain on the
full state, so that tasks can be put together: 0 is no better than not looking, 1 as good as the
full state, whose runs are resampled, too.
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
    # their names; those where agents on the baseline don't surely learn are left out
    tasks: tuple[str, ...]
    runs: int  # on each task: the first of those with more
    iqm: Interval  # interquartile mean of scores, with its 95 % interval
    optimality_gap: Interval  # mean of what scores lack to 1, with its 95 % interval
    scores: Array  # where the profile is evaluated, (k,)
    # the share of runs with a score above each of these, averaged over tasks, (k,)
    profile: Interval


def aggregates(
    gains: Mapping[str, Mapping[str, Mapping[str, Array]]], seed: int
) -> Iterator[Aggregate]:
    """The results of each algorithm and representation that has runs on two tasks or more.

    Nothing of one that is alone, whose scores would be its own.
    Gains are by algorithm, task and representation, the baseline first, (runs,) each.
    """
    for algorithm, by_task in gains.items():
        names = dict.fromkeys(name for by_name in by_task.values() for name in by_name)
        for name in names if min(len(by_task), len(names)) > 1 else ():
            if all(name in by_name for by_name in by_task.values()):
                yield _aggregate(algorithm, name, by_task, seed)


def _aggregate(
    algorithm: str, name: str, by_task: Mapping[str, Mapping[str, Array]], seed: int
) -> Aggregate:
    runs = min(len(by_name[name]) for by_name in by_task.values())
    own = [by_name[name][:runs] for by_name in by_task.values()]
    baselines = [next(iter(by_name.items())) for by_name in by_task.values()]
    others = [each for baseline, each in baselines if baseline != name]

    def interval(statistic: Callable[[Array], Array]) -> Interval:
        def of_samples(*samples: Array) -> Array:
            mine = samples[: len(own)]
            return statistic(_scores(mine, samples[len(own) :] or mine))

        return percentile(of_samples, *own, *others, seed=seed)

    return Aggregate(
        algorithm=algorithm,
        representation=name,
        tasks=tuple(by_task),
        runs=runs,
        iqm=interval(iqm),
        optimality_gap=interval(lambda scores: (1 - np.minimum(scores, 1)).mean(axis=-1)),
        scores=SCORES,
        profile=interval(_shares_above),
    )


def _scores(gains: Sequence[Array], of_baseline: Sequence[Array]) -> Array:
    """The scores of all tasks together, (..., tasks x runs); NaN where the baseline gains nothing.

    Gains are those of each task, (..., runs) and (..., runs of the baseline).
    """
    means = (each.mean(axis=-1, keepdims=True) for each in of_baseline)
    scored = [
        gain / np.where(mean > 0, mean, np.nan) for gain, mean in zip(gains, means, strict=True)
    ]
    return np.concatenate(scored, axis=-1)


def _shares_above(scores: Array) -> Array:
    above = scores > SCORES.reshape(-1, *[1] * scores.ndim)
    return np.where(np.isnan(scores).any(axis=-1), np.nan, above.mean(axis=-1))
