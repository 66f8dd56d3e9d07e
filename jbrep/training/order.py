"""The order in which an epoch takes the training rows."""

import torch
from torch import Tensor

POOL = 1 << 30  # bytes of rows that are shuffled together
RUN = 1024  # consecutive rows that come into a pool together


def shuffled(count: int, pool: int, generator: torch.Generator) -> Tensor:
    """Every row number below `count` once, in an order that a disk can be read in.

    Rows that make up one pool are permuted uniformly. More are taken in runs of consecutive rows:
    the runs in random order, as many at a time as a pool holds, and their rows shuffled together,
    so that what is read at a time is a pool, whatever the number of rows. The order depends on the
    arguments alone, not on whether the rows are in memory.

    Args:
        count: number of rows.
        pool: rows that are shuffled together.
        generator: to draw from; the numbers will be on its device.
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
