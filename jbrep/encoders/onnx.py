"""Encoders as ONNX models, for other programs."""

import json
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper

from jbrep.encoders.encoder import Encoder
from jbrep.encoders.onnx_graph import Graph
from jbrep.errors import InputError
from jbrep.records.record import to_plain
from jbrep.records.storage import exists, write_whole

_OPSET, _IR_VERSION = 17, 8
_LATER = 20, 9  # the same for models with GELU


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
    graph = Graph()
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
    header = {**encoder.header, "environment": to_plain(encoder.task)}
    helper.set_model_props(made, {"jbrep": json.dumps(header)})
    onnx.checker.check_model(made, full_check=True)
    return made


def _encode(graph: Graph, encoder: Encoder) -> None:
    """Add all from observation to latent."""
    scaled = graph.scale(encoder.scaler, "observation", "scaled")
    code = graph.layers("encoder", encoder.encoder, scaled, "code" if encoder.kept else "latent")
    if encoder.kept:
        graph.join((code, graph.take(scaled, encoder.kept, "kept")), "latent")


def _decode(graph: Graph, encoder: Encoder) -> None:
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
