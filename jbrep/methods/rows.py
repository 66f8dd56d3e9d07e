"""The rows that a network is trained on: in memory, or read from the data set when asked for."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from jbrep.dae.training import Rows
from jbrep.dataset import ScaledDataset

_MEMORY = 4 << 30  # bytes that training rows may take


def training_rows(data: ScaledDataset, device: torch.device, memory: int = _MEMORY) -> Rows:
    """The scaled training rows (n, d), on that device, or outside memory if they don't fit.

    Both give the same numbers, and so the same weights; from a disk it is many times slower.
    """
    needed = len(data.train) * data.task.size * np.dtype(np.float32).itemsize
    return load_rows(data, data.train, device) if needed <= memory else _StoredRows(data, device)


def load_rows(data: ScaledDataset, rows: NDArray[np.int64], device: torch.device) -> Tensor:
    """Those rows, scaled, (n, d), on that device."""
    return torch.from_numpy(data.load(rows)).to(device)


class _StoredRows:
    """The scaled training rows (n, d), read from the data set whenever some are asked for."""

    def __init__(self, data: ScaledDataset, device: torch.device):
        self._data = data
        self.device = device
        self.shape = (len(data.train), data.task.size)

    def index_select(self, dim: int, index: Tensor, /) -> Tensor:
        """The rows with those numbers among the training rows, in that order; `dim` is 0."""
        return load_rows(self._data, self._data.train[index.cpu().numpy()], self.device)
