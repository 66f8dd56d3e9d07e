"""What an encoder is: observations to latents and back, through dense layers."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset import Scaler
from jbrep.errors import InputError
from jbrep.jitterbug.tasks import Task

Float32 = NDArray[np.float32]
Values = TypeVar("Values")  # a NumPy array, or a torch tensor

FULL = "full"  # what the identity is called beside encoders to fewer numbers
_WIDEST = 4096
_MOST = 1e12  # what float32 arithmetic stays clear of


class Layer(NamedTuple):
    """A dense layer: activation(values @ weight.T + bias)."""

    weight: Any  # (out, in) float32
    bias: Any  # (out,) float32
    activation: str


ACTIVATIONS: dict[str, Callable[[Any], Any]] = {  # of NumPy arrays and of torch tensors alike
    "linear": lambda values: values,
    "relu": lambda values: values.clip(min=0),
    "tanh": lambda values: values.tanh() if hasattr(values, "tanh") else np.tanh(values),
}


def run(layers: tuple[Layer, ...], values: Any) -> Any:
    """Values (..., in) through the layers, (..., out)."""
    for weight, bias, activation in layers:
        values = ACTIVATIONS[activation](values @ weight.T + bias)
    return values


class _Parts(NamedTuple):
    """The numbers of an encoder, all in one library and on one device."""

    centre: Any
    half_width: Any
    encoder: tuple[Layer, ...]
    decoder: tuple[Layer, ...]


@dataclass(frozen=True, eq=False)
class Encoder:
    """An encoder with its decoder, and the scaling that they were made for.

    It takes observations in physical units, as data sets and environments give them, and scales
    them to [-1, 1] over its training data itself. All arithmetic is float32.

    Attributes:
        header: what it is and where it comes from, see docs/encoders.md; plain JSON.
        scaler: fitted on the training part of its data.
        encoder: layers from d scaled features to l; none leaves them as they are.
        decoder: layers from l to d.

    Raises:
        InputError: tensors whose shapes don't fit together, of another type than float32, or not
            finite; an unknown activation. The message names the tensor.
    """

    header: Mapping[str, Any]
    scaler: Scaler
    encoder: tuple[Layer, ...]
    decoder: tuple[Layer, ...]
    _on: dict[Any, _Parts] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        sizes = [self.size]
        for name, tensor in self.tensors().items():
            self._check(name, tensor, sizes)
        if sizes[-1] != self.size:
            raise InputError(f"the last layer gives {sizes[-1]} features: {self.size} are needed")
        if max(sizes) > _WIDEST or self.latent_size > self.size:
            raise InputError(
                f"layers of {sizes[1:]} units: at most {_WIDEST}, and no more in the latent than "
                f"there are features, {self.size}"
            )
        for layer in (*self.encoder, *self.decoder):
            if layer.activation not in ACTIVATIONS:
                choices = ", ".join(ACTIVATIONS)
                raise InputError(f"unknown activation {layer.activation!r}: one of {choices}")
        scaling = self.scaler.centre, self.scaler.half_width
        self._on[None] = _Parts(*scaling, self.encoder, self.decoder)

    def _check(self, name: str, tensor: Any, sizes: list[int]) -> None:
        """One tensor; `sizes` has those of the layers up to it."""
        if name.endswith("weight"):
            rows = max(1, tensor.shape[0]) if np.ndim(tensor) == 2 else 1
            expected: tuple[int, ...] = (rows, sizes[-1])
            sizes.append(rows)
        else:
            expected = (sizes[-1],)
        if tensor.shape != expected:
            raise InputError(f"tensor {name} has shape {tensor.shape}: {expected} is needed")
        if tensor.dtype != np.float32:
            raise InputError(f"tensor {name} holds {tensor.dtype}: float32 is needed")
        if not (np.abs(tensor) < _MOST).all():
            raise InputError(f"tensor {name} holds a number that is not finite, or beyond {_MOST}")

    def tensors(self) -> dict[str, Float32]:
        """All its numbers by name, as they stand in its file."""
        named = {"low": self.scaler.low, "high": self.scaler.high}
        for part in ("encoder", "decoder"):
            for i, layer in enumerate(getattr(self, part)):
                named |= {f"{part}.{i}.weight": layer.weight, f"{part}.{i}.bias": layer.bias}
        return named

    @property
    def name(self) -> str:
        """What tables call it: `dae-8`, `dae-deep-8`, `pca-8`, `identity`."""
        return self.header["name"]

    @property
    def size(self) -> int:
        """Length d of an observation."""
        return len(self.scaler.low)

    @property
    def latent_size(self) -> int:
        """Length l of a latent."""
        return len(self.encoder[-1].bias) if self.encoder else self.size

    @property
    def feature_names(self) -> tuple[str, ...]:
        """The features of an observation, in order."""
        return tuple(self.header["features"])

    def encode(self, observation: Values) -> Values:
        """Observations (..., d) in physical units to latents (..., l).

        A torch tensor gives one on the same device, and gradients flow through; anything else is
        taken as a NumPy array.

        Raises:
            InputError: observations of another length.
        """
        values, parts = self._prepare(observation, self.size, "observations")
        return run(parts.encoder, (values - parts.centre) / parts.half_width)

    __call__ = encode

    def decode(self, latent: Values) -> Values:
        """Latents (..., l) to reconstructed observations (..., d) in physical units.

        Raises:
            InputError: latents of another length.
        """
        values, parts = self._prepare(latent, self.latent_size, "latents")
        return run(parts.decoder, values) * parts.half_width + parts.centre

    def _prepare(self, values: Any, size: int, what: str) -> tuple[Any, _Parts]:
        """Values as float32, and this encoder's numbers where the values are."""
        if type(values).__module__ == "torch":
            values, parts = values.float(), self._on_device(values.device)
        else:
            values, parts = np.asarray(values, np.float32), self._on[None]
        if not values.ndim or values.shape[-1] != size:
            raise InputError(
                f"{self.name} takes {what} of {size} numbers: shape {tuple(values.shape)}"
            )
        return values, parts

    def _on_device(self, device: Any) -> _Parts:
        """The numbers as torch tensors there, made once."""
        if device not in self._on:
            import torch

            def move(array: Float32) -> Any:
                return torch.tensor(array, device=device)

            def move_all(layers: tuple[Layer, ...]) -> tuple[Layer, ...]:
                return tuple(Layer(move(w), move(b), activation) for w, b, activation in layers)

            parts = self._on[None]
            self._on[device] = _Parts(
                move(parts.centre),
                move(parts.half_width),
                move_all(parts.encoder),
                move_all(parts.decoder),
            )
        return self._on[device]

    def check_task(self, task: Task) -> None:
        """Make sure that it reads this task's observations.

        Raises:
            InputError: it was made for other features, or for the same in another order.
        """
        ours, theirs = self.feature_names, task.feature_names
        if ours == theirs:
            return
        if self.header["task"] != task.name:
            raise InputError(
                f"{self.name} was made for {self.header['task']}, whose features differ from those "
                f"of {task.name}: take one made for {task.name}"
            )
        place = next(
            i for i in range(max(len(ours), len(theirs))) if ours[i : i + 1] != theirs[i : i + 1]
        )
        named = [names[place] if place < len(names) else "nothing" for names in (ours, theirs)]
        raise InputError(
            f"{self.name} has {named[0]} as feature {place}, where {task.name} has {named[1]}"
        )
