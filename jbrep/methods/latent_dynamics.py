"""Codes from which, with the action, the next code can be told.

DeepMDP: a code that is itself the state of a smooth decision process with the same rewards; and
self-prediction, without rewards.
"""

import math
from typing import Annotated, Any, ClassVar

import torch
from msgspec import Meta
from torch import Tensor, nn

from jbrep.dataset import ScaledDataset
from jbrep.encoders.layers import AVG_L1_NORM
from jbrep.errors import InputError
from jbrep.training.method import Learned, Network
from jbrep.training.network import HIDDEN, get_architecture, seeded, stack
from jbrep.training.objective import Objective
from jbrep.training.settings import Architecture, RewardWeight, TransitionWeight, Weight
from jbrep.training.windows import Windows

_SMALL = 1e-6  # standard deviation of a reward that says nothing


class DeepMDP(Network, Learned, frozen=True, kw_only=True):
    """Latent that predicts reward and next latent by Lipschitz functions, given the action."""

    name: ClassVar[str] = "deepmdp"

    architecture: Architecture = "deep"
    reward: RewardWeight = 1.0
    transition: TransitionWeight = 1.0
    lipschitz: Annotated[Weight, Meta(description="Weight of the Lipschitz penalty.")] = 0.1

    def check_data(self, data: ScaledDataset) -> None:
        super().check_data(data)
        if not self.reward:
            raise InputError(
                "deepmdp without reward makes a constant latent, which is easy to predict: give "
                "the reward a weight above 0"
            )
        if not data.reward_varies:
            raise InputError(
                f"deepmdp needs a reward that varies, and there is none in {data.dataset.folder}: "
                "the latent would be constant"
            )

    def objective(self, data: ScaledDataset) -> Objective:
        return DeepMDPObjective(self, data)


class DeepMDPObjective(Objective):
    """Reward and next code from the code and the action, by smooth functions.

    With the code z = f(x), the standardised reward r and the networks R and G (Gelada et al. 2019,
    with squared errors and deterministic transitions):

        reward |R(z_t, a_t) - r_t|^2 + transition |z_t + G(z_t, a_t) - z_t+1|^2 / l
        + lipschitz sum over R and G of max(0, L - 1)^2

    L, the product of the spectral norms of a network's weights, the first one's of the code alone,
    bounds how fast the network varies with the code; so R is kept to a constant of 1, and the
    transition to 2. A code that shrinks would make the transition easy: as R may not be steep, the
    reward keeps it wide. Gradients flow through both codes, so losses of epochs can be compared.
    """

    _mean: Tensor
    _deviation: Tensor

    def __init__(self, method: DeepMDP, data: ScaledDataset):
        super().__init__()
        architecture = get_architecture(method.architecture)
        size, self._latent = data.size, method.latent
        inputs = self._latent + data.task.action_size
        terms = "reward", "transition", "lipschitz"
        self._weights = {term: getattr(method, term) for term in terms}
        with seeded(method.seed):
            self.encoder = stack((size, *architecture.hidden, self._latent), architecture.code)
            self.reward = stack((inputs, HIDDEN, HIDDEN, 1), "linear")
            self.change = stack((inputs, HIDDEN, HIDDEN, self._latent), "linear")
        self.register_buffer("_mean", torch.zeros(()), persistent=False)
        self.register_buffer("_deviation", torch.ones(()), persistent=False)

    def prepare(self, windows: Windows) -> None:
        """Fit the standardisation of the reward."""
        deviation, self._mean = torch.std_mean(windows.rewards(windows.numbers))
        self._deviation = deviation.clamp(min=_SMALL)

    def batch(self, windows: Windows, numbers: Tensor) -> tuple[Tensor, ...]:
        rewards = (windows.rewards(numbers) - self._mean) / self._deviation
        return *windows.steps(numbers), rewards[:, None]

    def _errors(self, batch: tuple[Tensor, ...]) -> dict[str, Tensor]:
        now, actions, after, rewards = batch
        code, following = self.encoder(torch.cat((now, after))).chunk(2)
        known = torch.cat((code, actions), 1)
        return {
            "reward": (self.reward(known) - rewards).square().mean(),
            "transition": (code + self.change(known) - following).square().mean(),
            "lipschitz": sum(
                (self.lipschitz(network) - 1).relu().square()
                for network in (self.reward, self.change)
            ),
        }

    def lipschitz(self, network: nn.Sequential) -> Tensor:
        """A bound on how fast a network's output varies with the code."""
        first, *others = (each.weight for each in network if isinstance(each, nn.Linear))
        weights = first[:, : self._latent], *others
        squares = (w.T @ w if len(w) > w.shape[1] else w @ w.T for w in weights)
        return torch.stack([torch.linalg.eigvalsh(each)[-1] for each in squares]).prod().sqrt()

    def loss(self, batch: tuple[Tensor, ...]) -> Tensor:
        errors = self._errors(batch)
        return torch.stack([weight * errors[name] for name, weight in self._weights.items()]).sum()

    def report(self, windows: Windows) -> dict[str, Any]:
        """The terms of the loss, unweighted: `reward` is 1 for no prediction."""
        errors = self._errors(self.batch(windows, windows.numbers))
        return {"loss_by_term": {name: float(error) for name, error in errors.items()}}


class SelfPrediction(Network, Learned, frozen=True, kw_only=True):
    """Latent that predicts the next one, given the action; of mean magnitude 1 (SALE)."""

    name: ClassVar[str] = "self-prediction"

    architecture: Architecture = "deep"

    def check_data(self, data: ScaledDataset) -> None:
        super().check_data(data)
        if self.latent == 1:
            raise InputError(
                "self-prediction divides a latent by its average magnitude, which leaves a single "
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

    kept_by = None

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
