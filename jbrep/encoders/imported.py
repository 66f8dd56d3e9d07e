"""Networks from elsewhere, torch modules and ONNX models: any graph, kept and run as ONNX.

What a file holds is run by onnxruntime alone: no Python, no operators of other libraries, and no
data from another file.
"""

import copy
import logging
import warnings
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from google.protobuf.message import Message
from onnx import ModelProto, TensorProto, helper
from onnx.utils import Extractor

from jbrep.coordinates import is_torch
from jbrep.encoders.layers import ONNX
from jbrep.errors import InputError, first_line, refusing
from jbrep.records.storage import exists

LATENT, RECONSTRUCTION = "latent", "reconstruction"  # the outputs of a model that jbrep exported
_FLOATS = (TensorProto.FLOAT, TensorProto.DOUBLE)


class Model:
    """An ONNX model as a layer, from rows (..., inputs) to (..., units), run on the CPU.

    Its file has one input (rows, inputs) and one output (rows, units), both of floats.
    """

    activation = ONNX

    def __init__(self, content: bytes):
        with refusing("it isn't an ONNX model", describe=first_line):
            self.proto = onnx.load_model_from_string(content)
            self._content = content
            for each in _messages(self.proto):
                if isinstance(each, TensorProto) and each.data_location == TensorProto.EXTERNAL:
                    raise InputError(f"the tensor {each.name} is in another file")
            ends = (*self.proto.graph.input, *self.proto.graph.output)
            given, made = (each.type.tensor_type for each in ends)
            self.inputs, self.units = (each.shape.dim[1].dim_value for each in (given, made))
            self._dtype = helper.tensor_dtype_to_np_dtype(given.elem_type)

    def __reduce__(self) -> Any:
        return Model, (self._content,)

    def __call__(self, values: Any) -> Any:
        if is_torch(values):
            return values.new_tensor(self(values.detach().cpu().numpy()))
        if not isinstance(values, np.ndarray):  # rows of a model that it becomes part of
            return values.through(self.proto, self.units)
        rows = values.reshape(-1, self.inputs).astype(self._dtype)
        with refusing("the ONNX model failed", describe=first_line):
            (made,) = self._session.run(None, {self.proto.graph.input[0].name: rows})
        if made.shape != (len(rows), self.units):
            raise InputError(f"the ONNX model made shape {made.shape} of {len(rows)} rows")
        if not np.isfinite(made).all():
            raise InputError("the ONNX model returned numbers that are not finite")
        return made.astype(np.float32).reshape(*values.shape[:-1], self.units)

    @cached_property
    def _session(self) -> Any:
        return session(self._content)

    def moved(self, move: Any) -> "Model":
        """Itself: it is the same for all devices."""
        return self

    def tensors(self) -> dict[str, Any]:
        """Its bytes, by their name in a file."""
        return {ONNX: np.frombuffer(self._content, np.uint8)}

    def check(self, name: str, inputs: int) -> None:
        """Make sure that it takes so many numbers."""
        if self.inputs != inputs:
            raise InputError(f"{name} takes {self.inputs} numbers, but gets {inputs}")


