"""Encoders from ONNX models whose graph is a chain of dense layers.

Models may be strangers': they are bounded, and read from regular files of one folder alone.
"""

from collections import Counter
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
from jbrep.encoders.fold import Action, Chain, Value, refusal
from jbrep.encoders.layers import EPSILON, Layer
from jbrep.encoders.operations import NOTHING, VALUE, check_first_alone, operation, with_slope
from jbrep.envs.task import Task
from jbrep.errors import InputError, first_line, refusing
from jbrep.records.storage import exists, read_file
from jbrep.text import counted

LATENT, RECONSTRUCTION = "latent", "reconstruction"  # the outputs of a model that jbrep exported
Constants = dict[str, NDArray[np.generic]]
_Values = dict[str, Value | None]  # None of those from before the latent

_MOST_LETTERS = 100  # of what a message says of a node
_MAX_BYTES = 1 << 26  # of a model, and of the file of its numbers
_MAX_NODES = 1000
_MOST_KEPT = 1 << 26  # numbers of constants and unfinished layers, at a time
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
        start, rows = _input(model.graph, constants, size)
        outputs = [output.name for output in model.graph.output]
        if len(outputs) != 1 and sorted(outputs) != [LATENT, RECONSTRUCTION]:
            raise InputError(
                f"it has the outputs {', '.join(outputs)}: expected one, or {LATENT} and "
                f"{RECONSTRUCTION}"
            )
        uses = Counter(name for node in model.graph.node for name in node.input)
        nodes, values = iter(model.graph.node), _Values({start: fold.given(size)})
        if len(outputs) == 1:
            return _fold(nodes, values, outputs[0], constants, uses, rows), ()
        layers = _fold(nodes, values, LATENT, constants, uses, rows)
        values = {**dict.fromkeys(values), LATENT: fold.given(len(layers[-1].bias))}
        return layers, _fold(nodes, values, RECONSTRUCTION, constants, uses, rows)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _read(path: Path) -> tuple[onnx.ModelProto, Constants]:
    """A model, checked by ONNX's own checker, and its initialisers by name.

    Exporters put large tensors into a second file: it is read if it is a regular file in the
    model's folder, never through a path or a link.
    """
    model = onnx.ModelProto()
    what = f"{path} isn't an ONNX model that can be read"
    with refusing(what, _UNREADABLE, told=first_line):
        model.ParseFromString(_bytes(path))
        if len(model.graph.node) > _MAX_NODES:
            raise InputError(f"{path} has more than {_MAX_NODES} nodes")
        _fetch_all(model.graph.initializer, path.parent)
        onnx.checker.check_model(model)
        return model, {tensor.name: _array(tensor) for tensor in model.graph.initializer}


def _array(tensor: TensorProto) -> NDArray[np.generic]:
    """The numbers of a tensor.

    Raises:
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
    total = kept = 0
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
            kept += len(contents[name])
        if kept > _MAX_BYTES:
            raise InputError(f"the model's other files have more than {_MAX_BYTES:,} bytes")
        start = int(where.get("offset", 0))
        end = start + int(where["length"]) if "length" in where else len(contents[name])
        total += end - start
        if not 0 <= start <= end <= len(contents[name]) or total > _MAX_BYTES:
            raise InputError(f"the tensor {tensor.name} doesn't fit {folder / name}")
        tensor.raw_data = contents[name][start:end]
        tensor.data_location = TensorProto.DEFAULT
        del tensor.external_data[:]


def _bytes(path: Path) -> bytes:
    """The bytes of a regular file."""
    if not exists(path):
        raise InputError(f"no file {path}")
    return read_file(path)


def _input(graph: onnx.GraphProto, constants: Constants, size: int) -> tuple[str, int]:
    """The name of a graph's input, and its number of rows; 0 if it may have any."""
    inputs = [each for each in graph.input if each.name not in constants]
    if len(inputs) != 1:
        names = ", ".join(each.name for each in inputs) or "none"
        raise InputError(f"it has the inputs {names}: expected one")
    (given,) = inputs
    kind, rows = given.type.tensor_type, 0
    if kind.elem_type not in _FLOATS:
        raise InputError(f"its input {given.name} must be of float32")
    if kind.HasField("shape"):
        shape = [dim.dim_value or dim.dim_param or "?" for dim in kind.shape.dim]
        if len(shape) != 2 or (isinstance(shape[1], int) and shape[1] != size):
            shown = ", ".join(map(str, shape))
            raise InputError(f"its input {given.name} is ({shown}), expected (rows, {size})")
        rows = kind.shape.dim[0].dim_value
    return given.name, rows


