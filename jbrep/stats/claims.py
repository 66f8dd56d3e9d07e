"""What is claimed of a representation: how each claim is measured, and what is found of it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from jbrep.stats.arms import FEWEST_UNITS, Sides
from jbrep.stats.bootstrap import Interval
from jbrep.stats.intervals import Bounds, difference_within, p_of_difference, share_of_gain
from jbrep.stats.runs import Key
from jbrep.stats.spread import PERMUTATIONS, TO_SHOW, Curves, ratio_of_spreads, spread_p

SUPPORTED, CONTRADICTED, UNDECIDED = "supported", "contradicted", "undecided"
NOT_YET, EXPLORATORY = "not yet", "exploratory"


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What is found of a claim, of one representation against the baseline.

    No claim is supported or contradicted by fewer than FEWEST_UNITS units on either side.

    Raises:
        ValueError: it decides by too few units.
    """

    claim: str
    verdict: str  # SUPPORTED, CONTRADICTED, UNDECIDED, NOT_YET or EXPLORATORY
    estimate: Interval  # with its 95 % interval; without one for three runs or fewer
    boundary: float  # that the estimate is held against
    p: float  # two-sided, of lying on the boundary; NaN where there is none
    level: float  # of the last test, two-sided; NaN if there was none
    interval: Interval  # of 1 minus that level
    runs: tuple[int, int]  # of the representation and of the baseline that count
    encoders: int  # how many of the representation are the units of the test; 0 if its runs are
    look: int  # how many looks had come when it was decided or last tested; 0 if none
    reason: str | None  # why it is not decided, if not because the estimate is too rough

    def __post_init__(self) -> None:
        fewest = min(self.encoders or self.runs[0], self.runs[1])
        if self.verdict in (SUPPORTED, CONTRADICTED) and fewest < FEWEST_UNITS:
            raise ValueError(f"{self.claim!r} is {self.verdict} by {fewest} runs or encoders")


Verdicts = Mapping[Key, Mapping[str, tuple[Verdict, ...]]]  # then by representation


class Claim(NamedTuple):
    """A claim that runs on less state, x, support or contradict against the baseline's, y."""

    name: str  # in a few words
    side: int  # 1 if an estimate above the boundary speaks for the claim, -1 if one below does
    boundary: Callable[[float], float]  # of the estimate, given the margin
    # from both sides, the level of the interval and a seed
    estimate: Callable[[Sides, float, int], Interval]
    # the same with the interval that the test itself keeps
    tested: Callable[[Sides, float, int], Interval]
    # two-sided, of the estimand lying on the boundary, from sides, boundary and seed
    p_value: Callable[[Sides, float, int], float]
    is_ratio: bool = False  # whether the estimate is a ratio, whose logarithm is symmetrical
    # whether runs that fail to learn may forbid a verdict for the claim
    limits_failures: bool = False


def kept_gain(sides: Sides, level: float, seed: int = 0) -> Interval:
    """The gain of x over the reference as a share of that of y, with its interval."""
    x, y, frame = sides
    return share_of_gain(x.final, y.final, frame.reference, frame.bounds, level)


def _kept_p(sides: Sides, boundary: float, seed: int) -> float:
    x, y, frame = sides
    none_gained = (1 - boundary) * frame.reference
    return p_of_difference(x.final, y.final, frame.bounds, none_gained, boundary)


def time_lost(sides: Sides, level: float, seed: int = 0) -> Interval:
    """Steps that x takes more than y to half of y's gain, restricted to those of training."""
    x, y, frame = sides
    return difference_within(x.time, y.time, Bounds(0, frame.steps), level)


def _time_p(sides: Sides, boundary: float, seed: int) -> float:
    x, y, frame = sides
    return p_of_difference(x.time, y.time, Bounds(0, frame.steps), boundary)


def spread_ratio(
    sides: Sides, level: float, seed: int = 0, permutations: int = TO_SHOW
) -> Interval:
    """The spread of training curves of x over that of y."""
    return ratio_of_spreads(_curves(sides), level, seed, permutations)


def _spread_p(sides: Sides, boundary: float, seed: int) -> float:
    return spread_p(_curves(sides), seed)


def _curves(sides: Sides) -> Curves:
    x, y, frame = sides
    return Curves(x.curves, y.curves, frame.weights, frame.resolution)


NOT_WORSE = Claim(
    name="not worse",
    side=1,
    boundary=lambda margin: 1 - margin,
    estimate=kept_gain,
    tested=kept_gain,
    p_value=_kept_p,
    limits_failures=True,
)
WITHIN_HALF = NOT_WORSE._replace(
    name="within half the margin", boundary=lambda margin: 1 - margin / 2
)
LESS_VARIANCE = Claim(
    name="less variance",
    side=-1,
    boundary=lambda margin: 1.0,
    estimate=spread_ratio,
    tested=partial(spread_ratio, permutations=PERMUTATIONS),
    p_value=_spread_p,
    is_ratio=True,
)
FASTER = Claim(
    name="faster",
    side=-1,
    boundary=lambda margin: 0.0,
    estimate=time_lost,
    tested=time_lost,
    p_value=_time_p,
)
CLAIMS = {claim.name: claim for claim in (NOT_WORSE, LESS_VARIANCE, FASTER, WITHIN_HALF)}
