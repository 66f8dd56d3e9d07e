"""Dense layers and their activations, for NumPy arrays and torch tensors alike."""

from collections.abc import Callable, Iterable, Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from jbrep.coordinates import is_torch
from jbrep.errors import InputError, choose

MAX_UNITS = 4096  # in a layer
MAX_MAGNITUDE = 1e12  # of any number, far from where float32 overflows

ONNX = "onnx"  # in place of an activation: a layer that is a model
AVG_L1_NORM = "avg-l1-norm"
LEAST_NORM = 1e-8  # that an average magnitude counts as


class Layer(NamedTuple):
    """A dense layer: activation(values @ weight.T + bias), from (..., in) to (..., units)."""

    weight: Any  # (units, in) float32
    bias: Any  # (units,) float32
    activation: str

    def __call__(self, values: Any) -> Any:
        return activate(self.activation, values @ self.weight.T + self.bias)

    @property
    def units(self) -> int:
        return len(self.bias)

    def moved(self, move: Callable[[Any], Any]) -> "Layer":
        """The same with weight and bias as `move` makes them, such as torch tensors."""
        return Layer(move(self.weight), move(self.bias), self.activation)

    def tensors(self) -> dict[str, Any]:
        """Its numbers, by their names in a file."""
        return {"weight": self.weight, "bias": self.bias}

    def check(self, name: str, inputs: int) -> None:
        """Check the numbers of a layer of so many inputs."""
        units = max(1, self.weight.shape[0]) if np.ndim(self.weight) == 2 else 1
        check_tensor(f"{name}.weight", self.weight, (units, inputs))
        check_tensor(f"{name}.bias", self.bias, (units,))
        choose(self.activation, ACTIVATIONS, "activation")


def dense(weight: Any, bias: Any, activation: str = "linear") -> Layer:
    """A dense layer, stored in float32, of weights computed in float64."""
    single = np.ascontiguousarray(weight, dtype=np.float32)
    return Layer(single, np.asarray(bias, np.float32), activation)


def check_tensor(name: str, tensor: Any, shape: tuple[int, ...]) -> None:
    """Make sure that a tensor is of that shape, of float32, and finite."""
    if tensor.shape != shape:
        raise InputError(f"tensor {name} has shape {tensor.shape}, expected {shape}")
    if tensor.dtype != np.float32:
        raise InputError(f"tensor {name} has type {tensor.dtype}, expected float32")
    if not (np.abs(tensor) < MAX_MAGNITUDE).all():
        raise InputError(
            f"tensor {name} holds a number that is not finite or not below {MAX_MAGNITUDE:g}"
        )


def run(layers: Iterable[Any], values: Any) -> Any:
    """Pass values (..., in) through the layers, giving (..., units)."""
    for layer in layers:
        values = layer(values)
    return values


def activate(name: str, values: Any) -> Any:
    """Apply an activation to values (..., units) in their type.

    They are a NumPy array, a torch tensor, or something that has `activations` of its own.

    `avg-l1-norm` divides them by their average magnitude (Fujimoto et al. 2023).
    """
    if is_torch(values):
        return _torch()[name](values)
    return getattr(values, "activations", ACTIVATIONS)[name](values)


def _sigmoid(values: Any) -> Any:
    small = np.exp(-np.abs(values))  # at most 1, so that nothing overflows
    return np.where(values >= 0, 1, small) / (1 + small)


def _gelu(values: Any) -> Any:
    from scipy.special import ndtr  # the distribution function of N(0, 1), exact in its tails

    return values * ndtr(values)


ACTIVATIONS: Mapping[str, Callable[[Any], Any]] = {  # for NumPy arrays
    "linear": lambda values: values,
    "relu": lambda values: values.clip(min=0),
    "tanh": np.tanh,
    "sigmoid": _sigmoid,
    "gelu": _gelu,  # Hendrycks and Gimpel 2016
    "silu": lambda values: values * _sigmoid(values),
    "elu": lambda values: np.where(values > 0, values, np.expm1(np.minimum(values, 0))),
    "leaky-relu": lambda values: np.maximum(values, 0.01 * values),
    "sin": np.sin,
    AVG_L1_NORM: lambda values: values / np.abs(values).mean(-1, keepdims=True).clip(LEAST_NORM),
}


@cache
def _torch() -> Mapping[str, Callable[[Any], Any]]:
    import torch
    from torch.nn import functional

    return {
        "linear": lambda values: values,
        "relu": lambda values: values.clip(min=0),
        **{name: getattr(torch, name) for name in ("tanh", "sigmoid", "sin")},
        **{name: getattr(functional, name) for name in ("gelu", "silu", "elu")},
        "leaky-relu": functional.leaky_relu,
        AVG_L1_NORM: lambda v: v / v.abs().mean(-1, keepdim=True).clip(min=LEAST_NORM),
    }
