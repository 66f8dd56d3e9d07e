"""What is claimed of two representations: how each claim is measured, and what is found of it.

Claims on returns and steps rest on Student's t over units; that curves lie closer together rests on
a permutation test of how far apart whole training curves lie.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import ttest_1samp

from jbrep.stats.bootstrap import Array, Interval
from jbrep.stats.intervals import Bounds, constant, mean_within
from jbrep.stats.pairs import Pair

SUPPORTED, CONTRADICTED, UNDECIDED = "supported", "contradicted", "undecided"
PERMUTATIONS = 9999
TO_SHOW = 499  # permutations, for intervals that no test rests on
_FURTHEST = 12.0  # logarithm of a ratio of spreads: nobody has seen more
_CLOSE = 5e-3  # of that logarithm
_AT_ONCE = 1 << 22  # numbers in memory


class Claim(NamedTuple):
    """A claim of a representation, x, against another, y."""

    name: str  # as in "x NAME than y"
    side: int  # 1 if an estimate above the boundary speaks for the claim, -1 if one below does
    boundary: Callable[[Pair, float], float]  # of the estimate, given the margin
    estimate: Callable[[Pair, float], Interval]  # with an interval of a level
    p_value: Callable[[Pair, float], float]  # two-sided, of the estimand lying on the boundary
    is_of_returns: bool = False  # whether the estimate is a difference of returns
    takes_learning: bool = True  # whether it says nothing where agents on y don't learn
    # the estimate with the interval that the test itself keeps, if that is another
    tested: Callable[[Pair, float], Interval] | None = None


def _returns(pair: Pair) -> Array:
    return pair.x.final - pair.y.final


def _steps(pair: Pair) -> Array:
    return pair.x.steps - pair.y.steps


def difference(of: Callable[[Pair], Array], pair: Pair, level: float) -> Interval:
    """The mean of differences between the sides of units, with Student's interval."""
    return mean_within(of(pair), Bounds(), level)


def _difference_p(of: Callable[[Pair], Array], pair: Pair, boundary: float) -> float:
    values = of(pair)
    return np.nan if constant(values) else float(ttest_1samp(values, boundary).pvalue)


class Curves(NamedTuple):
    """What two representations are compared by, unit by unit."""

    x: Array  # curves of one, (n, g)
    y: Array  # curves of the other, (n, g)
    weights: Array  # of the g evaluations in a mean over training, with a sum of 1
    resolution: float  # in units of return, above 0


def log_spread(curves: Array, weights: Array, resolution: float) -> Array:
    """How far apart curves (g, ..., n) lie, by step first and by run last, (...).

    The mean over training of the logarithm of their median absolute deviation, plus a resolution,
    below which differences don't matter and without which equal curves would have none.
    """
    apart = np.abs(curves - _median(curves)[..., None])
    return np.tensordot(weights, np.log(_median(apart) + resolution), 1)


