"""One pass over all windows of the training part, in blocks of consecutive rows."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset import ScaledDataset
from jbrep.training.windows import first_rows

Array = NDArray[np.float64]

_BLOCK = 1 << 16  # windows in a block
_NUMBERS = 1 << 23  # at most in its wide arrays


class Block(NamedTuple):
    """Consecutive training rows, and which of them begin a window.

    Attributes:
        rows: scaled, (n, size).
        actions: scaled to [-1, 1], (n, k).
        rewards: (n,).
        starts: places of the windows' first rows, (m,); a window lies within the block.
    """

    rows: Array
    actions: Array
    rewards: Array
    starts: NDArray[np.int64]

    def later(self, ahead: int) -> Array:
        """The rows that many steps after each window's first, (m, size)."""
        return self.rows[self.starts + ahead]

    def next_actions(self, count: int) -> Array:
        """The first actions of each window, (m, count * k)."""
        return self.actions[self.starts[:, None] + np.arange(count)].reshape(len(self.starts), -1)

    def mean_reward(self, count: int) -> Array:
        """The mean of the first rewards of each window, (m, 1)."""
        earned = np.concatenate(([0], np.cumsum(self.rewards)))
        return (earned[self.starts + count] - earned[self.starts])[:, None] / count


def blocks(data: ScaledDataset, horizon: int, width: int) -> Iterator[Block]:
    """All windows of the training part, in order.

    Args:
        data: scaled.
        horizon: rows of a window after its first.
        width: numbers that the caller makes of each window, by which blocks are sized.

    Raises:
        InputError: no episode is longer than the horizon.
    """
    starts = first_rows(data, data.train, horizon)
    task, action, reward = data.task, data.dataset["action"], data.dataset["reward"]
    low, high = (np.asarray(bound, float) for bound in (task.action_low, task.action_high))
    size = max(1, min(_BLOCK, _NUMBERS // width))
    for first in range(0, len(starts), size):
        chosen = starts[first : first + size]
        places = data.train[chosen[0] : chosen[-1] + horizon + 1]
        yield Block(
            data.load(places).astype(np.float64),
            (action[places].reshape(len(places), -1) - (high + low) / 2) / ((high - low) / 2),
            reward[places].astype(np.float64),
            chosen - chosen[0],
        )
