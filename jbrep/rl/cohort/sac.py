"""SAC of n agents at once."""

import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor

from jbrep.rl.cohort.algorithm import Algorithm, Batch, Losses, min_q, optimizer_step
from jbrep.rl.cohort.networks import Stack

_LOG_STD = (-20.0, 2.0)  # the limits of stable-baselines3's actor
_EPSILON = 1e-6  # in the density of its actions


class SAC(Algorithm):
    """Soft actor-critic (Haarnoja et al. 2018).

    The actor's outputs are means, then logarithms of standard deviations.
    """

    settings: ClassVar = ("ent_coef", "target_entropy", "target_update_interval")
    normals_to_explore: ClassVar = 1
    normals_to_learn: ClassVar = 2

    def __init__(self, stack: Stack):
        super().__init__(stack)
        agent = stack.agents[0]
        self.target_entropy = float(agent.target_entropy)
        self.target_update_interval: int = agent.target_update_interval
        (self.actor,) = stack.networks(
            lambda each: [[*each.actor.latent_pi, [each.actor.mu, each.actor.log_std]]]
        )
        self.actor_optimizer = stack.adam(self.actor, lambda each: each.actor.optimizer)
        self.ent_coef_optimizer = None  # the coefficient is fixed
        if agent.ent_coef_optimizer is None:
            self.log_ent_coef = stack.numbers(lambda each: each.ent_coef_tensor.log())
        else:
            self.log_ent_coef = stack.numbers(lambda each: each.log_ent_coef)
            self.ent_coef_optimizer = stack.adam(
                self.log_ent_coef, lambda each: each.ent_coef_optimizer
            )

    def explore(self, observation: Tensor, normals: Sequence[Tensor]) -> Tensor:
        """Actions drawn from the policy."""
        return self.sample(observation, normals[0])[0]

    def sample(self, observation: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
        """Actions of the policy, (n, b, k), with their log density, (n, b, 1)."""
        mean, log_std = self.mlp(self.actor, observation).chunk(2, 2)
        log_std = log_std.clamp(*_LOG_STD)
        action = torch.tanh(mean + log_std.exp() * normal)
        log_prob = -0.5 * normal**2 - log_std - 0.5 * math.log(2 * math.pi)
        log_prob = log_prob - torch.log(1 - action**2 + _EPSILON)  # of the squashed action
        return action, log_prob.sum(2, keepdim=True)

    def update(
        self, batch: Batch, normals: Sequence[Tensor], n_updates: int, gradient_step: int
    ) -> Losses:
        """As for `Algorithm`; all losses are by the entropy coefficient of before."""
        normal, next_normal = normals
        ent_coef = self.log_ent_coef.exp()
        critic_loss = self.update_critic(batch, next_normal, ent_coef)
        actor_loss, log_prob = self.update_actor(batch.observation, normal, ent_coef)
        losses = {
            "critic_loss": critic_loss,
            "actor_loss": actor_loss,
            "ent_coef": ent_coef[:, 0, 0],
            **self.update_ent_coef(log_prob),
        }
        if gradient_step % self.target_update_interval == 0:
            self.polyak_update()
        return losses

    def update_critic(self, batch: Batch, normal: Tensor, ent_coef: Tensor) -> Tensor:
        """Take a step towards the smaller of the targets' values, and the entropy."""
        next_action, next_log_prob = self.sample(batch.next_observation, normal)
        next_q = min_q(self.q_values(self.critic_target, batch.next_observation, next_action))
        target = self.td_target(batch, next_q - ent_coef * next_log_prob)
        with optimizer_step(self.critic_optimizer):
            loss = 0.5 * self.critic_loss(self.critic, batch, target)
            loss.sum().backward()
        return loss.detach()

    def update_actor(
        self, observation: Tensor, normal: Tensor, ent_coef: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Take a step up value and entropy; also the actions' log density, (n, b, 1)."""
        with optimizer_step(self.actor_optimizer):
            action, log_prob = self.sample(observation, normal)
            q_value = min_q(self.q_values(self.critic, observation, action))
            loss = (ent_coef * log_prob - q_value).mean((1, 2))
            loss.sum().backward()
        return loss.detach(), log_prob.detach()

    def update_ent_coef(self, log_prob: Tensor) -> Losses:
        """Take a step of the coefficient towards the target entropy, unless it is fixed."""
        if not self.ent_coef_optimizer:
            return {}
        with optimizer_step(self.ent_coef_optimizer):
            loss = -(self.log_ent_coef * (log_prob + self.target_entropy)).mean((1, 2))
            loss.sum().backward()
        return {"ent_coef_loss": loss.detach()}
