"""The authors' DDAE: a layer of ReLU units whose sigmoid decoder gives this row or a later one.

Theirs took cross-entropies of unscaled data, which have no least value, and targets from the next
episode; here targets lie in [0, 1] and in the same episode. Theirs saw 128,000 rows, ours all.
"""

import torch
from torch import Tensor, nn

from jbrep.dae.network import layers, seeded, stack
from jbrep.dataset import ScaledDataset
from jbrep.methods.autoencoder import feature_weights
from jbrep.methods.method import Learned, Settings
from jbrep.methods.settings import REQUIRED
from jbrep.methods.sigmoid import cross_entropy, sigmoid_layers
from jbrep.training.objective import Layers, Objective
from jbrep.training.windows import Windows

_DECAY, _DECAY_STEPS = 0.96, 1000  # of the learning rate, and how often


class Ddae(Objective):
    """The mean cross-entropy of a row `ahead` steps later, and half the weights' squares.

    Args:
        data: scaled.
        settings: of the method.
    """

    _weights: Tensor | None

    def __init__(self, data: ScaledDataset, settings: Settings):
        super().__init__()
        self.horizon = settings["ahead"]
        self._decay = settings["weight_decay"]
        size, latent = data.size, settings["latent"]
        with seeded(settings["seed"]):
            self.encoder = nn.Sequential(nn.Linear(size, latent), nn.ReLU())
            self.decoder = stack((latent, size), "linear")
            for parameter in self.parameters():
                nn.init.zeros_(parameter)
            for weight in self._matrices:
                nn.init.kaiming_normal_(weight)  # He et al. 2015
        weights = feature_weights(data, settings["weights"])
        self.register_buffer("_weights", weights, persistent=False)

    @property
    def _matrices(self) -> list[Tensor]:
        """The weights without the biases."""
        return [parameter for parameter in self.parameters() if parameter.ndim > 1]

    def batch(self, windows: Windows, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Rows, and those to be given."""
        now = windows.rows(numbers)
        return now, windows.rows(numbers, self.horizon) if self.horizon else now

    def loss(self, batch: tuple[Tensor, Tensor]) -> Tensor:
        """As for `Objective`."""
        now, target = batch
        error = cross_entropy(self.decoder(self.encoder(now)), target, self._weights).mean()
        squares = torch.stack([weight.square().sum() for weight in self._matrices])
        return error + self._decay * squares.sum() / 2

    def rate(self, progress: float, step: int) -> float:
        """As for `Objective`: the authors' steps."""
        return _DECAY ** (step // _DECAY_STEPS)

    def layers(self) -> tuple[Layers, Layers | None]:
        """As for `Objective`; what gives a later row is no decoder of this one."""
        decoder = None if self.horizon else sigmoid_layers(layers(self.decoder))
        return layers(self.encoder), decoder


def _check(data: ScaledDataset, settings: Settings) -> None:
    feature_weights(data, settings["weights"])


METHOD = Learned(
    name="ddae",
    words="the authors' DDAE: ReLU units, from which a sigmoid gives this row or one ahead",
    own={
        "latent": REQUIRED,
        "ahead": 0,
        "epochs": 5,
        "batch_size": 256,
        "learning_rate": 1e-3,
        "weight_decay": 1e-5,
        "seed": 0,
        "weights": {},
    },
    check=_check,
    objective=Ddae,
)
