"""The encoder: from observations to latents and back, through layers; and its file.

That is safetensors with a JSON header; reading one runs nothing in it.
"""

from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, Union

import numpy as np

from jbrep.coordinates import Coordinates, is_torch, library_of
from jbrep.coordinates.placing import nearest
from jbrep.dataset import Scaler
from jbrep.encoders.base import BaseEncoder, Float32, OwnEncoder
from jbrep.encoders.header import HELD_OUT_MSE, IMPORTED, EncoderHeader
from jbrep.encoders.layers import MAX_UNITS, ONNX, Layer, check_tensor, run
from jbrep.envs.task import Task, check_same
from jbrep.errors import InputError
from jbrep.records import container
from jbrep.records.container import Tensors
from jbrep.records.document import document_from
from jbrep.records.storage import write_whole

if TYPE_CHECKING:
    from torch.nn import Module

    from jbrep.encoders.imported import Model  # imports onnx

SUFFIX = ".safetensors"
Layers = tuple[Union[Layer, "Model"], ...]
Values = TypeVar("Values")  # a NumPy array, or a torch tensor


class Arrays(NamedTuple):
    """An encoder's arrays, all NumPy's or all torch tensors on one device, and what it computes.

    Written once for NumPy, torch and ONNX.
    """

    scaler: Scaler  # of observations
    # encoder, decoder: layers
    encoder: Layers
    decoder: Layers
    kept: list[int]  # places of the scaled numbers that pass around the layers

    def encode(self, observation: Any) -> Any:
        """Latents (..., l) of observations (..., d): arrays, torch tensors, or rows of a model."""
        scaled = self.scaler.scale(observation)
        code = run(self.encoder, scaled)
        if not self.kept:
            return code
        return library_of(code).concatenate((code, scaled[..., self.kept]), -1)

    def decode(self, latent: Any) -> Any:
        """Observations (..., d) from latents (..., l)."""
        coded = -len(self.kept) or None
        scaled = run(self.decoder, latent[..., :coded])
        if self.kept:
            beside = library_of(scaled).concatenate((scaled, latent[..., coded:]), -1)
            places = np.arange(self.scaler.size)
            places[self.kept] = self.scaler.size + np.arange(len(self.kept))
            scaled = beside[..., places.tolist()]
        return self.scaler.unscale(scaled)


