"""What the modules, functions and methods of torch do, as actions on a chain of layers."""

from collections.abc import Callable
from typing import Any

import numpy as np
from torch import Tensor, nn

from jbrep.encoders import fold
from jbrep.encoders.fold import Action
from jbrep.encoders.layers import EPSILON
from jbrep.errors import InputError

_USUAL_THRESHOLD = 20  # of softplus, beyond which torch takes it as linear
VALUE = object()  # stands for what depends on the observation among the arguments of a function


def as_array(value: Any) -> Any:
    """A tensor as an array in float64; anything else as it is."""
    return value.detach().double().numpy() if isinstance(value, Tensor) else value


def _affine_of(module: Any) -> dict[str, Any]:
    """The weight and the bias of a module, where it has them."""
    return {name: as_array(getattr(module, name)) for name in ("weight", "bias")}


def arithmetic(name: str, left: Any, right: Any) -> Action:
    """What an operator does that NumPy calls so."""
    left, right = (None if v is VALUE else np.asarray(v, np.float64) for v in (left, right))
    return fold.binary(name, left, right)


def _linear(values: Any, weight: Any, bias: Any = None) -> Action:
    return fold.affine(weight, 0 if bias is None else bias)


def _gelu(values: Any, approximate: str = "none") -> Action:
    return fold.activation("gelu-tanh" if approximate == "tanh" else "gelu")


def _elu(values: Any, alpha: float = 1.0, inplace: bool = False) -> Action:
    return fold.elu(alpha)


def _softplus(values: Any, beta: float = 1, threshold: float = _USUAL_THRESHOLD) -> Action:
    if threshold < _USUAL_THRESHOLD:
        raise InputError(f"its threshold is {threshold:g}: it must be {_USUAL_THRESHOLD}")
    return fold.with_slope("softplus", beta)


def _layer_norm(
    values: Any,
    normalized_shape: Any,
    weight: Any = None,
    bias: Any = None,
    eps: float = EPSILON,
) -> Action:
    if len(normalized_shape) != 1:
        raise InputError(f"it is over values of shape {tuple(normalized_shape)}, expected one size")
    return fold.layer_norm(eps, weight, bias)


def _batch_norm(
    values: Any,
    running_mean: Any,
    running_var: Any,
    weight: Any = None,
    bias: Any = None,
    training: bool = False,
    momentum: float = 0.1,
    eps: float = EPSILON,
) -> Action:
    if training or running_mean is None:
        raise InputError("it has no running statistics, so that rows depend on one another")
    return fold.batch_norm(running_mean, running_var, eps, weight, bias)


def _dropout(values: Any, p: float = 0.5, training: bool = True, inplace: bool = False) -> Action:
    if training:
        raise InputError("it is on in evaluation, too: give it training=self.training")
    return fold.NOTHING


def _flatten(values: Any, start_dim: int = 0, end_dim: int = -1) -> Action:
    if start_dim not in (1, -1):
        raise InputError("it flattens the rows: start at dimension 1")
    return fold.NOTHING


def _same(name: str) -> Callable[..., Action]:
    return lambda values, inplace=False: fold.activation(name)


def _part(function: Callable[..., Any]) -> Callable[..., Action]:
    """A function that is an activation only together with others."""
    return lambda values: Action(None, function)


BINARY = {
    **dict.fromkeys(("add", "iadd"), "add"),
    **dict.fromkeys(("sub", "isub", "subtract"), "subtract"),
    **dict.fromkeys(("mul", "imul", "multiply"), "multiply"),
    **dict.fromkeys(("div", "divide", "truediv", "itruediv", "true_divide"), "divide"),
    "pow": "power",
}
FUNCTIONS: dict[str, Callable[..., Action]] = {  # of torch, and methods of its tensors
    **{name: _same(name) for name in ("relu", "tanh", "sigmoid", "silu", "sin")},
    "gelu": _gelu,
    "elu": _elu,
    "softplus": _softplus,
    "linear": _linear,
    "matmul": lambda values, right: fold.affine(np.transpose(right)),
    "layer_norm": _layer_norm,
    "batch_norm": _batch_norm,
    "dropout": _dropout,
    "flatten": _flatten,
    "reshape": lambda values, *shape: fold.reshape(shape),
    "view": lambda values, *shape: fold.reshape(shape),
    "neg": lambda values: fold.rescale(-1),
    **{name: _part(getattr(np, name)) for name in ("exp", "log", "sqrt", "expm1", "log1p")},
    "erf": _part(fold.erf),
    **dict.fromkeys(
        ("clone", "contiguous", "cpu", "detach", "double", "float", "to"),
        lambda *arguments, **options: fold.NOTHING,
    ),
}
MODULES: dict[type[nn.Module], Callable[[Any], Action]] = {
    nn.Linear: lambda m: _linear(VALUE, **_affine_of(m)),
    nn.ReLU: lambda m: fold.activation("relu"),
    nn.Tanh: lambda m: fold.activation("tanh"),
    nn.Sigmoid: lambda m: fold.activation("sigmoid"),
    nn.SiLU: lambda m: fold.activation("silu"),
    nn.GELU: lambda m: _gelu(VALUE, m.approximate),
    nn.ELU: lambda m: _elu(VALUE, m.alpha),
    nn.Softplus: lambda m: _softplus(VALUE, m.beta, m.threshold),
    nn.LayerNorm: lambda m: _layer_norm(VALUE, m.normalized_shape, **_affine_of(m), eps=m.eps),
    nn.BatchNorm1d: lambda m: _batch_norm(
        VALUE, as_array(m.running_mean), as_array(m.running_var), **_affine_of(m), eps=m.eps
    ),
    nn.Flatten: lambda m: _flatten(VALUE, m.start_dim, m.end_dim),
    **dict.fromkeys((nn.Identity, nn.Dropout, nn.AlphaDropout), lambda m: fold.NOTHING),
}
