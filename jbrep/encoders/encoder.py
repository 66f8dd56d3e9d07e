"""The encoder: from observations to latents and back, through dense layers."""

import re
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

from jbrep.coordinates import is_torch, library_of
from jbrep.coordinates.nearest import nearest
from jbrep.dataset import Scaler
from jbrep.encoders.base import BaseEncoder, Float32, OwnEncoder
from jbrep.encoders.header import IMPORTED, MAX_MAGNITUDE, EncoderHeader
from jbrep.encoders.layers import ACTIVATIONS, MAX_UNITS, Layer, run
from jbrep.envs.task import Task, check_same
from jbrep.errors import InputError, choose
from jbrep.records import container

if TYPE_CHECKING:
    from torch.nn import Module

Layers = tuple[Layer, ...]
Values = TypeVar("Values")  # a NumPy array, or a torch tensor


class Arrays(NamedTuple):
    """An encoder's arrays, all NumPy's or all torch tensors on one device, and what it computes.

    Written once for NumPy, torch and ONNX.

    Attributes:
        scaler: of observations.
        encoder, decoder: layers.
        kept: places of the scaled numbers that pass around the layers.
    """

    scaler: Scaler
    encoder: Layers
    decoder: Layers
    kept: list[int]

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
    its own scaling. All arithmetic is float32.

    Args:
        header: its kind, name, task and origin.
        scaler: fitted on the training part of its data.
        encoder: layers from the scaled numbers of an observation to the code; none if the code is
            these numbers themselves.
        decoder: layers from the code back to the scaled numbers; none where there is no decoder.
        keep: features that pass around the layers: scaled, they follow the code in the latent.

    Attributes:
        header: that of its file, with what follows from the other arguments.
        scaler, encoder, decoder: as given.
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
        code = len(encoder[-1].bias) if encoder else scaler.size
        self.kept = scaler.places(keep, self.task)
        self.latent_size = code + len(self.kept)
        self.can_decode = bool(decoder) or not encoder
        identifying = {n: v for n, v in self.header.as_json().items() if n != "commits"}
        self.fingerprint = container.checksum(self.tensors(), identifying)
        self.arrays = Arrays(scaler, encoder, decoder, self.kept)
        self._on: dict[Any, Arrays] = {}  # by device

    def _check(self, keep: tuple[str, ...]) -> None:
        for name in ("low", "high"):
            _check_tensor(name, getattr(self.scaler, name), (len(self.scaler.features(self.task)),))
        if keep and not self.encoder:
            raise InputError("features can pass around layers, where there are some")
        sizes = [self.scaler.size]
        for part in ("encoder", "decoder"):
            for i, layer in enumerate(getattr(self, part)):
                sizes.append(_check_layer(f"{part}.{i}", layer, sizes[-1]))
        if self.decoder and sizes[-1] != self.scaler.size:
            raise InputError(f"the last layer has {sizes[-1]} units, expected {self.scaler.size}")
        if max(sizes) > MAX_UNITS:
            raise InputError(f"a layer has {max(sizes)} units: the limit is {MAX_UNITS}")

    @staticmethod
    def from_torch(
        encoder: "Module", task: Task | str, decoder: "Module | None" = None, name: str = "own"
    ) -> "Encoder":
        """An encoder with the layers of a torch module, which stays as it is.

        The module must be a chain of dense layers and activations of jbrep, as nn.Sequential or in
        a `forward` that torch.fx can trace, in evaluation: normalisation and any other affine maps
        become part of the layers.

        Args:
            encoder: takes observations (n, d) in physical units, gives latents (n, l). Its method
                `encode` is used if it has one.
            task: whose observations it reads, or that task's name.
            decoder: takes latents, gives observations; its method `decode` is used if it has one.
                None for the `decode` of the encoder, or none.
            name: what tables will call it: lower-case letters, digits and hyphens.
        """
        from jbrep.encoders.from_torch import layers_of  # imports torch
        from jbrep.envs.description import as_task  # imports Gymnasium

        known = as_task(task)
        return imported(known, name, *layers_of(encoder, known, decoder), "torch")

    def with_header(self, **changes: Any) -> "Encoder":
        """The same encoder with other values of some fields in its header."""
        header = self.header.replace(**changes)
        return Encoder(header, self.scaler, self.encoder, self.decoder, header.keep)

    def tensors(self) -> dict[str, Float32]:
        """All its numbers, by their names in its file."""
        named = {"low": self.scaler.low, "high": self.scaler.high}
        for part in ("encoder", "decoder"):
            for i, layer in enumerate(getattr(self, part)):
                named |= {f"{part}.{i}.weight": layer.weight, f"{part}.{i}.bias": layer.bias}
        return named

    def encode(self, observation: Values) -> Values:
        """Encode observations (..., d) in physical units as latents (..., l).

        A torch tensor gives a tensor on the same device, and gradients flow through; anything else
        is converted to a NumPy array.
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
        """This encoder's arrays as torch tensors on a device, made once."""
        if device not in self._on:
            import torch

            def move(array: Float32) -> Any:
                return torch.tensor(array, device=device)

            def move_all(layers: Layers) -> Layers:
                return tuple(Layer(move(w), move(b), activation) for w, b, activation in layers)

            with torch.inference_mode(False):  # so that gradients can flow through them later
                scaler = self.scaler.moved(move)
                encoder, decoder = move_all(self.encoder), move_all(self.decoder)
            self._on[device] = Arrays(scaler, encoder, decoder, self.kept)
        return self._on[device]

    @property
    def not_decoded(self) -> tuple[str, ...]:
        return self.scaler.coordinates.not_decoded if self.scaler.coordinates else ()

    def comparable(self, decoded: Any, observation: Any) -> Any:
        on_coordinates = self.scaler.coordinates is not None
        return nearest(self.task, decoded, observation) if on_coordinates else decoded

    def check_task(self, task: Task) -> None:
        """As for `BaseEncoder`; other arguments, such as another body of the robot, will do."""
        check_same(task, self.task, self.name)