def _fold(
    nodes: Iterable[onnx.NodeProto],
    values: _Values,
    end: str,
    constants: Constants,
    uses: Counter[str],
    rows: int,
) -> tuple[Layer, ...]:
    """The layers that lead to a value, by the nodes up to its own; values and constants grow.

    What no later node uses is dropped: it may be large.
    """
    for node in nodes:
        named = node.name or ", ".join(node.output)
        said = f"{node.op_type} ({named})"[:_MOST_LETTERS]
        if node.domain not in ("", "ai.onnx"):
            raise InputError(refusal(f"{node.domain}.{said}", "it is no operation of ONNX itself"))
        try:
            _check_size(values, constants)
            given = _Node(node, values, constants, rows)
            if given.values:
                action = given.action()
            else:
                constants[node.output[0]] = given.constant()
                continue
        except InputError as error:
            raise InputError(refusal(said, error)) from None
        except (AttributeError, IndexError, TypeError, ValueError, KeyError) as error:
            raise InputError(refusal(said, first_line(error))) from None
        values[node.output[0]] = fold.take(said, action, given.values)
        uses.subtract(node.input)
        for name in node.input:
            if not uses[name]:
                values.pop(name, None)
        if node.output[0] == end:
            break
    return fold.layers_to(values.get(end))


def _check_size(values: _Values, constants: Constants) -> None:
    """Refuse a model whose nodes make many large arrays of a few numbers."""
    chains = {chain for value in values.values() if value for chain in value.forms}
    kept = sum(chain.last[0].size for chain in chains if chain.last)
    kept += sum(each.size for each in constants.values())
    if kept > _MOST_KEPT:
        raise InputError(f"the nodes before it make more than {_MOST_KEPT:,} numbers")


class _Node:
    """A node with its attributes and inputs: VALUE, a constant, or None for one left out.

    All values have as many rows; 0 if these may be any.
    """

    def __init__(self, node: onnx.NodeProto, values: _Values, constants: Constants, rows: int):
        self.operation, self.rows = node.op_type, rows
        self.attributes: dict[str, Any] = {
            each.name: helper.get_attribute_value(each) for each in node.attribute
        }
        self.values: list[Value] = []
        self.inputs = [self._input(name, values, constants) for name in node.input]

    def _input(self, name: str, values: _Values, constants: Constants) -> Any:
        if value := values.get(name):
            self.values.append(value)
            return VALUE
        if name in values:
            raise InputError(f"it reads {name}, from before the latent")
        if not name:
            return None
        if name not in constants:
            raise InputError(f"it reads {name}, which is no output that can be used")
        constant = constants[name]
        if constant.dtype.kind not in "fib":
            raise InputError(f"its input {name} isn't a number")
        return constant.astype(np.float64) if constant.dtype.kind == "f" else constant

    def constant(self) -> Any:
        """The output of a node of constants alone."""
        if self.operation == "Constant":
            ((kind, value),) = self.attributes.items()
            return _array(value) if kind == "value" else np.asarray(value)
        first, second = self.given(0), self.given(1)
        if self.operation == "Identity":
            return first
        if self.operation == "Cast":
            return first.astype(helper.tensor_dtype_to_np_dtype(self.attributes["to"]))
        if self.operation == "Transpose":
            return np.transpose(first, self.attributes.get("perm"))
        if self.operation in _SHAPES and second is not None:
            return _SHAPES[self.operation](first, tuple(second.tolist()))
        raise InputError("it computes a constant")

    def action(self) -> Action:
        """What it does."""
        if self.operation in _ACTIONS:
            check_first_alone(self.inputs)
            return _ACTIONS[self.operation](self)
        return operation(self.operation.lower() if self.operation in _SAME else "", *self.inputs)

    def given(self, place: int) -> Any:
        """An input; None if there is none."""
        return self.inputs[place] if place < len(self.inputs) else None

    def number(self, name: str, default: float) -> float:
        """An attribute that is a number: float32, brought back to the decimal that was meant."""
        return float(f"{self.attributes.get(name, default):.7g}")

    def must(self, name: str, *allowed: int) -> None:
        """Make sure that an attribute has an allowed value, of which the first is the default."""
        value = self.attributes.get(name, allowed[0])
        if value not in allowed:
            raise InputError(f"its {name} is {value}, expected {allowed[0]}")


