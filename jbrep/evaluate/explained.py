"""R^2 with intervals over episodes."""

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from jbrep.stats.bootstrap import Array, Interval, bootstrap, r_squared, variation


class Episodes(Protocol):
    """Rows by episode."""

    def sums(self, rows: NDArray[np.int64], *values: NDArray[Any]) -> list[Array]:
        """Sums of each array (n, k) over the rows of each episode, (episodes, k)."""


def explained(
    predicted: NDArray[Any],
    true: NDArray[Any],
    rows: NDArray[np.int64],
    episodes: Episodes,
    widths: Sequence[int] | None = None,
    means: Sequence[NDArray[Any]] = (),
) -> Interval:
    """R^2 of each part of predicted columns (n, k), (parts,); the columns of a part count together.

    Args:
        predicted: the columns.
        true: what they should be, (n, k).
        rows: their rows, (n,).
        episodes: of the rows, to resample.
        widths: of the parts; None for all columns as one part.
        means: weights of the parts, (parts,), in weighted means of those that vary, which come as
            further parts at the end.
    """
    true = np.asarray(true, np.float64)
    shifted = true - true.mean(axis=0)  # keeps the digits of a small variation
    sums = episodes.sums(
        rows, (predicted - true) ** 2, shifted, shifted**2, np.ones((len(rows), 1))
    )
    starts = np.cumsum([0, *(widths or [true.shape[1]])])[:-1]

    def statistic(residual: Array, total: Array, squares: Array, n: Array) -> Array:
        about_mean = variation(total, squares, n)
        parts = r_squared(*(np.add.reduceat(v, starts, axis=-1) for v in (residual, about_mean)))
        known = np.isfinite(parts)
        filled = np.where(known, parts, 0)
        for weights in means:
            weight = known @ weights
            mean = np.where(weight > 0, filled @ weights / np.where(weight > 0, weight, 1), np.nan)
            parts = np.append(parts, mean[..., None], axis=-1)
        return parts

    return bootstrap(statistic, *sums)
