"""Autoencoders, plain and denoising: a row is reconstructed, from a corrupted one with noise."""

from collections.abc import Iterable, Iterator, Mapping
from itertools import pairwise
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal

import torch
from msgspec import Meta
from torch import Tensor, nn

from jbrep.dataset import ScaledDataset
from jbrep.errors import InputError
from jbrep.training import settings
from jbrep.training.method import Network, Reconstructing
from jbrep.training.network import ARCHITECTURES, get_architecture, layers, stacks
from jbrep.training.objective import Layers, Objective, feature_weights
from jbrep.training.windows import Windows

NOISE = 0.1  # standard deviation, of features scaled to [-1, 1]
_PAPER = ARCHITECTURES["paper"]


class Autoencoder(Network, Reconstructing, frozen=True, kw_only=True):
    """What plain and denoising autoencoders share; architectures have their own training."""

    architecture: settings.Architecture = _PAPER.name
    epochs: settings.Epochs = _PAPER.epochs
    learning_rate: settings.LearningRate = _PAPER.learning_rate
    initial: Annotated[
        Literal["torch", "normal"],
        Meta(
            description="Weights to begin with: torch, its own; or normal, N(0, 1) with biases of "
            "0."
        ),
    ] = "torch"

    @classmethod
    def defaults(cls, given: Mapping[str, Any] = MappingProxyType({})) -> dict[str, Any]:
        used = get_architecture(given.get("architecture", _PAPER.name))
        own = {"epochs": used.epochs, "learning_rate": used.learning_rate}
        return {**super().defaults(), **own}

    def objective(self, data: ScaledDataset) -> "Reconstruction":
        return Reconstruction(self, data.size, feature_weights(data, self.weights))


class AE(Autoencoder, frozen=True, kw_only=True):
    """Autoencoder without noise."""

    name: ClassVar[str] = "ae"


class DAE(Autoencoder, frozen=True, kw_only=True):
    """Denoising autoencoder: noise on each feature of each row, the clean row as target."""

    name: ClassVar[str] = "dae"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "authors": {"initial": "normal", "shared_noise": True}
    }

    noise: settings.NoiseDeviation = NOISE
    shared_noise: Annotated[bool, Meta(description="Corrupt all rows of a batch alike.")] = False

    def check_data(self, data: ScaledDataset) -> None:
        super().check_data(data)
        if not self.noise:
            raise InputError("dae without noise is a plain autoencoder: use the kind ae")

    def objective(self, data: ScaledDataset) -> "Reconstruction":
        weights = feature_weights(data, self.weights)
        return Reconstruction(self, data.size, weights, self.noise, self.shared_noise)


class Reconstruction(Objective):
    """The mean squared error of a reconstruction.

    Batches are (features, rows), corrupted and clean. Weights are of each scaled number in the
    error, (d,), None for 1; `noise` is the standard deviation of the corruption.
    """

    _weights: Tensor | None

    def __init__(
        self,
        method: Autoencoder,
        size: int,
        weights: Tensor | None = None,
        noise: float = 0,
        shared_noise: bool = False,
    ):
        super().__init__()
        architecture = get_architecture(method.architecture)
        parts = stacks(architecture, size, method.latent, method.seed, method.initial)
        self.encoder, self.decoder = parts
        self._decays = architecture.decay
        self._noise, self._shared = noise, shared_noise
        self.register_buffer("_weights", weights, persistent=False)
        self._gradient: Gradient | None = None

    def batch(self, windows: Windows, numbers: Tensor) -> tuple[Tensor, Tensor]:
        clean = windows.rows(numbers).T.contiguous()
        return clean, clean

    def draws(
        self, windows: Windows, numbers: Tensor, size: int, generator: torch.Generator
    ) -> Iterator[tuple[Tensor, Tensor]]:
        clean = windows.rows(numbers).T.contiguous()
        for part in clean.split(size, 1) if self._shared else (clean,):
            corrupted = self._corrupt(part, generator)
            yield from zip(corrupted.split(size, 1), part.split(size, 1), strict=True)

    def _corrupt(self, clean: Tensor, generator: torch.Generator) -> Tensor:
        if not self._noise:
            return clean
        like = clean[:, :1] if self._shared else clean
        drawn = torch.empty_like(like).normal_(0, self._noise, generator=generator)
        return clean + drawn if self._shared else drawn.add_(clean)

    def loss(self, batch: tuple[Tensor, Tensor]) -> Tensor:
        corrupted, clean = batch
        squares = (self.decoder(self.encoder(corrupted.T)) - clean.T).square()
        return (squares if self._weights is None else squares * self._weights).mean()

    def gradient(self, batch: tuple[Tensor, Tensor]) -> Tensor:
        corrupted, clean = batch
        rows = corrupted.shape[1]
        if self._gradient is None or self._gradient.rows < rows:
            modules = (*self.encoder, *self.decoder)
            self._gradient = Gradient(modules, rows, self._weights)
        return self._gradient(corrupted, clean)

    def rate(self, progress: float, step: int) -> float:
        return super().rate(progress, step) if self._decays else 1

    def layers(self) -> tuple[Layers, Layers]:
        return layers(self.encoder), layers(self.decoder)


