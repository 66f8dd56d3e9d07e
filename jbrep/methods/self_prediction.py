"""Latent self-prediction: a code from which, with the action, the next code can be told."""

import math
from typing import ClassVar

import torch
from torch import Tensor, nn

from jbrep.dataset import ScaledDataset
from jbrep.encoders.layers import AVG_L1_NORM
from jbrep.errors import InputError
from jbrep.training.method import Learned, Network
from jbrep.training.network import HIDDEN, get_architecture, seeded, stack
from jbrep.training.objective import Objective
from jbrep.training.settings import Architecture


class SelfPrediction(Network, Learned, frozen=True, kw_only=True):
    """A code that tells, with the action, the next code; on a mean magnitude of 1 (SALE)."""

    name: ClassVar[str] = "self-prediction"

    architecture: Architecture = "deep"

    def check_data(self, data: ScaledDataset) -> None:
        super().check_data(data)
        if self.latent == 1:
            raise InputError(
                "self-prediction divides a code by its average magnitude, which leaves a single "
                "unit only its sign: use a latent size of at least 2"
            )

    def objective(self, data: ScaledDataset) -> Objective:
        return SelfPredictionObjective(self, data)


class SelfPredictionObjective(Objective):
    """The mean squared error of the next code, as in SALE of TD7 (Fujimoto et al. 2023).

    The code z = f(x) / mean |f(x)| is predicted from the one before it and the action:
    |g(z_t, a_t) - z_t+1|^2, where no gradient flows through z_t+1. The normalisation keeps codes
    from shrinking to 0; nothing in the loss keeps them from becoming constant. What a code begins
    with it mostly keeps, so its layers begin orthogonal and without biases: from torch's own
    initial weights, biases outweigh the rows and half of the units repeat the others.
    """

    horizon = 1
    moving_target = True

    def __init__(self, method: SelfPrediction, data: ScaledDataset):
        super().__init__()
        hidden = get_architecture(method.architecture).hidden
        size, latent, actions = data.size, method.latent, data.task.action_size
        with seeded(method.seed):
            self.encoder = stack((size, *hidden, latent), AVG_L1_NORM)
            for parameter in self.encoder.parameters():
                if parameter.ndim == 2:
                    nn.init.orthogonal_(parameter, math.sqrt(2))
                else:
                    nn.init.zeros_(parameter)
            self.next_code = stack((latent + actions, HIDDEN, HIDDEN, latent), "linear")

    def loss(self, batch: tuple[Tensor, ...]) -> Tensor:
        now, actions, after = batch
        predicted = self.next_code(torch.cat((self.encoder(now), actions), 1))
        with torch.no_grad():
            target = self.encoder(after)
        return (predicted - target).square().mean()
