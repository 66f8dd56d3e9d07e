"""Encoders as ONNX models, for other programs."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import ArrayLike
from onnx import TensorProto, helper, numpy_helper

from jbrep.dataset import Scaler
from jbrep.encoders.encoder import Encoder
from jbrep.encoders.layers import AVG_L1_NORM, EPSILON, LAYER_NORM, LEAST_NORM, Layer
from jbrep.errors import InputError
from jbrep.records.storage import exists, write_whole

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


class _Graph:
    """Nodes and constants, in order; values are (rows, numbers), and known by name."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, name: str, value: ArrayLike, kind: type[np.generic] = np.float32) -> str:
        """Add a constant; its name."""
        made = np.asarray(value, kind, order="C")
        self.constants.append(numpy_helper.from_array(made, name))
        return name

    def node(self, operator: str, inputs: tuple[str, ...], output: str, **attributes: Any) -> str:
        """Add an operation; its output's name."""
        self.nodes.append(helper.make_node(operator, inputs, [output], output, **attributes))
        return output

    def take(self, value: str, places: ArrayLike, output: str) -> str:
        """Some numbers of a value, in that order."""
        numbers = self.constant(f"{output}.places", places, np.int64)
        return self.node("Gather", (value, numbers), output, axis=1)

    def join(self, values: tuple[str, ...], output: str) -> str:
        """Values side by side."""
        return self.node("Concat", values, output, axis=1)

    def layers(self, part: str, layers: tuple[Layer, ...], value: str, output: str) -> str:
        """Add a part's layers, from a value to the output."""
        for i, layer in enumerate(layers):
            names = f"{part}.{i}.weight", f"{part}.{i}.bias"
            weight, bias = map(self.constant, names, (layer.weight.T, layer.bias))
            dense = self.node("Gemm", (value, weight, bias), f"{part}.{i}.dense")
            value = self._activation(layer, dense, f"{part}.{i}")
        return self.node("Identity", (value,), output)

    def _activation(self, layer: Layer, value: str, output: str) -> str:
        """Add a layer's activation, from a value to the output."""
        if layer.activation == "silu":
            share = self.node("Sigmoid", (value,), f"{output}.sigmoid")
            return self.node("Mul", (value, share), output)
        if layer.activation == LAYER_NORM:
            ones = self.constant(f"{output}.scale", np.ones_like(layer.bias))
            return self.node("LayerNormalization", (value, ones), output, epsilon=EPSILON)
        if layer.activation == AVG_L1_NORM:
            shares = np.full((len(layer.bias), 1), 1 / len(layer.bias))
            sizes = self.node("Abs", (value,), f"{output}.abs")
            mean = (sizes, self.constant(f"{output}.shares", shares))
            least = self.constant(f"{output}.least", LEAST_NORM)
            norm = (self.node("MatMul", mean, f"{output}.mean"), least)
            return self.node("Div", (value, self.node("Max", norm, f"{output}.norm")), output)
        operator, attributes = _OPERATORS[layer.activation]
        return self.node(operator, (value,), output, **attributes)

    def scale(self, scaler: Scaler, value: str, output: str) -> str:
        """Add what `Scaler.scale` does, from a value to the output."""
        size, angles = len(scaler.low), list(scaler.angles)
        self.constant("centre", scaler.centre)
        self.constant("half_width", scaler.half_width)
        self.node("Sub", (value, "centre"), "centred")
        plain = scaler.clip is None and not angles
        scaled = self.node("Div", ("centred", "half_width"), output if plain else "divided")
        if scaler.clip is not None:
            limits = map(self.constant, ("least", "most"), (-scaler.clip, scaler.clip))
            scaled = self.node("Clip", (scaled, *limits), "limited" if angles else output)
        if not angles:
            return scaled
        turned = self.take(value, angles, "angles")
        parts = self.node("Sin", (turned,), "sines"), self.node("Cos", (turned,), "cosines")
        places = np.arange(size + len(angles))
        places[angles] = size + np.arange(len(angles))
        places[size:] += len(angles)
        return self.take(self.join((scaled, *parts), "with_angles"), places, output)

    def unscale(self, scaler: Scaler, value: str, output: str) -> str:
        """Add what `Scaler.unscale` does, after `scale`."""
        size, angles = len(scaler.low), list(scaler.angles)
        linear = self.take(value, np.arange(size), "linear") if angles else value
        self.node("Mul", (linear, "half_width"), "widened")
        moved = self.node("Add", ("widened", "centre"), "moved" if angles else output)
        if not angles:
            return moved
        sine = self.take(value, angles, "sine")
        cosine = self.take(value, np.arange(size, scaler.size), "cosine")
        centre = self.constant("angle_centre", scaler.centre[angles])
        turn = self.constant("turn", 2 * math.pi)
        ahead = self.node("Sub", (self._angle(sine, cosine), centre), "ahead")
        turns = self.node("Round", (self.node("Div", (ahead, turn), "parts"),), "turns")
        whole = self.node("Mul", (turns, turn), "whole")
        back = self.node("Sub", ("angle", whole), "wrapped")
        places = np.arange(size)
        places[angles] = size + np.arange(len(angles))
        return self.take(self.join((moved, back), "with_turned"), places, output)

    def _angle(self, sine: str, cosine: str) -> str:
        """Add the angle with that sine and cosine, or multiples of them: ONNX has no atan2.

        The smaller is divided by the larger; 0 where both are 0.
        """
        for name, number in (("zero", 0), ("one", 1), ("half_turn", math.pi)):
            self.constant(name, number)
        sizes = self.node("Abs", (sine,), "sine.abs"), self.node("Abs", (cosine,), "cosine.abs")
        steep = self.node("Greater", sizes, "steep")
        small = self.node("Where", (steep, cosine, sine), "small")
        large = self.node("Where", (steep, sine, cosine), "large")
        none = self.node("Equal", (large, "zero"), "none")
        ratio = self.node("Div", (small, self.node("Where", (none, "one", large), "by")), "ratio")
        flat = self.node("Atan", (ratio,), "flat")
        self.constant("minus_half_turn", -math.pi)
        below = self.node("Less", (sine, "zero"), "below")
        side = self.node("Where", (below, "minus_half_turn", "half_turn"), "side")
        behind = self.node("Less", (cosine, "zero"), "behind")
        base = self.node("Where", (behind, side, "zero"), "base")
        quarter = self.node("Mul", (side, self.constant("half", 0.5)), "quarter")
        level = self.node("Add", (base, flat), "level")
        upright = self.node("Sub", (quarter, flat), "upright")
        return self.node("Where", (steep, upright, level), "angle")


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
    sizes = {"latent": encoder.latent_size}
    _encode(graph, encoder)
    if encoder.can_decode:
        _decode(graph, encoder)
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
    helper.set_model_props(made, {"jbrep": json.dumps(encoder.header.as_json())})
    onnx.checker.check_model(made, full_check=True)
    return made


def _encode(graph: _Graph, encoder: Encoder) -> None:
    """Add all from observation to latent."""
    scaled = graph.scale(encoder.scaler, "observation", "scaled")
    code = graph.layers("encoder", encoder.encoder, scaled, "code" if encoder.kept else "latent")
    if encoder.kept:
        graph.join((code, graph.take(scaled, encoder.kept, "kept")), "latent")


def _decode(graph: _Graph, encoder: Encoder) -> None:
    """Add all from latent to reconstruction."""
    latent, kept = "latent", encoder.kept
    coded = encoder.latent_size - len(kept)
    code = graph.take(latent, np.arange(coded), "code_again") if kept else latent
    decoded = graph.layers("decoder", encoder.decoder, code, "decoded")
    if kept:
        beside = graph.take(latent, np.arange(coded, encoder.latent_size), "kept_again")
        both = graph.join((decoded, beside), "with_kept")
        decoded = graph.take(both, encoder.restored, "restored")
    graph.unscale(encoder.scaler, decoded, "reconstruction")


def _rows(name: str, size: int) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, ("rows", size))
