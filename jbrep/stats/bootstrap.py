"""Intervals from resampling whole episodes, as the rows of one episode are not independent."""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

RESAMPLES = 1000
_SEED = 0
_BOUNDS = (2.5, 97.5)  # [%]


class Interval(NamedTuple):
    """A value with its interval."""

    value: Any
    low: Any
    high: Any

    def tolist(self) -> list[Any]:
        """Lists (..., 3) for JSON: value, low, high; None for what isn't finite."""
        stacked = np.stack([np.asarray(part, float) for part in self], axis=-1)
        return without_nan(stacked.tolist())


def without_nan(values: Any) -> Any:
    """Numbers in nested lists, with None in place of those that aren't finite."""
    if isinstance(values, list):
        return [without_nan(value) for value in values]
    return values if math.isfinite(values) else None


def bootstrap(statistic: Callable[..., ArrayLike], *sums: Array) -> Interval:
    """A statistic of sums over all episodes with its interval, which is NaN for one episode.

    The resamples depend on the number of episodes alone, so statistics of the same episodes are
    compared on the same resamples. A statistic maps sums over episodes, (..., k) each, to values,
    (...); the sums are for each episode, (episodes, ...) each.
    """
    count = len(sums[0])
    weights = _weights(count)
    with np.errstate(divide="ignore", invalid="ignore"):
        values = np.asarray(statistic(*(np.tensordot(weights, s, 1) for s in sums)))
    if count < 2:
        return Interval(values[0], values[0] * np.nan, values[0] * np.nan)
    return Interval(values[0], *np.percentile(values[1:], _BOUNDS, axis=0))


@lru_cache(4)
def _weights(count: int) -> Array:
    """How often each episode counts: once in the first row, then as often as it was drawn."""
    draws = np.random.default_rng(_SEED).multinomial(count, np.full(count, 1 / count), RESAMPLES)
    return np.concatenate((np.ones((1, count)), draws))


def by_episode(values: NDArray[Any], episode: NDArray[np.int64], count: int) -> Array:
    """Sums of rows (n, ...) over the rows of each episode, (count, ...); zero of one without rows.

    `episode` has that of each row, (n,), in ascending order.
    """
    sums = np.zeros((count, *values.shape[1:]))
    if len(values):
        starts = np.flatnonzero(np.diff(episode, prepend=-1))
        sums[episode[starts]] = np.add.reduceat(values, starts, axis=0, dtype=np.float64)
    return sums


def variation(total: Array, squares: Array, rows: Array) -> Array:
    """The sum of squared deviations from the mean, from the sums of values and of their squares.

    0 where it is no more than rounding.
    """
    deviations = squares - total**2 / rows
    return np.where(deviations > 1e-9 * squares, deviations, 0)


def r_squared(residual: Array, about_mean: Array) -> Array:
    """1 - residual / variation; NaN where nothing varies."""
    return np.where(about_mean > 0, 1 - residual / about_mean, np.nan)
