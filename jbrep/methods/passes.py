"""One pass over all windows of the training part, in blocks of consecutive rows."""

from collections.abc import Iterator
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset import ScaledDataset
from jbrep.envs.task import Array
from jbrep.errors import InputError
from jbrep.training.windows import first_rows

_BLOCK = 1 << 15  # windows in a block
_NUMBERS = 1 << 22  # at most in its wide arrays: 32 MiB
_MOST_WORK = 10**12  # multiplications in a pass: a minute or two of one core
_WIDEST = 1 << 28  # products of a window, which are summed: 2 GiB


class Block:
    """Windows that follow each other, with the rows that they share.

    `starts` are the places of their first rows among the training rows, (m,), `horizon` is the
    number of rows after these.
    """

    def __init__(self, data: ScaledDataset, starts: NDArray[np.int64], horizon: int):
        self._data = data
        self._places = data.train[starts[0] : starts[-1] + horizon + 1]
        self._starts = starts - starts[0]

    def __len__(self) -> int:
        return len(self._starts)

    @cached_property
    def _rows(self) -> Array:
        return self._data.load(self._places).astype(np.float64)

    @cached_property
    def _actions(self) -> Array:
        """Scaled to [-1, 1], (n, k)."""
        return self._data.actions(self._places, np.float64)

    @cached_property
    def _earned(self) -> Array:
        """Sums of the rewards before each row, (n + 1,)."""
        rewards = self._data.rewards(self._places)
        return np.concatenate(([0], np.cumsum(rewards, dtype=float)))

    def later(self, ahead: int) -> Array:
        """The scaled rows that many steps after each window's first, (m, size)."""
        return self._rows[self._starts + ahead]

    def next_actions(self, count: int) -> Array:
        """The first actions of each window, scaled to [-1, 1], (m, count * k)."""
        return self._actions[self._starts[:, None] + np.arange(count)].reshape(len(self), -1)

    def mean_reward(self, count: int) -> Array:
        """The mean of the first rewards of each window, (m, 1)."""
        return (self._earned[self._starts + count] - self._earned[self._starts])[:, None] / count


def blocks(data: ScaledDataset, horizon: int, width: int, work: int) -> Iterator[Block]:
    """All windows of the training part, in order; of very wide ones, evenly spaced blocks.

    Memory doesn't grow with the number of rows, but for the places of the windows. `width` and
    `work` are the numbers and the products that the caller makes of each window: by the first
    blocks are sized, and so many are given that the second come to 10^12 at most.
    """
    if work > _WIDEST:
        raise InputError(
            f"{horizon} steps of {data.size} features and {data.task.action_size} actions are too "
            "many numbers: look fewer steps ahead"
        )
    starts = first_rows(data, data.train, horizon)
    size = max(1, min(_BLOCK, _NUMBERS // width))
    every = -(-len(starts) * work // _MOST_WORK)
    first = 0
    while first < len(starts):
        reach = np.searchsorted(starts, starts[first] + 2 * size)  # many episodes may be too short
        last = min(first + size, int(reach))
        yield Block(data, starts[first:last], horizon)
        first += (last - first) * every


def check_enough(count: int, width: int, data: ScaledDataset, apart: int, less: str) -> None:
    """Make sure that there are more windows than numbers in each, `width`, to regress on.

    They reach `apart` steps; `less` is what to give to have more windows, or fewer numbers.
    """
    if count <= width:
        raise InputError(
            f"{data.dataset.folder} has {count} pairs of rows {apart} steps apart to learn from, "
            f"which must be more than {width}: give {less}, or more data"
        )
