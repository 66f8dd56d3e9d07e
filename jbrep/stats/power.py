"""How many seeds would decide what is undecided, if the effect observed is the true one."""

import numpy as np

from jbrep.stats.bootstrap import Array
from jbrep.stats.claims import Claim, decide

SEEDS = (5, 10, 20, 40, 80, 160, 320)
POWER = 0.8
_STUDIES = 1000


def seeds_needed(claim: Claim, x: Array, y: Array, level: float, seed: int = 0) -> int | str:
    """The fewest seeds a label with which four of five simulated studies are decided.

    The rule and its interval are those of the verdict; of its p-value only the least possible is
    heeded, so that variances may take rather more. A study draws runs of both groups from those
    there are.

    Args:
        claim: what is to be decided.
        x: a value for each run of the representation, (n,).
        y: for each run of the baseline, (m,).
        level: of the interval.
        seed: of the studies.
    """
    for count in SEEDS:
        if claim.least_p(count) > 1 - level:
            continue
        random = np.random.default_rng(seed)
        ours, theirs = _draw(x, count, random), _draw(y, count, random)
        decided = decide(claim, claim.interval(ours, theirs, level), claim.boundary(theirs))
        if np.mean(decided != 0) >= POWER:
            return count
    return f"> {SEEDS[-1]}"


def _draw(values: Array, count: int, random: np.random.Generator) -> Array:
    """Studies of that many runs, (studies, count), drawn with replacement.

    Draws vary less than the runs' variance says, by (n - 1) / n, so they are stretched about the
    mean by its root. Of a few runs they never have the tails, which makes numbers for variances
    rough: mostly within a step of SEEDS for normal returns, and blind to outliers none of them was.
    """
    runs, mean = len(values), values.mean()
    stretched = mean + (values - mean) * np.sqrt(runs / (runs - 1))
    return stretched[random.integers(0, runs, (_STUDIES, count))]
