"""TD3 of n agents at once.

DDPG is TD3 with one critic, a step of the actor for each of the critic, and no noise on targets.
"""

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor

from jbrep.rl.cohort.algorithm import Algorithm, Batch, Losses, min_q, optimizer_step
from jbrep.rl.cohort.networks import Network, Stack


class TD3(Algorithm):
    """Twin delayed deep deterministic policy gradients (Fujimoto et al. 2018)."""

    settings: ClassVar = ("policy_delay", "target_noise_clip", "target_policy_noise")
    normals_to_explore: ClassVar = 0
    normals_to_learn: ClassVar = 1

    def __init__(self, stack: Stack):
        super().__init__(stack)
        agent = stack.agents[0]
        self.policy_delay: int = agent.policy_delay
        self.target_policy_noise: float = agent.target_policy_noise
        self.target_noise_clip: float = agent.target_noise_clip
        (self.actor,) = stack.networks(lambda each: [each.actor.mu])
        (self.actor_target,) = stack.networks(lambda each: [each.actor_target.mu])
        self.set_targets([self.critic, self.actor], [self.critic_target, self.actor_target])
        self.actor_optimizer = stack.adam(self.actor, lambda each: each.actor.optimizer)

    def explore(self, observation: Tensor, normals: Sequence[Tensor]) -> Tensor:
        """The policy's actions."""
        return self.act(self.actor, observation)

    def act(self, actor: Network, observation: Tensor) -> Tensor:
        """The actions of a policy, (n, b, k) in [-1, 1]."""
        return torch.tanh(self.mlp(actor, observation))

    def update(
        self, batch: Batch, normals: Sequence[Tensor], n_updates: int, gradient_step: int
    ) -> Losses:
        """As for `Algorithm`; the actor and the targets follow with a delay."""
        losses = {"critic_loss": self.update_critic(batch, normals[0])}
        if n_updates % self.policy_delay == 0:
            losses["actor_loss"] = self.update_actor(batch.observation)
            self.polyak_update()
        return losses

    def update_critic(self, batch: Batch, normal: Tensor) -> Tensor:
        """Take a step towards the smaller of the targets' values of actions with clipped noise."""
        limit = self.target_noise_clip
        noise = (self.target_policy_noise * normal).clamp(-limit, limit)
        next_action = (self.act(self.actor_target, batch.next_observation) + noise).clamp(-1, 1)
        next_q = min_q(self.q_values(self.critic_target, batch.next_observation, next_action))
        target = self.td_target(batch, next_q)
        with optimizer_step(self.critic_optimizer):
            loss = self.critic_loss(self.critic, batch, target)
            loss.sum().backward()
        return loss.detach()

    def update_actor(self, observation: Tensor) -> Tensor:
        """Take a step up the first critic's Q-value of the policy's actions."""
        with optimizer_step(self.actor_optimizer):
            action = self.act(self.actor, observation)
            (q_value,) = self.q_values(self.critic[:1], observation, action)
            loss = -q_value.mean((1, 2))
            loss.sum().backward()
        return loss.detach()
