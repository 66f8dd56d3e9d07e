"""Covariances of what is now with the rows some steps later, at several lags, in one pass."""

from collections.abc import Callable

import numpy as np

from jbrep.dataset import ScaledDataset
from jbrep.methods.passes import Array, Block, blocks

LAGS = (1, 2, 5, 10, 20, 50, 100)  # of the spectra that the file keeps, beside those asked for


class Lagged:
    """Second moments over all windows as long as the longest lag.

    Args:
        data: scaled.
        lags: steps from now to later.
        width: of what is now, n.
        now: what is now, of a block of windows, (m, n).

    Attributes:
        lags: those, and the smaller ones of LAGS, in order.
        now_mean: (n,).
        now: E[x x'] of what is now, (n, n).
        later_mean: of the rows at each lag, (lags, size).
        later: E[y y'] of the rows at each lag, (lags, size, size).
        across: E[x y'], (lags, n, size).

    Raises:
        InputError: no episode is longer than the longest lag.
    """

    def __init__(
        self,
        data: ScaledDataset,
        lags: tuple[int, ...],
        width: int,
        now: Callable[[Block], Array],
    ):
        longest = max(lags)
        self.lags = tuple(sorted({*lags, *(lag for lag in LAGS if lag < longest)}))
        count, size = len(self.lags), data.size
        windows = 0
        self.now_mean, self.later_mean = np.zeros(width), np.zeros((count, size))
        self.now, self.later = np.zeros((width, width)), np.zeros((count, size, size))
        self.across = np.zeros((count, width, size))
        work = width**2 + count * size * (width + size)
        for block in blocks(data, longest, width + size, work):
            first = now(block)
            windows += len(block)
            self.now_mean += first.sum(axis=0)
            self.now += first.T @ first
            for i, lag in enumerate(self.lags):
                after = block.later(lag)
                self.later_mean[i] += after.sum(axis=0)
                self.across[i] += first.T @ after
                self.later[i] += after.T @ after
        for total in (self.now_mean, self.now, self.later_mean, self.later, self.across):
            total /= windows

    def places(self, lags: tuple[int, ...]) -> list[int]:
        """Where these lags are among all."""
        return [self.lags.index(lag) for lag in lags]
