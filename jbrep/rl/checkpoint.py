"""Where a run has got to, in a file that runs nothing when it is read."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.vec_env import VecMonitor

from jbrep.errors import InputError, differences
from jbrep.files import container
from jbrep.files.container import Tensors

_MAX_BYTES = 1 << 34
_COUNTERS = ("num_timesteps", "_n_updates", "_episode_num")
_ROLLOUT = ("_last_obs", "_last_episode_starts")
_TRANSITIONS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def save(
    agent: BaseAlgorithm, record: Mapping[str, Any], identity: Mapping[str, Any], path: Path
) -> None:
    """Write all that decides how the run goes on, whole or not at all.

    Args:
        agent: between two rollouts.
        record: what else to keep: plain JSON.
        identity: what must be equal for the run to go on: plain JSON.
        path: the file.
    """
    tensors, counters = _state(agent)
    header = {"identity": identity, "record": record, "counters": counters}
    container.write(path, {k: np.asarray(v, order="C") for k, v in tensors.items()}, header)


def restore(agent: BaseAlgorithm, identity: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Bring an agent that begins to learn to where the file's was.

    Returns:
        The record that was kept.

    Raises:
        InputError: the file is damaged, or of other settings or versions.
    """
    tensors, header = container.read(path, "checkpoint", _MAX_BYTES)
    try:
        differing = differences(dict(header["identity"]), identity)
        if not differing:
            _restore(agent, tensors, header["counters"])
            return dict(header["record"])
    except (KeyError, TypeError, ValueError, RuntimeError, IndexError):
        raise InputError(f"{path} is damaged: delete it to begin anew") from None
    raise InputError(
        f"{path} was begun otherwise: {differing}; take another folder, or delete it to begin anew"
    )


def _state(agent: BaseAlgorithm) -> tuple[Tensors, dict[str, Any]]:
    """Arrays by name, and what JSON holds."""
    env = _env(agent)
    physics, generators = env.venv.get_attr("episodes")[0].state
    kind, keys, position, has_gauss, gauss = np.random.get_state()  # noqa: NPY002 - SB3 draws there
    tensors = {f"parameters.{name}": tensor.numpy() for name, tensor in _parameters(agent)}
    tensors |= {f"physics.{name}": values for name, values in physics.items()}
    tensors |= {f"noise.{i}": n.noise_prev for i, n in enumerate(_drifting(agent))}
    tensors |= {f"rollout.{name}": getattr(agent, name) for name in _ROLLOUT}
    tensors |= {"returns": env.episode_returns, "lengths": env.episode_lengths}
    tensors |= {"torch": torch.get_rng_state().numpy(), "numpy": np.asarray(keys)}
    counters = {name: getattr(agent, name) for name in _COUNTERS}
    counters |= {
        "numpy": (kind, position, has_gauss, gauss),
        "generators": generators,
        "action_space": agent.action_space.np_random.bit_generator.state,
        "episodes": [{k: float(v) for k, v in e.items()} for e in agent.ep_info_buffer or ()],
    }
    if buffer := _buffer(agent):
        counters["buffer"] = (buffer.pos, buffer.full)
        tensors |= {f"buffer.{name}": values for name, values in _transitions(buffer).items()}
    return tensors, counters


def _restore(agent: BaseAlgorithm, tensors: Tensors, counters: Mapping[str, Any]) -> None:
    """Put back what `_state` took."""
    env = _env(agent)
    if buffer := _buffer(agent):
        buffer.pos, buffer.full = counters["buffer"]
        for name, values in _transitions(buffer).items():
            values[:] = tensors[f"buffer.{name}"]
    with torch.no_grad():
        for name, tensor in _parameters(agent):
            tensor.copy_(torch.from_numpy(tensors[f"parameters.{name}"]))
    for i, noise in enumerate(_drifting(agent)):
        noise.noise_prev = tensors[f"noise.{i}"]
    for name in _ROLLOUT:
        setattr(agent, name, tensors[f"rollout.{name}"])
    for name in _COUNTERS:
        setattr(agent, name, counters[name])
    env.episode_returns, env.episode_lengths = tensors["returns"], tensors["lengths"]
    physics = {n.removeprefix("physics."): v for n, v in tensors.items() if "physics." in n}
    env.venv.get_attr("episodes")[0].restore(physics, counters["generators"])
    assert agent.ep_info_buffer is not None
    agent.ep_info_buffer.extend(counters["episodes"])
    agent.action_space.np_random.bit_generator.state = counters["action_space"]
    torch.set_rng_state(torch.from_numpy(tensors["torch"]))
    kind, *rest = counters["numpy"]
    np.random.set_state((kind, tensors["numpy"], *rest))  # noqa: NPY002


def _env(agent: BaseAlgorithm) -> VecMonitor:
    assert isinstance(agent.env, VecMonitor)
    return agent.env


def _buffer(agent: BaseAlgorithm) -> ReplayBuffer | None:
    return getattr(agent, "replay_buffer", None)


def _transitions(buffer: ReplayBuffer) -> dict[str, NDArray[Any]]:
    """Views of what is in the buffer."""
    size = buffer.buffer_size if buffer.full else buffer.pos
    return {name: getattr(buffer, name)[:size] for name in _TRANSITIONS}


def _drifting(agent: BaseAlgorithm) -> list[OrnsteinUhlenbeckActionNoise]:
    """The action noise of each lane, if it has a memory."""
    noise = getattr(agent, "action_noise", None)
    noises = noise.noises if isinstance(noise, VectorizedActionNoise) else [noise]
    return [n for n in noises if isinstance(n, OrnsteinUhlenbeckActionNoise)]


def _parameters(agent: BaseAlgorithm) -> Iterator[tuple[str, torch.Tensor]]:
    """What gradient steps change: weights, targets, moments; the agent's own tensors."""
    names, variables = agent._get_torch_save_params()
    yield from ((name, getattr(agent, name).data) for name in variables)
    for name in names:
        part: Any = agent
        for word in name.split("."):
            part = getattr(part, word)
        if isinstance(part, torch.optim.Optimizer):
            begin(part)
            yield from _moments(name, part)
        else:
            yield from ((f"{name}.{key}", t) for key, t in part.state_dict().items())


def _moments(name: str, optimizer: torch.optim.Optimizer) -> Iterator[tuple[str, torch.Tensor]]:
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    for i, parameter in enumerate(parameters):
        for key, tensor in optimizer.state[parameter].items():
            yield f"{name}.{i}.{key}", tensor


def begin(optimizer: torch.optim.Optimizer) -> None:
    """Make the state that Adam would make at its first step, where it has none yet."""
    for group in optimizer.param_groups:
        for parameter in group["params"]:
            state = optimizer.state[parameter]
            state.setdefault("step", torch.zeros(()))
            state.setdefault("exp_avg", torch.zeros_like(parameter))
            state.setdefault("exp_avg_sq", torch.zeros_like(parameter))
