"""Weights of stable-baselines3's agents, and Adam's moments of them, into a stack and back.

Agents whose observations have different sizes stand in one stack: the shorter are filled up with
zeros. The gradient of a weight on a zero is zero, and Adam leaves it at zero.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from torch import Tensor
from torch.nn import Linear, Sequential

from jbrep.rl.cohort.networks import Layer, Network

Read = Callable[[Tensor], Tensor]


class Part(NamedTuple):
    """A network of one agent."""

    layers: Sequence[Sequence[Linear]]  # one of several modules has the outputs of all of them
    size: int  # of the observation, which comes first among its inputs


def parts(agent: OffPolicyAlgorithm, name: str) -> list[Part]:
    """An agent's networks: one of its actor or actor_target, some of critic or critic_target."""
    (size,) = agent.observation_space.shape or ()
    module = getattr(agent, name)
    if "critic" in name:
        return [Part(_linears(network), size) for network in module.q_networks]
    if hasattr(module, "log_std"):  # SAC's last layer has means and standard deviations
        return [Part([*_linears(module.latent_pi), [module.mu, module.log_std]], size)]
    return [Part(_linears(module.mu), size)]


def _linears(network: Sequential) -> list[list[Linear]]:
    return [[module] for module in network if isinstance(module, Linear)]


def gather(networks: Sequence[Part], size: int, read: Read) -> Network:
    """The same network of several agents, stacked.

    Args:
        networks: of the agents.
        size: to which observations are filled up.
        read: a parameter's values, or moments.
    """
    layers = []
    for number, each in enumerate(zip(*(part.layers for part in networks), strict=True)):
        weights = [torch.cat([read(m.weight) for m in modules]).T for modules in each]
        biases = [torch.cat([read(m.bias) for m in modules])[None] for modules in each]
        if number == 0:
            own = [part.size for part in networks]
            weights = [_fill(w, n, size) for w, n in zip(weights, own, strict=True)]
        layers.append(Layer(torch.stack(weights), torch.stack(biases)))
    return layers


def scatter(network: Network, member: int, part: Part, size: int, read: Read) -> None:
    """Write a member's entries of a stack into its own network; arguments as for `gather`."""
    for number, (layer, modules) in enumerate(zip(network, part.layers, strict=True)):
        weight, bias = layer.weight[member], layer.bias[member, 0]
        if number == 0:
            weight = torch.cat((weight[: part.size], weight[size:]))
        outputs = [module.out_features for module in modules]
        for module, w, b in zip(modules, weight.T.split(outputs), bias.split(outputs), strict=True):
            read(module.weight).copy_(w)
            read(module.bias).copy_(b)


def _fill(weight: Tensor, size: int, to: int) -> Tensor:
    """Zeros after the first `size` of the inputs, up to `to`."""
    filling = weight.new_zeros(to - size, weight.shape[1])
    return torch.cat((weight[:size], filling, weight[size:]))
