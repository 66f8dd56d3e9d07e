"""Rank correlation over a few pairs of values."""

import numpy as np
from scipy.stats import rankdata

from jbrep.stats.bootstrap import Array, Interval
from jbrep.stats.intervals import UNDEFINED, percentile

FEWEST = 5  # pairs: with fewer, ranks agree by chance too often


def rank_correlation(x: Array, y: Array, seed: int = 0) -> Interval:
    """Spearman's rank correlation with its percentile bootstrap interval over pairs.

    Spearman 1904, "The proof and measurement of association between two things": Pearson's
    correlation of ranks, equal values sharing their mean rank. All is NaN for fewer than FEWEST
    pairs, and where x or y doesn't vary.

    In 300 samples each of normal pairs with correlations of 0, 0.6 and 0.9, the intervals covered
    88, 95 and 71 % for 5 pairs, 95, 96 and 98 % for 8, and 96, 97 and 98 % for 12: of five pairs in
    the same order the interval has no width, which says little.

    Args:
        x: finite values, (n,).
        y: as many.
        seed: of the resamples.
    """
    if len(x) < FEWEST or np.ptp(x) == 0 or np.ptp(y) == 0:
        return UNDEFINED
    return percentile(_of_ranks, np.stack((x, y)), seed=seed)


def _of_ranks(pairs: Array) -> Array:
    """Correlation of the ranks of x and y, (2, ..., n), over the last axis, (...)."""
    x, y = rankdata(pairs, axis=-1) - (pairs.shape[-1] + 1) / 2
    correlation: Array = (x * y).sum(-1) / np.sqrt((x * x).sum(-1) * (y * y).sum(-1))
    return correlation
