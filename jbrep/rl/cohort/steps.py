"""What the gradient steps of all algorithms are made of, for n agents at once.

Losses are summed over members: since no member's loss depends on another's weights, the gradient of
the sum is that of each.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.optim import Optimizer
from torch.utils._pytree import tree_leaves, tree_map

from jbrep.rl.cohort.networks import Arithmetic, Network

Losses = dict[str, Tensor]  # of each member, (n,) each, by stable-baselines3's names


class Batch(NamedTuple):
    """Transitions from each member's own replay memory."""

    observation: Tensor  # (n, b, d)
    action: Tensor  # (n, b, k), in [-1, 1]
    next_observation: Tensor  # (n, b, d)
    reward: Tensor  # (n, b, 1)
    ended: Tensor  # (n, b, 1); 1 where a state ended the episode, else 0


def values(
    compute: Arithmetic, critics: Sequence[Network], observation: Tensor, action: Tensor
) -> list[Tensor]:
    """What each critic says of each action, (n, b, 1)."""
    inputs = torch.cat((observation, action), 2)
    return [compute(critic, inputs) for critic in critics]


def least(each: Sequence[Tensor]) -> Tensor:
    """The elementwise minimum."""
    return torch.stack([*each]).min(0).values


def target(batch: Batch, gamma: float, value: Tensor) -> Tensor:
    """What a critic should say, given the value of the next state, (n, b, 1)."""
    return batch.reward + (1 - batch.ended) * gamma * value


def squared_error(
    critics: Sequence[Network], compute: Arithmetic, batch: Batch, wanted: Tensor
) -> Tensor:
    """The sum of all critics' mean squared errors, (n,)."""
    told = values(compute, critics, batch.observation, batch.action)
    return torch.stack([((each - wanted) ** 2).mean((1, 2)) for each in told]).sum(0)


def descend(
    loss: Callable[..., tuple[Tensor, Any]], weights: Any, optimizer: Optimizer, *others: Any
) -> Any:
    """Take a step of an optimiser, and return what the loss tells beside its value."""
    leaves = [leaf.requires_grad_() for leaf in tree_leaves(weights)]
    value, told = loss(weights, *others)
    for leaf, gradient in zip(leaves, torch.autograd.grad(value, leaves), strict=True):
        leaf.grad = gradient
        leaf.requires_grad_(False)
    optimizer.step()
    return tree_map(Tensor.detach, told)


def approach(targets: Any, weights: Any, tau: float) -> None:
    """Move target weights towards the weights by a share of the distance."""
    for behind, ahead in zip(tree_leaves(targets), tree_leaves(weights), strict=True):
        behind.lerp_(ahead, tau)


def set_rate(optimizers: Sequence[Optimizer | None], rate: float) -> None:
    """Let optimisers go on at a learning rate."""
    for optimizer in filter(None, optimizers):
        optimizer.param_groups[0]["lr"] = rate


def sum_of(network: Network) -> Tensor:
    """The sum of each member's weights, (n,): not finite if one of them isn't."""
    return torch.stack([leaf.sum((1, 2)) for leaf in tree_leaves(network)]).sum(0)
