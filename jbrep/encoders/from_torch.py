"""The layers of torch modules, which are traced into chains of operations."""

import copy
import operator
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor, fx, nn
from torch.nn import functional
from torch.nn.utils.parametrize import type_before_parametrizations

from jbrep.encoders import fold
from jbrep.encoders.base import floating
from jbrep.encoders.fold import Value, refusal
from jbrep.encoders.layers import Layer, run
from jbrep.encoders.operations import VALUE, operation
from jbrep.envs.task import Task
from jbrep.errors import InputError, kind_and_line

_ROWS = 64  # on which the layers are compared with the module
_PRECISION = 1e-3  # of the largest number: single precision, after many layers


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
        raise InputError(f"{said} isn't a torch module, of which an Encoder is made")
    try:
        copied = _copy(getattr(module, "_orig_mod", module))  # of a compiled one, the original
        traced = _Method(copied, method if hasattr(copied, method) else "forward")
        _refuse_hooks(traced)
        with torch.no_grad():
            interpreter = _Folding(traced, graph=_Tracer().trace(traced))
            interpreter.extra_traceback = False  # messages are one line
            end = interpreter.run(fold.given(rows.shape[1]))
            expected = _outputs(traced, rows)
        layers = fold.layers_to(end)
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
    result = module(torch.as_tensor(rows, dtype=floating(module).dtype))
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


def _refuse_hooks(module: nn.Module) -> None:
    for name, each in module.named_modules():
        if each._forward_hooks or each._forward_pre_hooks:
            raise InputError(f"the hooks of {_said(each, name)} can't be converted: remove them")


class _Folding(fx.Interpreter):
    """Does what a traced module does with a `fold.Value`; all else as it is."""

    def run_node(self, n: fx.Node) -> Any:
        """The result of a node."""
        values: list[Value] = []

        def shown(each: Any) -> Any:
            if not isinstance(each, Value):
                return _as_array(each)
            values.append(each)
            return VALUE

        args: Any
        kwargs: Any
        args, kwargs = fx.node.map_aggregate(self.fetch_args_kwargs_from_env(n), shown)
        if not values or not n.op.startswith("call"):
            return super().run_node(n)
        if n.op == "call_module":
            called = self.module.get_submodule(str(n.target))
            said = _said(called, str(n.target))
            known = _MODULES.get(type_before_parametrizations(called))
            (name, *args), kwargs = known(called) if known else ("",), {}
        else:
            function = n.target if isinstance(n.target, str) else _name(n.target)
            said = f"the {n.op.removeprefix('call_')} {function}"
            name = function.strip("_")
        try:
            action = operation(name, *args, **kwargs)
        except InputError as error:
            raise InputError(refusal(said, error)) from None
        return fold.take(said, action, values)


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


def _affine(module: Any) -> tuple[Any, Any]:
    """The weight and the bias of a module, None where it has none."""
    return _as_array(module.weight), _as_array(module.bias)


_MODULES: dict[type[nn.Module], Callable[[Any], tuple[Any, ...]]] = {  # operation, arguments
    nn.Linear: lambda m: ("linear", VALUE, *_affine(m)),
    nn.ReLU: lambda m: ("relu", VALUE),
    nn.Tanh: lambda m: ("tanh", VALUE),
    nn.Sigmoid: lambda m: ("sigmoid", VALUE),
    nn.SiLU: lambda m: ("silu", VALUE),
    nn.GELU: lambda m: ("gelu", VALUE, m.approximate),
    nn.ELU: lambda m: ("elu", VALUE, m.alpha),
    nn.LeakyReLU: lambda m: ("leaky_relu", VALUE, m.negative_slope),
    nn.Softplus: lambda m: ("softplus", VALUE, m.beta, m.threshold),
    nn.LayerNorm: lambda m: ("layer_norm", VALUE, m.normalized_shape, *_affine(m), m.eps),
    nn.BatchNorm1d: lambda m: (
        *("batch_norm", VALUE, _as_array(m.running_mean), _as_array(m.running_var)),
        *(*_affine(m), False, m.momentum, m.eps),
    ),
    nn.Flatten: lambda m: ("flatten", VALUE, m.start_dim, m.end_dim),
    **dict.fromkeys((nn.Identity, nn.Dropout, nn.AlphaDropout), lambda m: ("identity", VALUE)),
}
