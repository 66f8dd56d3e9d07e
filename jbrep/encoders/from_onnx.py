"""Encoders from ONNX models whose graph is a chain of dense layers.

Models may be strangers': they are bounded, and read from regular files of one folder alone.
"""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from google.protobuf.message import DecodeError
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from jbrep.encoders import fold
from jbrep.encoders.encoder import Encoder, imported
from jbrep.encoders.fold import NOTHING, Action, Step, refusal
from jbrep.encoders.layers import EPSILON, Layer
from jbrep.envs.task import Task
from jbrep.errors import InputError, first_line
from jbrep.records.storage import exists, read_file

LATENT, RECONSTRUCTION = "latent", "reconstruction"  # the outputs of a model that jbrep exported
Constants = dict[str, NDArray[np.generic]]

_MOST_LETTERS = 100  # of what a message says of a node
_MAX_BYTES = 1 << 26  # of a model, and of the file of its numbers
_MAX_NODES = 1000
_FLOATS = (TensorProto.FLOAT, TensorProto.DOUBLE)
_TYPES = (*_FLOATS, TensorProto.INT32, TensorProto.INT64, TensorProto.BOOL)
_UNREADABLE = (DecodeError, onnx.checker.ValidationError, ValueError, TypeError, RuntimeError)


def convert(path: Path, task: Task, decoder: Path | None, name: str) -> Encoder:
    """An encoder from ONNX models.

    The graph of a model must be a chain of dense layers and activations of jbrep from one input,
    (n, d) in physical units, to one output; or to the outputs `latent` and `reconstruction`, as
    jbrep exports them.

    Args:
        path: of the encoder's model.
        task: whose observations it reads.
        decoder: path of a model from latents to observations; None for the encoder's
            `reconstruction`, or none.
        name: what tables will call it: lower-case letters, digits and hyphens.

    Raises:
        InputError: a model can't be read, or is no such chain; the message names the operation.
    """
    encoder, back = _layers(path, task.size)
    if decoder is not None:
        back = _layers(decoder, len(encoder[-1].bias))[0]
    return imported(task, name, encoder, back, "onnx")


@np.errstate(all="ignore")  # what isn't finite is refused with the whole encoder
def _layers(path: Path, size: int) -> tuple[tuple[Layer, ...], tuple[Layer, ...]]:
    """The layers of a model, and those from its latent to its reconstruction, if it has both."""
    model, constants = _read(path)
    try:
        start = _input(model.graph, constants, size)
        outputs = [output.name for output in model.graph.output]
        steps = _steps(model, start, constants)
        if sorted(outputs) == [LATENT, RECONSTRUCTION]:
            layers = fold.fold(steps, start, LATENT, size)
            back = fold.fold(steps, LATENT, RECONSTRUCTION, len(layers[-1].bias))
            return layers, back
        if len(outputs) != 1:
            raise InputError(
                f"it has the outputs {', '.join(outputs)}: expected one, or {LATENT} and "
                f"{RECONSTRUCTION}"
            )
        return fold.fold(steps, start, outputs[0], size), ()
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _read(path: Path) -> tuple[onnx.ModelProto, Constants]:
    """A model, checked by ONNX's own checker, and its initialisers by name.

    Exporters put large tensors into a second file: it is read if it is a regular file in the
    model's folder, never through a path or a link.

    Raises:
        InputError: there is no such file, or it is no ONNX model that can be read.
    """
    model = onnx.ModelProto()
    try:
        model.ParseFromString(_bytes(path))
        if len(model.graph.node) > _MAX_NODES:
            raise InputError(f"{path} has more than {_MAX_NODES} nodes")
        _fetch_all(model.graph.initializer, path.parent)
        onnx.checker.check_model(model)
        return model, {tensor.name: _array(tensor) for tensor in model.graph.initializer}
    except InputError:
        raise
    except _UNREADABLE as error:
        reason = first_line(error)
        raise InputError(f"{path} is no ONNX model that can be read: {reason}") from None


def _array(tensor: TensorProto) -> NDArray[np.generic]:
    """The numbers of a tensor.

    Raises:
        InputError: it is of another type, or in another file.
        ValueError: it has another number of them than its shape says.
    """
    if tensor.data_location == TensorProto.EXTERNAL:
        raise InputError(f"the tensor {tensor.name} is in another file: only initialisers can be")
    if tensor.data_type not in _TYPES:
        kind = TensorProto.DataType.Name(tensor.data_type).lower()
        raise InputError(f"the tensor {tensor.name} is of {kind}: expected float32 or float64")
    return numpy_helper.to_array(tensor)