def _median(values: Array) -> Array:
    """The median of (..., n), (...): by sorting, which is far faster than np.median for few n."""
    ordered, last = np.sort(values, axis=-1), values.shape[-1] - 1
    return (ordered[..., last // 2] + ordered[..., -(-last // 2)]) / 2


def ratio_of_spreads(curves: Curves, level: float, permutations: int = TO_SHOW) -> Interval:
    """By what the deviations of x must be divided to spread like those of y, with an interval.

    The interval has the ratios that the permutation test doesn't reject (Hodges and Lehmann 1963):
    with `PERMUTATIONS`, as `spread_p` has, they agree. Ratios are looked for from e^-12 to
    e^12; those beyond are 0 and infinity, as of curves that don't differ at all. All is NaN where
    no curves of either differ from one another.
    """
    most, least = _excess(curves, -_FURTHEST), _excess(curves, _FURTHEST)
    if most == least == 0:
        return Interval(np.nan, np.nan, np.nan)
    if most > 0 > least:
        value = float(brentq(partial(_excess, curves), -_FURTHEST, _FURTHEST))
    else:
        value = _FURTHEST if least >= 0 else -_FURTHEST
    drawn = _permuted(curves, permutations)

    def is_rejected(log_ratio: float) -> bool:
        return _p(curves, log_ratio, drawn) <= 1 - level

    kept = (_last_kept(value, direction, is_rejected) for direction in (-1, 1))
    return Interval(*map(_ratio, (value, *kept)))


def _ratio(log_ratio: float) -> float:
    if abs(log_ratio) < _FURTHEST:
        return float(np.exp(log_ratio))
    return np.inf if log_ratio > 0 else 0.0


def spread_p(curves: Curves, permutations: int = PERMUTATIONS, seed: int = 0) -> float:
    """P-value of equal spreads: curves of a unit swap sides, after taking off their side's median.

    Two-sided, twice the smaller share, as that of few curves isn't symmetrical (Phipson and Smyth
    2010: the curves as they are count as one permutation).
    """
    return _p(curves, 0.0, _permuted(curves, permutations, seed))


def _shrunk(curves: Curves, log_ratio: float) -> tuple[Array, Array]:
    """Curves about their group's median, those of x divided by a ratio."""
    x, y = (each - np.median(each, axis=0) for each in (curves.x, curves.y))
    return x / np.exp(log_ratio), y


def _excess(curves: Curves, log_ratio: float) -> float:
    x, y = _shrunk(curves, log_ratio)
    how = curves.weights, curves.resolution
    return float(log_spread(x.T, *how) - log_spread(y.T, *how))


def swaps(units: int, count: int, seed: int = 0) -> NDArray[np.bool_]:
    """Which units swap sides in each permutation, (count, units)."""
    return np.random.default_rng(seed).random((count, units)) < 0.5


def _permuted(curves: Curves, count: int, seed: int = 0) -> NDArray[np.int64]:
    """Orders of all curves, (count, 2 n), in which units may have swapped sides."""
    runs, every = len(curves.x), np.arange(2 * len(curves.x))
    swapped = np.tile(swaps(runs, count, seed), 2)
    return np.where(swapped, (every + runs) % (2 * runs), every)


def _p(curves: Curves, log_ratio: float, drawn: NDArray[np.int64]) -> float:
    x, y = _shrunk(curves, log_ratio)
    how, by_step = (curves.weights, curves.resolution), np.concatenate((x, y)).T.copy()
    observed = _excess(curves, log_ratio)
    parts = np.array_split(drawn, -(-drawn.size * len(by_step) // _AT_ONCE))
    each = np.concatenate(
        [
            log_spread(mixed[..., : len(x)], *how) - log_spread(mixed[..., len(x) :], *how)
            for mixed in (by_step[:, orders] for orders in parts)
        ]
    )
    rounding = 1e-12 * abs(observed)
    beyond = (each >= observed - rounding).sum(), (each <= observed + rounding).sum()
    return float(min(1.0, 2 * (1 + min(beyond)) / (1 + len(drawn))))


def _last_kept(value: float, direction: int, is_rejected: Callable[[float], bool]) -> float:
    """The furthest logarithm of a ratio in a direction that isn't rejected, as far as is looked."""
    kept, step = value, 0.5
    while not is_rejected(beyond := value + direction * step):
        kept, step = beyond, 2 * step
        if step > _FURTHEST:
            return direction * _FURTHEST
    while abs(beyond - kept) > _CLOSE:
        middle = (kept + beyond) / 2
        kept, beyond = (kept, middle) if is_rejected(middle) else (middle, beyond)
    return kept


def _curves(pair: Pair) -> Curves:
    return Curves(pair.x.curves, pair.y.curves, pair.weights, pair.resolution)


BETTER = Claim(
    name="better",
    side=1,
    boundary=lambda pair, margin: 0.0,
    estimate=partial(difference, _returns),
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
    p_value=partial(_difference_p, _steps),
)
LESS_VARIABLE = Claim(
    name="less variable",
    side=-1,
    boundary=lambda pair, margin: 1.0,
    estimate=lambda pair, level: ratio_of_spreads(_curves(pair), level),
    tested=lambda pair, level: ratio_of_spreads(_curves(pair), level, PERMUTATIONS),
    p_value=lambda pair, boundary: spread_p(_curves(pair)),
)
CLAIMS = {claim.name: claim for claim in (BETTER, NOT_WORSE, FASTER, LESS_VARIABLE)}