class Gradient:
    """Computes the gradients of the mean squared error of a stack of layers, written out.

    With so few features a step is limited by memory access and by the number of operations: with
    features first, in preallocated buffers, it takes about half of autograd's time
    (benchmarks/encoders.py). Modules are nn.Linear, each followed by nn.ReLU, nn.Tanh, or neither;
    `rows` is the largest batch.
    """

    def __init__(self, modules: Iterable[nn.Module], rows: int, weights: Tensor | None = None):
        self.rows = rows
        self._weights = None if weights is None else weights[:, None]
        stack = [*modules, nn.Identity()]
        self._layers = [
            (module, after) for module, after in pairwise(stack) if isinstance(module, nn.Linear)
        ]
        self._outputs = [p.bias.new_empty(len(p.bias) * rows) for p, _ in self._layers]
        self._errors = [torch.empty_like(output) for output in self._outputs]
        for linear, _ in self._layers:
            for parameter in linear.parameters():
                parameter.grad = torch.zeros_like(parameter)

    @torch.no_grad()
    def __call__(self, values: Tensor, target: Tensor) -> Tensor:
        """Set every parameter's gradient, and return the mean squared error.

        Values and the target to come close to are (features, rows).
        """
        inputs = [values, *self._cut(self._outputs, values.shape[1])]
        for (linear, activation), before, after in zip(
            self._layers, inputs[:-1], inputs[1:], strict=True
        ):
            torch.addmm(linear.bias[:, None], linear.weight, before, out=after)
            _activate(activation, after)
        errors = self._cut(self._errors, values.shape[1])
        error = torch.sub(inputs[-1], target, out=errors[-1])
        if self._weights is None:
            loss = torch.dot(error.view(-1), error.view(-1)) / error.numel()
        else:
            loss = torch.sum(error.square() * self._weights) / error.numel()
            error.mul_(self._weights)
        error.mul_(2 / error.numel())
        for i, (linear, activation) in reversed(list(enumerate(self._layers))):
            _differentiate(activation, inputs[i + 1], errors[i])
            torch.mm(errors[i], inputs[i].T, out=linear.weight.grad)
            torch.sum(errors[i], 1, out=linear.bias.grad)
            if i:
                torch.mm(linear.weight.T, errors[i], out=errors[i - 1])
        return loss

    def _cut(self, buffers: list[Tensor], rows: int) -> list[Tensor]:
        """The part of each buffer that this many rows occupy, (features, rows)."""
        sizes = [len(linear.bias) for linear, _ in self._layers]
        return [b[: n * rows].view(n, rows) for n, b in zip(sizes, buffers, strict=True)]


def _activate(activation: nn.Module, values: Tensor) -> None:
    if isinstance(activation, nn.Tanh):  # as 2 sigmoid(2x) - 1: a third of torch.tanh's time
        values.mul_(2).sigmoid_().mul_(2).sub_(1)
    elif isinstance(activation, nn.ReLU):
        values.clamp_min_(0)


def _differentiate(activation: nn.Module, output: Tensor, error: Tensor) -> None:
    """Turn the error at an activation's output into that at its input, overwriting both."""
    if isinstance(activation, nn.Tanh):
        torch.addcmul(error, error, output.square_(), value=-1, out=error)
    elif isinstance(activation, nn.ReLU):
        torch.ops.aten.threshold_backward.grad_input(error, output, 0, grad_input=error)
