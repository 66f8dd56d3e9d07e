"""SAC for n agents at once, with the gradient steps of stable-baselines3."""

import math
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

_LOG_STD = (-20.0, 2.0)  # the limits of stable-baselines3's actor
_EPSILON = 1e-6  # in the density of its actions


@dataclass(kw_only=True)
class SAC:
    """Soft actor-critic (Haarnoja et al. 2018).

    Networks and optimisers have stable-baselines3's names.
    """

    compute: Arithmetic
    actor: Network  # its outputs are means, then logarithms of standard deviations
    critic: Sequence[Network]
    critic_target: Sequence[Network]
    log_ent_coef: Tensor  # of the entropy's weight, (n, 1, 1)
    actor_optimizer: Optimizer
    critic_optimizer: Optimizer
    ent_coef_optimizer: Optimizer | None  # None: the weight is fixed
    gamma: float
    tau: float
    target_entropy: float
    target_update_interval: int
    draws_to_explore: ClassVar = 1
    draws_to_learn: ClassVar = 2  # of standard normal numbers, in the order in which they are used

    def explore(self, observation: Tensor, normals: Sequence[Tensor]) -> Tensor:
        """Actions at random, (n, lanes, k) in [-1, 1]."""
        return self._sample(self.actor, observation, normals[0])[0]

    def is_due(self, number: int, index: int) -> bool:
        """Whether the targets follow in a gradient step.

        Args:
            number: of the step since the start, from 1.
            index: of the step since the environments were stepped, from 0.
        """
        return index % self.target_update_interval == 0

    @property
    def optimizers(self) -> tuple[Optimizer | None, ...]:
        """All that there are."""
        return (self.actor_optimizer, self.critic_optimizer, self.ent_coef_optimizer)

    def size_of_actors(self) -> Tensor:
        """The sum of each actor's weights, (n,), which isn't finite if one of them isn't."""
        return sum_of(self.actor)

    def update(self, batch: Batch, normals: Sequence[Tensor], due: bool) -> Losses:
        """Take a gradient step.

        Args:
            batch: to learn from.
            normals: (n, b, k) each, of actions now and next.
            due: what `is_due` said.
        """
        now, after = normals
        weight = self.log_ent_coef.exp()
        chosen, log_density = self._sample(self.actor, batch.next_observation, after)
        told = values(self.compute, self.critic_target, batch.next_observation, chosen)
        wanted = target(batch, self.gamma, least(told) - weight * log_density)
        losses = {
            "critic_loss": descend(
                self._critic_loss, self.critic, self.critic_optimizer, batch, wanted
            )
        }
        losses["actor_loss"], log_density = descend(
            self._actor_loss, self.actor, self.actor_optimizer, batch.observation, now, weight
        )
        losses["ent_coef"] = weight[:, 0, 0]
        if optimizer := self.ent_coef_optimizer:
            excess = log_density + self.target_entropy
            loss = descend(self._entropy_loss, self.log_ent_coef, optimizer, excess)
            losses["ent_coef_loss"] = loss
        if due:
            approach(self.critic_target, self.critic, self.tau)
        return losses

    def _sample(self, actor: Network, observation: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
        """Actions made of standard normal numbers, (n, b, k), and their log density, (n, b, 1)."""
        mean, log_std = self.compute(actor, observation).chunk(2, 2)
        log_std = log_std.clamp(*_LOG_STD)
        action = torch.tanh(mean + log_std.exp() * normal)
        log_density = -0.5 * normal**2 - log_std - 0.5 * math.log(2 * math.pi)
        log_density = log_density - torch.log(1 - action**2 + _EPSILON)  # of the squashed action
        return action, log_density.sum(2, keepdim=True)

    def _critic_loss(
        self, critic: Sequence[Network], batch: Batch, wanted: Tensor
    ) -> tuple[Tensor, Tensor]:
        loss = 0.5 * squared_error(critic, self.compute, batch, wanted)
        return loss.sum(), loss

    def _actor_loss(
        self, actor: Network, observation: Tensor, normal: Tensor, weight: Tensor
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        action, log_density = self._sample(actor, observation, normal)
        told = values(self.compute, self.critic, observation, action)
        loss = (weight * log_density - least(told)).mean((1, 2))
        return loss.sum(), (loss, log_density)

    def _entropy_loss(self, log_weight: Tensor, excess: Tensor) -> tuple[Tensor, Tensor]:
        loss = -(log_weight * excess).mean((1, 2))
        return loss.sum(), loss
