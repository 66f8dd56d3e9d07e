"""What operations do to layers, by PyTorch's names and with PyTorch's arguments."""

import inspect
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from jbrep.encoders.fold import Action, Array, Chain
from jbrep.encoders.layers import ACTIVATIONS, EPSILON
from jbrep.errors import InputError

VALUE: Any = object()  # stands for what depends on the observation among the arguments
NOTHING = Action(lambda chain: chain, lambda values: values)
_USUAL_THRESHOLD = 20  # of softplus, beyond which torch takes it as linear


def operation(name: str, *args: Any, **options: Any) -> Action:
    """What an operation does.

    Args:
        name: that of a function of PyTorch, or of a method of its tensors.
        args: VALUE where it takes what depends on the observation; arrays in float64.
        options: arguments by name.
    """
    make = _POINTWISE.get(name)
    if make is None:
        make = _OPERATIONS.get(name)
        if make is None:
            raise InputError("an encoder has no such layer")
        check_first_alone(args)
    else:
        _check_dimensions(args)
    try:
        inspect.signature(make).bind(*args, **options)
        return make(*args, **options)
    except TypeError:
        raise InputError("not with these arguments") from None


def _check_dimensions(args: Any) -> None:
    """Make sure that no constant makes more dimensions than (rows, units)."""
    for each in args:
        if each is not VALUE and np.ndim(each) > 2:
            raise InputError(
                f"it has a constant of shape {np.shape(each)}, expected at most two dimensions"
            )


def check_first_alone(args: Any) -> None:
    """Check that the first of some arguments, alone, depends on the observation."""
    if [place for place, each in enumerate(args) if each is VALUE] != [0]:
        raise InputError("its first input alone may depend on the observation")


def _activation(name: str, values: Any = VALUE, inplace: bool = False) -> Action:
    """One of an encoder's activations but the layer norm."""
    return Action(lambda chain: chain.activate(name), ACTIVATIONS[name])


def with_slope(name: str, beta: float) -> Action:
    """An activation f with a slope, as softplus and SiLU can have: f(beta * values) / beta."""
    if not 0 < beta < math.inf:
        raise InputError(f"its beta is {beta}: it must be positive")
    if beta == 1:
        return _activation(name)
    return Action(
        lambda chain: chain.scale(beta).activate(name).scale(1 / beta),
        lambda values: ACTIVATIONS[name](values * beta) / beta,
    )


def _linear(values: Any, weight: Any, bias: Any = None) -> Action:
    return Action(lambda chain: chain.affine(weight, 0 if bias is None else bias), None)


def _layer_norm(
    values: Any,
    normalized_shape: Any,
    weight: Any = None,
    bias: Any = None,
    eps: float = EPSILON,
) -> Action:
    if len(normalized_shape) != 1:
        raise InputError(f"it is over values of shape {tuple(normalized_shape)}, expected one size")
    factor, shift = 1 if weight is None else weight, 0 if bias is None else bias
    return Action(lambda chain: chain.layer_norm(eps).scale(factor, shift), None)


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
    factor = (1 if weight is None else weight) / np.sqrt(running_var + eps)
    return _rescale(factor, (0 if bias is None else bias) - running_mean * factor)


def _gelu(values: Any, approximate: str = "none") -> Action:
    return _activation("gelu-tanh" if approximate == "tanh" else "gelu")


def _elu(values: Any, alpha: float = 1.0, inplace: bool = False) -> Action:
    if alpha != 1:
        raise InputError(f"its alpha is {alpha:g}: only 1 can be converted")
    return _activation("elu")


def _leaky_relu(values: Any, negative_slope: float = 0.01, inplace: bool = False) -> Action:
    if not math.isclose(negative_slope, 0.01, rel_tol=1e-6):  # ONNX has it in single precision
        raise InputError(f"its slope is {negative_slope:g}: only 0.01 can be converted")
    return _activation("leaky-relu")


def _softplus(values: Any, beta: float = 1, threshold: float = _USUAL_THRESHOLD) -> Action:
    if threshold < _USUAL_THRESHOLD:
        raise InputError(f"its threshold is {threshold:g}: it must be {_USUAL_THRESHOLD}")
    return with_slope("softplus", beta)


