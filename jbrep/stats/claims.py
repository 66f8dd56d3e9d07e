"""What is claimed of a representation: how each claim is measured, and what would decide it."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from jbrep.stats.arms import Arm, Frame
from jbrep.stats.bootstrap import Interval
from jbrep.stats.means import Bounds, Part, p_of_sum, sum_within
from jbrep.stats.spread import PERMUTATIONS, TO_SHOW, Curves, ratio_of_spreads, spread_p
from jbrep.stats.verdict import Statement

_FURTHEST = 1e3  # shares of a gain that are looked for


class Claim(NamedTuple):
    """A claim that runs on less state, x, support or contradict against those of the baseline, y.

    Attributes:
        name: in a few words.
        statement: the claim as a sentence, with a place for the percentage that may be lost.
        estimand: what is estimated, in words.
        side: 1 if an estimate above the boundary speaks for the claim, -1 if one below does.
        boundary: of the estimate, given the margin.
        estimate: from x, y, their frame, the level of the interval and a seed.
        tested: the same with the interval that the test itself keeps.
        p_value: two-sided, of the estimand lying on the boundary, from x, y, frame, boundary, seed.
    """

    name: str
    statement: str
    estimand: str
    side: int
    boundary: Callable[[float], float]
    estimate: Callable[[Arm, Arm, Frame, float, int], Interval]
    tested: Callable[[Arm, Arm, Frame, float, int], Interval]
    p_value: Callable[[Arm, Arm, Frame, float, int], float]

    def in_words(self, margin: float) -> Statement:
        """What is claimed, given the margin."""
        percent = f"{100 * (1 - self.boundary(margin)):.3g} %"
        statement = self.statement.format(percent)
        return Statement(self.name, statement, self.estimand, self.estimate is spread_ratio)


def kept_gain(x: Arm, y: Arm, frame: Frame, level: float, seed: int = 0) -> Interval:
    """The gain of x over standing still as a share of that of y, with its interval.

    The interval has the shares c with which the interval of mean(x) - c mean(y) has what standing
    still would give (Fieller 1954), as far as they are looked for: an end is 1,000 or -1,000
    where y may not gain anything.
    """
    gained, of_y = x.final.mean() - frame.still, y.final.mean() - frame.still
    if of_y <= 0:
        return Interval(np.nan, np.nan, np.nan)
    value = float(gained / of_y)

    def room(share: float, direction: int) -> float:
        parts = (Part(1, x.final), Part(-share, y.final))
        _, low, high = sum_within(parts, frame.bounds, level)
        return float((low if direction < 0 else high) - (1 - share) * frame.still) * direction

    return Interval(value, *(_end(room, value, direction) for direction in (-1, 1)))


def _end(room: Callable[[float, int], float], value: float, direction: int) -> float:
    """The share in a direction from which on the interval is on one side; NaN if it has none."""
    if np.isnan(room(value, direction)):
        return np.nan
    step = 0.25
    while step < _FURTHEST:
        if room(value + direction * step, direction) < 0:
            return float(brentq(room, value, value + direction * step, (direction,)))
        step *= 2
    return direction * _FURTHEST


def _kept_p(x: Arm, y: Arm, frame: Frame, boundary: float, seed: int) -> float:
    parts = (Part(1, x.final), Part(-boundary, y.final))
    return p_of_sum(parts, frame.bounds, (1 - boundary) * frame.still)


def time_lost(x: Arm, y: Arm, frame: Frame, level: float, seed: int = 0) -> Interval:
    """Steps that x takes more than y to half of y's gain, restricted to those of training."""
    return sum_within((Part(1, x.time), Part(-1, y.time)), Bounds(0, frame.steps), level)


def _time_p(x: Arm, y: Arm, frame: Frame, boundary: float, seed: int) -> float:
    parts = (Part(1, x.time), Part(-1, y.time))
    return p_of_sum(parts, Bounds(0, frame.steps), boundary)


def spread_ratio(
    x: Arm, y: Arm, frame: Frame, level: float, seed: int = 0, permutations: int = TO_SHOW
) -> Interval:
    """The spread of training curves of x over that of y."""
    return ratio_of_spreads(_curves(x, y, frame), level, seed, permutations)


def _spread_p(x: Arm, y: Arm, frame: Frame, boundary: float, seed: int) -> float:
    return spread_p(_curves(x, y, frame), seed)


def _curves(x: Arm, y: Arm, frame: Frame) -> Curves:
    return Curves(x.curves, y.curves, frame.weights, frame.resolution)


_KEPT = "gain over standing still, as a share of that on the full state"
NOT_WORSE = Claim(
    name="not worse",
    statement="Agents on less state lose at most {} of the gain",
    estimand=_KEPT,
    side=1,
    boundary=lambda margin: 1 - margin,
    estimate=kept_gain,
    tested=kept_gain,
    p_value=_kept_p,
)
WITHIN_HALF = Claim(
    name="within half the margin",
    statement="They lose at most {} of it",
    estimand=_KEPT,
    side=1,
    boundary=lambda margin: 1 - margin / 2,
    estimate=kept_gain,
    tested=kept_gain,
    p_value=_kept_p,
)
LESS_VARIANCE = Claim(
    name="less variance",
    statement="Their training varies less from run to run",
    estimand="spread of training curves, as a multiple of that on the full state",
    side=-1,
    boundary=lambda margin: 1.0,
    estimate=spread_ratio,
    tested=partial(spread_ratio, permutations=PERMUTATIONS),
    p_value=_spread_p,
)
FASTER = Claim(
    name="faster",
    statement="They learn faster",
    estimand="steps to half of the full agents' gain, beyond what these take",
    side=-1,
    boundary=lambda margin: 0.0,
    estimate=time_lost,
    tested=time_lost,
    p_value=_time_p,
)
CLAIMS = {claim.name: claim for claim in (NOT_WORSE, LESS_VARIANCE, FASTER, WITHIN_HALF)}
