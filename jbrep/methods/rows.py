"""The rows that a network is trained on: in memory, or read from the data set when asked for."""

import os

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from jbrep.dae.training import Rows
from jbrep.dataset import ScaledDataset
from jbrep.dataset.scaled import sample

_LEAST_MEMORY = 1 << 30  # bytes that rows may take on any machine
_WATCHED = 100_000  # held-out rows whose loss is reported after each epoch
_WATCHED_NUMBERS = 1 << 22  # at most in those rows: 16 MiB


def available_memory(device: torch.device) -> int:
    """Bytes that training rows may take: half of what is free, but at least 1 GiB.

    Rows for a GPU pass through the machine's memory, so they must fit in half of both.
    """
    pages = "SC_AVPHYS_PAGES" if "SC_AVPHYS_PAGES" in os.sysconf_names else "SC_PHYS_PAGES"
    memory = max(os.sysconf(pages) * os.sysconf("SC_PAGE_SIZE") // 2, _LEAST_MEMORY)
    if device.type == "cuda":
        memory = min(memory, torch.cuda.mem_get_info(device)[0] // 2)
    return memory


def training_rows(data: ScaledDataset, device: torch.device, memory: int | None = None) -> Rows:
    """The scaled training rows (n, d), on that device, or on disk if they don't fit in memory.

    Both give the same numbers in the same order, and so the same weights. What is read from disk
    is left to the system's cache of files, which gives it up as soon as memory is needed.

    Args:
        data: the data set.
        device: to train on.
        memory: bytes that they may take; None for `available_memory`.
    """
    limit = available_memory(device) if memory is None else memory
    needed = len(data.train) * data.task.size * np.dtype(np.float32).itemsize
    return load_rows(data, data.train, device) if needed <= limit else _StoredRows(data, device)


def watched_rows(data: ScaledDataset, device: torch.device) -> Tensor:
    """A sample of the scaled held-out rows, (m, d): at most 100,000, fewer of wide robots."""
    most = min(_WATCHED, _WATCHED_NUMBERS // data.task.size)
    return load_rows(data, sample(data.test, most), device)


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
        numbers, place = index.cpu().sort()  # a disk is faster in ascending order
        loaded = load_rows(self._data, self._data.train[numbers.numpy()], self.device)
        return torch.empty_like(loaded).index_copy_(0, place.to(self.device), loaded)
