"""Reading ONNX models of strangers: bounded, and nothing but regular files of one folder."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import onnx
from google.protobuf.message import DecodeError
from numpy.typing import NDArray
from onnx import TensorProto, numpy_helper

from jbrep.errors import InputError, first_line
from jbrep.records.storage import exists, read_file

_MAX_BYTES = 1 << 26  # of a model, and of the file of its numbers
_MAX_NODES = 1000
FLOATS = (TensorProto.FLOAT, TensorProto.DOUBLE)
_TYPES = (*FLOATS, TensorProto.INT32, TensorProto.INT64, TensorProto.BOOL)
_UNREADABLE = (DecodeError, onnx.checker.ValidationError, ValueError, TypeError, RuntimeError)

Constants = dict[str, NDArray[np.generic]]


def read(path: Path) -> tuple[onnx.ModelProto, Constants]:
    """A model, checked by ONNX's own checker, and its initialisers by name.

    Exporters put large tensors into a second file: it is read if it is a regular file in the
    model's folder, never through a path or a link.

    Raises:
        InputError: there is no such file, or it is no ONNX model that can be read.
    """
    model = onnx.ModelProto()
    try:
        model.ParseFromString(_bytes(path))
        if len(model.graph.node) > _MAX_NODES:
            raise InputError(f"{path} has more than {_MAX_NODES} nodes")
        _fetch_all(model.graph.initializer, path.parent)
        onnx.checker.check_model(model)
        return model, {tensor.name: array(tensor) for tensor in model.graph.initializer}
    except InputError:
        raise
    except _UNREADABLE as error:
        reason = first_line(error)
        raise InputError(f"{path} is no ONNX model that can be read: {reason}") from None


def array(tensor: TensorProto) -> NDArray[np.generic]:
    """The numbers of a tensor.

    Raises:
        InputError: it is of another type, or in another file.
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
    total = 0
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
        start = int(where.get("offset", 0))
        end = start + int(where["length"]) if "length" in where else len(contents[name])
        total += end - start
        if not 0 <= start <= end <= len(contents[name]) or total > _MAX_BYTES:
            raise InputError(f"the tensor {tensor.name} doesn't fit {folder / name}")
        tensor.raw_data = contents[name][start:end]
        tensor.data_location = TensorProto.DEFAULT
        del tensor.external_data[:]


def _bytes(path: Path) -> bytes:
    """The bytes of a regular file.

    Raises:
        InputError: there is none, or it is too large.
    """
    if not exists(path):
        raise InputError(f"no file {path}")
    return read_file(path, _MAX_BYTES)
