"""Intervals over runs, each by the method that covered best in simulations.

Coverage [%] of 95 % intervals for 5, 10 and 20 runs per group, drawn from a normal distribution,
from a skewed one (1000 minus a gamma variable of shape 2), and from Student's t distribution with 5
degrees of freedom (600 to 40,000 samples each):

                                         normal              skewed              heavy tails
    mean: Student's t                    94.9  93.8  95.1    91.3  93.4  93.1    96.4  95.3  95.7
      bootstrap-t                        94.7  93.3  95.0    92.9  95.4  93.9    94.5  93.0  93.8
      percentile bootstrap               83.5  88.9  92.3    80.1  89.5  90.9    84.3  89.5  92.0
    ratio of variances: Bonett's         97.9  96.1  95.5    97.2  95.5  95.2    97.0  95.7  95.2
      with variances of 4 to 1           97.1  95.4  96.2    96.3  94.0  93.9    96.0  93.8  94.1
      bootstrap-t of jackknife errors    98.0  93.9  94.0    96.5  91.0  93.0    97.2  94.4  92.1
      percentile bootstrap               96.9  93.4  92.0    95.6  88.5  90.4    95.5  92.1  90.0
    SD: Bonett's                         99.5  95.7  94.9    98.7  93.1  90.3    98.9  95.2  91.9
      percentile bootstrap               63.6  76.7  85.9    52.3  65.1  75.1    54.5  68.3  76.5
    median: percentile bootstrap         93.7  92.3  94.8    93.4  94.1  92.9    93.6  93.1  93.9
    IQM: percentile bootstrap            89.5  92.2  94.5    89.7  94.9  93.6    89.7  93.3  94.7
    P(improvement): the same             90.2  92.8  94.8    89.8  94.0  94.2    91.3  93.8  94.3
      with means an SD apart             84.8  91.5  94.3    86.0  91.2  94.5    84.2  91.5  92.0
    IQR: percentile bootstrap            86.8  94.6  97.3    82.5  93.4  94.5    87.1  97.3  97.0
    MAD: percentile bootstrap            66.9  94.1  97.3    67.1  92.5  94.8    72.1  95.9  96.9

So with five runs a percentile interval is too short. It is kept where the literature uses it, so
that numbers can be compared (Agarwal et al. 2021); no verdict depends on one. With five runs the
interval of a ratio of variances is wide: it extends by a factor of ten to both sides.

No interval covers returns of which some are near 900 with an SD of 20, from runs that learn, and
the others near 50, from runs that don't (40,000 samples each):

                                         a tenth don't       a fifth don't
    mean: Student's t                    40.9  65.0  87.6    66.2  88.7  91.9
    ratio of variances: Bonett's         55.9  54.7  78.0    58.8  80.8  94.4
      of 99.44 %                         94.6  80.7  85.3    93.4  86.5  97.1

because a group in which all runs happen to learn seems to vary little. That is why no verdict
depends on a ratio of variances, and why those on returns must hold even if as many runs failed as
can't be excluded (`jbrep.stats.rules`).

Intervals of means stay within what is possible: Student's is taken on a scale on which the task's
bounds are infinitely far away, of the logit where returns have two bounds, of the logarithm where
they have one (the delta method). Differences are taken within units (`jbrep.stats.pairs`), under
Student's t. Of eight encoders with one, two or four runs each, compared with a baseline on the same
seeds, intervals of 95 % over differences covered [%], beside what could be done instead
(`python benchmarks/coverage.py`; 4,000 samples each):

                                              encoders           runs, paired       runs, unpaired
    runs differ                           95.2  95.1  95.2    95.2  94.8  95.3    97.1  95.9  95.5
    seeds have 0.6 of the variance        95.2  95.1  95.2    95.2  94.8  95.3    99.7  99.8  99.8
    encoders have 0.6 of it               95.6  95.2  95.2    95.6  91.7  84.7    96.7  92.4  85.2
    0.4 each                              95.5  95.2  95.2    95.5  91.3  83.9    99.2  97.9  92.3
      skewed                              95.3  94.8  95.6    95.3  90.7  84.0    99.2  97.1  93.6
      a tenth fails                       95.2  94.8  95.5    95.2  90.0  82.4    99.0  97.2  92.3

A nested bootstrap of encoders and their runs covered 87 to 98.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit
from scipy.stats import norm, trim_mean

from jbrep.stats.bootstrap import Array, Interval

LEVEL = 0.95
RESAMPLES = 2000
UNDEFINED = Interval(np.nan, np.nan, np.nan)
_FEWEST_FOR_RATIOS = 3  # with two runs Bonett's interval of a ratio covers 86 %
FEWEST_RUNS = 4  # for an interval: three or fewer are better shown as points


def percentile(statistic: Callable[..., Array], *samples: Array, seed: int = 0) -> Interval:
    """A statistic with its 95 % percentile interval, from a stratified bootstrap over whole runs.

    Resamples in which the statistic is undefined widen the interval at both ends. Of fewer runs
    than FEWEST_RUNS in a sample there is no interval: it is NaN. A statistic maps samples with runs
    on the last axis, (..., n) each, to values, (...); each is resampled on its own.
    """
    if min(sample.shape[-1] for sample in samples) < FEWEST_RUNS:
        with np.errstate(divide="ignore", invalid="ignore"):
            value = statistic(*samples)
        return Interval(value, value * np.nan, value * np.nan)
    random = np.random.default_rng(seed)
    drawn = []
    for sample in samples:
        runs = sample.shape[-1]
        drawn.append(sample[..., random.integers(0, runs, (RESAMPLES, runs))])
    with np.errstate(divide="ignore", invalid="ignore"):
        value, values = statistic(*samples), statistic(*drawn)
    unknown = np.isnan(values)
    low, high = (
        np.quantile(np.where(unknown, worst, values), q, axis=-1, method="inverted_cdf")
        for q, worst in (((1 - LEVEL) / 2, -np.inf), ((1 + LEVEL) / 2, np.inf))
    )
    return Interval(value, low, high)


def unless_few(interval: Interval, *runs: int) -> Interval:
    """An interval, or its value alone where a sample has fewer runs than FEWEST_RUNS."""
    return interval if min(runs) >= FEWEST_RUNS else UNDEFINED._replace(value=interval.value)


def constant(values: Array) -> NDArray[np.bool_]:
    """Whether values (..., n) differ by no more than rounding, (...)."""
    return np.ptp(values, axis=-1) <= 1e-9 * np.abs(values).max(axis=-1)


def deviation(values: Array) -> Interval:
    """The standard deviation of (n,) with Bonett's 95 % interval.

    Bonett 2006, "Approximate confidence interval for standard deviation of nonnormal
    distributions", Computational Statistics & Data Analysis 50: an interval of the log variance,
    with a kurtosis about a trimmed mean. It is NaN for fewer runs than FEWEST_RUNS, and where
    nothing varies.
    """
    runs, value = len(values), values.std(ddof=1)
    if runs < FEWEST_RUNS or constant(values):
        return Interval(value, np.nan, np.nan)
    quartic, squares = _moments(values)
    z = norm.ppf((1 + LEVEL) / 2)
    correction = runs / (runs - z)
    half = z * correction * np.sqrt(_log_error(runs * quartic / squares**2, runs))
    centre = math.log(correction * value**2)
    return Interval(value, np.exp((centre - half) / 2), np.exp((centre + half) / 2))


def variance_ratio(x: Array, y: Array, level: float = LEVEL) -> Interval:
    """The variance of x (..., n) over that of y (..., m), with Bonett's interval, (...).

    Bonett 2006, "Robust confidence interval for a ratio of standard deviations", Applied
    Psychological Measurement 30: a normal interval of the log ratio, whose error has the kurtosis
    pooled over both groups. His correction for groups of unequal size is left out, as it breaks
    down for levels near 1. The interval is NaN where a group has only two runs or doesn't vary.
    """
    n, m = x.shape[-1], y.shape[-1]
    (quartic_x, squares_x), (quartic_y, squares_y) = _moments(x), _moments(y)
    known = ~constant(x) & ~constant(y) & (min(n, m) >= _FEWEST_FOR_RATIOS)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = (squares_x / (n - 1)) / (squares_y / (m - 1))
        kurtosis = (n + m) * (quartic_x + quartic_y) / (squares_x + squares_y) ** 2
        error = np.sqrt(_log_error(kurtosis, n) + _log_error(kurtosis, m))
        half = np.where(known, norm.ppf((1 + level) / 2) * error, np.nan)
        return Interval(value, value * np.exp(-half), value * np.exp(half))


def _moments(values: Array) -> tuple[Array, Array]:
    """Sums over (..., n) of fourth powers about a trimmed mean, and of squares about the mean."""
    n = values.shape[-1]
    # for five runs Bonett trims half of them off each end, that is, all but the median
    trimmed = 0.5 / math.sqrt(max(n - 4, 2))
    centre = np.median(values, axis=-1) if n < 6 else trim_mean(values, trimmed, axis=-1)
    return ((values - centre[..., None]) ** 4).sum(axis=-1), n * values.var(axis=-1)


def _log_error(kurtosis: Array, n: int) -> Array:
    return (kurtosis - (n - 3) / n) / (n - 1)


class Bounds(NamedTuple):
    """The least and the largest possible return; infinite where unknown."""

    low: float = -np.inf
    high: float = np.inf

    @classmethod
    def of(cls, low: float | None, high: float | None) -> "Bounds":
        """Bounds of which either may be unknown."""
        return cls(-np.inf if low is None else low, np.inf if high is None else high)


def mean_within(values: Array, bounds: Bounds, level: float) -> Interval:
    """The mean of (..., n) with its interval, (...); NaN where nothing varies."""
    runs, mean = values.shape[-1], values.mean(axis=-1)
    deviation = values.std(axis=-1, ddof=1) if runs > 1 else np.nan
    error = np.where(constant(values), np.nan, deviation / np.sqrt(runs))
    half = stdtrit(runs - 1, (1 + level) / 2) * error
    above, below = mean - bounds.low, bounds.high - mean
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        if np.isinf(bounds.low) and np.isinf(bounds.high):
            return Interval(mean, mean - half, mean + half)
        if np.isinf(bounds.high):
            factor = np.exp(half / above)
            return Interval(mean, bounds.low + above / factor, bounds.low + above * factor)
        if np.isinf(bounds.low):
            factor = np.exp(half / below)
            return Interval(mean, bounds.high - below * factor, bounds.high - below / factor)
        odds, width = above / below, bounds.high - bounds.low
        factor = np.exp(half * (1 / above + 1 / below))
        low, high = odds / factor, odds * factor
        return Interval(mean, *(bounds.low + width / (1 + 1 / each) for each in (low, high)))


def surely_above(values: Array, least: float, bounds: Bounds) -> bool:
    """Whether a mean lies above a number: its interval does, or each of few values (n,)."""
    if len(values) < FEWEST_RUNS or constant(values):
        return bool(values.min() > least)
    return bool(mean_within(values, bounds, LEVEL).low > least)


def share_of_gain(x: Array, y: Array, reference: float, level: float) -> Interval:
    """The gain of x (n,) over a reference as a share of that of y (n,), with its interval.

    Units are paired. The interval has the shares c for which Student's interval of the mean of
    x - reference - c (y - reference) holds 0 (Fieller 1954). An end is infinite where y may not
    gain anything; all is NaN where it doesn't, and ends are where nothing varies.
    """
    gains = np.stack((x - reference, y - reference))
    of_x, of_y = gains.mean(axis=1)
    if of_y <= 0:
        return UNDEFINED
    quantile = stdtrit(len(x) - 1, (1 + level) / 2)
    (xx, xy), (_, yy) = quantile**2 * np.cov(gains) / len(x)
    a, b, c = of_y**2 - yy, of_x * of_y - xy, of_x**2 - xx
    value = float(of_x / of_y)
    if constant(x) and constant(y):
        return UNDEFINED._replace(value=value)
    if a <= 0:
        return Interval(value, -np.inf, np.inf)
    half = math.sqrt(max(b * b - a * c, 0.0))
    return Interval(value, float(b - half) / a, float(b + half) / a)
