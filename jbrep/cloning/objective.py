"""What policies learn from data alone, behaviour cloning and TD3+BC; and what they see of it."""

from collections.abc import Iterator, Mapping
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from jbrep.dataset import Dataset, ScaledDataset
from jbrep.dataset.scaling import mean_and_std
from jbrep.encoders.base import BaseEncoder
from jbrep.rl.agent import unchecked_distributions
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
        with unchecked_distributions():  # training refuses a loss that isn't finite
            likelihood: Tensor = self.policy.get_distribution(seen).log_prob(actions)
        return -likelihood.mean()

    def errors(self, windows: Windows) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The errors of actions in windows, and the actions, scaled to [-1, 1], (n, chunk, k)."""
        actions = windows.actions(windows.numbers, self.horizon + 1)
        with torch.no_grad():
            chosen = self.policy._predict(windows.rows(windows.numbers), deterministic=True)
        errors = chosen.clamp(-1, 1).view_as(actions) - actions
        return errors.numpy(force=True), actions.numpy(force=True)


class TD3BC(Cloning):
    """TD3 on the transitions of a data set, whose actor is held to the data's actions.

    After Fujimoto and Gu 2021, "A minimalist approach to offline reinforcement learning".

    With the critics Q1 and Q2, and targets Q' and pi' that follow slowly,

        y = r + gamma (1 - terminated) min Q'(s', clip(pi'(s') + noise, -1, 1))
        the critics' loss: (Q1(s, a) - y)^2 + (Q2(s, a) - y)^2
        the actor's, every `policy_delay` steps: |pi(s) - a|^2 - alpha Q1(s, pi(s)) / mean |Q1|

    An episode that was cut, not terminated by a state, goes on in the value of its last state.
    Where none is terminated, rewards are taken less their mean: that shifts all values alike, and
    mean |Q1| then is how far they differ. The loss that is watched is the squared error of held-out
    actions, which isn't what is minimised: the last epoch is kept.

    Args:
        policy: of stable-baselines3's TD3.
        alpha: weight of the value.
        td3: gamma, tau, policy_delay, target_policy_noise, target_noise_clip, as TD3 has them.
    """

    kept_by = None
    _updates: Tensor

    def __init__(self, policy: Any, alpha: float, td3: Mapping[str, Any]):
        super().__init__(policy, chunk=1)
        self._alpha, self._td3 = alpha, td3
        self.register_buffer("_updates", torch.zeros((), dtype=torch.int64))
        self._shift = 0.0

    def prepare(self, windows: Windows) -> None:
        if not windows.after(windows.numbers)[1].any():
            self._shift = float(windows.rewards(windows.numbers).mean())

    def batch(self, windows: Windows, numbers: Tensor) -> tuple[Tensor, ...]:
        after, terminated = windows.after(numbers)
        rewards = windows.rewards(numbers)[:, None] - self._shift
        return *super().batch(windows, numbers), rewards, after, terminated[:, None]

    def draws(
        self, windows: Windows, numbers: Tensor, size: int, generator: torch.Generator
    ) -> Iterator[Any]:
        clip = self._td3["target_noise_clip"]
        for batch in super().draws(windows, numbers, size, generator):
            actions = batch[1]
            noise = torch.randn(actions.shape, generator=generator, device=actions.device)
            yield *batch, (self._td3["target_policy_noise"] * noise).clamp(-clip, clip)

    def gradient(self, batch: Any) -> Tensor:
        """Set the gradients of the critics and, every `policy_delay` times, of the actor.

        The targets follow first what the optimiser has made of the last ones. Parameters without a
        gradient stay as they are. The loss that is returned is the critics'.
        """
        number, policy, delay = int(self._updates), self.policy, self._td3["policy_delay"]
        if number and (number - 1) % delay == 0:
            self._follow(policy.critic, policy.critic_target)
            self._follow(policy.actor, policy.actor_target)
        self._updates += 1
        seen, actions, rewards, after, terminated, noise = batch
        with torch.no_grad():
            following = (policy.actor_target(after) + noise).clamp(-1, 1)
            value = torch.cat(policy.critic_target(after, following), 1).amin(1, keepdim=True)
            target = rewards + self._td3["gamma"] * (1 - terminated) * value
        loss = sum((each - target).square().mean() for each in policy.critic(seen, actions))
        _set_gradients(policy.parameters(), None)
        _set_gradients(policy.critic.parameters(), loss)
        if number % delay == 0:
            chosen = policy.actor(seen)
            values = policy.critic.q1_forward(seen, chosen)
            gain = self._alpha * values.mean() / values.detach().abs().mean().clamp(min=1e-8)
            _set_gradients(policy.actor.parameters(), (chosen - actions).square().mean() - gain)
        return loss.detach()

    def _follow(self, network: nn.Module, target: nn.Module) -> None:
        with torch.no_grad():
            for own, its in zip(network.parameters(), target.parameters(), strict=True):
                its.lerp_(own, self._td3["tau"])

    def rate(self, progress: float, step: int) -> float:
        return 1.0


def _set_gradients(parameters: Iterator[nn.Parameter], loss: Tensor | None) -> None:
    """Set the gradients of a loss with respect to parameters; none without a loss."""
    some = list(parameters)
    gradients = [None] * len(some) if loss is None else torch.autograd.grad(loss, some)
    for parameter, gradient in zip(some, gradients, strict=True):
        parameter.grad = gradient