def _fetch_all(tensors: Iterable[TensorProto], folder: Path) -> None:
    """Bring the numbers that tensors have in other files into the tensors."""
    contents: dict[str, bytes] = {}
    total = 0
    for tensor in tensors:
        if tensor.data_location != TensorProto.EXTERNAL:
            continue
        where = {entry.key: entry.value for entry in tensor.external_data}
        name = where.get("location", "")
        if not name or name in (".", "..") or set(name) & set("/\\\0"):
            raise InputError(
                f"the tensor {tensor.name} is in {name!r}: only a file beside the model is read"
            )
        if name not in contents:
            contents[name] = _bytes(folder / name)
        start = int(where.get("offset", 0))
        end = start + int(where["length"]) if "length" in where else len(contents[name])
        total += end - start
        if not 0 <= start <= end <= len(contents[name]) or total > _MAX_BYTES:
            raise InputError(f"the tensor {tensor.name} doesn't fit {folder / name}")
        tensor.raw_data = contents[name][start:end]
        tensor.data_location = TensorProto.DEFAULT
        del tensor.external_data[:]


def _bytes(path: Path) -> bytes:
    """The bytes of a regular file.

    Raises:
        InputError: there is none, or it is too large.
    """
    if not exists(path):
        raise InputError(f"no file {path}")
    return read_file(path, _MAX_BYTES)


def _input(graph: onnx.GraphProto, constants: Constants, size: int) -> str:
    """The name of a graph's input."""
    inputs = [each for each in graph.input if each.name not in constants]
    if len(inputs) != 1:
        names = ", ".join(each.name for each in inputs) or "none"
        raise InputError(f"it has the inputs {names}: expected one")
    (given,) = inputs
    kind = given.type.tensor_type
    if kind.elem_type not in _FLOATS:
        raise InputError(f"its input {given.name} must be of float32")
    if kind.HasField("shape"):
        shape = [dim.dim_value or dim.dim_param or "?" for dim in kind.shape.dim]
        if len(shape) != 2 or (isinstance(shape[1], int) and shape[1] != size):
            shown = ", ".join(map(str, shape))
            raise InputError(f"its input {given.name} is ({shown}), expected (rows, {size})")
    return given.name


def _steps(model: onnx.ModelProto, start: str, constants: Constants) -> list[Step]:
    """The steps of a graph; its nodes of constants alone are added to the constants."""
    steps: list[Step] = []
    values = {start}
    for node in model.graph.node:
        said = f"{node.op_type} ({node.name or node.output[0]})"[:_MOST_LETTERS]
        if node.domain not in ("", "ai.onnx"):
            raise InputError(refusal(f"{node.domain}.{said}", "it is no operation of ONNX itself"))
        inputs = tuple(name for name in node.input if name in values)
        try:
            given = _Node(node, values, constants)
            if inputs:
                steps.append(Step(said, inputs, node.output[0], given.action()))
                values.add(node.output[0])
            else:
                constants[node.output[0]] = given.constant()
        except InputError as error:
            raise InputError(refusal(said, error)) from None
        except (IndexError, TypeError, ValueError, KeyError) as error:
            raise InputError(refusal(said, first_line(error))) from None
    return steps


class _Node:
    """A node with its attributes and its inputs, of which each is a value or a constant."""

    def __init__(self, node: onnx.NodeProto, values: set[str], constants: Constants):
        self.operation = node.op_type
        self.attributes: dict[str, Any] = {
            each.name: helper.get_attribute_value(each) for each in node.attribute
        }
        self._names = list(node.input)
        self.count = len(self._names)
        for name in self._names:
            if name and name not in values and name not in constants:
                raise InputError(f"it reads {name}, which is no output that can be used")
        self._constants = constants
        self._values = values

    def constant(self) -> Any:
        """The output of a node of constants alone."""
        if self.operation == "Constant":
            ((kind, value),) = self.attributes.items()
            return _array(value) if kind == "value" else np.asarray(value)
        first, second = self.given(0), self.given(1)
        if self.operation in ("Identity", "Cast"):
            return first
        if self.operation == "Transpose":
            return np.transpose(first, self.attributes.get("perm"))
        if self.operation in _SHAPES and second is not None:
            return _SHAPES[self.operation](first, tuple(second.tolist()))
        raise InputError("it computes a constant")

    def action(self) -> Action:
        """What it does."""
        if self.operation in _POINTWISE:
            return _POINTWISE[self.operation](self)
        if self.operation not in _ACTIONS:
            raise InputError("an encoder has no such layer")
        if self._names[0] not in self._values or self._values & set(self._names[1:]):
            raise InputError("its first input alone may depend on the observation")
        return _ACTIONS[self.operation](self)

    def given(self, place: int) -> Any:
        """The constant that an input is, in float64 unless of integers; None if there is none."""
        if place >= len(self._names) or self._names[place] not in self._constants:
            return None
        value = self._constants[self._names[place]]
        if value.dtype.kind not in "fib":
            raise InputError(f"its input {place} is no number")
        return value.astype(np.float64) if value.dtype.kind == "f" else value

    def number(self, name: str, default: float) -> float:
        """An attribute that is a number: float32, brought back to the decimal that was meant."""
        return float(f"{self.attributes.get(name, default):.7g}")

    def must(self, name: str, *allowed: int) -> None:
        """Make sure that an attribute has an allowed value, of which the first is the default."""
        value = self.attributes.get(name, allowed[0])
        if value not in allowed:
            raise InputError(f"its {name} is {value}, expected {allowed[0]}")