def _gemm(node: _Node) -> Action:
    node.must("transA", 0)
    weight, bias = node.given(1), node.given(2)
    weight = weight if node.attributes.get("transB") else np.transpose(weight)
    bias = 0 if bias is None else bias * node.number("beta", 1)
    return operation("linear", VALUE, weight * node.number("alpha", 1), bias)


def _layer_norm(node: _Node) -> Action:
    node.must("axis", -1, 1)
    weight, bias = node.given(1), node.given(2)
    epsilon = node.number("epsilon", EPSILON)
    return operation("layer_norm", VALUE, np.shape(weight), weight, bias, epsilon)


def _batch_norm(node: _Node) -> Action:
    node.must("training_mode", 0)
    weight, bias, mean, variance = (node.given(place) for place in range(1, 5))
    epsilon = node.number("epsilon", EPSILON)
    return operation("batch_norm", VALUE, mean, variance, weight, bias, eps=epsilon)


def _dropout(node: _Node) -> Action:
    if np.any(node.given(2)):
        raise InputError("it is on, as in training")
    return NOTHING


def _flatten(node: _Node) -> Action:
    node.must("axis", 1, -1)
    return NOTHING


def _reshape(node: _Node) -> Action:
    node.must("allowzero", 0)
    rows, *units = node.given(1).tolist()
    if rows not in (0, -1, node.rows):
        made = counted(rows, "row")
        raise InputError(f"it makes {made} of any number, expected 0 or -1 for all of them")
    return operation("reshape", VALUE, rows, *units)


def _squeeze(node: _Node) -> Action:
    def apply(chain: Chain) -> Chain:
        if 1 in (node.rows, chain.width) or node.given(1) is not None or "axes" in node.attributes:
            raise InputError("it removes a dimension")
        return chain

    return Action(apply, None)


def _cast(node: _Node) -> Action:
    if node.attributes["to"] not in _FLOATS:
        raise InputError("it makes other numbers than float32 or float64")
    return NOTHING


def _gelu(node: _Node) -> Action:
    return operation("gelu", VALUE, node.attributes.get("approximate", b"none").decode())


_SAME = {  # those that PyTorch calls so, too, and that have no attributes
    *("Add", "Div", "Erf", "Exp", "Greater", "Identity", "Less", "Log", "MatMul", "Mul", "Neg"),
    *("Pow", "Reciprocal", "Relu", "Sigmoid", "Sin", "Softplus", "Sqrt", "Sub", "Tanh", "Where"),
}
_ACTIONS: dict[str, Callable[[_Node], Action]] = {  # of one value, the first input
    "Gemm": _gemm,
    "Flatten": _flatten,
    "Reshape": _reshape,
    "Squeeze": _squeeze,
    "Cast": _cast,
    "Dropout": _dropout,
    "BatchNormalization": _batch_norm,
    "LayerNormalization": _layer_norm,
    "Gelu": _gelu,
    "Swish": lambda node: with_slope("silu", node.number("alpha", 1)),
    "Elu": lambda node: operation("elu", VALUE, node.number("alpha", 1)),
    "LeakyRelu": lambda node: operation("leaky_relu", VALUE, node.number("alpha", 0.01)),
}
_SHAPES: dict[str, Callable[[Any, tuple[int, ...]], Any]] = {  # of constants
    "Reshape": lambda value, shape: value.reshape(
        [value.shape[place] if size == 0 else size for place, size in enumerate(shape)]
    ),
    "Unsqueeze": np.expand_dims,
    "Squeeze": np.squeeze,
}
