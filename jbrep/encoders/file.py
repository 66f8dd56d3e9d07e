"""The encoder file: safetensors, with a header of JSON; reading one runs nothing in it."""

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jbrep.dataset import Scaler
from jbrep.encoders.encoder import Encoder, Layer
from jbrep.errors import DamageError, InputError, check_version
from jbrep.files import container
from jbrep.files.container import Tensors

FORMAT = "jbrep encoder"
FORMAT_VERSION = 1
SUFFIX = ".safetensors"
HELD_OUT_MSE = "held_out_mse"  # the metric that every encoder has
_HASH = "sha256"  # of the rest of the header and all tensors
_TEXTS = ("kind", "name", "task")
_RECORDS = ("training", "data", "metrics", "versions")


def save(encoder: Encoder, path: Path) -> None:
    """Write an encoder's file, whole or not at all.

    Raises:
        InputError: it can't be written.
    """
    header = {**_whole_header(encoder), _HASH: fingerprint(encoder)}
    container.write(path, encoder.tensors(), header)


def fingerprint(encoder: Encoder) -> str:
    """SHA-256 of an encoder's header and numbers: it names the encoder."""
    return _digest(_whole_header(encoder), encoder.tensors())


def _whole_header(encoder: Encoder) -> dict[str, Any]:
    """The header with what only the file needs."""
    activations = {
        part: [layer.activation for layer in getattr(encoder, part)]
        for part in ("encoder", "decoder")
    }
    return {"format": FORMAT, "format_version": FORMAT_VERSION, **encoder.header, **activations}


def load(path: Path) -> Encoder:
    """Read an encoder's file.

    Raises:
        InputError: no such file, another kind of file, one of a newer jbrep, or one whose header
            and tensors don't fit together; the message names the tensor.
        DamageError: it isn't what was written.
    """
    tensors, header = container.read(path, "encoder")
    if header.get("format") != FORMAT or not isinstance(header.get("format_version"), int):
        raise InputError(f"{path} is not a jbrep encoder")
    check_version(path, header["format_version"], FORMAT_VERSION)
    if header.pop(_HASH, None) != _digest(header, tensors):
        raise DamageError(f"{path} is damaged: its numbers or header aren't those written")
    try:
        return _encoder(header, tensors)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _digest(header: Mapping[str, Any], tensors: Tensors) -> str:
    """SHA-256 of a header in its one spelling, and of all tensors."""
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tensor.dtype} {tensor.shape} ".encode())
        digest.update(np.ascontiguousarray(tensor).tobytes())
    return digest.hexdigest()


def _encoder(header: dict[str, Any], tensors: Tensors) -> Encoder:
    """Both put together; what is left to go wrong is what a forger wrote."""
    _check(header)
    parts = {}
    for part in ("encoder", "decoder"):
        names = [(f"{part}.{i}.weight", f"{part}.{i}.bias") for i in range(len(header[part]))]
        parts[part] = [
            Layer(_take(tensors, weight), _take(tensors, bias), activation)
            for (weight, bias), activation in zip(names, header.pop(part), strict=True)
        ]
    scaler = Scaler(_take(tensors, "low"), _take(tensors, "high"))
    if tensors:
        raise InputError(f"tensor {min(tensors)} is none of an encoder's")
    expected = (len(header["features"]),)
    if scaler.low.shape != expected:
        raise InputError(f"tensor low has shape {scaler.low.shape}: {expected} is needed")
    del header["format"], header["format_version"]
    return Encoder(header, scaler, tuple(parts["encoder"]), tuple(parts["decoder"]))


def _check(header: dict[str, Any]) -> None:
    """Every field is there and of its type."""
    fields = [(name, str) for name in _TEXTS] + [(name, dict) for name in _RECORDS]
    for name, kind in [*fields, ("features", list), ("encoder", list), ("decoder", list)]:
        if not isinstance(header.get(name), kind):
            raise InputError(f"its header has no {name}")
    if not re.fullmatch("[a-z0-9-]+", header["name"]):
        raise InputError(f"its name {header['name']!r} is none")
    if not isinstance(header["metrics"].get(HELD_OUT_MSE), float):
        raise InputError(f"its header has no {HELD_OUT_MSE} among its metrics")
    for name in ("features", "encoder", "decoder"):
        if not all(isinstance(word, str) for word in header[name]):
            raise InputError(f"its header's {name} are no words")


def _take(tensors: Tensors, name: str) -> np.ndarray:
    if name not in tensors:
        raise InputError(f"tensor {name} is missing")
    return tensors.pop(name)
