"""How much of the spread of returns is the encoders' and how much the runs', if each has several.

The return of a run is a mean plus what its encoder adds plus what the run adds, each with a
variance of its own: the one-way random effects model (Searle, Casella and McCulloch 1992, "Variance
Components"). The estimates are those of the analysis of variance, cut off at 0. Intervals assume
normal distributions.
"""

from typing import NamedTuple

import numpy as np
from scipy.stats import chi2, f

from jbrep.stats.bootstrap import Array, Interval
from jbrep.stats.intervals import LEVEL

_TAILS = (1 + LEVEL) / 2, (1 - LEVEL) / 2


class Components(NamedTuple):
    """Variances, each with its interval."""

    encoders: Interval  # of what encoders add
    runs: Interval  # of what runs add
    ratio: Interval  # of the first to the second


def components(returns: Array) -> Components:
    """The variance components of returns.

    The interval of the runs' variance is that of chi-squared, the ratio's is exact (Searle, Casella
    and McCulloch, section 3.6), and the encoders' is the one of Ting et al. 1990, "Confidence
    intervals on linear combinations of variance components that are unrestricted in sign", Journal
    of Statistical Computation and Simulation 35. As variances aren't negative, none ends below 0.

    Args:
        returns: a row for each encoder, a column for each of its runs, (e, r): at least two each.
    """
    encoders, runs = returns.shape
    freedom = encoders - 1, encoders * (runs - 1)
    between = runs * float(returns.mean(axis=1).var(ddof=1))
    within = float(returns.var(axis=1, ddof=1).mean())
    of_runs = Interval(
        within, *(within * freedom[1] / chi2.ppf(tail, freedom[1]) for tail in _TAILS)
    )
    quotient = between / within if within else np.inf
    ratios = (quotient / f.ppf(tail, *freedom) for tail in _TAILS)
    ratio = (max((each - 1) / runs, 0.0) for each in (quotient, *ratios))
    below, above = _half_widths(between, within, freedom)
    difference = between - within
    ends = (difference, difference - below, difference + above)
    of_encoders = (max(end / runs, 0.0) for end in ends)
    return Components(Interval(*of_encoders), of_runs, Interval(*ratio))


def _half_widths(between: float, within: float, freedom: tuple[int, int]) -> tuple[float, float]:
    """Of the interval of a difference of mean squares: to below and to above."""
    high, low = _TAILS
    g1, g2 = (1 - n / chi2.ppf(high, n) for n in freedom)
    h1, h2 = (n / chi2.ppf(low, n) - 1 for n in freedom)
    f_high, f_low = f.ppf(high, *freedom), f.ppf(low, *freedom)
    g12 = ((f_high - 1) ** 2 - (g1 * f_high) ** 2 - h2**2) / f_high
    h12 = ((1 - f_low) ** 2 - (h1 * f_low) ** 2 - g2**2) / f_low
    product = between * within
    return (
        float(np.sqrt(max((g1 * between) ** 2 + (h2 * within) ** 2 + g12 * product, 0))),
        float(np.sqrt(max((h1 * between) ** 2 + (g2 * within) ** 2 + h12 * product, 0))),
    )
