"""A variational autoencoder (Kingma and Welling 2014) with a sigmoid decoder.

The authors' had a layer of d/16 = 1 unit before its 15 latents, which left one number of the state,
and gave agents sampled codes. Here hidden layers are wider than the code, which is the mean; and
the divergence weighs less, for cross-entropy hardly sees features of small spread.
"""

from abc import abstractmethod
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from jbrep.dae.network import get_architecture, layers, seeded, stack
from jbrep.dataset import ScaledDataset
from jbrep.encoders.layers import Layer
from jbrep.methods.autoencoder import check, feature_weights
from jbrep.methods.method import Learned, Settings
from jbrep.methods.settings import REQUIRED
from jbrep.methods.sigmoid import cross_entropy, sigmoid_layers
from jbrep.training.objective import Layers, Objective
from jbrep.training.windows import Windows

_LEAST, _MOST = -7.0, 7.0  # log standard deviation of a posterior


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


class Variational(Objective):
    """A code with a distribution: drawn from in training, its mean in evaluation and in the file.

    Batches end with the noise of the codes, (n, l), 0 in evaluation.

    Args:
        data: scaled.
        settings: of the method.
    """

    _weights: Tensor | None

    def __init__(self, data: ScaledDataset, settings: Settings):
        super().__init__()
        self._latent = settings["latent"]
        self._beta = settings["beta"]
        self._hidden = get_architecture(settings["architecture"]).hidden
        with seeded(settings["seed"]):
            self.encoder = stack((data.size, *self._hidden, 2 * self._latent), "linear")
            self.build(data)
        weights = feature_weights(data, settings["weights"])
        self.register_buffer("_weights", weights, persistent=False)

    @abstractmethod
    def build(self, data: ScaledDataset) -> None:
        """Make the decoder, and what else there is, from torch's generator."""

    def inputs(self, windows: Windows, numbers: Tensor) -> tuple[Tensor, ...]:
        """What a batch has before its noise; rows first."""
        return (windows.rows(numbers),)

    def batch(self, windows: Windows, numbers: Tensor) -> tuple[Tensor, ...]:
        """As for `Objective`, without noise."""
        inputs = self.inputs(windows, numbers)
        return *inputs, inputs[0].new_zeros(1, self._latent).expand(len(inputs[0]), -1)

    def draws(
        self, windows: Windows, numbers: Tensor, size: int, generator: torch.Generator
    ) -> Iterator[tuple[Tensor, ...]]:
        """As for `Objective`, with noise."""
        *inputs, zeros = self.batch(windows, numbers)
        noise = torch.empty(zeros.shape, device=zeros.device).normal_(generator=generator)
        yield from zip(*(part.split(size) for part in (*inputs, noise)), strict=True)

    def report(self, windows: Windows) -> dict[str, Any]:
        """The mean divergence of each unit [nat]: about 0 for one that says nothing."""
        rows = self.inputs(windows, windows.numbers)[0]
        return {"divergence": divergence(*posterior(self.encoder(rows))).mean(0).tolist()}


class Vae(Variational):
    """The cross-entropy of a row, summed over its numbers, and `beta` times the divergence."""

    def build(self, data: ScaledDataset) -> None:
        """As for `Variational`."""
        self.decoder = stack((self._latent, *reversed(self._hidden), data.size), "linear")

    def loss(self, batch: tuple[Tensor, ...]) -> Tensor:
        """As for `Objective`."""
        rows, noise = batch
        mean, log_deviation = posterior(self.encoder(rows))
        logits = self.decoder(mean + log_deviation.exp() * noise)
        error = cross_entropy(logits, rows, self._weights).sum(1)
        return (error + self._beta * divergence(mean, log_deviation).sum(1)).mean()

    def layers(self) -> tuple[Layers, Layers]:
        """As for `Objective`."""
        return first_half(layers(self.encoder)), sigmoid_layers(layers(self.decoder))


METHOD = Learned(
    name="vae",
    words="variational autoencoder with a sigmoid decoder; the code is the mean",
    source="Kingma and Welling 2014; Higgins et al. 2017",
    own={
        "latent": REQUIRED,
        "architecture": "deep",
        "beta": 0.001,
        "epochs": 5,
        "batch_size": 256,
        "learning_rate": 1e-3,
        "seed": 0,
        "weights": {},
    },
    check=check,
    objective=Vae,
)
