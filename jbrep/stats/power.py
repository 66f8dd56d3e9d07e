"""What a study could find, before its first run: least p-values, and power at given effects."""

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.stats import nct, t

from jbrep.stats.claims import (
    FASTER,
    LESS_VARIABLE,
    NOT_WORSE,
    PERMUTATIONS,
    Curves,
    spread_p,
    swaps,
)
from jbrep.stats.pairs import FEWEST_UNITS
from jbrep.stats.rules import Planned, Stated, most_failing

SDS = (0.1, 0.2, 0.3)
BETTER_BY, EARLIER_BY = 0.2, 0.1
_RATIOS = (1 / 2, 1 / 3, 1 / 5)
_STUDIES_OF_CURVES = 200
_LEAST_PERMUTATIONS = 999


class Prospect(NamedTuple):
    """What can be found of a claim on a task."""

    where: str  # task and algorithm
    claim: Stated
    units: int
    level: float  # of the test, if no other claims pass on their level
    least_p: float
    power: tuple[float, ...]  # at SDS, or of less variable curves at ratios of spreads
    unseen: float  # the share of units that may fail where none of the runs does


def obstacle(claim: Stated, units: int, level: float) -> str | None:
    """Why no outcome could support a claim; None if one could."""
    if units < FEWEST_UNITS:
        return f"it has {units} runs or encoders to compare, and verdicts take {FEWEST_UNITS}"
    if (least := _least_p(claim, units)) > level:
        return f"its least p-value is {least:.2g}, above its level, {level:.2g}"
    return None


def prospects(planned: Planned, units: dict[Stated, int]) -> Iterator[Prospect]:
    """What can be found of each claim on each task and algorithm, with its planned units."""
    level = planned.share
    for task, algorithm in planned.groups:
        for claim, count in units.items():
            yield Prospect(
                where=f"{task}, {algorithm}",
                claim=claim,
                units=count,
                level=level,
                least_p=_least_p(claim, count),
                power=_power(claim.claim.name, planned.rules.margin, count, level),
                unseen=most_failing(0, count, level),
            )


def _least_p(claim: Stated, units: int) -> float:
    """Two-sided, of swaps of sides as `spread_p` draws them; that of a mean can be any."""
    if claim.claim.name != LESS_VARIABLE.name:
        return 0.0
    same = (~swaps(units, PERMUTATIONS)).all(axis=1).sum()  # none swaps, as in the data
    return float(2 * (1 + same) / (1 + PERMUTATIONS))


@lru_cache(256)
def _power(claim: str, margin: float, units: int, level: float) -> tuple[float, ...]:
    if claim == LESS_VARIABLE.name:
        return tuple(_power_of_spread(ratio, units, level) for ratio in _RATIOS)
    effect = {NOT_WORSE.name: margin, FASTER.name: EARLIER_BY}.get(claim, BETTER_BY)
    least = t.isf(level / 2, units - 1)
    return tuple(float(nct.sf(least, units - 1, np.sqrt(units) * effect / sd)) for sd in SDS)


def _power_of_spread(ratio: float, units: int, level: float) -> float:
    random = np.random.default_rng(0)
    count = max(_LEAST_PERMUTATIONS, min(PERMUTATIONS, int(5 / level)))
    found = 0
    for seed in range(_STUDIES_OF_CURVES):
        x, y = (random.normal(0, sd, (units, 1)) for sd in (ratio, 1))
        found += spread_p(Curves(x, y, np.ones(1), 0.01), count, seed) <= level
    return found / _STUDIES_OF_CURVES
