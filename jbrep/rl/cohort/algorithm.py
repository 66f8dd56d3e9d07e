"""What an algorithm is that trains n agents at once, and what its gradient steps are made of.

Losses are (n,), one for each agent. Their sum is differentiated: as no agent's loss depends on the
weights of another, its gradient is that of each.
"""

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor
from torch.optim import Optimizer
from torch.utils._pytree import tree_leaves

from jbrep.errors import InputError
from jbrep.rl.cohort import ALGORITHMS, get_algorithm
from jbrep.rl.cohort.networks import Network, Stack
from jbrep.rl.presets import Hyperparameters, parameters_of

Losses = dict[str, Tensor]  # (n,) each, by the names under which stable-baselines3 logs them
_SETTINGS = {  # of stable-baselines3 that every algorithm here honours
    *("batch_size", "buffer_size", "gamma", "gradient_steps", "learning_rate", "learning_starts"),
    *("n_steps", "stats_window_size", "tau", "train_freq", "activation_fn", "n_critics"),
}
_INSTEAD = 'add --trainer sb3, or trainer = "sb3" to a study'


class Batch(NamedTuple):
    """Transitions of n_steps from each agent's own replay buffer, or to an episode's end."""

    observation: Tensor  # (n, b, d)
    action: Tensor  # (n, b, k), in [-1, 1]
    next_observation: Tensor  # (n, b, d)
    reward: Tensor  # (n, b, 1); the discounted sum of those on the way
    terminated: Tensor  # (n, b, 1); 1 where a state ended the episode, else 0
    discount: Tensor  # (n, b, 1); of the next observation's value


class Algorithm(ABC):
    """An off-policy actor-critic algorithm, with the gradient steps of stable-baselines3.

    Args:
        stack: of the agents, from which a subclass gathers its networks and optimisers.
    """

    settings: ClassVar[Collection[str]]  # of stable-baselines3 that it honours, beside _SETTINGS
    normals_to_explore: ClassVar[int]  # draws of standard normal numbers that `explore` takes
    normals_to_learn: ClassVar[int]  # the same of `update`
    actor: Network

    def __init__(self, stack: Stack):
        self.mlp = stack.mlp
        self.critic = stack.networks(lambda each: each.critic.q_networks)
        self.critic_target = stack.networks(lambda each: each.critic_target.q_networks)
        self.critic_optimizer = stack.adam(self.critic, lambda each: each.critic.optimizer)
        self.tau: float = stack.agents[0].tau
        self.set_targets(self.critic, self.critic_target)

    def set_targets(self, networks: Any, targets: Any) -> None:
        """Say which networks have targets, for `polyak_update`."""
        self._weights, self._target_weights = tree_leaves(networks), tree_leaves(targets)

    def polyak_update(self) -> None:
        """Move the weights of the targets towards those of their networks by a share tau."""
        torch._foreach_lerp_(self._target_weights, self._weights, self.tau)

    @abstractmethod
    def explore(self, observation: Tensor, normals: Sequence[Tensor]) -> Tensor:
        """Actions in [-1, 1] before action noise, by draws for them, (n, lanes, k) each."""

    @abstractmethod
    def update(
        self, batch: Batch, normals: Sequence[Tensor], n_updates: int, gradient_step: int
    ) -> Losses:
        """Take a gradient step of all agents.

        Args:
            batch: to learn from.
            normals: (n, b, k) each.
            n_updates: gradient steps since the start, with this one.
            gradient_step: of those since the environments were stepped, from 0.
        """

    def q_values(
        self, critic: Sequence[Network], observation: Tensor, action: Tensor
    ) -> list[Tensor]:
        """The Q-values of actions by each network of a critic, (n, b, 1)."""
        inputs = torch.cat((observation, action), 2)
        return [self.mlp(network, inputs) for network in critic]

    def td_target(self, batch: Batch, next_value: Tensor) -> Tensor:
        """Reward and discounted value of the next state, (n, b, 1)."""
        return batch.reward + (1 - batch.terminated) * batch.discount * next_value

    def critic_loss(self, critic: Sequence[Network], batch: Batch, target: Tensor) -> Tensor:
        """The sum of the mean squared errors of a critic's networks, (n,)."""
        q_values = self.q_values(critic, batch.observation, batch.action)
        return torch.stack([((q - target) ** 2).mean((1, 2)) for q in q_values]).sum(0)

    def actor_sum(self) -> Tensor:
        """The sum of each actor's weights, (n,), which isn't finite if one of them isn't."""
        return torch.stack([leaf.sum((1, 2)) for leaf in tree_leaves(self.actor)]).sum(0)


def min_q(q_values: Sequence[Tensor]) -> Tensor:
    """The smallest Q-value of each action, (n, b, 1)."""
    return torch.stack([*q_values]).min(0).values


@contextmanager
def optimizer_step(optimizer: Optimizer) -> Iterator[None]:
    """Let an optimiser's weights have gradients in a block, and take its step at the end."""
    weights = optimizer.param_groups[0]["params"]
    for each in weights:
        each.requires_grad_(True)
    yield
    for each in weights:
        each.requires_grad_(False)
    optimizer.step()
    optimizer.zero_grad()


def check(algorithm: str, hyperparameters: Hyperparameters) -> None:
    """Check that agents of an algorithm with these settings can learn in a cohort."""
    if algorithm not in ALGORITHMS:
        raise InputError(f"cohorts train {', '.join(ALGORITHMS)}, not {algorithm}: {_INSTEAD}")
    of_class, of_policy = hyperparameters.algorithm_kwargs, hyperparameters.policy_kwargs
    if isinstance(of_class.get("train_freq"), list):
        raise InputError(f"a cohort takes train_freq as a number of steps: {_INSTEAD}")
    honoured = {*_SETTINGS, *get_algorithm(algorithm).settings}
    for given, parameters in zip((of_class, of_policy), parameters_of(algorithm), strict=True):
        for name, value in given.items():
            if name not in honoured and value != parameters[name].default:
                raise InputError(f"a cohort can't learn with {name} = {value}: {_INSTEAD}")
