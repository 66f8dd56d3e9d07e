"""The authors' DDAE: a layer of ReLU units whose sigmoid decoder gives this row or a later one.

Theirs took cross-entropies of unscaled data, which have no least value, and targets from the next
episode; here targets lie in [0, 1] and in the same episode. Theirs saw 128,000 rows, ours all.
"""

from typing import Annotated, ClassVar

import torch
from msgspec import Meta
from torch import Tensor, nn

from jbrep.dataset import ScaledDataset
from jbrep.methods.vae import cross_entropy, sigmoid_layers
from jbrep.training.method import Reconstructing
from jbrep.training.network import layers, seeded, stack
from jbrep.training.objective import Layers, Objective, feature_weights
from jbrep.training.settings import MAX_HORIZON, BatchSize, Epochs, LearningRate, Weight
from jbrep.training.windows import Windows

_DECAY, _DECAY_STEPS = 0.96, 1000  # of the learning rate, and how often


class Ddae(Reconstructing, frozen=True, kw_only=True):
    """The authors' DDAE: ReLU units, from which a sigmoid gives this row or one ahead."""

    name: ClassVar[str] = "ddae"

    ahead: Annotated[
        int, Meta(ge=0, le=MAX_HORIZON, description="Steps ahead of the row that is reconstructed.")
    ] = 0
    epochs: Epochs = 5
    batch_size: BatchSize = 256
    learning_rate: LearningRate = 1e-3
    weight_decay: Annotated[Weight, Meta(description="Weight of half the squared weights.")] = 1e-5

    def objective(self, data: ScaledDataset) -> Objective:
        return DdaeObjective(self, data)


class DdaeObjective(Objective):
    """The mean cross-entropy of a row `ahead` steps later, and half the weights' squares."""

    _weights: Tensor | None

    def __init__(self, method: Ddae, data: ScaledDataset):
        super().__init__()
        self.horizon = method.ahead
        self._decay = method.weight_decay
        size, latent = data.size, method.latent
        with seeded(method.seed):
            self.encoder = nn.Sequential(nn.Linear(size, latent), nn.ReLU())
            self.decoder = stack((latent, size), "linear")
            for parameter in self.parameters():
                nn.init.zeros_(parameter)
            for weight in self._matrices:
                nn.init.kaiming_normal_(weight)  # He et al. 2015
        weights = feature_weights(data, method.weights)
        self.register_buffer("_weights", weights, persistent=False)

    @property
    def _matrices(self) -> list[Tensor]:
        return [parameter for parameter in self.parameters() if parameter.ndim > 1]

    def batch(self, windows: Windows, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Rows, and those to be given."""
        now = windows.rows(numbers)
        return now, windows.rows(numbers, self.horizon) if self.horizon else now

    def loss(self, batch: tuple[Tensor, Tensor]) -> Tensor:
        now, target = batch
        error = cross_entropy(self.decoder(self.encoder(now)), target, self._weights).mean()
        squares = torch.stack([weight.square().sum() for weight in self._matrices])
        return error + self._decay * squares.sum() / 2

    def rate(self, progress: float, step: int) -> float:
        return _DECAY ** (step // _DECAY_STEPS)

    def layers(self) -> tuple[Layers, Layers | None]:
        # what gives a later row is no decoder of this one
        decoder = None if self.horizon else sigmoid_layers(layers(self.decoder))
        return layers(self.encoder), decoder
