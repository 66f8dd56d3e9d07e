"""Encoders from torch modules, which are traced into chains of layers."""

import copy
import inspect
import operator
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, fx, nn
from torch.nn import functional
from torch.nn.utils.parametrize import type_before_parametrizations

from jbrep.encoders import fold
from jbrep.encoders.encoder import Encoder
from jbrep.encoders.fold import Step, refusal
from jbrep.encoders.imported import imported
from jbrep.encoders.layers import Layer, run
from jbrep.encoders.torch_actions import BINARY, FUNCTIONS, MODULES, VALUE, arithmetic, as_array
from jbrep.envs.task import Task
from jbrep.errors import InputError, kind_and_line

_ROWS = 64  # on which the layers are compared with the module
_PRECISION = 1e-3  # of the largest number: single precision, after many layers


def convert(encoder: nn.Module, task: Task, decoder: nn.Module | None, name: str) -> Encoder:
    """As `Encoder.from_torch`."""
    rows = task.unscale(np.random.default_rng(0).uniform(-1, 1, (_ROWS, task.size)))
    into, latents = _layers(encoder, "encode", rows)
    decoder = encoder if decoder is None and hasattr(encoder, "decode") else decoder
    back: tuple[Layer, ...] = _layers(decoder, "decode", latents)[0] if decoder is not None else ()
    return imported(task, name, into, back, "torch")


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
        known = type_before_parametrizations(m) in MODULES
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
        make: Any = MODULES.get(type_before_parametrizations(called))
        args, kwargs = (called,), {}
    else:
        args, kwargs = fx.node.map_arg(
            (node.args, node.kwargs), lambda each: as_array(constants.get(each, VALUE))
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
    if name in BINARY:
        return partial(arithmetic, BINARY[name])
    return FUNCTIONS.get(name) if args[:1] == (VALUE,) and values == 1 else None


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
