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
from jbrep.records.storage import MissingFileError, open_regular, read_regular, write_whole

Tensors = dict[str, NDArray[Any]]

MAX_BYTES = 1 << 24  # that `read` accepts unless told otherwise
_MAX_HEADER = 100_000_000  # bytes, as safetensors has it
_KEY = "jbrep"  # of the header in the file's metadata
_CHECKSUM = "sha256"  # of the rest of the header and all tensors, in the header


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


def read(path: Path, what: str, most: int = MAX_BYTES) -> tuple[Tensors, dict[str, Any]]:
    """Tensors and header of such a file, once its checksum has been verified.

    Args:
        path: the file.
        what: it should be, for messages, such as "encoder".
        most: bytes that it may have.

    Raises:
        DamageError: it isn't what was written, or has no checksum.
    """
    try:
        raw = read_regular(path, most)
    except MissingFileError:
        raise InputError(f"no {what} at {path}") from None
    if not raw:
        raise InputError(
            f"{path} is not a jbrep {what}: it must be a regular file of 1 to {most:,} bytes"
        )
    return unpack(raw, path, what)


def unpack(raw: bytes, path: Path, what: str) -> tuple[Tensors, dict[str, Any]]:
    """What `pack` made bytes of, as `read` returns it; the path is for messages.

    Raises:
        DamageError: it isn't what was written, or has no checksum.
    """
    try:
        tensors, header = safetensors.numpy.load(raw), _header(raw)
    except (SafetensorError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path} is not a jbrep {what}, or is truncated: {error}") from None
    if _CHECKSUM not in header:
        raise DamageError(
            f"{path} has no checksum, so an older jbrep wrote it: delete it to start over"
        )
    if header.pop(_CHECKSUM) != checksum(tensors, header):
        raise DamageError(
            f"{path} is damaged (its checksum doesn't match): delete it to start over"
        )
    return tensors, header


def peek(path: Path) -> dict[str, Any]:
    """The header of such a file, by no checksum; empty for any other file."""
    try:
        file = open_regular(path)
        if file is None:
            return {}
        with file:
            start = file.read(8)
            start += file.read(min(int.from_bytes(start, "little"), _MAX_HEADER))
        header = _header(start)
        header.pop(_CHECKSUM, None)
        return header
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return {}


def _header(raw: bytes) -> dict[str, Any]:
    """The header, from bytes that safetensors has found well-formed."""
    length = int.from_bytes(raw[:8], "little")
    text = json.loads(raw[8 : 8 + length])["__metadata__"][_KEY]
    header = json.loads(text)
    if not isinstance(header, dict) or json.dumps(header) != text:
        raise TypeError("its header is not in the form that jbrep writes")
    json.dumps(header, ensure_ascii=False).encode()  # half a character can't be written again
    return header


def without(prefix: str, tensors: Tensors) -> Tensors:
    """Those tensors whose names begin so, without that beginning."""
    return {
        name.removeprefix(prefix): values
        for name, values in tensors.items()
        if name.startswith(prefix)
    }
