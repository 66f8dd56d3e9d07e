"""A representation's runs against the baseline's: numbers, and verdicts on the claims."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.stats import levene, rankdata

from jbrep.stats.bootstrap import Array, Interval
from jbrep.stats.claims import CONTRADICTED, EXPLORATORY, NOT_YET, SUPPORTED, Verdict
from jbrep.stats.intervals import (
    FEWEST_RUNS,
    LEVEL,
    Bounds,
    constant,
    difference_within,
    percentile,
    unless_few,
    variance_ratio,
)
from jbrep.stats.labels import RepresentationResult, median
from jbrep.stats.scale import STEPS_TO


@dataclass(frozen=True, eq=False)
class Comparison:
    """A representation against the baseline."""

    representation: str
    # differences, ratios and the probability of improvement, by name, each with its 95 % interval
    numbers: Mapping[str, Interval]
    brown_forsythe_p: float  # of equal variances of final returns; NaN where it is undefined
    verdicts: tuple[Verdict, ...]  # one for each claim
    looks: int  # after which there may be verdicts
    runs: tuple[int, int]  # of the representation and of the baseline

    @property
    def is_open(self) -> bool:
        """Whether all runs may be looked at: no verdict is still to come on more of them."""
        states = {verdict.verdict for verdict in self.verdicts}
        if NOT_YET in states:
            return False
        is_done = CONTRADICTED in states or states <= {SUPPORTED, EXPLORATORY}
        was_last = max(verdict.look for verdict in self.verdicts) == self.looks
        return is_done or was_last or self.counts_all

    @property
    def counts_all(self) -> bool:
        """Whether its verdicts count all runs."""
        return all(verdict.runs == self.runs for verdict in self.verdicts)

    @property
    def is_judged(self) -> bool:
        """Whether it has verdicts: it isn't exploratory."""
        return any(verdict.verdict != EXPLORATORY for verdict in self.verdicts)


def compare(
    label: RepresentationResult,
    baseline: RepresentationResult,
    verdicts: tuple[Verdict, ...],
    looks: int,
    bounds: Bounds,
    seed: int,
) -> Comparison:
    """A representation against the baseline of the same task and algorithm, by bounded returns.

    Verdicts may come after so many looks.
    """
    pairs = {name: (label.by_run[name], baseline.by_run[name]) for name in label.by_run}
    finals, runs = pairs["final_return"], (len(label.seeds), len(baseline.seeds))
    numbers = {}
    for name in ("final_return", "mean_return"):
        difference = difference_within(*pairs[name], bounds, LEVEL)
        numbers[f"{name}_difference"] = unless_few(difference, *runs)
    numbers["variance_ratio"] = unless_few(variance_ratio(*finals), *runs)
    for name, statistic in (
        ("variance_ratio_bootstrap", _ratio_of_variances),
        ("probability_of_improvement", probability_of_improvement),
    ):
        numbers[name] = percentile(statistic, *finals, seed=seed)
    for name in STEPS_TO:
        numbers[f"{name}_ratio"] = percentile(_ratio_of_medians, *pairs[name], seed=seed)
    return Comparison(
        representation=label.representation,
        numbers=numbers,
        brown_forsythe_p=_brown_forsythe(*finals),
        verdicts=verdicts,
        looks=looks,
        runs=runs,
    )


def probability_of_improvement(x: Array, y: Array) -> Array:
    """The share of pairs in which a run of x (..., n) beats one of y (..., m); ties count half.

    Mann and Whitney's statistic, as in Agarwal et al. 2021, "Deep Reinforcement Learning at the
    Edge of the Statistical Precipice".
    """
    n, m = x.shape[-1], y.shape[-1]
    ranks = rankdata(np.concatenate((x, y), axis=-1), axis=-1)[..., :n]
    return (ranks.sum(axis=-1) - n * (n + 1) / 2) / (n * m)


def _ratio_of_variances(x: Array, y: Array) -> Array:
    return x.var(axis=-1, ddof=1) / y.var(axis=-1, ddof=1)


def _ratio_of_medians(x: Array, y: Array) -> Array:
    return median(x) / median(y)


def _brown_forsythe(x: Array, y: Array) -> float:
    if constant(x) or constant(y) or min(len(x), len(y)) < FEWEST_RUNS:
        return np.nan
    return float(levene(x, y, center="median").pvalue)
