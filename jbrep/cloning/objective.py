"""Behaviour cloning: a policy that does what the data's did; and what it sees of the data."""

from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from jbrep.dataset import Dataset, ScaledDataset
from jbrep.dataset.scaling import mean_and_std
from jbrep.encoders.base import BaseEncoder
from jbrep.rl.normalization import Statistics
from jbrep.training.objective import Objective
from jbrep.training.windows import Windows

_NEGLIGIBLE = 1e-6  # standard deviation of a number that says nothing, of its magnitude


class PolicyInputs(ScaledDataset):
    """A data set's rows as a policy sees them: an encoder's latents, of mean 0 and variance 1.

    Attributes:
        statistics: of the latents of the training part.
    """

    def __init__(self, dataset: Dataset, encoder: BaseEncoder):
        super().__init__(dataset)
        self._encoder = encoder
        mean, deviation = mean_and_std(map(encoder.encode, self.observations(self.train)))
        varies = deviation > _NEGLIGIBLE * (1 + np.abs(mean))
        variance = np.where(varies, deviation**2, 1)
        self.statistics = Statistics(mean, variance, float(len(self.train)))

    @property
    def size(self) -> int:
        return self._encoder.latent_size

    def scale(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        return self.statistics(self._encoder.encode(observations))


class Cloning(Objective):
    """The squared error of actions scaled to [-1, 1], or minus their log-likelihood.

    The former is of a policy with an actor, whose actions tanh keeps within the bounds; the latter
    of one with a Gaussian about actions that are clipped to them, of the same standard deviations
    in all states.

    Args:
        policy: of stable-baselines3.
        chunk: actions that it chooses at once.
    """

    kept_by: Literal["train_loss", "test_loss"] | None = "test_loss"

    def __init__(self, policy: Any, chunk: int):
        super().__init__()
        self.policy, self.horizon = policy, chunk - 1

    def batch(self, windows: Windows, numbers: Tensor) -> tuple[Tensor, ...]:
        """What is seen, (n, l), and the actions of the chunk that begins there, (n, chunk * k)."""
        return windows.rows(numbers), windows.actions(numbers, self.horizon + 1).flatten(1)

    def loss(self, batch: tuple[Tensor, ...]) -> Tensor:
        seen, actions, *_ = batch
        if hasattr(self.policy, "actor"):
            return (self.policy.actor(seen) - actions).square().mean()
        likelihood: Tensor = self.policy.get_distribution(seen).log_prob(actions)
        return -likelihood.mean()

    def errors(self, windows: Windows) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The errors of actions in windows, and the actions, scaled to [-1, 1], (n, chunk, k)."""
        actions = windows.actions(windows.numbers, self.horizon + 1)
        with torch.no_grad():
            chosen = self.policy._predict(windows.rows(windows.numbers), deterministic=True)
        errors = chosen.clamp(-1, 1).view_as(actions) - actions
        return errors.numpy(force=True), actions.numpy(force=True)
