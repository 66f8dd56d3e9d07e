"""TD3 for n agents at once, with the gradient steps of stable-baselines3.

DDPG is TD3 with one critic, a step of the actor for each of the critic, and no noise on targets.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor
from torch.optim import Optimizer

from jbrep.rl.cohort.networks import Arithmetic, Network
from jbrep.rl.cohort.steps import (
    Batch,
    Losses,
    approach,
    descend,
    least,
    squared_error,
    sum_of,
    target,
    values,
)


@dataclass(kw_only=True)
class TD3:
    """Twin delayed deep deterministic policy gradients (Fujimoto et al. 2018).

    Networks and optimisers have stable-baselines3's names.
    """

    compute: Arithmetic
    actor: Network
    critic: Sequence[Network]
    actor_target: Network
    critic_target: Sequence[Network]
    actor_optimizer: Optimizer
    critic_optimizer: Optimizer
    gamma: float
    tau: float
    policy_delay: int  # gradient steps of the critic for one of the actor
    noise: float  # standard deviation of that on target actions
    noise_clip: float
    draws_to_explore: ClassVar = 0
    draws_to_learn: ClassVar = 1  # of standard normal numbers, in the order in which they are used

    def explore(self, observation: Tensor, normals: Sequence[Tensor]) -> Tensor:
        """Actions before noise is added, (n, lanes, k) in [-1, 1]."""
        return self.act(self.actor, observation)

    def is_due(self, number: int, index: int) -> bool:
        """Whether the actor learns and the targets follow in a gradient step.

        Args:
            number: of the step since the start, from 1.
            index: of the step since the environments were stepped, from 0.
        """
        return number % self.policy_delay == 0

    @property
    def optimizers(self) -> tuple[Optimizer | None, ...]:
        """All that there are."""
        return (self.actor_optimizer, self.critic_optimizer)

    def size_of_actors(self) -> Tensor:
        """The sum of each actor's weights, (n,), which isn't finite if one of them isn't."""
        return sum_of(self.actor)

    def update(self, batch: Batch, normals: Sequence[Tensor], due: bool) -> Losses:
        """Take a gradient step.

        Args:
            batch: to learn from.
            normals: (n, b, k) each.
            due: what `is_due` said.
        """
        noise = (self.noise * normals[0]).clamp(-self.noise_clip, self.noise_clip)
        chosen = (self.act(self.actor_target, batch.next_observation) + noise).clamp(-1, 1)
        told = values(self.compute, self.critic_target, batch.next_observation, chosen)
        wanted = target(batch, self.gamma, least(told))
        losses = {
            "critic_loss": descend(
                self._critic_loss, self.critic, self.critic_optimizer, batch, wanted
            )
        }
        if due:
            losses["actor_loss"] = descend(
                self._actor_loss, self.actor, self.actor_optimizer, batch.observation
            )
            approach(self.critic_target, self.critic, self.tau)
            approach(self.actor_target, self.actor, self.tau)
        return losses

    def act(self, actor: Network, observation: Tensor) -> Tensor:
        """What networks choose, (n, b, k) in [-1, 1]."""
        return torch.tanh(self.compute(actor, observation))

    def _critic_loss(
        self, critic: Sequence[Network], batch: Batch, wanted: Tensor
    ) -> tuple[Tensor, Tensor]:
        loss = squared_error(critic, self.compute, batch, wanted)
        return loss.sum(), loss

    def _actor_loss(self, actor: Network, observation: Tensor) -> tuple[Tensor, Tensor]:
        chosen = self.act(actor, observation)
        (told,) = values(self.compute, self.critic[:1], observation, chosen)
        loss = -told.mean((1, 2))
        return loss.sum(), loss
