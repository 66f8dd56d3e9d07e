"""Do diagnostics predict learning? Final returns against what was measured of the codes."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import rankdata

from jbrep.stats.analysis import GroupAnalysis
from jbrep.stats.bootstrap import Array, Interval
from jbrep.stats.intervals import UNDEFINED, percentile

_FEWEST = 5  # pairs: with fewer, ranks agree by chance too often
Diagnosed = Mapping[tuple[str, str], Mapping[str, float | None]]  # by task and representation


class Diagnostic(NamedTuple):
    """A number of an encoder."""

    name: str
    words: str  # what it is
    better: int  # 1 if higher is better, -1 if lower is


class Association(NamedTuple):
    """A diagnostic of the codes of one task, and what one algorithm learned from them."""

    group: GroupAnalysis
    diagnostic: Diagnostic
    representations: tuple[str, ...]  # that it is known of, the full observation among them
    values: Array  # of the diagnostic, (n,)
    returns: Array  # mean final return over runs, (n,)
    correlation: Interval  # of ranks; positive if the better value goes with the higher return


def associations(
    groups: Iterable[GroupAnalysis],
    diagnosed: Diagnosed,
    diagnostics: Sequence[Diagnostic],
    seed: int = 0,
) -> list[Association]:
    """Each diagnostic with the final returns of each group, where both are known of some code."""
    result = []
    for group in groups:
        returns = {
            label.representation: float(label.numbers["final_return_mean"].value)
            for label in group.labels
        }
        for each in diagnostics:
            known = {
                name: value
                for name in returns
                if (value := diagnosed.get((group.task, name), {}).get(each.name)) is not None
            }
            if known:
                x, y = np.array(list(known.values())), np.array([returns[name] for name in known])
                correlation = rank_correlation(each.better * x, y, seed)
                result.append(Association(group, each, tuple(known), x, y, correlation))
    return result


def rank_correlation(x: Array, y: Array, seed: int = 0) -> Interval:
    """Spearman's rank correlation of finite x and y, (n,), with its percentile bootstrap interval.

    Spearman 1904, "The proof and measurement of association between two things": Pearson's
    correlation of ranks, equal values sharing their mean rank. All is NaN for fewer than five
    pairs, and where x or y doesn't vary.

    In 300 samples each of normal pairs with correlations of 0, 0.6 and 0.9, the intervals covered
    88, 95 and 71 % for 5 pairs, 95, 96 and 98 % for 8, and 96, 97 and 98 % for 12: of five pairs in
    the same order the interval has no width, which says little.
    """
    if len(x) < _FEWEST or np.ptp(x) == 0 or np.ptp(y) == 0:
        return UNDEFINED
    return percentile(_of_ranks, np.stack((x, y)), seed=seed)


def _of_ranks(pairs: Array) -> Array:
    """Correlation of the ranks of x and y, (2, ..., n), over the last axis, (...)."""
    x, y = rankdata(pairs, axis=-1) - (pairs.shape[-1] + 1) / 2
    correlation: Array = (x * y).sum(-1) / np.sqrt((x * x).sum(-1) * (y * y).sum(-1))
    return correlation