def _check_layer(name: str, layer: Layer, inputs: int) -> int:
    """Check a layer of so many inputs; its units."""
    units = max(1, layer.weight.shape[0]) if np.ndim(layer.weight) == 2 else 1
    _check_tensor(f"{name}.weight", layer.weight, (units, inputs))
    _check_tensor(f"{name}.bias", layer.bias, (units,))
    choose(layer.activation, ACTIVATIONS, "activation")
    return units


def _check_tensor(name: str, tensor: Any, shape: tuple[int, ...]) -> None:
    """Make sure that a tensor is of that shape, of float32, and finite."""
    if tensor.shape != shape:
        raise InputError(f"tensor {name} has shape {tensor.shape}, expected {shape}")
    if tensor.dtype != np.float32:
        raise InputError(f"tensor {name} has type {tensor.dtype}, expected float32")
    if not (np.abs(tensor) < MAX_MAGNITUDE).all():
        raise InputError(
            f"tensor {name} holds a number that is not finite or not below {MAX_MAGNITUDE:g}"
        )


def imported(task: Task, name: str, encoder: Layers, decoder: Layers, package: str) -> Encoder:
    """An encoder that was trained elsewhere, from layers that take physical units.

    Args:
        task: whose observations it reads.
        name: what tables will call it: lower-case letters, digits and hyphens.
        encoder: from d features to l units.
        decoder: from l units to d features; empty if there is none.
        package: that it comes from, such as torch.
    """
    versions = {each: version(each) for each in ("jbrep", "numpy", package)}
    header = EncoderHeader(kind=IMPORTED, name=name, environment=task, versions=versions)
    ones = np.ones(task.size, np.float32)
    return Encoder(header, Scaler(-ones, ones), encoder, decoder)


def as_file(encoder: BaseEncoder) -> BaseEncoder:
    """The encoder that a file can hold, where a user's own is a module with such layers.

    Its header has no versions: equal layers are the same encoder, whatever converted them.

    Returns:
        The same encoder where it isn't a user's own, or can't be converted.
    """
    if not isinstance(encoder, OwnEncoder) or not encoder.is_module:
        return encoder
    name = re.sub("[^a-z0-9]+", "-", encoder.name.lower()).strip("-") or "own"
    try:
        return Encoder.from_torch(encoder.given, encoder.task, name=name).with_header(versions={})
    except InputError:
        return encoder
