"""What codes are worth in words: which one to take, and why others are worth less."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jbrep.encoders import FULL
from jbrep.evaluate.evaluation import Evaluation, LatentUnits, Learned, Score, Worth
from jbrep.report.words import enumerated
from jbrep.stats.bootstrap import Interval
from jbrep.stats.scale import best_blind
from jbrep.text import SIGNIFICANT, Table, interval, number
from jbrep.worth import AGENT

_WIDE = 100  # how much more a code varies in one direction than in another: a rule of thumb
_BY = {
    AGENT: "small agents",
    "trees": "fitted Q-iteration with trees",
    "fourier": "fitted Q-iteration with Fourier features",
    "linear model": "planning over a linear model",
    "network model": "planning over a network",
}


class Ranked(NamedTuple):
    """Codes by what one way of learning makes of them.

    Attributes:
        way: that is the surest of those that were asked for.
        means: returns by label, the best first.
        best: labels of those not clearly below the best one, but clearly above the floor.
        floor: the mean return of the best policy that doesn't look.
    """

    way: str
    means: Mapping[str, Interval]
    best: list[str]
    floor: float


def ranked(worth: Worth | None) -> Ranked | None:
    """Codes by the surest way of learning that found out all; None where nothing can be said."""
    if worth is None or _is_constant(worth):
        return None
    by_way = worth.learned
    complete = (way for way in by_way if len(by_way[way]) == max(map(len, by_way.values())))
    way = next(complete, None)
    if way is None:
        return None
    means = {label: _bounded(each.final) for label, each in by_way[way].items()}
    blind = best_blind(worth.references)
    floor = worth.references[blind] if blind else -math.inf
    order = sorted(means, key=lambda label: -means[label].value)
    first = means[order[0]]
    best = [
        label
        for label in order
        if means[label].low > floor and not _clearly_below(means[label], first)
    ]
    return Ranked(way, {label: means[label] for label in order}, best, floor)


def _clearly_below(mean: Interval, best: Interval) -> bool:
    """Whether the interval of a difference says so (Zou and Donner 2008, MOVER)."""
    return bool(best.value - mean.value > math.hypot(best.value - best.low, mean.high - mean.value))


def _is_constant(worth: Worth) -> bool:
    """Whether all that is known was learned from data in which no step is better than another."""
    is_alike = worth.rewards is not None and not worth.rewards[1] and not worth.ends
    return is_alike and AGENT not in worth.learned


def _bounded(mean: Score) -> Interval:
    """A mean with its interval, which is the mean alone where no return differs from another."""
    value, low, high = mean
    at = -math.inf if value is None else value
    return Interval(at, at if low is None else low, at if high is None else high)


def advice(evaluation: Evaluation, worth: Worth) -> str:
    """Which code to take; or why that can't be said."""
    if worth.rewards is not None and _is_constant(worth):
        return (
            f"Every reward of the data is {worth.rewards[0]:g}: what codes are worth can't be "
            f"learned from it.{_instead(worth)}"
        )
    found = ranked(worth)
    if found is None:
        return "What codes are worth isn't known yet: the same command goes on."
    by = _BY[found.way]
    if not found.best:
        return (
            f"Nothing can be said of the codes: by {by}, none is clearly worth more than not "
            f"looking at all ({number(found.floor, SIGNIFICANT)}).{_instead(worth)}"
        )
    smallest = min(found.best, key=lambda label: evaluation.encoders[label].latent)
    take, doubt = ("Take", "") if found.way == AGENT else ("Perhaps take", _doubt(worth))
    if found.best == [FULL]:
        return f"{take} the full observation: by {by}, it is worth more than any code.{doubt}"
    if len(found.best) == 1:
        return f"{take} {smallest}: by {by}, it is worth the most.{doubt}"
    best = enumerated(found.best)
    return (
        f"{take} {smallest}: by {by}, the smallest of those not clearly worse than the best, "
        f"{best}.{doubt}"
    )


def _doubt(worth: Worth) -> str:
    """What came out where it was tested: see results/worth-face-direction."""
    surer = "" if worth.estimated else ": ask for --worth agent"
    return f" Where this was tested, agents' returns didn't follow it{surer}."


def _instead(worth: Worth) -> str:
    """What may say more."""
    surer = "" if AGENT in worth.learned or worth.estimated else "; or ask for --worth agent"
    return f" Collect data with a better policy{surer}."


def title(worth: Worth, found: Ranked) -> str:
    """What the returns of a ranking are."""
    if found.way == AGENT:
        how = f"{_BY[AGENT]}, {worth.runs} of {worth.steps:,} steps each"
    else:
        mean, deviation = worth.rewards or (math.nan, math.nan)
        how = f"{_BY[found.way]} from steps that earn {mean:.2g} on average (SD {deviation:.2g})"
    where = "estimated from the data" if worth.estimated else f"in {worth.episodes} episodes"
    return f"Mean return of {how}, {where}"


def worth_table(worth: Worth) -> Table:
    """What each code returns, by way of learning; first, and learned again with own steps."""
    labels = dict.fromkeys(label for known in worth.learned.values() for label in known)
    return Table(
        "Mean returns, by way of learning",
        ("encoder", *worth.learned),
        [
            (label, *(_returned(known.get(label)) for known in worth.learned.values()))
            for label in labels
        ],
    )


def _returned(each: Learned | None) -> str:
    if each is None:
        return "-"
    first = interval(each.score, SIGNIFICANT)
    return first if each.again is None else f"{first}, then {interval(each.again, SIGNIFICANT)}"


def conditioning(evaluation: Evaluation, worth: Worth, label: str) -> str:
    """How ill-conditioned a code is, if it is; else nothing.

    It is if trees, to which scale doesn't matter, find more in it than Fourier features do; or,
    where these weren't tried, if it varies a hundred times as much in one direction as in another.
    """
    learned, units = worth.learned, evaluation.encoders[label].latent_units
    if all(label in learned.get(way, {}) for way in ("trees", "fourier")):
        trees, fourier = (_bounded(learned[way][label].final) for way in ("trees", "fourier"))
        if trees.low > fourier.high:
            return (
                f"ill-conditioned: trees make {number(trees.value, SIGNIFICANT)} of it, Fourier "
                f"features {number(fourier.value, SIGNIFICANT)}"
            )
    elif (ratio := condition(units)) > _WIDE:
        return f"ill-conditioned: one direction varies {ratio:,.0f} times as much as another"
    return ""


def condition(units: LatentUnits) -> float:
    """The largest deviation of a code in any direction, over the least; dead units don't count."""
    alive = [unit for unit in range(len(units.variance)) if unit not in units.dead]
    if not alive:
        return 1.0
    deviation = np.sqrt(np.array(units.variance)[alive])
    correlation = np.array(units.correlation, float)[np.ix_(alive, alive)]
    return float(np.linalg.cond(correlation * np.outer(deviation, deviation)) ** 0.5)
