"""Intervals of means of returns, and of their differences, that stay within what is possible.

Student's interval of a mean is taken on a scale on which the task's bounds are infinitely far away:
of the logit where returns have two bounds, of the logarithm where they have one (the delta method).
Intervals of several means are joined into that of their sum by Zou and Donner 2008, "Construction
of confidence limits about effect measures", Statistics in Medicine 27, which needs no equal
variances and keeps to the bounds as well.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.special import stdtrit

from jbrep.stats.bootstrap import Array, Interval
from jbrep.stats.intervals import constant

_LEAST_P, _MOST_P = 1e-12, 1 - 1e-12


class Bounds(NamedTuple):
    """The least and the largest possible return; infinite where unknown."""

    low: float = -np.inf
    high: float = np.inf


class Part(NamedTuple):
    """A mean in a sum, times a factor."""

    factor: float
    values: Array  # a value for each run, (..., n)


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


def sum_within(parts: Sequence[Part], bounds: Bounds, level: float) -> Interval:
    """The sum of means (...) times their factors, with its interval, (...).

    What doesn't vary adds nothing to the interval, which is NaN where nothing varies.
    """
    each = [(part.factor, _known(mean_within(part.values, bounds, level))) for part in parts]
    value = sum(factor * mean.value for factor, mean in each)
    downwards = sum((f * (m.value - (m.low if f > 0 else m.high))) ** 2 for f, m in each)
    upwards = sum((f * (m.value - (m.high if f > 0 else m.low))) ** 2 for f, m in each)
    low, high = value - np.sqrt(downwards), value + np.sqrt(upwards)
    return Interval(value, *(np.where(low < high, end, np.nan) for end in (low, high)))


def _known(mean: Interval) -> Interval:
    """Without width where the interval isn't known."""
    return Interval(mean.value, *(np.where(np.isnan(e), mean.value, e) for e in mean[1:]))


def p_of_sum(parts: Sequence[Part], bounds: Bounds, boundary: float) -> float:
    """The two-sided p-value of a sum of means (n,) lying on a boundary, by its intervals.

    It is 1 minus the level of the interval that ends there; NaN where nothing varies.
    """

    def room(p: float) -> float:
        value, low, high = sum_within(parts, bounds, 1 - p)
        return float(boundary - low if value > boundary else high - boundary)

    if np.isnan(room(0.5)):
        return np.nan
    if room(_LEAST_P) <= 0:
        return _LEAST_P
    return float(brentq(room, _LEAST_P, _MOST_P)) if room(_MOST_P) < 0 else 1.0
