"""What a study could find, before its first run: least p-values, and power at given effects."""

from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from jbrep.stats.arms import FEWEST_UNITS
from jbrep.stats.claims import CLAIMS, FASTER, LESS_VARIANCE
from jbrep.stats.intervals import Bounds, difference_within
from jbrep.stats.rules import Planned, Rules, levels, most_failing
from jbrep.stats.spread import PERMUTATIONS, Curves, spread_p

_SDS = (0.05, 0.1, 0.2)
_RATIOS = (1 / 2, 1 / 3, 1 / 5)
_EARLIER = 0.1
_STUDIES = 2000
_STUDIES_OF_CURVES = 200
_LEAST_PERMUTATIONS = 999


class Arms(NamedTuple):
    """How many runs are planned of a representation and of the baseline."""

    runs: int  # of the representation
    units: int  # its encoders, if they are the units of tests, else its runs
    baseline: int  # units of the baseline


class Prospect(NamedTuple):
    """What can be found of a claim in a primary cell."""

    cell: str
    claim: str
    arms: Arms
    level: float  # of the test at the last look, if no other cell passes on its level
    least_p: float
    power: tuple[float, ...]  # at EFFECTS


def obstacle(rules: Rules, claim: str, arms: Arms) -> str | None:
    """Why no outcome could support a claim before another cell is decided; None if one could."""
    fewest = min(arms.units, arms.baseline)
    if fewest < FEWEST_UNITS:
        return f"a side has {fewest} runs or encoders, and verdicts take {FEWEST_UNITS}"
    level = _level(Planned(rules, (*range(arms.runs),)))
    first = "before another cell is decided, " if len(rules.primary) > 1 else ""
    if _least_p(claim) > level:
        return f"{first}its least p-value is {_least_p(claim):.2g}, above its level"
    most = most_failing(0, arms.units, level)
    if most > rules.failing:
        what = "encoders" if arms.units < arms.runs else "runs"
        return (
            f"{first}even if all {arms.units} {what} learn, up to {100 * most:.0f} % may fail, and "
            f"the limit is {100 * rules.failing:.0f} %; plan more, or set verdicts.failing"
        )
    return None


def prospects(planned: Planned, arms: Mapping[str, Arms]) -> Iterator[Prospect]:
    """What can be found of each claim in each primary cell, with its planned arms."""
    level = _level(planned)
    for cell in planned.rules.primary:
        for claim in planned.rules.claims:
            least = _least_p(claim)
            power = _power(claim, planned.rules.margin, arms[cell], level)
            yield Prospect(cell, claim, arms[cell], level, least, power)


def _level(planned: Planned) -> float:
    return levels(planned.shares, planned.rules.share)[-1]


def _least_p(claim: str) -> float:
    """Of random permutations, two-sided, which are fewer than all; that of a mean can be any."""
    return 2 / (PERMUTATIONS + 1) if claim == LESS_VARIANCE.name else 0.0


@lru_cache(256)
def _power(claim: str, margin: float, arms: Arms, level: float) -> tuple[float, ...]:
    if claim == LESS_VARIANCE.name:
        return tuple(_power_of_spread(ratio, arms, level) for ratio in _RATIOS)
    boundary = CLAIMS[claim].boundary(margin)
    share, effect = (1.0, _EARLIER) if claim == FASTER.name else (boundary, 1 - boundary)
    return tuple(_power_of_means(sd, share, effect, arms, level) for sd in _SDS)


def _power_of_means(sd: float, share: float, effect: float, arms: Arms, level: float) -> float:
    """How often the interval of mean(x) - share mean(y), which is the effect, lies above 0."""
    random = np.random.default_rng(0)
    x = random.normal(effect, sd, (_STUDIES, arms.units))
    y = random.normal(0, sd, (_STUDIES, arms.baseline))
    _, low, _ = difference_within(x, y, Bounds(), 1 - level, share)
    return float(np.mean(low > 0))


def _power_of_spread(ratio: float, arms: Arms, level: float) -> float:
    """How often the permutation test finds curves closer together by a ratio."""
    random = np.random.default_rng(0)
    count = max(_LEAST_PERMUTATIONS, min(PERMUTATIONS, int(5 / level)))
    found = 0
    for seed in range(_STUDIES_OF_CURVES):
        x, y = (random.normal(0, sd, (n, 1)) for sd, n in ((ratio, arms.units), (1, arms.baseline)))
        found += spread_p(Curves(x, y, np.ones(1), 0.01), seed, count) <= level
    return found / _STUDIES_OF_CURVES
