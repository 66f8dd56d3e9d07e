"""Do diagnostics predict learning? Final returns against what was measured of the codes."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jbrep.stats.analysis import GroupAnalysis
from jbrep.stats.bootstrap import Array, Interval
from jbrep.stats.ranks import rank_correlation

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
    """Each diagnostic with the final returns of each group, where both are known of some code.

    Args:
        groups: of a study.
        diagnosed: values of diagnostics, by name; None for one that isn't known.
        diagnostics: which ones, in order.
        seed: of the resamples.
    """
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
