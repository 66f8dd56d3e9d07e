"""Small networks side by side, which take what is known and give what comes next."""

import torch
from torch import Tensor, nn

HIDDEN = 64  # units of each of a predictor's two hidden layers


class Predictors(nn.Module):
    """Networks of one shape, of which each reads the first of some shared inputs.

    Each has two hidden layers of ReLU. Features come first and rows last, and all networks are
    multiplied at once: with so few units, a step of separate ones is bound by calls and by memory.

    Args:
        reads: for each network, how many of the inputs it reads.
        outputs: numbers that each gives.
    """

    _read: Tensor

    def __init__(self, reads: tuple[int, ...], outputs: int):
        super().__init__()
        count, most = len(reads), max(reads)
        fan_in = torch.tensor(reads), *(torch.full((count,), HIDDEN) for _ in range(2))
        shapes = (HIDDEN, most), (HIDDEN, HIDDEN), (outputs, HIDDEN)
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for (width, inputs), fan in zip(shapes, fan_in, strict=True):
            limit = fan.rsqrt()[:, None, None]  # as nn.Linear
            self.weights.append((2 * torch.rand(count, width, inputs) - 1) * limit)
            self.biases.append((2 * torch.rand(count, width, 1) - 1) * limit)
        read = torch.arange(most) < torch.tensor(reads)[:, None, None]
        self.register_buffer("_read", read.float(), persistent=False)

    def forward(self, inputs: Tensor) -> Tensor:
        """What each network gives, (networks, outputs, n), of inputs (most, n)."""
        first = (self.weights[0] * self._read).flatten(0, 1)
        hidden = torch.addmm(self.biases[0].flatten(0, 1), first, inputs).relu_()
        hidden = hidden.view(len(self._read), HIDDEN, -1)
        hidden = torch.baddbmm(self.biases[1], self.weights[1], hidden).relu_()
        return torch.baddbmm(self.biases[2], self.weights[2], hidden)
