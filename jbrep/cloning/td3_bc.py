"""TD3+BC: offline reinforcement learning that stays near the actions of the data.

Fujimoto and Gu, A minimalist approach to offline reinforcement learning, 2021.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from jbrep.cloning.objective import Cloning
from jbrep.training.windows import Windows


class TD3BC(Cloning):
    """TD3 on the transitions of a data set, whose actor is held to the data's actions.

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