class Encoder(BaseEncoder):
    """An encoder with its decoder and the scaling that both expect.

    It takes observations in physical units, as data sets and environments give them, and applies
    its own scaling. All arithmetic is float32. A network that was trained elsewhere is one layer,
    see `jbrep.encoders.imported`.

    Args:
        header: its kind, name, task and origin.
        scaler: fitted on the training part of its data.
        encoder: layers from the scaled numbers of an observation to the code; none if the code is
            these numbers themselves.
        decoder: layers from the code back to the scaled numbers; none where there is no decoder.
        keep: features that pass around the layers: scaled, they follow the code in the latent.

    Attributes:
        header: that of its file, with what follows from the other arguments.
        kept: places of the scaled numbers that pass around the layers.
        arrays: what it computes with, in NumPy.
    """

    def __init__(
        self,
        header: EncoderHeader,
        scaler: Scaler,
        encoder: Layers,
        decoder: Layers,
        keep: tuple[str, ...] = (),
    ):
        self.name, self.kind, self.task = header.name, header.kind, header.environment
        self.size = self.task.size
        self.scaler, self.encoder, self.decoder = scaler, encoder, decoder
        self._check(keep)
        self.header = header.replace(
            coordinates=scaler.coordinates.parts if scaler.coordinates else (),
            clip=scaler.clip,
            keep=keep,
            encoder=[layer.activation for layer in encoder],
            decoder=[layer.activation for layer in decoder],
        )
        code = encoder[-1].units if encoder else scaler.size
        self.kept = scaler.places(keep, self.task)
        self.latent_size = code + len(self.kept)
        self.can_decode = bool(decoder) or not encoder
        identifying = {n: v for n, v in self.header.as_json().items() if n != "commits"}
        self.fingerprint = container.checksum(self.tensors(), identifying)
        self.arrays = Arrays(scaler, encoder, decoder, self.kept)
        self._on: dict[Any, Arrays] = {}  # by device

    def _check(self, keep: tuple[str, ...]) -> None:
        for name in ("low", "high"):
            check_tensor(name, getattr(self.scaler, name), (len(self.scaler.features(self.task)),))
        if keep and not self.encoder:
            raise InputError("features can pass around layers, where there are some")
        sizes = [self.scaler.size]
        for part in ("encoder", "decoder"):
            for i, layer in enumerate(getattr(self, part)):
                layer.check(f"{part}.{i}", sizes[-1])
                sizes.append(layer.units)
        if self.decoder and sizes[-1] != self.scaler.size:
            raise InputError(f"the last layer has {sizes[-1]} units, expected {self.scaler.size}")
        if max(sizes) > MAX_UNITS:
            raise InputError(f"a layer has {max(sizes)} units: the limit is {MAX_UNITS}")

    @staticmethod
    def from_torch(
        encoder: "Module", task: Task | str, decoder: "Module | None" = None, name: str = "own"
    ) -> "Encoder":
        """An encoder that runs a torch module, exported as ONNX; the module stays as it is.

        Args:
            encoder: takes observations (n, d) in physical units, gives latents (n, l), whatever it
                does between, as far as `torch.onnx.export` can follow it. Its method `encode` is
                used if it has one.
            task: whose observations it reads, or that task's name.
            decoder: takes latents, gives observations; its method `decode` is used if it has one.
                None for the `decode` of the encoder, or none.
            name: what tables will call it: lower-case letters, digits and hyphens.
        """
        from jbrep.encoders.imported import of_modules  # imports onnx
        from jbrep.envs.description import as_task  # imports Gymnasium

        known = as_task(task)
        return _imported(known, name, "torch", *of_modules(encoder, known.size, decoder))

    @staticmethod
    def from_onnx(
        path: Path, task: Task | str, decoder: Path | None = None, name: str = "own"
    ) -> "Encoder":
        """An encoder from ONNX models.

        A model has one input, (n, d) in physical units, and one output; or the outputs `latent` and
        `reconstruction`, as jbrep exports them. Numbers in other files must be beside it.

        Args:
            path: of the encoder's model.
            task: whose observations it reads.
            decoder: path of a model from latents to observations; None for the encoder's
                `reconstruction`, or none.
            name: what tables will call it: lower-case letters, digits and hyphens.
        """
        from jbrep.encoders.imported import of_files  # imports onnx
        from jbrep.envs.description import as_task  # imports Gymnasium

        known = as_task(task)
        return _imported(known, name, "onnx", *of_files(path, known.size, decoder))

    def with_header(self, **changes: Any) -> "Encoder":
        """The same encoder with other values of some fields in its header."""
        header = self.header.replace(**changes)
        return Encoder(header, self.scaler, self.encoder, self.decoder, header.keep)

    def tensors(self) -> dict[str, Float32]:
        """All its numbers, by their names in its file."""
        named = {"low": self.scaler.low, "high": self.scaler.high}
        for part in ("encoder", "decoder"):
            for i, layer in enumerate(getattr(self, part)):
                named |= {f"{part}.{i}.{n}": each for n, each in layer.tensors().items()}
        return named

    def encode(self, observation: Values) -> Values:
        """Encode observations (..., d) in physical units as latents (..., l).

        A torch tensor gives a tensor on the same device, and gradients flow through all layers but
        ONNX models; anything else is converted to a NumPy array.
        """
        values, arrays = self._prepare(observation, self.size, "observations")
        return arrays.encode(values)

    __call__ = encode

    def decode(self, latent: Values) -> Values:
        """Decode latents (..., l) to reconstructed observations (..., d) in physical units."""
        self.check_decodes("it can't reconstruct observations")
        values, arrays = self._prepare(latent, self.latent_size, "latents")
        return arrays.decode(values)

    def scale(self, observation: Float32) -> Float32:
        """Scale observations (..., d) linearly, as its training data were."""
        if self.scaler.coordinates:
            return super().scale(observation)
        return (observation - self.scaler.centre) / self.scaler.half_width

    def _prepare(self, values: Any, size: int, what: str) -> tuple[Any, Arrays]:
        """Values as float32, and this encoder's arrays on the device that they are on."""
        if is_torch(values):
            values, arrays = values.float(), self._on_device(values.device)
        else:
            values, arrays = np.asarray(values, np.float32), self.arrays
        if not values.ndim or values.shape[-1] != size:
            raise InputError(
                f"{self.name} takes {what} of {size} numbers, but got shape {tuple(values.shape)}"
            )
        return values, arrays

    def _on_device(self, device: Any) -> Arrays:
        if device not in self._on:
            import torch

            def move(array: Float32) -> Any:
                return torch.tensor(array, device=device)

            with torch.inference_mode(False):  # so that gradients can flow through them later
                scaler = self.scaler.moved(move)
                encoder, decoder = (
                    tuple(layer.moved(move) for layer in part)
                    for part in (self.encoder, self.decoder)
                )
            self._on[device] = Arrays(scaler, encoder, decoder, self.kept)
        return self._on[device]

    @property
    def not_decoded(self) -> tuple[str, ...]:
        return self.scaler.coordinates.not_decoded if self.scaler.coordinates else ()

    def comparable(self, decoded: Any, observation: Any) -> Any:
        on_coordinates = self.scaler.coordinates is not None
        return nearest(self.task, decoded, observation) if on_coordinates else decoded

    def check_task(self, task: Task) -> None:
        check_same(task, self.task, self.name)  # other arguments, such as another body, will do


