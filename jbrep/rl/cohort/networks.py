"""Networks of n agents as one: every weight has a leading axis, with an entry for each member."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function

from jbrep.rl.names import FLOAT32


class Product(NamedTuple):
    """How matrices are multiplied: each is cast once, however many products it is a factor of."""

    cast: Callable[[Tensor], Tensor]
    multiply: Callable[[Tensor, Tensor], Tensor]  # factors (n, rows, in) and (n, in, out), cast


class Layer(NamedTuple):
    """An affine layer of n networks."""

    weight: Tensor  # (n, in, out)
    bias: Tensor  # (n, 1, out)


Network = Sequence[Layer]


class Arithmetic(NamedTuple):
    """How a network computes: what follows each hidden layer, and how matrices are multiplied."""

    activation: Callable[[Tensor], Tensor]
    product: Product

    def __call__(self, network: Network, inputs: Tensor) -> Tensor:
        """The outputs (n, rows, out) of networks on inputs (n, rows, in)."""
        *hidden, last = network
        for layer in hidden:
            inputs = self.activation(_Affine.apply(inputs, *layer, self.product))
        outputs: Tensor = _Affine.apply(inputs, *last, self.product)
        return outputs


class _Affine(Function):
    """Affine layers, and their gradients, by a product of one's choice."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, weight: Tensor, bias: Tensor, product: Product) -> Tensor:
        inputs, weight = map(product.cast, (inputs, weight))
        ctx.save_for_backward(inputs, weight)
        ctx.product = product
        return product.multiply(inputs, weight).add_(bias)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        inputs, weight = ctx.saved_tensors
        of_inputs, of_layer, *_ = ctx.needs_input_grad
        factor, multiply = ctx.product.cast(gradient), ctx.product.multiply
        return (
            multiply(factor, weight.mT) if of_inputs else None,
            multiply(inputs.mT, factor) if of_layer else None,
            gradient.sum(1, keepdim=True) if of_layer else None,
            None,
        )


def get_product(precision: str, device: torch.device) -> Product:
    """How matrices are multiplied, with a precision, on a device."""
    multiply = torch.bmm if device.type == "cuda" else _one_by_one
    if precision == FLOAT32:
        return Product(lambda values: values, multiply)
    if device.type == "cuda" or torch.ops.mkldnn._is_mkldnn_bf16_supported():
        return Product(Tensor.bfloat16, lambda left, right: multiply(left, right).float())
    return Product(_rounded, lambda left, right: _rounded(multiply(left, right)))


def _rounded(values: Tensor) -> Tensor:
    """To bfloat16, kept as they were: products of such factors are exact in float32."""
    return values.bfloat16().to(values.dtype)


def _one_by_one(left: Tensor, right: Tensor) -> Tensor:
    """Products of matrices, each by itself: its bits don't depend on how many there are.

    A processor sums a product of a batch differently if it has one member, or many.
    """
    products = left.new_empty(len(left), left.shape[1], right.shape[2])
    for a, b, product in zip(left, right, products, strict=True):
        torch.mm(a, b, out=product)
    return products