def _arithmetic(name: str) -> Callable[[_Node], Action]:
    return lambda node: fold.binary(name, node.given(0), node.given(1))


def _part(function: Callable[..., Any]) -> Callable[[_Node], Action]:
    """A function that is an activation only together with others."""

    def make(node: _Node) -> Action:
        given = [node.given(place) for place in range(node.count)]
        if any(np.size(each) != 1 for each in given if each is not None):
            raise InputError("it has a constant of several numbers, expected one")
        numbers = [each if each is None else np.reshape(each, ()) for each in given]

        def filled(*values: Any) -> Any:
            rest = iter(values)
            return function(*(next(rest) if each is None else each for each in numbers))

        return Action(None, filled)

    return make


def _same(name: str) -> Callable[[_Node], Action]:
    return lambda node: fold.activation(name)


def _gemm(node: _Node) -> Action:
    node.must("transA", 0)
    weight, bias = node.given(1), node.given(2)
    weight = weight if node.attributes.get("transB") else np.transpose(weight)
    bias = 0 if bias is None else bias * node.number("beta", 1)
    return fold.affine(weight * node.number("alpha", 1), bias)


def _layer_norm(node: _Node) -> Action:
    node.must("axis", -1, 1)
    return fold.layer_norm(node.number("epsilon", EPSILON), node.given(1), node.given(2))


def _batch_norm(node: _Node) -> Action:
    node.must("training_mode", 0)
    weight, bias, mean, variance = (node.given(place) for place in range(1, 5))
    return fold.batch_norm(mean, variance, node.number("epsilon", EPSILON), weight, bias)


def _dropout(node: _Node) -> Action:
    if np.any(node.given(2)):
        raise InputError("it is on, as in training")
    return NOTHING


def _flatten(node: _Node) -> Action:
    node.must("axis", 1, -1)
    return NOTHING


def _squeeze(node: _Node) -> Action:
    if node.given(1) is not None or "axes" in node.attributes:
        raise InputError("it removes a dimension")
    return NOTHING


def _cast(node: _Node) -> Action:
    if node.attributes["to"] not in _FLOATS:
        raise InputError("it makes other numbers than float32 or float64")
    return NOTHING


def _gelu(node: _Node) -> Action:
    approximate = node.attributes.get("approximate") == b"tanh"
    return fold.activation("gelu-tanh" if approximate else "gelu")


_POINTWISE: dict[str, Callable[[_Node], Action]] = {  # of values and constants in any order
    "Add": _arithmetic("add"),
    "Sub": _arithmetic("subtract"),
    "Mul": _arithmetic("multiply"),
    "Div": _arithmetic("divide"),
    "Pow": _arithmetic("power"),
    "Erf": _part(fold.erf),
    "Exp": _part(np.exp),
    "Log": _part(np.log),
    "Sqrt": _part(np.sqrt),
    "Reciprocal": _part(np.reciprocal),
    "Greater": _part(np.greater),
    "Less": _part(np.less),
    "Where": _part(np.where),
}
_ACTIONS: dict[str, Callable[[_Node], Action]] = {  # of one value, the first input
    "MatMul": lambda node: fold.affine(np.transpose(node.given(1))),
    "Gemm": _gemm,
    "Identity": lambda node: NOTHING,
    "Neg": lambda node: fold.rescale(-1),
    "Flatten": _flatten,
    "Reshape": lambda node: fold.reshape(node.given(1).tolist()),
    "Squeeze": _squeeze,
    "Cast": _cast,
    "Dropout": _dropout,
    "BatchNormalization": _batch_norm,
    "LayerNormalization": _layer_norm,
    "Relu": _same("relu"),
    "Tanh": _same("tanh"),
    "Sigmoid": _same("sigmoid"),
    "Gelu": _gelu,
    "Swish": lambda node: fold.with_slope("silu", node.number("alpha", 1)),
    "Elu": lambda node: fold.elu(node.number("alpha", 1)),
    "Softplus": _same("softplus"),
    "Sin": _same("sin"),
}
_SHAPES: dict[str, Callable[[Any, tuple[int, ...]], Any]] = {  # of constants
    "Reshape": lambda value, shape: value.reshape(
        [value.shape[place] if size == 0 else size for place, size in enumerate(shape)]
    ),
    "Unsqueeze": np.expand_dims,
    "Squeeze": np.squeeze,
}
