"""The encoder file: safetensors with a JSON header; reading one runs nothing in it."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jbrep.coordinates import Coordinates
from jbrep.dataset import Scaler
from jbrep.encoders.encoder import Encoder, Layers
from jbrep.encoders.header import HELD_OUT_MSE, IMPORTED, EncoderHeader
from jbrep.encoders.layers import ONNX, Layer
from jbrep.errors import InputError
from jbrep.records import container
from jbrep.records.container import Tensors
from jbrep.records.document import document_from
from jbrep.records.storage import make_folder, write_new, write_whole

if TYPE_CHECKING:
    from jbrep.encoders.imported import Model

SUFFIX = ".safetensors"


def save(encoder: Encoder, path: Path) -> None:
    """Write an encoder's file, whole or not at all."""
    write_whole(path, _packed(encoder))


def save_new(encoder: Encoder, path: Path) -> None:
    """The same of a file that doesn't exist yet."""
    make_folder(path.parent)
    write_new(path, _packed(encoder))


def _packed(encoder: Encoder) -> bytes:
    return container.pack(encoder.tensors(), encoder.header.as_json())


def load(path: Path) -> Encoder:
    """Read an encoder's file."""
    return unpack(path, *container.read(path, "encoder"))


def unpack(path: Path, tensors: Tensors, header: dict[str, Any]) -> Encoder:
    """The encoder with these tensors, which are used up, and this header.

    Args:
        path: of the file that they come from, for messages.
        tensors: as `Encoder.tensors` gives them.
        header: as `EncoderHeader.as_json` gives it.
    """
    known = document_from(header, path, EncoderHeader)
    try:
        return _encoder(known, tensors)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _encoder(header: EncoderHeader, tensors: Tensors) -> Encoder:
    if header.kind != IMPORTED and type(header.metrics.get(HELD_OUT_MSE)) is not float:
        raise InputError(f"the header's metrics have no {HELD_OUT_MSE}, or not as a float")
    encoder = _layers("encoder", header.encoder, tensors)
    decoder = _layers("decoder", header.decoder, tensors)
    made = Coordinates(header.environment, header.coordinates) if header.coordinates else None
    scaler = Scaler(_take(tensors, "low"), _take(tensors, "high"), made, header.clip)
    if tensors:
        raise InputError(f"unexpected tensor {min(tensors)}")
    return Encoder(header, scaler, encoder, decoder, header.keep)


def _layers(part: str, activations: tuple[str, ...], tensors: Tensors) -> Layers:
    return tuple(
        _layer(f"{part}.{i}", activation, tensors) for i, activation in enumerate(activations)
    )


def _layer(name: str, activation: str, tensors: Tensors) -> "Layer | Model":
    if activation != ONNX:
        return Layer(_take(tensors, f"{name}.weight"), _take(tensors, f"{name}.bias"), activation)
    from jbrep.encoders.imported import Model  # imports onnx

    return Model(_take(tensors, f"{name}.{ONNX}").tobytes())


def _take(tensors: Tensors, name: str) -> np.ndarray:
    if name not in tensors:
        raise InputError(f"tensor {name} is missing")
    return tensors.pop(name)
