"""The rows that a network is trained on: in memory, or read from the data set when asked for."""

import os
from collections.abc import Callable
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Load = Callable[[NDArray[np.int64]], NDArray[np.float32]]

_LEAST_MEMORY = 1 << 30  # bytes that rows may take on any machine


class Rows(Protocol):
    """Rows (n, d): a tensor, or what gives chosen rows as one."""

    def index_select(self, dim: int, index: Tensor, /) -> Tensor:
        """The rows with those numbers, in that order; `dim` is 0."""


def available_memory(device: torch.device) -> int:
    """Bytes that training rows may take: half of what is free, but at least 1 GiB.

    Rows for a GPU pass through the machine's memory, so they must fit in half of both.
    """
    pages = "SC_AVPHYS_PAGES" if "SC_AVPHYS_PAGES" in os.sysconf_names else "SC_PHYS_PAGES"
    memory = max(os.sysconf(pages) * os.sysconf("SC_PAGE_SIZE") // 2, _LEAST_MEMORY)
    if device.type == "cuda":
        memory = min(memory, torch.cuda.mem_get_info(device)[0] // 2)
    return memory


def rows_of(
    load: Load, rows: NDArray[np.int64], width: int, device: torch.device, memory: int
) -> Rows:
    """What is loaded of the rows, (n, width), on that device, or left on disk if it doesn't fit.

    Both give the same numbers in the same order, and so the same weights. What is read from disk
    is left to the system's cache of files, which gives it up as soon as memory is needed.

    Args:
        load: from row numbers (n,) to float32, (n, width).
        rows: row numbers.
        width: numbers of a row.
        device: to train on.
        memory: bytes that they may take.
    """
    if len(rows) * width * np.dtype(np.float32).itemsize <= memory:
        return torch.from_numpy(load(rows)).to(device)
    return _StoredRows(load, rows, device)


class _StoredRows:
    """Rows (n, d) that are read from the data set whenever some are asked for."""

    def __init__(self, load: Load, rows: NDArray[np.int64], device: torch.device):
        self._load, self._numbers, self._device = load, rows, device

    def index_select(self, dim: int, index: Tensor, /) -> Tensor:
        """The rows with those numbers, in that order; `dim` is 0."""
        numbers, place = index.cpu().sort()  # a disk is faster in ascending order
        loaded = torch.from_numpy(self._load(self._numbers[numbers.numpy()])).to(self._device)
        return torch.empty_like(loaded).index_copy_(0, place.to(self._device), loaded)
