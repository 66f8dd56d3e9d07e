"""What is claimed of two representations: how each claim is measured, and what is found of it."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.stats import ttest_1samp

from jbrep.stats.bootstrap import Array, Interval
from jbrep.stats.intervals import Bounds, constant, mean_within
from jbrep.stats.pairs import Pair
from jbrep.stats.spread import PERMUTATIONS, TO_SHOW, Curves, ratio_of_spreads, spread_p

SUPPORTED, CONTRADICTED, UNDECIDED = "supported", "contradicted", "undecided"


class Claim(NamedTuple):
    """A claim of a representation, x, against another, y."""

    name: str  # as in "x NAME than y"
    side: int  # 1 if an estimate above the boundary speaks for the claim, -1 if one below does
    boundary: Callable[[Pair, float], float]  # of the estimate, given the margin
    # with an interval of a level; the seed is that of permutations
    estimate: Callable[[Pair, float, int], Interval]
    # the same with the interval that the test itself keeps
    tested: Callable[[Pair, float, int], Interval]
    # two-sided, of the estimand lying on the boundary, from a pair, the boundary and a seed
    p_value: Callable[[Pair, float, int], float]
    is_of_returns: bool = False  # whether the estimate is a difference of returns
    is_ratio: bool = False  # whether the estimate is a ratio, whose logarithm is symmetrical
    takes_learning: bool = True  # whether it says nothing where agents on y don't learn


def _returns(pair: Pair) -> Array:
    return pair.x.final - pair.y.final


def _steps(pair: Pair) -> Array:
    return pair.x.steps - pair.y.steps


def difference(of: Callable[[Pair], Array], pair: Pair, level: float, seed: int = 0) -> Interval:
    """The mean of differences between the sides of units, with Student's interval."""
    return mean_within(of(pair), Bounds(), level)


def _difference_p(of: Callable[[Pair], Array], pair: Pair, boundary: float, seed: int) -> float:
    """Student's p-value; NaN where nothing varies."""
    values = of(pair)
    return np.nan if constant(values) else float(ttest_1samp(values, boundary).pvalue)


def spread_ratio(pair: Pair, level: float, seed: int, permutations: int = TO_SHOW) -> Interval:
    """The spread of training curves of x over that of y."""
    return ratio_of_spreads(_curves(pair), level, seed, permutations)


def _spread_p(pair: Pair, boundary: float, seed: int) -> float:
    return spread_p(_curves(pair), seed)


def _curves(pair: Pair) -> Curves:
    return Curves(pair.x.curves, pair.y.curves, pair.weights, pair.resolution)


BETTER = Claim(
    name="better",
    side=1,
    boundary=lambda pair, margin: 0.0,
    estimate=partial(difference, _returns),
    tested=partial(difference, _returns),
    p_value=partial(_difference_p, _returns),
    is_of_returns=True,
    takes_learning=False,
)
NOT_WORSE = BETTER._replace(
    name="not worse",
    boundary=lambda pair, margin: -margin * (pair.ends.top - pair.ends.blind),
    takes_learning=True,
)
FASTER = Claim(
    name="faster",
    side=-1,
    boundary=lambda pair, margin: 0.0,
    estimate=partial(difference, _steps),
    tested=partial(difference, _steps),
    p_value=partial(_difference_p, _steps),
)
LESS_VARIABLE = Claim(
    name="less variable",
    side=-1,
    boundary=lambda pair, margin: 1.0,
    estimate=spread_ratio,
    tested=partial(spread_ratio, permutations=PERMUTATIONS),
    p_value=_spread_p,
    is_ratio=True,
)
CLAIMS = {claim.name: claim for claim in (BETTER, NOT_WORSE, FASTER, LESS_VARIABLE)}
