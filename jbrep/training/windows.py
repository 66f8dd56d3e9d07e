"""Windows of consecutive steps, which never cross the end of an episode, and their rows."""

from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from jbrep.dataset import ScaledDataset
from jbrep.dataset.scaled import sample
from jbrep.errors import InputError
from jbrep.text import counted

_WATCHED = 100_000  # held-out windows whose loss is reported after each epoch
_WATCHED_NUMBERS = 1 << 22  # at most in their rows: 16 MiB


class Windows:
    """Windows of consecutive steps: a row, and some number of rows after it in its episode.

    A window is a number: rows, actions and rewards are looked up, so that windows take no more
    memory than the rows that they share.

    Args:
        data: scaled.
        rows: sorted rows of whole episodes, such as `data.train`.
        horizon: rows after the first one.
        device: where they are held.
        most: windows, at most; a sample of them if there are more.
    """

    def __init__(
        self,
        data: ScaledDataset,
        rows: NDArray[np.int64],
        horizon: int = 0,
        device: torch.device | None = None,
        most: int | None = None,
    ):
        self._data, self._rows = data, rows
        self.device = device or torch.device("cpu")
        starts = first_rows(data, rows, horizon)
        chosen = starts if most is None else sample(starts, most)
        every = len(chosen) == len(rows)
        # the first row of each window, (n,); None where all rows are
        self._starts = None if every else torch.from_numpy(chosen).to(self.device)
        self._count = len(chosen)

    def __len__(self) -> int:
        return self._count

    @property
    def numbers(self) -> Tensor:
        """The numbers of all windows, (n,)."""
        return torch.arange(len(self), device=self.device)

    def _first(self, numbers: Tensor) -> Tensor:
        return numbers if self._starts is None else self._starts.index_select(0, numbers)

    def rows(self, numbers: Tensor, ahead: int = 0) -> Tensor:
        """Scaled rows, that many steps after each window's first, (n, size)."""
        return self._scaled.index_select(0, self._first(numbers) + ahead)

    def actions(self, numbers: Tensor, count: int = 1) -> Tensor:
        """The first actions of each window, scaled to [-1, 1], (n, count, k)."""
        steps = torch.arange(count, device=self.device)
        places = (self._first(numbers)[:, None] + steps).flatten()
        return self._action.index_select(0, places).view(len(numbers), count, -1)

    def steps(self, numbers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Of each window the first row (n, size), its action (n, k), and what follows (n, size)."""
        return self.rows(numbers), self.actions(numbers)[:, 0], self.after(numbers)[0]

    def after(self, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """What follows each window's first row, (n, size), also at the end of its episode.

        And whether a state ended the episode there, 1 or 0, (n,).
        """
        rows, ended = self._following
        first = self._first(numbers)
        return rows.index_select(0, first), ended.index_select(0, first)

    @property
    def first_rows(self) -> NDArray[np.int64]:
        """The first row of each window, by its number in the data set, (n,)."""
        return self._rows[self._first(self.numbers).numpy(force=True)]

    def rewards(self, numbers: Tensor, count: int = 1) -> Tensor:
        """The mean of the first rewards of each window, (n,)."""
        first = self._first(numbers)
        total = self._earned.index_select(0, first + count) - self._earned.index_select(0, first)
        return (total / count).float()

    @cached_property
    def _scaled(self) -> Tensor:
        return torch.from_numpy(self._data.load(self._rows)).to(self.device)

    @cached_property
    def _following(self) -> tuple[Tensor, Tensor]:
        episodes, rows = self._data.dataset.episodes, self._scaled.roll(-1, 0)
        lasts = np.cumsum(episodes["length"], dtype=np.int64) - 1
        own, ended = np.isin(lasts, self._rows), np.zeros(len(rows), np.float32)
        places = np.searchsorted(self._rows, lasts[own])
        finals = self._data.scale(episodes["final_observation"][own])
        rows[places], ended[places] = torch.from_numpy(finals).to(rows), episodes["terminated"][own]
        return rows, torch.from_numpy(ended).to(self.device)

    @cached_property
    def _action(self) -> Tensor:
        return torch.from_numpy(self._data.actions(self._rows)).to(self.device)

    @cached_property
    def _earned(self) -> Tensor:
        """Sums of the rewards before each row, (rows + 1,)."""
        earned = np.zeros(len(self._rows) + 1)
        np.cumsum(self._data.rewards(self._rows), dtype=np.float64, out=earned[1:])
        return torch.from_numpy(earned).to(self.device)


def first_rows(data: ScaledDataset, rows: NDArray[np.int64], horizon: int) -> NDArray[np.int64]:
    """Places among sorted rows of those with so many rows after them in their episode."""
    if not horizon:
        return np.arange(len(rows))
    ends = np.cumsum(data.dataset.episodes["length"], dtype=np.int64)
    end = ends[np.searchsorted(ends, rows, side="right")]
    starts = np.flatnonzero(rows + horizon < end)
    if not len(starts):
        part = "held-out" if len(rows) and rows[0] in data.test else "training"
        raise InputError(
            f"no {part} episode of {data.dataset.folder} has more than {counted(horizon, 'step')}: "
            "look fewer steps ahead, or predict a shorter chunk of actions"
        )
    return starts


def count_windows(data: ScaledDataset, horizon: int) -> int:
    """How many windows the training rows have."""
    first_rows(data, data.test, horizon)
    if (count := len(first_rows(data, data.train, horizon))) < 2:
        raise InputError(
            f"the training episodes of {data.dataset.folder} have too few steps: collect more"
        )
    return count


def watched_windows(data: ScaledDataset, horizon: int, device: torch.device) -> Windows:
    """A sample of the held-out windows: at most 100,000, fewer of wide robots."""
    most = min(_WATCHED, _WATCHED_NUMBERS // data.size)
    return Windows(data, data.test, horizon, device, most)
