"""Backpropagation through dense layers, written out.

With so few features a step is limited by memory access and by the number of operations: with
features first, in preallocated buffers, it takes about half of autograd's time
(benchmarks/encoders.py).
"""

from collections.abc import Iterable
from itertools import pairwise

import torch
from torch import Tensor, nn


class Gradient:
    """Computes the gradients of the mean squared error of a stack of layers.

    Args:
        modules: nn.Linear, each followed by an activation, nn.ReLU or nn.Tanh, or by none.
        rows: the largest batch.
        weights: of each number in the error, (d,); None for 1.
    """

    def __init__(self, modules: Iterable[nn.Module], rows: int, weights: Tensor | None = None):
        self.rows = rows
        self._weights = None if weights is None else weights[:, None]
        stack = [*modules, nn.Identity()]
        self._layers = [
            (module, after) for module, after in pairwise(stack) if isinstance(module, nn.Linear)
        ]
        self._outputs = [p.bias.new_empty(len(p.bias) * rows) for p, _ in self._layers]
        self._errors = [torch.empty_like(output) for output in self._outputs]
        for linear, _ in self._layers:
            for parameter in linear.parameters():
                parameter.grad = torch.zeros_like(parameter)

    @torch.no_grad()
    def __call__(self, values: Tensor, target: Tensor) -> Tensor:
        """Set every parameter's gradient, and return the mean squared error.

        Args:
            values: the input, (features, rows).
            target: the output to come close to, (features, rows).
        """
        inputs = [values, *self._cut(self._outputs, values.shape[1])]
        for (linear, activation), before, after in zip(
            self._layers, inputs[:-1], inputs[1:], strict=True
        ):
            torch.addmm(linear.bias[:, None], linear.weight, before, out=after)
            _activate(activation, after)
        errors = self._cut(self._errors, values.shape[1])
        error = torch.sub(inputs[-1], target, out=errors[-1])
        if self._weights is None:
            loss = torch.dot(error.view(-1), error.view(-1)) / error.numel()
        else:
            loss = torch.sum(error.square() * self._weights) / error.numel()
            error.mul_(self._weights)
        error.mul_(2 / error.numel())
        for i, (linear, activation) in reversed(list(enumerate(self._layers))):
            _differentiate(activation, inputs[i + 1], errors[i])
            torch.mm(errors[i], inputs[i].T, out=linear.weight.grad)
            torch.sum(errors[i], 1, out=linear.bias.grad)
            if i:
                torch.mm(linear.weight.T, errors[i], out=errors[i - 1])
        return loss

    def _cut(self, buffers: list[Tensor], rows: int) -> list[Tensor]:
        """The part of each buffer that this many rows occupy, (features, rows)."""
        sizes = [len(linear.bias) for linear, _ in self._layers]
        return [b[: n * rows].view(n, rows) for n, b in zip(sizes, buffers, strict=True)]


def _activate(activation: nn.Module, values: Tensor) -> None:
    """Apply an activation in place."""
    if isinstance(activation, nn.Tanh):  # as 2 sigmoid(2x) - 1: a third of torch.tanh's time
        values.mul_(2).sigmoid_().mul_(2).sub_(1)
    elif isinstance(activation, nn.ReLU):
        values.clamp_min_(0)


def _differentiate(activation: nn.Module, output: Tensor, error: Tensor) -> None:
    """Turn the error at an activation's output into that at its input, overwriting both."""
    if isinstance(activation, nn.Tanh):
        torch.addcmul(error, error, output.square_(), value=-1, out=error)
    elif isinstance(activation, nn.ReLU):
        torch.ops.aten.threshold_backward.grad_input(error, output, 0, grad_input=error)
