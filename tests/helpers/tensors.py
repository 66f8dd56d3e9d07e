"""Windows of rows that are there already, without a data set; and torch's threads."""

from contextlib import contextmanager

import torch


@contextmanager
def torch_threads(count):
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class TensorWindows:
    """Every row (n, d) of a tensor as a window of its own."""

    def __init__(self, rows):
        self._rows = rows
        self.device, self.size = rows.device, rows.shape[1]
        self.numbers = torch.arange(len(rows), device=rows.device)

    def __len__(self):
        return len(self._rows)

    def rows(self, numbers):
        return self._rows.index_select(0, numbers)