def session(content: bytes) -> Any:
    """A session of onnxruntime, of one thread, that says nothing but errors."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    return onnxruntime.InferenceSession(content, options)


Models = tuple[Model, Model | None]  # encoder and decoder


def of_files(path: Path, size: int, decoder: Path | None) -> Models:
    """Encoder and decoder from ONNX files, as `Encoder.from_onnx` takes them."""
    proto, back = _read(path)
    if decoder is not None:
        back, _ = _read(decoder)
    into = _layer(str(path), proto, size)
    return into, _layer(str(decoder or path), back, into.units) if back else None


def _read(path: Path) -> tuple[ModelProto, ModelProto | None]:
    """A model; of one with a latent and a reconstruction the ways to and from the latent."""
    if not exists(path):
        raise InputError(f"no file {path}")
    with refusing(f"{path} isn't an ONNX model that can be read", describe=first_line):
        model = onnx.load(path)  # with numbers in files beside it
        onnx.checker.check_model(model)
    outputs = [each.name for each in model.graph.output]
    if sorted(outputs) == [LATENT, RECONSTRUCTION]:
        given = [each.name for each in model.graph.input]
        extract = Extractor(model).extract_model
        return extract(given, [LATENT]), extract([LATENT], [RECONSTRUCTION])
    return model, None


def _layer(said: str, model: ModelProto, size: int) -> Model:
    """A model as a layer that takes rows of that size; `said` is what messages call it."""
    graph, constants = model.graph, {each.name for each in model.graph.initializer}
    inputs = [each for each in graph.input if each.name not in constants]
    for what, ends in {"inputs": inputs, "outputs": graph.output}.items():
        if len(ends) != 1:
            names = ", ".join(each.name for each in ends) or "none"
            raise InputError(f"{said} has the {what} {names}: expected one")
    graph.ClearField("input")
    graph.input.extend(inputs)
    given, made = (each.type.tensor_type for each in (*graph.input, *graph.output))
    shape = [dim.dim_value or dim.dim_param or "?" for dim in given.shape.dim]
    fits = len(shape) == 2 and (isinstance(shape[1], str) or shape[1] == size)
    if not fits or given.elem_type not in _FLOATS:
        shown = f"({', '.join(map(str, shape))})"
        raise InputError(f"the input of {said} is {shown}, expected floats (rows, {size})")
    graph.ClearField("value_info")
    for each in _messages(model):  # what exporters say of the machine that they ran on
        for field in ("doc_string", "metadata_props"):
            if field in each.DESCRIPTOR.fields_by_name:
                each.ClearField(field)
    given.shape.CopyFrom(_shape(size))
    made.ClearField("shape")
    rows = np.zeros((2, size), helper.tensor_dtype_to_np_dtype(given.elem_type))
    what = f"{said} can't be run on several rows: export it with a dynamic first dimension"
    with refusing(what, describe=first_line):
        (result,) = session(model.SerializeToString()).run(None, {inputs[0].name: rows})
    if result.ndim != 2 or result.dtype.kind != "f":
        raise InputError(
            f"{said} made {result.dtype} of shape {result.shape} of 2 rows, expected floats (2, l)"
        )
    made.shape.CopyFrom(_shape(result.shape[1]))
    return Model(model.SerializeToString(deterministic=True))


def _shape(width: int) -> onnx.TensorShapeProto:
    return helper.make_tensor_type_proto(TensorProto.FLOAT, ("rows", width)).tensor_type.shape


def _messages(message: Message) -> Iterator[Message]:
    yield message
    for field, value in message.ListFields():
        if field.message_type:
            for each in [value] if isinstance(value, Message) else value:
                yield from _messages(each)


def of_modules(encoder: Any, size: int, decoder: Any) -> Models:
    """Encoder and decoder from torch modules, as `Encoder.from_torch` takes them."""
    decoder = encoder if decoder is None and hasattr(encoder, "decode") else decoder
    layer = _exported(encoder, "encode", size)
    return layer, None if decoder is None else _exported(decoder, "decode", layer.units)


def _exported(module: Any, method: str, size: int) -> Model:
    """A module, by that method or else `forward`, as a layer."""
    import torch

    said = type(module).__name__
    if not isinstance(module, torch.nn.Module):
        raise InputError(f"{said} isn't a torch module, of which an Encoder is made")
    for name in ("torch.onnx", "torch._subclasses.fake_tensor"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # of parts that it doesn't need
    with refusing(f"{said} can't be exported"), warnings.catch_warnings(action="ignore"):
        copied = copy.deepcopy(getattr(module, "_orig_mod", module))  # of a compiled one
        copied = copied.cpu().float().eval()
        copied.forward = getattr(copied, method, copied.forward)
        rows, any_number = torch.zeros(2, size), {0: torch.export.Dim.DYNAMIC}
        traced = torch.export.export(copied, (rows,), dynamic_shapes=(any_number,))
        program = torch.onnx.export(traced, verbose=False)
        assert program
        return _layer(said, program.model_proto, size)
