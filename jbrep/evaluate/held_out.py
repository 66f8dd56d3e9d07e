"""The held-out episodes that encoders are judged on."""

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset import ScaledDataset
from jbrep.stats.bootstrap import Array, by_episode

Rows = NDArray[np.int64]


class HeldOut:
    """Held-out rows of a data set, by episode.

    Attributes:
        data: the data set, split and scaled.
        numbers: of the held-out episodes within the data set, (episodes,).
    """

    def __init__(self, data: ScaledDataset):
        self.data = data
        self._ends = np.cumsum(data.dataset.episodes["length"], dtype=np.int64)
        self.numbers = np.unique(self._episode(data.test))

    def __len__(self) -> int:
        return len(self.numbers)

    def _episode(self, rows: Rows) -> Rows:
        return np.searchsorted(self._ends, rows, side="right")

    def place(self, rows: Rows) -> Rows:
        """The position of each held-out row's episode among the held-out ones, (n,)."""
        return np.searchsorted(self.numbers, self._episode(rows))

    def followed(self, rows: Rows) -> Rows:
        """Those rows whose next row belongs to the same episode."""
        return rows[self._ends[self._episode(rows)] > rows + 1]

    def sums(self, rows: Rows, *values: NDArray[Any]) -> list[Array]:
        """Sums of each array (n, k) over the rows of each held-out episode, (episodes, k)."""
        place = self.place(rows)
        return [by_episode(v, place, len(self)) for v in values]

    @cached_property
    def row_counts(self) -> Array:
        """Rows of each held-out episode, (episodes, 1)."""
        return self.sums(self.data.test, np.ones((len(self.data.test), 1)))[0]

    @cached_property
    def variation(self) -> list[Array]:
        """Sums of scaled features and of their squares over each held-out episode."""
        scaled = self.data.load(self.data.test)
        return self.sums(self.data.test, scaled, scaled**2)
