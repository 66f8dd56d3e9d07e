"""The encoder file: safetensors with a JSON header; reading one runs nothing in it."""

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jbrep.dataset import Scaler
from jbrep.encoders.encoder import FORMAT, FORMAT_VERSION, IMPORTED, Encoder
from jbrep.encoders.layers import Layer
from jbrep.encoders.names import check_name
from jbrep.errors import InputError, check_version
from jbrep.records import container
from jbrep.records.container import Tensors
from jbrep.records.storage import write_whole

SUFFIX = ".safetensors"
HELD_OUT_MSE = "held_out_mse"  # the metric that every encoder has, unless it was trained elsewhere
_TEXTS = ("kind", "name", "task")
_RECORDS = ("training", "data", "metrics", "versions")
_RESERVED = ("format", "format_version", "encoder", "decoder", "angles", "clip", "keep", "sha256")


def save(encoder: Encoder, path: Path) -> None:
    """Write an encoder's file, whole or not at all.

    Raises:
        InputError: it can't be written, or `load` would refuse it.
    """
    try:
        content = _pack(encoder)
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"can't save an encoder in {path}: {error}") from None
    write_whole(path, content)


def _pack(encoder: Encoder) -> bytes:
    """The bytes of an encoder's file, checked as `load` checks them."""
    header = encoder.file_header
    if reserved := [name for name in _RESERVED if name in encoder.header]:
        raise InputError(f"the header must not have {reserved[0]}, which saving adds")
    _encoder(json.loads(json.dumps(header)), encoder.tensors())
    content = container.pack(encoder.tensors(), header)
    if len(content) > container.MAX_BYTES:
        raise InputError(f"{len(content):,} bytes are more than {container.MAX_BYTES:,}")
    return content


def load(path: Path) -> Encoder:
    """Read an encoder's file.

    Raises:
        InputError: no such file, another kind of file, one of a newer jbrep, or one whose header
            and tensors are inconsistent; the message names the tensor.
        DamageError: it isn't what was written.
    """
    return unpack(path, *container.read(path, "encoder"))


def unpack(path: Path, tensors: Tensors, header: dict[str, Any]) -> Encoder:
    """The encoder with these tensors and this header, both of which are used up.

    Args:
        path: of the file that they come from, for messages.
        tensors: as `Encoder.tensors` gives them.
        header: as `Encoder.file_header` is.

    Raises:
        InputError: as `load`.
    """
    if header.get("format") != FORMAT:
        raise InputError(f"{path} is not a jbrep encoder")
    check_version(path, header.get("format_version"), FORMAT_VERSION)
    try:
        return _encoder(header, tensors)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _encoder(header: dict[str, Any], tensors: Tensors) -> Encoder:
    """The encoder with that header and those tensors, both of which are used up.

    Raises:
        InputError: they are invalid or inconsistent.
    """
    _check(header)
    parts = {}
    for part in ("encoder", "decoder"):
        tensor_names = [
            (f"{part}.{i}.weight", f"{part}.{i}.bias") for i in range(len(header[part]))
        ]
        parts[part] = [
            Layer(_take(tensors, weight), _take(tensors, bias), activation)
            for (weight, bias), activation in zip(tensor_names, header.pop(part), strict=True)
        ]
    names = {name: header.pop(name, []) for name in ("angles", "keep")}
    places = tuple(_place(header["features"], name) for name in names["angles"])
    clip = header.pop("clip", None)
    scaler = Scaler(_take(tensors, "low"), _take(tensors, "high"), places, clip)
    if tensors:
        raise InputError(f"unexpected tensor {min(tensors)}")
    expected = (len(header["features"]),)
    if scaler.low.shape != expected:
        raise InputError(f"tensor low has shape {scaler.low.shape}, expected {expected}")
    del header["format"], header["format_version"]
    layers = tuple(parts["encoder"]), tuple(parts["decoder"])
    encoder = Encoder(header, scaler, *layers, tuple(names["keep"]))
    encoder.task  # noqa: B018  checked before it is needed
    return encoder


def _check(header: dict[str, Any]) -> None:
    """Make sure that every field is there and of its type."""
    fields = [(name, str) for name in _TEXTS] + [(name, dict) for name in _RECORDS]
    if header["format_version"] > 1:
        fields.append(("environment", dict))
    for name, kind in [*fields, ("features", list), ("encoder", list), ("decoder", list)]:
        if not isinstance(header.get(name), kind):
            raise InputError(f"the header has no {name}, or not as a {kind.__name__}")
    check_name(header["name"])
    absent = 0.0 if header["kind"] == IMPORTED else None
    if not isinstance(header["metrics"].get(HELD_OUT_MSE, absent), float):
        raise InputError(f"the header's metrics have no {HELD_OUT_MSE}, or not as a float")
    for name in ("features", "encoder", "decoder"):
        _check_words(name, header[name])
    for name in ("angles", "keep"):
        _check_words(name, header.get(name, []))
    if type(header.get("clip", 0)) not in (int, float):
        raise InputError("the header's clip must be a number")
    if not all(map(math.isfinite, _floats(header))):
        raise InputError("the header holds a number that is not finite")


def _check_words(name: str, words: Any) -> None:
    if not isinstance(words, list) or not all(isinstance(word, str) for word in words):
        raise InputError(f"the header's {name} must be strings")


def _floats(value: Any) -> Iterator[float]:
    """All floats in plain JSON."""
    if isinstance(value, float):
        yield value
    elif isinstance(value, Mapping | list):
        for item in value.values() if isinstance(value, Mapping) else value:
            yield from _floats(item)


def _place(features: list[str], name: str) -> int:
    if name not in features:
        raise InputError(f"the header's angle {name} is no feature")
    return features.index(name)


def _take(tensors: Tensors, name: str) -> np.ndarray:
    if name not in tensors:
        raise InputError(f"tensor {name} is missing")
    return tensors.pop(name)
