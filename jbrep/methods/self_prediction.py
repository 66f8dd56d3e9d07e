"""Latent self-prediction: a code from which, with the action, the next code can be told."""

import math

import torch
from torch import Tensor, nn

from jbrep.dae.network import check_size, get_architecture, layers, seeded, stack
from jbrep.dataset import ScaledDataset
from jbrep.encoders.layers import AVG_L1_NORM
from jbrep.errors import InputError
from jbrep.methods.method import Learned, Settings
from jbrep.methods.predictors import HIDDEN
from jbrep.methods.settings import REQUIRED
from jbrep.training.objective import Layers, Objective
from jbrep.training.windows import Windows


class SelfPrediction(Objective):
    """The mean squared error of the next code, as in SALE of TD7 (Fujimoto et al. 2023).

    The code z = f(x) / mean |f(x)| is predicted from the one before it and the action:
    |g(z_t, a_t) - z_t+1|^2, where no gradient flows through z_t+1. The normalisation keeps codes
    from shrinking to 0; nothing in the loss keeps them from becoming constant. What a code begins
    with it mostly keeps, so its layers begin orthogonal and without biases: from torch's own
    initial weights, biases outweigh the rows and half of the units repeat the others.

    Args:
        data: scaled.
        settings: of the method.
    """

    horizon = 1
    moves = True

    def __init__(self, data: ScaledDataset, settings: Settings):
        super().__init__()
        hidden = get_architecture(settings["architecture"]).hidden
        size, latent, actions = data.size, settings["latent"], data.task.action_size
        with seeded(settings["seed"]):
            self.encoder = stack((size, *hidden, latent), AVG_L1_NORM)
            for parameter in self.encoder.parameters():
                if parameter.ndim == 2:
                    nn.init.orthogonal_(parameter, math.sqrt(2))
                else:
                    nn.init.zeros_(parameter)
            self.next_code = stack((latent + actions, HIDDEN, HIDDEN, latent), "linear")

    def batch(self, windows: Windows, numbers: Tensor) -> tuple[Tensor, ...]:
        """Rows (n, size), actions (n, k), and the next rows (n, size)."""
        actions = windows.actions(numbers).flatten(1)
        return windows.rows(numbers), actions, windows.rows(numbers, 1)

    def loss(self, batch: tuple[Tensor, ...]) -> Tensor:
        """As for `Objective`."""
        now, actions, after = batch
        predicted = self.next_code(torch.cat((self.encoder(now), actions), 1))
        with torch.no_grad():
            target = self.encoder(after)
        return (predicted - target).square().mean()

    def layers(self) -> tuple[Layers, Layers | None]:
        """As for `Objective`; there is no decoder."""
        return layers(self.encoder), None


def _check(data: ScaledDataset, settings: Settings) -> None:
    check_size(settings["architecture"], data.size, settings["latent"])
    if settings["latent"] == 1:
        raise InputError(
            "self-prediction divides a code by its average magnitude, which leaves a single unit "
            "only its sign: use a latent size of at least 2"
        )


METHOD = Learned(
    name="self-prediction",
    words="a code that tells, with the action, the code of the next step; on a mean magnitude of 1",
    source="SALE of TD7, Fujimoto et al. 2023",
    own={
        "latent": REQUIRED,
        "architecture": "deep",
        "epochs": 12,
        "batch_size": None,
        "learning_rate": 2e-3,
        "seed": 0,
    },
    check=_check,
    objective=SelfPrediction,
)
