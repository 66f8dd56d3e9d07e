"""The encoder: from observations to latents and back, through dense layers."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import zip_longest
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset import Scaler
from jbrep.dataset.scaling import library_of
from jbrep.encoders.base import BaseEncoder
from jbrep.encoders.layers import ACTIVATIONS, FIRST_ACTIVATIONS, MAX_UNITS, Layer, run
from jbrep.envs.task import Task, check_same
from jbrep.errors import InputError
from jbrep.jitterbug.tasks import get_task
from jbrep.records import container
from jbrep.records.record import from_plain

Float32 = NDArray[np.float32]
Values = TypeVar("Values")  # a NumPy array, or a torch tensor

FULL = "full"  # the representation that is the whole observation
FORMAT = "jbrep encoder"
FORMAT_VERSION = 3  # the newest; see `Encoder.format_version`
IDENTITY = "identity"  # the kind of encoder that leaves the scaled observation as it is
IMPORTED = "imported"  # the kind of encoder that was trained elsewhere
MAX_MAGNITUDE = 1e12  # of any number, far from where float32 overflows
_SCALING = ("low", "high")  # tensors


class _Parts(NamedTuple):
    """An encoder's arrays, all NumPy's, or torch tensors on one device."""

    scaler: Scaler
    encoder: tuple[Layer, ...]
    decoder: tuple[Layer, ...]


@dataclass(frozen=True, eq=False)
class Encoder(BaseEncoder):
    """An encoder with its decoder and the scaling that both expect.

    It takes observations in physical units, as data sets and environments give them, and applies
    its own scaling. All arithmetic is float32.

    Attributes:
        header: its kind, name and origin as plain JSON, see docs/encoder-file.md.
        scaler: fitted on the training part of its data.
        encoder: layers from the scaled numbers of an observation to the code; empty for the
            identity.
        decoder: layers from the code back to the scaled numbers; empty where there is no decoder.
        keep: features that pass around the layers: scaled, they follow the code in the latent.

    Raises:
        InputError: tensors whose shapes are inconsistent, whose type is not float32, or that hold
            numbers that are not finite; an unknown activation. The message names the tensor.
    """

    header: Mapping[str, Any]
    scaler: Scaler
    encoder: tuple[Layer, ...]
    decoder: tuple[Layer, ...]
    keep: tuple[str, ...] = ()
    _on: dict[Any, _Parts] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        self._check_scaling()
        sizes = [self.scaler.size]
        for name, tensor in self.tensors().items():
            if name not in _SCALING:
                self._check(name, tensor, sizes)
        if self.decoder and sizes[-1] != self.scaler.size:
            raise InputError(f"the last layer has {sizes[-1]} units, expected {self.scaler.size}")
        if max(sizes) > MAX_UNITS:
            raise InputError(f"a layer has {max(sizes)} units: the limit is {MAX_UNITS}")
        for layer in (*self.encoder, *self.decoder):
            if layer.activation not in ACTIVATIONS:
                choices = ", ".join(ACTIVATIONS)
                raise InputError(
                    f"unknown activation {layer.activation!r}: choose one of {choices}"
                )
        self._on[None] = _Parts(self.scaler, self.encoder, self.decoder)

    def _check_scaling(self) -> None:
        """Check the scaling, and what passes around the layers."""
        for name in _SCALING:
            _check_tensor(name, getattr(self.scaler, name), (self.size,))
        angles, clip = self.scaler.angles, self.scaler.clip
        if len(set(angles)) < len(angles) or not all(0 <= i < self.size for i in angles):
            raise InputError("its angles must be different features")
        if clip is not None and not 1 <= clip < MAX_MAGNITUDE:
            raise InputError(f"its clip is {clip}: it must be at least 1")
        if unknown := [name for name in self.keep if name not in self.feature_names]:
            raise InputError(f"{unknown[0]} can't pass around its layers: it is no feature")
        if self.keep and (not self.encoder or len(set(self.keep)) < len(self.keep)):
            raise InputError("different features can pass around layers, where there are some")

    def _check(self, name: str, tensor: Any, sizes: list[int]) -> None:
        """Check one tensor; `sizes` holds the widths of the layers so far, and grows."""
        if name.endswith("weight"):
            rows = max(1, tensor.shape[0]) if np.ndim(tensor) == 2 else 1
            expected: tuple[int, ...] = (rows, sizes[-1])
            sizes.append(rows)
        else:
            expected = (sizes[-1],)
        _check_tensor(name, tensor, expected)

    @staticmethod
    def from_torch(
        encoder: Any, task: Task | str, decoder: Any = None, name: str = "own"
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

        Raises:
            InputError: a module is no such chain; the message names the operation.
        """
        from jbrep.encoders.from_torch import convert  # imports torch
        from jbrep.envs.description import describe  # imports Gymnasium

        known = describe(task) if isinstance(task, str) else task
        return convert(encoder, known, decoder, name)

    def __repr__(self) -> str:
        return f"Encoder({self.name}, {self.header.get('task')}, {self.size} to {self.latent_size})"

    def tensors(self) -> dict[str, Float32]:
        """All its numbers, by their names in its file."""
        named = {"low": self.scaler.low, "high": self.scaler.high}
        for part in ("encoder", "decoder"):
            for i, layer in enumerate(getattr(self, part)):
                named |= {f"{part}.{i}.weight": layer.weight, f"{part}.{i}.bias": layer.bias}
        return named

    @property
    def name(self) -> str:
        """Its name in tables and files, such as `dae-8`, `dae-deep-8`, `pca-8`, `identity`."""
        return self.header["name"]

    @property
    def kind(self) -> str:
        """How it was made."""
        return self.header["kind"]

    @property
    def representation(self) -> str:
        """What an agent that sees its latent sees: `full` for the identity, else its name."""
        return FULL if self.name == IDENTITY else self.name

    @property
    def can_decode(self) -> bool:
        """Whether there is a decoder."""
        return bool(self.decoder) or not self.encoder

    @cached_property
    def kept(self) -> list[int]:
        """Places of the scaled numbers that pass around the layers."""
        angles = (self.feature_names[i] for i in self.scaler.angles)
        scaled = (*self.feature_names, *angles) if self.keep else ()
        return [i for i, name in enumerate(scaled) if name in self.keep]

    @cached_property
    def restored(self) -> list[int]:
        """Places of the scaled numbers among decoded ones with those that are kept after them."""
        places = list(range(self.scaler.size))
        for i, place in enumerate(self.kept):
            places[place] = self.scaler.size + i
        return places

    @property
    def file_header(self) -> dict[str, Any]:
        """The header with the fields that its file needs."""
        angles = [self.feature_names[i] for i in self.scaler.angles]
        inputs = {"angles": angles, "clip": self.scaler.clip, "keep": list(self.keep)}
        activations = {
            part: [layer.activation for layer in getattr(self, part)]
            for part in ("encoder", "decoder")
        }
        start = {"format": FORMAT, "format_version": self.format_version}
        used = {name: value for name, value in inputs.items() if value}
        return {**start, **self.header, **used, **activations}

    @property
    def format_version(self) -> int:
        """The oldest version of the file that can hold it, so that old files keep their bytes.

        Version 1 has no environment: it is the Jitterbug's. Version 3 is of encoders that a jbrep
        of version 2 can't read: imported, with other activations, without a decoder, with a
        latent larger than the observation, with angles as sine and cosine, with a limit of scaled
        values, or with some that pass around the layers.
        """
        if "environment" not in self.header:
            return 1
        if self.scaler.angles or self.scaler.clip is not None or self.keep:
            return 3
        used = {layer.activation for layer in (*self.encoder, *self.decoder)}
        known = self.kind != IMPORTED and used <= FIRST_ACTIVATIONS
        return 2 if known and self.can_decode and self.latent_size <= self.size else 3

    @property
    def fingerprint(self) -> str:
        """SHA-256 of its header and numbers, but not of commits: it identifies the encoder."""
        header = {name: value for name, value in self.file_header.items() if name != "commits"}
        return container.checksum(self.tensors(), header)

    @property
    def size(self) -> int:
        """Length d of an observation."""
        return len(self.scaler.low)

    @property
    def latent_size(self) -> int:
        """Length l of a latent."""
        code = len(self.encoder[-1].bias) if self.encoder else self.scaler.size
        return code + len(self.kept)

    @cached_property
    def task(self) -> Task:
        """The task whose observations it was made from, with the arguments of its environment.

        Raises:
            InputError: the header's description can't be used, or is of other features.
        """
        try:
            task = self._described_task()
        except (ValueError, RecursionError) as error:
            raise InputError(f"the environment of {self.name} can't be used: {error}") from None
        if self.header["task"] != task.name:
            raise InputError(
                f"{self.name} is for {self.header['task']}, but its environment is {task.name}"
            )
        if self.feature_names != task.feature_names:
            pairs = enumerate(
                zip_longest(self.feature_names, task.feature_names, fillvalue="nothing")
            )
            place, (ours, its) = next((i, pair) for i, pair in pairs if pair[0] != pair[1])
            raise InputError(
                f"{self.name} has {ours} as feature {place}, where {task.name} has {its}"
            )
        return task

    def _described_task(self) -> Task:
        if "environment" in self.header:
            return from_plain(self.header["environment"], Task)
        return get_task(self.header["task"]).describe()  # version 1 knew the Jitterbug's alone

    @property
    def feature_names(self) -> tuple[str, ...]:
        """Names of the features of an observation, in order."""
        return tuple(self.header["features"])

    def encode(self, observation: Values) -> Values:
        """Encode observations (..., d) in physical units as latents (..., l).

        A torch tensor gives a tensor on the same device, and gradients flow through; anything else
        is converted to a NumPy array.

        Raises:
            InputError: observations of another length.
        """
        values, parts = self._prepare(observation, self.size, "observations")
        scaled = parts.scaler.scale(values)
        code = run(parts.encoder, scaled)
        if not self.keep:
            return code
        return library_of(code).concatenate((code, scaled[..., self.kept]), -1)

    __call__ = encode

    def decode(self, latent: Values) -> Values:
        """Decode latents (..., l) to reconstructed observations (..., d) in physical units.

        Raises:
            InputError: latents of another length, or there is no decoder.
        """
        if not self.can_decode:
            raise InputError(f"{self.name} has no decoder: it can't reconstruct observations")
        values, parts = self._prepare(latent, self.latent_size, "latents")
        coded = self.latent_size - len(self.kept)
        scaled = run(parts.decoder, values[..., :coded])
        if self.keep:
            scaled = library_of(scaled).concatenate((scaled, values[..., coded:]), -1)
            scaled = scaled[..., self.restored]
        return parts.scaler.unscale(scaled)

    def scale(self, observation: Float32) -> Float32:
        """Scale observations (..., d) linearly, as its training data were."""
        return (observation - self.scaler.centre) / self.scaler.half_width

    def _prepare(self, values: Any, size: int, what: str) -> tuple[Any, _Parts]:
        """Values as float32, and this encoder's arrays on the device that they are on."""
        if type(values).__module__ == "torch":
            values, parts = values.float(), self._on_device(values.device)
        else:
            values, parts = np.asarray(values, np.float32), self._on[None]
        if not values.ndim or values.shape[-1] != size:
            raise InputError(
                f"{self.name} takes {what} of {size} numbers, but got shape {tuple(values.shape)}"
            )
        return values, parts

    def _on_device(self, device: Any) -> _Parts:
        """This encoder's arrays as torch tensors on a device, made once."""
        if device not in self._on:
            import torch

            def move(array: Float32) -> Any:
                return torch.tensor(array, device=device)

            def move_all(layers: tuple[Layer, ...]) -> tuple[Layer, ...]:
                return tuple(Layer(move(w), move(b), activation) for w, b, activation in layers)

            scaler, encoder, decoder = self._on[None]
            moved = replace(scaler, low=move(scaler.low), high=move(scaler.high))
            self._on[device] = _Parts(moved, move_all(encoder), move_all(decoder))
        return self._on[device]

    def check_task(self, task: Task) -> None:
        """Make sure that it can read this task's observations.

        Other arguments of the same environment will do, such as another body of the same robot.

        Raises:
            InputError: it was made for another environment or other features.
        """
        check_same(task, self.task, self.name)


def _check_tensor(name: str, tensor: Any, shape: tuple[int, ...]) -> None:
    """Make sure that a tensor is of that shape, of float32, and finite.

    Raises:
        InputError: it isn't.
    """
    if tensor.shape != shape:
        raise InputError(f"tensor {name} has shape {tensor.shape}, expected {shape}")
    if tensor.dtype != np.float32:
        raise InputError(f"tensor {name} has type {tensor.dtype}, expected float32")
    if not (np.abs(tensor) < MAX_MAGNITUDE).all():
        raise InputError(
            f"tensor {name} holds a number that is not finite or not below {MAX_MAGNITUDE:g}"
        )
