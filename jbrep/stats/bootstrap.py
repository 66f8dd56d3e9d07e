"""Intervals from resampling whole episodes: rows of one episode are no independent samples."""

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
    """A value with its interval: of 95 %, from a percentile bootstrap, unless said otherwise."""

    value: Any
    low: Any
    high: Any

    def tolist(self) -> list[Any]:
        """For JSON, [value, low, high] last; None where it isn't finite."""
        stacked = np.stack([np.asarray(part, float) for part in self], axis=-1)
        return without_nan(stacked.tolist())


def without_nan(values: Any) -> Any:
    """Numbers in lists of lists, None in place of those that aren't finite."""
    if isinstance(values, list):
        return [without_nan(value) for value in values]
    return values if math.isfinite(values) else None


def bootstrap(
    statistic: Callable[..., ArrayLike], *sums: Array, resamples: int = RESAMPLES
) -> Interval:
    """A statistic of sums over all episodes, with its interval; NaN for that of one episode.

    The same resamples come for every call on as many episodes, so what is compared is compared on
    the same episodes.

    Args:
        statistic: what the sums over the episodes, (..., k) each, give, (...).
        sums: per episode, (episodes, ...) each.
        resamples: how many draws of as many episodes as there are, with replacement.
    """
    count = len(sums[0])
    weights = _weights(count, resamples)
    with np.errstate(divide="ignore", invalid="ignore"):
        values = np.asarray(statistic(*(np.tensordot(weights, s, 1) for s in sums)))
    if count < 2:
        return Interval(values[0], values[0] * np.nan, values[0] * np.nan)
    return Interval(values[0], *np.percentile(values[1:], _BOUNDS, axis=0))


@lru_cache(4)
def _weights(count: int, resamples: int) -> Array:
    """How often each episode counts: once each, then as each resample drew them."""
    draws = np.random.default_rng(_SEED).multinomial(count, np.full(count, 1 / count), resamples)
    return np.concatenate((np.ones((1, count)), draws))


def by_episode(values: NDArray[Any], episode: NDArray[np.int64], count: int) -> Array:
    """Sums of rows (n, ...) over the rows of each episode, (count, ...).

    Args:
        values: a row for each row of data.
        episode: the number of its episode, (n,), in ascending order.
        count: how many episodes there are; one without rows has zeros.
    """
    sums = np.zeros((count, *values.shape[1:]))
    if len(values):
        starts = np.flatnonzero(np.diff(episode, prepend=-1))
        sums[episode[starts]] = np.add.reduceat(values, starts, axis=0, dtype=np.float64)
    return sums


def variation(total: Array, squares: Array, rows: Array) -> Array:
    """Squared deviations from the mean, of the sum of values and of their squares.

    0 where there is nothing but rounding.
    """
    found = squares - total**2 / rows
    return np.where(found > 1e-9 * squares, found, 0)


def r_squared(residual: Array, about_mean: Array) -> Array:
    """1 - residual / variation; NaN where nothing varies."""
    return np.where(about_mean > 0, 1 - residual / about_mean, np.nan)
