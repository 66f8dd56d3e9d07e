"""Encoders as ONNX models, for other programs."""

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import ArrayLike
from onnx import TensorProto, compose, helper, numpy_helper, version_converter

from jbrep.encoders.encoder import Encoder
from jbrep.encoders.layers import AVG_L1_NORM, LEAST_NORM
from jbrep.records.storage import write_new

_OPSET, _IR_VERSION = 17, 8
_LATER, _LATER_IR_VERSION = 20, 9  # of models with GELU, or with others in them
_FLOAT = TensorProto.FLOAT
_OPERATORS = {  # by NumPy's names
    **{
        name: name.capitalize()
        for name in ("add", "cos", "equal", "floor", "greater", "less", "sin", "sqrt")
    },
    **{"subtract": "Sub", "multiply": "Mul", "divide": "Div", "matmul": "MatMul"},
    **{"absolute": "Abs", "arctan": "Atan", "negative": "Neg"},
    **{"maximum": "Max", "minimum": "Min"},
}


class _Graph:
    """Nodes and constants, in order, known by name; and what they need of ONNX."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self.functions: list[onnx.FunctionProto] = []
        self.opsets, self.ir_version = {"": _OPSET}, _IR_VERSION

    def need(self, opsets: Mapping[str, int], ir_version: int) -> None:
        """Need these versions of operators, by their domains, and of the format, or later ones."""
        for domain, opset in opsets.items():
            self.opsets[domain] = max(opset, self.opsets.get(domain, 0))
        self.ir_version = max(self.ir_version, ir_version)

    def add(self, model: onnx.ModelProto) -> None:
        """Add all that a model is made of; its names must be others."""
        self.nodes.extend(model.graph.node)
        self.constants.extend(model.graph.initializer)
        self.functions.extend(model.functions)
        self.need({each.domain: each.version for each in model.opset_import}, model.ir_version)

    def node(self, operator: str, *inputs: Any, output: str = "", **attributes: Any) -> str:
        """Add an operation on values and constants; its output's name."""
        output = output or f"value_{len(self.nodes)}"
        if operator == "Gelu":
            self.need({"": _LATER}, _LATER_IR_VERSION)
        names = [each.name if isinstance(each, _Rows) else self._constant(each) for each in inputs]
        self.nodes.append(helper.make_node(operator, names, [output], output, **attributes))
        return output

    def _constant(self, value: ArrayLike) -> str:
        name, made = f"constant_{len(self.constants)}", np.asarray(value, order="C")
        made = made if made.dtype == np.int64 and made.ndim else made.astype(np.float32)
        self.constants.append(numpy_helper.from_array(made, name))
        return name


class _Rows(NDArrayOperatorsMixin):
    """Numbers (rows, width) in a model: what NumPy does with them becomes part of the model.

    A function of NumPy that an encoder comes to use must be added here.
    """

    def __init__(self, graph: _Graph, name: str, width: int):
        self.graph, self.name, self.width = graph, name, width

    def made(self, operator: str, *inputs: Any, width: int = 0, **attributes: Any) -> "_Rows":
        """What an operation makes of values, as wide as this one unless another width is given."""
        name = self.graph.node(operator, *inputs, **attributes)
        return _Rows(self.graph, name, width or self.width)

    def through(self, model: onnx.ModelProto, width: int) -> "_Rows":
        """What another model makes of them, of that width; it becomes part of this one."""
        opset = max(each.version for each in model.opset_import if each.domain in ("", "ai.onnx"))
        if opset < _LATER:
            model = version_converter.convert_version(model, _LATER)
        part = compose.add_prefix(model, f"part_{len(self.graph.nodes)}/")
        (given,), (made,) = part.graph.input, part.graph.output
        kind = given.type.tensor_type.elem_type
        self.graph.node("Cast", self, output=given.name, to=kind)
        self.graph.add(part)
        return self.made("Cast", _Rows(self.graph, made.name, width), width=width, to=_FLOAT)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        if ufunc is np.arctan2:
            return _arctan2(*inputs)
        if ufunc is np.remainder:
            value, by = inputs
            return value - np.floor(value / by) * by
        width = inputs[1].shape[1] if ufunc is np.matmul else 0
        return self.made(_OPERATORS[ufunc.__name__], *inputs, width=width)

    def __array_function__(self, function: Any, types: Any, args: Any, options: Any) -> Any:
        if function in (np.concatenate, np.stack):  # a column is one number wide here
            return self.made("Concat", *args[0], width=sum(v.width for v in args[0]), axis=1)
        return self.made({np.where: "Where"}[function], *args)

    def clip(self, least: float, most: float) -> "_Rows":
        """Numbers within limits."""
        return self.made("Clip", self, least, most)

    def __getitem__(self, key: Any) -> "_Rows":
        places = np.atleast_1d(np.arange(self.width)[key[-1]])
        if np.array_equal(places, np.arange(self.width)):
            return self
        return self.made("Gather", self, places, width=len(places), axis=1)

    @property
    def activations(self) -> Mapping[str, Callable[["_Rows"], "_Rows"]]:
        """An encoder's activations."""
        return _ACTIVATIONS


