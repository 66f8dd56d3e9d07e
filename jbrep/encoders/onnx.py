"""Encoders as ONNX models, for other programs."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from jbrep.encoders.activations import EPSILON, LAYER_NORM
from jbrep.encoders.encoder import Encoder, Layer
from jbrep.errors import InputError
from jbrep.files.storage import exists, write_whole

_OPSET, _IR_VERSION = 17, 8
_LATER = 20, 9  # the same for models with GELU
_OPERATORS: dict[str, tuple[str, dict[str, Any]]] = {
    "linear": ("Identity", {}),
    "relu": ("Relu", {}),
    "tanh": ("Tanh", {}),
    "sigmoid": ("Sigmoid", {}),
    "gelu": ("Gelu", {"approximate": "none"}),
    "gelu-tanh": ("Gelu", {"approximate": "tanh"}),
    "elu": ("Elu", {"alpha": 1.0}),
    "softplus": ("Softplus", {}),
    "sin": ("Sin", {}),
}


def export(encoder: Encoder, path: Path) -> None:
    """Write encoder and decoder, with the scaling, as one model.

    Its input is `observation`, (n, d) float32 in physical units; its outputs are `latent`, (n, l),
    and, if there is a decoder, `reconstruction`, (n, d) in physical units. Its metadata has the
    header, which describes the environment.

    Raises:
        InputError: the file exists already, or can't be written.
    """
    if exists(path):
        raise InputError(f"{path} exists already: choose another file")
    write_whole(path, model(encoder).SerializeToString(deterministic=True))


def model(encoder: Encoder) -> onnx.ModelProto:
    """The ONNX model, checked."""
    graph = _Graph()
    graph.constant("centre", encoder.scaler.centre)
    graph.constant("half_width", encoder.scaler.half_width)
    graph.node("Sub", ("observation", "centre"), "centred")
    graph.node("Div", ("centred", "half_width"), "scaled")
    graph.layers("encoder", encoder.encoder, "scaled", "latent")
    sizes = {"latent": encoder.latent_size}
    if encoder.can_decode:
        graph.layers("decoder", encoder.decoder, "latent", "decoded")
        graph.node("Mul", ("decoded", "half_width"), "widened")
        graph.node("Add", ("widened", "centre"), "reconstruction")
        sizes["reconstruction"] = encoder.size
    later = any("gelu" in layer.activation for layer in (*encoder.encoder, *encoder.decoder))
    opset, ir_version = _LATER if later else (_OPSET, _IR_VERSION)
    made = helper.make_model(
        helper.make_graph(
            graph.nodes,
            encoder.name,
            [_rows("observation", encoder.size)],
            [_rows(name, size) for name, size in sizes.items()],
            graph.constants,
        ),
        opset_imports=[helper.make_opsetid("", opset)],
        ir_version=ir_version,
        producer_name="jbrep",
    )
    header = {**encoder.header, "environment": encoder.task.as_json()}
    helper.set_model_props(made, {"jbrep": json.dumps(header)})
    onnx.checker.check_model(made, full_check=True)
    return made


def _rows(name: str, size: int) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, ("rows", size))


class _Graph:
    """The nodes and constants of a graph, in order."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, name: str, value: np.ndarray) -> str:
        self.constants.append(numpy_helper.from_array(np.ascontiguousarray(value), name))
        return name

    def node(self, operator: str, inputs: tuple[str, ...], output: str, **attributes: Any) -> str:
        self.nodes.append(helper.make_node(operator, inputs, [output], output, **attributes))
        return output

    def layers(self, part: str, layers: tuple[Layer, ...], value: str, output: str) -> None:
        """Add a part's layers, from a value to the output."""
        for i, layer in enumerate(layers):
            names = f"{part}.{i}.weight", f"{part}.{i}.bias"
            weight, bias = map(self.constant, names, (layer.weight.T, layer.bias))
            dense = self.node("Gemm", (value, weight, bias), f"{part}.{i}.dense")
            value = self.activation(layer, dense, f"{part}.{i}")
        self.node("Identity", (value,), output)

    def activation(self, layer: Layer, value: str, output: str) -> str:
        """Add a layer's activation, from a value to the output."""
        if layer.activation == "silu":
            share = self.node("Sigmoid", (value,), f"{output}.sigmoid")
            return self.node("Mul", (value, share), output)
        if layer.activation == LAYER_NORM:
            ones = self.constant(f"{output}.scale", np.ones_like(layer.bias))
            return self.node("LayerNormalization", (value, ones), output, epsilon=EPSILON)
        operator, attributes = _OPERATORS[layer.activation]
        return self.node(operator, (value,), output, **attributes)
