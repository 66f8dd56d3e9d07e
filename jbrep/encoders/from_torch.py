"""The layers of torch modules, which are traced into chains of operations."""

import copy
import inspect
import operator
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, fx, nn
from torch.nn import functional
from torch.nn.utils.parametrize import type_before_parametrizations

from jbrep.encoders import fold
from jbrep.encoders.fold import Action, Step, refusal
from jbrep.encoders.layers import EPSILON, Layer, run
from jbrep.envs.task import Task
from jbrep.errors import InputError, kind_and_line

_ROWS = 64  # on which the layers are compared with the module
_PRECISION = 1e-3  # of the largest number: single precision, after many layers
_USUAL_THRESHOLD = 20  # of softplus, beyond which torch takes it as linear
_VALUE = object()  # stands for what depends on the observation among the arguments of a function


def layers_of(
    encoder: nn.Module, task: Task, decoder: nn.Module | None
) -> tuple[tuple[Layer, ...], tuple[Layer, ...]]:
    """The layers of encoder and decoder, as `Encoder.from_torch` takes them."""
    rows = task.unscale(np.random.default_rng(0).uniform(-1, 1, (_ROWS, task.size)))
    into, latents = _layers(encoder, "encode", rows)
    decoder = encoder if decoder is None and hasattr(encoder, "decode") else decoder
    return into, _layers(decoder, "decode", latents)[0] if decoder is not None else ()


class _Method(nn.Module):
    """A method of a module as a module."""

    def __init__(self, module: nn.Module, method: str):
        super().__init__()
        self.module = module
        self.method = method

    def forward(self, values: Tensor) -> Any:
        """What the method makes of values (n, units)."""
        return getattr(self.module, self.method)(values)


@np.errstate(all="ignore")  # what isn't finite is refused
def _layers(module: nn.Module, method: str, rows: Any) -> tuple[tuple[Layer, ...], Any]:
    """A module's layers, and what it makes of rows (n, units).

    Args:
        module: left as it is.
        method: that is traced if there is one, else `forward`.
        rows: on which both are compared.
    """
    said = type(module).__name__
    if not isinstance(module, nn.Module):
        raise InputError(f"{said} is no torch module: an Encoder is made of one")
    try:
        copied = _copy(getattr(module, "_orig_mod", module))  # of a compiled one, the original
        traced = _Method(copied, method if hasattr(copied, method) else "forward")
        with torch.no_grad():
            layers = _fold(traced, _Tracer().trace(traced), rows.shape[1])
            expected = _outputs(traced, rows)
    except InputError as error:
        raise InputError(f"{said}: {error}") from None
    except Exception as error:
        raise InputError(refusal(said, kind_and_line(error))) from error
    given = run(layers, np.asarray(rows, np.float32))
    most = _PRECISION * (np.abs(expected).max() + _PRECISION)
    if given.shape != expected.shape or not (np.abs(given - expected) <= most).all():
        raise InputError(
            f"{said} gives other numbers than its layers: it does more than tracing shows, such as "
            "changing a value in place"
        )
    return layers, expected


def _copy(module: nn.Module) -> nn.Module:
    """A copy in evaluation on the CPU, of 32 bits at least."""
    copied = copy.deepcopy(module).cpu().eval()
    is_short = any(p.is_floating_point() and p.element_size() < 4 for p in copied.parameters())
    return copied.float() if is_short else copied


def _outputs(module: nn.Module, rows: Any) -> Any:
    """What a module makes of rows (n, units): (n, units) float64."""
    floats = (p for p in [*module.parameters(), *module.buffers()] if p.is_floating_point())
    like = next(floats, torch.empty(0))
    result = module(torch.as_tensor(rows, dtype=like.dtype))
    if not isinstance(result, Tensor) or result.ndim != 2:
        shape = tuple(result.shape) if isinstance(result, Tensor) else type(result).__name__
        raise InputError(f"it returns {shape}, expected one tensor (rows, units)")
    if not result.isfinite().all():
        raise InputError("it returns numbers that are not finite")
    return result.double().numpy()


class _Tracer(fx.Tracer):
    """Follows what a module does, down to the modules that are known."""

    def is_leaf_module(self, m: nn.Module, module_qualified_name: str) -> bool:
        known = type_before_parametrizations(m) in _MODULES
        return known or super().is_leaf_module(m, module_qualified_name)


def _fold(module: nn.Module, graph: fx.Graph, size: int) -> tuple[Layer, ...]:
    """The layers of a traced module."""
    for name, each in module.named_modules():
        if each._forward_hooks or each._forward_pre_hooks:
            raise InputError(f"the hooks of {_said(each, name)} can't be converted: remove them")
    constants: dict[fx.Node, Any] = {}
    steps: list[Step] = []
    start = end = ""
    for node in graph.nodes:
        values = [each.name for each in node.all_input_nodes if each not in constants]
        if node.op == "placeholder":
            start = node.name
        elif node.op == "output":
            end = values[0] if values else ""
        elif values:
            steps.append(_step(node, module, constants))
        else:
            constants[node] = _constant(node, module, constants)
    return fold.fold(steps, start, end, size)


