"""Tensors with a JSON header in one safetensors file, with a checksum; reading runs no code."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray
from safetensors import SafetensorError

from jbrep.errors import DamageError, InputError
from jbrep.records.storage import exists, read_file, write_whole

Tensors = dict[str, NDArray[Any]]

_KEY = "jbrep"  # of the header in the file's metadata
_CHECKSUM = "sha256"  # of the rest of the header and all tensors, in the header
_MALFORMED = (SafetensorError, ValueError, KeyError, TypeError, RecursionError)


def write(path: Path, tensors: Tensors, header: Mapping[str, Any]) -> None:
    """Write tensors and header with their checksum, whole or not at all."""
    write_whole(path, pack(tensors, header))


def pack(tensors: Tensors, header: Mapping[str, Any]) -> bytes:
    """The bytes of such a file."""
    checked = {**header, _CHECKSUM: checksum(tensors, header)}
    in_order = {name: np.asarray(t, order="C") for name, t in tensors.items()}
    return safetensors.numpy.save(in_order, {_KEY: json.dumps(checked)})


def checksum(tensors: Tensors, header: Mapping[str, Any]) -> str:
    """SHA-256 of a header, as JSON with sorted keys, and of all tensors."""
    plain = json.loads(json.dumps(header))
    digest = hashlib.sha256(json.dumps(plain, sort_keys=True).encode())
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tensor.dtype} {tensor.shape} ".encode())
        digest.update(np.ascontiguousarray(tensor).data)
    return digest.hexdigest()


def read(path: Path, what: str) -> tuple[Tensors, dict[str, Any]]:
    """Tensors and header of a file of what is named, once its checksum has been verified."""
    if not exists(path):
        raise InputError(f"no {what} at {path}")
    return unpack(read_file(path), path, what)


def unpack(raw: bytes, path: Path, what: str) -> tuple[Tensors, dict[str, Any]]:
    """What `pack` made bytes of, as `read` returns it; the path is for messages."""
    try:
        tensors, header = safetensors.numpy.load(raw), _header(raw)
    except _MALFORMED as error:
        is_onnx = path.suffix == ".onnx"
        why = "jbrep encoder import makes an encoder of an ONNX model" if is_onnx else error
        raise InputError(f"{path} is not a jbrep {what}, or is truncated: {why}") from None
    if header.pop(_CHECKSUM, None) != checksum(tensors, header):
        raise DamageError(
            f"{path} is damaged (its checksum doesn't match): delete it to start over"
        )
    return tensors, header


def peek(path: Path) -> dict[str, Any]:
    """The header of such a file, by no checksum; empty for any other file."""
    try:
        with path.open("rb") as file:
            start = file.read(8)
            header = _header(start + file.read(int.from_bytes(start, "little")))
    except (OSError, OverflowError, MemoryError, *_MALFORMED):
        return {}
    header.pop(_CHECKSUM, None)
    return header


def _header(raw: bytes) -> dict[str, Any]:
    length = int.from_bytes(raw[:8], "little")
    header = json.loads(json.loads(raw[8 : 8 + length])["__metadata__"][_KEY])
    if not isinstance(header, dict):
        raise TypeError("its header is not an object")
    return header


def without(prefix: str, tensors: Tensors) -> Tensors:
    """Those tensors whose names begin so, without that beginning."""
    return {
        name.removeprefix(prefix): values
        for name, values in tensors.items()
        if name.startswith(prefix)
    }