def _imported(
    task: Task, name: str, package: str, encoder: "Model", decoder: "Model | None"
) -> Encoder:
    """An encoder of models that take physical units, made with a package, once it was tried."""
    versions = {each: version(each) for each in ("jbrep", "numpy", package)}
    header = EncoderHeader(kind=IMPORTED, name=name, environment=task, versions=versions)
    ones: Float32 = np.ones(task.size, np.float32)
    made = Encoder(header, Scaler(-ones, ones), (encoder,), (decoder,) if decoder else ())
    tried = OwnEncoder(made, task)
    if made.can_decode:
        tried.decode(tried.encode(np.zeros((2, task.size))))
    return made


def pack(encoder: Encoder) -> bytes:
    """The bytes of an encoder's file."""
    return container.pack(encoder.tensors(), encoder.header.as_json())


def save(encoder: Encoder, path: Path | str) -> None:
    """Write an encoder's file, whole or not at all."""
    write_whole(Path(path), pack(encoder))


def load(path: Path) -> Encoder:
    """Read an encoder's file."""
    return unpack(path, *container.read(path, "encoder"))


def unpack(path: Path, tensors: Tensors, header: dict[str, Any]) -> Encoder:
    """The encoder with these tensors, which are used up, and this header, from that path."""
    known = document_from(header, path, EncoderHeader)
    try:
        return _encoder(known, tensors)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _encoder(header: EncoderHeader, tensors: Tensors) -> Encoder:
    if header.kind != IMPORTED and type(header.metrics.get(HELD_OUT_MSE)) is not float:
        raise InputError(f"the header's metrics have no {HELD_OUT_MSE}, or not as a float")
    encoder, decoder = (
        tuple(_layer(f"{part}.{i}", name, tensors) for i, name in enumerate(getattr(header, part)))
        for part in ("encoder", "decoder")
    )
    made = Coordinates(header.environment, header.coordinates) if header.coordinates else None
    scaler = Scaler(_take(tensors, "low"), _take(tensors, "high"), made, header.clip)
    if tensors:
        raise InputError(f"unexpected tensor {min(tensors)}")
    return Encoder(header, scaler, encoder, decoder, header.keep)


def _layer(name: str, activation: str, tensors: Tensors) -> "Layer | Model":
    if activation != ONNX:
        return Layer(_take(tensors, f"{name}.weight"), _take(tensors, f"{name}.bias"), activation)
    from jbrep.encoders.imported import Model  # imports onnx

    return Model(_take(tensors, f"{name}.{ONNX}").tobytes())


def _take(tensors: Tensors, name: str) -> np.ndarray:
    if name not in tensors:
        raise InputError(f"tensor {name} is missing")
    return tensors.pop(name)
