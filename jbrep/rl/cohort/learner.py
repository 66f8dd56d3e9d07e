"""Agents of stable-baselines3 as a stack that learns, and the stack written back into them."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import stable_baselines3
import torch
from torch import Tensor
from torch.nn import Module, ReLU
from torch.optim import Adam, Optimizer
from torch.utils._pytree import tree_leaves, tree_map

from jbrep.rl.cohort.networks import Arithmetic, Network, get_product
from jbrep.rl.cohort.sac import SAC
from jbrep.rl.cohort.stack import Read, gather, parts, scatter
from jbrep.rl.cohort.td3 import TD3
from jbrep.rl.names import FLOAT32

Agents = Sequence[Any]  # of one algorithm and with the same settings
Learner = TD3 | SAC
_TRAINED = ("actor", "critic")
_TARGETS = ("actor_target", "critic_target")
_CPU = torch.device("cpu")
_MOMENTS = ("exp_avg", "exp_avg_sq")


def stacked(
    agents: Agents, size: int, precision: str = FLOAT32, device: torch.device = _CPU
) -> Learner:
    """A stack of the agents as they are.

    Args:
        agents: n, with the state of their optimisers allocated.
        size: to which their observations are filled up.
        precision: of products of matrices.
        device: that the stack is on.
    """
    first = agents[0]
    names = [name for name in (*_TRAINED, *_TARGETS) if hasattr(first, name)]
    networks = {name: _gathered(agents, name, size, _value, device) for name in names}
    shared: dict[str, Any] = {
        **{name: each[0] if "actor" in name else each for name, each in networks.items()},
        **{
            f"{name}_optimizer": _optimizer(agents, name, networks[name], size, device)
            for name in _TRAINED
        },
        "compute": Arithmetic(_activation(first), get_product(precision, device)),
        "gamma": first.gamma,
        "tau": first.tau,
    }
    if not isinstance(first, stable_baselines3.SAC):
        return TD3(
            **shared,
            policy_delay=first.policy_delay,
            noise=first.target_policy_noise,
            noise_clip=first.target_noise_clip,
        )
    weight = torch.cat([_log_weight(agent) for agent in agents]).reshape(-1, 1, 1).to(device)
    return SAC(
        **shared,
        log_ent_coef=weight,
        ent_coef_optimizer=_entropy_optimizer(agents, weight),
        target_entropy=float(first.target_entropy),
        target_update_interval=first.target_update_interval,
    )


def give_back(learner: Learner, agents: Agents, size: int) -> None:
    """Write a stack's weights and moments into its agents; arguments as for `stacked`."""
    with torch.no_grad():
        for name in (*_TRAINED, *_TARGETS):
            if networks := getattr(learner, name, None):
                _scatter(networks, agents, name, size, _value)
        for name in _TRAINED:
            optimizer = getattr(learner, f"{name}_optimizer")
            state = _state(getattr(agent, name).optimizer for agent in agents)
            for moment in _MOMENTS:
                moments = tree_map(_of(optimizer.state, moment), getattr(learner, name))
                _scatter(moments, agents, name, size, _of(state, moment))
            for each in state.values():
                each["step"].copy_(_step(optimizer))
        if isinstance(learner, SAC) and (optimizer := learner.ent_coef_optimizer):
            moments = optimizer.state[learner.log_ent_coef]
            for member, agent in enumerate(agents):
                agent.log_ent_coef.copy_(learner.log_ent_coef[member, 0])
                own = agent.ent_coef_optimizer.state[agent.log_ent_coef]
                own["step"].copy_(moments["step"])
                for moment in _MOMENTS:
                    own[moment].copy_(moments[moment][member, 0])


def _gathered(
    agents: Agents, name: str, size: int, read: Read, device: torch.device
) -> list[Network]:
    each = zip(*(parts(agent, name) for agent in agents), strict=True)
    stacks = [gather(networks, size, read) for networks in each]
    return tree_map(lambda leaf: leaf.to(device), stacks)


def _scatter(networks: Any, agents: Agents, name: str, size: int, read: Read) -> None:
    several = [networks] if "actor" in name else networks
    for member, agent in enumerate(agents):
        for network, part in zip(several, parts(agent, name), strict=True):
            scatter(network, member, part, size, read)


def _optimizer(
    agents: Agents, name: str, networks: Sequence[Network], size: int, device: torch.device
) -> Optimizer:
    """Adam on stacked networks, with the moments of the agents' own."""
    state = _state(getattr(agent, name).optimizer for agent in agents)
    moments = [_gathered(agents, name, size, _of(state, m), device) for m in _MOMENTS]
    options = {"fused": True, **agents[0].policy.optimizer_kwargs}
    return _adam(tree_leaves(networks), map(tree_leaves, moments), state, options)


def _entropy_optimizer(agents: Agents, weight: Tensor) -> Optimizer | None:
    if agents[0].ent_coef_optimizer is None:
        return None
    state = _state(agent.ent_coef_optimizer for agent in agents)
    moments = (torch.stack([each[moment] for each in state.values()]) for moment in _MOMENTS)
    own = ([each.reshape(weight.shape).to(weight.device)] for each in moments)
    return _adam([weight], own, state, {})


def _adam(
    leaves: list[Tensor], moments: Any, state: dict[Tensor, Any], options: dict[str, Any]
) -> Optimizer:
    optimizer = Adam(leaves, **options)
    step = next(iter(state.values()))["step"]
    for leaf, *each in zip(leaves, *moments, strict=True):
        own = dict(zip(_MOMENTS, each, strict=True))
        optimizer.state[leaf] = {"step": step.clone().to(leaf.device), **own}
    return optimizer


def _log_weight(agent: Any) -> Tensor:
    if agent.ent_coef_optimizer is None:
        return agent.ent_coef_tensor.log().reshape(1)
    return agent.log_ent_coef.detach()


def _state(optimizers: Iterator[Optimizer]) -> dict[Tensor, Any]:
    return {p: each for optimizer in optimizers for p, each in optimizer.state.items()}


def _step(optimizer: Optimizer) -> Tensor:
    return next(iter(optimizer.state.values()))["step"]


def _of(state: Any, moment: str) -> Callable[[Tensor], Tensor]:
    return lambda leaf: state[leaf][moment]


def _activation(agent: Any) -> Callable[[Tensor], Tensor]:
    """What follows the hidden layers of an agent; it may overwrite what it is given."""
    activation: Module = agent.policy.activation_fn()
    return torch.relu_ if isinstance(activation, ReLU) else activation


def _value(parameter: Tensor) -> Tensor:
    return parameter.detach()
