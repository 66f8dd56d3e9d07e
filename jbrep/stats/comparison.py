"""A representation's runs against the baseline's, in numbers."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.stats import levene, rankdata

from jbrep.stats.bootstrap import Array, Interval
from jbrep.stats.claims import FASTER, LESS_VARIABLE
from jbrep.stats.curves import Compared
from jbrep.stats.intervals import (
    FEWEST_RUNS,
    LEVEL,
    UNDEFINED,
    Bounds,
    constant,
    mean_within,
    percentile,
    share_of_gain,
    unless_few,
    variance_ratio,
)
from jbrep.stats.labels import RepresentationResult, median
from jbrep.stats.pairs import Pair, paired
from jbrep.stats.scale import STEPS_TO

_PAIRED = (
    *("final_return_difference", "score_difference", "mean_return_difference"),
    *("share_of_gain", "steps_later", "spread_ratio"),
)


@dataclass(frozen=True, eq=False)
class Comparison:
    """A representation against the baseline."""

    representation: str
    # differences, ratios and the probability of improvement, by name, each with its 95 % interval
    numbers: Mapping[str, Interval]
    brown_forsythe_p: float  # of equal variances of final returns; NaN where it is undefined
    shared: int  # seeds of both, over which differences are taken
    by_encoder: bool  # whether that is over encoders


def compare(
    label: RepresentationResult, baseline: RepresentationResult, known: Compared, seed: int
) -> Comparison:
    """A representation against the baseline of the same task and algorithm."""
    pairs = {name: (label.by_run[name], baseline.by_run[name]) for name in label.by_run}
    finals, runs = pairs["final_return"], (len(label.seeds), len(baseline.seeds))
    found = paired(known, label.representation, baseline.representation)
    numbers = _differences(found, seed) if found else dict.fromkeys(_PAIRED, UNDEFINED)
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
        shared=found.runs if found else 0,
        by_encoder=found is not None and found.by_encoder,
    )


def _differences(pair: Pair, seed: int) -> dict[str, Interval]:
    """What is compared unit by unit; shares of gains and ratios only where the baseline learned."""
    x, y = pair.x, pair.y
    score = pair.ends.score(x.final) - pair.ends.score(y.final)
    every = (
        mean_within(x.final - y.final, Bounds(), LEVEL),
        mean_within(score, Bounds(), LEVEL),
        mean_within(x.mean - y.mean, Bounds(), LEVEL),
        *(
            (
                share_of_gain(x.final, y.final, pair.ends.blind, LEVEL),
                FASTER.estimate(pair, LEVEL, seed),
                LESS_VARIABLE.estimate(pair, LEVEL, seed),
            )
            if pair.y_learns
            else [UNDEFINED] * 3
        ),
    )
    return {n: unless_few(e, pair.units) for n, e in zip(_PAIRED, every, strict=True)}


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
