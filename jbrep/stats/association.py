"""Rank correlations over codes, for whether diagnostics predict learning."""

from collections.abc import Callable, Sequence

import numpy as np

from jbrep.stats.bootstrap import Array, Interval
from jbrep.stats.intervals import UNDEFINED, percentile

_FEWEST = 5  # pairs, or families for an interval: with fewer, ranks agree by chance too often


def rank_correlation(x: Array, y: Array, families: Sequence[str], seed: int = 0) -> Interval:
    """Spearman's rank correlation of finite x and y, (n,), with its percentile bootstrap interval.

    Spearman 1904, "The proof and measurement of association between two things": Pearson's
    correlation of ranks, equal values sharing their mean rank. All is NaN for fewer than five
    pairs, and where x or y doesn't vary.

    Codes of one family, such as the autoencoders of several sizes, are much alike, so whole
    families are resampled; of fewer than five there is no interval.

    In 300 samples each of normal pairs with correlations of 0, 0.6 and 0.9, the intervals covered
    88, 94 and 74 % for 5 codes, each a family, 97 % for 8, and 93, 97 and 98 % for 12: of five
    pairs in the same order the interval has no width, which says little. Of 8 families of two
    codes, which share .8 of the variance, they covered 95, 96 and 97 %.
    """
    if len(x) < _FEWEST or np.ptp(x) == 0 or np.ptp(y) == 0:
        return UNDEFINED
    found = over_families(lambda times: correlation_of_ranks(x, y, times), families, seed)
    return found if len({*families}) >= _FEWEST else UNDEFINED._replace(value=found.value)


def over_families(
    statistic: Callable[[Array], Array], families: Sequence[str], seed: int = 0
) -> Interval:
    """A statistic of codes that each come so many times, (..., n), resampled by families."""
    names, family = np.unique(families, return_inverse=True)
    numbers = np.arange(len(names), dtype=np.float64)

    def of_drawn(drawn: Array) -> Array:
        times = (drawn[..., None] == numbers).sum(axis=-2)
        return statistic(times[..., family])

    return percentile(of_drawn, numbers, seed=seed)


def correlation_of_ranks(x: Array, y: Array, times: Array) -> Array:
    """Correlation of the ranks of x and y, (n,), each pair so many times, (..., n); (...)."""
    x, y = _ranks(x, times), _ranks(y, times)
    correlation: Array = (times * x * y).sum(-1) / np.sqrt(
        (times * x * x).sum(-1) * (times * y * y).sum(-1)
    )
    return correlation


def _ranks(values: Array, times: Array) -> Array:
    """The mean rank of each value, (n,), that comes so many times, (..., n), about the middle."""
    above = np.sign(values[:, None] - values)  # of a value over each other one
    return times @ above.T / 2
