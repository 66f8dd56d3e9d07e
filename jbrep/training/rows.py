"""The rows that a network is trained on, in memory or on disk, and the order of an epoch."""

from collections.abc import Callable
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from jbrep.machine import free_memory

Load = Callable[[NDArray[np.int64]], NDArray[np.float32]]

_LEAST_MEMORY = 1 << 30  # bytes that rows may take on any machine
POOL = 1 << 30  # bytes of rows that are shuffled together
RUN = 1024  # consecutive rows that come into a pool together


class Rows(Protocol):
    """Rows (n, d): a tensor, or what gives chosen rows as one."""

    def index_select(self, dim: int, index: Tensor, /) -> Tensor:
        """The rows with those numbers, in that order; `dim` is 0."""


def available_memory(device: torch.device) -> int:
    """Bytes that training rows may take: half of what is free, but at least 1 GiB.

    Rows for a GPU pass through the machine's memory, so they must fit in half of both.
    """
    memory = max(free_memory() // 2, _LEAST_MEMORY)
    if device.type == "cuda":
        memory = min(memory, torch.cuda.mem_get_info(device)[0] // 2)
    return memory


def rows_of(
    load: Load, rows: NDArray[np.int64], width: int, device: torch.device, memory: int
) -> Rows:
    """What is loaded of the rows, (n, width), on that device, or left on disk if it doesn't fit.

    Both give the same numbers in the same order, and so the same weights. What is read from disk
    is left to the system's cache of files, which gives it up as soon as memory is needed.
    """
    if len(rows) * width * np.dtype(np.float32).itemsize <= memory:
        return torch.from_numpy(load(rows)).to(device)
    return _StoredRows(load, rows, device)


class _StoredRows:
    """Rows (n, d) that are read from the data set whenever some are asked for."""

    def __init__(self, load: Load, rows: NDArray[np.int64], device: torch.device):
        self._load, self._numbers, self._device = load, rows, device

    def index_select(self, dim: int, index: Tensor, /) -> Tensor:
        numbers, place = index.cpu().sort()  # a disk is faster in ascending order
        loaded = torch.from_numpy(self._load(self._numbers[numbers.numpy()])).to(self._device)
        return torch.empty_like(loaded).index_copy_(0, place.to(self._device), loaded)


def shuffled(count: int, pool: int, generator: torch.Generator) -> Tensor:
    """Every row number below `count` once, in an order that a disk can be read in.

    Rows that make up one pool are permuted uniformly. More are taken in runs of consecutive rows:
    the runs in random order, as many at a time as a pool holds, and their rows shuffled together,
    so that what is read at a time is a pool, whatever the number of rows. The order depends on the
    arguments alone, not on whether the rows are in memory.
    """
    device = generator.device
    if count <= pool:
        return torch.randperm(count, generator=generator, device=device)
    runs = torch.randperm(-(-count // RUN), generator=generator, device=device)
    within = torch.arange(RUN, device=device)
    pools = []
    for chosen in runs.split(max(1, pool // RUN)):
        rows = (chosen[:, None] * RUN + within).flatten()
        rows = rows[rows < count]  # the last run may be shorter
        pools.append(rows[torch.randperm(len(rows), generator=generator, device=device)])
    return torch.cat(pools)
