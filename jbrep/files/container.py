"""Tensors with a header of JSON in one safetensors file; reading one runs nothing in it."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors.numpy
from numpy.typing import NDArray
from safetensors import SafetensorError

from jbrep.errors import InputError
from jbrep.files.storage import read_regular, write_whole

Tensors = dict[str, NDArray[Any]]

_KEY = "jbrep"  # of the header among the file's metadata
_MAX_BYTES = 1 << 24


def write(path: Path, tensors: Tensors, header: Mapping[str, Any]) -> None:
    """Write tensors and header, whole or not at all.

    Raises:
        InputError: they can't be written.
    """
    write_whole(path, safetensors.numpy.save(tensors, {_KEY: json.dumps(header)}))


def read(path: Path, what: str, most: int = _MAX_BYTES) -> tuple[Tensors, dict[str, Any]]:
    """Tensors and header of such a file.

    Args:
        path: the file.
        what: it should be, for messages: an encoder.
        most: bytes that it may have.

    Raises:
        InputError: no such file, or another kind of file.
    """
    try:
        raw = read_regular(path, most)
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"no {what} at {path}") from None
    except OSError as error:
        raise InputError(f"can't read {path}: {error.strerror or error}") from error
    if not raw:
        raise InputError(
            f"{path} is not a jbrep {what}: a regular file of 1 to {most:,} bytes is needed"
        )
    try:
        return safetensors.numpy.load(raw), _header(raw)
    except (SafetensorError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path} is not a jbrep {what}, or cut short: {error}") from None


def _header(raw: bytes) -> dict[str, Any]:
    """The header, of bytes that safetensors found well-formed."""
    length = int.from_bytes(raw[:8], "little")
    text = json.loads(raw[8 : 8 + length])["__metadata__"][_KEY]
    header = json.loads(text)
    if not isinstance(header, dict) or json.dumps(header) != text:
        raise TypeError("its header isn't as jbrep writes it")
    return header