def _arctan2(sine: Any, cosine: Any) -> Any:
    """The angle with that sine and cosine, or multiples of them: ONNX has no atan2.

    The smaller is divided by the larger; 0 where both are 0.
    """
    steep = np.abs(sine) > np.abs(cosine)
    small, large = np.where(steep, cosine, sine), np.where(steep, sine, cosine)
    flat = np.arctan(small / np.where(large == 0, 1, large))
    side = np.where(sine < 0, -math.pi, math.pi)
    return np.where(steep, side * 0.5 - flat, np.where(cosine < 0, side, 0) + flat)


def _node(operator: str, **attributes: Any) -> Callable[[_Rows], _Rows]:
    return lambda values: values.made(operator, values, **attributes)


_ACTIVATIONS: Mapping[str, Callable[[_Rows], _Rows]] = {
    "linear": lambda values: values,
    **{name: _node(name.capitalize()) for name in ("relu", "tanh", "sigmoid", "sin")},
    "gelu": _node("Gelu", approximate="none"),
    "silu": lambda values: values * values.made("Sigmoid", values),
    "elu": _node("Elu", alpha=1.0),
    "leaky-relu": _node("LeakyRelu", alpha=0.01),
    AVG_L1_NORM: lambda v: v / np.maximum(abs(v) @ np.full((v.width, 1), 1 / v.width), LEAST_NORM),
}


def export(encoder: Encoder, path: Path) -> None:
    """Write encoder and decoder, with the scaling, as one model.

    Its input is `observation`, (n, d) float32 in physical units; its outputs are `latent`, (n, l),
    and, if there is a decoder, `reconstruction`, (n, d) in physical units. Its metadata has the
    header, which describes the environment.
    """
    write_new(path, model(encoder).SerializeToString(deterministic=True))


def model(encoder: Encoder) -> onnx.ModelProto:
    """The ONNX model, checked."""

    def outputs(observation: Any) -> Iterator[tuple[str, Any]]:
        latent = encoder.arrays.encode(observation)
        yield "latent", latent
        if encoder.can_decode:
            coded = _Rows(latent.graph, "latent", latent.width)  # so that a decoder begins there
            yield "reconstruction", encoder.arrays.decode(coded)

    return traced(encoder.name, encoder.size, outputs, encoder.header.as_json())


def traced(
    name: str,
    size: int,
    outputs: Callable[[Any], Iterable[tuple[str, Any]]],
    metadata: Mapping[str, Any],
) -> onnx.ModelProto:
    """The model of a computation in NumPy, checked.

    `outputs` computes values with their names of observations (rows, size), the model's input. The
    metadata, plain JSON, are its property jbrep.
    """
    graph, described = _Graph(), []
    for output, rows in outputs(_Rows(graph, "observation", size)):
        graph.node("Identity", rows, output=output)
        described.append(_described(output, rows.width))
    inputs = [_described("observation", size)]
    made = helper.make_model(
        helper.make_graph(graph.nodes, name, inputs, described, graph.constants),
        functions=graph.functions,
        opset_imports=[helper.make_opsetid(*each) for each in graph.opsets.items()],
        ir_version=graph.ir_version,
        producer_name="jbrep",
    )
    helper.set_model_props(made, {"jbrep": json.dumps(metadata)})
    onnx.checker.check_model(made, full_check=True)
    return made


def _described(name: str, size: int) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, _FLOAT, ("rows", size))