def _constant(node: fx.Node, module: nn.Module, constants: dict[fx.Node, Any]) -> Any:
    """The value of a node that doesn't depend on the observation."""
    target: Any = node.target
    args, kwargs = fx.node.map_arg((node.args, node.kwargs), constants.__getitem__)
    if node.op == "get_attr":
        return operator.attrgetter(target)(module)
    if node.op == "call_method":
        return getattr(args[0], target)(*args[1:], **kwargs)
    called = module.get_submodule(target) if node.op == "call_module" else target
    return called(*args, **kwargs)


def _step(node: fx.Node, module: nn.Module, constants: dict[fx.Node, Any]) -> Step:
    """The step that a node is."""
    inputs = tuple(each.name for each in _flat(node) if each not in constants)
    args: Any
    kwargs: Any
    if node.op == "call_module":
        called = module.get_submodule(str(node.target))
        said = _said(called, str(node.target))
        make: Any = _MODULES.get(type_before_parametrizations(called))
        args, kwargs = (called,), {}
    else:
        args, kwargs = fx.node.map_arg(
            (node.args, node.kwargs), lambda each: _as_array(constants.get(each, _VALUE))
        )
        name = node.target if isinstance(node.target, str) else _name(node.target)
        said = f"the {'method' if node.op == 'call_method' else 'function'} {name}"
        make = _function(name.strip("_"), args, len(inputs))
    if make is None:
        raise InputError(refusal(said, "an encoder has no such layer"))
    try:
        inspect.signature(make).bind(*args, **kwargs)
        return Step(said, inputs, node.name, make(*args, **kwargs))
    except TypeError:
        raise InputError(refusal(said, "not with these arguments")) from None
    except InputError as error:
        raise InputError(refusal(said, error)) from None


def _function(name: str, args: Any, values: int) -> Any:
    """What makes the action of a function, given its arguments; None if it isn't known."""
    if name in _BINARY:
        return partial(_arithmetic, _BINARY[name])
    return _FUNCTIONS.get(name) if args[:1] == (_VALUE,) and values == 1 else None


def _flat(node: fx.Node) -> list[fx.Node]:
    """All nodes among a node's arguments, in order, also those that are there twice."""
    nodes: list[fx.Node] = []
    fx.node.map_arg((node.args, node.kwargs), nodes.append)
    return nodes


def _said(module: nn.Module, path: str) -> str:
    """As Mish (layers.3)."""
    return f"{type(module).__name__} ({path.removeprefix('module').lstrip('.') or 'itself'})"


def _name(function: Any) -> str:
    """The name of a function of torch or Python, or of any other, in full."""
    name = getattr(function, "__name__", repr(function))
    if any(getattr(library, name, None) is function for library in (torch, functional, operator)):
        return name
    return f"{getattr(function, '__module__', None)}.{name}"


def _as_array(value: Any) -> Any:
    """A tensor as an array in float64; anything else as it is."""
    return value.detach().double().numpy() if isinstance(value, Tensor) else value


def _affine_of(module: Any) -> dict[str, Any]:
    """The weight and the bias of a module, where it has them."""
    return {name: _as_array(getattr(module, name)) for name in ("weight", "bias")}


def _arithmetic(name: str, left: Any, right: Any) -> Action:
    """What an operator does that NumPy calls so."""
    left, right = (None if v is _VALUE else np.asarray(v, np.float64) for v in (left, right))
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


_BINARY = {
    **dict.fromkeys(("add", "iadd"), "add"),
    **dict.fromkeys(("sub", "isub", "subtract"), "subtract"),
    **dict.fromkeys(("mul", "imul", "multiply"), "multiply"),
    **dict.fromkeys(("div", "divide", "truediv", "itruediv", "true_divide"), "divide"),
    "pow": "power",
}
_FUNCTIONS: dict[str, Callable[..., Action]] = {  # of torch, and methods of its tensors
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
_MODULES: dict[type[nn.Module], Callable[[Any], Action]] = {
    nn.Linear: lambda m: _linear(_VALUE, **_affine_of(m)),
    nn.ReLU: lambda m: fold.activation("relu"),
    nn.Tanh: lambda m: fold.activation("tanh"),
    nn.Sigmoid: lambda m: fold.activation("sigmoid"),
    nn.SiLU: lambda m: fold.activation("silu"),
    nn.GELU: lambda m: _gelu(_VALUE, m.approximate),
    nn.ELU: lambda m: _elu(_VALUE, m.alpha),
    nn.Softplus: lambda m: _softplus(_VALUE, m.beta, m.threshold),
    nn.LayerNorm: lambda m: _layer_norm(_VALUE, m.normalized_shape, **_affine_of(m), eps=m.eps),
    nn.BatchNorm1d: lambda m: _batch_norm(
        _VALUE, _as_array(m.running_mean), _as_array(m.running_var), **_affine_of(m), eps=m.eps
    ),
    nn.Flatten: lambda m: _flatten(_VALUE, m.start_dim, m.end_dim),
    **dict.fromkeys((nn.Identity, nn.Dropout, nn.AlphaDropout), lambda m: fold.NOTHING),
}