def _flatten(values: Any, start_dim: int = 0, end_dim: int = -1) -> Action:
    if start_dim not in (1, -1):
        raise InputError("it flattens the rows: start at dimension 1")
    return NOTHING


def _dropout(values: Any, p: float = 0.5, training: bool = True, inplace: bool = False) -> Action:
    if training:
        raise InputError("it is on in evaluation, too: give it training=self.training")
    return NOTHING


def _reshape(values: Any, *shape: Any) -> Action:
    """A change of the shape to (rows, units), which must be the shape that it has."""

    def apply(chain: Chain) -> Chain:
        if len(shape) != 2 or shape[1] not in (0, -1, chain.width):
            raise InputError(f"it makes the shape {tuple(shape)} from (rows, {chain.width})")
        return chain

    return Action(apply, None)


def _rescale(factor: Any, shift: Any = 0) -> Action:
    """Affine map of each number: values * factor + shift."""
    single = np.size(factor) == np.size(shift) == 1
    factor, shift = np.asarray(factor), np.asarray(shift)
    return Action(
        lambda chain: chain.scale(factor, shift),
        (lambda values: values * factor.item() + shift.item()) if single else None,
    )


def _arithmetic(name: str, left: Any, right: Any) -> Action:
    """What an operator does that NumPy calls so."""
    left, right = (v if v is VALUE else np.asarray(v, np.float64) for v in (left, right))
    constant = right if left is VALUE else left
    if constant is not VALUE:
        if name == "add":
            return _rescale(1, constant)
        if name == "multiply":
            return _rescale(constant)
        if name == "subtract":
            return _rescale(-1, left) if right is VALUE else _rescale(1, -right)
        if name == "divide" and left is VALUE:
            return _rescale(1 / right)
    return _together(getattr(np, name), left, right)


def _together(function: Callable[..., Any], *args: Any) -> Action:
    """A function that is an activation only together with others."""
    if any(np.size(each) != 1 for each in args if each is not VALUE):
        raise InputError("it has a constant of several numbers, expected one")
    numbers = [each if each is VALUE else np.reshape(each, ()) for each in args]

    def filled(*values: Array) -> Array:
        rest = iter(values)
        return function(*(next(rest) if each is VALUE else each for each in numbers))

    return Action(None, filled)


def _erf(values: Array) -> Array:
    from scipy.special import erf

    return erf(values)


_PARTS = "exp", "expm1", "greater", "less", "log", "log1p", "reciprocal", "sqrt", "where"
_POINTWISE: dict[str, Callable[..., Action]] = {  # of values and constants in any order
    **dict.fromkeys(("add", "iadd"), partial(_arithmetic, "add")),
    **dict.fromkeys(("sub", "isub", "subtract"), partial(_arithmetic, "subtract")),
    **dict.fromkeys(("mul", "imul", "multiply"), partial(_arithmetic, "multiply")),
    **dict.fromkeys(
        ("div", "divide", "truediv", "itruediv", "true_divide"), partial(_arithmetic, "divide")
    ),
    "pow": partial(_arithmetic, "power"),
    "erf": partial(_together, _erf),
    **{name: partial(_together, getattr(np, name)) for name in _PARTS},
}


_OPERATIONS: dict[str, Callable[..., Action]] = {  # of one value, the first argument
    **{name: partial(_activation, name) for name in ("relu", "tanh", "sigmoid", "silu", "sin")},
    "gelu": _gelu,
    "elu": _elu,
    "leaky_relu": _leaky_relu,
    "softplus": _softplus,
    "linear": _linear,
    "matmul": lambda values, right: _linear(values, np.transpose(right)),
    "layer_norm": _layer_norm,
    "batch_norm": _batch_norm,
    "dropout": _dropout,
    "flatten": _flatten,
    **dict.fromkeys(("reshape", "view"), _reshape),
    "neg": lambda values: _rescale(-1),
    **dict.fromkeys(
        ("clone", "contiguous", "cpu", "detach", "double", "float", "identity", "to"),
        lambda *arguments, **options: NOTHING,
    ),
}
