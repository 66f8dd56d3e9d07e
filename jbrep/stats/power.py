"""How many seeds would decide an undecided claim, if the observed effect is the true one."""

import numpy as np

from jbrep.stats.bootstrap import Array
from jbrep.stats.first_claims import Claim, decide

SEEDS = (5, 10, 20, 40, 80, 160, 320)
POWER = 0.8
_STUDIES = 1000


def seeds_needed(
    claim: Claim, x: Array, y: Array, reference: float, level: float, seed: int = 0
) -> int | str:
    """The fewest seeds per representation with which four of five simulated studies are decided.

    The rule and the interval are those of the verdict; of the p-value only its smallest possible
    value is taken into account, so variances may need somewhat more. A simulated study draws the
    runs of both groups from the runs given.

    Args:
        claim: to be decided.
        x: a value for each run of the representation, (n,).
        y: a value for each run of the baseline, (m,).
        reference: the return that gains are counted from.
        level: of the interval.
        seed: of the simulated studies.
    """
    for count in SEEDS:
        if claim.least_p(count) > 1 - level:
            continue
        random = np.random.default_rng(seed)
        ours, theirs = _draw(x, count, random), _draw(y, count, random)
        boundary = claim.boundary(theirs, reference)
        decided = decide(claim, claim.interval(ours, theirs, level), boundary)
        if np.mean(decided != 0) >= POWER:
            return count
    return f"> {SEEDS[-1]}"


def _draw(values: Array, count: int, random: np.random.Generator) -> Array:
    """Studies with `count` runs each, (studies, count), drawn with replacement.

    The variance of the draws is (n - 1) / n of the runs' variance, so the draws are stretched about
    the mean to make up for it. A few runs don't show the tails of their distribution, which makes
    the result for variances rough: mostly within one step of SEEDS for normal returns, and blind to
    outliers that haven't occurred.
    """
    runs, mean = len(values), values.mean()
    stretched = mean + (values - mean) * np.sqrt(runs / (runs - 1))
    return stretched[random.integers(0, runs, (_STUDIES, count))]
