"""What codes are worth in words: which one to take, and why others are worth less."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jbrep.encoders import FULL
from jbrep.evaluate.evaluation import Evaluation, LatentUnits, Score, Worth
from jbrep.report.words import enumerated
from jbrep.stats.bootstrap import Interval
from jbrep.stats.scale import best_blind
from jbrep.text import SIGNIFICANT, number

_WIDE = 100  # how much more a code varies in one direction than in another: a rule of thumb
_BY = "by small agents"


class Ranked(NamedTuple):
    """Codes by what agents return that observe them.

    Attributes:
        means: returns by label, the best first.
        best: labels of those not clearly below the best one, but clearly above the floor.
        floor: the mean return of the best policy that doesn't look.
    """

    means: Mapping[str, Interval]
    best: list[str]
    floor: float


def ranked(worth: Worth) -> Ranked:
    """Codes by their agents' returns."""
    means = {label: _bounded(each) for label, each in worth.returns.items()}
    blind = best_blind(worth.references)
    floor = worth.references[blind] if blind else -math.inf
    order = sorted(means, key=lambda label: -means[label].value)
    first = means[order[0]]
    best = [
        label
        for label in order
        if means[label].low > floor and not _clearly_below(means[label], first)
    ]
    return Ranked({label: means[label] for label in order}, best, floor)


def _clearly_below(mean: Interval, best: Interval) -> bool:
    """Whether the interval of a difference says so (Zou and Donner 2008, MOVER)."""
    return bool(best.value - mean.value > math.hypot(best.value - best.low, mean.high - mean.value))


def _bounded(mean: Score) -> Interval:
    """A mean with its interval, which is the mean alone where no return differs from another."""
    value, low, high = mean
    at = -math.inf if value is None else value
    return Interval(at, at if low is None else low, at if high is None else high)


def advice(evaluation: Evaluation, found: Ranked) -> str:
    """Which code to take; or why that can't be said."""
    if not found.best:
        return (
            f"Nothing can be said of the codes: {_BY}, none is clearly worth more than not "
            f"looking at all ({number(found.floor, SIGNIFICANT)})."
        )
    smallest = min(found.best, key=lambda label: evaluation.encoders[label].latent)
    if found.best == [FULL]:
        return f"Take the full observation: {_BY}, it is worth more than any code."
    if len(found.best) == 1:
        return f"Take {smallest}: {_BY}, it is worth the most."
    return (
        f"Take {smallest}: {_BY}, the smallest of those not clearly worse than the best. "
        f"These are {enumerated(found.best)}."
    )


def title(worth: Worth) -> str:
    """What the returns of a ranking are."""
    return (
        f"Mean return of small agents, {worth.runs} of {worth.steps:,} steps each, in "
        f"{worth.episodes} episodes"
    )


def conditioning(units: LatentUnits) -> str:
    """How ill-conditioned a code is, if it is; else nothing."""
    if (ratio := condition(units)) <= _WIDE:
        return ""
    return f"ill-conditioned: one direction varies {ratio:,.0f} times as much as another"


def condition(units: LatentUnits) -> float:
    """The largest deviation of a code in any direction, over the least; dead units don't count."""
    alive = [unit for unit in range(len(units.variance)) if unit not in units.dead]
    if not alive:
        return 1.0
    deviation = np.sqrt(np.array(units.variance)[alive])
    correlation = np.array(units.correlation, float)[np.ix_(alive, alive)]
    return float(np.linalg.cond(correlation * np.outer(deviation, deviation)) ** 0.5)
