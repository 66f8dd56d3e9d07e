"""A variational autoencoder (Kingma and Welling 2014) with a sigmoid decoder.

The authors' had a layer of d/16 = 1 unit before its 15 latents, which left one number of the state,
and gave agents sampled codes. Here hidden layers are wider than the code, which is the mean; and
the divergence weighs less, for cross-entropy hardly sees features of small spread.
"""

from abc import abstractmethod
from collections.abc import Iterator
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from msgspec import Meta
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from jbrep.dataset import ScaledDataset
from jbrep.encoders.layers import Layer
from jbrep.training.method import Network, Reconstructing
from jbrep.training.network import get_architecture, layers, seeded, stack
from jbrep.training.objective import Layers, Objective, feature_weights
from jbrep.training.settings import Architecture, BatchSize, Epochs, LearningRate, Weight
from jbrep.training.windows import Windows

_LEAST, _MOST = -7.0, 7.0  # log standard deviation of a posterior

Beta = Annotated[Weight, Meta(description="Weight of the divergence from the prior.")]


class Variational(Network, Reconstructing, frozen=True, kw_only=True):
    """A method whose code has a distribution."""

    architecture: Architecture = "deep"
    beta: Beta = 0.001
    batch_size: BatchSize = 256
    learning_rate: LearningRate = 1e-3


class Vae(Variational, frozen=True, kw_only=True):
    """Variational autoencoder with a sigmoid decoder; the code is the mean.

    Kingma and Welling 2014; Higgins et al. 2017.
    """

    name: ClassVar[str] = "vae"

    epochs: Epochs = 5

    def objective(self, data: ScaledDataset) -> Objective:
        return VaeObjective(self, data)


def posterior(values: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and log standard deviation, (n, l) each, in an encoder's output (n, 2 l)."""
    mean, log_deviation = values.chunk(2, 1)
    return mean, log_deviation.clamp(_LEAST, _MOST)


def divergence(mean: Tensor, log_deviation: Tensor) -> Tensor:
    """KL of N(mean, deviation^2) from N(0, 1), of each unit, (n, l)."""
    return (mean.square() + (2 * log_deviation).exp() - 1) / 2 - log_deviation


def first_half(layers: Layers) -> Layers:
    """Layers of which the last gives only the first half of its units."""
    weight, bias, activation = layers[-1]
    count = len(bias) // 2
    return (*layers[:-1], Layer(weight[:count].copy(), bias[:count].copy(), activation))


class VariationalObjective(Objective):
    """A code with a distribution: drawn from in training, its mean in evaluation and in the file.

    Batches end with the noise of the codes, (n, l), 0 in evaluation.
    """

    _weights: Tensor | None

    def __init__(self, method: Variational, data: ScaledDataset):
        super().__init__()
        self._latent, self._beta = method.latent, method.beta
        self._hidden = get_architecture(method.architecture).hidden
        with seeded(method.seed):
            self.encoder = stack((data.size, *self._hidden, 2 * self._latent), "linear")
            self.build(data)
        weights = feature_weights(data, method.weights)
        self.register_buffer("_weights", weights, persistent=False)

    @abstractmethod
    def build(self, data: ScaledDataset) -> None:
        """Make the decoder, and what else there is, from torch's generator."""

    def inputs(self, windows: Windows, numbers: Tensor) -> tuple[Tensor, ...]:
        """What a batch has before its noise; rows first."""
        return (windows.rows(numbers),)

    def batch(self, windows: Windows, numbers: Tensor) -> tuple[Tensor, ...]:
        inputs = self.inputs(windows, numbers)
        return *inputs, inputs[0].new_zeros(1, self._latent).expand(len(inputs[0]), -1)

    def draws(
        self, windows: Windows, numbers: Tensor, size: int, generator: torch.Generator
    ) -> Iterator[tuple[Tensor, ...]]:
        *inputs, zeros = self.batch(windows, numbers)
        noise = torch.empty(zeros.shape, device=zeros.device).normal_(generator=generator)
        yield from zip(*(part.split(size) for part in (*inputs, noise)), strict=True)

    def report(self, windows: Windows) -> dict[str, Any]:
        """The mean divergence of each unit [nat]: about 0 for one that says nothing."""
        rows = self.inputs(windows, windows.numbers)[0]
        return {"divergence": divergence(*posterior(self.encoder(rows))).mean(0).tolist()}


class VaeObjective(VariationalObjective):
    """The cross-entropy of a row, summed over its numbers, and `beta` times the divergence."""

    def build(self, data: ScaledDataset) -> None:
        self.decoder = stack((self._latent, *reversed(self._hidden), data.size), "linear")

    def loss(self, batch: tuple[Tensor, ...]) -> Tensor:
        rows, noise = batch
        mean, log_deviation = posterior(self.encoder(rows))
        logits = self.decoder(mean + log_deviation.exp() * noise)
        error = cross_entropy(logits, rows, self._weights).sum(1)
        return (error + self._beta * divergence(mean, log_deviation).sum(1)).mean()

    def layers(self) -> tuple[Layers, Layers]:
        return first_half(layers(self.encoder)), sigmoid_layers(layers(self.decoder))


def cross_entropy(logits: Tensor, rows: Tensor, weights: Tensor | None) -> Tensor:
    """The binary cross-entropy of each number, (n, d).

    Scaled values beyond [-1, 1], which held-out rows and scalings other than by extrema have, count
    as its ends: no sigmoid gives more, and beyond them the cross-entropy has no least value.
    """
    target = ((rows + 1) / 2).clamp(0, 1)
    return binary_cross_entropy_with_logits(logits, target, weights, reduction="none")


def sigmoid_layers(layers: Layers) -> Layers:
    """Layers that give logits, followed by what makes them scaled numbers, 2 sigmoid - 1."""
    weight, bias, _ = layers[-1]
    size = len(bias)
    back = Layer(2 * np.eye(size, dtype=np.float32), -np.ones(size, np.float32), "linear")
    return (*layers[:-1], Layer(weight, bias, "sigmoid"), back)
