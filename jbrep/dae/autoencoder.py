"""Autoencoders, plain and denoising: a row is reconstructed, from a corrupted one with noise."""

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal

import torch
from msgspec import Meta, field
from torch import Tensor

from jbrep.dae.gradient import Gradient
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
    batch_size: settings.BatchSize = None
    learning_rate: settings.LearningRate = _PAPER.learning_rate
    seed: settings.Seed = 0
    initial: Annotated[
        Literal["torch", "normal"],
        Meta(
            description="Weights to begin with: torch, its own; or normal, N(0, 1) with biases of "
            "0."
        ),
    ] = "torch"
    weights: settings.FeatureWeights = field(default_factory=dict)

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

    Batches are (features, rows), corrupted and clean.

    Args:
        method: says the network.
        size: scaled numbers d in a row.
        weights: of each scaled number in the error, (d,); None for 1.
        noise: standard deviation of the corruption.
        shared_noise: whether one vector of noise corrupts all rows of a batch.
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
        """Clean rows, twice."""
        clean = windows.rows(numbers).T.contiguous()
        return clean, clean

    def draws(
        self, windows: Windows, numbers: Tensor, size: int, generator: torch.Generator
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Corrupted and clean rows."""
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
        """As for `Objective`; the paper's doesn't fall."""
        return super().rate(progress, step) if self._decays else 1

    def layers(self) -> tuple[Layers, Layers]:
        return layers(self.encoder), layers(self.decoder)
